"""TRI3 mesh: three-node triangles with linear shape functions, over a region of interest."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TypedDict

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh.region import Region
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Tri3Mesh"]

logger = logging.getLogger(__name__)

NARROW = 10
"""Width (px) under which a region is told to be narrow: speckles are 3 to 5 px wide, and a pixel or two at each border
serve the filters only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tri3Mesh:
    """Triangles on the reference image.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2), float64
        Positions (x, y) in px.
    elements : ndarray, shape (E, 3), int32
        Node indices, ordered so that ``(p1 - p0) x (p2 - p0) > 0`` in (x, y).
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]

    def __post_init__(self) -> None:
        nodes = np.ascontiguousarray(self.nodes, dtype=np.float64)
        elements = np.array(self.elements, dtype=np.int32)
        if nodes.ndim != 2 or nodes.shape[1] != 2 or elements.ndim != 2 or elements.shape[1] != 3 or not len(elements):
            raise InputError(
                f"a TRI3 mesh has nodes (N, 2) and elements (E, 3), not {nodes.shape} and {elements.shape}"
            )
        if not np.isfinite(nodes).all() or elements.min() < 0 or elements.max() >= len(nodes):
            raise InputError("mesh nodes must be finite and elements must name existing nodes")
        area = _signed_area(nodes, elements)
        if (area == 0).any():
            raise InputError(f"element {int(np.argmin(np.abs(area)))} of the mesh has no area")
        elements[area < 0] = elements[area < 0][:, [0, 2, 1]]
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "elements", elements)

    @classmethod
    def from_region(cls, region: Region, element_size: float) -> Tri3Mesh:
        """Mesh a region with triangles whose legs are about `element_size` px.

        A rectangle gets a regular mesh; other regions a Delaunay mesh that follows their outline and holes. The log
        tells of a region that is narrow or smaller than an element.

        Raises
        ------
        InputError
            `element_size` is under 4 px: too few pixels for six unknowns.
        RegionError
            The region is too small for one element.
        """
        if not (np.isfinite(element_size) and element_size >= 4):
            raise InputError(f"element_size must be at least 4 px; given is {element_size!r}")
        if region.width < NARROW:
            logger.warning("the region is %d px across: two or three speckles, hardly enough to measure", region.width)
        elif region.width < element_size:
            logger.warning(
                "the elements of %g px are larger than the region, which is %d px across", element_size, region.width
            )
        if region.rectangle is not None:
            return cls(**_rectangle_mesh(region.rectangle, element_size))
        return cls(**_outline_mesh(region.mask, element_size))

    @property
    def areas(self) -> FloatArray:
        """Area of each element in square px, shape (E,)."""
        return _signed_area(self.nodes, self.elements)

    @property
    def size(self) -> float:
        """Typical leg of an element in px: that of a right isosceles triangle of the median area."""
        return float(np.sqrt(2 * np.median(self.areas)))

    def to_nodes(self, per_element: FloatArray) -> FloatArray:
        """Sum of a value per element (E,) over the elements around each node, shape (N,)."""
        sums = np.bincount(self.elements.ravel(), weights=np.repeat(per_element, 3), minlength=len(self.nodes))
        return np.asarray(sums, dtype=np.float64)

    def beside(self, nodes: BoolArray) -> BoolArray:
        """Nodes (N,) that share an element with one of `nodes` (N,), these included."""
        near = np.zeros(len(self.nodes), dtype=bool)
        near[self.elements[nodes[self.elements].any(axis=1)]] = True
        return near

    def element_gradient(self, values: FloatArray) -> FloatArray:
        """Gradient of the linear interpolant of nodal values (N, C) in every element, shape (E, C, 2)."""
        return np.asarray(np.einsum("eac,ead->ecd", values[self.elements], self.shape_gradients()))

    def shape_gradients(self) -> FloatArray:
        """Gradient of the three shape functions of every element, shape (E, 3, 2), per px."""
        p = self.nodes[self.elements]
        x, y = p[..., 0], p[..., 1]
        slopes_x = np.stack([y[:, 1] - y[:, 2], y[:, 2] - y[:, 0], y[:, 0] - y[:, 1]], axis=1)
        slopes_y = np.stack([x[:, 2] - x[:, 1], x[:, 0] - x[:, 2], x[:, 1] - x[:, 0]], axis=1)
        return np.asarray(np.stack([slopes_x, slopes_y], axis=-1) / (2 * self.areas)[:, None, None])

    def nodal_gradient(self, values: FloatArray) -> FloatArray:
        """Gradient of nodal values (N, C) at the nodes: the area-weighted mean of the elements around; (N, C, 2)."""
        gradient = self.element_gradient(values) * self.areas[:, None, None]
        flat = gradient.reshape(len(gradient), -1).T
        sums = np.stack([self.to_nodes(np.ascontiguousarray(part)) for part in flat], axis=-1)
        return np.asarray((sums / self.to_nodes(self.areas)[:, None]).reshape(-1, *gradient.shape[1:]))

    @property
    def on_boundary(self) -> BoolArray:
        """True for nodes on an edge that belongs to one element only, shape (N,)."""
        edges = np.concatenate([self.elements[:, [0, 1]], self.elements[:, [1, 2]], self.elements[:, [2, 0]]])
        pairs, count = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
        boundary = np.zeros(len(self.nodes), dtype=bool)
        boundary[pairs[count == 1]] = True
        return boundary

    @property
    def neighbours(self) -> npt.NDArray[np.int32]:
        """Pairs of nodes joined by an edge, shape (M, 2), each pair once."""
        edges = np.concatenate([self.elements[:, [0, 1]], self.elements[:, [1, 2]], self.elements[:, [2, 0]]])
        return np.unique(np.sort(edges, axis=1), axis=0)


class _Parts(TypedDict):
    nodes: FloatArray
    elements: npt.NDArray[np.int32]


def _signed_area(nodes: FloatArray, elements: npt.NDArray[np.int32]) -> FloatArray:
    p = nodes[elements]
    a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    return np.asarray((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def _rectangle_mesh(rectangle: tuple[float, float, float, float], size: float) -> _Parts:
    x0, y0, x1, y1 = rectangle
    if min(x1 - x0, y1 - y0) < 4:
        raise RegionError(f"the region {rectangle} is too small: an element needs at least 4 x 4 px")
    nx = max(1, round((x1 - x0) / size))
    ny = max(1, round((y1 - y0) / size))
    x, y = np.meshgrid(np.linspace(x0, x1, nx + 1), np.linspace(y0, y1, ny + 1))
    column, row = (index.ravel() for index in np.meshgrid(np.arange(nx), np.arange(ny)))
    a = row * (nx + 1) + column
    b, c, d = a + 1, a + nx + 2, a + nx + 1
    # alternating diagonals: no preferred direction in the noise
    even = ((row + column) % 2 == 0)[:, None]
    first = np.where(even, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(even, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    elements = np.stack([first, second], 1).reshape(-1, 3).astype(np.int32)
    return {"nodes": np.stack([x.ravel(), y.ravel()], 1), "elements": elements}


def _outline_mesh(mask: BoolArray, size: float) -> _Parts:
    from scipy.spatial import Delaunay, QhullError

    outline = _outline_points(mask, size)
    padded = np.pad(mask, 1).astype(np.uint8)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    inner = _lattice_points(mask.shape, size)
    inner = inner[depth[np.round(inner[:, 1]).astype(int), np.round(inner[:, 0]).astype(int)] > 0.6 * size]
    points = np.concatenate([outline, inner])
    try:
        triangles = Delaunay(points).simplices
    except (QhullError, ValueError):
        raise RegionError(f"the region of {int(mask.sum())} px is too small for one element of {size} px") from None
    centre = np.round(points[triangles].mean(axis=1)).astype(int)
    inside = mask[np.clip(centre[:, 1], 0, mask.shape[0] - 1), np.clip(centre[:, 0], 0, mask.shape[1] - 1)]
    large = np.abs(_signed_area(points, triangles.astype(np.int32))) > 0.02 * size**2
    triangles = triangles[inside & large]
    if not len(triangles):
        raise RegionError(f"the region of {int(mask.sum())} px is too small for one element of {size} px")
    used, elements = np.unique(triangles, return_inverse=True)
    return {"nodes": points[used], "elements": elements.reshape(-1, 3).astype(np.int32)}


def _lattice_points(shape: tuple[int, int], size: float) -> FloatArray:
    """Points of a triangular lattice with pitch `size` over an image of `shape`."""
    rise = size * np.sqrt(3) / 2
    rows = np.arange(rise / 2, shape[0] - 1, rise)
    x = np.arange(0, shape[1] - 1 - size / 2, size)
    points = [np.stack([x + (i % 2) * size / 2, np.full_like(x, y)], 1) for i, y in enumerate(rows)]
    return np.concatenate(points) if points else np.empty((0, 2))


def _outline_points(mask: BoolArray, size: float) -> FloatArray:
    """Points about `size` px apart along the region's outline and holes; corners are kept."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    points = []
    for contour in contours:
        corners = cv2.approxPolyDP(contour, max(1.0, 0.06 * size), True)[:, 0].astype(np.float64)
        if len(corners) < 3:
            continue
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            pieces = max(1, round(float(np.hypot(*(end - start))) / size))
            points.append(start + np.arange(pieces)[:, None] / pieces * (end - start))
    if not points:
        return np.empty((0, 2))
    return _without_crowding(np.concatenate(points), 0.3 * size)


def _without_crowding(points: FloatArray, distance: float) -> FloatArray:
    """Drop every point that lies closer than `distance` to a kept one before it."""
    from scipy.spatial import cKDTree

    keep = np.ones(len(points), dtype=bool)
    for i, j in sorted(cKDTree(points).query_pairs(distance)):
        if keep[i]:
            keep[j] = False
    return points[keep]
