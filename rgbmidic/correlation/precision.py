"""Statistics of the residual: covariance of the scores, precision of the lights, and matching criterion of elements.

The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and speckle and
between the lights; the variance of its sum over blocks wider than that reach holds all of it (the block estimator of
the long-run variance). The weights by statistics are the lights' precision together around each pixel. The matching
criterion of an element is the zero-mean correlation coefficient of all lights at the displacement found.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement

import cv2
import numpy as np
from scipy.spatial import cKDTree

from rgbmidic._kernels.lights import best_mean, robust_weights, scores
from rgbmidic.correlation.assembly import BLOCK, block_side
from rgbmidic.correlation.images import spread, window_covariance, window_means
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage

__all__ = [
    "Precision",
    "correlation",
    "correlation_around",
    "displacing_fraction",
    "learn_precision",
    "light_covariances",
    "matching_elements",
    "misfit",
    "score_covariance",
]

_LEAST_RATIO = 1e-2
"""Least fraction of a residual's variance that is taken to displace. Chosen; with half or twice of it nothing changes
(benchmarks/constants.py)."""
_LEAST_FRACTION = 0.05
"""Least fraction of a direction in the texture: nodes with less of the median are not measured (`SEEN`)."""
_EVEN = 0.6
"""Standard deviation (blocks) of the window in which the information of a block is taken. Chosen; with half or twice of
it lights differ by 1e-4 px at most, beside a gap by 4e-3, their uncertainty by 4 % (benchmarks/constants.py)."""
_SCORE_RANGE = 30.0
"""Standard deviation (px) of the window over which block sums are averaged: 67 blocks of 13 px give a variance to 12 %
(derived). With half or twice of it lights differ by 2e-3 px at most, beside a gap by 1e-2, their uncertainty by 10 %
(benchmarks/constants.py)."""
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
    xx, _, yy = _score_ratios(reference, difference[None], weight[None], reference.texture[:, None], BLOCK)
    fraction = np.maximum(xx + yy, _LEAST_RATIO)
    return np.asarray(reference.pixels.from_blocks(fraction[None], BLOCK)[0])


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
    side, gradient = block_side(reference.pixels, reference.mesh.size), (reference.gradient_x, reference.gradient_y)
    ratios = _score_ratios(reference, residual.difference, weights, gradient, side)
    along_x, _, along_y = _per_element(reference, ratios, side) / reference.unfitted
    fraction = _fraction_along_x(reference, texture)
    along_x, along_y = along_x / fraction, along_y / (1 - fraction)
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
    side, slopes = block_side(reference.pixels, reference.mesh.size), (reference.gradient_x, reference.gradient_y)
    fields = np.empty((4, weights.shape[1]), dtype=np.float32)
    scores(residual.difference, weights, *slopes, fields)
    common = np.divide(fields[:2], fields[2], out=np.zeros_like(fields[:2]), where=fields[2] > 0)
    lost = np.float32(1 / np.sqrt(reference.unfitted) - 1)
    own, roots = [], []
    for light, (difference, weight, gx, gy) in enumerate(zip(residual.difference, weights, *slopes, strict=True)):
        whole = difference + lost * (gx * common[0] + gy * common[1])
        own.append(_unit_scores(reference, whole[None], weight[None], (gx[None], gy[None]), side))
        along_x, _, along_y = _per_element(reference, _averaged_ratios(*own[light], side), side)
        fraction = _fraction_along_x(reference, reference.hessian_blocks(light, weight))
        roots.append(np.sqrt([along_x / fraction, along_y / (1 - fraction)]))
    for a, b in combinations_with_replacement(range(len(weights)), 2):
        # the gradients of two lights are parallel
        slope = (np.copysign(np.sqrt(np.maximum(axis[a] * axis[b], 0)), axis[a]) for axis in slopes)
        texture = reference.blocks(np.sqrt(weights[a] * weights[b]), *slope)
        (x, y), (other_x, other_y) = roots[a], roots[b]
        scale = np.stack([x * other_x, (x * other_y + y * other_x) / 2, y * other_y], axis=-1)
        if a != b:
            scale *= _per_element(reference, _correlation(own[a], own[b], side)[None], side)[0, :, None]
        yield a, b, texture * scale[:, None, None]


def _fraction_along_x(reference: Reference, texture: FloatArray) -> FloatArray:
    """Return the fraction (E,) of the gradients along x in the `texture` (E, 3, 3, 3) around each element."""
    mesh = reference.mesh
    own = texture.sum(axis=(1, 2))
    x, y = (mesh.to_nodes(part)[mesh.elements].sum(axis=1) for part in (own[:, 0], own[:, 2]))
    fraction = np.divide(x, x + y, out=np.full_like(x, 0.5), where=x + y > 0)
    return np.asarray(np.clip(fraction, _LEAST_FRACTION, 1 - _LEAST_FRACTION))


def _score_ratios(
    reference: Reference,
    difference: FloatImage,
    weights: FloatImage,
    gradient: FloatImage | tuple[FloatImage, FloatImage],
    side: int,
) -> FloatArray:
    """Covariance (xx, xy, yy) of the scores of blocks over their information; shape (3, rows, columns).

    The scores are those of all lights together, for fields (k, P) and their `gradient` in x and y. A light's precision
    changes a hundredfold at the edge of a reflection, the scores' variance with it: what is smooth, and averaged, is
    its ratio to the information; xx + yy is 1 for white noise and ideal weights.
    """
    return _averaged_ratios(*_unit_scores(reference, difference, weights, gradient, side), side)


def _unit_scores(
    reference: Reference,
    difference: FloatImage,
    weights: FloatImage,
    gradient: FloatImage | tuple[FloatImage, FloatImage],
    side: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Scores in x and y of blocks over the root of their information, and their pixels; shape (rows, columns)."""
    fields = np.empty((4, difference.shape[1]), dtype=np.float32)
    scores(difference, weights, *gradient, fields)
    x, y, information, count = reference.pixels.block_sums(fields, side).astype(np.float64)
    level = _blur(information, _EVEN) / np.maximum(_blur(count, _EVEN), 1e-6)
    scale = np.divide(1, np.sqrt(level), out=np.zeros_like(level), where=(level > 0) & (count > 0))
    return x * scale, y * scale, count


