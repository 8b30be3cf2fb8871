"""Standard uncertainty of nodal quantities: the scores' covariance from the residual, carried through the equations.

The scores' covariance is the information times the design effect of the table of blocks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.assembly import RigidMotions
from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh.recovery import Functional, Recovery, functional_std
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic.weights.precision import Precision


def robust_loss(precision: Precision, reference: Reference, weights: FloatImage) -> FloatArray:
    """Factor (N,) on the uncertainty with the solve's `weights` (k, P): a robust loss bends less."""
    total, bent = (
        reference.mesh.to_nodes(sums) for sums in reference.sums(weights, precision.loss_curvature).sum(axis=0).T
    )
    # 0.1, so that the quotient exists: up to twice of it nothing changes
    return np.divide(total, np.maximum(bent, 0.1 * total), out=np.ones_like(total), where=total > 0)


def score_covariance(table: BlockTable, texture: FloatArray) -> FloatArray:
    """Covariance of the right-hand side, as element blocks (E, 3, 3, 3).

    Parameters
    ----------
    table
        Of the solution, of all lights together.
    texture : ndarray, shape (E, 3, 3, 3)
        Element blocks of its Hessian.
    """
    along_x, along_y = _axis_ratios(table, table.design_effect()[0], texture) / table.reference.residual_leverage
    scale = np.stack([along_x, np.sqrt(along_x * along_y), along_y], axis=-1)
    return np.asarray(texture * scale[:, None, None])


def light_covariances(table: BlockTable, equations: Equations) -> Iterator[tuple[int, int, FloatArray]]:
    """Covariance of the right-hand sides of each two lights a and b >= a.

    A light's own is as in `score_covariance`; that of two is the root of both, times the correlation of their scores
    where both see. Of what the lights have in common the fit leaves the fraction `residual_leverage`, which is put back
    before: each light has its fraction of the information of it. The fit takes nothing of what they differ by.

    Parameters
    ----------
    table
        Of the solution, of each light.
    equations
        Of the solution.

    Yields
    ------
    tuple
        Numbers of the two lights, and the element blocks (E, 3, 3, 3).
    """
    reference, weights = table.reference, equations.weights
    mesh, slopes = reference.mesh, reference.gradient
    table = table.over_elements().with_common_scores()
    effects, correlation = table.design_effect(), table.correlation()
    blocks = map(reference.blocks, weights, slopes.swapaxes(0, 1))
    roots = [np.sqrt(_axis_ratios(table, *light)) for light in zip(effects, blocks, strict=True)]
    for a, b in combinations_with_replacement(range(len(weights)), 2):
        # the gradients of two lights are parallel
        slope = (np.copysign(np.sqrt(np.maximum(axis[a] * axis[b], 0)), axis[a]) for axis in slopes)
        texture = reference.blocks(np.sqrt(weights[a] * weights[b]), slope)
        (x, y), (other_x, other_y) = roots[a], roots[b]
        scale = np.stack([x * other_x, (x * other_y + y * other_x) / 2, y * other_y], axis=-1)
        if a != b:
            scale *= table.at(correlation[a, b][None], mesh.centres).T
        yield a, b, texture * scale[:, None, None]


def _axis_ratios(table: BlockTable, effect: FloatArray, texture: FloatArray) -> FloatArray:
    """Variance of the scores in x and y over their information in that axis, (2, E).

    `effect` (3, h, w) is their variance over the information in both, which is divided by the gradients along x and y
    in the `texture` (E, 3, 3, 3) around each element.
    """
    mesh = table.reference.mesh
    along_x, along_y = table.at(effect[::2], mesh.centres)
    xx, _, yy = texture.sum(axis=(1, 2)).T
    x, y = (mesh.to_nodes(component)[mesh.elements].sum(axis=1) for component in (xx, yy))
    fraction = np.divide(x, x + y, out=np.full_like(x, 0.5), where=x + y > 0)
    min_fraction = table.reference.constants.min_texture  # nodes with less of the texture are not measured
    fraction = np.clip(fraction, min_fraction, 1 - min_fraction)
    return np.stack([along_x / fraction, along_y / (1 - fraction)])


