"""The field between the nodes of a mesh: points, pixels and the weights of the nodes there.

In an element it is ``sum phi_a (u_a + slope_a . (x - x_a) / 2)`` over its corners, with slopes from the quadratics
around (`slope_operators`): continuous, linear in the nodal values and exact for quadratic fields; along an edge it is
the cubic through values and slopes of both ends.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.arguments import checked
from rgbmidic.errors import InputError
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.mesh.recovery import slope_operators
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, FloatImage, IntArray

_ROUNDING = 1e-6
"""Rounding of barycentric coordinates, 1e-5 px."""
_AT_ONCE = 20_000
"""Points whose elements are searched at once: some 60 MB (derived)."""


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshPoints:
    """Points in a mesh: their elements and barycentric coordinates.

    Attributes
    ----------
    mesh
        The mesh.
    points : ndarray, shape (P, 2)
        In px on the reference.
    inside : ndarray, shape (P,), bool
    element : ndarray, shape (P,), int
        The element that holds the point, the nearest one for a point outside.
    barycentric : ndarray, shape (P, 3)
        Value of the shape functions of that element's nodes at the point.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> points = MeshPoints.of(mesh, np.array([[30.0, 25.0], [95.0, 25.0]]))
    >>> points.inside.tolist()
    [True, False]
    """

    mesh: Tri3Mesh
    points: FloatArray
    inside: BoolArray
    element: IntArray
    barycentric: FloatArray

    @classmethod
    def of(cls, mesh: Tri3Mesh, points: npt.ArrayLike) -> Self:
        """Find the elements of points (P, 2) in a mesh.

        Parameters
        ----------
        mesh
            N nodes, E elements.
        points : array_like, shape (P, 2)
            Points (x, y) on the reference, px.

        Returns
        -------
        MeshPoints
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        middle, slopes, element = mesh.centres, mesh.shape_gradients(), np.empty(len(points), dtype=np.int64)
        count = min(24, len(middle))  # the nearest elements: their sizes in one mesh differ by a factor of 2
        for start in range(0, len(points), _AT_ONCE):
            batch = points[start : start + _AT_ONCE]
            near = np.asarray(mesh.centre_tree.query(batch, k=count)[1]).reshape(-1, count)
            shape = np.einsum("pced,pcd->pce", slopes[near], batch[:, None] - middle[near])
            element[start : start + _AT_ONCE] = near[np.arange(len(near)), shape.min(axis=2).argmax(axis=1)]
        return cls.within(mesh, points, element)

    @classmethod
    def within(cls, mesh: Tri3Mesh, points: FloatArray, element: IntArray) -> Self:
        """Take points whose elements are known.

        Parameters
        ----------
        mesh
            N nodes, E elements.
        points : ndarray, shape (P, 2)
            Points (x, y) on the reference, px.
        element : ndarray, shape (P,), int
            Their elements.

        Returns
        -------
        MeshPoints
        """
        offset = points - mesh.centres[element]
        barycentric = 1 / 3 + np.einsum("pcd,pd->pc", mesh.shape_gradients()[element], offset)
        inside = barycentric.min(axis=1) >= -_ROUNDING
        return cls(mesh=mesh, points=points, inside=inside, element=element, barycentric=barycentric)

    @classmethod
    def subdivide(cls, mesh: Tri3Mesh, along: int) -> tuple[Self, npt.NDArray[np.int32]]:
        """Divide each element, for pictures of the field that are linear in the parts.

        Parameters
        ----------
        mesh
            E elements.
        along
            Parts of a side.

        Returns
        -------
        places : Places
            Corners of the parts, those of each element apart.
        triangles : ndarray, shape (E along^2, 3), int32
            Indices of the corners of each part.
        """
        steps = [(i, j) for i in range(along + 1) for j in range(along + 1 - i)]
        index = {step: number for number, step in enumerate(steps)}
        up = [((i, j), (i + 1, j), (i, j + 1)) for i, j in steps if i + j < along]
        down = [((i + 1, j), (i + 1, j + 1), (i, j + 1)) for i, j in steps if i + j < along - 1]
        subtriangles = np.array([[index[corner] for corner in triangle] for triangle in up + down])
        second, third = np.array(steps).T / along
        shape = np.stack([1 - second - third, second, third], axis=1)
        points = np.einsum("sc,ecd->esd", shape, mesh.nodes[mesh.elements]).reshape(-1, 2)
        element = np.arange(len(mesh.elements))
        corners = (len(steps) * element[:, None, None] + subtriangles).reshape(-1, 3)
        return cls.within(mesh, points, np.repeat(element, len(steps))), corners.astype(np.int32)

    def check(self, description: str) -> None:
        """Refuse points outside the mesh.

        Parameters
        ----------
        description
            What the points are, for the message.

        Raises
        ------
        InputError
            One is; the message names it after `description`.
        """
        if not self.inside.all():
            x, y = self.points[~self.inside][0]
            raise InputError(f"{description} at ({x:g}, {y:g}) px is outside {self.bounds_text}")

    @property
    def bounds_text(self) -> str:
        """Text for messages with the bounds of the region."""
        (left, top), (right, bottom) = self.mesh.nodes.min(axis=0), self.mesh.nodes.max(axis=0)
        return f"the region that was measured, which lies within x {left:g} to {right:g}, y {top:g} to {bottom:g}"

    def nearby(self) -> tuple[IntArray, Self]:
        """Take the part of the mesh on which the field at the points depends.

        Returns
        -------
        nodes : ndarray, shape (m,), int
            Its nodes.
        places : Places
            The points in it.
        """
        mesh, near = self.mesh, np.zeros(len(self.mesh.nodes), dtype=bool)
        near[mesh.elements[self.element[self.inside]]] = True
        near = mesh.adjacent_nodes(
            mesh.adjacent_nodes(mesh.adjacent_nodes(near))
        )  # two edges from those beside an element's nodes
        number = np.cumsum(near[mesh.elements].all(axis=1)) - 1
        element = np.where(self.inside, number[self.element], 0)
        return np.flatnonzero(near), replace(self, mesh=mesh.submesh(near), element=element)

    def measured(self, has_data: BoolArray) -> BoolArray:
        """Report which points (P,) are inside, and have data at the corners around them.

        Parameters
        ----------
        has_data : ndarray, shape (N,), bool
            Nodes that have data.

        Returns
        -------
        ndarray, shape (P,), bool
        """
        missing = (np.abs(self.barycentric) * ~has_data[self.mesh.elements[self.element]]).sum(axis=1)
        return np.asarray(self.inside & (missing <= _ROUNDING))

    def weights(self, has_data: BoolArray) -> sp.csr_matrix:
        """Compute the weight (P, N) of every node in the field at the points.

        Parameters
        ----------
        has_data : ndarray, shape (N,), bool
            Nodes that have data; the weights of the others are 0. A point that is not `measured` has no meaning.

        Returns
        -------
        csr_matrix, shape (P, N)
        """
        fits = self.mesh.derive(_fits, has_data.tobytes())
        return sp.csr_matrix(sum(matrix @ fit for matrix, fit in zip(self._matrices(), fits, strict=True)))

    def read(self, values: FloatArray) -> FloatArray:
        """Evaluate nodal fields at the points.

        Parameters
        ----------
        values : ndarray, shape (N,) or (N, C)
            At the nodes; NaN where a node has no data.

        Returns
        -------
        ndarray, shape (P,) or (P, C)
            NaN outside the mesh and beside nodes without data.
        """
        valid = np.isfinite(values)
        has_data = np.asarray(valid.reshape(len(values), -1).all(axis=1))
        terms = (fit @ np.where(valid, values, 0) for fit in self.mesh.derive(_fits, has_data.tobytes()))
        field = np.asarray(sum(matrix @ term for matrix, term in zip(self._matrices(), terms, strict=True)))
        field[~self.measured(has_data)] = np.nan
        return field

    def linear(self, values: FloatArray) -> FloatArray:
        """Interpolate nodal values linearly, within those of each element's nodes.

        Parameters
        ----------
        values : ndarray, shape (N,)
            At the nodes; NaN where a node has no data.

        Returns
        -------
        ndarray, shape (P,)
            As of `read`.
        """
        field = np.einsum("pc,pc->p", self.barycentric, values[self.mesh.elements[self.element]])
        return np.where(self.inside, field, np.nan)

    def _matrices(self) -> Iterator[sp.csr_matrix]:
        """Weigh values and slopes at the nodes (N,) in the field at the points: (P, N) each."""
        node, first = self.mesh.elements[self.element].ravel(), np.arange(0, self.barycentric.size + 1, 3)
        for factor in self.factors():
            yield sp.csr_matrix((factor.ravel(), node, first), shape=(len(self.points), len(self.mesh.nodes)))

    def factors(self, axis: int | None = None) -> Iterator[FloatArray]:
        """Compute the factors of value and slopes at an element's corners in the field at the points.

        Parameters
        ----------
        axis
            0 or 1: in its slope along x or y; None: in the field.

        Returns
        -------
        iterator of ndarray, shape (P, 3)
            Of the value, the slope along x and that along y.
        """
        arms = np.moveaxis(self.points[:, None] - self.mesh.nodes[self.mesh.elements[self.element]], 2, 0)
        if axis is None:
            shape, inner = self.barycentric, np.zeros(2)
        else:
            shape, inner = self.mesh.shape_gradients()[self.element, :, axis], np.eye(2)[axis]
        yield shape
        for arm, derivative in zip(arms, inner, strict=True):
            yield (shape * arm + self.barycentric * derivative) / 2


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PointSum:
    """A weighted sum of the field over points of a mesh, and where asked the same of its slopes along x and y.

    Attributes
    ----------
    nodes : ndarray, shape (m,), int
        Nodes of the mesh on which it depends.
    submesh
        The mesh of these alone.
    inside
        Fraction of the points that lie in the mesh: the others take no part.
    count : ndarray, shape (G,)
        Fraction of the latter in each group: those of an element that depend on the same of its corners.
    corners : ndarray, shape (G, 3), int
        These, in `submesh`.
    needed : ndarray, shape (G, 3), bool
        Those on which the group depends: the field at a node depends on this one, slopes depend on all.
    moments : ndarray, shape (S, 3, G, 3)
        Factors of value and slopes at the corners in the sums of the field, its slope along x and its slope along y.
    """

    nodes: IntArray
    submesh: Tri3Mesh
    inside: float
    count: FloatArray
    corners: IntArray
    needed: BoolArray
    moments: FloatArray

    @classmethod
    def over(cls, points: MeshPoints, factors: FloatArray, *, slopes: bool = False) -> Self:
        """Sum over places, one at least inside, with factors (P,)."""
        nodes, near = points.nearby()
        inside, needed = near.inside, slopes | (np.abs(near.barycentric) > _ROUNDING)
        _, first, group, count = np.unique(
            8 * near.element[inside] + needed[inside] @ (1, 2, 4),
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )
        sums = sp.csr_matrix(
            (factors[inside], (group.ravel(), np.flatnonzero(inside))), shape=(len(first), len(inside))
        )
        group_points = np.flatnonzero(inside)[first]
        return cls(
            nodes=nodes,
            submesh=near.mesh,
            inside=float(inside.mean()),
            count=count / count.sum(),
            corners=near.mesh.elements[near.element[group_points]].astype(np.int64),
            needed=needed[group_points],
            moments=np.array(
                [[sums @ factor for factor in near.factors(axis)] for axis in ((None, 0, 1) if slopes else (None,))]
            )
            * needed[group_points],
        )

    def weights(self, has_data: BoolArray, *, linear: bool = False) -> tuple[FloatArray, float]:
        """Compute the weights of the nodes in the S sums, over the points that are measured.

        Parameters
        ----------
        has_data : ndarray, shape (m,), bool
            Nodes that have data.
        linear
            Whether the field is linear in each element, within the values of its nodes.

        Returns
        -------
        weights : ndarray, shape (S, m)
        measured
            Fraction of the points inside that have data.
        """
        measured = (has_data[self.corners] | ~self.needed).all(axis=1)
        node, weights = self.corners[measured].ravel(), np.zeros((len(self.moments), len(has_data)))
        fits = self.submesh.derive(_fits, has_data.tobytes())[: 1 if linear else None]
        for fit, sums in zip(fits, self.moments[:, :, measured].swapaxes(0, 1), strict=False):
            nodal_weights = [np.bincount(node, weights=moment.ravel(), minlength=len(has_data)) for moment in sums]
            weights += np.asarray(nodal_weights) @ fit
        return weights, float(self.count[measured].sum())


