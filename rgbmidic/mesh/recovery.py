"""Displacement and strain at the nodes, recovered from the best linear fit, and the uncertainty of what is recovered.

A least-squares fit of linear elements passes above the crest of a wave and below its trough: its nodes are off by about
``h^2/12`` times the second derivative, and the mean slope of the elements at an edge is that of a point half an element
inside. A quadratic polynomial is fitted to the nodes around each node, every second-order term with what the linear fit
makes of it under a uniform texture: the polynomial's value and slopes at the node are then right to third order, at
edges too, and carry a third less noise. Under speckle of 3 to 6 px and elements of 25 px a tenth of what the linear
fit's nodes are off by remains (tests/truth/test_estimating_equation.py).

The quadratic fit is the recovery of Zhang and Naga, SIAM J. Sci. Comput. 26, 2005, with weights that fall with the
distance.

The covariance is the sandwich ``M^-1 S M^-1`` with S the covariance of the right-hand side. Columns of M^-1 decay
within a few elements, so many of them are found with one solve: unit vectors of nodes far apart are summed (probing),
and each node of the result belongs to the nearest of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic._kernels.factors import node_energies
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.outline_mesh import EDGES, edge_keys
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.typing import BoolArray, FloatArray

Functional = tuple[sp.csr_matrix | None, sp.csr_matrix | None]
"""A quantity linear in the displacements around each node: its matrices (N, N) for u and for v, None for 0."""


def functional_std(
    solve: Callable[[FloatArray], FloatArray],
    right_side_covariance: sp.csc_matrix,
    mesh: Tri3Mesh,
    quantities: Sequence[tuple[Functional, BoolArray]],
) -> FloatArray:
    """Evaluate the standard uncertainty of quantities that are linear in the displacements around each node.

    Parameters
    ----------
    solve
        Solves ``M x = b`` for b of shape (2 N, R).
    right_side_covariance
        S, shape (2 N, 2 N).
    mesh
        N nodes.
    quantities
        F quantities, row n of whose matrices is zero but for n and its neighbours; and of each the nodes (N,) whose
        uncertainty is asked for. It must not touch a node that is hardly seen: such a column reaches far and would
        corrupt those of its colour.

    Returns
    -------
    ndarray, shape (N, F)
    """
    count, (colour, nearest) = len(mesh.nodes), mesh.colouring
    colours = len(nearest)
    columns = np.zeros((count, 2, len(quantities), colours))
    for i, (functional, nodes) in enumerate(quantities):
        for axis, matrix in enumerate(functional):
            if matrix is not None:
                row = np.repeat(np.arange(count), np.diff(matrix.indptr))
                slot = matrix.indices * np.int64(colours) + colour[row]
                sums = np.bincount(slot, weights=matrix.data * nodes[row], minlength=count * colours)
                columns[:, axis, i] = sums.reshape(count, colours)
    solved = solve(columns.reshape(2 * count, -1))
    energy = np.empty((count, len(quantities), colours))
    covariance = right_side_covariance  # symmetric: its columns are its rows
    node_energies(covariance.data, covariance.indices, covariance.indptr, solved, energy.reshape(count, -1))
    owner = nearest.T.ravel()
    variance = [
        np.bincount(owner, weights=energy[:, i].ravel(), minlength=count)[:count] for i in range(len(quantities))
    ]
    return np.sqrt(np.maximum(np.stack(variance, axis=1), 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """Linear operators from the nodal values of the linear fit to the field at the nodes.

    Attributes
    ----------
    value, slope_x, slope_y : csr_matrix, shape (N, N)
    curvature : tuple of csr_matrix, shape (N, N)
        Second derivatives xx, xy, yy.
    offset : ndarray, shape (N, 3)
        See `Tri3Mesh.linear_fit_offset`.
    """

    value: sp.csr_matrix
    slope_x: sp.csr_matrix
    slope_y: sp.csr_matrix
    curvature: tuple[sp.csr_matrix, ...]
    offset: FloatArray

    @classmethod
    def over(
        cls, mesh: Tri3Mesh, active: BoolArray, information: FloatArray | None = None, first: int | None = None
    ) -> Recovery:
        """Over the elements `active` (E,) of a mesh; `information` (E,) and `first` as in `quadratic_fit`."""
        offset = mesh.linear_fit_offset
        operators = quadratic_fit(mesh, active, information=information, offset=offset, first=first)
        value, slope_x, slope_y, *curvature = operators
        return cls(value=value, slope_x=slope_x, slope_y=slope_y, curvature=tuple(curvature), offset=offset)

    @property
    def strain_functionals(self) -> list[Functional]:
        """Strains exx, eyy, exy at the nodes, as `functional_std` takes them."""
        half_x, half_y = (with_data(slope, slope.data / 2) for slope in (self.slope_x, self.slope_y))
        return [(self.slope_x, None), (None, self.slope_y), (half_y, half_x)]

    def field(self, u: FloatArray, v: FloatArray) -> FloatArray:
        """u, v, exx, eyy, exy (..., 5) at the nodes for nodal values u and v of the linear fit, (N,) or (N, R)."""
        shear = (self.slope_y @ u + self.slope_x @ v) / 2
        return np.stack([self.value @ u, self.value @ v, self.slope_x @ u, self.slope_y @ v, shear], axis=-1)

    def offset_and_curvature(self, fitted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the linear fit has at the nodes beyond the field (N, 2), and its second derivatives (N, 2, 3)."""
        second = np.stack([operator @ fitted for operator in self.curvature], axis=-1)
        return np.einsum("nt,nct->nc", self.offset[: len(second)], second), second


