"""The sums of the MIDIC minimisation over the pixels of each element (paper, eq. 3).

Pixels are stored element by element: element e owns the slots ``offsets[e]:offsets[e + 1]``. Each element writes its
own row of the output, so the sums are the same bits on any number of threads. Positions are kept relative to the
element's origin pixel: float32 then resolves 1e-5 px on images of any size. Slots are counted without sign: an index
that may be negative would be looked at for each pixel, and the loop not vectorised.
"""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.owned_pixels import LANES, largest_element
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
"""Side (px) of the blocks that `find_changed_weights` looks up, all weights 1 or not: eight bytes, compared at once."""
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


@helper(fastmath=FAST)
def _element_differences(
    coefficients, height, width, reference, runs, run_offsets, origin, elements, barycentric, displacement, e, begin,
    out,
):  # fmt: skip
    """Write ``f - g(x + u)`` of element e into ``out`` (k, n), whose first is slot `begin`; 0 outside the image.

    `coefficients` are those of all lights, one behind the other, whose images have `height` and `width`. What follows
    the element's last pixel is overwritten, up to a vector.
    """
    across = np.uint64(width + 2 * PAD)
    area, lights = np.uint64(height + 2 * PAD) * across, np.uint64(len(reference))
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
            target = np.uint64(slot) - begin
            if not (px >= low_x and py >= low_y and px <= high_x and py <= high_y):
                for light in range(lights):
                    out[light, target] = _ZERO
                slot, remaining, x = slot + 1, remaining - 1, x + _ONE
                continue
            cx, cy = np.floor(px), np.floor(py)
            column, row = base_x + np.int64(cx), base_y + np.int64(cy)
            tx, ty = px - cx, py - cy
            side_by_side = min((end_x - tx) * pace_x, (end_y - ty) * pace_y, np.float32(remaining - 1))
            n = max(min(np.int64(side_by_side) + 1, width - 1 - column), 1)
            # whole vectors, of which the last one may be too long, where memory goes on so far
            filled = (n + LANES - 1) // LANES * LANES
            if slot + filled > reference.shape[1] or column + filled + 3 >= width + 2 * PAD:
                filled = n
            i0, first = np.uint64(slot), np.uint64(row + PAD - 1) * across + np.uint64(column + PAD - 1)
            for light in range(lights):
                cell = first + light * area
                for i in range(np.uint32(filled)):
                    t = np.float32(np.int32(i))
                    g = _spline(coefficients, cell, across, i, tx + (fxx - _ONE) * t, ty + fyx * t)
                    out[light, target + i] = reference[light, i0 + i] - g
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
def find_changed_weights(
    start, stop, partial, height, width, runs, run_offsets, origin, elements, barycentric, displacement, is_changed,
):  # fmt: skip
    """Find where the weights of lights that move alike may be others than those of the reference.

    `partial` (k, h + 1, w + 1) int32 counts where a weight of the deformed images, of `height` and `width`, is other
    than 1: how many such blocks of `BLOCK` px lie above and to the left. `is_changed` (k, E) receives the result.

    `runs` (R, 4) int32, `run_offsets` (E + 1,) and `origin` (E, 2) are as in `rgbmidic.mesh.PixelMap`; `barycentric`
    (E, 3, 3) float64 has the shape function ``b[0] + b[1] x + b[2] y`` of the local position; `displacement` (N, 2).
    """
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        left = top = np.float32(np.inf)
        right = bottom = -np.float32(np.inf)
        for run in range(run_offsets[e], run_offsets[e + 1]):
            first, y = np.float32(runs[run, 2]), np.float32(runs[run, 3])
            for x in (first, first + np.float32(runs[run, 1])):  # its first pixel, and the one behind its last
                px = ux + fxx * x + fxy * y
                py = uy + fyx * x + fyy * y
                left, right, top, bottom = min(left, px), max(right, px), min(top, py), max(bottom, py)
        sides = base_x + left, base_y + top, base_x + right, base_y + bottom
        outside = sides[0] < 0 or sides[1] < 0 or sides[2] > width - 1 or sides[3] > height - 1
        for light in range(len(is_changed)):
            if run_offsets[e] == run_offsets[e + 1]:
                is_changed[light, e] = False
            else:
                is_changed[light, e] = outside or _any_partial(partial, light, *sides)


