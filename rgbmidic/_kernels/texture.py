"""Local means of an image, its contrast, and the products of neighbouring samples that tell its texture.

Grids hold one value per square block of pixels and stand for the block's centre; between the centres they are
interpolated linearly, beyond the outermost they are constant.
"""

import numpy as np

from rgbmidic._kernels.threads import compiled, helper

REACH = 3
"""Rows and columns beyond a cell that its binomial sums reach."""
PLANE_PAIRS = tuple((p, q) for p in range(4) for q in range(p, 4))
"""Pairs of the planes of a mosaic; plane 2 a + b has the samples of row a and column b of the 2x2 cells."""
_CELLS = 128
"""Cells of a row at a time."""


@helper()
def between(row, block, rows):
    """Return the two rows of a grid that a row of pixels lies between, and how far on from the first it is."""
    position = min(max((row + 0.5) / block - 0.5, 0.0), rows - 1.0)
    low = int(position)
    return low, min(low + 1, rows - 1), np.float32(position - low)


@compiled("sums", axis=1)
def block_sums(start, stop, values, block, sums):
    """Sum the finite samples of the four planes in each block, then count them: `sums` (8, h, w) float32."""
    total = np.empty((4, sums.shape[2] * block), np.float32)
    for bi in range(start, stop):
        for n in range(4):
            for j in range(total.shape[1]):
                total[n, j] = 0
        for i in range(bi * block, min((bi + 1) * block, len(values))):
            line, value, known = values[i], total[i % 2], total[2 + i % 2]
            for j in range(line.size):
                finite = np.isfinite(line[j])
                value[j] += line[j] if finite else np.float32(0.0)
                known[j] += np.float32(1.0) if finite else np.float32(0.0)
        for plane in range(8):
            line, out = total[plane // 2], sums[plane, bi]
            for b in range(out.size):
                value = np.float32(0)
                for j in range(np.uint64(b * block + plane % 2), np.uint64((b + 1) * block), np.uint64(2)):
                    value += line[j]
                out[b] = value


@compiled("out")
def subtract_mean(start, stop, values, mean, block, out):
    """Write ``out = values - local mean``.

    `mean` (2, h, W) float32 has the rows of a grid, for the even and for the odd rows of pixels, widened to their
    columns.
    """
    for i in range(start, stop):
        low, high, part = between(i, block, mean.shape[1])
        above, below, line, target = mean[i % 2, low], mean[i % 2, high], values[i], out[i]
        for j in range(line.size):
            target[j] = line[j] - (above[j] + part * (below[j] - above[j]))


@compiled("out")
def divide_by_mean(start, stop, values, mean, block, least, out):
    """``out = values / local mean``, NaN where the mean is not above `least`.

    `mean` (h, W) float32: the rows of a grid of `block` px, widened to the columns.
    """
    for i in range(start, stop):
        low, high, part = between(i, block, len(mean))
        above, below, line, target = mean[low], mean[high], values[i], out[i]
        for j in range(line.size):
            level = above[j] + part * (below[j] - above[j])
            target[j] = line[j] / level if level > least else np.float32(np.nan)


@compiled("out")
def scaled_contrast(start, stop, contrast, scale, block, pad, out):
    """``out = contrast * scale``, mirrored by `pad` pixels on every side.

    `scale` (2, h, W) float32 as the mean of `subtract_mean`; `out` has `pad` more rows above and below and columns on
    the left, and at least as many on the right, where what lies beyond is 0. H, W > pad.
    """
    rows, columns = contrast.shape
    for p in range(start, stop):
        i = abs(p - pad)
        i = min(i, 2 * (rows - 1) - i)
        low, high, part = between(i, block, scale.shape[1])
        above, below, line, target = scale[i % 2, low], scale[i % 2, high], contrast[i], out[p, pad:]
        for j in range(columns):
            target[j] = line[j] * (above[j] + part * (below[j] - above[j]))
        for side in range(1, pad + 1):
            out[p, pad - side] = target[side]
            target[columns - 1 + side] = target[columns - 1 - side]
        target[columns + pad :] = 0


@helper(fastmath={"contract"})
def _down(above, here, below, first, last, planes, number):
    """Binomial sums of three rows of a mosaic, of their even and of their odd columns."""
    ten = np.float32(10)
    for c in range(np.uint64(number)):
        j = np.uint64(2) * c
        planes[0, c] = first * above[j] + ten * here[j] + last * below[j]
        j += np.uint64(1)
        planes[1, c] = first * above[j] + ten * here[j] + last * below[j]


@compiled("sums", axis=1, fastmath={"contract"})
def cell_moments(start, stop, contrast, block, sums):
    """Second moments of the four planes' low-passed contrast, summed over the cells of each block.

    At the middle of each 2x2 cell the binomial [1 5 10 10 5 1] along both axes takes from each plane its own share,
    with the same weight and the same centroid. `sums` (11, h, w) float32 receives the products of the planes in the
    order of `PLANE_PAIRS`, then the number of cells; a cell with a sample that is not finite in reach is left out.
    """
    rows, columns = contrast.shape
    half = block // 2
    zero, one, five, ten = np.float32(0), np.float32(1), np.float32(5), np.float32(10)
    planes, low = np.empty((4, _CELLS + 2), np.float32), np.empty((4, _CELLS), np.float32)
    total = np.empty((11, _CELLS), np.float32)
    for bi in range(start, stop):
        for left in range(0, half * sums.shape[2], _CELLS):
            total[:] = 0
            first = max(left, 1)
            number = min(left + _CELLS, columns // 2 - 1) - first
            for i in range(max(bi * block, 2), min((bi + 1) * block, rows - REACH), 2):
                j = 2 * first - 2
                _down(contrast[i - 2, j:], contrast[i, j:], contrast[i + 2, j:], one, five, planes[:2], number + 2)
                _down(contrast[i - 1, j:], contrast[i + 1, j:], contrast[i + 3, j:], five, one, planes[2:], number + 2)
                for c in range(np.uint64(max(number, 0))):
                    d, e = c + np.uint64(1), c + np.uint64(2)
                    p0 = planes[0, c] + ten * planes[0, d] + five * planes[0, e]
                    p1 = five * planes[1, c] + ten * planes[1, d] + planes[1, e]
                    p2 = planes[2, c] + ten * planes[2, d] + five * planes[2, e]
                    p3 = five * planes[3, c] + ten * planes[3, d] + planes[3, e]
                    known = np.isfinite(p0 + p1 + p2 + p3)
                    low[0, c], low[1, c] = p0 if known else zero, p1 if known else zero
                    low[2, c], low[3, c] = p2 if known else zero, p3 if known else zero
                    total[10, c] += one if known else zero
                moment = 0
                for p in range(4):
                    for q in range(p, 4):
                        for c in range(np.uint64(max(number, 0))):
                            total[moment, c] += low[p, c] * low[q, c]
                        moment += 1
            for moment in range(11):
                for b in range(left // half, min((left + _CELLS) // half, sums.shape[2])):
                    value = np.float32(0)
                    for c in range(np.uint64(max(b * half - first, 0)), np.uint64((b + 1) * half - first)):
                        value += total[moment, c]
                    sums[moment, bi, b] = value


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
