"""Cubic B-spline interpolation: prefilter and evaluation (Unser, IEEE Signal Process. Mag. 16(6), 1999)."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.threads import over_ranges
from rgbmidic.typing import FloatImage

__all__ = ["PAD", "bspline_coefficients", "pixel_gradient", "sample_with_gradient"]

PAD = 2
"""Rows and columns by which the coefficient array exceeds the image on every side."""

_POLE = np.float32(np.sqrt(3.0) - 2.0)
_GAIN = np.float32(6.0)  # (1 - z)(1 - 1/z) of the pole z
_HORIZON = 14  # |z|**14 is below float32 resolution
_FAST = {"reassoc", "contract", "arcp", "nsz"}  # keeps the meaning of NaN and inf


_BLOCK = 64
"""Columns filtered together: a cache line of each row."""
_TOGETHER = 8
"""Rows filtered together: each waits for its own last sample only."""


def bspline_coefficients(image: FloatImage, out: FloatImage) -> None:
    """Cubic B-spline coefficients of `image` (H, W) float32 into `out` (H + 2 PAD, W + 2 PAD) float32, mirrored."""
    height, width = image.shape
    inner = out[PAD : PAD + height, PAD : PAD + width]
    inner[:] = image
    _filter_columns(inner)
    _filter_rows(out[PAD : PAD + height])
    for p in range(1, PAD + 1):
        out[PAD - p] = out[PAD + min(p, height - 1)]
        out[PAD + height - 1 + p] = out[PAD + max(height - 1 - p, 0)]


@over_ranges("values", axis=1, grain=_BLOCK)
@compiled(fastmath=_FAST)
def _filter_columns(start, stop, values):
    """Turn the columns of `values` into B-spline coefficients in place (mirror boundary), side by side in memory."""
    n = values.shape[0]
    if n == 1:
        return
    z = _POLE
    factor = z / (z * z - np.float32(1.0))
    first = np.empty(_BLOCK, dtype=np.float32)
    for left in range(start, stop, _BLOCK):
        m = min(_BLOCK, stop - left)
        for c in range(m):
            first[c] = values[0, left + c]
        power = z
        for i in range(1, _HORIZON):
            row = _mirrored(i, n)
            for c in range(m):
                first[c] += power * values[row, left + c]
            power *= z
        for c in range(m):
            values[0, left + c] = first[c] * _GAIN
        for i in range(1, n):
            for c in range(left, left + m):
                values[i, c] = values[i, c] * _GAIN + z * values[i - 1, c]
        for c in range(left, left + m):
            values[n - 1, c] = factor * (values[n - 1, c] + z * values[n - 2, c])
        for i in range(n - 2, -1, -1):
            for c in range(left, left + m):
                values[i, c] = z * (values[i + 1, c] - values[i, c])


@over_ranges("rows")
@compiled()
def _filter_rows(start, stop, rows):
    """The same along each of `rows` (H, W + 2 PAD), whose ends then mirror what lies inside."""
    n = rows.shape[1] - 2 * PAD
    for top in range(start, stop, _TOGETHER):
        end = min(top + _TOGETHER, stop)
        if n > 1:
            _filter_lines(rows[:, PAD:], top, end, n)
        for r in range(top, end):
            line = rows[r, PAD:]
            for p in range(1, PAD + 1):
                rows[r, PAD - p] = line[min(p, n - 1)]
                line[n - 1 + p] = line[max(n - 1 - p, 0)]


@helper()
def _filter_lines(lines, top, end, n):
    z = _POLE
    for r in range(top, end):
        first = lines[r, 0]
        power = z
        for i in range(1, _HORIZON):
            first += power * lines[r, _mirrored(i, n)]
            power *= z
        lines[r, 0] = first * _GAIN
    for i in range(np.uint64(1), np.uint64(n)):
        for r in range(np.uint64(top), np.uint64(end)):
            lines[r, i] = lines[r, i] * _GAIN + z * lines[r, i - np.uint64(1)]
    for r in range(top, end):
        lines[r, n - 1] = z / (z * z - np.float32(1.0)) * (lines[r, n - 1] + z * lines[r, n - 2])
    for i in range(n - 2, -1, -1):
        for r in range(np.uint64(top), np.uint64(end)):
            lines[r, np.uint64(i)] = z * (lines[r, np.uint64(i + 1)] - lines[r, np.uint64(i)])


@helper()
def _mirrored(i, n):
    """Sample of n > 1 that stands for the i-th, mirrored about the last and the first."""
    j = i % (2 * n - 2)
    return j if j < n else 2 * n - 2 - j


@over_ranges("lines")
@compiled(fastmath=_FAST)
def pixel_gradient(start, stop, lines, coefficients, top, left, gradient_x, gradient_y):
    """Gradient of the spline at whole pixels, those of `lines` (R, 4) int32: first slot, number, row and column counted
    from `top` and `left` of the image. `gradient_x`, `gradient_y` (P,) float32 receive grey levels per px."""
    four, twelfth = np.float32(4), np.float32(1 / 12)
    for q in range(start, stop):
        slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
        row, column = top + lines[q, 2] + PAD, left + lines[q, 3] + PAD - 1
        above, here, below = coefficients[row - 1, column:], coefficients[row, column:], coefficients[row + 1, column:]
        for i in range(number):
            j, k = i + np.uint64(1), i + np.uint64(2)
            along = (above[k] - above[i]) + four * (here[k] - here[i]) + (below[k] - below[i])
            down = (below[i] - above[i]) + four * (below[j] - above[j]) + (below[k] - above[k])
            gradient_x[slot + i] = twelfth * along
            gradient_y[slot + i] = twelfth * down


@over_ranges("x", grain=4096)
@compiled(fastmath=_FAST)
def sample_with_gradient(start, stop, coefficients, x, y, value, gradient_x, gradient_y):
    """Value and spatial gradient of the spline at the points (x, y), 1-D float64; points outside are clamped.

    `value`, `gradient_x`, `gradient_y` are 1-D float32 outputs, grey levels and grey levels per px.
    """
    height = coefficients.shape[0] - 2 * PAD
    width = coefficients.shape[1] - 2 * PAD
    for i in range(np.uint64(start), np.uint64(stop)):
        px = min(max(x[i], 0.0), width - 1.0)
        py = min(max(y[i], 0.0), height - 1.0)
        column = int(px)
        row = int(py)
        x0, x1, x2, x3, dx0, dx1, dx2, dx3 = _weights(px - column)
        y0, y1, y2, y3, dy0, dy1, dy2, dy3 = _weights(py - row)
        v = gx = gy = 0.0
        for a in range(4):
            # PAD - 1 = 1: the first of the four taps lies one pixel before the point's own
            c0, c1 = coefficients[row + a + 1, column + 1], coefficients[row + a + 1, column + 2]
            c2, c3 = coefficients[row + a + 1, column + 3], coefficients[row + a + 1, column + 4]
            weight = y0 if a == 0 else y1 if a == 1 else y2 if a == 2 else y3
            slope = dy0 if a == 0 else dy1 if a == 1 else dy2 if a == 2 else dy3
            along = x0 * c0 + x1 * c1 + x2 * c2 + x3 * c3
            v += weight * along
            gx += weight * (dx0 * c0 + dx1 * c1 + dx2 * c2 + dx3 * c3)
            gy += slope * along
        value[i] = v
        gradient_x[i] = gx
        gradient_y[i] = gy


@helper(fastmath=_FAST)
def _weights(t):
    """The four cubic B-spline weights at the fraction t behind the second sample, and their slopes."""
    t2, rest = t * t, 1.0 - t
    t3 = t2 * t
    return (
        rest * rest * rest / 6,
        (4 - 6 * t2 + 3 * t3) / 6,
        (1 + 3 * t + 3 * t2 - 3 * t3) / 6,
        t3 / 6,
        -rest * rest / 2,
        (3 * t2 - 4 * t) / 2,
        (1 + 2 * t - 3 * t2) / 2,
        t2 / 2,
    )
