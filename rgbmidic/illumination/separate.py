"""The single entry from a raw mosaic to one image per light."""

from __future__ import annotations

from collections.abc import Callable

from rgbmidic.errors import InputError
from rgbmidic.illumination.calibration import Crosstalk
from rgbmidic.illumination.demosaic import BilinearDemosaicer, Demosaicer, MalvarDemosaicer
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.mosaic import LinearMosaic
from rgbmidic.illumination.unmix import unmix

__all__ = ["DEMOSAICERS", "Separator", "separate"]

Separator = Callable[[LinearMosaic, Crosstalk], IlluminationImages]
"""A method that gives the lights from the mosaic."""


def _channelwise(demosaicer: Demosaicer) -> Separator:
    def separator(mosaic: LinearMosaic, crosstalk: Crosstalk) -> IlluminationImages:
        return unmix(demosaicer(mosaic), crosstalk)

    return separator


DEMOSAICERS: dict[str, Separator] = {
    "bilinear": _channelwise(BilinearDemosaicer()),
    "malvar": _channelwise(MalvarDemosaicer()),
}
"""The methods by the name they have in the configuration."""


def separate(mosaic: LinearMosaic, crosstalk: Crosstalk, method: str = "malvar") -> IlluminationImages:
    """One image per light from one raw frame.

    Parameters
    ----------
    mosaic
        The linearised frame.
    crosstalk
        Which camera channel sees how much of which light, shape (3, k).
    method
        One of `DEMOSAICERS`.

    Raises
    ------
    InputError
        Unknown method, or a crosstalk matrix that is not for three camera channels.
    """
    if method not in DEMOSAICERS:
        raise InputError(f"unknown demosaicing method {method!r}; allowed are {', '.join(DEMOSAICERS)}")
    if crosstalk.matrix.shape[0] != 3:
        raise InputError(
            f"a Bayer mosaic has 3 camera channels; the crosstalk matrix has {crosstalk.matrix.shape[0]} rows"
        )
    return DEMOSAICERS[method](mosaic, crosstalk)
