"""The single entry from a raw mosaic to one image per light."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaic import (
    SMALLEST_FRAME,
    Demosaicer,
    MalvarDemosaicer,
    NormalisedMosaic,
    Reconstruction,
    ReflectionAwareDemosaicer,
)
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearMosaic
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.illumination.unmix import unmix
from rgbmidic.typing import FloatArray

__all__ = ["DEFAULT_METHOD", "DEMOSAICERS", "reconstructed_lights", "separate"]


DEFAULT_METHOD = "reflection-aware"
_BY_CHANNEL: dict[str, Demosaicer] = {"malvar": MalvarDemosaicer(), "normalised": NormalisedMosaic()}
"""Methods that know nothing of lights: demosaic, then unmix."""
DEMOSAICERS = (DEFAULT_METHOD, *_BY_CHANNEL)
"""The methods by the name they have in the configuration, where ``"auto"`` means the one that suits the frame."""


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
    if method != DEFAULT_METHOD:
        return unmix(_BY_CHANNEL[method](mosaic), crosstalk)
    demosaicer = ReflectionAwareDemosaicer(crosstalk=crosstalk, texture=texture)
    if crosstalk.field is not None:
        return reconstructed_lights(demosaicer.reconstruct(mosaic), crosstalk)
    model = demosaicer.reconstruct(mosaic, crosstalk.unmixing)
    return IlluminationImages(
        values=model.channels.values,
        valid=model.channels.valid,
        names=crosstalk.lights,
        full_scale=mosaic.full_scale,
        reflection=_reflection(model, crosstalk),
        texture=model.texture,
    )


def reconstructed_lights(reconstruction: Reconstruction, crosstalk: Crosstalk) -> IlluminationImages:
    """The lights of a frame, and their reflection index, from what the reflection-aware method made of its channels."""
    images = unmix(reconstruction.channels, crosstalk)
    return replace(images, reflection=_reflection(reconstruction, crosstalk), texture=reconstruction.texture)


def _chosen(method: str, mosaic: LinearMosaic) -> str:
    """The method meant, "auto" resolved."""
    if method == "auto":
        return DEFAULT_METHOD if min(mosaic.values.shape) >= SMALLEST_FRAME else "malvar"
    if method not in DEMOSAICERS:
        raise InputError(f"unknown demosaicing method {method!r}; allowed are auto, {', '.join(DEMOSAICERS)}")
    return method


def _check_channels(crosstalk: Crosstalk) -> None:
    if crosstalk.matrix.shape[0] != 3:
        raise InputError(
            f"a Bayer mosaic has 3 camera channels; the crosstalk matrix has {crosstalk.matrix.shape[0]} rows"
        )


def _reflection(model: Reconstruction, crosstalk: Crosstalk) -> FloatArray:
    """Index (k, h, w) on the blocks' grid: how much less contrast a light has than the best one."""
    height, width = model.factors.slope.shape[1:]
    level = np.stack([cv2.resize(m, (width, height), interpolation=cv2.INTER_AREA) for m in model.mean])
    unmixing = crosstalk.unmixing
    slope, light = (np.tensordot(unmixing, channels, axes=1) for channels in (model.factors.slope, level))
    contrast = np.divide(slope, light, out=np.zeros_like(slope), where=light > 1e-3 * light.max())
    best = contrast.max(axis=0)
    relative = np.divide(contrast, best, out=np.ones_like(contrast), where=best > 0)
    return np.asarray(1 - np.clip(relative, 0, 1))
