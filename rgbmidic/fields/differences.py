"""What the frames of a test have in common: the noise of the reference, which cancels in differences and rates.

The displacement of frame t has the error ``b_t - r``: what the frame's own noise makes of it, less the mean of the same
for the n frames of the reference. With equal noise in all frames the variance stated for t is ``(1 + 1/n) Var(b)``, of
which the share ``1 / (1 + n)`` is the reference's.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["difference_std", "frame_covariance", "reference_share"]


def reference_share(count: int) -> float:
    """Share of the variance of every frame that the mean of `count` reference frames puts into all of them alike."""
    return 1 / (1 + count)


def frame_covariance(std: FloatArray, share: float, references: Sequence[bool] | BoolArray) -> FloatArray:
    """Covariance between frames of a quantity that is measured in each.

    Two frames share the reference's part, ``share`` of the smaller of their variances: where one of them is less
    certain, because it sees fewer lights or has changed more, what it has beyond the other is its own (the covariance
    of an estimate with the best one is the variance of the best). A frame of the reference, whose own noise is a part
    of the mean that is taken off, shares nothing with the others: the only one is 0 without uncertainty, n of them
    are correlated by ``-1/(n - 1)``.

    Parameters
    ----------
    std : ndarray, shape (T, ...)
        Standard uncertainty in each frame.
    share
        See `reference_share`.
    references : (T,), bool
        Which of the frames belong to the reference.

    Returns
    -------
    ndarray, shape (T, T, ...)
    """
    variance, own = np.asarray(std, dtype=np.float64) ** 2, np.asarray(references, dtype=bool)
    either, both = own[:, None] | own[None], own[:, None] & own[None]
    count = round(1 / share) - 1
    factor = np.where(both, -1 / max(count - 1, 1), np.where(either, 0.0, share))
    np.fill_diagonal(factor, 1.0)
    factor = factor.reshape(factor.shape + (1,) * (variance.ndim - 1))
    return np.asarray(factor * np.minimum(variance[:, None], variance[None]))


def difference_std(first: FloatArray, second: FloatArray, share: float) -> FloatArray:
    """Standard uncertainty of a quantity's difference between two frames that are no reference, from that in each."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    shared = share * np.minimum(first, second) ** 2
    return np.asarray(np.sqrt(first**2 + second**2 - 2 * shared))
