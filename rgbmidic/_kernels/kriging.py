"""Compiled loops of the reconstruction by local linear prediction: fixed filters per tile, chosen from a table."""

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.texture import expand_row
from rgbmidic._kernels.threads import over_ranges

__all__ = ["TILE", "fill_unknown", "predict"]

TILE = 16
"""Side in px of the squares within which the filters are the same."""


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
@helper(fastmath={"contract"})
def _add_five(line, c0, c1, c2, c3, c4, total):
    for j in range(total.size):
        total[j] += (
            c0[j] * line[j] + c1[j] * line[j + 1] + c2[j] * line[j + 2] + c3[j] * line[j + 3] + c4[j] * line[j + 4]
        )


@helper(fastmath={"contract"})
def _add_one(line, c, total):
    for j in range(total.size):
        total[j] += c[j] * line[j]


@helper()
def _add_taps(line, lines, k, size, total):
    """Add the products of a row of samples with the `size` filters `lines` from the k-th, five at a time."""
    b = 0
    while b + 5 <= size:
        _add_five(line[b:], lines[k + b], lines[k + b + 1], lines[k + b + 2], lines[k + b + 3], lines[k + b + 4], total)
        b += 5
    while b < size:
        _add_one(line[b:], lines[k + b], total)
        b += 1


@helper()
def _spread(taps, index, row, parity, output, lines):
    """Filters of a row of tiles, tap by tap, written out along the pixels: `lines` (size², 16 w)."""
    for tile in range(index.shape[1]):
        chosen = index[row, tile]
        for k in range(lines.shape[0]):
            for j in range(TILE):
                lines[k, tile * TILE + j] = taps[chosen, parity, output, k, j]


@over_ranges("index")
@compiled(fastmath={"contract"})
def predict(start, stop, padded, index, taps, size, scale, scale_block, mean, mean_block, out):
    """Channels from the scaled contrast: ``out = mean + scale * sum of taps x samples around``.

    Parameters
    ----------
    padded : (H + 2 pad, 16 w + 2 pad) float32
        Scaled contrast, finite, with pad = size // 2.
    index : (h, w) int32
        Which filters each tile of 16 x 16 px uses.
    taps : (T, 2, n, size², 16) float32
        By row parity, output and tap; the last axis runs over the columns of the tile, which alternate between two
        phases.
    scale, mean : (n, gh, gw) float32
        Grids of `scale_block` and `mean_block` px.
    out : (n, H, W) float32
    """
    outputs, rows, columns = out.shape
    width = index.shape[1] * TILE
    for ti in range(start, stop):
        lines = np.empty((size * size, width), dtype=np.float32)
        total, level, gain = np.empty(width, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
        scratch_scale, scratch_mean = np.empty(scale.shape[2], np.float32), np.empty(mean.shape[2], np.float32)
        for n in range(outputs):
            for parity in range(2):
                _spread(taps, index, ti, parity, n, lines)
                for i in range(ti * TILE + parity, min((ti + 1) * TILE, rows), 2):
                    for j in range(width):
                        total[j] = 0.0
                    for a in range(size):
                        _add_taps(padded[i + a], lines, a * size, size, total)
                    expand_row(scale[n], i, scale_block, scratch_scale, gain)
                    expand_row(mean[n], i, mean_block, scratch_mean, level)
                    target = out[n, i]
                    for j in range(columns):
                        target[j] = level[j] + gain[j] * total[j]
