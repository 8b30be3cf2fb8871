"""Compiled loops over a Bayer mosaic that gather what the colours' textures have in common.

Grids hold one value per square block of pixels and stand for the block's centre; between the centres they are
interpolated linearly, beyond the outermost they are constant. ``red_row, red_column`` are the position of red in the
2x2 cell. A sample that must not be used is NaN.
"""

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.threads import over_ranges

__all__ = ["block_sums", "cell_moments", "expand_row", "lag_products", "scaled_contrast", "subtract_mean"]

REACH = 3
"""Rows and columns beyond a cell that its binomial sums reach."""


@over_ranges("sums", axis=1)
@compiled()
def block_sums(start, stop, values, red_row, red_column, block, sums, counts):
    """Sum and number of finite samples of each channel in each block: `sums`, `counts` (3, h, w) float64."""
    rows, columns = values.shape
    for bi in range(start, stop):
        for bj in range(sums.shape[2]):
            for channel in range(3):
                sums[channel, bi, bj] = 0.0
                counts[channel, bi, bj] = 0.0
            for i in range(bi * block, min((bi + 1) * block, rows)):
                own = 0 if i % 2 == red_row else 2
                for j in range(bj * block, min((bj + 1) * block, columns)):
                    channel = own if (j % 2 == red_column) == (own == 0) else 1
                    if np.isfinite(values[i, j]):
                        sums[channel, bi, bj] += values[i, j]
                        counts[channel, bi, bj] += 1.0


@helper()
def expand_row(grid, row, block, line, out):
    """Row of pixels `out` (W,) interpolated from a grid (h, w); `line` (w,) is scratch."""
    position = min(max((row + 0.5) / block - 0.5, 0.0), grid.shape[0] - 1.0)
    low = int(position)
    high = min(low + 1, grid.shape[0] - 1)
    part = np.float32(position - low)
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


@helper()
def _expand_own(grid, i, block, red_row, red_column, line, other, out):
    """Row i of a grid (3, h, w) of blocks, at each pixel that of the pixel's own channel, into `out` (W,)."""
    own = 0 if i % 2 == red_row else 2
    expand_row(grid[own], i, block, line, other)
    expand_row(grid[1], i, block, line, out)
    start = red_column if own == 0 else 1 - red_column
    for j in range(start, out.size, 2):
        out[j] = other[j]


@over_ranges("out")
@compiled()
def subtract_mean(start, stop, values, mean, red_row, red_column, block, out):
    """``out = values - local mean of the pixel's channel``; `mean` (3, h, w) float32."""
    columns = values.shape[1]
    for i in range(start, stop):
        line = np.empty(mean.shape[2], dtype=np.float32)
        other, green = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
        _expand_own(mean, i, block, red_row, red_column, line, other, green)
        for j in range(columns):
            out[i, j] = values[i, j] - green[j]


@over_ranges("out")
@compiled()
def scaled_contrast(start, stop, contrast, scale, red_row, red_column, block, pad, out):
    """``out = contrast * scale of the pixel's channel``, mirrored by `pad` pixels on every side.

    `scale` (3, h, w) float32; `out` has `pad` more rows above and below and columns on the left, and at least as many
    on the right, where what lies beyond is 0. H, W > pad.
    """
    rows, columns = contrast.shape
    for p in range(start, stop):
        i = abs(p - pad)
        i = min(i, 2 * (rows - 1) - i)
        line = np.empty(scale.shape[2], dtype=np.float32)
        other, green = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
        _expand_own(scale, i, block, red_row, red_column, line, other, green)
        target = out[p]
        for j in range(columns):
            target[j + pad] = contrast[i, j] * green[j]
        for side in range(1, pad + 1):
            target[pad - side] = target[pad + side]
            target[pad + columns - 1 + side] = target[pad + columns - 1 - side]
        for j in range(columns + 2 * pad, target.size):
            target[j] = 0.0


