"""The sums of the MIDIC minimisation over the pixels of each element (paper, eq. 3).

Pixels are stored element by element: element e owns the slots ``offsets[e]:offsets[e + 1]``. Each element writes its
own row of the output, so the sums are the same bits on any number of threads. Positions are kept relative to the
element's origin pixel: float32 then resolves 1e-5 px on images of any size. Slots are counted without sign: an index
that may be negative would be looked at for each pixel, and the loop not vectorised.
"""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.owned_pixels import LANES, correct_element, largest_element
from rgbmidic._kernels.splines import PAD
from rgbmidic._kernels.threads import FAST, compiled, helper

_SIXTH = np.float32(1.0 / 6.0)
_HALF = np.float32(0.5)
_TWO_THIRDS = np.float32(2.0 / 3.0)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_LEVEL = np.float32(1e-7)
"""Drift (px per pixel) under which a run stays between two rows: 100 pixels then drift by what float32 resolves."""
BLOCK = 8
"""Side (px) of the blocks for each of which `warped_weights` knows whether all weights are 1: eight bytes, compared at
once."""
_NEVER = np.float32(1e9)


@helper(forceinline=True, fastmath=FAST)
def _spline(coefficients, first, width, i, tx, ty):
    """Return the cubic B-spline value at the fraction (tx, ty) of a cell.

    The cell's first coefficient is the `first` + i-th of the rows of `width`. No view of them is made: each view counts
    its owners, and the threads would wait for each other.
    """
    t2 = tx * tx
    t3 = t2 * tx
    x3 = t3 * _SIXTH
    x0 = _SIXTH - _HALF * (tx - t2) - x3
    x1 = _TWO_THIRDS - t2 + _HALF * t3
    x2 = _ONE - x0 - x1 - x3
    t2 = ty * ty
    t3 = t2 * ty
    y3 = t3 * _SIXTH
    y0 = _SIXTH - _HALF * (ty - t2) - y3
    y1 = _TWO_THIRDS - t2 + _HALF * t3
    y2 = _ONE - y0 - y1 - y3
    a = first + i
    b = a + width
    c = b + width
    d = c + width
    j, k, m = np.uint64(1), np.uint64(2), np.uint64(3)
    return (
        y0 * (x0 * coefficients[a] + x1 * coefficients[a + j] + x2 * coefficients[a + k] + x3 * coefficients[a + m])
        + y1 * (x0 * coefficients[b] + x1 * coefficients[b + j] + x2 * coefficients[b + k] + x3 * coefficients[b + m])
        + y2 * (x0 * coefficients[c] + x1 * coefficients[c + j] + x2 * coefficients[c + k] + x3 * coefficients[c + m])
        + y3 * (x0 * coefficients[d] + x1 * coefficients[d + j] + x2 * coefficients[d + k] + x3 * coefficients[d + m])
    )


@helper(forceinline=True)
def _crossing(drift):
    """Fraction at which the next pixels reach another row, and its change in pixels per unit of fraction.

    The fraction changes by `drift` from pixel to pixel. Of ``(crossing - fraction) * pace`` pixels all lie between the
    same two rows, or move on by one column each.
    """
    if abs(drift) <= _LEVEL:
        return _NEVER, _ONE
    return _ONE if drift > _ZERO else _ZERO, _ONE / drift


@helper(forceinline=True)
def _element_motion(displacement, elements, barycentric, origin, e):
    """Affine displacement of element e about its origin pixel: whole-pixel part, constant rest and slopes."""
    ux = uy = uxx = uxy = uyx = uyy = 0.0
    for a in range(3):
        node = elements[e, a]
        u = displacement[node, 0]
        v = displacement[node, 1]
        ux += barycentric[e, a, 0] * u
        uy += barycentric[e, a, 0] * v
        uxx += barycentric[e, a, 1] * u
        uxy += barycentric[e, a, 2] * u
        uyx += barycentric[e, a, 1] * v
        uyy += barycentric[e, a, 2] * v
    whole_x = np.floor(ux)
    whole_y = np.floor(uy)
    return (
        np.int64(whole_x) + origin[e, 0],
        np.int64(whole_y) + origin[e, 1],
        np.float32(ux - whole_x),
        np.float32(uy - whole_y),
        np.float32(1.0 + uxx),
        np.float32(uxy),
        np.float32(uyx),
        np.float32(1.0 + uyy),
    )


