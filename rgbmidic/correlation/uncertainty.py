"""Standard uncertainty of nodal quantities: the scores' covariance from the residual, carried through the equations.

The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and speckle and
between the lights; the variance of its sum over blocks wider than that reach holds all of it (the block estimator of
the long-run variance).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.assembly import RigidMotions, block_side
from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.images import at_blocks, window_sums
from rgbmidic.correlation.recovery import Functional, Recovery, functional_std
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Precision, Residual
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage


def displacing_fraction(reference: Reference, difference: FloatImage, weight: FloatImage) -> FloatImage:
    """Return the variance of a residual's scores over what white noise of the same variance would give, (P,).

    Parameters
    ----------
    reference
        The gradient is that of the lights' common texture.
    difference : ndarray, shape (P,), float32
        The residual.
    weight : ndarray, shape (P,), float32
        Its inverse variance.
    """
    block = reference.constants.block
    xx, _, yy = BlockScores.of(reference, block, difference, weight, *reference.texture.texture).products()
    # at least 0.01: of images without noise it is not 0 (up to twice of it nothing changes)
    fraction = np.maximum(xx + yy, 0.01)
    return np.asarray(reference.pixels.from_blocks(fraction[None], block)[0])


def score_covariance(residual: Residual, weights: FloatImage, texture: FloatArray) -> FloatArray:
    """Covariance of the right-hand side, as element blocks (E, 3, 3, 3).

    Parameters
    ----------
    residual
        At the solution.
    weights : ndarray, shape (k, P), float32
        Of the solve.
    texture : ndarray, shape (E, 3, 3, 3)
        Element blocks of its Hessian.
    """
    reference = residual.reference
    side = block_side(reference.pixels, reference.mesh.size, reference.constants)
    own = BlockScores.of(reference, side, residual.difference, weights, *reference.gradient)
    along_x, along_y = _axis_ratios(reference, own, texture) / reference.unfitted
    scale = np.stack([along_x, np.sqrt(along_x * along_y), along_y], axis=-1)
    return np.asarray(texture * scale[:, None, None])


def light_covariances(residual: Residual, weights: FloatImage) -> Iterator[tuple[int, int, FloatArray]]:
    """Covariance of the right-hand sides of each two lights a and b >= a.

    A light's own is as in `score_covariance`; that of two is the root of both, times the correlation of their scores
    where both see. Of what the lights have in common the fit leaves the fraction `unfitted`, which is put back before
    the scores are summed; it takes nothing of what they differ by.

    Parameters
    ----------
    residual
        At the solution.
    weights : ndarray, shape (k, P), float32
        Of the solve.

    Yields
    ------
    tuple
        Numbers of the two lights, and the element blocks (E, 3, 3, 3).
    """
    reference = residual.reference
    mesh, pixels, slopes = reference.mesh, reference.pixels, reference.gradient
    side = block_side(pixels, mesh.size, reference.constants)
    score = np.einsum("kp,kp,akp->ap", weights, residual.difference, slopes)
    information = np.einsum("kp,akp,akp->p", weights, slopes, slopes)
    common = np.divide(score, information, out=np.zeros_like(score), where=information > 0)
    lost = np.asarray(1 / np.sqrt(reference.unfitted) - 1, dtype=np.float32)
    if lost.ndim:
        lost = np.repeat(lost, np.diff(pixels.offsets))
    own, roots = [], []
    for difference, weight, gx, gy in zip(residual.difference, weights, *slopes, strict=True):
        whole = difference + lost * (gx * common[0] + gy * common[1])
        own.append(BlockScores.of(reference, side, whole, weight, gx, gy))
        roots.append(np.sqrt(_axis_ratios(reference, own[-1], reference.blocks(weight, (gx, gy)))))
    for a, b in combinations_with_replacement(range(len(weights)), 2):
        # the gradients of two lights are parallel
        slope = (np.copysign(np.sqrt(np.maximum(axis[a] * axis[b], 0)), axis[a]) for axis in slopes)
        texture = reference.blocks(np.sqrt(weights[a] * weights[b]), slope)
        (x, y), (other_x, other_y) = roots[a], roots[b]
        scale = np.stack([x * other_x, (x * other_y + y * other_x) / 2, y * other_y], axis=-1)
        if a != b:
            scale *= at_blocks(pixels, own[a].correlation(own[b])[None], side, mesh.centres).T
        yield a, b, texture * scale[:, None, None]


def _axis_ratios(reference: Reference, own: BlockScores, texture: FloatArray) -> FloatArray:
    """Variance of the scores in x and y over their information in that axis, (2, E).

    The information is divided by the gradients along x and y in the `texture` (E, 3, 3, 3) around each element.
    """
    mesh = reference.mesh
    along_x, _, along_y = at_blocks(reference.pixels, own.products(), own.side, mesh.centres)
    xx, _, yy = texture.sum(axis=(1, 2)).T
    x, y = (mesh.to_nodes(part)[mesh.elements].sum(axis=1) for part in (xx, yy))
    fraction = np.divide(x, x + y, out=np.full_like(x, 0.5), where=x + y > 0)
    least = reference.constants.seen  # nodes with less of the texture are not measured
    fraction = np.clip(fraction, least, 1 - least)
    return np.stack([along_x / fraction, along_y / (1 - fraction)])


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockScores:
    """Scores of blocks in x and y over the root of their information, and the pixels of the blocks.

    A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is smooth,
    and averaged, is its ratio to the information.

    Attributes
    ----------
    x, y, count : ndarray, shape (rows, columns)
    side : int
        Of the blocks, px.
    constants : SolverConstants
    """

    x: FloatArray
    y: FloatArray
    count: FloatArray
    side: int
    constants: SolverConstants

    @classmethod
    def of(cls, reference: Reference, side: int, *fields: FloatImage) -> BlockScores:
        """Scores of all lights together; `fields` are difference, weights, gradient in x and y, (k, P) or (P,)."""
        even = reference.constants.even
        x, y, information, count = reference.score_sums(side, *(np.atleast_2d(field) for field in fields))
        level = window_sums(information, even) / np.maximum(window_sums(count, even), 1e-6)
        scale = np.divide(1, np.sqrt(level), out=np.zeros_like(level), where=(level > 0) & (count > 0))
        return cls(x=x * scale, y=y * scale, count=count, side=side, constants=reference.constants)

    @property
    def typical_square(self) -> float:
        """Square of a score in one direction, per pixel, typical of the region's blocks.

        A median, so that what does not match has no part in it: ``x^2 + y^2`` of two independent Gaussian scores is
        distributed exponentially, with a median of 2 ln 2 variances.
        """
        whole = self.count >= 0.5 * self.count.max(initial=0.0)
        square = (self.x**2 + self.y**2)[whole] / np.maximum(self.count[whole], 1.0)
        return float(np.median(square)) / (2 * np.log(2)) if square.size else 0.0

    def around(self, grid: AnyArray) -> AnyArray:
        """Sums of a grid over the window in which scores are averaged, up to a factor."""
        return window_sums(grid, self.constants.score_range / self.side)

    def products(self) -> FloatArray:
        """Products xx, xy, yy of the scores per pixel, averaged; shape (3, rows, columns).

        xx + yy is 1 for white noise and ideal weights. They are raised where blocks are few, so that an error over its
        stated uncertainty has the variance 1.
        """
        typical, around, prior = self.typical_square, self.around(self.count), self.constants.prior * self.side**2
        # an estimate from n blocks has 2 n degrees of freedom; the mean of its inverse is n / (n - 1) times too large
        window = 4 * np.pi * (self.constants.score_range / self.side) ** 2
        number = np.minimum(window * around, self.count.sum()) / self.side**2
        ratios = [
            (self.around(product) + prior * expected) / (around + prior)
            for product, expected in ((self.x * self.x, typical), (self.x * self.y, 0.0), (self.y * self.y, typical))
        ]
        # of one block, less one, a quarter: the variance is hardly known, and stated 4 times larger
        return np.asarray(np.stack(ratios) * (number / np.maximum(number - 1, 0.25)))

    def correlation(self, other: BlockScores) -> FloatArray:
        """Correlation (rows, columns) with the scores of another light over the blocks around that both see."""
        both = (self.count > 0) & (other.count > 0)
        product = self.around(both * (self.x * other.x + self.y * other.y))
        first, second = (
            self.around(both * (one.x**2 + one.y**2)) + 2 * self.constants.prior * self.side**2 * one.typical_square
            for one in (self, other)
        )
        scale = np.sqrt(first * second)
        return np.divide(product, scale, out=np.zeros_like(product), where=scale > 0)


def _in_reference_axes(functional: Functional, deformation: FloatArray) -> Functional:
    """Return a quantity linear in the displacement as one of the motion in axes that follow the surface."""
    columns = [
        [matrix @ sp.diags(turn) for matrix, turn in zip(functional, row, strict=True) if matrix is not None]
        for row in deformation.T
    ]
    along_x, along_y = (sp.csr_matrix(sum(parts)) for parts in columns)
    return along_x, along_y


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


def _probed_std(
    equations: Equations, scores: FloatArray, reference: Reference, asked: list[tuple[Functional, BoolArray]]
) -> FloatArray:
    """Evaluate `functional_std` for element blocks of `scores` (E, 3, 3, 3) without what lost nodes do to others.

    Beside nodes that are hardly seen columns of M^-1 are a hundred times as large as others, which they still exceed
    where they have decayed: the sums of these may vanish, or be negative. What is large is known itself, and left out
    when the others are evaluated again. Beside them the least is what the information allows (Cramer and Rao): the
    uncertainty with the scores' variance over their information as small as it is in any element around.
    """
    mesh, assembly, lost = reference.material, reference.assembly, reference.constants.lost
    limits, covariance = [lost] * 2 + [lost / mesh.size] * (len(asked) - 2), assembly.matrix(scores)
    found = functional_std(equations.solve, covariance, mesh, asked)
    far = np.zeros(found.shape, dtype=bool)
    while ((found > limits) & ~far).any():
        far |= found > limits
        others = [(functional, nodes & ~beyond) for (functional, nodes), beyond in zip(asked, far.T, strict=True)]
        found = np.where(far, found, functional_std(equations.solve, covariance, mesh, others))
    if not far.any():
        return found
    score, information = (np.einsum("eaad->ed", blocks)[:, ::2].sum(axis=1) for blocks in (scores, equations.blocks))
    ratio, least = score / np.maximum(information, 1e-300), np.full(len(found), np.inf)
    np.minimum.at(least, mesh.elements[information > 0], ratio[information > 0, None])
    allowed = functional_std(equations.solve, assembly.matrix(equations.blocks), mesh, others)
    return np.maximum(found, allowed * np.sqrt(np.where(least < np.inf, least, 0))[:, None])


def standard_uncertainty(
    residual: Residual, equations: Equations, precision: Precision | None, recovery: Recovery | None = None
) -> FloatArray:
    """Evaluate the standard uncertainty of the linear fit's u and v, or of what a recovery gives.

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs: uncertainty), and what the
    rigid motions of the lights add. Displacement is stated at the textured nodes, strain where all nodes around are
    textured, too. That of a recovery holds the step, too, that the lights' channel-specific gradients would make from
    the solution: two gradients that measure the same motion differ by noise alone (Hausman, Econometrica 46, 1978).
    Where a reflection does not follow the surface it pulls with them, and what it still pulls without is less than that
    (docs/explanation/uncertainty.md).

    Parameters
    ----------
    residual, equations, precision
        Of the last pass.
    recovery
        Of the field from the linear fit; None for the fit itself.

    Returns
    -------
    ndarray, shape (N, 2) or (N, 5)
        Of u and v (px); with a `recovery` of u, v, exx, eyy, exy.
    """
    reference, textured = residual.reference, equations.textured
    value = sp.eye(len(textured), format="csr") if recovery is None else recovery.value
    asked: list[tuple[Functional, BoolArray]] = [((value, None), textured), ((None, value), textured)]
    if recovery is not None:
        inner = textured & ~reference.mesh.beside(~textured)
        asked += [(one, inner) for one in recovery.strain_functionals]
    asked = [(_in_reference_axes(functional, equations.deformation), nodes) for functional, nodes in asked]
    scores = score_covariance(residual, equations.weights, equations.blocks)
    std = _probed_std(equations, scores, reference, asked)
    if equations.rigid is not None:
        rigid = _rigid_variance(residual, equations, equations.rigid, [functional for functional, _ in asked])
        std = np.sqrt(np.maximum(std**2 + rigid, 0))
    if precision is not None:
        std = std * precision.robust_loss(reference, equations.weights)[:, None]
    if recovery is None or len(equations.weights) == 1:
        return std
    specific = map(reference.channel_specific, range(len(equations.weights)))
    lights = zip(equations.weights, residual.difference, specific, strict=True)
    pulls = np.array([reference.assembly.vector(reference.projected(*light)) for light in lights])
    pull, rigid_pull = pulls.sum(axis=0), (pulls[1:] @ equations.functions).ravel()
    step, _ = equations.increment(pull, np.zeros_like(pull), rigid_pull)
    return np.hypot(std, recovery.field(*step.T))