@helper()
def _along(line, j, odd):
    """Binomial sum about the middle of the cell at column j, of its even or its odd columns."""
    if odd:
        return 5 * line[j - 1] + 10 * line[j + 1] + line[j + 3]
    return line[j - 2] + 10 * line[j] + 5 * line[j + 2]


@over_ranges("counts")
@compiled()
def cell_moments(start, stop, contrast, red_row, red_column, block, sums, counts):
    """Second moments of the four planes' low-passed contrast, summed over the cells of each block.

    At the middle of each 2x2 cell the binomial [1 5 10 10 5 1] along both axes takes from each of the planes red, green
    in red rows, green in blue rows and blue its own share, with the same weight and the same centroid. `sums`
    (7, h, w) float64 receives red², green², blue², red green, red blue, green blue, the greens averaged after
    multiplying, and the product of the two greens; `counts` (h, w) the cells; a cell with a sample that is not finite
    in reach is left out.
    """
    rows, columns = contrast.shape
    half = block // 2
    for bi in range(start, stop):
        for bj in range(sums.shape[2]):
            counts[bi, bj] = 0.0
            for moment in range(7):
                sums[moment, bi, bj] = 0.0
        even = np.empty(columns, dtype=np.float32)
        odd = np.empty(columns, dtype=np.float32)
        for ci in range(bi * half, (bi + 1) * half):
            i = 2 * ci
            if i < 2 or i + REACH >= rows:
                continue
            for j in range(columns):
                even[j] = contrast[i - 2, j] + 10 * contrast[i, j] + 5 * contrast[i + 2, j]
                odd[j] = 5 * contrast[i - 1, j] + 10 * contrast[i + 1, j] + contrast[i + 3, j]
            red = even if red_row == 0 else odd
            blue = odd if red_row == 0 else even
            for bj in range(sums.shape[2]):
                for cj in range(bj * half, (bj + 1) * half):
                    j = 2 * cj
                    if j < 2 or j + REACH >= columns:
                        continue
                    r, g1 = _along(red, j, red_column), _along(red, j, 1 - red_column)
                    g2, b = _along(blue, j, red_column), _along(blue, j, 1 - red_column)
                    total = r + g1 + g2 + b
                    if not np.isfinite(total):
                        continue
                    g = 0.5 * (g1 + g2)
                    sums[0, bi, bj] += r * r
                    sums[1, bi, bj] += 0.5 * (g1 * g1 + g2 * g2)
                    sums[2, bi, bj] += b * b
                    sums[3, bi, bj] += r * g
                    sums[4, bi, bj] += r * b
                    sums[5, bi, bj] += g * b
                    sums[6, bi, bj] += g1 * g2
                    counts[bi, bj] += 1.0


@compiled()
def lag_products(contrast, red_row, red_column, lags, step, sums, counts):
    """Products of samples at each lag (row, column), apart for red-green, red-blue, green-blue and each colour alone.

    Base pixels are the 2x2 cells of every `step`-th row of cells. `sums`, `counts` (lags, 6) float64; kinds 0 to 5 are
    red², green², blue², red green, red blue, green blue.
    """
    rows, columns = contrast.shape
    for n in range(lags.shape[0]):
        di, dj = lags[n, 0], lags[n, 1]
        for ci in range(0, rows // 2, step):
            for i in range(2 * ci, 2 * ci + 2):
                other = i + di
                if other >= rows:
                    continue
                own = 0 if i % 2 == red_row else 2
                own_other = 0 if other % 2 == red_row else 2
                for j in range(max(0, -dj), min(columns, columns - dj)):
                    a = own if (j % 2 == red_column) == (own == 0) else 1
                    b = own_other if ((j + dj) % 2 == red_column) == (own_other == 0) else 1
                    product = contrast[i, j] * contrast[other, j + dj]
                    if np.isfinite(product):
                        kind = a if a == b else 2 + a + b
                        sums[n, kind] += product
                        counts[n, kind] += 1.0
