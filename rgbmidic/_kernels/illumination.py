"""From a Bayer mosaic to channels, from channels to lights, and from the lights' residuals to weights and scores.

The mosaic comes padded by two pixels on every side, mirrored about the border pixel, which keeps the Bayer phase; a
sample that must not be used is NaN there and spreads to all it takes part in. ``red_row, red_column`` are the position
of red in the 2x2 cell of the unpadded mosaic; blue is diagonal to it.

Grids hold one value per square block of pixels and stand for the block's centre; between the centres they are
interpolated linearly, beyond the outermost they are constant.
"""

import numpy as np

from rgbmidic._kernels.interpolation import _FAST, between
from rgbmidic._kernels.threads import compiled, helper, over_ranges

BLOCK = 4096
"""Pixels at a time: what a core's fastest cache holds."""


@over_ranges("out", axis=1)
@compiled()
def unmix(start, stop, channels, valid, grid, step, needed, out, out_valid):
    """``out = matrix(x, y) @ channels`` with the matrix interpolated linearly between grid points `step` px apart.

    channels, valid: (C, H, W); grid: (GY, GX, k, C) at x, y = 0, step, 2 step ... beyond the last pixel; needed:
    (k, C); out, out_valid: (k, H, W). Invalid where a `needed` channel is; one not needed
    contributes the value it has, NaN nothing.
    """
    colours, lights, width = channels.shape[0], out.shape[0], out.shape[2]
    for y in range(start, stop):
        gy = y // step
        down = np.float32(y - gy * step) / np.float32(step)
        for light in range(lights):
            values, ok = out[light, y], out_valid[light, y]
            for x in range(np.uint64(width)):
                values[x] = 0.0
            for x in range(np.uint64(width)):
                ok[x] = True
            for colour in range(colours):
                given, known = channels[colour, y], valid[colour, y]
                for gx in range((width + step - 1) // step):
                    first, number = np.uint64(gx * step), np.uint64(min(step, width - gx * step))
                    above, below = grid[gy, gx, light, colour], grid[gy + 1, gx, light, colour]
                    left = above + (below - above) * down
                    above, below = grid[gy, gx + 1, light, colour], grid[gy + 1, gx + 1, light, colour]
                    slope = (above + (below - above) * down - left) / np.float32(step)
                    for i in range(number):
                        factor, value = left + slope * np.float32(np.int32(i)), given[first + i]
                        values[first + i] += factor * value if np.isfinite(value) else np.float32(0.0)
                if needed[light, colour]:
                    for x in range(np.uint64(width)):
                        ok[x] &= known[x]
            for x in range(np.uint64(width)):
                values[x] = values[x] if ok[x] else np.float32(np.nan)


PAD = 2
"""Pixels added on every side by `pad_mosaic`."""


@helper()
def _mirror(index, size):
    period = 2 * (size - 1)
    index = abs(index) % period
    return min(index, period - index)


@over_ranges("out")
@compiled()
def pad_mosaic(start, stop, values, invalid, out):
    """Copy (H, W) `values` into (H + 4, W + 4) `out`, mirrored at the borders, NaN where `invalid`; H, W >= 2."""
    rows, columns = values.shape
    for i in range(start, stop):
        source = _mirror(i - PAD, rows)
        for j in range(columns):
            out[i, j + PAD] = np.nan if invalid[source, j] else values[source, j]
        for side in range(PAD):
            left = _mirror(side - PAD, columns)
            right = _mirror(columns + side, columns)
            out[i, side] = np.nan if invalid[source, left] else values[source, left]
            out[i, columns + PAD + side] = np.nan if invalid[source, right] else values[source, right]


@over_ranges("out", axis=1)
@compiled()
def malvar(start, stop, padded, red_row, red_column, out):
    """Bilinear average corrected by the Laplacian of the sampled channel (Malvar 2004); fills (3, H, W) `out`."""
    columns = out.shape[2]
    for i in range(start, stop):
        above2, above, here, below, below2 = padded[i], padded[i + 1], padded[i + 2], padded[i + 3], padded[i + 4]
        in_red_row = i % 2 == red_row
        own = 0 if in_red_row else 2
        own_start = red_column if in_red_row else 1 - red_column
        own_out, green_out, other_out = out[own, i], out[1, i], out[2 - own, i]
        for j in range(own_start, columns, 2):
            c = j + PAD
            centre = here[c]
            cross = above[c] + below[c] + here[c - 1] + here[c + 1]
            far = above2[c] + below2[c] + here[c - 2] + here[c + 2]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            own_out[j] = centre
            green_out[j] = 0.125 * (4 * centre + 2 * cross - far)
            other_out[j] = 0.125 * (6 * centre + 2 * diagonal - 1.5 * far)
        for j in range(1 - own_start, columns, 2):
            c = j + PAD
            centre = here[c]
            across, along = here[c - 1] + here[c + 1], above[c] + below[c]
            across2, along2 = here[c - 2] + here[c + 2], above2[c] + below2[c]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            own_out[j] = 0.125 * (5 * centre + 4 * across - across2 - diagonal + 0.5 * along2)
            green_out[j] = centre
            other_out[j] = 0.125 * (5 * centre + 4 * along - along2 - diagonal + 0.5 * across2)


_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)


