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
    def over(cls, mesh: Tri3Mesh, active: BoolArray, information: FloatArray, first: int | None = None) -> Recovery:
        """Over the elements `active` (E,) of a mesh; `information` (N,) and `first` as in `quadratic_fit`."""
        operators = quadratic_fit(mesh, active, information=information, of_linear_fit=True, first=first)
        value, slope_x, slope_y, *curvature = operators
        return cls(
            value=value, slope_x=slope_x, slope_y=slope_y, curvature=tuple(curvature), offset=mesh.linear_fit_offset
        )

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
    of_linear_fit: bool = False,
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
    information : ndarray, shape (N,), optional
        How well each node is known (inverse variance, any unit): one that is known badly counts little elsewhere.
    of_linear_fit
        The nodal values are those of the best linear fit of the field (`Tri3Mesh.linear_fit_offset`), not its own.
    first
        Fit the polynomials of so many first nodes only; None: of all.

    Returns
    -------
    tuple of csr_matrix, shape (N, N) or (`first`, N)
        In the order of `TERMS`, per px and square px.
    """
    window = mesh.derive(_Window.over) if active.all() else _Window.over(mesh, active)
    count = len(mesh.nodes) if first is None else first
    neighbours, weight, structure = window.neighbours[:count], window.weight[:count], window.structure[:count]
    basis, entries = (window.fitted if of_linear_fit else window.basis)[:count], window.entries[: structure.nnz]
    if information is not None:
        node_information = np.broadcast_to(information[: len(neighbours), None], neighbours.shape)
        neighbour_information = information[neighbours]
        weight = weight * np.divide(
            neighbour_information,
            node_information + neighbour_information,
            out=np.full(neighbours.shape, 0.5),
            where=node_information + neighbour_information > 0,
        )
    weighted = weight[:, None] * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    # slopes and curvatures are held at 0 where too few nodes determine them: the second derivatives of waves of 5 to 6
    # elements, crack tips among them, change by 2e-5 of the largest at most (measured)
    normal[:, range(1, 6), range(1, 6)] += [1e-9, 1e-9, 1e-6, 1e-6, 1e-6]
    fits = (np.linalg.inv(normal) / (mesh.sizes[:count, None] ** np.array([0, 1, 1, 2, 2, 2]))[:, :, None]) @ weighted
    return tuple(with_data(structure, fits[:, term].ravel()[entries]) for term in range(6))


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


_WIDTH = 0.58
"""Standard deviation of the weights around an inner node, in sides of an element. Waves of 3, 4 and 6 elements then
have .95 to 1.02, .99 to 1.01 and 1.00 of their height at the nodes, at a third less noise than the linear fit's; with
.45 1.05 and with .7 .86 of it at 3 elements (regular and outlined meshes, waves along the mesh and at 45 degrees). At
an edge the window holds as much of the mesh as inside: with .58 everywhere corners scattered 2 times as much as the
linear fit's, and waves at an edge were seen no better."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Window:
    """The nodes that the polynomial of each node is fitted to.

    Attributes
    ----------
    neighbours : ndarray, shape (N, W)
        The nodes around each; itself where a row has fewer.
    entries
        Places of those that are no such filling.
    weight : ndarray, shape (N, W)
        Their weights.
    structure
        Matrix of these nodes.
    basis : ndarray, shape (N, 6, W)
        1, x, y, xx/2, xy, yy/2 about each node at those around it, in sides of an element.
    fitted : ndarray, shape (N, 6, W)
        The same of their best linear fits.
    """

    neighbours: Index
    entries: Index
    weight: FloatArray
    structure: sp.csr_matrix
    basis: FloatArray
    fitted: FloatArray

    @classmethod
    def over(cls, mesh: Tri3Mesh, active: BoolArray | None = None) -> _Window:
        """Reach nodes over `active` elements (E,), or over all."""
        elements = np.ones(len(mesh.elements), dtype=bool) if active is None else active
        surrounded = angle_fraction(mesh, elements)
        is_tip = mesh.on_boundary & (surrounded > 0.8)  # of a crack that opens by less than 70 degrees
        reach = _reached(mesh, elements, ~is_tip)
        number, sizes = np.diff(reach.indptr), mesh.sizes[:, None]
        is_entry = np.arange(number.max()) < number[:, None]
        neighbours = np.repeat(np.arange(number.size)[:, None], is_entry.shape[1], axis=1)
        neighbours[is_entry] = reach.indices
        x, y = ((axis[neighbours] - axis[:, None]) / sizes for axis in mesh.nodes.T)
        basis = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=1)
        fitted = basis.copy()
        fitted[:, 3:] += (mesh.linear_fit_offset[neighbours] / sizes[..., None] ** 2).transpose(0, 2, 1)
        return cls(
            neighbours=neighbours,
            entries=np.flatnonzero(is_entry),
            weight=np.where(is_entry, np.exp(-(x * x + y * y) * surrounded[:, None] / (2 * _WIDTH**2)), 0.0),
            structure=reach,
            basis=basis,
            fitted=fitted,
        )


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


def _reached(mesh: Tri3Mesh, active: BoolArray, passable: BoolArray) -> sp.csr_matrix:
    """Return the nodes up to two edges of `active` elements away from each and itself, as the entries of its row.

    A way leads through `passable` nodes (N,) only: not round the tip of a crack to its other side.
    """
    corners, itself = mesh.elements[active], np.arange(len(mesh.nodes))
    rows = np.concatenate([np.repeat(corners, 3, axis=1).ravel(), itself])
    columns = np.concatenate([np.tile(corners, 3).ravel(), itself])
    beside = sp.csr_matrix((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(itself.size, itself.size))
    row = np.repeat(itself, np.diff(beside.indptr))
    through = with_data(beside, passable[row] | (beside.indices == row))
    reached = sp.csr_matrix(beside @ through)
    reached.sort_indices()  # or scipy might, later, in one of the matrices that share them
    return reached
