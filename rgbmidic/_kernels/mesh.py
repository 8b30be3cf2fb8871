"""Triangle meshes: owners of pixels, colouring, interpolation at points."""

from __future__ import annotations

import math

import numpy as np

from rgbmidic._kernels.threads import compiled


@compiled()
def claim_pixels(nodes, elements, owner):
    """Give every pixel of the region to the first element that contains its centre.

    `nodes` (N, 2) float64, `elements` (E, 3) of positive orientation; `owner` (H, W) int32 holds -1 for a free pixel of
    the region and -2 outside the region, and receives the element index.
    """
    height, width = owner.shape
    for e in range(len(elements)):
        y = nodes[elements[e, 0], 1], nodes[elements[e, 1], 1], nodes[elements[e, 2], 1]
        tolerance = 25e-9 * (1.0 + abs(nodes[elements[e, 0], 0]) + abs(y[0]))
        top, bottom = max(np.ceil(min(y) - tolerance), 0.0), min(np.floor(max(y) + tolerance), height - 1.0)
        for row in range(int(top), int(bottom) + 1):
            first, last = 0.0, width - 1.0
            for a in range(3):
                x0, y0 = nodes[elements[e, a], 0], y[a]
                dx, dy = nodes[elements[e, (a + 1) % 3], 0] - x0, y[(a + 1) % 3] - y0
                reach = dx * (row - y0) + dy * x0 + tolerance  # inside are the columns with dy * column <= reach
                if dy > 0:
                    last = min(last, np.floor(reach / dy))
                elif dy < 0:
                    first = max(first, np.ceil(reach / dy))
                elif reach < 0:
                    last = -1.0
            for column in range(int(first), int(last) + 1):
                if owner[row, column] == -1:
                    owner[row, column] = e


@compiled()
def colour_nodes(starts, near, occupied, colour):
    """Give each node the first colour that no earlier node with a neighbour in common has.

    `occupied` (N, C), bool, is set where a node or one `near` it has a colour.

    The nodes near node n, itself with them, are ``near[starts[n]:starts[n + 1]]``; `colour` (N,) receives its colour.
    """
    for node in range(colour.size):
        begin, end = starts[node], starts[node + 1]
        candidate, k = 0, begin
        while k < end:
            if occupied[near[k], candidate]:
                candidate, k = candidate + 1, begin
            else:
                k += 1
        colour[node] = candidate
        for k in range(begin, end):
            occupied[near[k], candidate] = True


_EDGE = -1e-9
"""Shape function from which a point on an edge is inside: rounding of float64 on images of 1e5 px is 1e-11."""


@compiled("out", grain=4096)
def interpolate_at_points(start, stop, out, x, y, nodes, elements, values, box, first, members):
    """Write the linear interpolation (2,) of `values` (N, 2) at every point, NaN outside the mesh.

    Parameters
    ----------
    start, stop
        Range of points that this call does.
    out : (M, 2)
        Written: the interpolation.
    x, y : (M,)
        Points, px.
    nodes, elements, values : (N, 2), (E, 3), (N, 2)
        The mesh (px) and what is interpolated.
    box : (5,)
        Bins that list the elements: x0, y0, side, columns, rows.
    first, members
        ``members[first[b]:first[b + 1]]`` are the elements whose bounding box meets bin b.
    """
    columns, rows = int(box[3]), int(box[4])
    for p in range(start, stop):
        out[p, 0] = out[p, 1] = np.nan
        i, j = math.floor((x[p] - box[0]) / box[2]), math.floor((y[p] - box[1]) / box[2])
        if not (0 <= i < columns and 0 <= j < rows):
            continue
        b = j * columns + i
        for m in range(first[b], first[b + 1]):
            a, c, d = elements[members[m], 0], elements[members[m], 1], elements[members[m], 2]
            ux, uy = nodes[c, 0] - nodes[a, 0], nodes[c, 1] - nodes[a, 1]
            wx, wy = nodes[d, 0] - nodes[a, 0], nodes[d, 1] - nodes[a, 1]
            qx, qy = x[p] - nodes[a, 0], y[p] - nodes[a, 1]
            area = ux * wy - uy * wx
            s, t = (qx * wy - qy * wx) / area, (ux * qy - uy * qx) / area
            if s >= _EDGE and t >= _EDGE and s + t <= 1.0 - _EDGE:
                for k in range(2):
                    out[p, k] = (1.0 - s - t) * values[a, k] + s * values[c, k] + t * values[d, k]
                break
