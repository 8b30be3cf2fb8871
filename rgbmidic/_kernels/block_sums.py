"""Sums of fields at the owned pixels over square blocks of the rectangle around the region.

Pixels lie in memory element after element, and are read so: the rows of an element in a row of blocks are first added
up along its columns, these then over the blocks. `lines` (R, 4) int32 and `run_offsets` (E + 1,) are those of
`rgbmidic.mesh.PixelMap`. A row of blocks is summed by one thread, element by element, so that the sums are the same
bits on any number of threads.
"""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled, helper

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_LANES = 8
"""Pixels in a vector register: runs have 13 on average, and what does not fill a vector costs as much as eight."""


@compiled("out", axis=1, fastmath=FAST)
def block_sums(start, stop, values, lines, run_offsets, side, out):
    """Sum fields (n, P) over blocks of `side` px: ``out`` (n, h, w)."""
    out[:, start:stop] = 0
    columns = np.zeros((len(values), out.shape[2] * side + _LANES), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        _add(values, np.uint64(0), lines, run_offsets, e, start * side, stop * side, side, columns, out)


@compiled("out", axis=1, fastmath=FAST)
def product_sums(start, stop, values, weights, lines, run_offsets, side, out):
    """Sum ``s a b`` and ``s = sqrt(w_a w_b)`` over blocks for each two fields a, b of `values` (k, P).

    ``out`` (k (k + 1), h, w) receives both sums, with the fields' `weights` (k, P), for each field with those up to it.
    """
    out[:, start:stop] = 0
    columns = np.zeros((len(out), out.shape[2] * side + _LANES), dtype=np.float32)
    largest = _largest(lines, run_offsets)
    field, root = np.empty((2, len(values), largest), dtype=np.float32)
    products = np.empty((len(out), largest), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        first, number = _slots(lines, run_offsets, e, start * side, stop * side)
        n = 0
        for a in range(len(values)):
            for i in range(number):
                root[a, i] = np.sqrt(weights[a, first + i])
                field[a, i] = root[a, i] * values[a, first + i]
            for b in range(a + 1):
                for i in range(number):
                    products[n, i] = field[a, i] * field[b, i]
                    products[n + 1, i] = root[a, i] * root[b, i]
                n += 2
        _add(products, first, lines, run_offsets, e, start * side, stop * side, side, columns, out)


@compiled("out", axis=1, fastmath=FAST)
def score_sums(start, stop, residual, weights, gradient_x, gradient_y, lines, run_offsets, side, out):
    """Sum ``w r gx``, ``w r gy`` and ``w (gx gx + gy gy)`` of fields (k, P) over blocks, and the pixels with weight.

    ``out`` (4, h, w) receives the sums over all lights, and the number of pixels where one has weight.
    """
    out[:, start:stop] = 0
    columns = np.zeros((4, out.shape[2] * side + _LANES), dtype=np.float32)
    scores = np.empty((4, _largest(lines, run_offsets)), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        first, number = _slots(lines, run_offsets, e, start * side, stop * side)
        for i in range(number):
            scores[0, i] = scores[1, i] = scores[2, i] = scores[3, i] = _ZERO
        for light in range(len(weights)):
            for i in range(number):
                w, gx, gy = weights[light, first + i], gradient_x[light, first + i], gradient_y[light, first + i]
                weighted = w * residual[light, first + i]
                scores[0, i] += weighted * gx
                scores[1, i] += weighted * gy
                scores[2, i] += w * (gx * gx + gy * gy)
                scores[3, i] = max(scores[3, i], _ONE if w > _ZERO else _ZERO)
        _add(scores, first, lines, run_offsets, e, start * side, stop * side, side, columns, out)


@helper()
def _largest(lines, run_offsets):
    """Return the number of pixels of the largest element."""
    most = 0
    for e in range(len(run_offsets) - 1):
        first, last = run_offsets[e], run_offsets[e + 1] - 1
        if last >= first:
            most = max(most, lines[last, 0] + lines[last, 1] - lines[first, 0])
    return most


@helper()
def _slots(lines, run_offsets, e, top, bottom):
    """First slot of an element and its number of pixels; none where it has no row from `top` to `bottom`."""
    first, last = run_offsets[e], run_offsets[e + 1] - 1
    if last < first or lines[first, 2] >= bottom or lines[last, 2] < top:
        return np.uint64(0), np.uint64(0)
    return np.uint64(lines[first, 0]), np.uint64(lines[last, 0] + lines[last, 1] - lines[first, 0])


@helper(fastmath=FAST)
def _add(fields, begin, lines, run_offsets, e, top, bottom, side, columns, out):
    """Add the rows from `top` to `bottom` of an element to the blocks; slot `begin` is the first of `fields` (n, ...).

    `columns` (n, W) are 0 before and after.
    """
    block, low, high = np.int64(-1), np.int64(0), np.int64(0)
    for q in range(run_offsets[e], run_offsets[e + 1]):
        slot, number, row, column = lines[q, 0], np.int64(lines[q, 1]), lines[q, 2], np.int64(lines[q, 3])
        if row < top:
            continue
        if row >= bottom:
            break
        if row // side != block:
            _flush(columns, low, high, side, block, out)
            block, low, high = row // side, column, column
        low, high = min(low, column), max(high, column + number)
        at, to = np.uint64(slot) - begin, np.uint64(column)
        # whole vectors, of which the last one may be too long, where memory goes on so far
        filled = (number + _LANES - 1) // _LANES * _LANES
        if np.int64(at) + filled > fields.shape[1]:
            filled = number
        for n in range(len(fields)):
            for i in range(np.uint32(filled)):
                value = fields[n, at + i]
                columns[n, to + i] += value if np.int32(i) < np.int32(number) else _ZERO
    _flush(columns, low, high, side, block, out)


@helper(fastmath=FAST)
def _flush(columns, low, high, side, block, out):
    """Add the columns from `low` to `high` to a row of blocks, and make them 0."""
    for b in range(low // side, (high + side - 1) // side):
        for n in range(len(columns)):
            total = _ZERO
            for i in range(np.uint64(b * side), np.uint64((b + 1) * side)):
                total += columns[n, i]
                columns[n, i] = _ZERO
            out[n, block, b] += total
