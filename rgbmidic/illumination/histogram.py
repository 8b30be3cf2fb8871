"""Histogram of the grey levels of raw samples: where they pile up, and levels that are missing or doubled."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.illumination.linear import NoiseModel

SIGNIFICANCE = 6.0
"""Standard errors beyond which a departure is not chance: 24 planes and levels are looked at."""
WINDOW = 9
"""Grey levels over which the histogram is smooth (a parabola) where noise has a standard deviation of `SMOOTHED`."""
SMOOTHED = 2.0


def saturation_pile(samples: npt.NDArray[np.integer[Any]], white: float) -> float | None:
    """Find the level below white at which samples pile up as they do at saturation.

    Parameters
    ----------
    samples
        Raw samples.
    white
        Their white level.

    Returns
    -------
    float or None
        Their largest value, where it occurs more than twice as often as the four levels below it, which noise would
        make as frequent; None: it does not. A constant piles up: a plane that is saturated as a whole.
    """
    top = int(samples.max(initial=0))
    if top >= white or top < 8 or (count := np.count_nonzero(samples == top)) <= 20:
        return None
    bits = int(np.bitwise_or.reduce(samples, axis=None))
    step = bits & -bits  # all samples are multiples of it
    below = np.count_nonzero(samples >= top - 4 * step) - count
    return float(top) if count > 2 * below else None


def unevenness(
    samples: npt.NDArray[np.uint16], noise: NoiseModel | None = None, black: float = 0.0, step: int = 1
) -> float:
    """Return the relative variance of the histogram of raw samples about its smooth course, less that of counting.

    It is 0 where the histogram is smooth over `WINDOW` levels as noise makes it, .05 where every 21st level is missing,
    about 2 where every other one is; NaN where too few samples, or too little noise, leave it open.

    Parameters
    ----------
    samples
        Of one colour plane, none saturated.
    noise
        Calibrated noise: only levels at which it smooths the histogram are looked at; None: all.
    black
        Their black level.
    step
        What all samples of the frame are multiples of.

    Returns
    -------
    float
    """
    if samples.size < 1000:
        return float("nan")
    count = np.bincount(samples // step).astype(np.float64)
    if count.size < 30:
        return float("nan")
    count[: np.flatnonzero(count)[0] + 1] = 0  # what is clipped at the bottom
    smooth_count = np.convolve(count, np.full(WINDOW, 1 / WINDOW), mode="same")
    usable = smooth_count >= 8
    if noise is not None:
        usable &= noise.variance(step * np.arange(count.size) - black) >= (SMOOTHED * step) ** 2
    if usable.sum() < 30:
        return float("nan")
    middle = np.linalg.pinv(np.vander(np.arange(WINDOW) - WINDOW // 2, 3))[-1]  # of the parabola through a window
    residual_fraction = 1 - middle[WINDOW // 2]  # of the variance of counting, by the residual of the parabola
    square = (count - np.convolve(count, middle, mode="same"))[usable] ** 2 / residual_fraction
    chance = SIGNIFICANCE * np.sqrt(2 * usable.sum())
    if (square / smooth_count[usable]).sum() - usable.sum() < chance:
        return 0.0
    return float((square.sum() - smooth_count[usable].sum()) / (smooth_count[usable] ** 2).sum())
