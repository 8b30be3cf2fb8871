"""Slow, obvious twins of the correlation and interpolation kernels: one pixel at a time, in double precision."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from rgbmidic._kernels.splines import PAD


def bspline_coefficients(image):
    """Coefficients by scipy, with the image's mirror around them."""
    inner = ndimage.spline_filter(np.asarray(image, dtype=np.float64), order=3, mode="mirror")
    return np.pad(inner, PAD, mode="reflect")


def bspline(t):
    """Centred cubic B-spline and its derivative."""
    a = abs(t)
    if a < 1:
        return 2 / 3 - a**2 + a**3 / 2, np.sign(t) * (-2 * a + 1.5 * a**2)
    if a < 2:
        return (2 - a) ** 3 / 6, -np.sign(t) * (2 - a) ** 2 / 2
    return 0.0, 0.0


def spline(coefficients, x, y):
    """Value and gradient at a point: all taps that the spline reaches, whatever they hold."""
    height, width = (size - 2 * PAD for size in coefficients.shape)
    column, row = min(int(np.floor(x)), width - 1), min(int(np.floor(y)), height - 1)
    value = gradient_x = gradient_y = 0.0
    for i in range(row - 1, row + 3):
        for j in range(column - 1, column + 3):
            (along, slope_x), (across, slope_y) = bspline(x - j), bspline(y - i)
            tap = float(coefficients[i + PAD, j + PAD])
            value += along * across * tap
            gradient_x += slope_x * across * tap
            gradient_y += along * slope_y * tap
    return value, gradient_x, gradient_y


def sample_with_gradient(coefficients, x, y):
    """Values and gradients (3, M) at points clamped to the image."""
    height, width = (size - 2 * PAD for size in coefficients.shape)
    points = zip(np.clip(x, 0, width - 1), np.clip(y, 0, height - 1), strict=True)
    return np.array([spline(coefficients, *point) for point in points]).T


def shape_functions(pixels, e, i):
    """The three shape functions of element e at pixel slot i."""
    return pixels.barycentric[e].astype(np.float64) @ [1.0, float(pixels.local_x[i]), float(pixels.local_y[i])]


def owned(pixels):
    """(element, slot) of every owned pixel."""
    return [(e, i) for e in range(len(pixels.offsets) - 1) for i in range(pixels.offsets[e], pixels.offsets[e + 1])]


def moved(pixels, mesh, displacement, e, i):
    """Position (x, y) of a pixel in the deformed image."""
    u = shape_functions(pixels, e, i) @ displacement[mesh.elements[e]]
    return pixels.columns[i] + u[0], pixels.rows[i] + u[1]


def inside(shape, x, y):
    return 0 <= x <= shape[1] - 1 and 0 <= y <= shape[0] - 1


def warp(coefficients, pixels, mesh, displacement):
    """g(x + u) at the owned pixels (P,); NaN outside the image."""
    out = np.full(pixels.rows.size, np.nan)
    for e, i in owned(pixels):
        x, y = moved(pixels, mesh, displacement, e, i)
        if inside(pixels.shape, x, y):
            out[i] = spline(coefficients, x, y)[0]
    return out


def element_hessian(gradient, weight, pixels):
    """Sums (E, 3, 3, 3) of w (gx gx, gx gy, gy gy) phi_a phi_b."""
    out = np.zeros((len(pixels.offsets) - 1, 3, 3, 3))
    for e, i in owned(pixels):
        gx, gy, phi = float(gradient[0][i]), float(gradient[1][i]), shape_functions(pixels, e, i)
        for a in range(3):
            for b in range(3):
                out[e, a, b] += float(weight[i]) * phi[a] * phi[b] * np.array([gx * gx, gx * gy, gy * gy])
    return out


