"""Standard uncertainty of displacement and strain at the nodes, from the residual of a solve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.recovery import Recovery
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.rigid import RigidMotions
from rgbmidic.correlation.uncertainty.propagation import Functional, displacement_functionals, functional_std
from rgbmidic.correlation.uncertainty.scores import light_covariances, score_covariance
from rgbmidic.typing import FloatArray

__all__ = ["nodal_std"]


def nodal_std(residual: Residual, equations: Equations, recovery: Recovery | None = None) -> FloatArray:
    """Standard uncertainty of u and v (px) of the linear fit, (N, 2); with a `recovery`, of what it gives: u, v, exx,
    eyy, exy, (N, 5).

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs/uncertainty.md), and what the
    rigid motions of the lights add. Displacement is told at the textured nodes, strain where all nodes around are
    textured, too.
    """
    reference, textured = residual.reference, equations.textured
    covariance = reference.assembly.matrix(score_covariance(residual, equations.weights, equations.blocks))
    if recovery is None:
        asked = [(one, textured) for one in displacement_functionals(len(textured))]
    else:
        inner = textured & ~reference.mesh.beside(~textured)
        asked = [(one, textured) for one in recovery.displacement_functionals]
        asked += [(one, inner) for one in recovery.strain_functionals]
    std = functional_std(equations.solve, covariance, reference.colouring, asked)
    if equations.rigid is None:
        return std
    rigid = _rigid_variance(residual, equations, equations.rigid, [functional for functional, _ in asked])
    return np.asarray(np.sqrt(np.maximum(std**2 + rigid, 0)))


def _rigid_variance(
    residual: Residual, equations: Equations, rigid: RigidMotions, asked: Sequence[Functional]
) -> FloatArray:
    """What the error of the rigid coefficients adds to the variance (N, F) of quantities linear in the displacement.

    The displacement's error is ``M^-1 q - X e``, where q is the sum over the lights of their scores q_j and
    ``e = sum G_j^T q_j``, ``G_j = D_j T``, is that of the coefficients, with T the inverse Schur complement. With S_jl
    the covariance of q_j and q_l a quantity ``a^T u`` gets ``(a^T X) Cov(e) (X^T a) - 2 (a^T M^-1 Cov(q, e)) (X^T a)``,
    where ``Cov(e) = sum G_j^T S_jl G_l`` and ``Cov(q, e) = sum S_jl G_l``.
    """
    gains, assembly = rigid.moves @ rigid.inverse, residual.reference.assembly
    products = np.zeros_like(gains)
    for a, b, blocks in light_covariances(residual, equations.weights):
        covariance = assembly.matrix(blocks)
        products[a] += covariance @ gains[b]
        if a != b:
            products[b] += covariance @ gains[a]
    coefficients = np.einsum("jnc,jnd->cd", gains, products)
    shared, variance = equations.solve(products.sum(axis=0)), []
    for along_x, along_y in asked:
        follows, common = (
            sum(matrix @ column[axis::2] for axis, matrix in enumerate((along_x, along_y)) if matrix is not None)
            for column in (rigid.follows, shared)
        )
        variance.append(((follows @ coefficients - 2 * common) * follows).sum(axis=1))
    return np.stack(variance, axis=1)