@compiled("elements", fastmath=FAST)
def compare_states(
    start, stop, coefficients, deformed_weight, reference, reference_weight, is_changed, runs, run_offsets, origin,
    elements, barycentric, displacement, offsets, difference, weight, moments,
):  # fmt: skip
    """Compare lights that move alike: differences, weights, and the sums of the grey levels of both states with them.

    `difference` (k, P) float32 receives ``f - g(x + u)`` at the owned pixels, 0 outside the deformed image, with the
    `coefficients` (k, H + 2 PAD, W + 2 PAD) of g. `weight` (k, P) float32 holds the `reference_weight` (k, P); where it
    `is_changed`, as by `find_changed_weights`, it receives that times the `deformed_weight` (k, H, W) at the displaced
    position (bilinear), 0 outside and beside excluded pixels. `moments` (k, E, 6) receives the sums of w, w f, w g,
    w f f, w f g, w g g. What describes the motion is as there.
    """
    _, height, width = deformed_weight.shape
    flat, lights = coefficients.ravel(), len(reference)
    buffer = np.empty((lights, largest_element(offsets) + LANES), np.float32)
    for e in range(start, stop):
        begin, motion = np.uint64(offsets[e]), (elements, barycentric, displacement)
        number = np.uint64(offsets[e + 1]) - begin
        _element_differences(flat, height, width, reference, runs, run_offsets, origin, *motion, e, begin, buffer)
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        low_x, low_y = np.float32(-base_x), np.float32(-base_y)
        high_x, high_y = np.float32(width - 1 - base_x), np.float32(height - 1 - base_y)
        for light in range(lights):
            for run in range(run_offsets[e], run_offsets[e + 1] if is_changed[light, e] else run_offsets[e]):
                x, y = np.float32(runs[run, 2]), np.float32(runs[run, 3])
                for i in range(runs[run, 0], runs[run, 0] + runs[run, 1]):
                    px = ux + fxx * x + fxy * y
                    py = uy + fyx * x + fyy * y
                    within = px >= low_x and py >= low_y and px <= high_x and py <= high_y
                    mean = _beside(deformed_weight, light, base_x, base_y, px, py) if within else _ZERO
                    weight[light, i] = reference_weight[light, i] * mean
                    x += _ONE
            total = f1 = g1 = f2 = fg = g2 = 0.0
            for i in range(number):
                f, w, d = reference[light, begin + i], weight[light, begin + i], buffer[light, i]
                difference[light, begin + i] = d
                g = f - d
                wf, wg = w * f, w * g
                total += w
                f1 += wf
                g1 += wg
                f2 += wf * f
                fg += wf * g
                g2 += wg * g
            moments[light, e, 0], moments[light, e, 1], moments[light, e, 2] = total, f1, g1
            moments[light, e, 3], moments[light, e, 4], moments[light, e, 5] = f2, fg, g2


@helper()
def _any_partial(partial, light, left, top, right, bottom):
    """Tell whether a block is partial that holds a pixel of this rectangle, or the next one on the right or below."""
    a, b = np.int64(left) // BLOCK, np.int64(top) // BLOCK
    c = min((np.int64(right) + 1) // BLOCK + 1, partial.shape[2] - 1)
    d = min((np.int64(bottom) + 1) // BLOCK + 1, partial.shape[1] - 1)
    return partial[light, d, c] - partial[light, b, c] - partial[light, d, a] + partial[light, b, a] > 0


@helper()
def _beside(weight, light, base_x, base_y, px, py):
    """Bilinear mean of a light's weight (k, H, W) at a position; 0 next to an excluded one, which would lend to it."""
    cx, cy = np.floor(px), np.floor(py)
    column, row = base_x + np.int64(cx), base_y + np.int64(cy)
    tx, ty = px - cx, py - cy
    right, below = min(column + 1, weight.shape[2] - 1), min(row + 1, weight.shape[1] - 1)
    a, b = weight[light, row, column], weight[light, row, right]
    c, d = weight[light, below, column], weight[light, below, right]
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


@compiled("offsets", fastmath=FAST)
def element_vector(start, stop, weight, values, first, second, local_x, local_y, offsets, barycentric, out):
    """Project two fields of each light on the shape functions.

    ``out`` (k, E, 3, 2) receives the sums of ``weight values first phi`` and ``weight values second phi``; all fields
    are (k, P) float32.
    """
    for e in range(start, min(stop, offsets.size - 1)):
        for light in range(len(weight)):
            p = px = py = q = qx = qy = _ZERO
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                weighted = weight[light, i] * values[light, i]
                a, b = weighted * first[light, i], weighted * second[light, i]
                p += a
                px += a * local_x[i]
                py += a * local_y[i]
                q += b
                qx += b * local_x[i]
                qy += b * local_y[i]
            for a in range(3):
                constant, along_x, along_y = barycentric[e, a, 0], barycentric[e, a, 1], barycentric[e, a, 2]
                out[light, e, a, 0] = constant * p + along_x * px + along_y * py
                out[light, e, a, 1] = constant * q + along_x * qx + along_y * qy