def _fits(mesh: Tri3Mesh, has_data: bytes) -> tuple[sp.csr_matrix, ...]:
    """Matrices (N, N) from nodal values to the value at each node and to its slopes along x and y."""
    is_complete = np.asarray(np.frombuffer(has_data, dtype=bool)[mesh.elements].all(axis=1))
    return sp.eye(len(mesh.nodes), format="csr"), *slope_operators(mesh, is_complete)


@checked
def at_pixels(mesh: Tri3Mesh, values: FloatArray, shape: tuple[int, int]) -> FloatImage:
    """Evaluate nodal fields at the pixels of an image.

    Parameters
    ----------
    mesh
        The mesh.
    values : ndarray, shape (N, C)
        At the nodes; NaN where a node has no data.
    shape
        Rows and columns (H, W) of the image.

    Returns
    -------
    ndarray, shape (C, H, W), float32
        NaN outside the mesh and in elements with a NaN node.

    Raises
    ------
    InputError
        The values are not those of the nodes, or there is no such image.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> at_pixels(mesh, 0.01 * mesh.nodes[:, :1], (80, 100))[0, 30, [20, 40, 99]].round(3).tolist()
    [0.20000000298023224, 0.4000000059604645, nan]
    """
    if values.ndim != 2 or len(values) != len(mesh.nodes) or min(shape) < 1:
        raise InputError(
            f"nodal fields (N, C) of {len(mesh.nodes)} nodes and an image H, W are needed, not {values.shape}, {shape}"
        )
    pixels = PixelMap.from_mesh(mesh, Region.from_mask(np.ones(shape, dtype=bool)))
    element = np.repeat(np.arange(len(mesh.elements)), np.diff(pixels.offsets))
    points = MeshPoints.within(mesh, np.stack([pixels.columns, pixels.rows], axis=1).astype(np.float64), element)
    field = replace(points, inside=np.ones(len(element), dtype=bool)).read(values)
    return np.stack([pixels.scatter(component, fill=np.nan) for component in field.T])


