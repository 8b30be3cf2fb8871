"""Fields at the owned pixels of a region: to and from images of the rectangle around it, from nodes, sums over blocks.

`lines` (R, 4) int32 are the rows of pixels of the elements: first slot, number of pixels, row and column in the
rectangle. They, `run_offsets` and `offsets` (E + 1,) are those of `rgbmidic.mesh.PixelMap`. Pixels are counted without
sign: an index that may be negative would be looked at each time.

Pixels lie in memory element after element, and are read so: for the sums over square blocks the rows of an element in a
row of blocks are first added up along its columns, these then over the blocks. A row of blocks is summed by one thread,
element by element, so that the sums are the same bits on any number of threads.
"""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled, helper

_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)
_HALF = np.float32(0.5)
LANES = 8
"""Pixels in a vector register: runs have 13 on average, and what does not fill a vector costs as much as eight."""


@compiled("lines")
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


@compiled("lines")
def from_image(start, stop, lines, image, top, left, out):
    """Read fields ``out`` (n, P) at the owned pixels from such images (n, H, W)."""
    for n in range(len(image)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, slot + i] = image[n, row, column + i]


@compiled("elements")
def interpolate_nodal(start, stop, values, elements, local_x, local_y, offsets, barycentric, out):
    """Nodal field (N, 2) at the owned pixels: ``out`` (2, P) float32."""
    for e in range(start, stop):
        for c in range(2):
            constant = slope_x = slope_y = 0.0
            for a in range(3):
                value = values[elements[e, a], c]
                constant += barycentric[e, a, 0] * value
                slope_x += barycentric[e, a, 1] * value
                slope_y += barycentric[e, a, 2] * value
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                out[c, i] = constant + slope_x * local_x[i] + slope_y * local_y[i]


@compiled("factors", fastmath=FAST)
def add_second_derivatives(start, stop, factors, images, lines, run_offsets, top, left, out):
    """Add second derivatives of images (k, H, W) float32, times `factors` (E, 3) for xx, xy and yy, to ``out`` (k, P).

    They are second differences of the pixels around; nothing is added at the images' own edges.
    """
    height, width = images.shape[1:]
    lights, one, quarter = np.uint64(len(images)), np.uint64(1), np.float32(0.25)
    for e in range(start, stop):
        xx, xy, yy = factors[e, 0], quarter * factors[e, 1], factors[e, 2]
        for q in range(run_offsets[e], run_offsets[e + 1]):
            row, column = top + lines[q, 2], left + lines[q, 3]
            low, high = max(column, 1), min(column + lines[q, 1], width - 1)
            if row == 0 or row == height - 1 or low >= high:
                continue
            b, c0, slot = np.uint64(row), np.uint64(low), np.uint64(lines[q, 0] + low - column)
            a, d = b - one, b + one
            for light in range(lights):
                for i in range(np.uint64(high - low)):
                    c = c0 + i
                    twice = images[light, b, c] + images[light, b, c]
                    second = xx * (images[light, b, c - one] - twice + images[light, b, c + one])
                    second += yy * (images[light, a, c] - twice + images[light, d, c])
                    cross = images[light, a, c - one] - images[light, a, c + one]
                    cross += images[light, d, c + one] - images[light, d, c - one]
                    out[light, slot + i] += second + xy * cross


