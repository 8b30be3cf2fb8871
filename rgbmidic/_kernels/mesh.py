"""Which element owns which pixel, and which nodes are far apart."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.compilation import compiled

__all__ = ["claim_pixels", "colour_nodes"]


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
def colour_nodes(starts, near, taken, colour):
    """Give each node the first colour that no node before it has `taken` (N, C), bool, at one of those `near` both.

    The nodes near node n, itself with them, are ``near[starts[n]:starts[n + 1]]``; `colour` (N,) receives its colour.
    """
    for node in range(colour.size):
        begin, end = starts[node], starts[node + 1]
        own, k = 0, begin
        while k < end:
            if taken[near[k], own]:
                own, k = own + 1, begin
            else:
                k += 1
        colour[node] = own
        for k in range(begin, end):
            taken[near[k], own] = True
