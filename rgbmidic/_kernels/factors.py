"""Sparse Cholesky factors: factorisation, solves and quadratic forms.

The solves and the quadratic forms take many vectors at once, side by side in memory.
"""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled

_BLOCK = 32
"""Vectors at a time: those of some 3,000 unknowns stay in a core's own cache."""


@compiled(fastmath=FAST)
def factorise(data, entry_starts, entry_nodes, entries, before_starts, before, starts, rows, lower, inverse):
    """Factorise a symmetric positive definite matrix, with a block of 2 x 2 for each two nodes, as ``L D L^T``.

    The algorithm is that of Davis (Direct Methods for Sparse Linear Systems, 2006, section 4.8). Row k of the matrix
    has the blocks ``data[entries[p]]``, (n, 2, 2) indices, at the nodes ``entry_nodes[p]`` up to k, p from
    ``entry_starts[k]`` to ``entry_starts[k + 1]``; row k of L, whose own block is 1, has blocks at the nodes `before`
    it, and column k at `rows` after it, in their order. `lower` (R, 4) receives the latter, `inverse` (N, 3)
    entries xx, xy and yy of the inverse of each block of D.
    """
    work, filled = np.zeros((len(inverse), 4)), starts[:-1].copy()
    for k in range(len(inverse)):
        for p in range(entry_starts[k], entry_starts[k + 1]):
            i = entry_nodes[p]
            work[i, 0], work[i, 1] = data[entries[p, 0, 0]], data[entries[p, 0, 1]]
            work[i, 2], work[i, 3] = data[entries[p, 1, 0]], data[entries[p, 1, 1]]
        xx, xy, yy = work[k, 0], work[k, 1], work[k, 3]
        work[k] = 0.0
        for q in range(before_starts[k], before_starts[k + 1]):
            i = before[q]
            a, b, c, d = work[i, 0], work[i, 1], work[i, 2], work[i, 3]
            work[i] = 0.0
            for p in range(starts[i], filled[i]):
                e, f, g, h, r = lower[p, 0], lower[p, 1], lower[p, 2], lower[p, 3], rows[p]
                work[r, 0] -= a * e + b * f
                work[r, 1] -= a * g + b * h
                work[r, 2] -= c * e + d * f
                work[r, 3] -= c * g + d * h
            s, t, u = inverse[i, 0], inverse[i, 1], inverse[i, 2]
            e, f, g, h, p = a * s + b * t, a * t + b * u, c * s + d * t, c * t + d * u, filled[i]
            lower[p, 0], lower[p, 1], lower[p, 2], lower[p, 3] = e, f, g, h
            filled[i] += 1
            xx -= e * a + f * b
            xy -= e * c + f * d
            yy -= g * c + h * d
        scale = 1.0 / (xx * yy - xy * xy)
        inverse[k, 0], inverse[k, 1], inverse[k, 2] = yy * scale, -xy * scale, xx * scale


@compiled("x", axis=2, grain=_BLOCK, fastmath=FAST)
def solve_factors(start, stop, starts, rows, lower, inverse, x):
    """Solve ``L D L^T x = b`` in place, for x (N, 2, R) float64 and such factors."""
    n = len(inverse)
    for first in range(start, stop, _BLOCK):
        begin, end = np.uint64(first), np.uint64(min(first + _BLOCK, stop))
        for j in range(np.uint64(n)):
            for p in range(starts[j], starts[j + np.uint64(1)]):
                i, a, b, c, d = np.uint64(rows[p]), lower[p, 0], lower[p, 1], lower[p, 2], lower[p, 3]
                for r in range(begin, end):
                    x[i, 0, r] -= a * x[j, 0, r] + b * x[j, 1, r]
                    x[i, 1, r] -= c * x[j, 0, r] + d * x[j, 1, r]
        for back in range(n):
            node = np.uint64(n - 1 - back)
            xx, xy, yy = inverse[node, 0], inverse[node, 1], inverse[node, 2]
            for r in range(begin, end):
                u, v = x[node, 0, r], x[node, 1, r]
                x[node, 0, r] = xx * u + xy * v
                x[node, 1, r] = xy * u + yy * v
            for p in range(starts[node], starts[node + np.uint64(1)]):
                i, a, b, c, d = np.uint64(rows[p]), lower[p, 0], lower[p, 1], lower[p, 2], lower[p, 3]
                for r in range(begin, end):
                    x[node, 0, r] -= a * x[i, 0, r] + c * x[i, 1, r]
                    x[node, 1, r] -= b * x[i, 0, r] + d * x[i, 1, r]


@compiled("x", axis=1, grain=_BLOCK, fastmath=FAST)
def node_energies(start, stop, values, columns, starts, x, out):
    """Write what each node adds to ``x^T S x`` of every column of x (2 N, R): ``out`` (N, R), S given by its rows."""
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