@compiled("elements", fastmath=FAST)
def differences(
    start, stop, coefficients, reference, runs, run_offsets, origin, elements, barycentric, displacement, out
):
    """Differences ``f - g(x + u)`` of one light at the owned pixels, 0 outside the deformed image.

    `coefficients` of the deformed image; `reference` and `out` (P,) float32; `runs` (R, 4) int32, `run_offsets`
    (E + 1,) and `origin` (E, 2) as in `rgbmidic.mesh.PixelMap`; `barycentric` (E, 3, 3) float64 with the shape function
    ``b[0] + b[1] x + b[2] y`` of the local position; `displacement` (N, 2) float64.
    """
    height, width = coefficients.shape[0] - 2 * PAD, coefficients.shape[1] - 2 * PAD
    flat, across = coefficients.ravel(), np.uint64(coefficients.shape[1])
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        low_x, low_y = np.float32(-base_x), np.float32(-base_y)
        high_x, high_y = np.float32(width - 1 - base_x), np.float32(height - 1 - base_y)
        (end_x, pace_x), (end_y, pace_y) = _crossing(fxx - _ONE), _crossing(fyx)
        for run in range(run_offsets[e], run_offsets[e + 1]):
            slot, remaining = np.int64(runs[run, 0]), np.int64(runs[run, 1])
            x, y = np.float32(runs[run, 2]), np.float32(runs[run, 3])
            while remaining > 0:
                px = ux + fxx * x + fxy * y
                py = uy + fyx * x + fyy * y
                if not (px >= low_x and py >= low_y and px <= high_x and py <= high_y):
                    out[slot] = _ZERO
                    slot, remaining, x = slot + 1, remaining - 1, x + _ONE
                    continue
                cx, cy = np.floor(px), np.floor(py)
                column, row = base_x + np.int64(cx), base_y + np.int64(cy)
                tx, ty = px - cx, py - cy
                side_by_side = min((end_x - tx) * pace_x, (end_y - ty) * pace_y, np.float32(remaining - 1))
                n = max(min(np.int64(side_by_side) + 1, width - 1 - column), 1)
                # whole vectors, of which the last one may be too long, where memory goes on so far
                filled = (n + LANES - 1) // LANES * LANES
                if slot + filled > reference.size or column + filled + 3 >= width + 2 * PAD:
                    filled = n
                i0, first = np.uint64(slot), np.uint64(row + PAD - 1) * across + np.uint64(column + PAD - 1)
                for i in range(np.uint32(filled)):
                    t = np.float32(np.int32(i))
                    g = _spline(flat, first, across, i, tx + (fxx - _ONE) * t, ty + fyx * t)
                    if np.int32(i) < np.int32(n):
                        out[i0 + i] = reference[i0 + i] - g
                slot, remaining, x = slot + n, remaining - n, x + np.float32(n)


@helper()
def _shape_function(barycentric, e, a):
    """Constant and slopes along x and y of a shape function of element e."""
    return np.float32(barycentric[e, a, 0]), np.float32(barycentric[e, a, 1]), np.float32(barycentric[e, a, 2])


