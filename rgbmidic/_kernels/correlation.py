"""The sums of the MIDIC minimisation over the pixels of each element (paper, eq. 3).

Pixels are stored element by element: element e owns the slots ``offsets[e]:offsets[e + 1]``. Each element writes its
own row of the output, so the sums are the same bits on any number of threads. Positions are kept relative to the
element's origin pixel: float32 then resolves 1e-5 px on images of any size. Slots are counted without sign: an index
that may be negative would be looked at for each pixel, and the loop not vectorised.
"""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.interpolation import _FAST, PAD
from rgbmidic._kernels.threads import over_ranges

__all__ = [
    "curvature_deviation",
    "element_hessian",
    "element_moments",
    "element_right_side",
    "element_vector",
    "interpolate_nodal",
    "pull_back",
    "warp",
]

_SIXTH = np.float32(1.0 / 6.0)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)


@helper(forceinline=True, fastmath=_FAST)
def _spline(coefficients, row, column, tx, ty):
    """Cubic B-spline value at pixel (row, column) plus the fraction (tx, ty); `coefficients` carry the padding."""
    t2 = tx * tx
    t3 = t2 * tx
    x3 = t3 * _SIXTH
    x0 = _SIXTH - np.float32(0.5) * (tx - t2) - x3
    x1 = np.float32(2.0 / 3.0) - t2 + np.float32(0.5) * t3
    x2 = _ONE - x0 - x1 - x3
    t2 = ty * ty
    t3 = t2 * ty
    y3 = t3 * _SIXTH
    y0 = _SIXTH - np.float32(0.5) * (ty - t2) - y3
    y1 = np.float32(2.0 / 3.0) - t2 + np.float32(0.5) * t3
    y2 = _ONE - y0 - y1 - y3
    r0 = np.uint64(row + (PAD - 1))
    c0 = np.uint64(column + (PAD - 1))
    r1, r2, r3 = r0 + np.uint64(1), r0 + np.uint64(2), r0 + np.uint64(3)
    c1, c2, c3 = c0 + np.uint64(1), c0 + np.uint64(2), c0 + np.uint64(3)
    k = coefficients
    return (
        y0 * (x0 * k[r0, c0] + x1 * k[r0, c1] + x2 * k[r0, c2] + x3 * k[r0, c3])
        + y1 * (x0 * k[r1, c0] + x1 * k[r1, c1] + x2 * k[r1, c2] + x3 * k[r1, c3])
        + y2 * (x0 * k[r2, c0] + x1 * k[r2, c1] + x2 * k[r2, c2] + x3 * k[r2, c3])
        + y3 * (x0 * k[r3, c0] + x1 * k[r3, c1] + x2 * k[r3, c2] + x3 * k[r3, c3])
    )


@helper(forceinline=True)
def _place(px, py, base_x, base_y, height, width):
    """Pixel (column, row) and fraction of a local position, and whether it lies outside the image."""
    cx = np.floor(px)
    cy = np.floor(py)
    column = base_x + np.int64(cx)
    row = base_y + np.int64(cy)
    tx = px - cx
    ty = py - cy
    beyond_x = column < 0 or column > width - 1 or (column == width - 1 and tx > _ZERO)
    beyond_y = row < 0 or row > height - 1 or (row == height - 1 and ty > _ZERO)
    return column, row, tx, ty, beyond_x or beyond_y


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


