"""Raw frames as the camera recorded them, and their linearised form: the first step of docs/conventions.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.config import BAYER_PATTERNS
from rgbmidic.errors import InputError

__all__ = [
    "BAYER_PATTERNS",
    "ChannelFrame",
    "LinearChannels",
    "LinearMosaic",
    "Mosaic",
    "NoiseModel",
    "cfa_channels",
    "linearise",
    "shift_cfa",
]


def cfa_channels(cfa: str) -> npt.NDArray[np.intp]:
    """Channel index (R 0, G 1, B 2) of each position of the 2x2 cell of a Bayer pattern.

    Parameters
    ----------
    cfa
        One of `BAYER_PATTERNS`; upper or lower case.

    Returns
    -------
    ndarray, shape (2, 2)
        ``channels[row % 2, column % 2]`` is the channel sampled at that pixel.

    Raises
    ------
    InputError
        The name is not a Bayer pattern.
    """
    name = cfa.upper() if isinstance(cfa, str) else cfa
    if name not in BAYER_PATTERNS:
        raise InputError(f"unknown colour filter array {cfa!r}; allowed are {', '.join(BAYER_PATTERNS)}")
    return np.array(["RGB".index(letter) for letter in name], dtype=np.intp).reshape(2, 2)


def shift_cfa(cfa: str, rows: int, columns: int) -> str:
    """Name of the Bayer pattern seen after the first `rows` rows and `columns` columns are cropped away."""
    cell = np.array(list(cfa.upper())).reshape(2, 2)
    return "".join(np.roll(cell, (-rows, -columns), axis=(0, 1)).ravel())


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
class Mosaic:
    """One raw frame behind a Bayer colour filter array.

    Attributes
    ----------
    values : ndarray, shape (H, W), uint16
        Raw grey levels (DN).
    cfa : str
        One of `BAYER_PATTERNS`, valid for ``values[0, 0]``.
    black_level : ndarray, shape (2, 2), float64
        Black level (DN) of each position of the 2x2 cell.
    white_level : float
        Smallest grey level (DN) that counts as saturated.
    """

    values: npt.NDArray[np.uint16]
    cfa: str
    black_level: npt.NDArray[np.float64]
    white_level: float

    def __post_init__(self) -> None:
        values = np.asarray(self.values)
        if values.ndim != 2:
            raise InputError(f"a mosaic is one (H, W) image, not an array of shape {values.shape}")
        cfa_channels(self.cfa)
        black = np.broadcast_to(np.asarray(self.black_level, dtype=np.float64), (2, 2)).copy()
        _check_levels(black, self.white_level)
        object.__setattr__(self, "values", np.ascontiguousarray(values, dtype=np.uint16))
        object.__setattr__(self, "cfa", self.cfa.upper())
        object.__setattr__(self, "black_level", black)
        object.__setattr__(self, "white_level", float(self.white_level))


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelFrame:
    """One frame with all its channels at every pixel: monochrome (1 channel) or 3-CCD colour (3 channels).

    Attributes
    ----------
    values : ndarray, shape (C, H, W), uint16
        Raw grey levels (DN).
    black_level : ndarray, shape (C,), float64
        Black level (DN) of each channel.
    white_level : float
        Smallest grey level (DN) that counts as saturated.
    """

    values: npt.NDArray[np.uint16]
    black_level: npt.NDArray[np.float64]
    white_level: float

    def __post_init__(self) -> None:
        values = np.asarray(self.values)
        if values.ndim != 3 or values.shape[0] not in (1, 3):
            raise InputError(f"a channel frame has shape (1 or 3, H, W), not {values.shape}")
        black = np.broadcast_to(np.asarray(self.black_level, dtype=np.float64), values.shape[:1]).copy()
        _check_levels(black, self.white_level)
        object.__setattr__(self, "values", np.ascontiguousarray(values, dtype=np.uint16))
        object.__setattr__(self, "black_level", black)
        object.__setattr__(self, "white_level", float(self.white_level))


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

    values: npt.NDArray[np.float32]
    saturated: npt.NDArray[np.bool_]
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
    noise : NoiseModel or None
        Camera noise of one raw sample.
    """

    values: npt.NDArray[np.float32]
    valid: npt.NDArray[np.bool_]
    full_scale: float
    noise: NoiseModel | None = None


def linearise(frame: Mosaic | ChannelFrame, noise: NoiseModel | None = None) -> LinearMosaic | LinearChannels:
    """Subtract the black level and mark saturated samples.

    Parameters
    ----------
    frame
        Raw frame; a `Mosaic` gives a `LinearMosaic`, a `ChannelFrame` gives `LinearChannels`.
    noise
        Camera noise to carry along.
    """
    full_scale = frame.white_level - float(frame.black_level.mean())
    saturated = frame.values >= frame.white_level
    if isinstance(frame, ChannelFrame):
        values = frame.values.astype(np.float32) - frame.black_level.astype(np.float32)[:, None, None]
        return LinearChannels(values=values, valid=~saturated, full_scale=full_scale, noise=noise)
    values = frame.values.astype(np.float32)
    for row in (0, 1):
        for column in (0, 1):
            values[row::2, column::2] -= np.float32(frame.black_level[row, column])
    return LinearMosaic(values=values, saturated=saturated, cfa=frame.cfa, full_scale=full_scale, noise=noise)


def _check_levels(black: npt.NDArray[np.float64], white: float) -> None:
    if not (np.isfinite(black).all() and np.isfinite(white) and black.min() >= 0 and white > black.max()):
        raise InputError(
            f"black and white level must be finite with 0 <= black < white; given are black {black.tolist()}, "
            f"white {white}"
        )
