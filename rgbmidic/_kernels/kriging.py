"""Compiled loops of the reconstruction by local linear prediction: fixed filters per tile, chosen from a table."""

import numpy as np
from numba import njit, prange

from rgbmidic._kernels.texture import expand_row

__all__ = ["TILE", "fill_unknown", "predict"]

TILE = 16
"""Side in px of the squares within which the filters are the same."""


@njit(cache=True, inline="always")
def _channel(i, j, red_row, red_column):
    if i % 2 == red_row:
        return 0 if j % 2 == red_column else 1
    return 1 if j % 2 == red_column else 2


@njit(cache=True, parallel=True, nogil=True)
def fill_unknown(padded, share, red_row, red_column, pad, out, unknown):
    """Replace samples that are NaN by what the known ones around tell of the common texture.

    `padded` as written by `scaled_contrast`; `share` (3, h, w) is the share of the common texture in each tile. `out`,
    a copy of `padded`, receives ``sqrt(share) * texture``; where too little is known within one pixel it receives 0
    and `unknown` (like `padded`) is set.
    """
    height, width = padded.shape
    for i in prange(height):
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
@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_five(line, c0, c1, c2, c3, c4, total):
    for j in range(total.size):
        total[j] += (
            c0[j] * line[j] + c1[j] * line[j + 1] + c2[j] * line[j + 2] + c3[j] * line[j + 3] + c4[j] * line[j + 4]
        )


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_one(line, c, total):
    for j in range(total.size):
        total[j] += c[j] * line[j]


@njit(cache=True, nogil=True)
def _spread(taps, index, parity, output, lines):
    """Filters of a row of tiles, tap by tap, written out along the pixels: `lines` (size², 16 w)."""
    for tile in range(index.size):
        chosen = taps[index[tile], parity, output]
        for k in range(lines.shape[0]):
            target, source = lines[k, tile * TILE : (tile + 1) * TILE], chosen[k]
            for j in range(target.size):
                target[j] = source[j]


@njit(cache=True, parallel=True, nogil=True, fastmath={"contract"})
def predict(padded, index, taps, size, scale, scale_block, mean, mean_block, out):
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
    for ti in prange(index.shape[0]):
        lines = np.empty((size * size, width), dtype=np.float32)
        total, level, gain = np.empty(width, np.float32), np.empty(columns, np.float32), np.empty(columns, np.float32)
        scratch_scale, scratch_mean = np.empty(scale.shape[2], np.float32), np.empty(mean.shape[2], np.float32)
        for n in range(outputs):
            for parity in range(2):
                _spread(taps, index[ti], parity, n, lines)
                for i in range(ti * TILE + parity, min((ti + 1) * TILE, rows), 2):
                    total[:] = 0.0
                    for a in range(size):
                        b = 0
                        while b + 5 <= size:
                            k = a * size + b
                            _add_five(
                                padded[i + a, b:],
                                lines[k],
                                lines[k + 1],
                                lines[k + 2],
                                lines[k + 3],
                                lines[k + 4],
                                total,
                            )
                            b += 5
                        while b < size:
                            _add_one(padded[i + a, b:], lines[a * size + b], total)
                            b += 1
                    expand_row(scale[n], i, scale_block, scratch_scale, gain)
                    expand_row(mean[n], i, mean_block, scratch_mean, level)
                    target = out[n, i]
                    for j in range(columns):
                        target[j] = level[j] + gain[j] * total[j]
