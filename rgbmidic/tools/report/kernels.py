"""A field on a triangle mesh, painted as the pixels of a screen."""

import math

import numpy as np

from rgbmidic._kernels.threads import compiled

_EDGE = 1e-6
"""Distance (px) within which a pixel on an edge is painted by both elements: no gap through rounding in float64."""
_GREY_STEP, _OPAQUE = np.uint32(0x010101), np.uint32(0xFF000000)
"""A grey level in the three colours of a pixel, and its opacity, as the bytes of a number."""


@compiled("out", grain=16)
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
            out[row, column] = np.uint32(grey[row, column]) * _GREY_STEP | _OPAQUE
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
                colour_position = base + slope * np.float32(column)
                if nearest:
                    a, b = a0 + ac * column, b0 + bc * column
                    c = 1.0 - a - b
                    corner_value = vi if c >= a and c >= b else (vj if a >= b else vk)
                    colour_position = np.float32(scale * (corner_value - low))
                index = np.int32(min(max(colour_position, np.float32(0)), last))
                background = (np.uint32(grey[row, column]) * share) >> np.uint32(8)
                out[row, column] = colours[index] + background * _GREY_STEP
