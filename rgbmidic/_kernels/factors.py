"""Solving with the triangular factors of a sparse matrix, many right-hand sides at a time, side by side in memory."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.interpolation import _FAST
from rgbmidic._kernels.threads import over_ranges

__all__ = ["solve_factors"]


@over_ranges("columns", axis=1)
@compiled(fastmath=_FAST)
def solve_factors(
    start, stop, lower_starts, lower_rows, lower, upper_starts, upper_rows, upper, diagonal, columns
):  # fmt: skip
    """Replace `columns` (n, m) float64 by the solutions X of ``L U X = columns``.

    The lower triangle L, its unit diagonal left aside, and the upper one U are given column by column: rows and values
    of column j from ``starts[j]`` to ``starts[j + 1]``; `diagonal` (n,) is that of U.
    """
    count = columns.shape[0]
    flat, across = columns.ravel(), np.uint64(columns.shape[1])
    first, number = np.uint64(start), np.uint64(stop - start)
    for j in range(count):
        own = np.uint64(j) * across + first
        for k in range(lower_starts[j], lower_starts[j + 1]):
            if lower_rows[k] > j:
                other, factor = np.uint64(lower_rows[k]) * across + first, lower[k]
                for i in range(number):
                    flat[other + i] -= factor * flat[own + i]
    for j in range(count - 1, -1, -1):
        own = np.uint64(j) * across + first
        inverse = 1.0 / diagonal[j]
        for i in range(number):
            flat[own + i] *= inverse
        for k in range(upper_starts[j], upper_starts[j + 1]):
            if upper_rows[k] < j:
                other, factor = np.uint64(upper_rows[k]) * across + first, upper[k]
                for i in range(number):
                    flat[other + i] -= factor * flat[own + i]
