"""The owned pixels of a region, moved to and from images and coarse grids of square blocks.

Images and grids are of the rectangle around the region. `lines` (R, 4) int32 are the rows of pixels of the elements in
the order of the image's rows: first slot, number of pixels, row and column in the rectangle; row r has
``line_offsets[r]:line_offsets[r + 1]``. Pixels are counted without sign: an index that may be negative would be looked
at each time.
"""

import numpy as np

from rgbmidic._kernels.grids import expand_row
from rgbmidic._kernels.threads import FAST, compiled, over_ranges


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
