"""Which element owns which pixel."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.compilation import compiled

__all__ = ["claim_pixels", "list_pixels"]


@compiled()
def claim_pixels(nodes, elements, owner, counts):
    """Give every pixel of the region to the first element that contains its centre.

    `nodes` (N, 2) float64, `elements` (E, 3); `owner` (H, W) int32 holds -1 for a free pixel of the region and -2
    outside the region, and receives the element index; `counts` (E,) int64 receives the pixels of each element.
    """
    height, width = owner.shape
    for e in range(elements.shape[0]):
        x0, y0 = nodes[elements[e, 0], 0], nodes[elements[e, 0], 1]
        x1, y1 = nodes[elements[e, 1], 0], nodes[elements[e, 1], 1]
        x2, y2 = nodes[elements[e, 2], 0], nodes[elements[e, 2], 1]
        tolerance = 1e-9 * (1.0 + abs(x0) + abs(y0)) * 25.0
        top = max(int(np.ceil(min(y0, y1, y2) - tolerance)), 0)
        bottom = min(int(np.floor(max(y0, y1, y2) + tolerance)), height - 1)
        left = max(int(np.ceil(min(x0, x1, x2) - tolerance)), 0)
        right = min(int(np.floor(max(x0, x1, x2) + tolerance)), width - 1)
        count = 0
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                if owner[row, column] != -1:
                    continue
                # the three edge functions are non-negative inside a triangle of positive orientation
                a = (x1 - x0) * (row - y0) - (y1 - y0) * (column - x0)
                b = (x2 - x1) * (row - y1) - (y2 - y1) * (column - x1)
                c = (x0 - x2) * (row - y2) - (y0 - y2) * (column - x2)
                if a >= -tolerance and b >= -tolerance and c >= -tolerance:
                    owner[row, column] = e
                    count += 1
        counts[e] = count


@compiled()
def list_pixels(owner, position, rows, columns):
    """Write the pixels of each element, row by row; `position` (E,) int64 holds each first slot and is consumed."""
    for row in range(owner.shape[0]):
        for column in range(owner.shape[1]):
            e = owner[row, column]
            if e >= 0:
                rows[position[e]] = row
                columns[position[e]] = column
                position[e] += 1
