"""Stated cracks: their paths through the region as rows of mesh nodes, and the mesh split along them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.spatial import cKDTree

from rgbmidic.errors import InputError, RegionError
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["crack_paths", "distance_to", "edge_keys", "halved", "sharp_corners", "split_along", "uncrowded"]

_STEP = 0.5
"""Distance (px) of the points at which a path is looked at."""
_FINE = 1.0
"""How far (px) the row of nodes may be beside the stated path."""
_CROWDED = 0.5
"""Least distance of nodes along a path, and most by which a branch moves along the path it leaves, in elements."""
_AT_EDGE = 0.3
"""Distance in elements from the region's edge within which a path's end counts as on it."""
_SHARP = np.cos(np.radians(60))
"""Cosine of the turn from which a corner of the outline is not given up for a crack beside it: polygons around round
holes turn less from a radius of 12 px on."""


def crack_paths(
    cracks: Sequence[npt.ArrayLike], mask: BoolArray, edge: FloatArray, sharp: FloatArray, size: float
) -> list[FloatArray]:
    """Nodes of every crack within the region, shape (n, 2) each, at most `size` px apart.

    Parameters
    ----------
    cracks
        Corners (x, y) in px of each path, shape (M, 2).
    mask : ndarray, shape (H, W), bool
        The region.
    edge, sharp : ndarray, shape (n, 2)
        Points of its edge, on which a path ends that leaves the region or nearly reaches it, and the sharp corners.
    size
        Side of the elements in px.

    Raises
    ------
    InputError
        A path is not at least two finite corners.
    RegionError
        A path has no part within the region that is as long as an element.
    """
    paths: list[FloatArray] = []
    for number, crack in enumerate(cracks):
        corners = np.asarray(crack, dtype=np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2 or not np.isfinite(corners).all():
            raise InputError(f"mesh.cracks[{number}] is at least two finite corners (x, y) in px; given is {crack!r}")
        for part in _parts_within(corners, mask, size, number):
            earlier = np.concatenate([np.empty((0, 2)), *paths])
            paths.append(_path_nodes(part, ((earlier, _CROWDED), (sharp, _AT_EDGE), (edge, _AT_EDGE)), size))
    return paths


def _parts_within(corners: FloatArray, mask: BoolArray, size: float, number: int) -> list[FloatArray]:
    """The parts of a path within the region that are as long as an element, as points `_STEP` px apart."""
    points = _subdivided(corners, _STEP)
    column, row = np.round(points).astype(int).T
    in_image = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
    within = np.zeros(len(points), dtype=bool)
    within[in_image] = mask[row[in_image], column[in_image]]
    changes = np.flatnonzero(np.diff(within, prepend=False, append=False))
    parts = [points[first:last] for first, last in changes.reshape(-1, 2)]
    lengths = [float(np.hypot(*np.diff(part, axis=0).T).sum()) for part in parts]
    if max(lengths, default=0.0) + 2 * _STEP < size:
        rows, columns = np.nonzero(mask)
        raise RegionError(
            f"mesh.cracks[{number}] must run through the region (x {columns.min()} to {columns.max()}, y {rows.min()} "
            f"to {rows.max()} px) for at least an element, {size:g} px; given is {corners.tolist()}, with "
            f"{max(lengths, default=0.0):.0f} px in it"
        )
    return [part for part, length in zip(parts, lengths, strict=True) if length + 2 * _STEP >= size]


def _path_nodes(part: FloatArray, ends: Sequence[tuple[FloatArray, float]], size: float) -> FloatArray:
    corners = cv2.approxPolyDP(part.astype(np.float32), _FINE, False)[:, 0].astype(np.float64)
    for end in (0, -1):
        corners[end] = _end(corners[end], ends, size)
    nodes = _subdivided(corners, size)
    ends_first = np.roll(nodes, 1, axis=0)
    nodes = np.roll(ends_first[uncrowded(ends_first, _CROWDED * size)], -1, axis=0)
    # a crack between two tips opens only if a node lies in between
    return nodes if len(nodes) > 2 else _subdivided(nodes, float(np.hypot(*(nodes[1] - nodes[0]))) / 2)


def _end(end: FloatArray, places: Sequence[tuple[FloatArray, float]], size: float) -> FloatArray:
    """A path's end: the nearest of the first `places` (points, reach in elements) within reach, or as it is."""
    for points, reach in places:
        distance = np.hypot(*(points - end).T)
        if distance.min(initial=np.inf) <= reach * size:
            return np.asarray(points[np.argmin(distance)])
    return end