@checked
def at_nodes(field: FloatArray, nodes: FloatArray) -> FloatArray:
    """Interpolate a pixel field at nodes, bilinearly.

    Parameters
    ----------
    field : ndarray, shape (C, H, W)
        At the pixels.
    nodes : ndarray, shape (N, 2)
        Positions (x, y) in px; a node outside the image takes the value at its edge.

    Returns
    -------
    ndarray, shape (N, C)
        NaN where one of the four pixels around is NaN.

    Raises
    ------
    InputError
        No such field, or no such nodes.

    Examples
    --------
    >>> field = np.stack([np.tile(np.arange(5.0), (4, 1))])
    >>> at_nodes(field, np.array([[2.5, 1.0]])).tolist()
    [[2.5]]
    """
    if field.ndim != 3 or min(field.shape[1:]) < 2 or nodes.shape[1:] != (2,) or not np.isfinite(nodes).all():
        raise InputError(
            f"fields (C, H, W) of 2 x 2 px and more are interpolated at finite nodes (N, 2); given are {field.shape} "
            f"and {nodes.shape}"
        )
    height, width = field.shape[1:]
    x = np.clip(nodes[:, 0], 0, width - 1)
    y = np.clip(nodes[:, 1], 0, height - 1)
    column = np.minimum(x.astype(int), width - 2)
    row = np.minimum(y.astype(int), height - 2)
    tx, ty = x - column, y - row
    above = (1 - tx) * field[:, row, column] + tx * field[:, row, column + 1]
    below = (1 - tx) * field[:, row + 1, column] + tx * field[:, row + 1, column + 1]
    return np.asarray(((1 - ty) * above + ty * below).T)


