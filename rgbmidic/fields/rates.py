"""Velocity and acceleration by local polynomials over the frames' times, with the exact covariance of their errors.

Savitzky and Golay (Anal Chem 36, 1964) for times that need not be even: around every frame a polynomial is fitted by
least squares to the frames of a window; its slope is the velocity, twice its quadratic coefficient the acceleration.
Frames that are lost or not measured are left out. What all frames share of the reference's noise cancels in slopes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.differences import frame_covariance
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Rates", "rates"]

_DEGREE = 2
_WIDE = 1.01
"""Windows are as wide as stated, and a per cent more: cameras' stamps are rounded."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rates:
    """A quantity over time, smoothed, with its derivatives, each of the shape (T, ...) of what was measured.

    The standard uncertainty is that of noise. What the polynomial cannot follow within the window is not in it.
    """

    value: FloatArray
    value_std: FloatArray
    velocity: FloatArray
    velocity_std: FloatArray
    acceleration: FloatArray
    acceleration_std: FloatArray


def rates(
    times: npt.ArrayLike,
    values: npt.ArrayLike,
    std: npt.ArrayLike,
    *,
    window: float,
    share: float,
    references: Sequence[bool] | BoolArray,
    degree: int = _DEGREE,
) -> Rates:
    """Value, velocity and acceleration of a quantity that is measured in every frame.

    At both ends of the test the window keeps its length and the polynomial is taken off its middle, with an uncertainty
    that is accordingly larger.

    Parameters
    ----------
    times : (T,)
        Of the frames, rising.
    values, std : (T, ...)
        What was measured, and its standard uncertainty; NaN where it was not.
    window
        Length of time that a fit takes in, from the first to the last frame.
    share
        Of the variance that the reference puts into all frames alike, `reference_share`.
    references : (T,), bool
        Which of the frames belong to the reference.
    degree
        Of the polynomial, 2 or more.

    Returns
    -------
    Rates
        NaN in a frame whose window has no more known values than the polynomial has coefficients, and in a frame that
        lies beyond the known ones of its window.

    Raises
    ------
    InputError
        The times do not rise, shapes differ, or no window has enough frames.
    """
    when, what, error = (np.asarray(part, dtype=np.float64) for part in (times, values, std))
    own = np.asarray(references, dtype=bool)
    if not len(when) or what.shape != error.shape or len(when) != len(what) or len(own) != len(when):
        raise InputError(f"rates need a time for each frame, not {when.shape} for values {what.shape}, {error.shape}")
    if not (np.diff(when) > 0).all():
        raise InputError("rates need the times of the frames to rise from each to the next")
    if degree < _DEGREE:
        raise InputError(f"the degree of the polynomial must be at least {_DEGREE}, not {degree}")
    ranges = [_window(when, place, window) for place in range(len(when))]
    if max(stop - start for start, stop in ranges) <= degree + 1:
        raise InputError(
            f"a window of {window:g} holds no more than {max(b - a for a, b in ranges)} frames; a polynomial of degree "
            f"{degree} needs {degree + 2} or more"
        )
    shape = (len(when), -1)
    flat, spread = what.reshape(shape), error.reshape(shape)
    out = np.full((3, 2, *flat.shape), np.nan)
    for place, (start, stop) in enumerate(ranges):
        part = slice(start, stop)
        shift = when[part] - when[place]
        out[:, :, place] = _fit(shift, flat[part], spread[part], degree, share, own[part])
    named = out.reshape(3, 2, *what.shape)
    names = ("value", "velocity", "acceleration")
    return Rates(**{f"{name}{end}": named[i, j] for i, name in enumerate(names) for j, end in enumerate(("", "_std"))})


def _window(times: FloatArray, place: int, length: float) -> tuple[int, int]:
    """First and last but one frame of the window around a frame; at the ends it is moved inwards."""
    reach = length * _WIDE
    first = np.clip(times[place] - reach / 2, times[0], max(times[-1] - reach, times[0]))
    return int(np.searchsorted(times, first)), int(np.searchsorted(times, first + reach, side="right"))


def _fit(
    shift: FloatArray, values: FloatArray, std: FloatArray, degree: int, share: float, references: BoolArray
) -> FloatArray:
    """Value, first and second derivative with their standard uncertainty, (3, 2, N), at the time 0 of one window."""
    known = np.isfinite(values) & np.isfinite(std)
    seen = np.where(known, shift[:, None], np.nan)
    with np.errstate(invalid="ignore"):
        usable = (known.sum(axis=0) > degree + 1) & _within(seen)
    scale = float(np.abs(shift).max())
    basis = (shift / scale)[:, None] ** np.arange(degree + 1)
    pairs = (basis[:, :, None] * basis[:, None]).reshape(len(shift), -1)
    normal = (known.T @ pairs).reshape(-1, degree + 1, degree + 1)
    normal[~usable] = np.eye(degree + 1)
    weights = np.linalg.inv(normal)[:, :3] @ basis.T * known.T[:, None]
    weights *= (np.array([1, 1, 2]) / scale ** np.arange(3))[:, None]
    covariance = np.moveaxis(frame_covariance(np.where(known, std, 0), share, references), -1, 0)
    found = (weights @ np.where(known, values, 0).T[:, :, None])[..., 0].T
    variance = ((weights @ covariance) * weights).sum(axis=-1).T
    both = np.stack([found, np.sqrt(np.maximum(variance, 0))], axis=1)
    both[:, :, ~usable] = np.nan
    return both


def _within(seen: FloatArray) -> BoolArray:
    """Whether known times (t, N), NaN where not, reach from 0 or before to 0 or after."""
    filled_low, filled_high = np.where(np.isnan(seen), np.inf, seen), np.where(np.isnan(seen), -np.inf, seen)
    return np.asarray((filled_low.min(axis=0) <= 0) & (filled_high.max(axis=0) >= 0))
