"""Displacement and strain at the nodes, recovered from the best linear fit, and the uncertainty of what is recovered.

A least-squares fit of linear elements passes above the crest of a wave and below its trough: its nodes are off by about
``h^2/12`` times the second derivative, and the mean slope of the elements at an edge is that of a point half an element
inside. A quadratic polynomial is fitted to the nodes around each node, every second-order term with what the linear fit
makes of it under a uniform texture: the polynomial's value and slopes at the node are then right to third order, at
edges too, and carry a third less noise. Under speckle of 3 to 6 px and elements of 25 px a tenth of what the linear
fit's nodes are off by remains (tests/truth/test_estimating_equation.py).

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
from scipy.sparse.linalg import splu

from rgbmidic._kernels.factors import node_energies
from rgbmidic._kernels.mesh import colour_nodes
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.typing import BoolArray, FloatArray

Functional = tuple[sp.csr_matrix | None, sp.csr_matrix | None]
"""A quantity linear in the displacements around each node: its matrices (N, N) for u and for v, None for 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeColouring:
    """Colouring of the nodes so that nodes of one colour are far apart.

    Attributes
    ----------
    colour : ndarray, shape (N,), int64
    nearest : ndarray, shape (C, N), int64
        For every colour, the node of that colour nearest to each node; N where there is none within four edges.
    """

    colour: npt.NDArray[np.int64]
    nearest: npt.NDArray[np.int64]

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> NodeColouring:
        """Greedy colouring: nodes of one colour are at least five edges apart."""
        count = len(mesh.nodes)
        # nodes at one place count as neighbours: the nearest of a colour is found by distance
        i, j = np.concatenate([mesh.neighbours, mesh.copies, np.repeat(np.arange(count), 2).reshape(-1, 2)]).T
        ends = np.concatenate([i, j]), np.concatenate([j, i])
        ring = sp.csr_matrix((np.ones(2 * len(i), dtype=bool), ends), shape=(count, count))
        near = ring @ ring  # two nodes with one near both are at most four edges apart
        reach = near @ near
        colour = np.empty(count, dtype=np.int64)
        colour_nodes(near.indptr, near.indices, np.zeros((count, np.diff(reach.indptr).max()), dtype=bool), colour)
        node, other = np.repeat(np.arange(count), np.diff(reach.indptr)), reach.indices
        place, distance = colour[other] * count + node, sum((axis[node] - axis[other]) ** 2 for axis in mesh.nodes.T)
        least = np.full((colour.max() + 1) * count, np.inf)
        np.minimum.at(least, place, distance)
        nearest, own = np.full(least.size, count), distance == least[place]
        nearest[place[own]] = other[own]
        return cls(colour=colour, nearest=nearest.reshape(-1, count))


def functional_std(
    solve: Callable[[FloatArray], FloatArray],
    right_side_covariance: sp.csc_matrix,
    colouring: NodeColouring,
    asked: Sequence[tuple[Functional, BoolArray]],
) -> FloatArray:
    """Evaluate the standard uncertainty of quantities that are linear in the displacements around each node.

    Parameters
    ----------
    solve
        Solves ``M x = b`` for b of shape (2 N, R).
    right_side_covariance
        S, shape (2 N, 2 N).
    colouring
        Of the mesh.
    asked
        F quantities, row n of whose matrices is zero but for n and its neighbours; and of each the nodes (N,) whose
        uncertainty is asked for. It must not touch a node that is hardly seen: such a column reaches far and would
        corrupt those of its colour.

    Returns
    -------
    ndarray, shape (N, F)
    """
    count, colours = len(colouring.colour), len(colouring.nearest)
    columns = np.zeros((count, 2, len(asked), colours))
    for i, (functional, nodes) in enumerate(asked):
        for axis, matrix in enumerate(functional):
            if matrix is not None:
                row = np.repeat(np.arange(count), np.diff(matrix.indptr))
                place = matrix.indices * np.int64(colours) + colouring.colour[row]
                sums = np.bincount(place, weights=matrix.data * nodes[row], minlength=count * colours)
                columns[:, axis, i] = sums.reshape(count, colours)
    solved = solve(columns.reshape(2 * count, -1))
    energy = np.empty((count, len(asked), colours))
    covariance = right_side_covariance  # symmetric: its columns are its rows
    node_energies(covariance.data, covariance.indices, covariance.indptr, solved, energy.reshape(count, -1))
    nearest = colouring.nearest.T.ravel()
    variance = [np.bincount(nearest, weights=energy[:, i].ravel(), minlength=count)[:count] for i in range(len(asked))]
    return np.sqrt(np.maximum(np.stack(variance, axis=1), 0))


