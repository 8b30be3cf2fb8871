"""Raw mosaic to illumination images: linearise, demosaic, unmix, reflection index, weights.

The names below are imported on first use: spectra and calibration files are read without the kernels.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rgbmidic.illumination.images import REFLECTING, IlluminationImages

__all__ = ["REFLECTING", "IlluminationImages"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from rgbmidic.illumination import images

        return getattr(images, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
