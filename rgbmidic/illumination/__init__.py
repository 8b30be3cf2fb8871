"""From a raw frame to one image per light: linearise, demosaic, unmix; calibration and checks of a frame.

The names below are imported on first use.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rgbmidic.illumination.crosstalk import unmix
    from rgbmidic.illumination.images import IlluminationImages
    from rgbmidic.illumination.linear import linearise
    from rgbmidic.illumination.separation import demosaic, separate

__all__ = ["IlluminationImages", "demosaic", "linearise", "separate", "unmix"]

_HOMES = {
    "IlluminationImages": "images",
    "demosaic": "separation",
    "linearise": "linear",
    "separate": "separation",
    "unmix": "crosstalk",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"rgbmidic.illumination.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
