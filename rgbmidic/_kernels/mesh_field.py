"""Values given at the nodes of a triangle mesh, interpolated linearly at any points."""

from __future__ import annotations

import math

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.threads import over_ranges

__all__ = ["interpolate_nodal"]

_EDGE = -1e-9


@over_ranges("out", grain=4096)
@compiled()
def interpolate_nodal(start, stop, out, x, y, nodes, elements, values, box, first, members):
    """Write the linear interpolation (2,) of `values` (N, 2) at every point, NaN outside the mesh.

    Parameters
    ----------
    out : (M, 2)
    x, y : (M,)
    nodes, elements, values : (N, 2), (E, 3), (N, 2)
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
