"""Grey levels proportional to light: black level subtracted, saturated samples marked.

The figures of a camera per colour plane, each with its uncertainty, come from the photon transfer method.

Names and definitions follow EMVA standard 1288 (release 4.0): gain is 1/K, full well is the saturation capacity.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.illumination import subtract_black
from rgbmidic.arguments import check_fields
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.settings import bounded
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Camera noise of one linearised sample: ``variance = read_noise**2 + max(value, 0) / gain``.

    Attributes
    ----------
    gain
        Conversion gain in electrons per grey level (e-/DN).
    read_noise
        Standard deviation of the signal-independent noise in grey levels (DN).

    Examples
    --------
    >>> noise = NoiseModel(gain=4.0, read_noise=3.0)
    >>> noise.variance(np.array([400.0])).tolist()
    [109.0]
    """

    gain: float = bounded(above=0)
    read_noise: float = bounded(above=0)

    def variance(self, values: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        """Return the variance (DN squared) of samples whose linearised values (DN above black) are `values`."""
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

    Examples
    --------
    >>> mosaic = Mosaic(values=np.full((4, 6), 4095, dtype=np.uint16), cfa="RGGB", black_level=64, white_level=4095)
    >>> linearise(mosaic).saturated.all()
    np.True_
    """

    values: FloatImage
    saturated: BoolArray
    cfa: str
    full_scale: float
    noise: NoiseModel | None = None

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        values, saturated = np.ascontiguousarray(self.values, dtype=np.float32), np.asarray(self.saturated, dtype=bool)
        if values.ndim != 2 or min(values.shape) < 2:
            raise InputError(f"a mosaic has at least 2 rows and 2 columns; given is shape {values.shape}")
        if saturated.shape != values.shape:
            raise InputError(f"the saturation mask has shape {saturated.shape}, the mosaic has {values.shape}")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "saturated", saturated)


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

    Examples
    --------
    >>> channels = LinearChannels(values=np.ones((3, 4, 5)), valid=np.full((3, 4, 5), True), full_scale=4031.0)
    >>> channels.values.shape
    (3, 4, 5)
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

    Returns
    -------
    LinearMosaic or LinearChannels

    Examples
    --------
    >>> mosaic = Mosaic(values=np.full((4, 6), 564, dtype=np.uint16), cfa="RGGB", black_level=64, white_level=4095)
    >>> linear = linearise(mosaic)
    >>> linear.values[0, 0], linear.full_scale
    (np.float32(500.0), 4031.0)
    """
    full_scale = frame.white_level - float(frame.black_level.mean())
    black = frame.black_level.astype(np.float32)
    if isinstance(frame, ChannelFrame):
        values = frame.values.astype(np.float32) - black[:, None, None]
        return LinearChannels(values=values, valid=frame.values < frame.white_level, full_scale=full_scale)
    columns = frame.values.shape[1]
    values, saturated = np.empty(frame.values.shape, np.float32), np.empty(frame.values.shape, bool)
    black_rows = np.tile(black, -(-columns // 2))[:, :columns]
    samples = np.ascontiguousarray(frame.values)
    subtract_black(samples, np.ascontiguousarray(black_rows), frame.white_level, values, saturated)
    return LinearMosaic(values=values, saturated=saturated, cfa=frame.cfa, full_scale=full_scale, noise=noise)


QUANTISATION = 1 / 12
"""Variance (DN squared) of rounding to whole grey levels."""

DEFECTS = ("hot", "dead")


@dataclass(frozen=True, slots=True)
class Quantity:
    """A figure per colour plane and its standard uncertainty, both (P,); NaN where it was not measured."""

    value: FloatArray
    std: FloatArray

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self, CalibrationError)
        value = np.array(self.value, dtype=np.float64, ndmin=1)
        std = np.array(self.std, dtype=np.float64, ndmin=1)
        if value.ndim != 1 or value.shape != std.shape or (std < 0).any():
            raise CalibrationError(
                f"a figure per plane needs as many uncertainties, none negative: {value.shape}, {std.shape}"
            )
        object.__setattr__(self, "value", value)
        object.__setattr__(self, "std", std)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraNoise:
    """The camera's noise, per colour plane (R, G1, G2, B of a mosaic; R, G, B of a 3-CCD camera; M).

    Attributes
    ----------
    planes : tuple of str, length P
        Their names; every figure below has a value and its standard uncertainty for each.
    gain : Quantity
        1/K in e-/DN.
    read_noise : Quantity
        Temporal dark noise in DN, rounding to grey levels included (what one sample shows).
    black_level : Quantity
        Mean dark level in DN.
    saturation : Quantity
        Grey level (DN above black) at which samples saturate.
    linearity_error : Quantity
        Mean deviation from a straight line in exposure time, in % (EMVA 1288 LE); NaN without exposure times.
    dsnu : Quantity
        Spatial standard deviation of the dark level in DN, temporal noise taken out.
    prnu : Quantity
        Spatial standard deviation of the response in %, shading and temporal noise taken out; NaN on a textured target.
    defects : tuple of (int, int, str)
        Row, column and kind (``"hot"``, ``"dead"``) of pixels to distrust.
    """

    planes: tuple[str, ...]
    gain: Quantity
    read_noise: Quantity
    black_level: Quantity
    saturation: Quantity
    linearity_error: Quantity
    dsnu: Quantity
    prnu: Quantity
    defects: tuple[tuple[int, int, str], ...] = ()

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        for entry in fields(self):
            quantity = getattr(self, entry.name)
            if isinstance(quantity, Quantity) and len(quantity.value) != len(self.planes):
                raise CalibrationError(
                    f"noise figure {entry.name} has {len(quantity.value)} values for the planes {' '.join(self.planes)}"
                )
        for name in ("gain", "read_noise"):
            value = getattr(self, name).value
            if not (np.isfinite(value) & (value > 0)).all():
                raise CalibrationError(f"noise figure {name} must be positive in every plane, not {value.tolist()}")
        if any(kind not in DEFECTS for _, _, kind in self.defects):
            raise CalibrationError(f"a defect is one of {', '.join(DEFECTS)}")

    @property
    def model(self) -> NoiseModel:
        """One gain and one read noise for all planes: the mean gain, the root mean square read noise."""
        read = float(np.sqrt((self.read_noise.value**2).mean()))
        return NoiseModel(gain=float(self.gain.value.mean()), read_noise=read)

    @property
    def dark_noise(self) -> Quantity:
        """Temporal dark noise in e-, without the rounding to grey levels (EMVA 1288 sigma_d)."""
        plain = np.sqrt(np.maximum(self.read_noise.value**2 - QUANTISATION, 0))
        relative = self.read_noise.value * self.read_noise.std / np.maximum(plain, 1e-9) ** 2
        return _product(plain, self.gain, relative)

    @property
    def full_well(self) -> Quantity:
        """Saturation capacity in e-."""
        return _product(self.saturation.value, self.gain, self.saturation.std / self.saturation.value)

    @property
    def dynamic_range(self) -> FloatArray:
        """Saturation capacity over dark noise, in dB."""
        return np.asarray(20 * np.log10(self.full_well.value / np.maximum(self.dark_noise.value, 1e-9)))


def _product(value: FloatArray, gain: Quantity, relative: FloatArray) -> Quantity:
    result = value * gain.value
    return Quantity(result, result * np.hypot(relative, gain.std / gain.value))