@over_ranges("elements")
@compiled(fastmath=_FAST)
def element_right_side(
    start, stop, coefficients, reference, gradient_x, gradient_y, weight, local_x, local_y, offsets, origin, elements,
    barycentric, displacement, out, sums,
):  # fmt: skip
    """Right-hand side of one light, element by element.

    `coefficients` of the deformed image; `reference`, `gradient_x`, `gradient_y`, `weight` (P,) float32 and `local_x`,
    `local_y` (P,) float32 per owned pixel; `origin` (E, 2) int64; `barycentric` (E, 3, 3) float64 with the shape
    function ``b[0] + b[1] x + b[2] y`` of the local position; `displacement` (N, 2) float64.
    `out` (E, 3, 2) receives ``sum w (f - g(x + u)) grad f phi``; `sums` (E, 3) receives ``sum w r^2``, ``sum w`` and
    the number of pixels with weight whose position has left the image.
    """
    height = coefficients.shape[0] - 2 * PAD
    width = coefficients.shape[1] - 2 * PAD
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        low_x = np.float32(-base_x)
        low_y = np.float32(-base_y)
        high_x = np.float32(width - 1 - base_x)
        high_y = np.float32(height - 1 - base_y)
        b00 = np.float32(barycentric[e, 0, 0])
        b01 = np.float32(barycentric[e, 0, 1])
        b02 = np.float32(barycentric[e, 0, 2])
        b10 = np.float32(barycentric[e, 1, 0])
        b11 = np.float32(barycentric[e, 1, 1])
        b12 = np.float32(barycentric[e, 1, 2])
        s00 = s01 = s02 = s10 = s11 = s12 = _ZERO
        rest = total = lost = _ZERO
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            lx = local_x[i]
            ly = local_y[i]
            px = ux + fxx * lx + fxy * ly
            py = uy + fyx * lx + fyy * ly
            w = weight[i]
            inside = (px >= low_x) & (px <= high_x) & (py >= low_y) & (py <= high_y)
            lost += _ZERO if inside or w == _ZERO else _ONE
            w = w if inside else _ZERO
            px = min(max(px, low_x), high_x)
            py = min(max(py, low_y), high_y)
            cx = np.floor(px)
            cy = np.floor(py)
            g = _spline(coefficients, base_y + np.int64(cy), base_x + np.int64(cx), px - cx, py - cy)
            r = reference[i] - g
            wr = w * r
            rest += wr * r
            total += w
            wx = wr * gradient_x[i]
            wy = wr * gradient_y[i]
            l0 = b00 + b01 * lx + b02 * ly
            l1 = b10 + b11 * lx + b12 * ly
            s00 += wx * l0
            s10 += wy * l0
            s01 += wx * l1
            s11 += wy * l1
            s02 += wx
            s12 += wy
        out[e, 0, 0] = s00
        out[e, 0, 1] = s10
        out[e, 1, 0] = s01
        out[e, 1, 1] = s11
        out[e, 2, 0] = s02 - s00 - s01
        out[e, 2, 1] = s12 - s10 - s11
        sums[e, 0] = rest
        sums[e, 1] = total
        sums[e, 2] = lost


@over_ranges("out")
@compiled(fastmath=_FAST)
def element_hessian(start, stop, gradient_x, gradient_y, weight, local_x, local_y, offsets, barycentric, out):
    """Hessian (correlation matrix) of one light: ``out`` (E, 3, 3, 3) receives ``sum w D phi_a phi_b``.

    The last axis of `out` holds D = (gx gx, gx gy, gy gy).
    """
    for e in range(start, stop):
        b00 = np.float32(barycentric[e, 0, 0])
        b01 = np.float32(barycentric[e, 0, 1])
        b02 = np.float32(barycentric[e, 0, 2])
        b10 = np.float32(barycentric[e, 1, 0])
        b11 = np.float32(barycentric[e, 1, 1])
        b12 = np.float32(barycentric[e, 1, 2])
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


@over_ranges("elements")
@compiled()
def warp(start, stop, coefficients, local_x, local_y, offsets, origin, elements, barycentric, displacement, out):
    """Deformed image brought back to the reference: ``out`` (P,) float32 receives g(x + u), NaN outside the image."""
    height = coefficients.shape[0] - 2 * PAD
    width = coefficients.shape[1] - 2 * PAD
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            px = ux + fxx * local_x[i] + fxy * local_y[i]
            py = uy + fyx * local_x[i] + fyy * local_y[i]
            column, row, tx, ty, outside = _place(px, py, base_x, base_y, height, width)
            if outside:
                out[i] = np.nan
            else:
                out[i] = _spline(coefficients, row, column, tx, ty)


@over_ranges("out")
@compiled(fastmath=_FAST)
def element_moments(start, stop, reference, warped, weight, offsets, out):
    """Weighted moments of reference and warped deformed image: ``out`` (E, 6) receives the sums of
    w, w f, w g, w f f, w f g, w g g over the pixels with weight and a finite g."""
    for e in range(start, stop):
        total = f1 = g1 = f2 = fg = g2 = 0.0
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            g = warped[i]
            w = weight[i]
            if w == _ZERO or not np.isfinite(g):
                continue
            f = reference[i]
            total += w
            f1 += w * f
            g1 += w * g
            f2 += w * f * f
            fg += w * f * g
            g2 += w * g * g
        out[e, 0], out[e, 1], out[e, 2], out[e, 3], out[e, 4], out[e, 5] = total, f1, g1, f2, fg, g2


