"""Interpolation of images by cubic B-splines.

The prefilter of the splines and their evaluation follow Unser (IEEE Signal Process. Mag. 16(6), 1999).
"""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled, helper
from rgbmidic.typing import FloatImage

PAD = 2
"""Rows and columns by which the coefficient array exceeds the image on every side."""

_POLE = np.float32(np.sqrt(3.0) - 2.0)
_GAIN = np.float32(6.0)  # (1 - z)(1 - 1/z) of the pole z
_LINE = 16
"""Columns of a cache line."""
_STEPS, _REACH = 4, 15
"""Steps 1, 2, 4 and 8 of the filter along a row, and their sum: |z|**16 is below float32 resolution."""
_NO_FILTER = np.ones(1, dtype=np.float32)


def bspline_coefficients(image: FloatImage, out: FloatImage, taps: FloatImage = _NO_FILTER) -> None:
    """Cubic B-spline coefficients of `image` (H, W) float32 into `out` (H + 2 PAD, W + 2 PAD) float32, mirrored.

    `taps` (r + 1,) float32 filter the image before, along both axes: the middle one of a symmetric filter and those to
    one side of it.
    """
    height = image.shape[0]
    _filter_columns(image, taps, out)
    _filter_rows(image, taps, out)
    for p in range(1, PAD + 1):
        out[PAD - p] = out[PAD + min(p, height - 1)]
        out[PAD + height - 1 + p] = out[PAD + max(height - 1 - p, 0)]


@compiled("image", axis=1, grain=_LINE, fastmath=FAST)
def _filter_columns(start, stop, image, taps, out):
    """Filter down the columns, whole rows at a time: by `taps`, then by the recursions, causal and anticausal."""
    n, z = image.shape[0], _POLE
    line, before = np.zeros((2, stop - start), dtype=np.float32)
    for i in range(-_REACH, n):
        middle = image[_mirrored(i, n), start:stop]
        for j in range(line.size):
            line[j] = taps[0] * middle[j]
        for k in range(1, taps.size):
            above, below = image[_mirrored(i - k, n), start:stop], image[_mirrored(i + k, n), start:stop]
            for j in range(line.size):
                line[j] += taps[k] * (above[j] + below[j])
        row = out[PAD + max(i, 0), PAD + start :]
        for j in range(line.size):
            before[j] = row[j] = _GAIN * line[j] + z * before[j]
    above, row = out[PAD + max(n - 2, 0), PAD + start :], out[PAD + n - 1, PAD + start :]
    for j in range(line.size):
        before[j] = row[j] = z / (z * z - np.float32(1.0)) * (row[j] + z * above[j])
    for i in range(n - 2, -1, -1):
        row = out[PAD + i, PAD + start :]
        for j in range(line.size):
            before[j] = row[j] = z * (before[j] - row[j])


@compiled("image", fastmath=FAST)
def _filter_rows(start, stop, image, taps, out):
    """Filter along each row, with the recursions as products.

    ``1 / (1 - z B)`` is the product of ``1 + z**s B**s`` over s = 1, 2, 4, ... with the delay B.
    """
    n = image.shape[1]
    edge = PAD + _REACH + taps.size - 1
    line, buffer = np.empty(n + 2 * edge, dtype=np.float32), np.empty(n + 2 * edge, dtype=np.float32)
    for r in range(PAD + start, PAD + stop):
        row, middle = out[r, PAD:], line[edge:]
        for j in range(n):
            middle[j] = row[j]
        for j in range(1, edge + 1):
            line[edge - j], middle[n - 1 + j] = row[_mirrored(j, n)], row[_mirrored(n - 1 + j, n)]
        for k in range(1, taps.size):
            _symmetric(line if k == 1 else buffer, taps[0] if k == 1 else np.float32(1.0), line, taps[k], k, buffer)
        if taps.size > 1:
            line, buffer = buffer, line
        factor = _POLE
        for step in range(_STEPS):
            _symmetric(line, np.float32(1.0) + factor * factor, line, factor, 1 << step, buffer)
            line, buffer = buffer, line
            factor *= factor
        row, middle = out[r], line[edge - PAD :]
        for j in range(row.size):
            row[j] = -_GAIN * _POLE * middle[j]


@helper(fastmath=FAST)
def _symmetric(centre, centre_weight, line, side_weight, step, out):
    """``out = centre_weight * centre`` plus `side_weight` times `line` a `step` before and behind, where both are."""
    left, middle, right, target = line, centre[step:], line[2 * step :], out[step:]
    for j in range(right.size):
        target[j] = centre_weight * middle[j] + side_weight * (left[j] + right[j])


@helper()
def _mirrored(i, n):
    """Sample of n that stands for the i-th, mirrored about the last and the first."""
    j = i % max(2 * n - 2, 1)
    return j if j < n else 2 * n - 2 - j


@compiled("lines", fastmath=FAST)
def pixel_gradient(start, stop, lines, coefficients, top, left, gradient_x, gradient_y):
    """Evaluate the gradient of the spline at the whole pixels of `lines` (R, 4) int32.

    A line is first slot, number, row and column, counted from `top` and `left` of the image. `gradient_x` and
    `gradient_y` (P,) float32 receive grey levels per px.
    """
    four, twelfth = np.float32(4), np.float32(1 / 12)
    for q in range(start, stop):
        slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
        row, column = top + lines[q, 2] + PAD, left + lines[q, 3] + PAD - 1
        above, centre, below = (
            coefficients[row - 1, column:],
            coefficients[row, column:],
            coefficients[row + 1, column:],
        )
        for i in range(number):
            j, k = i + np.uint64(1), i + np.uint64(2)
            along = (above[k] - above[i]) + four * (centre[k] - centre[i]) + (below[k] - below[i])
            down = (below[i] - above[i]) + four * (below[j] - above[j]) + (below[k] - above[k])
            gradient_x[slot + i] = twelfth * along
            gradient_y[slot + i] = twelfth * down


@compiled("x", grain=4096, fastmath=FAST)
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
        (x0, x1, x2, x3), (dx0, dx1, dx2, dx3) = _weights(px - column)
        down, slopes = _weights(py - row)
        v = gx = gy = 0.0
        for a in range(4):
            # PAD - 1 = 1: the first of the four taps lies one pixel before the point's own
            c0, c1 = coefficients[row + a + 1, column + 1], coefficients[row + a + 1, column + 2]
            c2, c3 = coefficients[row + a + 1, column + 3], coefficients[row + a + 1, column + 4]
            along = x0 * c0 + x1 * c1 + x2 * c2 + x3 * c3
            v += down[a] * along
            gx += down[a] * (dx0 * c0 + dx1 * c1 + dx2 * c2 + dx3 * c3)
            gy += slopes[a] * along
        value[i] = v
        gradient_x[i] = gx
        gradient_y[i] = gy


@helper(fastmath=FAST)
def _weights(t):
    """Return the four cubic B-spline weights at the fraction t behind the second sample, and their slopes."""
    t2, complement = t * t, 1.0 - t
    t3 = t2 * t
    weights = (
        complement * complement * complement / 6,
        (4 - 6 * t2 + 3 * t3) / 6,
        (1 + 3 * t + 3 * t2 - 3 * t3) / 6,
        t3 / 6,
    )
    return weights, (-complement * complement / 2, (3 * t2 - 4 * t) / 2, (1 + 2 * t - 3 * t2) / 2, t2 / 2)