@compiled("out", fastmath=FAST)
def element_hessian(start, stop, gradient_x, gradient_y, weight, local_x, local_y, offsets, barycentric, out):
    """Hessian (correlation matrix) of one light: ``out`` (E, 3, 3, 3) receives ``sum w D phi_a phi_b``.

    The last axis of `out` holds D = (gx gx, gx gy, gy gy).
    """
    for e in range(start, stop):
        b00, b01, b02 = _shape_function(barycentric, e, 0)
        b10, b11, b12 = _shape_function(barycentric, e, 1)
        x00 = x01 = x11 = x02 = x12 = x22 = _ZERO
        m00 = m01 = m11 = m02 = m12 = m22 = _ZERO
        y00 = y01 = y11 = y02 = y12 = y22 = _ZERO
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            lx = local_x[i]
            ly = local_y[i]
            l0 = b00 + b01 * lx + b02 * ly
            l1 = b10 + b11 * lx + b12 * ly
            l2 = _ONE - l0 - l1
            wgx = weight[i] * gradient_x[i]
            xx = wgx * gradient_x[i]
            xy = wgx * gradient_y[i]
            yy = weight[i] * gradient_y[i] * gradient_y[i]
            p00 = l0 * l0
            p01 = l0 * l1
            p11 = l1 * l1
            p02 = l0 * l2
            p12 = l1 * l2
            p22 = l2 * l2
            x00 += xx * p00
            x01 += xx * p01
            x11 += xx * p11
            x02 += xx * p02
            x12 += xx * p12
            x22 += xx * p22
            m00 += xy * p00
            m01 += xy * p01
            m11 += xy * p11
            m02 += xy * p02
            m12 += xy * p12
            m22 += xy * p22
            y00 += yy * p00
            y01 += yy * p01
            y11 += yy * p11
            y02 += yy * p02
            y12 += yy * p12
            y22 += yy * p22
        out[e, 0, 0, 0], out[e, 0, 0, 1], out[e, 0, 0, 2] = x00, m00, y00
        out[e, 1, 1, 0], out[e, 1, 1, 1], out[e, 1, 1, 2] = x11, m11, y11
        out[e, 2, 2, 0], out[e, 2, 2, 1], out[e, 2, 2, 2] = x22, m22, y22
        out[e, 0, 1, 0], out[e, 0, 1, 1], out[e, 0, 1, 2] = x01, m01, y01
        out[e, 0, 2, 0], out[e, 0, 2, 1], out[e, 0, 2, 2] = x02, m02, y02
        out[e, 1, 2, 0], out[e, 1, 2, 1], out[e, 1, 2, 2] = x12, m12, y12
        for a in range(1, 3):
            for b in range(a):
                for c in range(3):
                    out[e, a, b, c] = out[e, b, a, c]


@compiled("out", axis=1, fastmath=FAST)
def element_block_products(
    start, stop, gradient_x, gradient_y, weight, runs, run_offsets, origin, barycentric, sign, side, period, out,
):  # fmt: skip
    """Project one light's ``s w D`` on the shape functions, the blocks of `side` px of each phase for themselves.

    `sign` (h, w) float32 holds s of each block; row and column of a block give its phase modulo `period`. `origin`
    (E, 2) counts from the first block's first pixel. ``out`` (period period, E, 3, 3) receives the sums over shape
    functions and D = (gx gx, gx gy, gy gy), added to what it holds.
    """
    for e in range(start, stop):
        for run in range(run_offsets[e], run_offsets[e + 1]):
            slot, remaining, x, y = runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3]
            row = (origin[e, 1] + y) // side
            while remaining > 0:
                block = (origin[e, 0] + x) // side
                number = min(remaining, (block + 1) * side - origin[e, 0] - x)
                xx = xy = yy = turn_xx = turn_xy = turn_yy = _ZERO
                first = np.uint64(slot)
                for i in range(np.uint32(number)):
                    t = np.float32(np.int32(i))
                    wx, wy = weight[first + i] * gradient_x[first + i], weight[first + i] * gradient_y[first + i]
                    p, q, r = wx * gradient_x[first + i], wx * gradient_y[first + i], wy * gradient_y[first + i]
                    xx += p
                    xy += q
                    yy += r
                    turn_xx += p * t
                    turn_xy += q * t
                    turn_yy += r * t
                phase = row % period * period + block % period
                for a in range(3):
                    slope = sign[row, block] * barycentric[e, a, 1]
                    value = sign[row, block] * (barycentric[e, a, 0] + barycentric[e, a, 2] * y) + slope * x
                    out[phase, e, a, 0] += value * xx + slope * turn_xx
                    out[phase, e, a, 1] += value * xy + slope * turn_xy
                    out[phase, e, a, 2] += value * yy + slope * turn_yy
                slot, remaining, x = slot + number, remaining - number, x + number


