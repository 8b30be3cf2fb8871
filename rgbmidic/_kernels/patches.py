"""Values at the pixels of elements: nodal interpolation and quadratic trends."""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled


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


@compiled("polynomials", fastmath=FAST)
def subtract_quadratic(
    start, stop, difference, gradient_x, gradient_y, polynomials, local_x, local_y, offsets, out,
):  # fmt: skip
    """Take the effect of a displacement d, quadratic in every element, out of a residual.

    ``out`` (k, P) receives ``difference - grad f . d``, all (k, P) float32. `polynomials` (E, 2, 6) float32 holds the
    coefficients of 1, x, y, x^2, x y, y^2 of the local position, in px.
    """
    for light in range(len(difference)):
        given, gx, gy, less = difference[light], gradient_x[light], gradient_y[light], out[light]
        for e in range(start, stop):
            u, v = polynomials[e, 0], polynomials[e, 1]
            u0, u1, u2, u3, u4, u5 = u[0], u[1], u[2], u[3], u[4], u[5]
            v0, v1, v2, v3, v4, v5 = v[0], v[1], v[2], v[3], v[4], v[5]
            for i in range(np.uint64(offsets[e]), np.uint64(offsets[e + 1])):
                x, y = local_x[i], local_y[i]
                dx = u0 + x * (u1 + u3 * x + u4 * y) + y * (u2 + u5 * y)
                dy = v0 + x * (v1 + v3 * x + v4 * y) + y * (v2 + v5 * y)
                less[i] = given[i] - gx[i] * dx - gy[i] * dy
