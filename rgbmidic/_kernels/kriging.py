"""Compiled loops of the reconstruction by local linear prediction: fixed filters per tile, chosen from a table."""

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.texture import between
from rgbmidic._kernels.threads import over_ranges

__all__ = ["TILE", "fill_unknown", "predict"]

TILE = 16
"""Side in px of the squares within which the filters are the same."""
_SIZE = 5
"""Usual side of the square of samples, whose taps are added in one go."""
_STRIP = 256
"""Columns at a time: what a core's caches hold of their filters."""


@helper()
def _channel(i, j, red_row, red_column):
    if i % 2 == red_row:
        return 0 if j % 2 == red_column else 1
    return 1 if j % 2 == red_column else 2


@over_ranges("out")
@compiled()
def fill_unknown(start, stop, padded, share, red_row, red_column, pad, out, unknown):
    """Replace samples that are NaN by what the known ones around tell of the common texture.

    `padded` as written by `scaled_contrast`; `share` (3, h, w) is the share of the common texture in each tile. `out`,
    a copy of `padded`, receives ``sqrt(share) * texture``; where too little is known within one pixel it receives 0
    and `unknown` (like `padded`) is set.
    """
    height, width = padded.shape
    for i in range(start, stop):
        for j in range(width):
            if np.isfinite(padded[i, j]):
                continue
            ti = min(max(i - pad, 0) // TILE, share.shape[1] - 1)
            tj = min(max(j - pad, 0) // TILE, share.shape[2] - 1)
            total = weight = near = 0.0
            for a in range(max(i - 2, 0), min(i + 3, height)):
                for b in range(max(j - 2, 0), min(j + 3, width)):
                    if np.isfinite(padded[a, b]):
                        s = share[_channel(a - pad, b - pad, red_row, red_column), ti, tj]
                        distance = (a - i) ** 2 + (b - j) ** 2
                        w = np.exp(-0.8 * distance)
                        total += w * np.sqrt(s) * padded[a, b]
                        weight += w * s
                        near += s if distance <= 2 else 0.0
            own = share[_channel(i - pad, j - pad, red_row, red_column), ti, tj]
            out[i, j] = np.sqrt(own) * total / weight if near > 0.5 else 0.0
            unknown[i, j] = near <= 0.5


# contraction to fused multiply-add alone: NaN and infinity keep their meaning
@helper(fastmath={"contract"}, forceinline=True)
def _filtered(r0, r1, r2, r3, r4, lines, out):
    """Sum of the products of five rows of samples with the taps `lines` (25, _STRIP)."""
    for j in range(out.size):
        total = np.float32(0.0)
        for b in range(_SIZE):
            upper = lines[b, j] * r0[j + b] + lines[_SIZE + b, j] * r1[j + b]
            lower = lines[3 * _SIZE + b, j] * r3[j + b] + lines[4 * _SIZE + b, j] * r4[j + b]
            total += upper + lines[2 * _SIZE + b, j] * r2[j + b] + lower
        out[j] = total


@helper(fastmath={"contract"}, forceinline=True)
def _add_tap(row, line, out):
    for j in range(out.size):
        out[j] += line[j] * row[j]


@helper()
def _spread(taps, parity, channel, index, first, lines):
    """Filters of tiles, tap by tap, written out along the pixels from the tile `first` on."""
    for tile in range(first, min(first + _STRIP // TILE, index.size)):
        chosen = taps[index[tile], parity, channel]
        for k in range(lines.shape[0]):
            source, line = chosen[k], lines[k, (tile - first) * TILE :]
            for j in range(TILE):
                line[j] = source[j]


@over_ranges("index")
@compiled(fastmath={"contract"})
def predict(start, stop, padded, index, taps, size, scale, scale_block, mean, mean_block, mixing, out):
    """Mixtures of the channels ``mean + scale * sum of taps x samples around`` from the scaled contrast.

    Parameters
    ----------
    padded : (H + 2 pad, 16 w + 2 pad) float32
        Scaled contrast, finite, with pad = size // 2.
    index : (h, w) int32
        Which filters each tile of 16 x 16 px uses.
    taps : (T, 2, 3, size², 16) float32
        By row parity, channel and tap; the last axis runs over the columns of the tile, which alternate between two
        phases.
    scale, mean : (3, h, W) float32
        Rows of grids of `scale_block` and `mean_block` px, widened to the pixels.
    mixing : (n, 3) float32
    out : (n, H, W) float32
    """
    rows, columns = out.shape[1:]
    lines, channels = np.empty((size * size, _STRIP), np.float32), np.empty((3, TILE, _STRIP), np.float32)
    for ti in range(start, stop):
        top, bottom = ti * TILE, min((ti + 1) * TILE, rows)
        for left in range(0, columns, _STRIP):
            number = min(_STRIP, columns - left)
            for c in range(3):
                for parity in range(2):
                    _spread(taps, parity, c, index[ti], left // TILE, lines)
                    for i in range(top + parity, bottom, 2):
                        made = channels[c, i - top, :number]
                        if size == _SIZE:
                            _filtered(
                                padded[i, left:],
                                padded[i + 1, left:],
                                padded[i + 2, left:],
                                padded[i + 3, left:],
                                padded[i + 4, left:],
                                lines,
                                made,
                            )
                        else:
                            for j in range(number):
                                made[j] = 0
                            for k in range(size * size):
                                _add_tap(padded[i + k // size, left + k % size :], lines[k], made)
                        low, high, part = between(i, mean_block, mean.shape[1])
                        above, below = mean[c, low, left:], mean[c, high, left:]
                        low, high, ahead = between(i, scale_block, scale.shape[1])
                        gain, other = scale[c, low, left:], scale[c, high, left:]
                        for j in range(number):
                            level = above[j] + part * (below[j] - above[j])
                            made[j] = level + (gain[j] + ahead * (other[j] - gain[j])) * made[j]
            for n in range(len(out)):
                red, green, blue = mixing[n]
                for i in range(top, bottom):
                    r, g, b, target = channels[0, i - top], channels[1, i - top], channels[2, i - top], out[n, i, left:]
                    for j in range(number):
                        target[j] = red * r[j] + green * g[j] + blue * b[j]