def sharp_corners(polygons: Sequence[FloatArray]) -> FloatArray:
    """Corners (n, 2) at which polygons (M, 2) turn sharply."""
    sharp = [np.empty((0, 2))]
    for corners in polygons:
        side = np.roll(corners, -1, axis=0) - corners
        side /= np.hypot(*side.T)[:, None]
        sharp.append(corners[(side * np.roll(side, 1, axis=0)).sum(axis=1) < _SHARP])
    return np.concatenate(sharp)


def _subdivided(corners: FloatArray, longest: float) -> FloatArray:
    """A path's corners (M, 2) and points between them, at most `longest` px apart."""
    points = [corners[:1]]
    for start, end in pairwise(corners):
        pieces = max(1, int(np.ceil(np.hypot(*(end - start)) / longest - 1e-9)))
        points.append(start + np.arange(1, pieces + 1)[:, None] / pieces * (end - start))
    return np.concatenate(points)


def distance_to(paths: Sequence[FloatArray], points: FloatArray) -> FloatArray:
    """Distance (px) of points (N, 2) from the nearest path, shape (N,), within a pixel's quarter."""
    dense = np.concatenate([_subdivided(path, _STEP) for path in paths])
    return np.asarray(cKDTree(dense).query(points)[0])


def halved(path: FloatArray, pieces: BoolArray) -> FloatArray:
    """A path (n, 2) with another node in the middle of the chosen pieces (n - 1,)."""
    middles = (path[1:] + path[:-1]) / 2
    return np.insert(path, np.flatnonzero(pieces) + 1, middles[pieces], axis=0)


def split_along(
    nodes: FloatArray, elements: npt.NDArray[np.int32], pieces: npt.NDArray[np.int64]
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """The mesh with its edges `pieces` (n, 2) cut: a node gets a copy for each side; unused nodes are left out.

    Corners of elements are one node if they meet at a shared edge that is not cut; so both sides share the node at a
    tip, and only that.
    """
    corner = elements.ravel()
    ends = np.stack([np.arange(corner.size), np.arange(corner.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()], axis=1)
    ends = np.take_along_axis(ends, np.argsort(corner[ends], axis=1), axis=1)  # each edge from its lower node
    key, cut = edge_keys(corner[ends], len(nodes)), edge_keys(pieces, len(nodes))
    order = np.argsort(key)
    shared = (key[order][1:] == key[order][:-1]) & ~np.isin(key[order][1:], cut)
    one, other = ends[order[:-1][shared]].ravel(), ends[order[1:][shared]].ravel()
    graph = sp.coo_matrix((np.ones(one.size), (one, other)), shape=(corner.size, corner.size))
    side = sp.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)
    side[~np.isin(corner, pieces)] = 0
    _, first, index = np.unique(corner * np.int64(corner.size) + side, return_index=True, return_inverse=True)
    return nodes[corner[first]], index.reshape(-1, 3).astype(np.int32)


def edge_keys(edges: npt.NDArray[np.integer], nodes: int) -> npt.NDArray[np.int64]:
    """One number for each edge (n, 2) of a mesh of so many nodes, whichever way it runs."""
    return np.asarray(edges.min(axis=1).astype(np.int64) * nodes + edges.max(axis=1))


def uncrowded(points: FloatArray, distance: float) -> BoolArray:
    """Points (N,) to keep: without those that lie closer than `distance` to a kept one before them."""
    keep = np.ones(len(points), dtype=bool)
    for i, j in sorted(cKDTree(points).query_pairs(distance)):
        if keep[i]:
            keep[j] = False
    return keep