@compiled("out", axis=1, fastmath=FAST)
def block_sums(start, stop, values, lines, run_offsets, side, out):
    """Sum fields (n, P) over blocks of `side` px: ``out`` (n, h, w)."""
    out[:, start:stop] = 0
    columns = np.zeros((len(values), out.shape[2] * side + LANES), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        _add(values, np.uint64(0), lines, run_offsets, e, start * side, stop * side, side, columns, out)


@compiled("out", axis=1, fastmath=FAST)
def weighted_block_sums(start, stop, values, weights, lines, run_offsets, side, out):
    """Sum fields (k, P) times their `weights` (k, P), and then these, over blocks of `side` px: ``out`` (2 k, h, w).

    One of (k, h, w) receives the first sums only.
    """
    out[:, start:stop] = 0
    lights, columns = len(values), np.zeros((len(out), out.shape[2] * side + LANES), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        block, low, high = np.int64(-1), np.int64(0), np.int64(0)
        for q in range(run_offsets[e], run_offsets[e + 1]):
            slot, number, row, column = lines[q, 0], np.int64(lines[q, 1]), lines[q, 2], np.int64(lines[q, 3])
            if row < start * side or row >= stop * side:
                continue
            if row // side != block:
                _flush(columns, low, high, side, block, out)
                block, low, high = row // side, column, column
            low, high = min(low, column), max(high, column + number)
            at, to, filled = np.uint64(slot), np.uint64(column), np.uint32(_filled(number, values.shape[1] - slot))
            for n in range(lights):
                for i in range(filled):
                    product = weights[n, at + i] * values[n, at + i]
                    columns[n, to + i] += product if np.int32(i) < np.int32(number) else _ZERO
            for n in range(lights, len(out)):
                for i in range(filled):
                    columns[n, to + i] += weights[n - lights, at + i] if np.int32(i) < np.int32(number) else _ZERO
        _flush(columns, low, high, side, block, out)


@compiled("offsets", fastmath=FAST)
def correct_brightness(
    start, stop, reference, inverse_level, scales, side, offset, lines, run_offsets, offsets, difference,
):  # fmt: skip
    """Correct the `difference` f - g of each light (k, P): it becomes ``(f - scale (g - b)) inverse_level``.

    The rows of a light's `scales` (k, h, W) belong to the centres of rows of blocks of `side` px, the first one of
    which lies above the rectangle around the pixels, as the first `side` columns lie before it. Its `offset` b (k, 3)
    has a constant and slopes along columns and rows; the other fields are (k, P) float32.
    """
    corrected = np.empty((len(difference), largest_element(offsets) + LANES), dtype=np.float32)
    brightness = reference, inverse_level, scales, side, offset
    for e in range(start, min(stop, offsets.size - 1)):
        first = np.uint64(offsets[e])
        for light in range(len(difference)):
            correct_element(light, difference, *brightness, lines, run_offsets, e, first, corrected)
            for i in range(np.uint64(offsets[e + 1]) - first):
                difference[light, first + i] = corrected[light, i]


@helper(fastmath=FAST)
def correct_element(
    light, difference, reference, inverse_level, scales, side, offset, lines, run_offsets, e, begin, out,
):  # fmt: skip
    """Write the corrected difference of an element, from slot `begin`, into ``out`` (k, n), longer by a vector."""
    constant, slope, down = np.float32(offset[light, 0]), np.float32(offset[light, 1]), np.float32(offset[light, 2])
    pace = _ONE / np.float32(side)
    for q in range(run_offsets[e], run_offsets[e + 1]):
        slot, number, row, column = lines[q, 0], np.int64(lines[q, 1]), lines[q, 2], lines[q, 3] + side
        at, from_column = np.uint64(slot), np.uint64(column)
        target = at - begin
        position = (np.float32(row) + _HALF) * pace + _HALF
        above = np.uint32(position)
        fraction, below = position - np.float32(above), above + np.uint32(1)
        b = constant + down * np.float32(row) + slope * np.float32(column - side)
        filled = _filled(number, min(reference.shape[1] - slot, scales.shape[2] - column))
        for i in range(np.uint32(filled)):  # the next row overwrites what is too long
            f, scale = reference[light, at + i], scales[light, above, from_column + i]
            scale += fraction * (scales[light, below, from_column + i] - scale)
            g = f - difference[light, at + i] - (b + slope * np.float32(np.int32(i)))
            out[light, target + i] = (f - scale * g) * inverse_level[light, at + i]


@compiled("out", axis=1, fastmath=FAST)
def product_sums(start, stop, values, weights, lines, run_offsets, offsets, side, out):
    """Sum ``s a b`` and ``s = sqrt(w_a w_b)`` over blocks for each two fields a, b of `values` (k, P).

    ``out`` (k (k + 1), h, w) receives both sums, with the fields' `weights` (k, P), for each field with those up to it.
    """
    out[:, start:stop] = 0
    columns = np.zeros((len(out), out.shape[2] * side + LANES), dtype=np.float32)
    largest = largest_element(offsets)
    field, root = np.empty((2, len(values), largest), dtype=np.float32)
    products = np.empty((len(out), largest), dtype=np.float32)
    for e in range(run_offsets.size - 1):
        first, number = _slots(lines, run_offsets, offsets, e, start * side, stop * side)
        n, total = 0, _ZERO
        for a in range(len(values)):
            for i in range(number):
                total += weights[a, first + i]
        if total == _ZERO:
            continue
        for a in range(len(values)):
            for i in range(number):
                root[a, i] = np.sqrt(weights[a, first + i])
                field[a, i] = root[a, i] * values[a, first + i]
            for b in range(a + 1):
                for i in range(number):
                    products[n, i] = field[a, i] * field[b, i]
                    products[n + 1, i] = root[a, i] * root[b, i]
                n += 2
        _add(products, first, lines, run_offsets, e, start * side, stop * side, side, columns, out)


@compiled("out", axis=2, fastmath=FAST)
def score_sums(
    start, stop, residual, weights, gradient_x, gradient_y, images_x, images_y, values, inverse_level, polynomials,
    local_x, local_y, lines, run_offsets, offsets, side, out, common,
):  # fmt: skip
    """Sum ``w r gx``, ``w r gy``, ``w (gx gx + gy gy)`` and the pixels with weight over blocks of `side` px.

    ``out`` (k, 4, h, w) receives them of each light, whose fields are (k, P). `common` (4, h, w) receives sums over the
    lights; it is (0, h, w) where they are not asked for: ``w r gx`` and ``w r gy`` with the gradient of the images, and
    ``w (gx df/dx + gy df/dy)``, by differences from every other row of each element, for f the `values` times the
    `inverse_level` and for those less the residual.

    The residual r is that given less the effect ``gx dx + gy dy`` of a displacement d that is quadratic in every
    element: `polynomials` (E, 2, 6) float32 holds its coefficients of 1, x, y, x^2, x y, y^2 of the local position, px;
    it is (0, 2, 6) without.
    """
    out[:, :, start:stop] = 0
    common[:, start:stop] = 0
    columns = np.zeros((4, out.shape[3] * side + LANES), dtype=np.float32)
    largest, lights, one = largest_element(offsets) + LANES, len(weights), np.uint64(1)
    scores, sums = np.empty((4, largest), dtype=np.float32), np.empty((4, largest), dtype=np.float32)
    # arrays of their own: of a slice the compiler does not know that it is contiguous
    half_x, half_y = np.empty((lights, largest), dtype=np.float32), np.empty((lights, largest), dtype=np.float32)
    f, g = np.empty((lights, largest), dtype=np.float32), np.empty((lights, largest), dtype=np.float32)
    r, dx, dy = np.empty(largest, dtype=np.float32), np.empty(largest, np.float32), np.empty(largest, np.float32)
    for e in range(run_offsets.size - 1):
        first, number = _slots(lines, run_offsets, offsets, e, start * side, stop * side)
        if number == 0:
            continue
        sums[:] = _ZERO
        dx[:], dy[:] = _ZERO, _ZERO
        if len(polynomials) > 0:
            _evaluate(polynomials[e, 0], local_x, local_y, first, number, dx)
            _evaluate(polynomials[e, 1], local_x, local_y, first, number, dy)
        for light in range(lights):
            for i in range(number):
                w, gx, gy = weights[light, first + i], gradient_x[light, first + i], gradient_y[light, first + i]
                r[i] = residual[light, first + i] - gx * dx[i] - gy * dy[i]
                weighted = w * r[i]
                scores[0, i] = weighted * gx
                scores[1, i] = weighted * gy
                scores[2, i] = w * (gx * gx + gy * gy)
                scores[3, i] = _ONE if w > _ZERO else _ZERO
            _add(scores, first, lines, run_offsets, e, start * side, stop * side, side, columns, out[light])
            if len(common) == 0:
                continue
            for i in range(number):
                w = weights[light, first + i]
                sums[0, i] += w * r[i] * images_x[light, first + i]
                sums[1, i] += w * r[i] * images_y[light, first + i]
                half_x[light, i] = _HALF * w * gradient_x[light, first + i]
                half_y[light, i] = _HALF * w * gradient_y[light, first + i]
                f[light, i] = values[light, first + i] * inverse_level[light, first + i]
                g[light, i] = f[light, i] - r[i]
        if len(common) == 0:
            continue
        for q in range(run_offsets[e], run_offsets[e + 1], 2):
            a, length = np.uint64(lines[q, 0]) - first, np.uint64(lines[q, 1] - 1)
            for light in range(lights):
                for i in range(a, a + length):
                    mean = half_x[light, i] + half_x[light, i + one]
                    sums[2, i] += mean * (f[light, i + one] - f[light, i])
                    sums[3, i] += mean * (g[light, i + one] - g[light, i])
            if q + 1 == run_offsets[e + 1] or lines[q + 1, 2] != lines[q, 2] + 1:
                continue
            low = max(lines[q, 3], lines[q + 1, 3])
            count = min(lines[q, 3] + lines[q, 1], lines[q + 1, 3] + lines[q + 1, 1]) - low
            a = np.uint64(lines[q, 0] + low - lines[q, 3]) - first
            b = np.uint64(lines[q + 1, 0] + low - lines[q + 1, 3]) - first
            for light in range(lights):
                for i in range(np.uint32(max(count, 0))):
                    mean = half_y[light, a + i] + half_y[light, b + i]
                    sums[2, a + i] += mean * (f[light, b + i] - f[light, a + i])
                    sums[3, a + i] += mean * (g[light, b + i] - g[light, a + i])
        _add(sums, first, lines, run_offsets, e, start * side, stop * side, side, columns, common)


@helper(fastmath=FAST)
def _evaluate(polynomial, local_x, local_y, first, number, out):
    """Evaluate a polynomial, coefficients of 1, x, y, x^2, x y and y^2, at the pixels of an element."""
    c0, c1, c2, c3, c4, c5 = (polynomial[0], polynomial[1], polynomial[2], polynomial[3], polynomial[4], polynomial[5])
    for i in range(number):
        x, y = local_x[first + i], local_y[first + i]
        out[i] = c0 + x * (c1 + c3 * x + c4 * y) + y * (c2 + c5 * y)


@helper()
def largest_element(offsets):
    """Number of pixels of the largest element."""
    largest = 0
    for e in range(offsets.size - 1):
        largest = max(largest, offsets[e + 1] - offsets[e])
    return largest


@helper()
def _slots(lines, run_offsets, offsets, e, top, bottom):
    """First slot of an element and its number of pixels; none where it has no row from `top` to `bottom`."""
    first, last = run_offsets[e], run_offsets[e + 1] - 1
    is_outside = last < first or lines[first, 2] >= bottom or lines[last, 2] < top
    return np.uint64(offsets[e]), np.uint64(0 if is_outside else offsets[e + 1] - offsets[e])


@helper(fastmath=FAST)
def _add(fields, begin, lines, run_offsets, e, top, bottom, side, columns, out):
    """Add the rows from `top` to `bottom` of an element to the blocks; slot `begin` is the first of `fields` (n, ...).

    `columns` (n, W) are 0 before and after.
    """
    block, low, high = np.int64(-1), np.int64(0), np.int64(0)
    for q in range(run_offsets[e], run_offsets[e + 1]):
        slot, number, row, column = lines[q, 0], np.int64(lines[q, 1]), lines[q, 2], np.int64(lines[q, 3])
        if row < top:
            continue
        if row >= bottom:
            break
        if row // side != block:
            _flush(columns, low, high, side, block, out)
            block, low, high = row // side, column, column
        low, high = min(low, column), max(high, column + number)
        at, to = np.uint64(slot) - begin, np.uint64(column)
        filled = _filled(number, fields.shape[1] - np.int64(at))
        for n in range(len(fields)):
            for i in range(np.uint32(filled)):
                value = fields[n, at + i]
                columns[n, to + i] += value if np.int32(i) < np.int32(number) else _ZERO
    _flush(columns, low, high, side, block, out)


@helper(forceinline=True)
def _filled(number, room):
    """Pixels of the whole vectors that hold a `number` of them; no more than these where memory has no `room`."""
    filled = (number + LANES - 1) // LANES * LANES
    return filled if filled <= room else number


@helper(fastmath=FAST)
def _flush(columns, low, high, side, block, out):
    """Add the columns from `low` to `high` to a row of blocks, and make them 0."""
    for b in range(low // side, (high + side - 1) // side):
        for n in range(len(columns)):
            total = _ZERO
            for i in range(np.uint64(b * side), np.uint64((b + 1) * side)):
                total += columns[n, i]
                columns[n, i] = _ZERO
            out[n, block, b] += total
