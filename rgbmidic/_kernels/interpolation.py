"""Interpolation: cubic B-splines, coarse grids of blocks, and fields on a triangle mesh.

The prefilter of the splines and their evaluation follow Unser (IEEE Signal Process. Mag. 16(6), 1999).

Other loops move values between the owned pixels and images, or coarse grids of square blocks, of the rectangle around
them. `lines` (R, 4) int32 are the rows of pixels of the elements in the order of the image's rows: first slot, number
of pixels, row and column in the rectangle; row r has ``line_offsets[r]:line_offsets[r + 1]``. Pixels are counted
without sign: an index that may be negative would be looked at each time. What is summed is first added up along the
columns of a block's rows, side by side in memory. The last one paints a field on a triangle mesh as the pixels of a
screen.
"""

from __future__ import annotations

import math

import numpy as np

from rgbmidic._kernels.threads import compiled, helper, over_ranges
from rgbmidic.typing import FloatImage

PAD = 2
"""Rows and columns by which the coefficient array exceeds the image on every side."""

_POLE = np.float32(np.sqrt(3.0) - 2.0)
_GAIN = np.float32(6.0)  # (1 - z)(1 - 1/z) of the pole z
_FAST = {"reassoc", "contract", "arcp", "nsz"}  # keeps the meaning of NaN and inf


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


@helper()
def between(row, block, rows):
    """Return the two rows of a grid that a row of pixels lies between, and how far on from the first it is."""
    position = min(max((row + 0.5) / block - 0.5, 0.0), rows - 1.0)
    low = int(position)
    return low, min(low + 1, rows - 1), np.float32(position - low)