@over_ranges("mean", axis=1, grain=BLOCK)
@compiled(fastmath=_FAST)
def gradient_of_others(start, stop, gradient, weights, light, fewest, mean, products):
    """Mean gradient of the lights other than `light`, and its products with that light's own.

    For gradients (2, k, P) and weights (k, P): `mean` (2, P) receives the mean of the others that have weight; where
    they are fewer than `fewest`, that of all that have. `products` (4, P) receives own times mean, mean times mean, own
    times own and 1, all 0 where the light has no weight.
    """
    count, less, total = np.empty((3, BLOCK), dtype=np.float32)
    own, lights = np.uint64(light), np.uint64(len(weights))
    for block in range(start, stop, BLOCK):
        first, number = np.uint64(block), np.uint64(min(BLOCK, stop - block))
        for i in range(number):
            count[i] = _ZERO
        for j in range(lights):
            for i in range(number):
                count[i] += _ONE if weights[j, first + i] > _ZERO else _ZERO
        for i in range(number):
            seen = _ONE if weights[own, first + i] > _ZERO else _ZERO
            less[i] = seen if count[i] - seen >= fewest else _ZERO
            products[3, first + i] = seen
        for axis in range(np.uint64(2)):
            for i in range(number):
                total[i] = _ZERO
            for j in range(lights):
                for i in range(number):
                    total[i] += gradient[axis, j, first + i] if weights[j, first + i] > _ZERO else _ZERO
            for i in range(number):
                slope = gradient[axis, own, first + i]
                mean[axis, first + i] = (total[i] - less[i] * slope) / max(count[i] - less[i], _ONE)
        for i in range(number):
            seen, x, y = products[3, first + i], gradient[0, own, first + i], gradient[1, own, first + i]
            u, v = mean[0, first + i], mean[1, first + i]
            products[0, first + i] = seen * (x * u + y * v)
            products[1, first + i] = seen * (u * u + v * v)
            products[2, first + i] = seen * (x * x + y * y)


