"""Solves with a sparse factorisation, and quadratic forms, of many vectors at once, side by side in memory."""

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.interpolation import _FAST
from rgbmidic._kernels.threads import over_ranges

__all__ = ["node_energies", "solve_factors"]

_BLOCK = 32
"""Vectors at a time: those of some 3,000 unknowns stay in a core's own cache."""


@over_ranges("x", axis=1, grain=_BLOCK)
@compiled(fastmath=_FAST)
def solve_factors(
    start, stop, lower_values, lower_rows, lower_starts, upper_values, upper_rows, upper_starts, x
):  # fmt: skip
    """Solve ``L U x = b`` in place, for x (n, R) float64.

    The factors are given by columns with sorted rows: L with a diagonal of ones, U with its diagonal last.
    """
    n = x.shape[0]
    for first in range(start, stop, _BLOCK):
        last = np.uint64(min(first + _BLOCK, stop))
        for j in range(np.uint64(n)):
            for p in range(np.int64(lower_starts[j]) + 1, np.int64(lower_starts[j + np.uint64(1)])):
                i, value = np.uint64(lower_rows[p]), lower_values[p]
                for c in range(np.uint64(first), last):
                    x[i, c] -= value * x[j, c]
        for back in range(n):
            own = np.uint64(n - 1 - back)
            end = np.int64(upper_starts[own + np.uint64(1)]) - 1
            inverse = 1.0 / upper_values[end]
            for c in range(np.uint64(first), last):
                x[own, c] *= inverse
            for p in range(np.int64(upper_starts[own]), end):
                i, value = np.uint64(upper_rows[p]), upper_values[p]
                for c in range(np.uint64(first), last):
                    x[i, c] -= value * x[own, c]


@over_ranges("x", axis=1, grain=_BLOCK)
@compiled(fastmath=_FAST)
def node_energies(start, stop, values, columns, starts, x, out):
    """What each node adds to ``x^T S x`` of every column of x (2 N, R): ``out`` (N, R), for S given by its rows."""
    product = np.empty(_BLOCK)
    for first in range(start, stop, _BLOCK):
        base, width = np.uint64(first), np.uint64(min(_BLOCK, stop - first))
        for node in range(np.uint64(out.shape[0])):
            for c in range(width):
                out[node, base + c] = 0.0
            for row in range(np.uint64(2) * node, np.uint64(2) * node + np.uint64(2)):
                product[:] = 0.0
                for p in range(starts[row], starts[row + np.uint64(1)]):
                    k, value = np.uint64(columns[p]), values[p]
                    for c in range(width):
                        product[c] += value * x[k, base + c]
                for c in range(width):
                    out[node, base + c] += product[c] * x[row, base + c]
