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
import scipy.sparse as sp

from rgbmidic._kernels.factors import node_energies
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.typing import BoolArray, FloatArray

Functional = tuple[sp.csr_matrix | None, sp.csr_matrix | None]
"""A quantity linear in the displacements around each node: its matrices (N, N) for u and for v, None for 0."""


def functional_std(
    solve: Callable[[FloatArray], FloatArray],
    right_side_covariance: sp.csc_matrix,
    mesh: Tri3Mesh,
    asked: Sequence[tuple[Functional, BoolArray]],
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
    asked
        F quantities, row n of whose matrices is zero but for n and its neighbours; and of each the nodes (N,) whose
        uncertainty is asked for. It must not touch a node that is hardly seen: such a column reaches far and would
        corrupt those of its colour.

    Returns
    -------
    ndarray, shape (N, F)
    """
    count, (colour, nearest) = len(mesh.nodes), mesh.colouring
    colours = len(nearest)
    columns = np.zeros((count, 2, len(asked), colours))
    for i, (functional, nodes) in enumerate(asked):
        for axis, matrix in enumerate(functional):
            if matrix is not None:
                row = np.repeat(np.arange(count), np.diff(matrix.indptr))
                place = matrix.indices * np.int64(colours) + colour[row]
                sums = np.bincount(place, weights=matrix.data * nodes[row], minlength=count * colours)
                columns[:, axis, i] = sums.reshape(count, colours)
    solved = solve(columns.reshape(2 * count, -1))
    energy = np.empty((count, len(asked), colours))
    covariance = right_side_covariance  # symmetric: its columns are its rows
    node_energies(covariance.data, covariance.indices, covariance.indptr, solved, energy.reshape(count, -1))
    owner = nearest.T.ravel()
    variance = [np.bincount(owner, weights=energy[:, i].ravel(), minlength=count)[:count] for i in range(len(asked))]
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
    offset : ndarray, shape (N, 3)
        See `Tri3Mesh.linear_fit_offset`.
    """

    value: sp.csr_matrix
    slope_x: sp.csr_matrix
    slope_y: sp.csr_matrix
    curvature: tuple[sp.csr_matrix, ...]
    offset: FloatArray

    @classmethod
    def over(cls, mesh: Tri3Mesh, used: BoolArray, information: FloatArray, first: int | None = None) -> Recovery:
        """Over the elements `used` (E,) of a mesh; `information` (N,) and `first` as in `quadratic_fit`."""
        offset = mesh.linear_fit_offset
        operators = quadratic_fit(mesh, used, information=information, offset=offset, first=first)
        value, slope_x, slope_y, *curvature = operators
        return cls(value=value, slope_x=slope_x, slope_y=slope_y, curvature=tuple(curvature), offset=offset)

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

    def bend(self, fitted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what the linear fit has at the nodes beyond the field (N, 2), and its second derivatives (N, 2, 3)."""
        second = np.stack([operator @ fitted for operator in self.curvature], axis=-1)
        return np.einsum("nt,nct->nc", self.offset[: len(second)], second), second
