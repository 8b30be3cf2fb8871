"""Values at the pixels of elements and patches: nodal interpolation, quadratic trends, correlation of two patches."""

import numpy as np

from rgbmidic._kernels.threads import FAST, compiled, over_ranges

_ZERO = np.float32(0.0)


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


@over_ranges("polynomials")
@compiled(fastmath=FAST)
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


@over_ranges("out", least=1 << 12)
@compiled(fastmath=FAST)
def patch_correlations(start, stop, first, second, centres, half, out):
    """Correlation coefficients of the patch (2 half + 1)^2 of `first` around each centre with those of `second`.

    `centres` (n, 2) are rows and columns; ``out`` (n, 2 m + 1, 2 m + 1) receives the zero-mean coefficient for shifts
    of up to m rows and columns, 0 where a patch is blank. The patches lie within the images.
    """
    side, most = 2 * half + 1, out.shape[1] // 2
    patch, area = np.empty((side, side), dtype=np.float32), side * side
    for n in range(start, stop):
        top, left = centres[n, 0] - half, centres[n, 1] - half
        level, power = first[top : top + side, left : left + side].mean(), 0.0
        for i in range(side):
            for j in range(side):
                patch[i, j] = first[top + i, left + j] - level
                power += patch[i, j] * patch[i, j]
        for down in range(out.shape[1]):
            for along in range(out.shape[2]):
                product = total = square = _ZERO
                for i in range(side):
                    line = second[top + down - most + i, left + along - most :]
                    for j in range(np.uint64(side)):
                        product += patch[i, j] * line[j]
                        total += line[j]
                        square += line[j] * line[j]
                spread = power * (square - total * total / area)
                out[n, down, along] = product / np.sqrt(spread) if spread > 0.0 else _ZERO