def _averaged_ratios(x: FloatArray, y: FloatArray, count: FloatArray, side: int) -> FloatArray:
    """Products xx, xy, yy of such scores per pixel, averaged; shape (3, rows, columns).

    They are raised where blocks are few, so that an error over its stated uncertainty has the variance 1.
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


_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual (Lange et al., J. Am. Stat. Assoc. 84, 1989,
who found 4 to work well). With 2 or 8 lights under a reflection differ by 2e-3 px at most, beside a gap by 4e-2, their
uncertainty by 11 % (benchmarks/constants.py)."""
_OWN = 0.1
"""Fraction of its variance that each light's residual is taken to have for itself: .03 to .3 measure the same."""
_LEAST_BEND = 0.1
"""Least bend of the loss around a node, over that of its weights. Chosen; with half or twice of it nothing changes
(benchmarks/constants.py)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """Precision of the lights, from their residuals.

    Attributes
    ----------
    factor : ndarray, shape (k, P), float32
        Factor on the weights: what each light adds to the best mean of the lights' residuals, times the inverse
        variance of that mean around the pixel, robust at the pixel.
    bend : ndarray, shape (P,), float32
        Second derivative of the robust loss over `factor`, 1 for a loss that is not robust.
    """

    factor: FloatImage
    bend: FloatImage

    def robust_loss(self, reference: Reference, weights: FloatImage) -> FloatArray:
        """Factor (N,) on the uncertainty with the solve's `weights` (k, P): a robust loss bends less."""
        total, bent = (reference.mesh.to_nodes(part) for part in reference.sums(weights, self.bend).sum(axis=0).T)
        return np.divide(total, np.maximum(bent, _LEAST_BEND * total), out=np.ones_like(total), where=total > 0)


