"""The Delaunay mesh of a region of any outline with its holes and cracks.

A stated crack is a path through the region: a row of mesh nodes, along which the mesh is split. Any mesh of triangles
has its order of corners, its areas and the keys of its edges from here, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.spatial import Delaunay, QhullError, cKDTree

from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh.region import MAX_COORDINATE
from rgbmidic.typing import BoolArray, FloatArray, as_numbers

EDGES = np.array([[0, 1], [1, 2], [2, 0]])
"""Corners of the edges of an element."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OutlineConstants:
    """Constants of `outline_mesh`: lengths in sides of an element, where nothing else is stated.

    Attributes
    ----------
    min_spacing
        Distance under which a node of the outline is left out beside another one, or beside a crack: the least angle of
        a triangle with two other sides of an element is then 17 degrees (derived). A path's end so near the region's
        edge counts as on it.
    min_depth
        Depth from which a lattice point is a node: over half the pitch, so that triangles at the outline are no flatter
        than those inside.
    outline_tolerance
        Distance within which the polygon of the outline follows its pixels, but at least a pixel: a chord of an
        element's length is that far from an arc with a radius of two elements (derived).
    crack_clearance
        Distance that nodes inside keep from a crack: they see a piece of it, at most an element long, under less than
        85 degrees, two of them from both sides under less than 180, which makes it an edge of the Delaunay mesh.
    max_halvings
        Times that a piece of a crack is halved where another crack or the outline keeps it from being an edge: pieces
        of a 16th of an element, 1.6 px for 25 px elements, are nearly as fine as a path is followed (`path_tolerance`).
    min_area
        Twice the area, in squares of an element's side, under which a triangle at the edge is left out: a regular one
        has .87, and one under .04 has too few pixels (8 for 20 px elements) for its six unknowns to be measured.
    sample_step
        Distance (px) of the points at which a path is looked at: no pixel that it crosses by more than half is missed.
    path_tolerance
        How far (px) the row of nodes may be beside the stated path: pixels that near its edges are left out.
    min_path_spacing
        Least distance of nodes along a path, and most by which a branch moves along the path it leaves: the nodes of
        an earlier path are at most an element apart.
    sharp_angle_deg
        Turn from which a corner of the outline is not given up for a crack beside it: polygons around round holes turn
        less from a radius of 12 px on.
    """

    min_spacing: float = 0.3
    min_depth: float = 0.6
    outline_tolerance: float = 0.06
    crack_clearance: float = 0.55
    max_halvings: int = 4
    min_area: float = 0.04
    sample_step: float = 0.5
    path_tolerance: float = 1.0
    min_path_spacing: float = 0.5
    sharp_angle_deg: float = 60.0


