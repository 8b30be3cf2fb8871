"""Standard uncertainty of displacement and strain at the nodes, from the residual of a solve."""

from __future__ import annotations

import numpy as np

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.propagation import functional_std
from rgbmidic.correlation.uncertainty.scores import score_covariance
from rgbmidic.typing import FloatArray

__all__ = ["nodal_std"]


def nodal_std(residual: Residual, equations: Equations, quantities: int) -> FloatArray:
    """Standard uncertainty (N, quantities) of the first of u, v (px), exx, eyy, exy from the scores.

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs/uncertainty.md).
    Displacement is told at the textured nodes, strain where all nodes around are textured, too.
    """
    reference, textured = residual.reference, equations.textured
    inner = textured & ~reference.mesh.beside(~textured)
    covariance = reference.assembly.matrix(score_covariance(residual, equations.weights))
    return np.concatenate(
        [
            functional_std(equations.solve, covariance, reference.colouring, functionals, nodes)
            for functionals, nodes in (
                (reference.functionals[:2], textured),
                (reference.functionals[2:quantities], inner),
            )
        ],
        axis=1,
    )