@over_ranges("elements")
@compiled()
def pull_back(start, stop, deformed_weight, reference_weight, local_x, local_y, offsets, origin, elements, barycentric,
              displacement, out):  # fmt: skip
    """Weight of each owned pixel: the reference's times the deformed image's at the displaced position (bilinear).

    `deformed_weight` (H, W) float32, `reference_weight` (P,) float32; positions outside the image give 0.
    """
    height, width = deformed_weight.shape
    for e in range(start, stop):
        base_x, base_y, ux, uy, fxx, fxy, fyx, fyy = _element_motion(displacement, elements, barycentric, origin, e)
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            px = ux + fxx * local_x[i] + fxy * local_y[i]
            py = uy + fyx * local_x[i] + fyy * local_y[i]
            column, row, tx, ty, outside = _place(px, py, base_x, base_y, height, width)
            if outside:
                out[i] = _ZERO
                continue
            right = min(column + 1, width - 1)
            below = min(row + 1, height - 1)
            a = deformed_weight[row, column]
            b = deformed_weight[row, right]
            c = deformed_weight[below, column]
            d = deformed_weight[below, right]
            value = (_ONE - ty) * ((_ONE - tx) * a + tx * b) + ty * ((_ONE - tx) * c + tx * d)
            # a pixel next to an excluded one would borrow from it through the interpolation
            out[i] = reference_weight[i] * value if min(a, b, c, d) > _ZERO else _ZERO


@over_ranges("out")
@compiled(fastmath=_FAST)
def element_vector(start, stop, first, second, local_x, local_y, offsets, barycentric, out):
    """Projection of two pixel fields on the shape functions: ``out`` (E, 3, 2) receives their sums times phi."""
    for e in range(start, stop):
        b00 = np.float32(barycentric[e, 0, 0])
        b01 = np.float32(barycentric[e, 0, 1])
        b02 = np.float32(barycentric[e, 0, 2])
        b10 = np.float32(barycentric[e, 1, 0])
        b11 = np.float32(barycentric[e, 1, 1])
        b12 = np.float32(barycentric[e, 1, 2])
        p0 = p1 = p2 = q0 = q1 = q2 = _ZERO
        for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
            l0 = b00 + b01 * local_x[i] + b02 * local_y[i]
            l1 = b10 + b11 * local_x[i] + b12 * local_y[i]
            p0 += first[i] * l0
            p1 += first[i] * l1
            p2 += first[i]
            q0 += second[i] * l0
            q1 += second[i] * l1
            q2 += second[i]
        out[e, 0, 0], out[e, 0, 1] = p0, q0
        out[e, 1, 0], out[e, 1, 1] = p1, q1
        out[e, 2, 0], out[e, 2, 1] = p2 - p0 - p1, q2 - q0 - q1


@over_ranges("elements")
@compiled()
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


@over_ranges("elements")
@compiled()
def curvature_deviation(start, stop, nodes, elements, curvature, local_x, local_y, offsets, barycentric, out):
    """Deviation of a curved field from its linear interpolant, ``out`` (2, P) float32.

    `curvature` (N, 2, 3) float64 holds the second derivatives (xx, xy, yy) of both components at the nodes; along an
    edge that is the mean of its ends: ``-1/2 sum_{a<b} phi_a phi_b (x_a - x_b)^T H_ab (x_a - x_b)``, continuous.
    """
    for e in range(start, stop):
        for c in range(2):
            half_01 = _half_sag(nodes, elements[e, 0], elements[e, 1], curvature, c)
            half_12 = _half_sag(nodes, elements[e, 1], elements[e, 2], curvature, c)
            half_20 = _half_sag(nodes, elements[e, 2], elements[e, 0], curvature, c)
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                l0 = barycentric[e, 0, 0] + barycentric[e, 0, 1] * local_x[i] + barycentric[e, 0, 2] * local_y[i]
                l1 = barycentric[e, 1, 0] + barycentric[e, 1, 1] * local_x[i] + barycentric[e, 1, 2] * local_y[i]
                l2 = 1.0 - l0 - l1
                out[c, i] = half_01 * l0 * l1 + half_12 * l1 * l2 + half_20 * l2 * l0


@helper()
def _half_sag(nodes, a, b, curvature, c):
    """Half the second difference of component c along the edge from node a to node b."""
    dx = nodes[a, 0] - nodes[b, 0]
    dy = nodes[a, 1] - nodes[b, 1]
    h = curvature[a, c] + curvature[b, c]
    return -0.25 * (h[0] * dx * dx + 2.0 * h[1] * dx * dy + h[2] * dy * dy)