def learn_precision(residual: Residual) -> Precision:
    """Weights of the lights' best mean around each pixel, from their residuals.

    Lights separated from one mosaic err together, for each is predicted from all the samples around; what one misses of
    a reflection's sparkle the others have too much. So the lights divide a weight as ``C^-1 1`` of the residuals'
    covariance C between them (generalised least squares), none below 0. The weight is the inverse variance of that
    mean's residual to the power .75, for it is itself uncertain, times the part of it that displaces: brightness and
    contrast that change slowly leave a residual which the gradient of the speckle averages out, blurred noise one that
    it does not. It holds whatever corrupts the mean there: camera noise, demosaicing, the erratic part of a reflection.
    Its unit is the median over the region. The pixel's own factor is that of a Student distribution, so that dust or a
    fragment does not corrupt a node.
    """
    pixels, weights = residual.reference.pixels, residual.weights
    covariance = window_covariance(pixels, residual.difference, weights)
    variance = covariance[range(len(weights)), range(len(weights))]
    typical = float(np.median(variance[variance > 0])) if variance.any() else 0.0
    if typical <= 0:
        return Precision(factor=np.ones_like(weights), bend=np.ones_like(weights[0]))
    floor = np.float32(max(0.1 * typical, 1e-6 * float(np.var(_some(residual.values, weights), dtype=np.float64))))
    factor = spread(pixels, _best_fractions(covariance, floor))
    mean, used, bend = np.empty((3, factor.shape[1]), dtype=np.float32)
    best_mean(factor, weights, residual.difference, mean, used)
    around = spread(pixels, window_means(pixels, (mean**2)[None], used[None]))[0]
    np.maximum(around, floor / len(factor), out=around)
    trusted = displacing_fraction(residual.reference, mean, used / around)
    trusted *= around
    unit = np.float32(np.median(_some(trusted, used))) if used.any() else np.float32(0)
    robust_weights(mean, around, trusted, np.float32(unit), np.float32(_FREEDOM), factor, bend)
    return Precision(factor=factor, bend=bend)


def _best_fractions(covariance: FloatImage, least: np.float32) -> FloatImage:
    """Solve ``C x = 1`` for the lights' fractions (k, h, w) of the mean of least variance, up to a factor.

    C is the residuals' `covariance` (k, k, h, w), with variances of `least` or more.
    """
    lights = range(len(covariance))
    matrices = covariance.astype(np.float64)
    matrices[lights, lights] = np.maximum(matrices[lights, lights], least)
    for a, b in combinations(lights, 2):
        most = (1 - _OWN) * np.sqrt(matrices[a, a] * matrices[b, b])
        matrices[a, b] = matrices[b, a] = np.clip((1 - _OWN) * matrices[a, b], -most, most)
    solved = np.linalg.solve(np.moveaxis(matrices, (0, 1), (2, 3)), np.ones((len(matrices), 1)))
    return np.asarray(np.moveaxis(solved[..., 0], 2, 0), dtype=np.float32)


