"""Cubic B-spline interpolation: prefilter and evaluation (Unser, IEEE Signal Process. Mag. 16(6), 1999)."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

__all__ = ["PAD", "bspline_coefficients", "sample_with_gradient"]

PAD = 2
"""Rows and columns by which the coefficient array exceeds the image on every side."""

_POLE = np.float32(np.sqrt(3.0) - 2.0)
_GAIN = np.float32(6.0)  # (1 - z)(1 - 1/z) of the pole z
_HORIZON = 14  # |z|**14 is below float32 resolution
_FAST = {"reassoc", "contract", "arcp", "nsz"}  # keeps the meaning of NaN and inf


@njit(cache=True, nogil=True)
def _filter_line(line, n):
    """Turn the n samples of `line` into B-spline coefficients in place (mirror boundary)."""
    if n == 1:
        return
    z = _POLE
    last = 2 * n - 2
    start = line[0]
    power = z
    for i in range(1, _HORIZON):
        j = i % last
        start += power * line[j if j < n else last - j]
        power *= z
    line[0] = start * _GAIN
    for i in range(1, n):
        line[i] = line[i] * _GAIN + z * line[i - 1]
    line[n - 1] = z / (z * z - np.float32(1.0)) * (line[n - 1] + z * line[n - 2])
    for i in range(n - 2, -1, -1):
        line[i] = z * (line[i + 1] - line[i])


@njit(cache=True, nogil=True, fastmath=_FAST)
def _filter_columns(block, n):
    """The same filter down the n rows of `block` (n, m): the inner loop runs along memory."""
    if n == 1:
        return
    z = _POLE
    m = block.shape[1]
    last = 2 * n - 2
    start = block[0].copy()
    power = z
    for i in range(1, _HORIZON):
        j = i % last
        j = j if j < n else last - j
        for c in range(m):
            start[c] += power * block[j, c]
        power *= z
    for c in range(m):
        block[0, c] = start[c] * _GAIN
    for i in range(1, n):
        for c in range(m):
            block[i, c] = block[i, c] * _GAIN + z * block[i - 1, c]
    factor = z / (z * z - np.float32(1.0))
    for c in range(m):
        block[n - 1, c] = factor * (block[n - 1, c] + z * block[n - 2, c])
    for i in range(n - 2, -1, -1):
        for c in range(m):
            block[i, c] = z * (block[i + 1, c] - block[i, c])


@njit(cache=True, nogil=True, parallel=True)
def bspline_coefficients(image, out):
    """Cubic B-spline coefficients of `image` (H, W) float32 into `out` (H + 2 PAD, W + 2 PAD) float32, mirrored."""
    height, width = image.shape
    block = 64
    for b in prange((width + block - 1) // block):
        c0 = b * block
        c1 = min(c0 + block, width)
        part = image[:, c0:c1].copy()
        _filter_columns(part, height)
        out[PAD : PAD + height, PAD + c0 : PAD + c1] = part
    for row in prange(height):
        _filter_line(out[PAD + row, PAD:], width)
        for p in range(1, PAD + 1):
            out[PAD + row, PAD - p] = out[PAD + row, PAD + min(p, width - 1)]
            out[PAD + row, PAD + width - 1 + p] = out[PAD + row, PAD + max(width - 1 - p, 0)]
    for p in range(1, PAD + 1):
        out[PAD - p] = out[PAD + min(p, height - 1)]
        out[PAD + height - 1 + p] = out[PAD + max(height - 1 - p, 0)]


@njit(cache=True, nogil=True, parallel=True, fastmath=_FAST)
def sample_with_gradient(coefficients, x, y, value, gradient_x, gradient_y):
    """Value and spatial gradient of the spline at the points (x, y), 1-D float64; points outside are clamped.

    `value`, `gradient_x`, `gradient_y` are 1-D float32 outputs, grey levels and grey levels per px.
    """
    height = coefficients.shape[0] - 2 * PAD
    width = coefficients.shape[1] - 2 * PAD
    for i in prange(x.size):
        px = min(max(x[i], 0.0), width - 1.0)
        py = min(max(y[i], 0.0), height - 1.0)
        column = min(int(px), width - 1)
        row = min(int(py), height - 1)
        tx = px - column
        ty = py - row
        wx = (
            (1 - tx) ** 3 / 6,
            (4 - 6 * tx * tx + 3 * tx**3) / 6,
            (1 + 3 * tx + 3 * tx * tx - 3 * tx**3) / 6,
            tx**3 / 6,
        )
        wy = (
            (1 - ty) ** 3 / 6,
            (4 - 6 * ty * ty + 3 * ty**3) / 6,
            (1 + 3 * ty + 3 * ty * ty - 3 * ty**3) / 6,
            ty**3 / 6,
        )
        dx = (-((1 - tx) ** 2) / 2, (3 * tx * tx - 4 * tx) / 2, (1 + 2 * tx - 3 * tx * tx) / 2, tx * tx / 2)
        dy = (-((1 - ty) ** 2) / 2, (3 * ty * ty - 4 * ty) / 2, (1 + 2 * ty - 3 * ty * ty) / 2, ty * ty / 2)
        v = 0.0
        gx = 0.0
        gy = 0.0
        for a in range(4):
            along = 0.0
            slope = 0.0
            for b in range(4):
                # PAD - 1 = 1: the first of the four taps lies one pixel before the point's own
                c = coefficients[row + a + 1, column + b + 1]
                along += wx[b] * c
                slope += dx[b] * c
            v += wy[a] * along
            gx += wy[a] * slope
            gy += dy[a] * along
        value[i] = v
        gradient_x[i] = gx
        gradient_y[i] = gy
