"""Covariance of the right-hand side from the residual itself: the block estimator of the long-run variance.

The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and speckle and
between the lights; the variance of its sum over blocks wider than that reach holds all of it.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic._kernels.grid import block_sums, score_sums
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

__all__ = ["displacing_share", "score_covariance"]

_BLOCK = 13
"""Side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter."""
_LEAST_RATIO = 1e-2
"""Least share of a residual's variance that is taken to displace."""
_EVEN = 0.6
"""Standard deviation (blocks) of the window in which the information of a block is taken."""
_MOSTLY_FITTED = 2.0
"""Nodes per block from which (elements under 9 px) the sums of blocks are checked against `_least_ratio`..."""
_FEW_BLOCKS = 9
"""...and blocks in the region up to which they are."""
_REACH = 3
"""Farthest move (px) of the autocorrelations in it."""
_SCORE_RANGE = 30.0
"""Standard deviation (px) of the window over which block sums are averaged."""


def displacing_share(residual: Residual, variance: FloatImage) -> FloatImage:
    """Variance of each light's scores over what white noise of that `variance` (k, P) would give, (k, P)."""
    pixels = residual.reference.pixels
    sums = _score_sums(residual, np.asarray((residual.weights > 0) / variance, dtype=np.float32))
    ratios = [_score_ratios(*light)[0] for light in sums]
    return np.stack([pixels.from_blocks(np.maximum(r[0] + r[2], _LEAST_RATIO), _BLOCK) for r in ratios])


def score_covariance(residual: Residual, weights: FloatImage, measured: int) -> FloatArray:
    """Element blocks (E, 3, 3, 3) of the covariance of the right-hand side with the solve's `weights` (k, P).

    Fitting `measured` nodes has taken their share out of the residual.
    """
    reference = residual.reference
    used = np.asarray(weights.any(axis=0), dtype=np.float32)
    x, y, information, _ = _score_sums(residual, weights).sum(axis=0)
    index, shape = reference.pixels.blocks(_BLOCK)
    count = np.zeros((1, information.size), dtype=np.float32)
    block_sums(used[None], index, count)
    ratios, level = _score_ratios(x, y, information, count.reshape(shape).astype(np.float64))
    share = _BLOCK**2 * measured / max(float(used.sum()), 1.0)
    ratios = ratios / (1 - min(share, 0.75))
    if share > _MOSTLY_FITTED or used.sum() < _FEW_BLOCKS * _BLOCK**2:  # the fit leaves little of a block's sum
        mean = float((ratios[0] + ratios[2]).mean())
        ratios *= max(1.0, _least_ratio(residual, weights, measured) / max(mean, 1e-30))
    return _per_element(reference, level * ratios, used)


def _least_ratio(residual: Residual, weights: FloatImage, measured: int) -> float:
    """Least variance of the scores over their information, from residual and gradient at short distances apart.

    ``sum_d R_r(d) R_g(d) / R_g(0)`` with the autocorrelations of ``sqrt(w) r`` and of ``sqrt(w) grad f``: what
    noise that no fit has touched, correlated by filters and demosaicing, would give.
    """
    reference = residual.reference
    pixels = reference.pixels
    total = information = independent = 0.0
    for light, weight in enumerate(weights):
        number = float((weight > 0).sum())
        if not number:
            continue
        root = np.sqrt(weight)
        parts = residual.difference[light], reference.gradient_x[light], reference.gradient_y[light]
        noise, *slopes = (_autocorrelation(pixels.window(root * part)) for part in parts)
        gradient = slopes[0] + slopes[1]
        total += float((noise * gradient).sum()) / number
        information += float(gradient[0])
        independent += number * float(noise[0] ** 2 / max((noise**2).sum(), 1e-300))
    freedom = 1 - 2 * measured / max(independent, 1e-30)
    return total / max(information, 1e-300) / max(freedom, 0.1)


def _score_sums(residual: Residual, weights: FloatImage) -> FloatArray:
    """Sums (k, 4, rows, columns) over blocks of the lights' scores in x and y, their information, and pixels."""
    reference = residual.reference
    index, shape = reference.pixels.blocks(_BLOCK)
    sums = np.zeros((len(weights), 4, shape[0] * shape[1]))
    score_sums(residual.difference, weights, reference.gradient_x, reference.gradient_y, index, sums)
    return sums.reshape(len(weights), 4, *shape)


def _score_ratios(
    x: FloatArray, y: FloatArray, information: FloatArray, count: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Covariance (xx, xy, yy) of the scores of blocks over their information, and the information per pixel.

    A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
    smooth, and averaged, is its ratio to the information; xx + yy is 1 for white noise and ideal weights.
    """
    level = _blur(information, _EVEN) / np.maximum(_blur(count, _EVEN), 1e-6)
    scale = np.divide(1, np.sqrt(level), out=np.zeros_like(level), where=(level > 0) & (count > 0))
    x, y = x * scale, y * scale
    around = _blur(count, _SCORE_RANGE / _BLOCK)
    # half a block's worth of the mean over the region: beside a hole few blocks speak
    prior, total = 0.5 * _BLOCK**2, max(float(count.sum()), 1.0)
    ratios = [
        (_blur(product, _SCORE_RANGE / _BLOCK) + prior * float(product.sum()) / total) / (around + prior)
        for product in (x * x, x * y, y * y)
    ]
    return np.stack(ratios), level


def _per_element(reference: Reference, density: FloatArray, used: FloatImage) -> FloatArray:
    """Element blocks of a score variance per pixel (xx, xy, yy) that is constant in each element."""
    mesh = reference.mesh
    top, left, _, _ = reference.pixels.bounds
    place = mesh.nodes[mesh.elements].mean(axis=1) - (left, top)
    centre = np.round(place / _BLOCK - 0.5).astype(int)
    column = np.clip(centre[:, 0], 0, density.shape[2] - 1)
    row = np.clip(centre[:, 1], 0, density.shape[1] - 1)
    # summed over the pixels in use: at an edge they do not cover the element evenly
    mass = reference.blocks(used, np.ones_like(used), np.zeros_like(used))[..., :1]
    return np.asarray(mass * density[:, row, column].T[:, None, None, :])


def _autocorrelation(image: FloatImage) -> FloatArray:
    """Sums of products of an image with itself moved by up to `_REACH` rows and columns, the one not moved first."""
    rows, columns = image.shape
    sums = [float(np.vdot(image, image))]
    for i in range(_REACH + 1):
        for j in range(-_REACH if i else 1, _REACH + 1):
            if i >= rows or abs(j) >= columns:
                continue
            first = image[i:, max(j, 0) : columns + min(j, 0)]
            second = image[: rows - i, max(-j, 0) : columns - max(j, 0)]
            sums += [float(np.vdot(first, second))] * 2  # and the opposite move
    return np.array(sums)


def _blur(image: AnyArray, sigma: float) -> AnyArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))
