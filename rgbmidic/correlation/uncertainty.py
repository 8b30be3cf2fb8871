"""Standard uncertainty of nodal quantities: the scores' covariance from the residual, carried through the equations.

The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and speckle and
between the lights; the variance of its sum over blocks wider than that reach holds all of it (the block estimator of
the long-run variance).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement

import cv2
import numpy as np

from rgbmidic._kernels.weights import scores
from rgbmidic.correlation.assembly import BLOCK, RigidMotions, block_side
from rgbmidic.correlation.assembly import SCORE_RANGE as _SCORE_RANGE
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.recovery import Functional, Recovery, displacement_functionals, functional_std
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Precision, Residual
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

_LEAST_RATIO = 1e-2
"""Least fraction of a residual's variance that is taken to displace: that of images without noise is not 0. Any value
up to twice of it gives the same."""
_LEAST_FRACTION = 0.05
"""Least fraction of a direction in the texture: nodes with less of the median are not measured (`SEEN`)."""
_EVEN = 0.6
"""Standard deviation (blocks) of the window in which the information of a block is taken. Chosen; with half or twice of
it lights differ by 1e-4 px at most, beside a gap by 4e-3, their uncertainty by 4 % (benchmarks/constants.py)."""
_LEAST_FREEDOM = 0.25
"""Least number of blocks, less one, that is taken, where a region has one block: the variance is stated 4 times larger
then, for it is hardly known (derived)."""
_PRIOR = 0.1
"""Blocks for which the region's typical score counts in that window: beside a hole there are few."""


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
    pixels, (gx, gy) = reference.pixels, reference.texture
    xx, _, yy = _averaged_ratios(*_unit_scores(pixels, BLOCK, difference, weight, gx, gy), BLOCK)
    fraction = np.maximum(xx + yy, _LEAST_RATIO)
    return np.asarray(pixels.from_blocks(fraction[None], BLOCK)[0])


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
    side = block_side(reference.pixels, reference.mesh.size)
    own = _unit_scores(reference.pixels, side, residual.difference, weights, *reference.gradient)
    along_x, along_y = _axis_ratios(reference, own, texture, side) / reference.unfitted
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
    side, slopes = block_side(reference.pixels, reference.mesh.size), reference.gradient
    fields = np.empty((4, weights.shape[1]), dtype=np.float32)
    scores(residual.difference, weights, *slopes, fields)
    common = np.divide(fields[:2], fields[2], out=np.zeros_like(fields[:2]), where=fields[2] > 0)
    lost = np.asarray(1 / np.sqrt(reference.unfitted) - 1, dtype=np.float32)
    if lost.ndim:
        lost = np.repeat(lost, np.diff(reference.pixels.offsets))
    own, roots = [], []
    for difference, weight, gx, gy in zip(residual.difference, weights, *slopes, strict=True):
        whole = difference + lost * (gx * common[0] + gy * common[1])
        own.append(_unit_scores(reference.pixels, side, whole, weight, gx, gy))
        roots.append(np.sqrt(_axis_ratios(reference, own[-1], reference.blocks(weight, (gx, gy)), side)))
    for a, b in combinations_with_replacement(range(len(weights)), 2):
        # the gradients of two lights are parallel
        slope = (np.copysign(np.sqrt(np.maximum(axis[a] * axis[b], 0)), axis[a]) for axis in slopes)
        texture = reference.blocks(np.sqrt(weights[a] * weights[b]), slope)
        (x, y), (other_x, other_y) = roots[a], roots[b]
        scale = np.stack([x * other_x, (x * other_y + y * other_x) / 2, y * other_y], axis=-1)
        if a != b:
            scale *= _per_element(reference, _correlation(own[a], own[b], side)[None], side)[0, :, None]
        yield a, b, texture * scale[:, None, None]


def _axis_ratios(
    reference: Reference, own: tuple[FloatArray, FloatArray, FloatArray], texture: FloatArray, side: int
) -> FloatArray:
    """Variance of the scores in x and y over their information in that axis, (2, E).

    The information is divided by the gradients along x and y in the `texture` (E, 3, 3, 3) around each element.
    """
    mesh = reference.mesh
    along_x, _, along_y = _per_element(reference, _averaged_ratios(*own, side), side)
    xx, _, yy = texture.sum(axis=(1, 2)).T
    x, y = (mesh.to_nodes(part)[mesh.elements].sum(axis=1) for part in (xx, yy))
    fraction = np.divide(x, x + y, out=np.full_like(x, 0.5), where=x + y > 0)
    fraction = np.clip(fraction, _LEAST_FRACTION, 1 - _LEAST_FRACTION)
    return np.stack([along_x / fraction, along_y / (1 - fraction)])


