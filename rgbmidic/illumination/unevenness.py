"""How uneven the channels of a frame are, over blocks of its pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic.illumination.linear import NoiseModel

SIGNIFICANCE = 6.0
"""Standard errors beyond which a departure is not chance: 24 planes and levels are looked at."""
WINDOW = 9
"""Grey levels over which the histogram is smooth (a parabola) where noise has a standard deviation of `SMOOTHED`."""
SMOOTHED = 2.0


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
    around = np.convolve(count, np.full(WINDOW, 1 / WINDOW), mode="same")
    known = around >= 8
    if noise is not None:
        known &= noise.variance(step * np.arange(count.size) - black) >= (SMOOTHED * step) ** 2
    if known.sum() < 30:
        return float("nan")
    middle = np.linalg.pinv(np.vander(np.arange(WINDOW) - WINDOW // 2, 3))[-1]  # of the parabola through a window
    kept = 1 - middle[WINDOW // 2]  # of the variance of counting, by the residual of the parabola
    square = (count - np.convolve(count, middle, mode="same"))[known] ** 2 / kept
    chance = SIGNIFICANCE * np.sqrt(2 * known.sum())
    if (square / around[known]).sum() - known.sum() < chance:
        return 0.0
    return float((square.sum() - around[known].sum()) / (around[known] ** 2).sum())
