"""Compiled loops between the owned pixels and images, or coarse grids of square blocks, of the rectangle around them.

`lines` (R, 4) int32 are the rows of pixels of the elements in the order of the image's rows: first slot, number of
pixels, row and column in the rectangle; row r has ``line_offsets[r]:line_offsets[r + 1]``. Pixels are counted without
sign: an index that may be negative would be looked at each time. What is summed is first added up along the columns of
a block's rows, side by side in memory.
"""

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.interpolation import _FAST
from rgbmidic._kernels.texture import expand_row
from rgbmidic._kernels.threads import over_ranges

__all__ = ["block_sums", "from_grid", "from_image", "product_sums", "score_sums", "to_image"]


_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_LANES = 8
"""Pixels in a vector register: lines have 13 on average, and what does not fill a vector costs as much as eight."""


@over_ranges("out", axis=1)
@compiled(fastmath=_FAST)
def block_sums(start, stop, values, lines, line_offsets, side, out):
    """Sums of fields (n, P) over blocks of `side` px: ``out`` (n, h, w)."""
    columns = np.empty(out.shape[2] * side, dtype=np.float32)
    for n in range(len(values)):
        for block in range(start, stop):
            columns[:] = 0
            first, last = line_offsets[block * side], line_offsets[min((block + 1) * side, line_offsets.size - 1)]
            for q in range(first, last):
                slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
                target, field = columns[lines[q, 3] :], values[n]
                for i in range(number):
                    target[i] += field[slot + i]
            _gather(columns, side, out[n, block])


@over_ranges("out", axis=3)
@compiled(fastmath=_FAST)
def product_sums(start, stop, values, weights, lines, line_offsets, side, out):
    """Sums over blocks of ``s a b`` and of ``s = sqrt(w_a w_b)`` for each two fields a, b of `values` (k, P) and their
    `weights` (k, P), the second not after the first: ``out`` (k, k, 2, h, w)."""
    lights, width = len(values), out.shape[4] * side
    field, root = np.empty((2, lights, width + _LANES), dtype=np.float32)
    sums = np.empty((lights, lights, 2, width), dtype=np.float32)
    for block in range(start, stop):
        sums[:] = 0
        for row in range(block * side, min((block + 1) * side, line_offsets.size - 1)):
            for light in range(lights):
                _to_row(row, values[light], lines, line_offsets, field[light])
                _to_row(row, weights[light], lines, line_offsets, root[light])
                for i in range(np.uint64(width)):
                    root[light, i] = np.sqrt(root[light, i])
                for other in range(light + 1):
                    a, b, v, w = field[light], field[other], root[light], root[other]
                    product, share = sums[light, other, 0], sums[light, other, 1]
                    for i in range(np.uint64(width)):
                        s = v[i] * w[i]
                        product[i] += s * a[i] * b[i]
                        share[i] += s
        for light in range(lights):
            for other in range(light + 1):
                for n in range(2):
                    _gather(sums[light, other, n], side, out[light, other, n, block])


@over_ranges("out", axis=2)
@compiled(fastmath=_FAST)
def score_sums(start, stop, residual, weight, gradient_x, gradient_y, lines, line_offsets, side, out):
    """Per light, sums over blocks of ``w r gx``, ``w r gy``, ``w (gx gx + gy gy)`` and of the pixels with weight.

    The fields are (k, P) float32; `out` (k, 4, h, w) float64.
    """
    columns = np.empty((4, out.shape[3] * side), dtype=np.float32)
    for light in range(len(weight)):
        r, w, gx, gy = residual[light], weight[light], gradient_x[light], gradient_y[light]
        for block in range(start, stop):
            columns[:] = 0
            first, last = line_offsets[block * side], line_offsets[min((block + 1) * side, line_offsets.size - 1)]
            for q in range(first, last):
                slot, number, column = np.uint64(lines[q, 0]), np.uint64(lines[q, 1]), lines[q, 3]
                x, y = columns[0, column:], columns[1, column:]
                information, pixels = columns[2, column:], columns[3, column:]
                for i in range(number):
                    own, along, across = w[slot + i], gx[slot + i], gy[slot + i]
                    pull = own * r[slot + i]
                    x[i] += pull * along
                    y[i] += pull * across
                    information[i] += own * (along * along + across * across)
                    pixels[i] += _ONE if own > _ZERO else _ZERO
            for n in range(4):
                _gather(columns[n], side, out[light, n, block])


@helper(forceinline=True)
def _filled(slot, number, size):
    """So many pixels in whole vectors, where memory goes on so far."""
    filled = (number + _LANES - 1) // _LANES * _LANES
    return filled if slot + filled <= size else number


@helper(fastmath=_FAST)
def _to_row(row, values, lines, line_offsets, out):
    """A row of the image of `values` (P,), 0 where no pixel is owned; `out` is longer by a vector."""
    out[:] = 0
    for q in range(line_offsets[row], line_offsets[row + 1]):
        slot, number = np.int64(lines[q, 0]), np.int64(lines[q, 1])
        source, target = values[slot:], out[lines[q, 3] :]
        for i in range(np.uint32(_filled(slot, number, values.size))):  # what is too much, the next line overwrites
            target[i] = source[i] if np.int32(i) < np.int32(number) else _ZERO


@helper(fastmath=_FAST)
def _gather(columns, side, out):
    """Sums of each `side` of the columns into `out` (w,)."""
    for block in range(out.size):
        total = _ZERO
        for i in range(np.uint64(block * side), np.uint64((block + 1) * side)):
            total += columns[i]
        out[block] = total


@over_ranges("lines")
@compiled()
def to_image(start, stop, lines, values, top, left, out):
    """Fields (n, P) float32 of the owned pixels as images ``out`` (n, H, W), in which the rectangle begins at row `top`
    and column `left`."""
    for n in range(len(values)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            target = out[n, top + lines[q, 2], left + lines[q, 3] :]
            for i in range(number):
                target[i] = values[n, slot + i]


@over_ranges("lines")
@compiled()
def from_image(start, stop, lines, image, top, left, out):
    """The way back: ``out`` (n, P) from such images (n, H, W)."""
    for n in range(len(image)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            source = image[n, top + lines[q, 2], left + lines[q, 3] :]
            for i in range(number):
                out[n, slot + i] = source[i]


@over_ranges("lines")
@compiled()
def from_grid(start, stop, lines, grid, side, out):
    """Grids (n, h, w) float32 of blocks of `side` px interpolated linearly between their centres, constant beyond the
    outermost, at the owned pixels: ``out`` (n, P)."""
    row = np.empty(grid.shape[2] * side, dtype=np.float32)
    between = np.empty(grid.shape[2], dtype=np.float32)
    for n in range(len(grid)):
        on = -1
        for q in range(start, stop):
            if lines[q, 2] != on:
                on = lines[q, 2]
                expand_row(grid[n], on, side, between, row)
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            source = row[lines[q, 3] :]
            for i in range(number):
                out[n, slot + i] = source[i]