def displacement_functionals(nodes: int) -> list[Functional]:
    """Return the displacements u and v themselves, as `functional_std` takes them."""
    itself = sp.eye(nodes, format="csr")
    return [(itself, None), (None, itself)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """Linear operators from the nodal values of the linear fit to the field at the nodes.

    Attributes
    ----------
    value, slope_x, slope_y : csr_matrix, shape (N, N)
    curvature : tuple of csr_matrix, shape (N, N)
        Second derivatives xx, xy, yy.
    """

    value: sp.csr_matrix
    slope_x: sp.csr_matrix
    slope_y: sp.csr_matrix
    curvature: tuple[sp.csr_matrix, ...]

    @classmethod
    def over(
        cls,
        mesh: Tri3Mesh,
        used: BoolArray,
        information: FloatArray,
        offset: FloatArray,
        first: int | None = None,
    ) -> Recovery:
        """Over the elements `used` (E,); `information` (N,), `offset` (N, 3) and `first` as in `quadratic_fit`."""
        operators = quadratic_fit(mesh, used, information=information, offset=offset, first=first)
        value, slope_x, slope_y, *curvature = operators
        return cls(value=value, slope_x=slope_x, slope_y=slope_y, curvature=tuple(curvature))

    @property
    def displacement_functionals(self) -> list[Functional]:
        """Displacements u and v at the nodes, as `functional_std` takes them."""
        return [(self.value, None), (None, self.value)]

    @property
    def strain_functionals(self) -> list[Functional]:
        """Strains exx, eyy, exy at the nodes, as `functional_std` takes them."""
        half_x, half_y = (with_data(slope, slope.data / 2) for slope in (self.slope_x, self.slope_y))
        return [(self.slope_x, None), (None, self.slope_y), (half_y, half_x)]

    def displacement(self, fitted: FloatArray) -> FloatArray:
        """Displacement (N, 2) at the nodes for that of the linear fit (N, 2)."""
        return np.asarray(self.value @ fitted)

    def strain(self, fitted: FloatArray) -> FloatArray:
        """Strain (N, 3) exx, eyy, exy at the nodes."""
        x, y = self.slope_x @ fitted, self.slope_y @ fitted
        return np.stack([x[:, 0], y[:, 1], (y[:, 0] + x[:, 1]) / 2], axis=1)

    def bend(self, fitted: FloatArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the linear fit has at the nodes beyond the field (N, 2), and its second derivatives (N, 2, 3)."""
        second = np.stack([operator @ fitted for operator in self.curvature], axis=-1)
        return np.einsum("nt,nct->nc", offset[: len(second)], second), second


def linear_fit_offset(mesh: Tri3Mesh) -> FloatArray:
    """Solve for what the best linear fit has at the nodes beyond a field with second derivative xx, xy or yy of 1.

    The texture counts alike in all places and directions on average, so the fit is that of the mass matrix M. A field
    with the second derivative H has ``-1/2 sum phi_a phi_b d^T H d`` over its linear interpolant, d being the edges of
    an element of area A. The offset solves ``M x = b``, where b sums over the elements around a node
    ``-A/120 (2 sum d^T H d - d^T H d of the opposite edge)``.

    Returns
    -------
    ndarray, shape (N, 3)
        For xx, xy and yy, square px.
    """
    corners = mesh.nodes[mesh.elements]
    edge = np.roll(corners, -1, axis=1) - corners
    squares = np.stack([edge[..., 0] ** 2, 2 * edge[..., 0] * edge[..., 1], edge[..., 1] ** 2], axis=-1)
    opposite = np.roll(squares, -1, axis=1)  # edge a joins the corners a and a + 1
    parts = -(2 * squares.sum(axis=1, keepdims=True) - opposite) * mesh.areas[:, None, None] / 120
    sums = [
        np.bincount(mesh.elements.ravel(), weights=part.ravel(), minlength=len(mesh.nodes))
        for part in np.moveaxis(parts, -1, 0)
    ]
    options = {"SymmetricMode": True}
    factors = splu(mass_matrix(mesh), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.asarray(factors.solve(np.stack(sums, axis=1)))


def mass_matrix(mesh: Tri3Mesh) -> sp.csc_matrix:
    """Integrals (N, N) of the products of two shape functions, square px: the consistent mass matrix."""
    mass = np.where(np.eye(3, dtype=bool), 2, 1) * mesh.areas[:, None, None] / 12
    rows, columns = np.repeat(mesh.elements, 3, axis=1).ravel(), np.tile(mesh.elements, 3).ravel()
    return sp.csc_matrix((mass.ravel(), (rows, columns)), shape=(len(mesh.nodes),) * 2)
