"""The single entry from a raw mosaic to one image per light."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, align, unmix
from rgbmidic.illumination.demosaicing import (
    SMALLEST_FRAME,
    Demosaicer,
    MalvarDemosaicer,
    NormalisedMosaic,
    Reconstruction,
    ReflectionAwareDemosaicer,
)
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import FloatArray

DEFAULT_METHOD = "reflection-aware"
_BY_CHANNEL: dict[str, Demosaicer] = {"malvar": MalvarDemosaicer(), "normalised": NormalisedMosaic()}
"""Methods that know nothing of lights: demosaic, then unmix."""
DEMOSAICERS = (DEFAULT_METHOD, *_BY_CHANNEL)
"""The methods by the name they have in the configuration, where ``"auto"`` means the one that suits the frame."""


def separate(
    frame: Mosaic | ChannelFrame | LinearMosaic | LinearChannels,
    calibration: Calibration | Crosstalk,
    method: str = DEFAULT_METHOD,
    *,
    texture: TextureModel | None = None,
) -> IlluminationImages:
    """One image per light from one raw colour frame: linearised, demosaiced, unmixed and, where calibrated, registered.

    Parameters
    ----------
    frame
        As it was recorded, or linearised (`linearise`) already.
    calibration
        Of camera and lights; or their crosstalk alone, shape (3, k).
    method
        How a mosaic is demosaiced: one of `DEMOSAICERS`, or ``"auto"``: reflection-aware where the frame is large
        enough, else Malvar.
    texture
        The speckle's autocorrelation for the methods that use it; None: they learn it from the frame.

    Returns
    -------
    IlluminationImages
        Shape (k, H, W), DN above black.

    Raises
    ------
    InputError
        Unknown method, a frame too small for it, no crosstalk, or one that is not for the frame's channels.
    """
    crosstalk = calibration if isinstance(calibration, Crosstalk) else calibration.crosstalk
    if crosstalk is None:
        raise InputError("the calibration has no crosstalk, which colour frames need (rgbmidic-calibrate crosstalk)")
    if isinstance(calibration, Calibration):
        linear = linearise(frame, calibration.noise) if isinstance(frame, Mosaic | ChannelFrame) else frame
        images = separate(linear, crosstalk, method, texture=texture)
        return align(replace(images, registration=calibration.registration))
    linear = linearise(frame) if isinstance(frame, Mosaic | ChannelFrame) else frame
    if isinstance(linear, LinearChannels):
        return unmix(linear, crosstalk)
    method = _chosen(method, linear)
    _check_channels(crosstalk)
    if method != DEFAULT_METHOD:
        return unmix(_BY_CHANNEL[method](linear), crosstalk)
    demosaicer = ReflectionAwareDemosaicer(crosstalk=crosstalk, texture=texture)
    if crosstalk.field is not None:
        return reconstructed_lights(demosaicer.reconstruct(linear), crosstalk)
    model = demosaicer.reconstruct(linear, crosstalk.unmixing)
    return IlluminationImages(
        values=model.channels.values,
        valid=model.channels.valid,
        names=crosstalk.lights,
        full_scale=linear.full_scale,
        reflection=_reflection(model, crosstalk),
        displacement=model.displacement,
        texture=model.texture,
    )


def demosaic(
    mosaic: Mosaic | LinearMosaic,
    method: str = DEFAULT_METHOD,
    *,
    crosstalk: Crosstalk | None = None,
    texture: TextureModel | None = None,
) -> LinearChannels:
    """All three camera channels at every pixel of a mosaic.

    Parameters
    ----------
    mosaic
        As it was recorded, or linearised.
    method
        As in `separate`.
    crosstalk, texture
        For the reflection-aware method: see `rgbmidic.illumination.demosaicing.ReflectionAwareDemosaicer`.

    Returns
    -------
    LinearChannels
        Shape (3, H, W) in the order R, G, B, DN above black.

    Raises
    ------
    InputError
        Unknown method, or a frame too small for it.
    """
    linear = linearise(mosaic) if isinstance(mosaic, Mosaic) else mosaic
    assert isinstance(linear, LinearMosaic)
    if (chosen := _chosen(method, linear)) != DEFAULT_METHOD:
        return _BY_CHANNEL[chosen](linear)
    return ReflectionAwareDemosaicer(crosstalk=crosstalk, texture=texture)(linear)


def reconstructed_lights(reconstruction: Reconstruction, crosstalk: Crosstalk) -> IlluminationImages:
    """The lights of a frame, and their reflection index, from what the reflection-aware method made of its channels."""
    images = unmix(reconstruction.channels, crosstalk)
    return replace(
        images,
        reflection=_reflection(reconstruction, crosstalk),
        displacement=reconstruction.displacement,
        texture=reconstruction.texture,
    )


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
