"""Velocity and acceleration where motion may set in at any frame: local polynomials within the pieces of a series.

A series is cut into pieces, each a polynomial of the times within its noise, which is known; all ways to cut it count
by their probability (Fearnhead, Stat Comput 16, 2006). Around every frame polynomials are fitted to a window (Savitzky
and Golay, Anal Chem 36, 1964) that does not leave the piece; the mean over pieces and degrees is the rate. Its
uncertainty is that of the mean in noise, and the spread of what it was taken over (Hoeting et al, Stat Sci 14, 1999).
Times need not be even; frames that are lost or not measured are left out. What all frames share of the reference's
noise cancels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.rates import LOWEST, mean_rates
from rgbmidic.errors import InputError
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Rates", "rates"]

_WIDE = 1.01
"""Windows are as wide as stated, and a per cent more: cameras' stamps are rounded."""
_KINK = 4.0
"""Standard uncertainties by which the rates of both sides differ at a kink: in noise once in 16,000 frames."""
_EXACT = 1e-3
"""Least noise of a value, as part of the median one: what is stated without noise does not outweigh all others."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rates:
    """A quantity over time, smoothed, with its derivatives, each of the shape (T, ...) of what was measured.

    Attributes
    ----------
    value, velocity, acceleration : ndarray, shape (T, ...)
        With their standard uncertainties `value_std` and so on: that of noise, and that of where the motion changes. At
        a kink velocity and acceleration lie between those of both sides, and the uncertainty reaches to either.
    velocity_before, velocity_after, acceleration_before, acceleration_after : ndarray, shape (T, ...)
        From the frames up to this one, and from this one on, with their standard uncertainties; NaN but in frames where
        they differ by more than four times these, that is, at kinks.
    """

    value: FloatArray
    value_std: FloatArray
    velocity: FloatArray
    velocity_std: FloatArray
    acceleration: FloatArray
    acceleration_std: FloatArray
    velocity_before: FloatArray
    velocity_before_std: FloatArray
    velocity_after: FloatArray
    velocity_after_std: FloatArray
    acceleration_before: FloatArray
    acceleration_before_std: FloatArray
    acceleration_after: FloatArray
    acceleration_after_std: FloatArray


_POWERS = {"value": 0, "velocity": 1, "acceleration": 2} | {
    f"{name}_{side}": power for side in ("before", "after") for power, name in ((1, "velocity"), (2, "acceleration"))
}
"""What the kernel gives, in its order, and the power of the time that each is over."""


def rates(
    times: npt.ArrayLike,
    values: npt.ArrayLike,
    std: npt.ArrayLike,
    *,
    window: float,
    share: float,
    references: Sequence[bool] | BoolArray,
) -> Rates:
    """Value, velocity and acceleration of a quantity that is measured in every frame.

    Next to a change of the motion, and at both ends of the test, a window keeps its length and the polynomial is taken
    off its middle, with an uncertainty that is accordingly larger. No statement that holds for every motion is narrower
    than the worst motion demands (Low, Ann Stat 25, 1997; Cai and Low, Ann Stat 32, 2004): a change of two or three
    standard uncertainties within a frame may be overlooked. How far the stated holds is in ``docs/results.md``.

    Parameters
    ----------
    times : (T,)
        Of the frames, rising.
    values, std : (T, ...)
        What was measured, and its standard uncertainty; NaN where it was not.
    window
        Length of time that the fit of a parabola takes in, from the first to the last frame; those of degrees 3 and 4
        take in 4/3 and 5/3 of it.
    share
        Of the variance that the reference puts into all frames alike, `reference_share`.
    references : (T,), bool
        Which of the frames belong to the reference.

    Returns
    -------
    Rates
        NaN in a frame whose windows have fewer known values than a parabola has coefficients, in a frame that lies
        beyond the known ones of its window, and where fewer than 4 frames are known at all.

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
    reach = window * _WIDE
    most = int((np.searchsorted(when, when + reach, side="right") - np.arange(len(when))).max())
    if most <= LOWEST + 1:
        raise InputError(
            f"a window of {window:g} holds no more than {most} frames; a polynomial of degree {LOWEST} needs "
            f"{LOWEST + 2} or more"
        )
    flat, spread = (np.ascontiguousarray(part.reshape(len(when), -1).T) for part in (what, error))
    scaled = (when - when[0]) / reach
    noise, common = _noise(scaled, flat, spread, share, own)
    out = np.full((len(flat), 2, len(_POWERS), len(when)), np.nan)
    weight = own / max(own.sum(), 1)
    mean_rates(scaled, np.nan_to_num(flat), noise, common, weight, most, out)
    out[:, 1] = np.sqrt(np.maximum(out[:, 1], 0))
    out /= reach ** np.array(list(_POWERS.values()), dtype=np.float64)[:, None]
    before, after = out[:, :, 3:5], out[:, :, 5:]
    with np.errstate(invalid="ignore"):
        kink = (np.abs(after[:, 0] - before[:, 0]) > _KINK * np.hypot(after[:, 1], before[:, 1])).any(axis=1)
    out[:, :, 3:] = np.where(kink[:, None, None], out[:, :, 3:], np.nan)
    named = out.transpose(1, 2, 3, 0).reshape(2, len(_POWERS), *what.shape)
    return Rates(
        **{f"{name}{end}": named[j, i] for i, name in enumerate(_POWERS) for j, end in enumerate(("", "_std"))}
    )


def _noise(
    times: FloatArray, values: FloatArray, std: FloatArray, share: float, references: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Noise of each value that is its own (0: not known), and the variance that the reference adds to all (N, T).

    As `frame_covariance` has it: frames share the reference's part of the smaller variance, here that of the least in
    half a window to both sides. A frame of the reference has the noise of the others, and no other part.
    """
    known = np.isfinite(values) & np.isfinite(std)
    variance = np.where(known, std, 0.0) ** 2
    others = np.where(known & ~references, variance, np.inf)
    first, last = np.searchsorted(times, times - 0.5), np.searchsorted(times, times + 0.5, side="right")
    least = np.stack([others[:, a:b].min(axis=1) for a, b in zip(first, last, strict=True)], axis=1)
    least = np.where(np.isfinite(least), least, others.min(axis=1, keepdims=True))
    least = np.where(np.isfinite(least), least, variance / (1 - share))
    noise = np.sqrt(np.where(references, (1 - share) * least, np.maximum(variance - share * least, 0)))
    middle, size = np.median(noise, axis=1), np.abs(np.nan_to_num(values)).max(axis=1)
    floor = np.where(middle > 0, _EXACT * middle, 1e-9 * size + np.finfo(float).tiny)
    return np.where(known, np.maximum(noise, floor[:, None]), 0.0), share * least