def element_block_products(gradient, weight, pixels, sign, side, apart):
    """Sums (apart apart, E, 3, 3) of s w (gx gx, gx gy, gy gy) phi_a over the blocks of each place."""
    out = np.zeros((apart * apart, len(pixels.offsets) - 1, 3, 3))
    top, left, _, _ = pixels.bounds
    for e, i in owned(pixels):
        row, column = (int(pixels.rows[i]) - top) // side, (int(pixels.columns[i]) - left) // side
        gx, gy, phi = float(gradient[0][i]), float(gradient[1][i]), shape_functions(pixels, e, i)
        for a in range(3):
            product = float(sign[row, column]) * float(weight[i]) * phi[a] * np.array([gx * gx, gx * gy, gy * gy])
            out[row % apart * apart + column % apart, e, a] += product
    return out


def element_moments(reference, difference, weight, pixels):
    """Sums (E, 6) of w, w f, w g, w f f, w f g, w g g for g = f - difference."""
    out = np.zeros((len(pixels.offsets) - 1, 6))
    for e, i in owned(pixels):
        f, w = float(reference[i]), float(weight[i])
        g = f - float(difference[i])
        out[e] += w, w * f, w * g, w * f * f, w * f * g, w * g * g
    return out


def element_squares(difference, weight, pixels):
    """Sums (k, E, 3) of w r^2, of w and of the pixels with weight."""
    out = np.zeros((len(weight), len(pixels.offsets) - 1, 3))
    for e, i in owned(pixels):
        w, r = weight[:, i].astype(float), difference[:, i].astype(float)
        out[:, e] += np.stack([w * r * r, w, w > 0], axis=1)
    return out


def element_sums(values, factor, pixels):
    """Sums (n, E, 2) of fields and of them times a factor."""
    out = np.zeros((len(values), len(pixels.offsets) - 1, 2))
    for e, i in owned(pixels):
        v = values[:, i].astype(float)
        out[:, e] += np.stack([v, v * float(factor[i])], axis=1)
    return out


def pull_back(deformed_weight, reference_weight, pixels, mesh, displacement):
    """Reference weight times the bilinear deformed weight, 0 where one of its four pixels is 0 or lies outside."""
    out = np.zeros(pixels.rows.size)
    height, width = pixels.shape
    for e, i in owned(pixels):
        x, y = moved(pixels, mesh, displacement, e, i)
        if not inside(pixels.shape, x, y):
            continue
        column, row = int(np.floor(x)), int(np.floor(y))
        right, below = min(column + 1, width - 1), min(row + 1, height - 1)
        corners = np.array([[deformed_weight[r, c] for c in (column, right)] for r in (row, below)], dtype=np.float64)
        if corners.min() > 0:
            along, across = x - column, y - row
            value = [1 - across, across] @ corners @ [1 - along, along]
            out[i] = float(reference_weight[i]) * value
    return out


def element_vector(weight, values, first, second, pixels):
    """Sums (E, 3, 2) of two weighted products of pixel fields times the shape functions."""
    out = np.zeros((len(pixels.offsets) - 1, 3, 2))
    for e, i in owned(pixels):
        for a, phi in enumerate(shape_functions(pixels, e, i)):
            weighted = float(weight[i]) * float(values[i]) * phi
            out[e, a] += weighted * float(first[i]), weighted * float(second[i])
    return out


def interpolate_nodal(values, pixels, mesh):
    """A nodal field (N, 2) at the owned pixels, (2, P)."""
    return np.array([shape_functions(pixels, e, i) @ values[mesh.elements[e]] for e, i in owned(pixels)]).T


def curvature_deviation(curvature, pixels, mesh):
    """A field with the second derivatives (N, 2, 3) of the nodes minus its linear interpolant, (2, P): quadratic along
    an edge, with the mean of its ends."""
    out = []
    for e, i in owned(pixels):
        phi, total = shape_functions(pixels, e, i), np.zeros(2)
        for first, second in ((0, 1), (1, 2), (2, 0)):
            a, b = mesh.elements[e, first], mesh.elements[e, second]
            (dx, dy), (xx, xy, yy) = mesh.nodes[b] - mesh.nodes[a], ((curvature[a] + curvature[b]) / 2).T
            total -= phi[first] * phi[second] / 2 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy)
        out.append(total)
    return np.array(out).T
