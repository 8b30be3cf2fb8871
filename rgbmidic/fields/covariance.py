"""How the errors of neighbouring nodes go together, which means, gauges and strains need.

The solve is a least-squares fit of linear elements, whose covariance is the inverse of a Hessian: for a texture that is
alike everywhere the inverse of the mesh's mass matrix. The displacement at a node is then that of a quadratic through
the nodes around it, a linear function of theirs. Where the texture, the weights or the noise vary, the stated
uncertainty of each node says by how much; its correlation with the others is taken as the mesh's alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.correlation.recovery import Recovery, linear_fit_offset, mass_matrix
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray

__all__ = ["NodalCovariance"]

_LOW, _HIGH = 0.5, 2.0
"""Bounds of the eigenvalues of a TRI3 mass matrix over its diagonal, on any mesh (Wathen, IMA J Numer Anal 7, 1987)."""
_RINGS = 4
"""Edges from a node up to which the inverse mass matrix is kept: what lies beyond is .8 % or less."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodalCovariance:
    """Correlation of the error of one displacement component between the nodes of a mesh; u and v have none in common.

    Attributes
    ----------
    mesh
        The mesh.
    correlation : csr_matrix, shape (N, N)
        1 on the diagonal.
    """

    mesh: Tri3Mesh
    correlation: sp.csr_matrix

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> Self:
        """Of the linear fit (the inverse mass matrix), carried through the recovery of the nodal values."""
        mass = mass_matrix(mesh)
        scale = sp.diags(1 / np.sqrt(mass.diagonal()))
        inverse = scale @ _chebyshev_inverse(sp.csr_matrix(scale @ mass @ scale), _RINGS) @ scale
        everywhere = np.ones(len(mesh.elements), dtype=bool)
        recovery = Recovery.over(mesh, everywhere, np.ones(len(mesh.nodes)), linear_fit_offset(mesh)).value
        whole = sp.csr_matrix(recovery @ inverse @ recovery.T)
        unit = sp.diags(1 / np.sqrt(whole.diagonal()))
        return cls(mesh=mesh, correlation=sp.csr_matrix(unit @ whole @ unit))

    def variance(self, weights: FloatArray, std: FloatArray) -> FloatArray:
        """Variance of the sum of nodal values by `weights` (..., N) where their standard uncertainty is `std` (..., N).

        Nodes of the weight 0 take no part, their uncertainty may be NaN.
        """
        parts = np.where(weights != 0, np.asarray(weights) * np.asarray(std), 0.0)
        flat = np.atleast_2d(parts.reshape(-1, parts.shape[-1]))
        total = np.einsum("fn,fn->f", flat @ self.correlation, flat)
        return np.asarray(np.maximum(total, 0)).reshape(parts.shape[:-1])

    def part(self, nodes: npt.NDArray[np.int64]) -> FloatArray:
        """Correlation (m, m) of some nodes, given by their indices (m,)."""
        chosen = sp.csr_matrix(
            (np.ones(len(nodes)), (np.arange(len(nodes)), nodes)), shape=(len(nodes), len(self.mesh.nodes))
        )
        return np.asarray((chosen @ self.correlation @ chosen.T).toarray())


def _chebyshev_inverse(matrix: sp.csr_matrix, degree: int) -> sp.csr_matrix:
    """Polynomial of `degree` in a matrix with eigenvalues in the bounds above that comes nearest to its inverse.

    Saad, Iterative methods for sparse linear systems, algorithm 12.1, on the unit matrix. Every such polynomial is
    positive within the bounds, so that no combination of nodes gets a negative variance.
    """
    middle, half = (_HIGH + _LOW) / 2, (_HIGH - _LOW) / 2
    residual: Any = sp.eye(matrix.shape[0], format="csr")
    step = residual / middle
    total, rho = step, half / middle
    for _ in range(degree):
        residual = residual - matrix @ step
        before, rho = rho, 1 / (2 * middle / half - rho)
        step = rho * before * step + (2 * rho / half) * residual
        total = total + step
    return sp.csr_matrix(total)
