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
CELLS_OF_BLOCK = 4
"""Side of a block of 8 px, cells."""


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


@compiled("low", axis=1, fastmath={"contract"})
def low_passed_planes(start, stop, contrast, low):
    """Low-pass the four planes of a mosaic at the middle of each 2x2 cell, `low` (4, H // 2, W // 2) float32.

    There the binomial [1 5 10 10 5 1] along both axes takes from each plane its own share, with the same weight, 16²,
    and the same centroid. A cell with a sample that is not finite in reach is NaN.
    """
    rows, columns = contrast.shape
    one, five, ten, nan = np.float32(1), np.float32(5), np.float32(10), np.float32(np.nan)
    planes = np.empty((4, columns // 2), np.float32)
    number = np.uint64(max(columns // 2 - 2, 0))
    for ci in range(start, stop):
        low[:, ci] = nan
        i = 2 * ci
        if i < 2 or i >= rows - REACH:
            continue
        _down(contrast[i - 2], contrast[i], contrast[i + 2], one, five, planes[:2], columns // 2)
        _down(contrast[i - 1], contrast[i + 1], contrast[i + 3], five, one, planes[2:], columns // 2)
        for c in range(number):
            d, e = c + np.uint64(1), c + np.uint64(2)
            p0 = planes[0, c] + ten * planes[0, d] + five * planes[0, e]
            p1 = five * planes[1, c] + ten * planes[1, d] + planes[1, e]
            p2 = planes[2, c] + ten * planes[2, d] + five * planes[2, e]
            p3 = five * planes[3, c] + ten * planes[3, d] + planes[3, e]
            known = np.isfinite(p0 + p1 + p2 + p3)
            low[0, ci, d], low[1, ci, d] = p0 if known else nan, p1 if known else nan
            low[2, ci, d], low[3, ci, d] = p2 if known else nan, p3 if known else nan


@helper()
def lanczos_weights(fraction, weights):
    """Weights of the eight neighbours of a place between the middle two (Duchon 1979), of unit sum."""
    total = 0.0
    for k in range(8):
        x = np.pi * (k - 3 - fraction)
        weights[k] = 4 * np.sin(x) * np.sin(x / 4) / (x * x) if abs(x) > 1e-6 else 1.0
        total += weights[k]
    for k in range(8):
        weights[k] /= total


@compiled("out", axis=1, grain=CELLS_OF_BLOCK, fastmath={"contract"})
def register_planes(start, stop, planes, apart, out):
    """Bring low-passed planes (k, H, W) of lights to one place, by interpolation (Lanczos 4).

    `apart` (k, 2, h, w) float64: x and y, in cells, by which a light shows the texture farther on, in each block of
    4 x 4 cells. `out`, like `planes`, is NaN where a sample is not finite or outside.
    """
    height, width = planes.shape[1:]
    half = CELLS_OF_BLOCK
    lines, wx, wy = np.empty((half + 7, half), np.float32), np.empty(8, np.float32), np.empty(8, np.float32)
    for bi in range(start // half, -(-stop // half)):
        for light in range(len(planes)):
            for bj in range(apart.shape[3]):
                x, y = apart[light, 0, bi, bj], apart[light, 1, bi, bj]
                left, top = int(np.floor(x)), int(np.floor(y))
                lanczos_weights(x - left, wx)
                lanczos_weights(y - top, wy)
                i0, j0 = bi * half + top - 3, bj * half + left - 3
                for i in range(half + 7):
                    for j in range(half):
                        value = np.float32(np.nan)
                        if 0 <= i0 + i < height and 0 <= j0 + j and j0 + j + 7 < width:
                            value = np.float32(0)
                            for k in range(8):
                                value += wx[k] * planes[light, i0 + i, j0 + j + k]
                        lines[i, j] = value
                for i in range(min(half, height - bi * half)):
                    for j in range(min(half, width - bj * half)):
                        value = np.float32(0)
                        for k in range(8):
                            value += wy[k] * lines[i + k, j]
                        out[light, bi * half + i, bj * half + j] = value


@compiled("sums", axis=2, fastmath={"contract"})
def displacement_scores(start, stop, planes, half, sums):
    """Sum ``-r gx``, ``-r gy`` and ``(gx gx + gy gy) / 2`` of each light over blocks of `half` cells.

    `planes` (k, H, W) float32: low-passed planes of the lights over their slopes; r is a light's minus the mean of the
    others, g the central difference of that mean in a cell. `sums` (k, 3, h, w) float32; what is not finite is left out.
    """
    count, height, width = planes.shape
    scale = np.float32(1 / (count - 1))
    mean = np.empty((3, width), np.float32)
    for bi in range(start, stop):
        sums[:, :, bi] = 0
        for i in range(max(bi * half, 1), min((bi + 1) * half, height - 1)):
            for light in range(count):
                mean[:] = 0
                for other in range(count):
                    if other != light:
                        for n in range(3):
                            for j in range(width):
                                mean[n, j] += scale * planes[other, i - 1 + n, j]
                for j in range(1, width - 1):
                    r = planes[light, i, j] - mean[1, j]
                    gx = np.float32(0.5) * (mean[1, j + 1] - mean[1, j - 1])
                    gy = np.float32(0.5) * (mean[2, j] - mean[0, j])
                    if np.isfinite(r + gx + gy):
                        sums[light, 0, bi, j // half] -= r * gx
                        sums[light, 1, bi, j // half] -= r * gy
                        sums[light, 2, bi, j // half] += np.float32(0.5) * (gx * gx + gy * gy)


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