Index = npt.NDArray[np.intp]

TERMS = ("value", "x", "y", "xx", "xy", "yy")
"""Results of the operators of `quadratic_fit`: the value, its first and its second derivatives."""


def quadratic_fit(
    mesh: Tri3Mesh,
    active: BoolArray,
    *,
    information: FloatArray | None = None,
    offset: FloatArray | None = None,
    first: int | None = None,
) -> tuple[sp.csr_matrix, ...]:
    """Linear operators (N, N), one for each of `TERMS`, from nodal values to those of the polynomial at each node.

    The polynomial is fitted to the nodes within two edges, reached over `active` elements only: not across a crack or a
    hole. Quadratic fields are reproduced, at edges too; what too few nodes determine is 0.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    active : ndarray, shape (E,), bool
        Elements over which nodes are reached.
    information : ndarray, shape (E,), optional
        What an element shows of the displacement, per area (inverse variance, any unit); None: all alike. A node that
        is known badly counts little elsewhere, and so does one that is reached only over elements that show little
        beside what a node knows: they may hide a step.
    offset : ndarray, shape (N, 3), optional
        Excess of the given values over a field whose second derivative xx, xy or yy is 1, square px; 0 without.
    first
        Fit the polynomials of so many first nodes only; None: of all.

    Returns
    -------
    tuple of csr_matrix, shape (N, N) or (`first`, N)
        In the order of `TERMS`, per px and square px.
    """
    neighbours, entries, weight, structure = mesh.derive(_window, active.tobytes())
    basis = mesh.derive(_basis, active.tobytes(), None if offset is None else offset.tobytes())
    if information is not None:
        weight = weight.copy()
        weight.ravel()[entries] *= _relative_information(mesh, active, information)
    if first is not None:
        neighbours, weight, basis, structure = neighbours[:first], weight[:first], basis[:first], structure[:first]
        entries = entries[: structure.nnz]
    weighted = weight[:, None] * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    # slopes and curvatures are held at 0 where too few nodes determine them: the second derivatives of waves of 5 to 6
    # elements, crack tips among them, change by 2e-5 of the largest at most (measured)
    normal[:, range(1, 6), range(1, 6)] += [1e-9, 1e-9, 1e-6, 1e-6, 1e-6]
    fits = (
        np.linalg.inv(normal) / (mesh.sizes[: len(neighbours), None] ** np.array([0, 1, 1, 2, 2, 2]))[:, :, None]
    ) @ weighted
    return tuple(with_data(structure, fits[:, term].ravel()[entries]) for term in range(6))


def _relative_information(mesh: Tri3Mesh, active: BoolArray, information: FloatArray) -> FloatArray:
    """Factor (M,) on the weights of the nodes around each, in the order of `_Ways`, by the elements' information.

    It is that of both nodes' variances, times the square of what twice the widest way between them has over what the
    node has, 1 at most: a way is over one or two edges, an edge is as wide as the better of its elements, a way as its
    narrower edge. Twice: elements differ by chance, by as many speckles as they hold.
    """
    ways, area = mesh.derive(_ways, active.tobytes()), mesh.areas * active
    nodal = mesh.to_nodes(information * area) / np.maximum(mesh.to_nodes(area), 1e-300)
    # the last element stands for a node itself
    width = np.maximum.reduceat(np.append(information, np.inf)[ways.elements], ways.element_starts)
    widest = np.maximum.reduceat(np.minimum(width[ways.first], width[ways.second]), ways.starts)
    structure = ways.structure
    row = np.repeat(np.arange(len(nodal)), np.diff(structure.indptr))
    node, neighbour = nodal[row], nodal[structure.indices]
    by_node = np.divide(neighbour, node + neighbour, out=np.full(row.size, 0.5), where=node + neighbour > 0)
    by_way = np.divide(np.minimum(2 * widest, node), node, out=np.ones(row.size), where=node > 0)
    return np.asarray(by_node * by_way**2)