@helper()
def expand_row(grid, row, block, line, out):
    """Row of pixels `out` (W,) interpolated from a grid (h, w); `line` (w,) is scratch."""
    low, high, part = between(row, block, grid.shape[0])
    for g in range(line.size):
        line[g] = grid[low, g] + part * (grid[high, g] - grid[low, g])
    half, last = block // 2, line.size - 1
    first = min(half, out.size)
    for j in range(first):
        out[j] = line[0]
    per_pixel = np.float32(1.0 / block)
    ahead = np.float32(0.5 - 0.5 * (block % 2))  # of the first pixel beyond a block's centre
    for j in range(block):
        part, start = (np.float32(j) + ahead) * per_pixel, half + j
        for g in range(np.uint64(max(min(last, (out.size - start + block - 1) // block), 0))):
            out[np.uint64(start) + g * np.uint64(block)] = line[g] + part * (line[g + np.uint64(1)] - line[g])
    for j in range(half + last * block, out.size):
        out[j] = line[last]


@over_ranges("image", axis=1, grain=_LINE)
@compiled(fastmath=_FAST)
def _filter_columns(start, stop, image, taps, out):
    """Filter down the columns, whole rows at a time: by `taps`, then by the recursions, causal and anticausal."""
    n, z = image.shape[0], _POLE
    line, before = np.empty(stop - start, dtype=np.float32), np.empty(stop - start, dtype=np.float32)
    for j in range(before.size):
        before[j] = 0
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


@over_ranges("image")
@compiled(fastmath=_FAST)
def _filter_rows(start, stop, image, taps, out):
    """Filter along each row, with the recursions as products.

    ``1 / (1 - z B)`` is the product of ``1 + z**s B**s`` over s = 1, 2, 4, ... with the delay B.
    """
    n = image.shape[1]
    edge = PAD + _REACH + taps.size - 1
    line, other = np.empty(n + 2 * edge, dtype=np.float32), np.empty(n + 2 * edge, dtype=np.float32)
    for r in range(PAD + start, PAD + stop):
        row, middle = out[r, PAD:], line[edge:]
        for j in range(n):
            middle[j] = row[j]
        for j in range(1, edge + 1):
            line[edge - j], middle[n - 1 + j] = row[_mirrored(j, n)], row[_mirrored(n - 1 + j, n)]
        for k in range(1, taps.size):
            _symmetric(line if k == 1 else other, taps[0] if k == 1 else np.float32(1.0), line, taps[k], k, other)
        if taps.size > 1:
            line, other = other, line
        factor = _POLE
        for step in range(_STEPS):
            _symmetric(line, np.float32(1.0) + factor * factor, line, factor, 1 << step, other)
            line, other = other, line
            factor *= factor
        row, middle = out[r], line[edge - PAD :]
        for j in range(row.size):
            row[j] = -_GAIN * _POLE * middle[j]


@helper(fastmath=_FAST)
def _symmetric(centre, own, line, beside, step, out):
    """``out = own * centre`` plus `beside` times what `line` has `step` before and behind, where there are both."""
    left, middle, right, target = line, centre[step:], line[2 * step :], out[step:]
    for j in range(right.size):
        target[j] = own * middle[j] + beside * (left[j] + right[j])


@helper()
def _mirrored(i, n):
    """Sample of n that stands for the i-th, mirrored about the last and the first."""
    j = i % max(2 * n - 2, 1)
    return j if j < n else 2 * n - 2 - j


@over_ranges("lines")
@compiled(fastmath=_FAST)
def pixel_gradient(start, stop, lines, coefficients, top, left, gradient_x, gradient_y):
    """Evaluate the gradient of the spline at the whole pixels of `lines` (R, 4) int32.

    A line is first slot, number, row and column, counted from `top` and `left` of the image. `gradient_x` and
    `gradient_y` (P,) float32 receive grey levels per px.
    """
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
    """Return the four cubic B-spline weights at the fraction t behind the second sample, and their slopes."""
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


_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_LANES = 8
"""Pixels in a vector register: lines have 13 on average, and what does not fill a vector costs as much as eight."""


@over_ranges("out", axis=1)
@compiled(fastmath=_FAST)
def block_sums(start, stop, values, lines, line_offsets, side, out):
    """Sum fields (n, P) over blocks of `side` px: ``out`` (n, h, w)."""
    columns = np.empty(out.shape[2] * side, dtype=np.float32)
    for n in range(len(values)):
        for block in range(start, stop):
            columns[:] = 0
            first, last = line_offsets[block * side], line_offsets[min((block + 1) * side, line_offsets.size - 1)]
            for q in range(first, last):
                slot, number, column = np.uint64(lines[q, 0]), np.uint64(lines[q, 1]), np.uint64(lines[q, 3])
                for i in range(number):
                    columns[column + i] += values[n, slot + i]
            _gather(columns, side, out[n, block])


@over_ranges("out", axis=3)
@compiled(fastmath=_FAST)
def product_sums(start, stop, values, weights, lines, line_offsets, side, out):
    """Sum ``s a b`` and ``s = sqrt(w_a w_b)`` over blocks for each two fields a, b of `values` (k, P).

    ``out`` (k, k, 2, h, w) receives the sums with the fields' `weights` (k, P), the second field not after the first.
    """
    lights, width = len(values), out.shape[4] * side
    field, root = np.empty((2, lights, width + _LANES), dtype=np.float32)
    sums = np.empty((lights, lights, 2, width), dtype=np.float32)
    for block in range(start, stop):
        sums[:] = 0
        for row in range(block * side, min((block + 1) * side, line_offsets.size - 1)):
            for light in range(lights):
                own, w = field[light], root[light]
                _to_row(row, values[light], lines, line_offsets, own)
                _to_row(row, weights[light], lines, line_offsets, w)
                for i in range(np.uint64(width)):
                    w[i] = np.sqrt(w[i])
                for i in range(np.uint64(width)):
                    own[i] *= w[i]
                for other in range(light + 1):
                    b, v = field[other], root[other]
                    product, share = sums[light, other, 0], sums[light, other, 1]
                    for i in range(np.uint64(width)):
                        product[i] += own[i] * b[i]
                    for i in range(np.uint64(width)):
                        share[i] += w[i] * v[i]
        for light in range(lights):
            for other in range(light + 1):
                for n in range(2):
                    _gather(sums[light, other, n], side, out[light, other, n, block])


@helper(fastmath=_FAST)
def _to_row(row, values, lines, line_offsets, out):
    """Write a row of the image of `values` (P,), 0 where no pixel is owned; `out` is longer by a vector.

    Whole vectors are copied, where memory goes on so far: the next line overwrites what is too much, or a gap does.
    """
    filled = np.int64(0)
    for q in range(line_offsets[row], line_offsets[row + 1]):
        slot, number, column = np.int64(lines[q, 0]), np.int64(lines[q, 1]), np.int64(lines[q, 3])
        for i in range(np.uint64(filled), np.uint64(column)):
            out[i] = _ZERO
        whole = (number + _LANES - 1) // _LANES * _LANES
        if slot + whole > values.size:
            whole = number
        first, target = np.uint64(slot), np.uint64(column)
        for i in range(np.uint32(whole)):
            out[target + i] = values[first + i]
        filled = column + number
    for i in range(np.uint64(filled), np.uint64(out.size)):
        out[i] = _ZERO


@helper(fastmath=_FAST)
def _gather(columns, side, out):
    """Sum each `side` of the columns into `out` (w,)."""
    for block in range(out.size):
        total = _ZERO
        for i in range(np.uint64(block * side), np.uint64((block + 1) * side)):
            total += columns[i]
        out[block] = total


@over_ranges("lines")
@compiled()
def to_image(start, stop, lines, values, top, left, out):
    """Write fields (n, P) float32 of the owned pixels into images ``out`` (n, H, W).

    The rectangle around the pixels begins at row `top` and column `left` of the images.
    """
    for n in range(len(values)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, row, column + i] = values[n, slot + i]


@over_ranges("lines")
@compiled()
def from_image(start, stop, lines, image, top, left, out):
    """Read fields ``out`` (n, P) at the owned pixels from such images (n, H, W)."""
    for n in range(len(image)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, slot + i] = image[n, row, column + i]


@over_ranges("line_offsets")
@compiled(fastmath=_FAST)
def from_grid(start, stop, lines, line_offsets, grid, side, out):
    """Interpolate grids (n, h, w) float32 of blocks of `side` px at the owned pixels: ``out`` (n, P).

    The interpolation is linear between the centres of the blocks and constant beyond the outermost.
    """
    row = np.empty(grid.shape[2] * side, dtype=np.float32)
    between = np.empty(grid.shape[2], dtype=np.float32)
    for r in range(start, min(stop, line_offsets.size - 1)):
        for n in range(len(grid)):
            expand_row(grid[n], r, side, between, row)
            for q in range(line_offsets[r], line_offsets[r + 1]):
                slot, number, column = np.uint64(lines[q, 0]), np.uint64(lines[q, 1]), np.uint64(lines[q, 3])
                for i in range(number):
                    out[n, slot + i] = row[column + i]


_EDGE = 1e-6
"""Distance (px) within which a pixel on an edge is painted by both elements: no gap through rounding in float64."""
_EACH, _OPAQUE = np.uint32(0x010101), np.uint32(0xFF000000)
"""A grey level in the three colours of a pixel, and its opacity, as the bytes of a number."""


@over_ranges("out", grain=16)
@compiled()
def paint_field(start, stop, out, grey, x, y, elements, values, low, high, colours, share, nearest):
    """Paint the linear interpolation of `values` (N,) over a grey picture; elements with a NaN node stay grey.

    Parameters
    ----------
    start, stop
        Range of rows that this call does.
    out : (H, W) uint32
        Receives red, green, blue and an opacity of 255, the lowest byte first.
    grey : (H, W) uint8
        The picture.
    x, y : (N,)
        Where each node is on the screen, in its pixels; the centre of the first is (0, 0).
    elements, values : (E, 3), (N,)
        Nodes of the triangles, and what is painted.
    low, high
        Values of the first and the last of the colours; beyond them these stay.
    colours : (C,) uint32
        Red, green, blue, each times the field's opacity, and 255, the lowest byte first.
    share
        Of the grey picture that is seen through the field, in 256ths.
    nearest
        Whether a pixel shows the value of the corner that counts most there, and not the mean of the three.
    """
    width, last = out.shape[1], np.float32(colours.shape[0] - 1)
    for row in range(start, stop):
        for column in range(width):
            out[row, column] = np.uint32(grey[row, column]) * _EACH | _OPAQUE
    scale, share = colours.shape[0] / (high - low), np.uint32(share)
    for e in range(elements.shape[0]):
        i, j, k = elements[e, 0], elements[e, 1], elements[e, 2]
        xi, yi, xj, yj, xk, yk = x[i], y[i], x[j], y[j], x[k], y[k]
        vi, vj, vk = values[i], values[j], values[k]
        if not math.isfinite(vi + vj + vk + xi + yi + xj + yj + xk + yk):
            continue
        top = max(math.ceil(min(yi, yj, yk) - _EDGE), start)
        bottom = min(math.floor(max(yi, yj, yk) + _EDGE), stop - 1)
        area = (xj - xi) * (yk - yi) - (yj - yi) * (xk - xi)
        if top > bottom or area == 0.0 or max(xi, xj, xk) < 0.0 or min(xi, xj, xk) > width - 1.0:
            continue
        # weights of the second and the third corner: a0 + ac column + ar row
        ac, ar = (yk - yi) / area, -(xk - xi) / area
        bc, br = -(yj - yi) / area, (xj - xi) / area
        for row in range(int(top), int(bottom) + 1):
            a0, b0 = ar * (row - yi) - ac * xi, br * (row - yi) - bc * xi
            left, right = 0.0, width - 1.0
            for slope, base in ((ac, a0), (bc, b0), (-ac - bc, 1.0 - a0 - b0)):
                if slope > 0.0:
                    left = max(left, (-_EDGE - base) / slope)
                elif slope < 0.0:
                    right = min(right, (-_EDGE - base) / slope)
                elif base < -_EDGE:
                    right = -1.0
            first, end = math.ceil(left), math.floor(right)
            slope = np.float32(scale * (ac * (vj - vi) + bc * (vk - vi)))
            base = np.float32(scale * (vi + a0 * (vj - vi) + b0 * (vk - vi) - low))
            for column in range(first, end + 1):
                place = base + slope * np.float32(column)
                if nearest:
                    a, b = a0 + ac * column, b0 + bc * column
                    c = 1.0 - a - b
                    own = vi if c >= a and c >= b else (vj if a >= b else vk)
                    place = np.float32(scale * (own - low))
                index = np.int32(min(max(place, np.float32(0)), last))
                seen = (np.uint32(grey[row, column]) * share) >> np.uint32(8)
                out[row, column] = colours[index] + seen * _EACH