@compiled("elements", fastmath=FAST)
def warped_weights(
    start, stop, deformed_weight, partial, reference, difference, reference_weight, runs, run_offsets, origin,
    elements, barycentric, displacement, weight, moments, is_changed,
):  # fmt: skip
    """Warp the weights of one light to the owned pixels, and sum the grey levels of both states with them.

    `weight` (P,) float32 receives the `reference_weight` (P,) times the `deformed_weight` (H, W) at the displaced
    position (bilinear), 0 outside and beside excluded pixels. `partial` (h + 1, w + 1) int32 counts where that is other
    than 1: how many such blocks of `BLOCK` px lie above and to the left. `moments` (E, 6) receives the sums of w, w f,
    w g, w f f, w f g, w g g, where g is f, the `reference` (P,), less the `difference` (P,). `is_changed` (E,) says
    where the weight may be another than that of the reference.
    """
    height, width = deformed_weight.shape
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        low_x, low_y = np.float32(-base_x), np.float32(-base_y)
        high_x, high_y = np.float32(width - 1 - base_x), np.float32(height - 1 - base_y)
        left_x = top_y = np.float32(np.inf)
        right_x = bottom_y = -np.float32(np.inf)
        if run_offsets[e] == run_offsets[e + 1]:
            moments[e], is_changed[e] = 0.0, False
            continue
        begin, end = runs[run_offsets[e], 0], runs[run_offsets[e + 1] - 1, 0] + runs[run_offsets[e + 1] - 1, 1]
        for run in range(run_offsets[e], run_offsets[e + 1]):
            first, y = np.float32(runs[run, 2]), np.float32(runs[run, 3])
            for x in (first, first + np.float32(runs[run, 1])):  # its first pixel, and the one behind its last
                px = ux + fxx * x + fxy * y
                py = uy + fyx * x + fyy * y
                left_x, right_x = min(left_x, px), max(right_x, px)
                top_y, bottom_y = min(top_y, py), max(bottom_y, py)
        inside = left_x >= low_x and top_y >= low_y and right_x <= high_x and bottom_y <= high_y
        sides = base_x + left_x, base_y + top_y, base_x + right_x, base_y + bottom_y
        is_changed[e] = not inside or _any_partial(partial, *sides)
        if not is_changed[e]:
            for i in range(np.uint64(begin), np.uint64(end)):
                weight[i] = reference_weight[i]
        else:
            for run in range(run_offsets[e], run_offsets[e + 1]):
                x, y = np.float32(runs[run, 2]), np.float32(runs[run, 3])
                for i in range(runs[run, 0], runs[run, 0] + runs[run, 1]):
                    px = ux + fxx * x + fxy * y
                    py = uy + fyx * x + fyy * y
                    within = px >= low_x and py >= low_y and px <= high_x and py <= high_y
                    mean = _beside(deformed_weight, base_x, base_y, px, py) if within else _ZERO
                    weight[i] = reference_weight[i] * mean
                    x += _ONE
        total = f1 = g1 = f2 = fg = g2 = 0.0
        for i in range(np.uint64(begin), np.uint64(end)):
            f, w = reference[i], weight[i]
            g = f - difference[i]
            wf, wg = w * f, w * g
            total += w
            f1 += wf
            g1 += wg
            f2 += wf * f
            fg += wf * g
            g2 += wg * g
        moments[e, 0], moments[e, 1], moments[e, 2] = total, f1, g1
        moments[e, 3], moments[e, 4], moments[e, 5] = f2, fg, g2


