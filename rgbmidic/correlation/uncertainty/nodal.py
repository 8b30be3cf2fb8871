"""Standard uncertainty of displacement and strain at the nodes, from the residual of a solve."""

from __future__ import annotations

import numpy as np

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.propagation import exact_std, functional_std
from rgbmidic.correlation.uncertainty.scores import score_covariance
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["nodal_std"]

_REACH = 3
"""Elements around a hole over which the columns of the nodes reach across it."""


def nodal_std(residual: Residual, equations: Equations, quantities: int) -> FloatArray:
    """Standard uncertainty (N, quantities) of the first of u, v (px), exx, eyy, exy from the scores.

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs/uncertainty.md).
    """
    reference, textured = residual.reference, equations.textured
    covariance = reference.assembly.matrix(score_covariance(residual, equations.weights, int(textured.sum())))
    std = functional_std(equations.solve, covariance, reference.colouring, reference.functionals[:quantities], textured)
    if quantities > 2:
        near_hole = np.flatnonzero(textured & _near(residual, ~textured))
        std[near_hole, 2:] = exact_std(equations.solve, covariance, reference.functionals[2:quantities], near_hole)
    return std


def _near(residual: Residual, nodes: BoolArray) -> BoolArray:
    for _ in range(_REACH):
        nodes = residual.reference.mesh.beside(nodes)
    return nodes
