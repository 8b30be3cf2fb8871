"""Standard uncertainty of displacement and strain at the nodes, from the residual of a solve."""

from __future__ import annotations

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.recovery import Recovery
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.propagation import displacement_functionals, functional_std
from rgbmidic.correlation.uncertainty.scores import score_covariance
from rgbmidic.typing import FloatArray

__all__ = ["nodal_std"]


def nodal_std(residual: Residual, equations: Equations, recovery: Recovery | None = None) -> FloatArray:
    """Standard uncertainty of u and v (px) of the linear fit, (N, 2); with a `recovery`, of what it gives: u, v, exx,
    eyy, exy, (N, 5).

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs/uncertainty.md).
    Displacement is told at the textured nodes, strain where all nodes around are textured, too.
    """
    reference, textured = residual.reference, equations.textured
    covariance = reference.assembly.matrix(score_covariance(residual, equations.weights, equations.blocks))
    if recovery is None:
        asked = [(one, textured) for one in displacement_functionals(len(textured))]
    else:
        inner = textured & ~reference.mesh.beside(~textured)
        asked = [(one, textured) for one in recovery.displacement_functionals]
        asked += [(one, inner) for one in recovery.strain_functionals]
    return functional_std(equations.solve, covariance, reference.colouring, asked)