def _some(values: FloatImage, weights: FloatImage) -> FloatImage:
    """About 100 000 of the values (..., P) that have weight."""
    every = slice(None, None, max(1, values.size // 100_000))
    some = values[..., every][weights[..., every] > 0]
    return np.asarray(some if some.size else values[weights > 0])


_MATCHED = (0.4, 0.6)
"""Correlation coefficient under which the images of an element do not match: for poor images and for good ones."""
_MATCHED_PRECISE = (0.4, 0.9)
"""The same where the lights count by their precision, so that a reflection in one of them is no mismatch."""
_WORSE = 8.0
"""In between: how many times farther from 1 than the median of the elements around. Chosen; with half or twice of it
lights do not change (benchmarks/constants.py)."""
_AROUND = 61
"""Elements around: a square of some 5.5 elements a side, of which a crack takes a third."""


def matching_elements(
    residual: Residual, precision: Precision | None = None, *, least: float | None = None
) -> BoolArray:
    """Find the elements whose images match: zero-mean correlation coefficient of all lights together.

    Elements without weight or texture in the reference count as matched.

    Parameters
    ----------
    residual
        At the displacement found.
    precision
        Of the lights, by which they count in an element; None: all alike.
    least
        Coefficient from which an element matches; None judges it by what the elements around reach.

    Returns
    -------
    ndarray, shape (E,), bool
    """
    mesh = residual.reference.mesh
    fg, ff, gg = _centred_products(residual, _light_precision(residual, precision))
    own = correlation(fg, ff, gg)
    # a few speckles can match by chance; those of all elements around a node hardly
    around = correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
    coefficient = np.minimum(own, np.sort(around[mesh.elements], axis=1)[:, 1])
    if least is not None:
        return np.asarray(coefficient >= least)
    poor, good = _MATCHED if precision is None else _MATCHED_PRECISE
    matched = np.asarray(coefficient >= good)
    between = ~matched & (coefficient >= poor)
    typical, textured = 1.0, ff > 0
    if textured.any() and between.any():
        centre = mesh.nodes[mesh.elements].mean(axis=1)
        ranks = [*range(1, min(_AROUND, int(textured.sum())) + 1)]
        nearest = cKDTree(centre[textured]).query(centre[between], k=ranks)[1]
        typical = np.median(coefficient[textured][nearest], axis=1)
    matched[between] = coefficient[between] >= 1 - _WORSE * (1 - typical)
    return matched


def correlation_around(residual: Residual) -> FloatArray:
    """Zero-mean correlation coefficient (N,) of all lights together in the elements around each node.

    It is NaN where the states show no texture together.
    """
    to_nodes = residual.reference.mesh.to_nodes
    fg, ff, gg = (to_nodes(part) for part in _centred_products(residual, _light_precision(residual, None)))
    return np.where(ff > 1e-9 * ff.max(initial=0.0), correlation(fg, ff, gg), np.nan)


def _light_precision(residual: Residual, precision: Precision | None) -> FloatArray:
    """Mean precision (k, E) of each light in each element, over that of the most precise; 1 where it is not known."""
    reference = residual.reference
    if precision is None or len(residual.values) == 1:
        return np.ones((len(residual.values), len(reference.mesh.elements)))
    mean = reference.sums(precision.factor, precision.bend)[..., 0]
    return np.asarray(mean / np.maximum(mean.max(axis=0), 1e-300))


def misfit(mesh: Tri3Mesh, squares: FloatArray, measured: BoolArray) -> FloatArray:
    """Weighted rms residual around each node, over its median: 1 is ordinary, 3 is suspicious.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    squares : ndarray, shape (k, E, 3)
        Those of `Residual` with the weights of the solve, in units of the inverse variance of the residual.
    measured : ndarray, shape (N,), bool
        Nodes over which the median is taken.

    Returns
    -------
    ndarray, shape (N,)
    """
    square, _, count = (mesh.to_nodes(part) for part in squares.sum(axis=0).T)
    around = square / np.maximum(count, 1.0)
    typical = float(np.median(around[measured])) if measured.any() else 0.0
    return np.sqrt(around / typical) if typical > 0 else np.ones_like(around)


def _centred_products(residual: Residual, precision: FloatArray) -> FloatArray:
    """Sum the centred products f g, f f and g g over the lights, each with its `precision` (k, E); (3, E)."""
    return np.asarray([(precision * part).sum(axis=0) for part in residual.centred_products()])


def correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from the centred products f g, f f and g g.

    It is 1 where the reference has nothing to compare, and 0 where only the deformed image has nothing.
    """
    empty = ff <= 1e-9 * ff.max(initial=0.0)
    blank = gg <= 1e-9 * ff
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    return np.where(empty, 1.0, np.where(blank, 0.0, fg / np.where(empty | blank, 1.0, scale)))
