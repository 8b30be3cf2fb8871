"""Local means of an image, its contrast, and the products of neighbouring samples that tell its texture.

Grids hold one value per square block of pixels and stand for the block's centre; between the centres they are
interpolated linearly, beyond the outermost they are constant.
"""

import numpy as np

from rgbmidic._kernels.threads import compiled, helper

REACH = 3
"""Rows and columns beyond a cell that its binomial sums reach."""
CELLS = 4
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
            line, value, count = values[i], total[i % 2], total[2 + i % 2]
            for j in range(line.size):
                finite = np.isfinite(line[j])
                value[j] += line[j] if finite else np.float32(0.0)
                count[j] += np.float32(1.0) if finite else np.float32(0.0)
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
        low, high, fraction = between(i, block, mean.shape[1])
        above, below, line, target = mean[i % 2, low], mean[i % 2, high], values[i], out[i]
        for j in range(line.size):
            target[j] = line[j] - (above[j] + fraction * (below[j] - above[j]))


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
        low, high, fraction = between(i, block, scale.shape[1])
        above, below, line, target = scale[i % 2, low], scale[i % 2, high], contrast[i], out[p, pad:]
        for j in range(columns):
            target[j] = line[j] * (above[j] + fraction * (below[j] - above[j]))
        for side in range(1, pad + 1):
            out[p, pad - side] = target[side]
            target[columns - 1 + side] = target[columns - 1 - side]
        target[columns + pad :] = 0


@helper(fastmath={"contract"})
def _down(above, centre, below, first, last, planes, number):
    """Binomial sums of three rows of a mosaic, of their even and of their odd columns."""
    ten = np.float32(10)
    for c in range(np.uint64(number)):
        j = np.uint64(2) * c
        planes[0, c] = first * above[j] + ten * centre[j] + last * below[j]
        j += np.uint64(1)
        planes[1, c] = first * above[j] + ten * centre[j] + last * below[j]


