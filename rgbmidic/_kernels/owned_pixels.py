"""The owned pixels of a region, moved to and from images and coarse grids of square blocks.

Images and grids are of the rectangle around the region. `lines` (R, 4) int32 are the rows of pixels of the elements in
the order of the image's rows: first slot, number of pixels, row and column in the rectangle; row r has
``line_offsets[r]:line_offsets[r + 1]``. Pixels are counted without sign: an index that may be negative would be looked
at each time. What is summed is first added up along the columns of a block's rows, side by side in memory.
"""

import numpy as np

from rgbmidic._kernels.grids import expand_row
from rgbmidic._kernels.threads import FAST, compiled, helper, over_ranges

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_LANES = 8
"""Pixels in a vector register: lines have 13 on average, and what does not fill a vector costs as much as eight."""


@over_ranges("out", axis=1)
@compiled(fastmath=FAST)
def block_sums(start, stop, values, lines, line_offsets, side, out):
    """Sum fields (n, P) over blocks of `side` px: ``out`` (n, h, w)."""
    columns = np.empty(out.shape[2] * side, dtype=np.float32)
    for n in range(len(values)):
        for block in range(start, stop):
            columns[:] = 0
            first, last = line_offsets[block * side], line_offsets[min((block + 1) * side, line_offsets.size - 1)]
            for q in range(first, last):
                slot, number, column = np.uint64(lines[q, 0]), np.uint64(lines[q, 1]), np.uint64(lines[q, 3])
                for i in range(number):
                    columns[column + i] += values[n, slot + i]
            _gather(columns, side, out[n, block])


@over_ranges("out", axis=3)
@compiled(fastmath=FAST)
def product_sums(start, stop, values, weights, lines, line_offsets, side, out):
    """Sum ``s a b`` and ``s = sqrt(w_a w_b)`` over blocks for each two fields a, b of `values` (k, P).

    ``out`` (k, k, 2, h, w) receives the sums with the fields' `weights` (k, P), the second field not after the first.
    """
    lights, width = len(values), out.shape[4] * side
    field, root = np.empty((2, lights, width + _LANES), dtype=np.float32)
    sums = np.empty((lights, lights, 2, width), dtype=np.float32)
    for block in range(start, stop):
        sums[:] = 0
        for row in range(block * side, min((block + 1) * side, line_offsets.size - 1)):
            for light in range(lights):
                own, w = field[light], root[light]
                _to_row(row, values[light], lines, line_offsets, own)
                _to_row(row, weights[light], lines, line_offsets, w)
                for i in range(np.uint64(width)):
                    w[i] = np.sqrt(w[i])
                for i in range(np.uint64(width)):
                    own[i] *= w[i]
                for other in range(light + 1):
                    b, v = field[other], root[other]
                    product, share = sums[light, other, 0], sums[light, other, 1]
                    for i in range(np.uint64(width)):
                        product[i] += own[i] * b[i]
                    for i in range(np.uint64(width)):
                        share[i] += w[i] * v[i]
        for light in range(lights):
            for other in range(light + 1):
                for n in range(2):
                    _gather(sums[light, other, n], side, out[light, other, n, block])


@helper(fastmath=FAST)
def _to_row(row, values, lines, line_offsets, out):
    """Write a row of the image of `values` (P,), 0 where no pixel is owned; `out` is longer by a vector.

    Whole vectors are copied, where memory goes on so far: the next line overwrites what is too much, or a gap does.
    """
    filled = np.int64(0)
    for q in range(line_offsets[row], line_offsets[row + 1]):
        slot, number, column = np.int64(lines[q, 0]), np.int64(lines[q, 1]), np.int64(lines[q, 3])
        for i in range(np.uint64(filled), np.uint64(column)):
            out[i] = _ZERO
        whole = (number + _LANES - 1) // _LANES * _LANES
        if slot + whole > values.size:
            whole = number
        first, target = np.uint64(slot), np.uint64(column)
        for i in range(np.uint32(whole)):
            out[target + i] = values[first + i]
        filled = column + number
    for i in range(np.uint64(filled), np.uint64(out.size)):
        out[i] = _ZERO


@helper(fastmath=FAST)
def _gather(columns, side, out):
    """Sum each `side` of the columns into `out` (w,)."""
    for block in range(out.size):
        total = _ZERO
        for i in range(np.uint64(block * side), np.uint64((block + 1) * side)):
            total += columns[i]
        out[block] = total


@over_ranges("lines")
@compiled()
def to_image(start, stop, lines, values, top, left, out):
    """Write fields (n, P) float32 of the owned pixels into images ``out`` (n, H, W).

    The rectangle around the pixels begins at row `top` and column `left` of the images.
    """
    for n in range(len(values)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, row, column + i] = values[n, slot + i]


@over_ranges("lines")
@compiled()
def from_image(start, stop, lines, image, top, left, out):
    """Read fields ``out`` (n, P) at the owned pixels from such images (n, H, W)."""
    for n in range(len(image)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, slot + i] = image[n, row, column + i]


@over_ranges("line_offsets")
@compiled(fastmath=FAST)
def from_grid(start, stop, lines, line_offsets, grid, side, out):
    """Interpolate grids (n, h, w) float32 of blocks of `side` px at the owned pixels: ``out`` (n, P).

    The interpolation is linear between the centres of the blocks and constant beyond the outermost.
    """
    row = np.empty(grid.shape[2] * side, dtype=np.float32)
    between = np.empty(grid.shape[2], dtype=np.float32)
    for r in range(start, min(stop, line_offsets.size - 1)):
        for n in range(len(grid)):
            expand_row(grid[n], r, side, between, row)
            for q in range(line_offsets[r], line_offsets[r + 1]):
                slot, number, column = np.uint64(lines[q, 0]), np.uint64(lines[q, 1]), np.uint64(lines[q, 3])
                for i in range(number):
                    out[n, slot + i] = row[column + i]