def _unit_scores(pixels: PixelMap, side: int, *fields: FloatImage) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scores in x and y of blocks over the root of their information, and their pixels; shape (rows, columns).

    The scores are those of all lights together; the `fields` are difference, weights and gradient in x and y, (k, P) or
    (P,). A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
    smooth, and averaged, is its ratio to the information.
    """
    sums = np.empty((4, pixels.local_x.size), dtype=np.float32)
    scores(*(np.atleast_2d(field) for field in fields), sums)
    x, y, information, count = pixels.block_sums(sums, side).astype(np.float64)
    level = _blur(information, _EVEN) / np.maximum(_blur(count, _EVEN), 1e-6)
    scale = np.divide(1, np.sqrt(level), out=np.zeros_like(level), where=(level > 0) & (count > 0))
    return x * scale, y * scale, count


def _averaged_ratios(x: FloatArray, y: FloatArray, count: FloatArray, side: int) -> FloatArray:
    """Products xx, xy, yy of such scores per pixel, averaged; shape (3, rows, columns).

    xx + yy is 1 for white noise and ideal weights. They are raised where blocks are few, so that an error over its
    stated uncertainty has the variance 1.
    """
    typical = _typical_square(x, y, count)
    around = _blur(count, _SCORE_RANGE / side)
    prior = _PRIOR * side**2
    # an estimate from n blocks has 2 n degrees of freedom; the mean of its inverse is n / (n - 1) times too large
    number = np.minimum(4 * np.pi * (_SCORE_RANGE / side) ** 2 * around, count.sum()) / side**2
    ratios = [
        (_blur(product, _SCORE_RANGE / side) + prior * expected) / (around + prior)
        for product, expected in ((x * x, typical), (x * y, 0.0), (y * y, typical))
    ]
    return np.asarray(np.stack(ratios) * (number / np.maximum(number - 1, _LEAST_FREEDOM)))


def _correlation(first: tuple[FloatArray, ...], second: tuple[FloatArray, ...], side: int) -> FloatArray:
    """Correlation (rows, columns) of the scores of two lights over the blocks around that both see."""
    (x, y, count), (other_x, other_y, other_count) = first, second
    both = (count > 0) & (other_count > 0)
    squares = (x * x + y * y, other_x * other_x + other_y * other_y)
    prior = [2 * _PRIOR * side**2 * _typical_square(*scores) for scores in (first, second)]
    product = _blur(both * (x * other_x + y * other_y), _SCORE_RANGE / side)
    first_square, second_square = (
        _blur(both * square, _SCORE_RANGE / side) + held for square, held in zip(squares, prior, strict=True)
    )
    scale = np.sqrt(first_square * second_square)
    return np.divide(product, scale, out=np.zeros_like(product), where=scale > 0)


def _typical_square(x: FloatArray, y: FloatArray, count: FloatArray) -> float:
    """Square of a score in one direction, per pixel, typical of the region's blocks.

    A median, so that what does not match has no part in it: ``x^2 + y^2`` of two independent Gaussian scores is
    distributed exponentially, with a median of 2 ln 2 variances.
    """
    whole = count >= 0.5 * count.max(initial=0.0)
    square = (x**2 + y**2)[whole] / np.maximum(count[whole], 1.0)
    return float(np.median(square)) / (2 * np.log(2)) if square.size else 0.0


def _per_element(reference: Reference, grid: FloatArray, side: int) -> FloatArray:
    """Values (n, E) at the elements' centres of n grids of blocks."""
    mesh = reference.mesh
    top, left, _, _ = reference.pixels.bounds
    place = mesh.nodes[mesh.elements].mean(axis=1) - (left, top)
    centre = np.round(place / side - 0.5).astype(int)
    column = np.clip(centre[:, 0], 0, grid.shape[2] - 1)
    row = np.clip(centre[:, 1], 0, grid.shape[1] - 1)
    return np.asarray(grid[:, row, column])


def _blur(image: AnyArray, sigma: float) -> AnyArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))


def nodal_std(residual: Residual, equations: Equations, recovery: Recovery | None = None) -> FloatArray:
    """Evaluate the standard uncertainty of the linear fit's u and v, or of what a recovery gives.

    The covariance is ``M^-1 S M^-1`` with S the covariance of the right-hand side (docs: uncertainty), and what the
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


def standard_uncertainty(
    residual: Residual, equations: Equations, precision: Precision | None, recovery: Recovery | None = None
) -> FloatArray:
    """Evaluate the standard uncertainty of the linear fit, (N, 2), or of what a `recovery` gives, (N, 5).

    The latter holds the step, too, that the lights' channel-specific gradients would make from the solution: two
    gradients that measure the same motion differ by noise alone (Hausman, Econometrica 46, 1978). Where a reflection
    does not follow the surface it pulls with them, and what it still pulls without is less than that
    (docs/explanation/uncertainty.md).
    """
    std = nodal_std(residual, equations, recovery)
    if precision is not None:
        std = std * precision.robust_loss(residual.reference, equations.weights)[:, None]
    if recovery is None:
        return std
    reference = residual.reference
    lights = zip(equations.weights, residual.difference, reference.channel_specific.swapaxes(0, 1), strict=False)
    pulls = np.array([reference.assembly.vector(reference.projected(*light)) for light in lights])
    pulls = pulls.reshape(-1, reference.assembly.size)  # none where there is but one light
    pull, rigid_pull = pulls.sum(axis=0), (pulls[1:] @ equations.functions).ravel()
    step, _ = equations.increment(pull, np.zeros_like(pull), rigid_pull)
    disagreement = np.concatenate([recovery.displacement(step), recovery.strain(step)], axis=1)
    return np.asarray(np.hypot(std, disagreement))
