"""From a Bayer mosaic to channels, from channels to lights, and from the lights' residuals to weights and scores.

The mosaic comes padded by two pixels on every side, mirrored about the border pixel, which keeps the Bayer phase; a
sample that must not be used is NaN there and spreads to all it takes part in. ``red_row, red_column`` are the position
of red in the 2x2 cell of the unpadded mosaic; blue is diagonal to it.
"""

import numpy as np

from rgbmidic._kernels.interpolation import _FAST
from rgbmidic._kernels.threads import compiled, helper, over_ranges

__all__ = ["PAD", "best_mean", "gradient_of_others", "malvar", "pad_mosaic", "robust_weights", "scores", "unmix"]

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