@helper()
def _any_partial(partial, left, top, right, bottom):
    """Tell whether a block is partial that holds a pixel of this rectangle, or the next one on the right or below."""
    a, b = np.int64(left) // BLOCK, np.int64(top) // BLOCK
    c = min((np.int64(right) + 1) // BLOCK + 1, partial.shape[1] - 1)
    d = min((np.int64(bottom) + 1) // BLOCK + 1, partial.shape[0] - 1)
    return partial[d, c] - partial[b, c] - partial[d, a] + partial[b, a] > 0


@helper()
def _beside(weight, base_x, base_y, px, py):
    """Bilinear mean of a weight (H, W) at a position inside; 0 next to an excluded pixel, which would lend to it."""
    cx, cy = np.floor(px), np.floor(py)
    column, row = base_x + np.int64(cx), base_y + np.int64(cy)
    tx, ty = px - cx, py - cy
    right, below = min(column + 1, weight.shape[1] - 1), min(row + 1, weight.shape[0] - 1)
    a, b = weight[row, column], weight[row, right]
    c, d = weight[below, column], weight[below, right]
    if min(a, b, c, d) <= _ZERO:
        return _ZERO
    return (_ONE - ty) * ((_ONE - tx) * a + tx * b) + ty * ((_ONE - tx) * c + tx * d)


@compiled("offsets", fastmath=FAST)
def element_squares(start, stop, difference, weight, offsets, out):
    """Sum ``w r^2``, w and the pixels with weight over every element.

    ``out`` (k, E, 3) receives the sums for a `difference` and a `weight` (k, P).
    """
    for light in range(len(weight)):
        r, w = difference[light], weight[light]
        for e in range(start, min(stop, offsets.size - 1)):
            square = total = number = _ZERO
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                square += w[i] * r[i] * r[i]
                total += w[i]
                number += _ONE if w[i] > _ZERO else _ZERO
            out[light, e, 0], out[light, e, 1], out[light, e, 2] = square, total, number


@compiled("offsets", fastmath=FAST)
def element_sums(start, stop, values, factor, offsets, out):
    """Sum fields (n, P) over every element's pixels, and their products with one factor (P,): ``out`` (n, E, 2)."""
    for n in range(len(values)):
        v = values[n]
        for e in range(start, min(stop, offsets.size - 1)):
            total = product = _ZERO
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                total += v[i]
                product += v[i] * factor[i]
            out[n, e, 0], out[n, e, 1] = total, product


@compiled("out", fastmath=FAST)
def element_vector(start, stop, weight, values, first, second, local_x, local_y, offsets, barycentric, out):
    """Project two fields on the shape functions.

    ``out`` (E, 3, 2) receives the sums of ``weight values first phi`` and ``weight values second phi``; all fields are
    (P,) float32.
    """
    for e in range(start, stop):
        _project(weight, values[offsets[e] :], first, second, local_x, local_y, offsets, barycentric, e, out)


@compiled("out", fastmath=FAST)
def corrected_vector(
    start, stop, weight, difference, first, second, reference, inverse_level, scales, side, offset, lines, run_offsets,
    local_x, local_y, offsets, barycentric, out,
):  # fmt: skip
    """Do the same with a `difference` that is corrected as by `correct_brightness`, and stays as it is."""
    values = np.empty(largest_element(offsets) + LANES, dtype=np.float32)
    brightness = reference, inverse_level, scales, side, offset
    for e in range(start, stop):
        correct_element(difference, *brightness, lines, run_offsets, offsets, e, values)
        _project(weight, values, first, second, local_x, local_y, offsets, barycentric, e, out)


@helper(fastmath=FAST)
def _project(weight, values, first, second, local_x, local_y, offsets, barycentric, e, out):
    """Project on the shape functions of element e, whose `values` these are."""
    b00, b01, b02 = _shape_function(barycentric, e, 0)
    b10, b11, b12 = _shape_function(barycentric, e, 1)
    p0 = p1 = p2 = q0 = q1 = q2 = _ZERO
    begin = np.uint64(offsets[e])
    for n in range(np.uint64(offsets[e + 1]) - begin):
        i = begin + n
        l0 = b00 + b01 * local_x[i] + b02 * local_y[i]
        l1 = b10 + b11 * local_x[i] + b12 * local_y[i]
        weighted = weight[i] * values[n]
        p, q = weighted * first[i], weighted * second[i]
        p0 += p * l0
        p1 += p * l1
        p2 += p
        q0 += q * l0
        q1 += q * l1
        q2 += q
    out[e, 0, 0], out[e, 0, 1] = p0, q0
    out[e, 1, 0], out[e, 1, 1] = p1, q1
    out[e, 2, 0], out[e, 2, 1] = p2 - p0 - p1, q2 - q0 - q1
