"""TRI3 mesh: three-node triangles with linear shape functions, over a region of interest."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from rgbmidic._kernels.mesh import claim_pixels, colour_nodes
from rgbmidic.derived import Derivable
from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh.outline_mesh import EDGES, edge_keys, orient_elements, outline_mesh
from rgbmidic.mesh.region import Region, image_shape
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, as_values

logger = logging.getLogger(__name__)


@state_new_names
@dataclass(frozen=True, kw_only=True, eq=False)
class Tri3Mesh(Derivable):
    """Triangles on the reference image. Its arrays are not writable, because derived quantities are cached.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2), float64
        Positions (x, y) in px.
    elements : ndarray, shape (E, 3), int32
        Node indices, ordered so that ``(p1 - p0) x (p2 - p0) > 0`` in (x, y).
    areas : ndarray, shape (E,), float64
        Area of each element in square px.
    size : float
        Typical leg of an element in px: that of a right isosceles triangle of the median area.
    sizes : ndarray, shape (N,), float64
        Typical leg of the elements around each node in px, by their mean area; `size` everywhere unless the mesh is
        graded.
    is_graded : bool
        Whether the elements around one node in ten are more than twice as large as those around another one in ten.

    Examples
    --------
    >>> from rgbmidic import Region, Tri3Mesh
    >>> region = Region.from_rectangle((10, 10, 90, 70), shape=(80, 120))
    >>> mesh = Tri3Mesh.from_region(region, element_size=20)
    >>> mesh.nodes.shape, mesh.elements.shape, float(mesh.areas.sum())
    ((20, 2), (24, 3), 4800.0)
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    areas: FloatArray = field(init=False)
    size: float = field(init=False)
    sizes: FloatArray = field(init=False)
    is_graded: bool = field(init=False)

    def __post_init__(self) -> None:
        """Check nodes and elements, order the corners and derive the areas."""
        nodes, elements, twice_areas = orient_elements(self.nodes, self.elements, "a TRI3 mesh")
        if not twice_areas.all():
            raise InputError(f"element {int(np.argmin(twice_areas))} of the mesh has no area")
        for name, values in (("nodes", nodes), ("elements", elements), ("areas", twice_areas / 2)):
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        object.__setattr__(self, "size", float(np.sqrt(2 * np.median(self.areas))))
        number = np.bincount(elements.ravel(), minlength=len(nodes))
        sizes = np.sqrt(2 * self.to_nodes(self.areas) / np.maximum(number, 1))
        small, large = np.quantile(sizes[number > 0], [0.1, 0.9])
        # sizes of `from_region`, for which one serves, differ by 1.53 at most (8 to 40 px over rectangles, discs, rings
        # and polygons, with a crack; measured)
        object.__setattr__(self, "is_graded", bool(large > 2.0 * small))
        sizes[(number == 0) | (not self.is_graded)] = self.size
        sizes.setflags(write=False)
        object.__setattr__(self, "sizes", sizes)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle nodes and elements only: the arrays of a copy are not writable either."""
        return partial(Tri3Mesh, nodes=self.nodes, elements=self.elements), ()

    @classmethod
    def from_region(cls, region: Region, element_size: float, cracks: Sequence[npt.ArrayLike] = ()) -> Tri3Mesh:
        """Mesh a region with triangles whose legs are about `element_size` px.

        A rectangle gets a regular mesh; other regions, and those with cracks, a Delaunay mesh that follows their
        outline, holes and cracks. The log warns of a region that is narrow or smaller than an element.

        Parameters
        ----------
        region
            The pixels to measure.
        element_size
            Side of the triangles in px.
        cracks
            Paths, each of corners (x, y) in px, shape (M, 2), along which the mesh is split: elements on both sides
            share the node at a tip within the region, and no other. A path may begin beyond the region; one that ends
            within 0.3 elements of its edge ends on it, one within half an element of an earlier path branches off it.

        Returns
        -------
        Tri3Mesh
            With nodes (N, 2) in px.

        Raises
        ------
        InputError
            `element_size` is under 4 px: too few pixels for six unknowns; a path is not two or more corners.
        RegionError
            The region is too small for one element, or a crack misses it.
        """
        if not isinstance(region, Region) or isinstance(cracks, str) or not np.iterable(cracks):
            raise InputError(f"a mesh is made of a Region and of paths of cracks; given are {region!r}, {cracks!r}")
        size: Any = element_size
        if not (isinstance(size, int | float | np.number) and math.isfinite(size) and size >= 4):
            hint = ': "auto" is for rgbmidic.measure' if isinstance(size, str) and size == "auto" else ""
            raise InputError(f"element_size must be a number of at least 4 px; given is {size!r}{hint}")
        # speckles are 3 to 5 px wide, and a pixel or two at each border serve the filters only
        if (width := region.width) < 10:
            logger.warning("the region is %d px across: two or three speckles, hardly enough to measure", width)
        elif width < element_size:
            logger.warning(
                "the elements of %g px are larger than the region, which is %d px across", element_size, width
            )
        if region.rectangle is not None and not len(cracks):
            nodes, elements = _rectangle_mesh(region.rectangle, element_size)
        else:
            nodes, elements = outline_mesh(region.mask, element_size, cracks, region.origin)
        return cls(nodes=nodes, elements=elements)

    @cached_property
    def centres(self) -> FloatArray:
        """Centre of each element, shape (E, 2), px."""
        centres = np.asarray(self.nodes[self.elements].mean(axis=1))
        centres.setflags(write=False)
        return centres

    @cached_property
    def centre_tree(self) -> cKDTree:
        """Search tree of the `centres`."""
        return cKDTree(self.centres)

    def region(self, shape: tuple[int, int]) -> Region:
        """Return the pixels that the elements cover.

        Parameters
        ----------
        shape
            Rows and columns of the images.

        Returns
        -------
        Region

        Raises
        ------
        RegionError
            The elements cover no pixel of the images.
        """
        owner = np.full(image_shape(shape), -1, dtype=np.int32)
        claim_pixels(self.nodes, self.elements, owner)
        return Region.from_mask(owner >= 0)

    def submesh(self, nodes: BoolArray) -> Tri3Mesh:
        """Return the mesh of some nodes (N,) and of the elements between them, with their `sizes` in the whole.

        Parameters
        ----------
        nodes : ndarray, shape (N,), bool
            The nodes of the part.

        Returns
        -------
        Tri3Mesh
        """
        nodes = as_values(nodes, "nodes", (len(self.nodes),), "b")
        node_index, is_inside = np.cumsum(nodes, dtype=np.int32) - 1, nodes[self.elements].all(axis=1)
        submesh = Tri3Mesh(nodes=self.nodes[nodes], elements=node_index[self.elements[is_inside]])
        vars(submesh).update(size=self.size, sizes=self.sizes[nodes], is_graded=self.is_graded)
        return submesh

    @cached_property
    def copies(self) -> npt.NDArray[np.int32]:
        """Pairs of nodes at one place, on two sides of a crack, shape (C, 2)."""
        pairs = cKDTree(self.nodes).query_pairs(1e-9, output_type="ndarray").astype(np.int32)
        pairs.setflags(write=False)
        return pairs

    @property
    def observation_points(self) -> FloatArray:
        """Positions (N, 2) at which the images show what moves with each node.

        They are the nodes; for a node on a side of a crack, the middle of the elements around it.
        """
        moments = (self.centres * self.areas[:, None]).T
        middle = np.stack([self.to_nodes(moment) for moment in moments], axis=1) / self.to_nodes(self.areas)[:, None]
        points, crack_nodes = self.nodes.copy(), self.copies.ravel()
        points[crack_nodes] = middle[crack_nodes]
        return points

    def nearest_nodes(self, targets: BoolArray) -> tuple[FloatArray, npt.NDArray[np.int64]]:
        """Distance (N,) in px and index (N,) of the nearest of the `targets` nodes (N,), along the edges of the mesh.

        The way is not across a crack or a hole; a part without any takes the nearest of another, infinitely far.

        Parameters
        ----------
        targets : ndarray, shape (N,), bool
            The nodes that are looked for, one at least.

        Returns
        -------
        distance : ndarray, shape (N,)
        index : ndarray, shape (N,), int64

        Raises
        ------
        InputError
            There are no such flags, or none of them is true.
        """
        targets = as_values(targets, "targets", (len(self.nodes),), "b")
        if not targets.any():
            raise InputError("targets must hold one node at least; given is none")
        if targets.all():
            return np.zeros(len(self.nodes)), np.arange(len(self.nodes))
        (i, j), count, sources = self.neighbours.T, len(self.nodes), np.flatnonzero(targets)
        graph = sp.coo_matrix((np.hypot(*(self.nodes[i] - self.nodes[j]).T), (i, j)), shape=(count, count))
        distance, _, index = sp.csgraph.dijkstra(
            graph, directed=False, indices=sources, min_only=True, return_predecessors=True
        )
        is_unreachable = ~np.isfinite(distance)
        index[is_unreachable] = sources[cKDTree(self.nodes[sources]).query(self.nodes[is_unreachable])[1]]
        return distance, index.astype(np.int64)

    def to_nodes(self, per_element: FloatArray) -> FloatArray:
        """Return the sum of a value per element (E,) over the elements around each node, shape (N,).

        Parameters
        ----------
        per_element : ndarray, shape (E,)
            Value of every element.

        Returns
        -------
        ndarray, shape (N,)
        """
        values = as_values(per_element, "per_element", (len(self.elements),))
        sums = np.bincount(self.elements.ravel(), weights=np.repeat(values, 3), minlength=len(self.nodes))
        return np.asarray(sums, dtype=np.float64)

    def adjacent_nodes(self, nodes: BoolArray) -> BoolArray:
        """Return the nodes (N,) that share an element with one of `nodes` (N,), these included.

        Parameters
        ----------
        nodes : ndarray, shape (N,), bool
            The chosen nodes.

        Returns
        -------
        ndarray, shape (N,), bool
        """
        nodes = as_values(nodes, "nodes", (len(self.nodes),), "b")
        is_adjacent = np.zeros(len(self.nodes), dtype=bool)
        is_adjacent[self.elements[nodes[self.elements].any(axis=1)]] = True
        return is_adjacent

    def element_gradient(self, values: FloatArray) -> FloatArray:
        """Return the gradient of the linear interpolant of nodal values (N, C) in every element, shape (E, C, 2).

        Parameters
        ----------
        values : ndarray, shape (N, C)
            Nodal values.

        Returns
        -------
        ndarray, shape (E, C, 2)
            Per px, by the axes x and y.
        """
        values = as_values(values, "values", (len(self.nodes), None))
        (first_x, first_y), (second_x, second_y) = _legs(self.nodes, self.elements)
        first, second = (leg / (2 * self.areas) for leg in _legs(values, self.elements))
        slopes = np.stack([first * second_y - second * first_y, second * first_x - first * second_x], axis=-1)
        return slopes.swapaxes(0, 1)

    def shape_gradients(self) -> FloatArray:
        """Return the gradient of the three shape functions of every element, shape (E, 3, 2), per px.

        Returns
        -------
        ndarray, shape (E, 3, 2)
            By element, corner and axis.
        """
        corners = self.nodes[self.elements]
        following, last = (np.roll(corners, turn, axis=1) for turn in (-1, -2))
        slopes = np.stack([following[..., 1] - last[..., 1], last[..., 0] - following[..., 0]], axis=-1)
        return np.asarray(slopes / (2 * self.areas)[:, None, None])

    def nodal_gradient(self, values: FloatArray) -> FloatArray:
        """Gradient of nodal values (N, C) at the nodes: the area-weighted mean of the elements around; (N, C, 2).

        Parameters
        ----------
        values : ndarray, shape (N, C)
            Nodal values.

        Returns
        -------
        ndarray, shape (N, C, 2)
            Per px, by the axes x and y.
        """
        gradient = self.element_gradient(values) * self.areas[:, None, None]
        flat = gradient.reshape(len(gradient), -1).T
        sums = np.stack([self.to_nodes(np.ascontiguousarray(component)) for component in flat], axis=-1)
        return np.asarray((sums / self.to_nodes(self.areas)[:, None]).reshape(-1, *gradient.shape[1:]))

    @property
    def on_boundary(self) -> BoolArray:
        """True for nodes on an edge that belongs to one element only, shape (N,)."""
        boundary = np.zeros(len(self.nodes), dtype=bool)
        boundary[self._boundary_edges()] = True
        return boundary

    def _boundary_edges(self) -> npt.NDArray[np.int32]:
        """Return the edges (B, 2) that belong to one element only."""
        edges, count = self._edges
        return np.asarray(edges[count == 1])

    @cached_property
    def _edges(self) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.intp]]:
        """Every edge once (M, 2), and the number of elements that share it (M,)."""
        sides = edge_keys(self.elements[:, EDGES].reshape(-1, 2), len(self.nodes))
        keys, count = np.unique(sides, return_counts=True)
        edges = np.stack(np.divmod(keys, len(self.nodes)), axis=1).astype(np.int32)
        edges.setflags(write=False)
        return edges, count

    @property
    def crack_edges(self) -> npt.NDArray[np.int32]:
        """Edges of both sides of the cracks, shape (C, 2): those at one place that belong to one element each."""
        edges = self._boundary_edges()
        keys = edge_keys(self.merged_index[edges], len(self.nodes))
        _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
        return np.asarray(edges[count[index] > 1])

    @property
    def merged_index(self) -> npt.NDArray[np.intp]:
        """Index (N,) of the same node for those at one place, on both sides of a crack; of others their own."""
        index, copies = np.arange(len(self.nodes)), self.copies
        np.minimum.at(index, copies[:, 1], copies[:, 0])
        return index

    @property
    def neighbours(self) -> npt.NDArray[np.int32]:
        """Pairs of nodes joined by an edge, shape (M, 2), each pair once."""
        return self._edges[0]

    @cached_property
    def mass_matrix(self) -> sp.csc_matrix:
        """Integrals (N, N) of the products of two shape functions, square px: the consistent mass matrix."""
        mass = np.where(np.eye(3, dtype=bool), 2, 1) * self.areas[:, None, None] / 12
        rows, columns = np.repeat(self.elements, 3, axis=1).ravel(), np.tile(self.elements, 3).ravel()
        return sp.csc_matrix((mass.ravel(), (rows, columns)), shape=(len(self.nodes),) * 2)

    @cached_property
    def linear_fit_offset(self) -> FloatArray:
        """Offset (N, 3), square px, of the best linear fit at the nodes from a field of unit curvature xx, xy or yy.

        Curvature is the second derivative. The texture counts alike in all places and directions on average, so the fit
        is that of the mass matrix M. A field with the second derivative H has ``-1/2 sum phi_a phi_b d^T H d`` over its
        linear interpolant, d being the edges of an element of area A. The offset solves ``M x = b``, where b sums over
        the elements around a node ``-A/120 (2 sum d^T H d - d^T H d of the opposite edge)``.
        """
        corners = self.nodes[self.elements]
        edge = np.roll(corners, -1, axis=1) - corners
        squares = np.stack([edge[..., 0] ** 2, 2 * edge[..., 0] * edge[..., 1], edge[..., 1] ** 2], axis=-1)
        opposite = np.roll(squares, -1, axis=1)  # edge a joins the corners a and a + 1
        contributions = -(2 * squares.sum(axis=1, keepdims=True) - opposite) * self.areas[:, None, None] / 120
        sums = [
            np.bincount(self.elements.ravel(), weights=contribution.ravel(), minlength=len(self.nodes))
            for contribution in np.moveaxis(contributions, -1, 0)
        ]
        options = {"SymmetricMode": True}
        factors = splu(self.mass_matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        return np.asarray(factors.solve(np.stack(sums, axis=1)))

    @cached_property
    def colouring(self) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """Colours (N,) of the nodes, those of one at least five edges apart, and the node of each nearest to every one.

        The latter has the shape (C, N) for C colours; it is N where there is none within four edges.
        """
        count = len(self.nodes)
        # nodes at one place count as neighbours: the nearest of a colour is found by distance
        i, j = np.concatenate([self.neighbours, self.copies, np.repeat(np.arange(count), 2).reshape(-1, 2)]).T
        ends = np.concatenate([i, j]), np.concatenate([j, i])
        ring = sp.csr_matrix((np.ones(2 * len(i), dtype=bool), ends), shape=(count, count))
        near = ring @ ring  # two nodes with one near both are at most four edges apart
        reach = near @ near
        colour = np.empty(count, dtype=np.int64)
        colour_nodes(near.indptr, near.indices, np.zeros((count, np.diff(reach.indptr).max()), dtype=bool), colour)
        node, neighbour = np.repeat(np.arange(count), np.diff(reach.indptr)), reach.indices
        slot = colour[neighbour] * count + node
        distance = sum((axis[node] - axis[neighbour]) ** 2 for axis in self.nodes.T)
        min_distance = np.full((colour.max() + 1) * count, np.inf)
        np.minimum.at(min_distance, slot, distance)
        nearest, is_nearest = np.full(min_distance.size, count), distance == min_distance[slot]
        nearest[slot[is_nearest]] = neighbour[is_nearest]
        return colour, nearest.reshape(-1, count)


def _legs(values: FloatArray, elements: npt.NDArray[np.int32]) -> tuple[FloatArray, FloatArray]:
    """Return the differences (C, E) of nodal values (N, C) from the first corner of elements to the others."""
    at_corners = values.T[:, elements]
    return at_corners[..., 1] - at_corners[..., 0], at_corners[..., 2] - at_corners[..., 0]


def _rectangle_mesh(
    rectangle: tuple[float, float, float, float], size: float
) -> tuple[FloatArray, npt.NDArray[np.int32]]:
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
    is_even = ((row + column) % 2 == 0)[:, None]
    first = np.where(is_even, np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(is_even, np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    elements = np.stack([first, second], 1).reshape(-1, 3).astype(np.int32)
    return np.stack([x.ravel(), y.ravel()], 1), elements


Matrix = TypeVar("Matrix", sp.csr_matrix, sp.csc_matrix)


def with_data(structure: Matrix, data: FloatArray) -> Matrix:
    """Return a matrix with the structure of another, shared with it and not checked again, and its own `data`."""
    matrix = copy(structure)
    matrix.data = data
    return matrix
