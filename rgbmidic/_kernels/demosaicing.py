"""Demosaicing by local linear prediction: its filters, the prediction, and what the lights' displacement is read from.

The filters are fixed in a tile, chosen from a table.
"""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.texture import between
from rgbmidic._kernels.threads import FAST, compiled, helper

TILE = 32
"""Side in px of the squares within which the filters are the same."""
_SIZE, _WIDE = 5, 7
"""Sides of the square of samples: the usual one, whose taps are added in one go, and the wide one."""
_STRIP = 256
"""Columns at a time: what a core's caches hold of their filters."""


@helper()
def _channel(i, j, red_row, red_column):
    if i % 2 == red_row:
        return 0 if j % 2 == red_column else 1
    return 1 if j % 2 == red_column else 2


@compiled("out")
def fill_unknown(start, stop, padded, fraction, red_row, red_column, pad, out, unknown):
    """Replace samples that are NaN by the common texture predicted from the known ones around.

    `padded` as written by `scaled_contrast`; `fraction` (3, h, w) is that of the common texture in each tile. `out`,
    a copy of `padded`, receives ``sqrt(fraction) * texture``; where too little is known within one pixel it receives 0
    and `unknown` (like `padded`) is set.
    """
    height, width = padded.shape
    for i in range(start, stop):
        for j in range(width):
            if np.isfinite(padded[i, j]):
                continue
            ti = min(max(i - pad, 0) // TILE, fraction.shape[1] - 1)
            tj = min(max(j - pad, 0) // TILE, fraction.shape[2] - 1)
            total = weight = near = 0.0
            for a in range(max(i - 2, 0), min(i + 3, height)):
                for b in range(max(j - 2, 0), min(j + 3, width)):
                    if np.isfinite(padded[a, b]):
                        s = fraction[_channel(a - pad, b - pad, red_row, red_column), ti, tj]
                        distance = (a - i) ** 2 + (b - j) ** 2
                        w = np.exp(-0.8 * distance)
                        total += w * np.sqrt(s) * padded[a, b]
                        weight += w * s
                        near += s if distance <= 2 else 0.0
            pixel_fraction = fraction[_channel(i - pad, j - pad, red_row, red_column), ti, tj]
            out[i, j] = np.sqrt(pixel_fraction) * total / weight if near > 0.5 else 0.0
            unknown[i, j] = near <= 0.5


# contraction to fused multiply-add alone: NaN and infinity keep their meaning
@helper(fastmath={"contract"}, forceinline=True)
def _filtered(padded, row, first_column, lines, out):
    """Sum of the products of five rows of samples, from a place on, with the taps `lines` (25, _STRIP)."""
    r0, r1, r2 = padded[row, first_column:], padded[row + 1, first_column:], padded[row + 2, first_column:]
    r3, r4 = padded[row + 3, first_column:], padded[row + 4, first_column:]
    for j in range(out.size):
        total = np.float32(0.0)
        for b in range(_SIZE):
            upper = lines[b, j] * r0[j + b] + lines[_SIZE + b, j] * r1[j + b]
            lower = lines[3 * _SIZE + b, j] * r3[j + b] + lines[4 * _SIZE + b, j] * r4[j + b]
            total += upper + lines[2 * _SIZE + b, j] * r2[j + b] + lower
        out[j] = total


@helper(fastmath={"contract"}, forceinline=True)
def _add_row(row, lines, out):
    """Add the products of a row of samples with a row of the taps of the wide square, (7, _STRIP)."""
    for j in range(out.size):
        total = out[j]
        for b in range(_WIDE):
            total += lines[b, j] * row[j + b]
        out[j] = total


@helper()
def _spread(taps, parity, channel, index, first, lines):
    """Write the filters of tiles, tap by tap, along the pixels from the tile `first` on."""
    for tile in range(first, min(first + lines.shape[1] // TILE, index.size)):
        tile_taps = taps[index[tile], parity, channel]
        for k in range(lines.shape[0]):
            even_tap, odd_tap, line = tile_taps[k, 0], tile_taps[k, 1], lines[k, (tile - first) * TILE :]
            for j in range(TILE // 2):
                line[2 * j], line[2 * j + 1] = even_tap, odd_tap


@compiled("index", fastmath={"contract"})
def predict(start, stop, padded, index, taps, size, scale, scale_block, mean, mean_block, mixing, out):
    """Mixtures of the channels ``mean + scale * sum of taps x samples around`` from the scaled contrast.

    Parameters
    ----------
    start, stop
        Range of rows of tiles that this call does.
    size
        Side of the square of samples, px: 5 or 7.
    padded : (H + 2 pad, 32 w + 2 pad) float32
        Scaled contrast, finite, with pad = size // 2.
    index : (h, w) int32
        Which filters each tile of 32 x 32 px uses.
    taps : (T, 2, 3, size², 2) float32
        By row parity, channel, tap and column parity.
    scale, mean : (3, h, W) float32
        Rows of grids, widened to the pixels.
    scale_block, mean_block
        Sides of their blocks, px.
    mixing : (n, 3) float32
        Factors of the channels in each output.
    out : (n, H, W) float32
        Written: the mixtures.
    """
    rows, columns = out.shape[1:]
    strip = _STRIP if size == _SIZE else _STRIP // 2
    lines, channels = np.empty((size * size, strip), np.float32), np.empty((3, TILE, strip), np.float32)
    for ti in range(start, stop):
        top, bottom = ti * TILE, min((ti + 1) * TILE, rows)
        for first_column in range(0, columns, strip):
            number = min(strip, columns - first_column)
            for c in range(3):
                for parity in range(2):
                    _spread(taps, parity, c, index[ti], first_column // TILE, lines)
                    for i in range(top + parity, bottom, 2):
                        filtered = channels[c, i - top, :number]
                        if size == _SIZE:
                            _filtered(padded, i, first_column, lines, filtered)
                        else:
                            filtered[:] = 0
                            for k in range(_WIDE):
                                _add_row(padded[i + k, first_column:], lines[k * _WIDE : (k + 1) * _WIDE], filtered)
                        low, high, mean_fraction = between(i, mean_block, mean.shape[1])
                        above, below = mean[c, low, first_column:], mean[c, high, first_column:]
                        low, high, scale_fraction = between(i, scale_block, scale.shape[1])
                        gain_above, gain_below = scale[c, low, first_column:], scale[c, high, first_column:]
                        for j in range(number):
                            level = above[j] + mean_fraction * (below[j] - above[j])
                            gain = gain_above[j] + scale_fraction * (gain_below[j] - gain_above[j])
                            filtered[j] = level + gain * filtered[j]
            for n in range(len(out)):
                red, green, blue = mixing[n]
                for i in range(top, bottom):
                    r, g, b = channels[0, i - top], channels[1, i - top], channels[2, i - top]
                    target = out[n, i, first_column:]
                    for j in range(number):
                        target[j] = red * r[j] + green * g[j] + blue * b[j]


@compiled("out", min_size=0, fastmath=FAST)
def prediction_taps(
    start,
    stop,
    light_fraction,
    spread,
    specific,
    coloured,
    light_correlation,
    displacement,
    noise,
    held,
    texture,
    step,
    fine,
    offset,
    sites,
    out,
):
    """Filters of the best linear prediction (simple kriging) from a square of samples, for T entries of a table.

    The contrast at site s over its channel's slope is ``sum_l F_sl (a_l + a_0 + sqrt(specific_l) e_l)`` and noise, with
    F the `light_fraction`: lights l show the texture displaced, with the covariance ``R_lm C(x - y - d_l + d_m)`` and
    R the `light_correlation`, a_0 is an unknown constant of variance `offset`, e_l the light's own component. Predicted
    are the channels, green as the mean of its two sites. Samples and channels are divided by their channel's `spread`.

    Parameters
    ----------
    start, stop
        Range of entries that this call does.
    light_fraction : (4, k) float64
        Of the sites red, green in red rows, green in blue rows, and blue.
    spread : (T, 4) float64
        Standard deviation of the sites' channels, without noise.
    specific : (T, k) float64
        Variance of the lights' own components.
    coloured
        Fraction of them that is the channels', which have nothing in common on a coloured specimen.
    light_correlation : (T, k, k) float64
        Correlations of the lights' textures.
    displacement : (T, k, 2) float64
        d in x and y, px.
    noise : (T, 3) float64
        Variance of a sample of each channel.
    held
        Variance that the sample in the middle has besides: a large one leaves it out.
    texture : (n,) float64
        C at the squared distances 0, `step`, 2 `step` ... px².
    step
        px².
    fine : (2 size - 1, 2 size - 1) float64
        Covariance of a light's own component by the distance in rows and columns.
    offset
        Variance.
    sites : (4, size, size) int64
        Of the samples, for each phase of the middle one in the 2 x 2 cell.
    out : (T, 4, 3, size, size) float64
        Written.
    """
    lights, size, count = light_fraction.shape[1], np.uint64(sites.shape[1]), np.uint64(sites[0].size)
    one, two, sides = np.uint64(1), np.uint64(2), np.uint64(fine.shape[0])
    reach, half = size - one, size // two
    covariance, lagged = np.empty((4, 4, fine.shape[0], fine.shape[0])), np.empty(fine.shape)
    matrix, factor, rhs = np.empty((count, count)), np.empty((count, count)), np.empty((3, count))
    per_step, last = 1 / step, texture.size - 1.001
    for entry in range(start, stop):
        for c in range(4):
            for e in range(4):
                constant = amplitude = 0.0
                if (c + 1) // 2 == (e + 1) // 2:
                    amplitude = coloured * (spread[entry, c] ** 2 - 1)
                for a in range(lights):
                    amplitude += (1 - coloured) * light_fraction[c, a] * light_fraction[e, a] * specific[entry, a]
                    for b in range(lights):
                        constant += light_fraction[c, a] * light_fraction[e, b] * offset
                for i in range(sides):
                    for j in range(sides):
                        covariance[c, e, i, j] = constant + amplitude * fine[i, j]
        for a in range(lights):
            for b in range(lights):
                x = displacement[entry, b, 0] - displacement[entry, a, 0] - reach
                y = displacement[entry, b, 1] - displacement[entry, a, 1] - reach
                for i in range(sides):
                    for j in range(sides):
                        position = min(((x + j) ** 2 + (y + i) ** 2) * per_step, last)
                        low = np.uint64(position)
                        lagged[i, j] = texture[low] + (position - low) * (texture[low + one] - texture[low])
                for c in range(4):
                    for e in range(4):
                        amplitude = light_fraction[c, a] * light_fraction[e, b] * light_correlation[entry, a, b]
                        for i in range(sides):
                            for j in range(sides):
                                covariance[c, e, i, j] += amplitude * lagged[i, j]
        for c in range(4):
            for e in range(4):
                scale = 1 / (spread[entry, c] * spread[entry, e])
                for i in range(sides):
                    for j in range(sides):
                        covariance[c, e, i, j] *= scale
        for phase in range(4):
            for m in range(count):
                row, column = m // size, m % size
                c = sites[phase, row, column]
                for other_row in range(row + one):
                    for n in range(size):
                        e = sites[phase, other_row, n]
                        matrix[m, other_row * size + n] = covariance[c, e, row + reach - other_row, column + reach - n]
                matrix[m, m] += noise[entry, (c + 1) // 2]
                below, right = row + reach - half, column + reach - half
                rhs[0, m] = covariance[c, 0, below, right]
                rhs[1, m] = (covariance[c, 1, below, right] + covariance[c, 2, below, right]) / 2
                rhs[2, m] = covariance[c, 3, below, right]
            middle = count // two
            matrix[middle, middle] += held
            for q in range(count):  # Cholesky, column by column
                scale = 1 / np.sqrt(matrix[q, q])
                for m in range(q, count):
                    factor[q, m] = matrix[m, q] * scale
                for m in range(q + one, count):
                    for n in range(q + one, m + one):
                        matrix[m, n] -= factor[q, m] * factor[q, n]
                for e in range(3):
                    rhs[e, q] *= scale
                    for m in range(q + one, count):
                        rhs[e, m] -= rhs[e, q] * factor[q, m]
            for e in range(3):
                for back in range(count):
                    p = count - one - back
                    value = rhs[e, p]
                    for m in range(p + one, count):
                        value -= factor[p, m] * rhs[e, m]
                    rhs[e, p] = value / factor[p, p]
                    out[entry, phase, e, p // size, p % size] = rhs[e, p]