@checked
def field_rms(mesh: Tri3Mesh, values: FloatArray, truth: FloatArray, *, border: float = 0.0) -> float:
    """Compute the root mean square difference, over pixels and components, of a nodal field and a pixel field.

    Parameters
    ----------
    mesh
        The mesh.
    values : ndarray, shape (N, 2)
        At its nodes; the elements of NaN nodes are left out.
    truth : ndarray, shape (2, H, W)
        At the pixels; NaN pixels are left out.
    border
        Width in px of the rim of the mesh's bounding box that is left out.

    Returns
    -------
    float

    Raises
    ------
    InputError
        The values are not those of the nodes, or the truth has other components.

    Examples
    --------
    >>> nodes, elements = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]]), np.array([[0, 1, 2]], dtype=np.int32)
    >>> mesh = Tri3Mesh(nodes=nodes, elements=elements)
    >>> field_rms(mesh, np.zeros((3, 2)), np.full((2, 5, 5), 0.5))
    0.5
    """
    if truth.ndim != 3 or values.shape[1:] != truth.shape[:1]:
        raise InputError(f"a truth (C, H, W) is compared with values (N, C), not {truth.shape} with {values.shape}")
    difference = at_pixels(mesh, values, truth.shape[1:]) - truth
    low, high = mesh.nodes.min(axis=0) + border, mesh.nodes.max(axis=0) - border
    rows = slice(int(np.ceil(low[1])), int(high[1]) + 1)
    columns = slice(int(np.ceil(low[0])), int(high[0]) + 1)
    inner = difference[:, rows, columns]
    inner = inner[np.isfinite(inner)]
    return float(np.sqrt(np.mean(inner**2))) if inner.size else float("nan")
