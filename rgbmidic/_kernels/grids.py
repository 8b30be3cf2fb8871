"""Between the values of a coarse grid, one per block of pixels: linearly, beyond the outermost centres constant."""

import numpy as np

from rgbmidic._kernels.threads import helper


@helper()
def between(row, block, rows):
    """Return the two rows of a grid that a row of pixels lies between, and how far on from the first it is."""
    position = min(max((row + 0.5) / block - 0.5, 0.0), rows - 1.0)
    low = int(position)
    return low, min(low + 1, rows - 1), np.float32(position - low)


@helper()
def expand_row(grid, row, block, line, out):
    """Row of pixels `out` (W,) interpolated from a grid (h, w); `line` (w,) is scratch."""
    low, high, part = between(row, block, grid.shape[0])
    for g in range(line.size):
        line[g] = grid[low, g] + part * (grid[high, g] - grid[low, g])
    half, last = block // 2, line.size - 1
    first = min(half, out.size)
    for j in range(first):
        out[j] = line[0]
    per_pixel = np.float32(1.0 / block)
    ahead = np.float32(0.5 - 0.5 * (block % 2))  # of the first pixel beyond a block's centre
    for j in range(block):
        part, start = (np.float32(j) + ahead) * per_pixel, half + j
        for g in range(np.uint64(max(min(last, (out.size - start + block - 1) // block), 0))):
            out[np.uint64(start) + g * np.uint64(block)] = line[g] + part * (line[g + np.uint64(1)] - line[g])
    for j in range(half + last * block, out.size):
        out[j] = line[last]