def outline_mesh(
    mask: BoolArray,
    size: float,
    cracks: Sequence[npt.ArrayLike],
    origin: tuple[int, int] = (0, 0),
    constants: OutlineConstants = OutlineConstants(),
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Return nodes (N, 2) and elements (E, 3) of about `size` px for the region `mask` (H, W), split along `cracks`.

    The mask may be a part of a frame that begins at column and row `origin`: the nodes then lie as in all of it.

    Raises
    ------
    RegionError
        The region is too small for one element, or a crack misses it.
    """
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    tolerance = max(1.0, constants.outline_tolerance * size)
    polygons = [cv2.approxPolyDP(line, tolerance, True)[:, 0].astype(np.float64) for line in contours]
    edge, outlines = np.concatenate(contours)[:, 0].astype(np.float64), [line for line in polygons if len(line) >= 3]
    outline = _outline_points(outlines, size)
    outline = outline[spacing_mask(outline, constants.min_spacing * size)]
    padded = np.pad(mask, 1).astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    inner = _lattice_points(mask.shape, size, origin)
    inner = inner[
        depth[np.round(inner[:, 1]).astype(int), np.round(inner[:, 0]).astype(int)] > constants.min_depth * size
    ]
    sharp = _sharp_corners(outlines, constants.sharp_angle_deg)
    paths = _crack_paths(cracks, mask, edge, sharp, size, constants)
    if paths:
        near = cKDTree(np.concatenate([_subdivide(path, constants.sample_step) for path in paths]))
        is_sharp = (outline[:, None] == sharp).all(axis=2).any(axis=1)
        outline = outline[is_sharp | (near.query(outline)[0] > constants.min_spacing * size)]
        inner = inner[near.query(inner)[0] > constants.crack_clearance * size]
    points, triangles, pieces = _triangulate(np.concatenate([outline, inner]), paths, constants.max_halvings)
    centre = np.round(points[triangles].mean(axis=1)).astype(int)
    inside = mask[np.clip(centre[:, 1], 0, mask.shape[0] - 1), np.clip(centre[:, 0], 0, mask.shape[1] - 1)]
    large = np.abs(cross(points, triangles)) > constants.min_area * size**2
    triangles = triangles[inside & large]
    if not len(triangles):
        raise RegionError(f"the region of {int(mask.sum())} px is too small for one element of {size} px")
    return split_along(points, triangles, pieces)


def _triangulate(
    points: FloatArray, paths: list[FloatArray], halvings: int
) -> tuple[FloatArray, npt.NDArray[np.int32], npt.NDArray[np.int64]]:
    """Delaunay mesh of points (N, 2) and of the nodes of the paths, whose pieces are halved where they are no edges.

    Returns
    -------
    tuple
        Nodes, triangles, and the pieces of the paths as edges (n, 2) of the mesh.
    """
    for _ in range(halvings + 1):
        nodes = np.concatenate([points, *paths])
        nodes = nodes[spacing_mask(nodes, 1e-6)]
        try:
            triangles = Delaunay(nodes).simplices.astype(np.int32)
        except (QhullError, ValueError):
            raise RegionError("the region is too small for one element") from None
        rows = [np.asarray(cKDTree(nodes).query(path)[1]) for path in paths]
        pieces = np.concatenate([np.empty((0, 2), dtype=np.int64), *(np.stack([r[:-1], r[1:]], axis=1) for r in rows)])
        edges = triangles[:, EDGES].reshape(-1, 2)
        missing = ~np.isin(edge_keys(pieces, len(nodes)), edge_keys(edges, len(nodes)))
        if not missing.any():
            return nodes, triangles, pieces
        missing_by_path = np.split(missing, np.cumsum([len(path) - 1 for path in paths])[:-1])
        paths = [
            np.insert(path, np.flatnonzero(is_missing) + 1, (path[1:] + path[:-1])[is_missing] / 2, axis=0)
            for path, is_missing in zip(paths, missing_by_path, strict=True)
        ]
    raise RegionError(
        "mesh.cracks cross, or run too close to each other or to a corner of the region, for the elements"
    )


def _lattice_points(shape: tuple[int, int], size: float, origin: tuple[int, int]) -> FloatArray:
    """Points of a triangular lattice with pitch `size` over a frame, in its part of `shape` that begins at `origin`."""
    rise, (x_origin, y_origin) = size * np.sqrt(3) / 2, origin
    rows = np.arange(rise / 2, y_origin + shape[0] - 1, rise)
    x = np.arange(0, x_origin + shape[1] - 1 - size / 2, size)
    x = x[x >= x_origin] - x_origin
    points = [
        np.stack([x + (i % 2) * size / 2, np.full_like(x, y - y_origin)], 1)
        for i, y in enumerate(rows)
        if y >= y_origin
    ]
    return np.concatenate(points) if points else np.empty((0, 2))


def _outline_points(outlines: list[FloatArray], size: float) -> FloatArray:
    """Return the points about `size` px apart along polygons; corners are kept."""
    points = [np.empty((0, 2))]
    for corners in outlines:
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            pieces = max(1, round(float(np.hypot(*(end - start))) / size))
            points.append(start + np.arange(pieces)[:, None] / pieces * (end - start))
    return np.concatenate(points)


def _crack_paths(
    cracks: Sequence[npt.ArrayLike],
    mask: BoolArray,
    edge: FloatArray,
    sharp: FloatArray,
    size: float,
    constants: OutlineConstants,
) -> list[FloatArray]:
    """Return the nodes (n, 2) of every crack (M, 2) within the region, at most `size` px apart.

    A path that leaves the region or nearly reaches its edge ends on points of the `edge`, or on a `sharp` corner.

    Raises
    ------
    InputError
        A path is not at least two finite corners.
    RegionError
        A path has no part within the region that is as long as an element.
    """
    paths: list[FloatArray] = []
    for number, crack in enumerate(cracks):
        requirement = f"mesh.cracks[{number}] is at least two finite corners (x, y) in px, within {MAX_COORDINATE} px"
        corners = as_numbers(crack, requirement, (None, 2))
        if len(corners) < 2 or np.abs(corners).max() > MAX_COORDINATE:
            raise InputError(f"{requirement}; given is {crack!r}")
        for segment in _segments_within(corners, mask, size, number, constants.sample_step):
            earlier = np.concatenate([np.empty((0, 2)), *paths])
            at_edge = constants.min_spacing * size
            ends = ((earlier, constants.min_path_spacing * size), (sharp, at_edge), (edge, at_edge))
            paths.append(_path_nodes(segment, ends, size, constants))
    return paths


def _segments_within(corners: FloatArray, mask: BoolArray, size: float, number: int, step: float) -> list[FloatArray]:
    """Return the parts of a path within the region that are as long as an element, as points `step` px apart."""
    points = _subdivide(corners, step)
    column, row = np.round(points).astype(int).T
    in_image = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
    within = np.zeros(len(points), dtype=bool)
    within[in_image] = mask[row[in_image], column[in_image]]
    changes = np.flatnonzero(np.diff(within, prepend=False, append=False))
    segments = [points[first:last] for first, last in changes.reshape(-1, 2)]
    lengths = [float(np.hypot(*np.diff(segment, axis=0).T).sum()) for segment in segments]
    long_segments = [segment for segment, length in zip(segments, lengths, strict=True) if length + 2 * step >= size]
    if not long_segments:
        rows, columns = np.nonzero(mask)
        raise RegionError(
            f"mesh.cracks[{number}] must run through the region (x {columns.min()} to {columns.max()}, y {rows.min()} "
            f"to {rows.max()} px) for at least an element, {size:g} px; given is {corners.tolist()}, with "
            f"{max(lengths, default=0.0):.0f} px in it"
        )
    return long_segments


def _path_nodes(
    segment: FloatArray, targets: Sequence[tuple[FloatArray, float]], size: float, constants: OutlineConstants
) -> FloatArray:
    """Return the nodes (n, 2) along a part of a path, at most `size` px apart.

    Each end moves to the nearest of the first `targets` (points, reach in px) that is within reach.
    """
    corners = cv2.approxPolyDP(segment.astype(np.float32), constants.path_tolerance, False)[:, 0].astype(np.float64)
    for end in (0, -1):
        for points, reach in targets:
            distance = np.hypot(*(points - corners[end]).T)
            if distance.min(initial=np.inf) <= reach:
                corners[end] = points[np.argmin(distance)]
                break
    nodes = _subdivide(corners, size)
    ends_first = np.roll(nodes, 1, axis=0)
    nodes = np.roll(ends_first[spacing_mask(ends_first, constants.min_path_spacing * size)], -1, axis=0)
    # a crack between two tips opens only if a node lies in between
    return nodes if len(nodes) > 2 else _subdivide(nodes, float(np.hypot(*(nodes[1] - nodes[0]))) / 2)


def _sharp_corners(polygons: Sequence[FloatArray], turn_deg: float) -> FloatArray:
    """Return the corners (n, 2) at which polygons (M, 2) turn by more than `turn_deg`."""
    sharp = [np.empty((0, 2))]
    for corners in polygons:
        side = np.roll(corners, -1, axis=0) - corners
        side /= np.hypot(*side.T)[:, None]
        sharp.append(corners[(side * np.roll(side, 1, axis=0)).sum(axis=1) < np.cos(np.radians(turn_deg))])
    return np.concatenate(sharp)


def _subdivide(corners: FloatArray, longest: float) -> FloatArray:
    """Return a path's corners (M, 2) and points between them, at most `longest` px apart."""
    points = [corners[:1]]
    for start, end in pairwise(corners):
        pieces = max(1, int(np.ceil(np.hypot(*(end - start)) / longest - 1e-9)))
        points.append(start + np.arange(1, pieces + 1)[:, None] / pieces * (end - start))
    return np.concatenate(points)


def split_along(
    nodes: FloatArray, elements: npt.NDArray[np.int32], pieces: npt.NDArray[np.int64]
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
    """Split a mesh along its edges `pieces` (n, 2): a node gets a copy for each side; unused nodes are left out.

    Corners of elements are one node if they meet at a shared edge that is not cut; so both sides share the node at a
    tip, and only that.
    """
    corner = elements.ravel()
    ends = np.arange(corner.size).reshape(-1, 3)[:, EDGES].reshape(-1, 2)
    ends = np.take_along_axis(ends, np.argsort(corner[ends], axis=1), axis=1)  # each edge from its lower node
    key, cut = edge_keys(corner[ends], len(nodes)), edge_keys(pieces, len(nodes))
    order = np.argsort(key)
    shared = (key[order][1:] == key[order][:-1]) & ~np.isin(key[order][1:], cut)
    first_corner, second_corner = ends[order[:-1][shared]].ravel(), ends[order[1:][shared]].ravel()
    graph = sp.coo_matrix((np.ones(first_corner.size), (first_corner, second_corner)), shape=(corner.size, corner.size))
    side = sp.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)
    side[~np.isin(corner, pieces)] = 0
    _, first, index = np.unique(corner * np.int64(corner.size) + side, return_index=True, return_inverse=True)
    return nodes[corner[first]], index.reshape(-1, 3).astype(np.int32)


def edge_keys(edges: npt.NDArray[np.integer], nodes: int) -> npt.NDArray[np.int64]:
    """Return one number for each edge (n, 2) of a mesh of so many nodes, whichever way it runs."""
    return np.asarray(edges.min(axis=1).astype(np.int64) * nodes + edges.max(axis=1))


def spacing_mask(points: FloatArray, distance: float) -> BoolArray:
    """Return the points (N,) to keep as a mask: without those closer than `distance` to a kept one before them."""
    keep = np.ones(len(points), dtype=bool)
    for i, j in sorted(cKDTree(points).query_pairs(distance)):
        if keep[i]:
            keep[j] = False
    return keep


def orient_elements(
    points: npt.ArrayLike, elements: npt.ArrayLike, name: str
) -> tuple[FloatArray, npt.NDArray[np.int32], FloatArray]:
    """Copies of nodes and triangles, checked and of their types, with corners as the axes turn; and twice the areas."""
    nodes = np.ascontiguousarray(as_numbers(points, f"{name} has finite nodes (N, 2)", (None, 2)))
    corners = as_numbers(elements, f"{name} has elements (E, 3), indices of nodes", (None, 3), dtype=np.int32)
    if not len(corners) or corners.min() < 0 or corners.max() >= len(nodes):
        raise InputError(f"{name}: elements (E, 3) must be there and name existing nodes")
    area = cross(nodes, corners)
    corners[area < 0] = corners[area < 0][:, [0, 2, 1]]
    return nodes, corners, np.abs(area)


def cross(points: FloatArray, elements: npt.NDArray[np.integer]) -> FloatArray:
    """Return twice the signed area (...) of triangles (..., 3)."""
    first, second = (points[elements[..., corner]] - points[elements[..., 0]] for corner in (1, 2))
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])
