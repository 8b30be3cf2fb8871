"""From the best linear fit to the field itself: displacement and strain at the nodes by a quadratic through them.

A least-squares fit of linear elements passes above the crest of a wave and below its trough: its nodes are off by about
``h^2/12`` times the second derivative, and the mean slope of the elements at an edge is that of a point half an element
inside. A quadratic polynomial is fitted to the nodes around each node, every second-order term with what the linear fit
makes of it: the polynomial's value and slopes at the node are right to third order, at edges too, and carry a third
less noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.correlation.uncertainty.propagation import Functional
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.mesh.sparse import with_data
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Recovery", "linear_fit_offset", "mass_matrix"]


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
    def over(cls, mesh: Tri3Mesh, used: BoolArray, information: FloatArray, offset: FloatArray) -> Recovery:
        """Over the elements `used` (E,); `information` (N,) and `offset` (N, 3) as in `quadratic_fit`."""
        value, slope_x, slope_y, *curvature = quadratic_fit(mesh, used, information=information, offset=offset)
        return cls(value=value, slope_x=slope_x, slope_y=slope_y, curvature=tuple(curvature))

    @property
    def displacement_functionals(self) -> list[Functional]:
        """u and v at the nodes, as `functional_std` takes them."""
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
        """What the linear fit has at the nodes beyond the field (N, 2), and its second derivatives (N, 2, 3)."""
        second = np.stack([operator @ fitted for operator in self.curvature], axis=-1)
        return np.einsum("nt,nct->nc", offset, second), second


def linear_fit_offset(mesh: Tri3Mesh) -> FloatArray:
    """What the best linear fit has at the nodes beyond a field whose second derivative xx, xy or yy is 1: (N, 3), px^2.

    The texture counts alike in all places and directions on average, so the fit is that of the mass matrix M. A field
    with the second derivative H has ``-1/2 sum phi_a phi_b d^T H d`` over its linear interpolant, d being the edges of
    an element of area A. The offset solves ``M x = b``, where b sums over the elements around a node
    ``-A/120 (2 sum d^T H d - d^T H d of the opposite edge)``.
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
