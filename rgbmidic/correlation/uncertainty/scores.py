"""Covariance of the right-hand side from the residual itself: the block estimator of the long-run variance.

The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and speckle and
between the lights; the variance of its sum over blocks wider than that reach holds all of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations_with_replacement

import cv2
import numpy as np

from rgbmidic._kernels.robust import scores
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.blocks import BLOCK, block_side
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

__all__ = ["displacing_share", "light_covariances", "score_covariance"]

_LEAST_RATIO = 1e-2
"""Least share of a residual's variance that is taken to displace."""
_LEAST_SHARE = 0.05
"""Least share of a direction in the texture: less is not measured."""
_EVEN = 0.6
"""Standard deviation (blocks) of the window in which the information of a block is taken."""
_SCORE_RANGE = 30.0
"""Standard deviation (px) of the window over which block sums are averaged."""
_LEAST_FREEDOM = 0.25
"""Least number of blocks, less one, that is taken: in a region of one block the uncertainty is hardly known."""
_PRIOR = 0.1
"""Blocks for which the region's typical score counts in that window: beside a hole few blocks speak."""


def displacing_share(reference: Reference, difference: FloatImage, weight: FloatImage) -> FloatImage:
    """Variance of the scores of a residual `difference` (P,) over what white noise would give of which `weight` (P,) is
    the inverse variance, with the gradient of the lights' common texture; (P,)."""
    xx, _, yy = _score_ratios(reference, difference[None], weight[None], reference.texture[:, None], BLOCK)
    share = np.maximum(xx + yy, _LEAST_RATIO)
    return np.asarray(reference.pixels.from_blocks(share[None], BLOCK)[0])


def score_covariance(residual: Residual, weights: FloatImage, texture: FloatArray) -> FloatArray:
    """Element blocks (E, 3, 3, 3) of the covariance of the right-hand side with the solve's `weights` (k, P), and with
    its Hessian's element blocks `texture` (E, 3, 3, 3)."""
    reference = residual.reference
    side, gradient = block_side(reference.pixels, reference.mesh.size), (reference.gradient_x, reference.gradient_y)
    ratios = _score_ratios(reference, residual.difference, weights, gradient, side)
    along_x, _, along_y = _per_element(reference, ratios, side) / reference.unfitted
    share = _share_along_x(reference, texture)
    along_x, along_y = along_x / share, along_y / (1 - share)
    scale = np.stack([along_x, np.sqrt(along_x * along_y), along_y], axis=-1)
    return np.asarray(texture * scale[:, None, None])


def light_covariances(residual: Residual, weights: FloatImage) -> Iterator[tuple[int, int, FloatArray]]:
    """Covariance of the right-hand sides of each two lights a and b >= a with the solve's `weights` (k, P): their
    numbers, and its element blocks (E, 3, 3, 3).

    A light's own is as in `score_covariance`; that of two is the root of both, times the correlation of their scores
    where both see. Of what the lights have in common the fit leaves the fraction `unfitted`, which is put back before
    the scores are summed; it takes nothing of what they differ by.
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
        share = _share_along_x(reference, reference.hessian_blocks(light, weight))
        roots.append(np.sqrt([along_x / share, along_y / (1 - share)]))
    for a, b in combinations_with_replacement(range(len(weights)), 2):
        # the gradients of two lights are parallel
        slope = (np.copysign(np.sqrt(np.maximum(axis[a] * axis[b], 0)), axis[a]) for axis in slopes)
        texture = reference.blocks(np.sqrt(weights[a] * weights[b]), *slope)
        (x, y), (other_x, other_y) = roots[a], roots[b]
        scale = np.stack([x * other_x, (x * other_y + y * other_x) / 2, y * other_y], axis=-1)
        if a != b:
            scale *= _per_element(reference, _correlation(own[a], own[b], side)[None], side)[0, :, None]
        yield a, b, texture * scale[:, None, None]


def _share_along_x(reference: Reference, texture: FloatArray) -> FloatArray:
    """Share (E,) of the gradients along x in the `texture` (E, 3, 3, 3) around each element."""
    mesh = reference.mesh
    own = texture.sum(axis=(1, 2))
    x, y = (mesh.to_nodes(part)[mesh.elements].sum(axis=1) for part in (own[:, 0], own[:, 2]))
    share = np.divide(x, x + y, out=np.full_like(x, 0.5), where=x + y > 0)
    return np.asarray(np.clip(share, _LEAST_SHARE, 1 - _LEAST_SHARE))


def _score_ratios(
    reference: Reference,
    difference: FloatImage,
    weights: FloatImage,
    gradient: FloatImage | tuple[FloatImage, FloatImage],
    side: int,
) -> FloatArray:
    """Covariance (xx, xy, yy) of the scores of blocks over their information; shape (3, rows, columns).

    The scores are those of all lights together, for fields (k, P) and their `gradient` in x and y.

    A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
    smooth, and averaged, is its ratio to the information; xx + yy is 1 for white noise and ideal weights.
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
    """Products xx, xy, yy of such scores per pixel, averaged; shape (3, rows, columns)."""
    typical = _typical_square(x, y, count)
    around = _blur(count, _SCORE_RANGE / side)
    prior = _PRIOR * side**2
    ratios = [
        (_blur(product, _SCORE_RANGE / side) + prior * expected) / (around + prior)
        for product, expected in ((x * x, typical), (x * y, 0.0), (y * y, typical))
    ]
    return np.asarray(np.stack(ratios) * _few_blocks(around, count, side))


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


def _few_blocks(around: FloatArray, count: FloatArray, side: int) -> FloatArray:
    """Factor on a variance that few blocks tell, so that an error over its stated uncertainty has the variance 1.

    An estimate from n blocks has 2 n degrees of freedom; the mean of its inverse is n / (n - 1) times too large.
    """
    window = 4 * np.pi * (_SCORE_RANGE / side) ** 2
    number = np.minimum(window * around, count.sum()) / side**2
    return np.asarray(number / np.maximum(number - 1, _LEAST_FREEDOM))


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
