"""What is known of each node after a solve: whether it counts as measured, and its standard uncertainty.

A node counts as measured unless one of an ordered table of rules applies to it. The uncertainty of displacement and
strain follows from the residual of the solve.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.correlation import element_hessian
from rgbmidic.correlation.assembly import RigidMotions
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.precision import light_covariances, score_covariance
from rgbmidic.correlation.recovery import Functional, Recovery, displacement_functionals, functional_std
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.solution import NodeStatus
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["LOST", "RULES", "Evidence", "Rule", "judge", "nodal_std", "one_sided_texture"]

LOST = 0.5
"""Uncertainty (px) from which a node is decorrelated: a position uncertain by half a pixel is no match."""
_MISFIT = 4.0
"""Residual around a node, over the median, from which it is decorrelated where elements near it do not match. Chosen;
with half or twice of it no node of the scenes in benchmarks/constants.py changes."""
_ONE_SIDED = 0.3
"""Texture in the worse direction over that in the better one under which the former may be noise...
Chosen; with half or twice of it no node of the scenes in benchmarks/constants.py changes."""
_NOISY = 0.3
"""...and is, if noise alone would give this fraction of it: displacements along it are 30 % too small (derived)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """State of knowledge on the N nodes at the end of a solve.

    Attributes
    ----------
    textured : ndarray, shape (N,), bool
        Enough texture is seen around the node, by what precision there is (`Equations`).
    one_sided : ndarray, shape (N,), bool
        The texture runs in one direction only (`one_sided_texture`).
    mismatched, near_mismatch : ndarray, shape (N,), bool
        An element around the node does not match; one around the node or its neighbours.
    std : ndarray, shape (N, 2)
        Standard uncertainty of u and v, px.
    misfit : ndarray, shape (N,)
        Residual around the node over its median.
    """

    textured: BoolArray
    one_sided: BoolArray
    mismatched: BoolArray
    near_mismatch: BoolArray
    std: FloatArray
    misfit: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Rule:
    """A rule: a node to which it applies gets the status, unless an earlier rule applied."""

    status: NodeStatus
    because: str
    applies: Callable[[Evidence], BoolArray]


RULES = (
    Rule(
        status=NodeStatus.DECORRELATED,
        because="the elements around it do not match, and the others have too little texture",
        applies=lambda nodes: nodes.mismatched & (nodes.one_sided | ~nodes.textured),
    ),
    Rule(
        status=NodeStatus.NOT_SEEN,
        because="no light sees enough texture around it",
        applies=lambda nodes: ~nodes.textured,
    ),
    Rule(
        status=NodeStatus.NOT_SEEN,
        because="the texture runs in one direction only: what lies along it cannot be measured",
        applies=lambda nodes: nodes.one_sided,
    ),
    Rule(
        status=NodeStatus.DECORRELATED,
        because="its displacement is uncertain by half a pixel or more",
        applies=lambda nodes: nodes.std.max(axis=1) > LOST,
    ),
    Rule(
        status=NodeStatus.DECORRELATED,
        because="elements near it do not match, and the residual around it is several times the usual one",
        applies=lambda nodes: nodes.near_mismatch & (nodes.misfit > _MISFIT),
    ),
)
"""In this order; a node to which none applies is measured."""


def judge(evidence: Evidence) -> npt.NDArray[np.uint8]:
    """`NodeStatus` of every node (N,) by the `RULES`."""
    applied = [rule.applies(evidence) for rule in RULES]
    return np.select(applied, [np.uint8(rule.status) for rule in RULES], np.uint8(NodeStatus.MEASURED))


def one_sided_texture(equations: Equations, residual: Residual) -> BoolArray:
    """Nodes (N,) whose texture runs in one direction only: along the other, the gradient is that of the noise."""
    xx, xy, yy = equations.node_blocks
    half, difference = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    weak = half - difference
    one_sided = np.asarray(equations.textured & (weak < _ONE_SIDED * (half + difference)))
    if not one_sided.any():
        return one_sided
    angle = np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2  # of the weaker direction
    x, y = np.cos(angle), np.sin(angle)
    noise_xx, noise_xy, noise_yy = _noise_blocks(residual, equations.weights, one_sided)
    along = noise_xx * x * x + 2 * noise_xy * x * y + noise_yy * y * y
    return np.asarray(one_sided & (along > _NOISY * weak))


def _noise_blocks(residual: Residual, weights: FloatImage, nodes: BoolArray) -> FloatArray:
    """Return entries xx, xy, yy (3, N) of the chosen nodes' own blocks in the Hessian that noise alone has.

    The noise is what the residual, which holds that of both images, differs by from pixel to pixel; `nodes` is (N,).
    """
    reference, pixels = residual.reference, residual.reference.pixels
    mesh = reference.mesh
    elements = np.asarray(nodes[mesh.elements].any(axis=1))
    around, column, row = pixels.of_elements(elements)
    beside, columns_beside, rows_beside = pixels.of_elements(np.asarray(mesh.beside(nodes)[mesh.elements].any(axis=1)))
    offsets = np.concatenate([[0], np.cumsum(np.diff(pixels.offsets)[elements])])
    place = pixels.local_x[around], pixels.local_y[around], offsets, pixels.barycentric[elements]
    own, total = np.zeros((int(elements.sum()), 3, 3, 3)), np.zeros((elements.size, 3, 3, 3))
    image = np.zeros([side + 1 for side in pixels.shape], dtype=np.float32)
    for weight, difference in zip(weights, residual.difference, strict=True):
        image[rows_beside, columns_beside] = difference[beside] / np.float32(np.sqrt(2))
        here = image[row, column]
        slopes = image[row, column + 1] - here, image[row + 1, column] - here
        element_hessian(*slopes, weight[around], *place, own)
        total[elements] += own
    return reference.assembly.node_blocks(total)


def nodal_std(residual: Residual, equations: Equations, recovery: Recovery | None = None) -> FloatArray:
    """Evaluate the standard uncertainty of the linear fit's u and v, or of what a recovery gives.

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs/uncertainty.md), and what the
    rigid motions of the lights add. Displacement is stated at the textured nodes, strain where all nodes around are
    textured, too.

    Parameters
    ----------
    residual, equations
        Of the last pass.
    recovery
        Of the field from the linear fit; None for the fit itself.

    Returns
    -------
    ndarray, shape (N, 2) or (N, 5)
        Of u and v (px); with a `recovery` of u, v, exx, eyy, exy.
    """
    reference, textured = residual.reference, equations.textured
    covariance = reference.assembly.matrix(score_covariance(residual, equations.weights, equations.blocks))
    if recovery is None:
        asked = [(one, textured) for one in displacement_functionals(len(textured))]
    else:
        inner = textured & ~reference.mesh.beside(~textured)
        asked = [(one, textured) for one in recovery.displacement_functionals]
        asked += [(one, inner) for one in recovery.strain_functionals]
    std = functional_std(equations.solve, covariance, reference.geometry.colouring, asked)
    if equations.rigid is None:
        return std
    rigid = _rigid_variance(residual, equations, equations.rigid, [functional for functional, _ in asked])
    return np.asarray(np.sqrt(np.maximum(std**2 + rigid, 0)))


def _rigid_variance(
    residual: Residual, equations: Equations, rigid: RigidMotions, asked: Sequence[Functional]
) -> FloatArray:
    """Variance (N, F) that the error of the rigid coefficients adds to quantities linear in the displacement.

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
