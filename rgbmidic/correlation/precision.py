"""How precise the lights are together around each pixel, learnt from their residuals: the weights by statistics."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbmidic._kernels.robust import best_mean, robust_weights
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.scores import displacing_share
from rgbmidic.correlation.windows import spread, window_covariance, window_means
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["Precision", "learn_precision"]

_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual."""
_OWN = 0.1
"""Share of its variance that each light's residual is taken to have for itself: .03 to .3 measure the same."""
_LEAST_BEND = 0.1
"""Least bend of the loss around a node, over that of its weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Precision:
    """What the residual says about the lights.

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
        """Factor (N,) on the uncertainty with the solve's `weights` (k, P): a robust loss bends less than they say."""
        total, bent = (reference.mesh.to_nodes(part) for part in reference.sums(weights, self.bend).sum(axis=0).T)
        return np.divide(total, np.maximum(bent, _LEAST_BEND * total), out=np.ones_like(total), where=total > 0)


def learn_precision(residual: Residual) -> Precision:
    """Weights of the lights' best mean around each pixel, from their residuals.

    Lights separated from one mosaic err together, for each is predicted from all the samples around; what one misses of
    a reflection's sparkle the others have too much. So the lights share a weight as ``C^-1 1`` of the residuals'
    covariance C between them (generalised least squares), none below 0. The weight is the inverse variance of that
    mean's residual to the power .75, for it is itself uncertain, times the part of it that displaces: brightness and
    contrast that change slowly leave a residual which the gradient of the speckle averages out, blurred noise one that
    it does not. It holds whatever spoils the mean there: camera noise, demosaicing, the erratic part of a reflection.
    Its unit is the median over the region. The pixel's own factor is that of a Student distribution, so that dust or a
    fragment does not spoil a node.
    """
    pixels, weights = residual.reference.pixels, residual.weights
    covariance = window_covariance(pixels, residual.difference, weights)
    variance = covariance[range(len(weights)), range(len(weights))]
    typical = float(np.median(variance[variance > 0])) if variance.any() else 0.0
    if typical <= 0:
        return Precision(factor=np.ones_like(weights), bend=np.ones_like(weights[0]))
    floor = np.float32(max(0.1 * typical, 1e-6 * float(np.var(_some(residual.values, weights), dtype=np.float64))))
    share = spread(pixels, _best_shares(covariance, floor))
    mean, used, bend = np.empty((3, share.shape[1]), dtype=np.float32)
    best_mean(share, weights, residual.difference, mean, used)
    around = spread(pixels, window_means(pixels, (mean**2)[None], used[None]))[0]
    np.maximum(around, floor / len(share), out=around)
    trusted = displacing_share(residual.reference, mean, used / around)
    trusted *= around
    unit = np.float32(np.median(_some(trusted, used))) if used.any() else np.float32(0)
    robust_weights(mean, around, trusted, np.float32(unit), np.float32(_FREEDOM), share, bend)
    return Precision(factor=share, bend=bend)


def _best_shares(covariance: FloatImage, least: np.float32) -> FloatImage:
    """Share (k, h, w) of each light in the mean of least variance, but for a factor common to the lights, from the
    residuals' `covariance` (k, k, h, w), whose variances are `least` or more."""
    lights = range(len(covariance))
    matrices = covariance.astype(np.float64)
    matrices[lights, lights] = np.maximum(matrices[lights, lights], least)
    for a, b in combinations(lights, 2):
        most = (1 - _OWN) * np.sqrt(matrices[a, a] * matrices[b, b])
        matrices[a, b] = matrices[b, a] = np.clip((1 - _OWN) * matrices[a, b], -most, most)
    return _solved_for_ones(matrices)


def _solved_for_ones(matrices: FloatArray) -> FloatImage:
    """The x (k, h, w) of ``C x = 1`` for symmetric positive definite matrices (k, k, h, w), by elimination."""
    left, right = matrices.copy(), np.ones_like(matrices[0])
    for pivot in range(len(right)):
        for row in range(len(right)):
            if row != pivot:
                factor = left[row, pivot] / left[pivot, pivot]
                left[row, pivot:] -= factor * left[pivot, pivot:]
                right[row] -= factor * right[pivot]
    return np.asarray(right / left[range(len(right)), range(len(right))], dtype=np.float32)


def _some(values: FloatImage, weights: FloatImage) -> FloatImage:
    """About 100 000 of the values (..., P) that have weight."""
    every = slice(None, None, max(1, values.size // 100_000))
    some = values[..., every][weights[..., every] > 0]
    return np.asarray(some if some.size else values[weights > 0])
