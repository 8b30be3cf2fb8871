"""The single entry from a raw mosaic to one image per light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from rgbmidic._kernels.kriging import TILE
from rgbmidic.errors import InputError
from rgbmidic.illumination.colour_factors import BLOCK, ColourFactors
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaic import (
    BandLimitedDemosaicer,
    BilinearDemosaicer,
    Demosaicer,
    MalvarDemosaicer,
    MenonDemosaicer,
    NormalisedMosaic,
    Reconstruction,
    ReflectionAwareDemosaicer,
)
from rgbmidic.illumination.demosaic.reflection_aware import SMALLEST_FRAME
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearMosaic
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.illumination.unmix import unmix
from rgbmidic.typing import FloatArray, FloatImage

__all__ = [
    "DEFAULT_METHOD",
    "DEMOSAICERS",
    "Separated",
    "Separator",
    "separate",
    "separate_reflections",
]


Separator = Callable[[LinearMosaic, Crosstalk, TextureModel | None], IlluminationImages]
"""A method that gives the lights from the mosaic; one that does not model the texture ignores it."""

DEFAULT_METHOD = "reflection-aware"


@dataclass(frozen=True, slots=True, kw_only=True)
class Separated:
    """The lights of one frame with what their separation found out.

    Attributes
    ----------
    images : IlluminationImages
        What the solve should correlate, each light divided by its local mean.
    variance : (k, H, W) float32
        Variance of the error of the values that comes from what a pixel did not sample, and from noise (DN²).
    texture : TextureModel
        The speckle's autocorrelation: hand it on to the other frames of the test.
    """

    images: IlluminationImages
    variance: FloatImage
    texture: TextureModel

    @property
    def reflection_index(self) -> FloatImage:
        """That of the images, which this method always tells."""
        assert self.images.reflection_index is not None
        return self.images.reflection_index


def separate_reflections(
    mosaic: LinearMosaic, crosstalk: Crosstalk, *, texture: TextureModel | None = None
) -> Separated:
    """Lights, reflection index and variance of one raw frame by the reflection-aware method.

    Parameters
    ----------
    mosaic
        The linearised frame, at least 64 x 64 px.
    crosstalk
        Which camera channel sees how much of which light, shape (3, k).
    texture
        The speckle's autocorrelation, from another frame of the test; None learns it from this one.

    Raises
    ------
    InputError
        The frame is too small, or the crosstalk matrix is not for three camera channels.
    """
    _check_channels(crosstalk)
    found = ReflectionAwareDemosaicer(crosstalk=crosstalk, texture=texture).reconstruct(mosaic)
    shape = mosaic.values.shape
    spread = _tiles(found.factors.spread, found.table.index.shape)
    error = np.moveaxis(found.table.variance[found.table.index], -1, 0) * spread**2
    return Separated(
        images=_lights(found, crosstalk),
        variance=_enlarged(np.tensordot(crosstalk.unmixing**2, error, axes=1), TILE, shape),
        texture=found.texture,
    )


def separate(
    mosaic: LinearMosaic,
    crosstalk: Crosstalk,
    method: str = DEFAULT_METHOD,
    *,
    texture: TextureModel | None = None,
) -> IlluminationImages:
    """One image per light from one raw frame.

    Parameters
    ----------
    mosaic
        The linearised frame.
    crosstalk
        Which camera channel sees how much of which light, shape (3, k).
    method
        One of `DEMOSAICERS`, or ``"auto"``: reflection-aware where the frame is large enough, else Malvar.
    texture
        The speckle's autocorrelation for the methods that use it; None: they learn it from the frame.

    Raises
    ------
    InputError
        Unknown method, a frame too small for it, or a crosstalk matrix that is not for three camera channels.
    """
    method = _chosen(method, mosaic)
    _check_channels(crosstalk)
    return DEMOSAICERS[method](mosaic, crosstalk, texture)


def _chosen(method: str, mosaic: LinearMosaic) -> str:
    """The method meant, "auto" resolved."""
    if method == "auto":
        return DEFAULT_METHOD if min(mosaic.values.shape) >= SMALLEST_FRAME else "malvar"
    if method not in DEMOSAICERS:
        raise InputError(f"unknown demosaicing method {method!r}; allowed are {', '.join(DEMOSAICERS)}")
    return method


def _check_channels(crosstalk: Crosstalk) -> None:
    if crosstalk.matrix.shape[0] != 3:
        raise InputError(
            f"a Bayer mosaic has 3 camera channels; the crosstalk matrix has {crosstalk.matrix.shape[0]} rows"
        )


def _channelwise(demosaicer: Demosaicer) -> Separator:
    def separator(mosaic: LinearMosaic, crosstalk: Crosstalk, texture: TextureModel | None) -> IlluminationImages:
        return unmix(demosaicer(mosaic), crosstalk)

    return separator


def _reflection_aware(mosaic: LinearMosaic, crosstalk: Crosstalk, texture: TextureModel | None) -> IlluminationImages:
    return _lights(ReflectionAwareDemosaicer(crosstalk=crosstalk, texture=texture).reconstruct(mosaic), crosstalk)


DEMOSAICERS: dict[str, Separator] = {
    "reflection-aware": _reflection_aware,
    "malvar": _channelwise(MalvarDemosaicer()),
    "menon": _channelwise(MenonDemosaicer()),
    "band-limited": _channelwise(BandLimitedDemosaicer()),
    "normalised": _channelwise(NormalisedMosaic()),
    "bilinear": _channelwise(BilinearDemosaicer()),
}
"""The methods by the name they have in the configuration."""


def _lights(found: Reconstruction, crosstalk: Crosstalk) -> IlluminationImages:
    images = unmix(found.channels, crosstalk)
    index = _enlarged(_reflection_index(found.factors, found.mean, crosstalk), BLOCK, images.shape)
    noise = None if found.noise is None else crosstalk.unmixing @ found.noise @ crosstalk.unmixing.T
    return replace(images, covariance=noise, reflection_index=index, texture=found.texture)


def _reflection_index(factors: ColourFactors, mean: FloatImage, crosstalk: Crosstalk) -> FloatArray:
    """Index (k, h, w) on the blocks' grid: how much less contrast a light has than the best one."""
    height, width = factors.slope.shape[1:]
    level = np.stack([cv2.resize(m, (width, height), interpolation=cv2.INTER_AREA) for m in mean])
    slope = np.tensordot(crosstalk.unmixing, factors.slope, axes=1)
    light = np.tensordot(crosstalk.unmixing, level, axes=1)
    contrast = np.divide(slope, light, out=np.zeros_like(slope), where=light > 1e-3 * light.max())
    best = contrast.max(axis=0)
    share = np.divide(contrast, best, out=np.ones_like(contrast), where=best > 0)
    return np.asarray(1 - np.clip(share, 0, 1))


def _tiles(grid: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    size = (shape[1], shape[0])
    return np.stack([cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in grid])


def _enlarged(grid: FloatArray, block: int, shape: tuple[int, ...]) -> FloatImage:
    """A grid of blocks (n, h, w) interpolated to the pixels of a frame of `shape`."""
    size = (grid.shape[2] * block, grid.shape[1] * block)
    whole = [cv2.resize(one.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) for one in grid]
    return np.stack([one[: shape[0], : shape[1]] for one in whole])