def slope_operators(mesh: Tri3Mesh, active: BoolArray) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    """Linear operators (N, N) from nodal values to the slopes along x and y with which the field is interpolated.

    The slope at a node is the mean, by the areas of the elements between, of what the quadratics of the nodes beside it
    (`quadratic_fit`) have there: each node's own has too small a slope where waves are short, those beside it too large
    a one. At an edge, where all of them lie on one side, it is the mean of that and its own: of the error of waves of 4
    to 10 elements beside the edge a tenth to three tenths less is left.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    active : ndarray, shape (E,), bool
        Elements over which nodes are reached.

    Returns
    -------
    tuple of csr_matrix, shape (N, N)
    """
    _, x, y, xx, xy, yy = quadratic_fit(mesh, active)
    count, corners = len(mesh.nodes), mesh.elements[active]
    pairs = np.concatenate([corners[:, [a, b]] for a in range(3) for b in range(3) if a != b])
    average = sp.csr_matrix((np.tile(mesh.areas[active], 6), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    row = np.repeat(np.arange(count), np.diff(average.indptr))
    average.data /= np.bincount(row, weights=average.data, minlength=count)[row]
    to_x, to_y = (with_data(average, average.data * (axis[row] - axis[average.indices])) for axis in mesh.nodes.T)
    node_fraction = np.where(at_free_boundary(mesh, active), 0.5, 0.0)
    neighbour_slopes = average @ x + to_x @ xx + to_y @ xy, average @ y + to_x @ xy + to_y @ yy
    along_x, along_y = (
        sp.csr_matrix(sp.diags(1 - node_fraction) @ mean + sp.diags(node_fraction) @ slope)
        for mean, slope in zip(neighbour_slopes, (x, y), strict=True)
    )
    return along_x, along_y


def _window(mesh: Tri3Mesh, active: bytes) -> tuple[Index, Index, FloatArray, sp.csr_matrix]:
    """Return the nodes that the polynomial of each node is fitted to.

    Returns
    -------
    tuple
        The nodes around each, itself where a row has fewer, (N, W); the places of those that are no such filling; their
        weights (N, W); and the matrix of these nodes.
    """
    elements = np.frombuffer(active, dtype=bool)
    surrounded = angle_fraction(mesh, elements)
    reach = mesh.derive(_ways, active).structure
    number = np.diff(reach.indptr)
    is_entry = np.arange(number.max()) < number[:, None]
    neighbours = np.repeat(np.arange(number.size)[:, None], is_entry.shape[1], axis=1)
    neighbours[is_entry] = reach.indices
    square = sum((axis[neighbours] - axis[:, None]) ** 2 for axis in mesh.nodes.T) / mesh.sizes[:, None] ** 2
    # Standard deviation of the weights around an inner node, in sides of an element. Waves of 3, 4 and 6 elements then
    # have .95 to 1.02, .99 to 1.01 and 1.00 of their height at the nodes, at a third less noise than the linear fit's;
    # with .45 1.05 and with .7 .86 of it at 3 elements (regular and outlined meshes, waves along the mesh and at 45
    # degrees). At an edge the window holds as much of the mesh as inside: with .58 everywhere corners scattered 2 times
    # as much as the linear fit's, and waves at an edge were seen no better.
    width = 0.58
    weight = np.where(is_entry, np.exp(-square * surrounded[:, None] / (2 * width**2)), 0.0)
    return neighbours, np.flatnonzero(is_entry), weight, reach


def angle_fraction(mesh: Tri3Mesh, active: BoolArray) -> FloatArray:
    """Return the fraction (N,) of the full angle around each node in `active` elements; 1 where there are none."""
    corners = mesh.nodes[mesh.elements]
    ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    angle = np.arctan2(across, (ahead * back).sum(axis=-1)) * active[:, None]
    fraction = np.bincount(mesh.elements.ravel(), weights=angle.ravel(), minlength=len(mesh.nodes)) / (2 * np.pi)
    return np.asarray(np.where(fraction > 0, fraction, 1.0))


def at_free_boundary(mesh: Tri3Mesh, active: BoolArray | None = None) -> BoolArray:
    """Nodes (N,) on the boundary of `active` elements (E,), and those within a quarter of an element of it."""
    elements, areas = (mesh.elements, mesh.areas) if active is None else (mesh.elements[active], mesh.areas[active])
    sides = elements[:, EDGES]
    keys = edge_keys(sides.reshape(-1, 2), len(mesh.nodes))
    _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    is_free = (count[index] == 1).reshape(-1, 3)
    length = np.linalg.norm(np.diff(mesh.nodes[sides], axis=2)[:, :, 0], axis=2)
    opposite = np.roll(elements, 1, axis=1)  # edge a joins the corners a and a + 1
    is_near = 2 * areas[:, None] / length < mesh.sizes[opposite] / 4
    at_boundary = np.zeros(len(mesh.nodes), dtype=bool)
    at_boundary[sides[is_free]] = True
    at_boundary[opposite[is_near & is_free]] = True
    return at_boundary


def _basis(mesh: Tri3Mesh, active: bytes, offset: bytes | None) -> FloatArray:
    """Evaluate 1, x, y, xx/2, xy, yy/2 about each node at those around it, in sides of an element: (N, 6, W)."""
    neighbours = mesh.derive(_window, active)[0]
    sizes = mesh.sizes[:, None]
    x, y = ((axis[neighbours] - axis[:, None]) / sizes for axis in mesh.nodes.T)
    basis = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=1)
    if offset is not None:
        for term, excess in enumerate(np.frombuffer(offset).reshape(-1, 3).T):
            basis[:, 3 + term] += excess[neighbours] / sizes**2
    return basis


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Ways:
    """Ways over one or two edges from each node to those around it.

    Attributes
    ----------
    structure : csr_matrix, shape (N, N)
        The nodes that are reached from each, and itself; its indices are sorted.
    elements, element_starts
        Elements at each edge, and where those of an edge begin. A node is an edge to itself, of the element E.
    first, second
        Edges of each way.
    starts
        Where the ways of an entry of the structure begin.
    """

    structure: sp.csr_matrix
    elements: Index
    element_starts: Index
    first: Index
    second: Index
    starts: Index


def _ways(mesh: Tri3Mesh, active: bytes) -> _Ways:
    """Find the ways over `active` elements; they do not lead round the tip of a crack to its other side."""
    is_active, count = np.frombuffer(active, dtype=bool), len(mesh.nodes)
    is_tip = mesh.on_boundary & (angle_fraction(mesh, is_active) > 0.8)  # of a crack that opens by less than 70 degrees
    corners, nodes = mesh.elements[is_active].astype(np.intp), np.arange(count)
    sides = count * np.repeat(corners, 3, axis=1).ravel() + np.tile(corners, 3).ravel()
    keys = np.concatenate([sides, (count + 1) * nodes])
    elements = np.concatenate([np.repeat(np.flatnonzero(is_active), 9), np.full(count, len(mesh.elements))])
    order = np.argsort(keys, kind="stable")
    edges, element_starts = np.unique(keys[order], return_index=True)
    begin, end = np.divmod(edges, count)
    number = np.bincount(begin, minlength=count)
    following = number[end]
    first = np.repeat(np.arange(edges.size), following)
    second = np.arange(first.size) + np.repeat(
        (np.cumsum(number) - number)[end] - (np.cumsum(following) - following), following
    )
    allowed = ~is_tip[end[first]] | (end[second] == end[first])
    first, second = first[allowed], second[allowed]
    way_order = np.argsort(count * begin[first] + end[second], kind="stable")
    first, second = first[way_order], second[way_order]
    reached, starts = np.unique(count * begin[first] + end[second], return_index=True)
    row, column = np.divmod(reached, count)
    offsets = np.searchsorted(row, np.arange(count + 1))
    structure = sp.csr_matrix(
        (np.ones(reached.size), column.astype(np.int32), offsets.astype(np.int32)), shape=(count, count)
    )
    return _Ways(
        structure=structure,
        elements=elements[order],
        element_starts=element_starts,
        first=first,
        second=second,
        starts=starts,
    )