def _rigid_variance(
    table: BlockTable, equations: Equations, rigid: RigidMotions, functionals: Sequence[Functional]
) -> FloatArray:
    """Variance (N, F) that the error of the rigid coefficients adds to quantities linear in the displacement.

    The displacement's error is ``M^-1 q - X e``, where q is the sum over the lights of their scores q_j and
    ``e = sum G_j^T q_j``, ``G_j = D_j T``, is that of the coefficients, with T the inverse Schur complement. With S_jl
    the covariance of q_j and q_l a quantity ``a^T u`` gets ``(a^T X) Cov(e) (X^T a) - 2 (a^T M^-1 Cov(q, e)) (X^T a)``,
    where ``Cov(e) = sum G_j^T S_jl G_l`` and ``Cov(q, e) = sum S_jl G_l``.
    """
    gains, assembly = rigid.relative_modes @ rigid.inverse, table.reference.assembly
    products = np.zeros_like(gains)
    for a, b, blocks in light_covariances(table, equations):
        covariance = assembly.matrix(blocks)
        products[a] += covariance @ gains[b]
        if a != b:
            products[b] += covariance @ gains[a]
    coefficients = np.einsum("jnc,jnd->cd", gains, products)
    motions = (rigid.response, equations.solve(products.sum(axis=0)))
    by_axis = [equations.turned(motion.reshape(len(motion) // 2, 2, -1)).swapaxes(0, 1) for motion in motions]
    variance = []
    for functional in functionals:
        response, common = (
            sum(matrix @ along for matrix, along in zip(functional, axes, strict=True) if matrix is not None)
            for axes in by_axis
        )
        variance.append(((response @ coefficients - 2 * common) * response).sum(axis=1))
    return np.stack(variance, axis=1)


def _probed_std(
    equations: Equations, scores: FloatArray, reference: Reference, quantities: list[tuple[Functional, BoolArray]]
) -> FloatArray:
    """Evaluate `functional_std` for element blocks of `scores` (E, 3, 3, 3) without what lost nodes do to others.

    Beside nodes that are hardly seen columns of M^-1 are a hundred times as large as others, which they still exceed
    where they have decayed: the sums of these may vanish, or be negative. What is large is known itself, and left out
    when the others are evaluated again. Beside them the least is what the information allows (Cramer and Rao): the
    uncertainty with the scores' variance over their information as small as it is in any element around.
    """
    mesh, assembly, lost = reference.material, reference.assembly, reference.constants.max_std
    limits, covariance = [lost] * 2 + [lost / mesh.size] * (len(quantities) - 2), assembly.matrix(scores)

    def solve(columns: FloatArray) -> FloatArray:
        """Solve for functionals (2 N, R) of the displacement, which the surface has turned."""
        turned = np.swapaxes(equations.deformation, 1, 2) @ columns.reshape(len(mesh.nodes), 2, -1)
        return equations.solve(turned.reshape(columns.shape))

    std = functional_std(solve, covariance, mesh, quantities)
    far = np.zeros(std.shape, dtype=bool)
    while ((std > limits) & ~far).any():
        far |= std > limits
        remaining = [
            (functional, nodes & ~excluded) for (functional, nodes), excluded in zip(quantities, far.T, strict=True)
        ]
        std = np.where(far, std, functional_std(solve, covariance, mesh, remaining))
    if not far.any():
        return std
    score, information = (np.einsum("eaad->ed", blocks)[:, ::2].sum(axis=1) for blocks in (scores, equations.blocks))
    ratio, min_ratio = score / np.maximum(information, 1e-300), np.full(len(std), np.inf)
    np.minimum.at(min_ratio, mesh.elements[information > 0], ratio[information > 0, None])
    allowed = functional_std(solve, assembly.matrix(equations.blocks), mesh, remaining)
    return np.maximum(std, allowed * np.sqrt(np.where(min_ratio < np.inf, min_ratio, 0))[:, None])


def standard_uncertainty(
    table: BlockTable, equations: Equations, precision: Precision | None, recovery: Recovery | None = None
) -> FloatArray:
    """Evaluate the standard uncertainty of the linear fit's u and v, or of what a recovery gives.

    The covariance is ``F M^-1 S M^-1 F^T`` with S the covariance of the right-hand side and F the deformation gradient
    (docs: uncertainty), and what the rigid motions of the lights add. Displacement is stated at the textured nodes,
    strain where all nodes around are textured, too.

    Parameters
    ----------
    table, equations, precision
        Of the solution, the table of each light.
    recovery
        Of the field from the linear fit; None for the fit itself.

    Returns
    -------
    ndarray, shape (N, 2) or (N, 5)
        Of u and v (px); with a `recovery` of u, v, exx, eyy, exy.
    """
    reference, textured = table.reference, equations.textured
    value = sp.eye(len(textured), format="csr") if recovery is None else recovery.value
    quantities: list[tuple[Functional, BoolArray]] = [((value, None), textured), ((None, value), textured)]
    if recovery is not None:
        inner = textured & ~reference.mesh.adjacent_nodes(~textured)
        quantities += [(functional, inner) for functional in recovery.strain_functionals]
    scores = score_covariance(table.over_elements().together(), equations.blocks)
    std = _probed_std(equations, scores, reference, quantities)
    if equations.rigid is not None:
        rigid = _rigid_variance(table, equations, equations.rigid, [functional for functional, _ in quantities])
        std = np.sqrt(np.maximum(std**2 + rigid, 0))
    if precision is not None:
        std = std * robust_loss(precision, reference, equations.weights)[:, None]
    return std


def gradient_disagreement(
    residual: Residual, table: BlockTable, equations: Equations, recovery: Recovery, std: FloatArray
) -> FloatArray:
    """Factor (N,) on the uncertainty by what the gradients of the lights' own images disagree with those of the solve.

    Two gradients that measure the same motion differ by noise alone (Hausman, Econometrica 46, 1978): by as much of the
    uncertainty as the scores of what a light alone shows have of all scores, typically. Where a reflection does not
    follow the surface it pulls with them, and what it still pulls without is less than that
    (docs/explanation/uncertainty.md): the step that they would make from the solution is stated beyond chance. A single
    step is a poor estimate of its variance: both directions have their mean.

    Parameters
    ----------
    residual, table
        At the solution, of each light.
    equations, recovery
        Of the solution.
    std : ndarray, shape (N, 5)
        Standard uncertainty by noise.
    """
    reference = residual.reference
    if len(equations.weights) == 1:
        return np.ones(len(std))
    projected = reference.projected(equations.weights, residual.difference, reference.texture.images)
    pulls = np.array([reference.assembly.vector(light) for light in projected])
    pull, rigid_pull = pulls.sum(axis=0), (pulls[1:] @ equations.functions).ravel()
    step = recovery.value @ equations.increment(pull, np.zeros_like(pull), rigid_pull)[0]
    square = ((step / np.maximum(std[:, :2], 1e-30)) ** 2).mean(axis=1)
    chance = np.nan_to_num(reference.residual_leverage).mean() * table.over_elements().disagreement_by_chance()
    return np.asarray(np.sqrt(1 + np.maximum(square - chance, 0)))
