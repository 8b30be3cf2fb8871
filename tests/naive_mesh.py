"""Slow, obvious twins of the mesh kernels."""

from __future__ import annotations

from typing import Any

import numpy as np


def contains(corners: Any, x: int, y: int) -> bool:
    """Whether the closed triangle (3, 2), of any orientation, contains the point."""
    points = [(float(a), float(b)) for a, b in corners]
    sides = [
        (q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
        for p, q in zip(points, points[1:] + points[:1], strict=True)
    ]
    return all(side >= 0 for side in sides) or all(side <= 0 for side in sides)


def owners(nodes: Any, elements: Any, mask: Any) -> Any:
    """Index of the first element that contains each pixel of the mask; -1 where none does, -2 outside the mask."""
    owner = np.full(mask.shape, -2)
    for row, column in np.argwhere(mask):
        hits = [e for e, element in enumerate(elements) if contains(nodes[element], column, row)]
        owner[row, column] = hits[0] if hits else -1
    return owner
