"""Grey levels proportional to light: black level subtracted, saturated samples marked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.typing import BoolArray, FloatImage

__all__ = ["LinearChannels", "LinearMosaic", "NoiseModel", "linearise"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Camera noise of one linearised sample: ``variance = read_noise**2 + max(value, 0) / gain``.

    Attributes
    ----------
    gain
        Conversion gain in electrons per grey level (e-/DN).
    read_noise
        Standard deviation of the signal-independent noise in grey levels (DN).
    """

    gain: float
    read_noise: float

    def variance(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Variance (DN squared) of samples whose linearised values (DN above black) are `values`."""
        variance: npt.NDArray[np.floating] = self.read_noise**2 + np.maximum(values, 0) / self.gain
        return variance


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearMosaic:
    """A mosaic proportional to light: black subtracted, saturation marked.

    Attributes
    ----------
    values : ndarray, shape (H, W), float32
        Grey levels above black (DN). Saturated samples keep their clipped value and are marked.
    saturated : ndarray, shape (H, W), bool
    cfa : str
    full_scale : float
        White level minus mean black level (DN).
    noise : NoiseModel or None
        Camera noise, where the calibration knows it.
    """

    values: FloatImage
    saturated: BoolArray
    cfa: str
    full_scale: float
    noise: NoiseModel | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearChannels:
    """Channels proportional to light, at every pixel: from a 3-CCD or monochrome camera, or demosaiced.

    Attributes
    ----------
    values : ndarray, shape (C, H, W), float32
        Grey levels above black (DN).
    valid : ndarray, shape (C, H, W), bool
        False where a saturated sample took part in the value.
    full_scale : float
        White level minus mean black level (DN).
    """

    values: FloatImage
    valid: BoolArray
    full_scale: float


def linearise(frame: Mosaic | ChannelFrame, noise: NoiseModel | None = None) -> LinearMosaic | LinearChannels:
    """Subtract the black level and mark saturated samples.

    Parameters
    ----------
    frame
        Raw frame; a `Mosaic` gives a `LinearMosaic`, a `ChannelFrame` gives `LinearChannels`.
    noise
        Camera noise for a `LinearMosaic` to carry along, whose separation uses it.
    """
    full_scale = frame.white_level - float(frame.black_level.mean())
    saturated = frame.values >= frame.white_level
    if isinstance(frame, ChannelFrame):
        values = frame.values.astype(np.float32) - frame.black_level.astype(np.float32)[:, None, None]
        return LinearChannels(values=values, valid=~saturated, full_scale=full_scale)
    values = frame.values.astype(np.float32)
    for row, black in enumerate(frame.black_level.astype(np.float32)):
        values[row::2] -= np.tile(black, -(-values.shape[1] // 2))[: values.shape[1]]
    return LinearMosaic(values=values, saturated=saturated, cfa=frame.cfa, full_scale=full_scale, noise=noise)