@compiled("low", axis=1, fastmath={"contract"})
def low_passed_planes(start, stop, contrast, order, unmixing, low, lights):
    """Low-pass the four planes of a mosaic at the middle of each 2x2 cell, and unmix the lights' from them.

    There the binomial [1 5 10 10 5 1] along both axes takes from each plane its own share, with the same weight, 16²,
    and the same centroid. `low` (4, H // 2, W // 2) float32 receives the planes ``2 a + b`` of row a and column b of
    the cells in their `order` (4,); a cell with a sample that is not finite in reach is NaN.
    """
    rows, columns = contrast.shape
    one, five, ten, nan = np.float32(1), np.float32(5), np.float32(10), np.float32(np.nan)
    planes = np.empty((4, columns // 2), np.float32)
    first, second, third, fourth = order
    for ci in range(start, stop):
        low[:, ci] = nan
        lights[:, ci] = nan
        i = 2 * ci
        if i < 2 or i >= rows - REACH:
            continue
        _down(contrast[i - 2], contrast[i], contrast[i + 2], one, five, planes[:2], columns // 2)
        _down(contrast[i - 1], contrast[i + 1], contrast[i + 3], five, one, planes[2:], columns // 2)
        for c in range(np.uint64(max(columns // 2 - 2, 0))):
            d, e = c + np.uint64(1), c + np.uint64(2)
            p0 = planes[0, c] + ten * planes[0, d] + five * planes[0, e]
            p1 = five * planes[1, c] + ten * planes[1, d] + planes[1, e]
            p2 = planes[2, c] + ten * planes[2, d] + five * planes[2, e]
            p3 = five * planes[3, c] + ten * planes[3, d] + planes[3, e]
            finite = np.isfinite(p0 + p1 + p2 + p3)
            low[first, ci, d], low[second, ci, d] = p0 if finite else nan, p1 if finite else nan
            low[third, ci, d], low[fourth, ci, d] = p2 if finite else nan, p3 if finite else nan
        for light in range(len(lights)):
            target, (a, b, c, d) = lights[light, ci], unmixing[light]
            first_line, second_line, third_line, fourth_line = low[0, ci], low[1, ci], low[2, ci], low[3, ci]
            for j in range(target.size):
                target[j] = a * first_line[j] + b * second_line[j] + c * third_line[j] + d * fourth_line[j]


@compiled("sums", axis=1, fastmath={"contract"})
def plane_products(start, stop, planes, half, sums):
    """Sum the products of any two of n planes over blocks of `half` cells.

    `planes` (n, H, W) float32; `sums` (n (n + 1) / 2 + 1, h, w) float32 receives the products of planes 00, 01 ... 11,
    12 ..., then the number of cells. A cell at which a plane is not finite is left out.
    """
    count, height, width = planes.shape
    total = np.empty((len(sums), width), np.float32)
    value = np.empty((count, width), np.float32)
    for bi in range(start, stop):
        total[:] = 0
        for i in range(bi * half, min((bi + 1) * half, height)):
            for j in range(width):
                plane_sum = np.float32(0)
                for n in range(count):
                    plane_sum += planes[n, i, j]
                finite = np.isfinite(plane_sum)
                total[-1, j] += np.float32(1) if finite else np.float32(0)
                for n in range(count):
                    value[n, j] = planes[n, i, j] if finite else np.float32(0)
            moment = 0
            for a in range(count):
                for b in range(a, count):
                    line, first, second = total[moment], value[a], value[b]
                    for j in range(width):
                        line[j] += first[j] * second[j]
                    moment += 1
        for moment in range(len(sums)):
            for b in range(sums.shape[2]):
                value_sum = np.float32(0)
                for j in range(b * half, min((b + 1) * half, width)):
                    value_sum += total[moment, j]
                sums[moment, bi, b] = value_sum


@compiled("out", axis=1, grain=CELLS, fastmath={"contract"})
def register_planes(start, stop, planes, displacement, weights, out):
    """Read low-passed planes (k, H, W) where each shows the texture, by interpolation between eight samples.

    `displacement` (k, 2, h, w) float64: x and y, in cells, by which a plane shows it farther on, in each block of 4 x 4
    cells. `weights` (8, F) float32: of the samples, by F fractions from one cell to the next. `out`, like `planes`, is
    NaN where a sample is not finite or outside.
    """
    height, width = planes.shape[1:]
    lines = np.empty((CELLS + 7, width), np.float32)
    wx, wy = np.empty((8, width), np.float32), np.empty((8, width), np.float32)
    column_shift, row_shift = np.empty(displacement.shape[3], np.int64), np.empty(displacement.shape[3], np.int64)
    steps = weights.shape[1]
    out[:, start:stop] = np.nan
    for bi in range(start // CELLS, -(-stop // CELLS)):
        for light in range(len(planes)):
            for bj in range(-(-width // CELLS)):
                x, y = displacement[light, 0, bi, bj], displacement[light, 1, bi, bj]
                column_shift[bj], row_shift[bj] = int(np.floor(x)), int(np.floor(y))
                # a place just before a sample is rounded to it
                at_x = min(int((x - column_shift[bj]) * steps), steps - 1)
                at_y = min(int((y - row_shift[bj]) * steps), steps - 1)
                for k in range(8):
                    for j in range(bj * CELLS, min((bj + 1) * CELLS, width)):
                        wx[k, j], wy[k, j] = weights[k, at_x], weights[k, at_y]
            first = 0
            while first < width:  # a run of blocks whose places lie between the same samples
                bj = last = first // CELLS
                while (
                    last * CELLS < width and column_shift[last] == column_shift[bj] and row_shift[last] == row_shift[bj]
                ):
                    last += 1
                i0, j0 = bi * CELLS + row_shift[bj] - 3, column_shift[bj] - 3
                begin, end = max(first, -j0), min(min(last * CELLS, width), width - j0 - 7)
                if i0 >= 0 and i0 + CELLS + 7 <= height:
                    for i in range(CELLS + 7):
                        line = lines[i, begin:end]
                        line[:] = 0
                        for k in range(8):
                            source, weight = planes[light, i0 + i, j0 + k + begin :], wx[k, begin:end]
                            for j in range(line.size):
                                line[j] += weight[j] * source[j]
                    for i in range(CELLS):
                        target = out[light, bi * CELLS + i, begin:end]
                        target[:] = 0
                        for k in range(8):
                            line, weight = lines[i + k, begin:end], wy[k, begin:end]
                            for j in range(target.size):
                                target[j] += weight[j] * line[j]
                first = last * CELLS


@compiled("sums", axis=2, fastmath={"contract"})
def displacement_scores(start, stop, planes, slope, half, sums):
    """Sum ``-r gx``, ``-r gy`` and ``(gx gx + gy gy) / 2`` of each light over blocks of `half` cells.

    `planes` (k, H, W) float32: low-passed planes of the lights, `slope` (k, h, W) float32 their slopes: rows of a grid
    of blocks, widened to the cells. r is a light's plane over its slope minus the mean of the others, g the central
    difference of that mean in a cell. `sums` (k, 3, h, w) float32; what is not finite is left out.
    """
    count, height, width = planes.shape
    fraction, zero = np.float32(1 / (count - 1)), np.float32(0)
    # of the rows of a block, and one above and below
    texture, mean = np.empty((count, half + 2, width), np.float32), np.empty((half + 2, width), np.float32)
    total = np.empty((count, 3, width), np.float32)
    for bi in range(start, stop):
        total[:] = 0
        first, last = max(bi * half, 1), min((bi + 1) * half, height - 1)
        for i in range(first - 1, last + 1):
            low, high, row_fraction = between(i, half, slope.shape[1])
            for light in range(count):
                above, below, line = slope[light, low], slope[light, high], planes[light, i]
                target = texture[light, i - first + 1]
                for j in range(width):
                    target[j] = line[j] / (above[j] + row_fraction * (below[j] - above[j]))
        for light in range(count):
            along_x, along_y, square = total[light]
            for i in range(last - first + 2):
                target = mean[i]
                target[:] = 0
                for other_light in range(count):
                    if other_light != light:
                        line = texture[other_light, i]
                        for j in range(width):
                            target[j] += fraction * line[j]
            for i in range(1, last - first + 1):
                light_row, above, centre, below = texture[light, i], mean[i - 1], mean[i], mean[i + 1]
                for j in range(1, width - 1):
                    r = light_row[j] - centre[j]
                    gx = np.float32(0.5) * (centre[j + 1] - centre[j - 1])
                    gy = np.float32(0.5) * (below[j] - above[j])
                    finite = np.isfinite(r + gx + gy)
                    along_x[j] -= r * gx if finite else zero
                    along_y[j] -= r * gy if finite else zero
                    square[j] += np.float32(0.5) * (gx * gx + gy * gy) if finite else zero
        for light in range(count):
            for n in range(3):
                for b in range(sums.shape[3]):
                    value = np.float32(0)
                    for j in range(b * half, min((b + 1) * half, width)):
                        value += total[light, n, j]
                    sums[light, n, bi, b] = value


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
                other_row = i + di
                if other_row >= rows:
                    continue
                row_colour = 0 if i % 2 == red_row else 2
                other_colour = 0 if other_row % 2 == red_row else 2
                for j in range(max(0, -dj), min(columns, columns - dj)):
                    a = row_colour if (j % 2 == red_column) == (row_colour == 0) else 1
                    b = other_colour if ((j + dj) % 2 == red_column) == (other_colour == 0) else 1
                    product = contrast[i, j] * contrast[other_row, j + dj]
                    if np.isfinite(product):
                        kind = a if a == b else 2 + a + b
                        sums[n, kind] += product
                        counts[n, kind] += 1.0
