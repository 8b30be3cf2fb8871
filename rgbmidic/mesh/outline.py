"""Delaunay mesh of a region of any outline, its holes and its cracks."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import RegionError
from rgbmidic.mesh.cracks import (
    crack_paths,
    distance_to,
    edge_keys,
    halved,
    sharp_corners,
    split_along,
    uncrowded,
)
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["outline_mesh"]

_CROWDED = 0.3
"""Distance in elements under which a node of the outline is left out beside another one, or beside a crack."""
_CLEAR = 0.55
"""Distance in elements that nodes inside keep from a crack: they see a piece of it, at most an element long, under less
than 85 degrees, two of them from both sides under less than 180, which makes it an edge of the Delaunay mesh."""
_HALVINGS = 4
"""Times that a piece of a crack is halved where another crack or the outline keeps it from being an edge."""

_SLIVER = 0.04
"""Twice the area, in squares of an element's side, under which a triangle at the edge is left out."""


def outline_mesh(
    mask: BoolArray, size: float, cracks: Sequence[npt.ArrayLike], origin: tuple[int, int] = (0, 0)
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Nodes (N, 2) and elements (E, 3) of about `size` px for the region `mask` (H, W), split along `cracks`.

    The mask may be a part of a frame that begins at column and row `origin`: the nodes then lie as in all of it.

    Raises
    ------
    RegionError
        The region is too small for one element, or a crack misses it.
    """
    edge, outlines = _outlines(mask, size)
    outline = _outline_points(outlines, size)
    padded = np.pad(mask, 1).astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    inner = _lattice_points(mask.shape, size, origin)
    inner = inner[depth[np.round(inner[:, 1]).astype(int), np.round(inner[:, 0]).astype(int)] > 0.6 * size]
    sharp = sharp_corners(outlines)
    paths = crack_paths(cracks, mask, edge, sharp, size)
    if paths:
        is_sharp = (outline[:, None] == sharp).all(axis=2).any(axis=1)
        outline = outline[is_sharp | (distance_to(paths, outline) > _CROWDED * size)]
        inner = inner[distance_to(paths, inner) > _CLEAR * size]
    points, triangles, pieces = _triangulated(np.concatenate([outline, inner]), paths)
    centre = np.round(points[triangles].mean(axis=1)).astype(int)
    inside = mask[np.clip(centre[:, 1], 0, mask.shape[0] - 1), np.clip(centre[:, 0], 0, mask.shape[1] - 1)]
    a, b = (points[triangles[:, corner]] - points[triangles[:, 0]] for corner in (1, 2))
    large = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > _SLIVER * size**2
    triangles = triangles[inside & large]
    if not len(triangles):
        raise RegionError(f"the region of {int(mask.sum())} px is too small for one element of {size} px")
    return split_along(points, triangles, pieces)


def _triangulated(
    points: FloatArray, paths: list[FloatArray]
) -> tuple[FloatArray, npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Delaunay mesh of the points (N, 2) and of the nodes of the paths: nodes, triangles, and the pieces of the paths
    as edges (n, 2) of it."""
    from scipy.spatial import Delaunay, QhullError, cKDTree

    for _ in range(_HALVINGS + 1):
        nodes = np.concatenate([points, *paths])
        nodes = nodes[uncrowded(nodes, 1e-6)]
        try:
            triangles = Delaunay(nodes).simplices.astype(np.int32)
        except (QhullError, ValueError):
            raise RegionError("the region is too small for one element") from None
        rows = [np.asarray(cKDTree(nodes).query(path)[1]) for path in paths]
        pieces = np.concatenate([np.empty((0, 2), dtype=np.int64), *(np.stack([r[:-1], r[1:]], axis=1) for r in rows)])
        edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
        missing = ~np.isin(edge_keys(pieces, len(nodes)), edge_keys(edges, len(nodes)))
        if not missing.any():
            return nodes, triangles, pieces
        parts = np.split(missing, np.cumsum([len(path) - 1 for path in paths])[:-1])
        paths = [halved(path, part) for path, part in zip(paths, parts, strict=True)]
    raise RegionError(
        "mesh.cracks cross, or run too close to each other or to a corner of the region, for the elements"
    )


def _lattice_points(shape: tuple[int, int], size: float, origin: tuple[int, int]) -> FloatArray:
    """Points of a triangular lattice with pitch `size` over a frame, in its part of `shape` that begins at `origin`."""
    rise, (left, top) = size * np.sqrt(3) / 2, origin
    rows = np.arange(rise / 2, top + shape[0] - 1, rise)
    x = np.arange(0, left + shape[1] - 1 - size / 2, size)
    x = x[x >= left] - left
    points = [np.stack([x + (i % 2) * size / 2, np.full_like(x, y - top)], 1) for i, y in enumerate(rows) if y >= top]
    return np.concatenate(points) if points else np.empty((0, 2))


def _outlines(mask: BoolArray, size: float) -> tuple[FloatArray, list[FloatArray]]:
    """The pixels (n, 2) at the edge of the region and its holes, and corners (M, 2) of the polygons around them."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    polygons = [cv2.approxPolyDP(contour, max(1.0, 0.06 * size), True)[:, 0].astype(np.float64) for contour in contours]
    return np.concatenate(contours)[:, 0].astype(np.float64), [corners for corners in polygons if len(corners) >= 3]


def _outline_points(outlines: list[FloatArray], size: float) -> FloatArray:
    """Points about `size` px apart along polygons; corners are kept."""
    points = [np.empty((0, 2))]
    for corners in outlines:
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            pieces = max(1, round(float(np.hypot(*(end - start))) / size))
            points.append(start + np.arange(pieces)[:, None] / pieces * (end - start))
    every = np.concatenate(points)
    return every[uncrowded(every, _CROWDED * size)]