@over_ranges("fraction", axis=1, grain=BLOCK)
@compiled(fastmath=_FAST)
def best_mean(start, stop, fraction, weights, difference, mean, used, square):
    """Turn `fraction` (k, P) into the fractions of the lights in a mean: none below 0 or without weight, their sum 1.

    `mean` (P,) receives that of `difference` (k, P), `square` (P,) its square, and `used` (P,) 1 where a light has a
    fraction, else 0.
    """
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        total, result = used[chunk], mean[chunk]
        total[:] = 0
        result[:] = 0
        for light in range(len(fraction)):
            own, weight = fraction[light, chunk], weights[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = max(own[i], _ZERO) if weight[i] > _ZERO else _ZERO
                total[i] += own[i]
        for light in range(len(fraction)):
            own, value = fraction[light, chunk], difference[light, chunk]
            for i in range(np.uint64(total.size)):
                own[i] = own[i] / total[i] if total[i] > _ZERO else _ZERO
                result[i] += own[i] * value[i]
        for i in range(np.uint64(total.size)):
            total[i] = _ONE if total[i] > _ZERO else _ZERO
        squares = square[chunk]
        for i in range(np.uint64(total.size)):
            squares[i] = result[i] * result[i]


@over_ranges("fraction", axis=1, grain=BLOCK)
@compiled(fastmath=_FAST)
def robust_weights(start, stop, mean, variance, displacing, unit, freedom, fraction, bend):
    """Multiply `fraction` (k, P) by the robust weight of the lights' `mean` residual (P,); the loss's `bend` (P,).

    Its `variance` (P,) is that around the pixel, `displacing` (P,) the fraction of it that counts, in units of `unit`;
    the weight is its inverse to the power .75 times that of a Student distribution of so many degrees of `freedom`.
    """
    factor = np.empty(BLOCK, dtype=np.float32)
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        value, around, part, curved = mean[chunk], variance[chunk], displacing[chunk], bend[chunk]
        for i in range(np.uint64(value.size)):
            ratio = value[i] * value[i] / around[i]
            precision = unit / (part[i] * around[i])
            curved[i] = (freedom - ratio) / (freedom + ratio)
            factor[i] = np.sqrt(precision * np.sqrt(precision)) * (freedom + _ONE) / (freedom + ratio)
        for light in range(len(fraction)):
            own = fraction[light, chunk]
            for i in range(np.uint64(own.size)):
                own[i] *= factor[i]


@over_ranges("out", axis=1, grain=BLOCK)
@compiled(fastmath=_FAST)
def scores(start, stop, residual, weights, gradient_x, gradient_y, out):
    """Sum ``w r gx``, ``w r gy`` and ``w (gx gx + gy gy)`` over the lights.

    ``out`` (4, P) receives the sums of fields (k, P), and 1 where a light has weight, else 0.
    """
    for first in range(start, stop, BLOCK):
        chunk = slice(first, min(first + BLOCK, stop))
        x, y, information, used = out[0, chunk], out[1, chunk], out[2, chunk], out[3, chunk]
        out[:, chunk] = 0
        for light in range(len(weights)):
            r, w = residual[light, chunk], weights[light, chunk]
            gx, gy = gradient_x[light, chunk], gradient_y[light, chunk]
            # loops that write to one place each: a loop over many arrays is not vectorised
            for i in range(np.uint64(x.size)):
                x[i] += w[i] * r[i] * gx[i]
            for i in range(np.uint64(x.size)):
                y[i] += w[i] * r[i] * gy[i]
            for i in range(np.uint64(x.size)):
                information[i] += w[i] * (gx[i] * gx[i] + gy[i] * gy[i])
            for i in range(np.uint64(x.size)):
                used[i] = max(used[i], _ONE if w[i] > _ZERO else _ZERO)


REACH = 3
"""Rows and columns beyond a cell that its binomial sums reach."""
PLANE_PAIRS = tuple((p, q) for p in range(4) for q in range(p, 4))
"""Pairs of the planes of a mosaic; plane 2 a + b has the samples of row a and column b of the 2x2 cells."""
_CELLS = 128
"""Cells of a row at a time."""


@over_ranges("sums", axis=1)
@compiled()
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


@over_ranges("out")
@compiled()
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


@over_ranges("out")
@compiled()
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


@over_ranges("out")
@compiled()
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
        for j in range(columns + pad, target.size):
            target[j] = 0.0


@helper(fastmath={"contract"})
def _down(above, here, below, first, last, planes, number):
    """Binomial sums of three rows of a mosaic, of their even and of their odd columns."""
    ten = np.float32(10)
    for c in range(np.uint64(number)):
        j = np.uint64(2) * c
        planes[0, c] = first * above[j] + ten * here[j] + last * below[j]
        j += np.uint64(1)
        planes[1, c] = first * above[j] + ten * here[j] + last * below[j]


@over_ranges("sums", axis=1)
@compiled(fastmath={"contract"})
def cell_moments(start, stop, contrast, block, sums):
    """Second moments of the four planes' low-passed contrast, summed over the cells of each block.

    At the middle of each 2x2 cell the binomial [1 5 10 10 5 1] along both axes takes from each plane its own share,
    with the same weight and the same centroid. `sums` (11, h, w) float32 receives the products of the planes in the
    order of `PLANE_PAIRS`, then the number of cells; a cell with a sample that is not finite in reach is left out.
    """
    rows, columns = contrast.shape
    half = block // 2
    one, five, ten = np.float32(1), np.float32(5), np.float32(10)
    planes, total = np.empty((4, _CELLS + 2), np.float32), np.empty((11, _CELLS), np.float32)
    for bi in range(start, stop):
        for left in range(0, half * sums.shape[2], _CELLS):
            for moment in range(11):
                for c in range(_CELLS):
                    total[moment, c] = 0
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
                    q0, q1 = p0 if known else np.float32(0), p1 if known else np.float32(0)
                    q2, q3 = p2 if known else np.float32(0), p3 if known else np.float32(0)
                    total[0, c] += q0 * q0
                    total[1, c] += q0 * q1
                    total[2, c] += q0 * q2
                    total[3, c] += q0 * q3
                    total[4, c] += q1 * q1
                    total[5, c] += q1 * q2
                    total[6, c] += q1 * q3
                    total[7, c] += q2 * q2
                    total[8, c] += q2 * q3
                    total[9, c] += q3 * q3
                    total[10, c] += one if known else np.float32(0)
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
