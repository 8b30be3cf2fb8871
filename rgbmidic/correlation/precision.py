"""How precise the lights are together around each pixel, learnt from their residuals: the weights by statistics."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.scores import displacing_share
from rgbmidic.correlation.windows import spread, window_means
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["Precision", "learn_precision"]

_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual."""
_OWN = 0.1
"""Share of its variance that each light's residual is taken to have for itself: .03 to .3 measure the same."""
_LEAST_BEND = 0.1
"""Least bend of the loss around a node, over that of its weights."""
_TRUST = 0.75
"""Power of the inverse variance that makes the weight: under 1, for the variance is itself uncertain."""


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
        whole = weights.sum(axis=0)
        total, bent = (
            reference.mesh.to_nodes(reference.pixels.by_element(part)) for part in (whole, whole * self.bend)
        )
        return np.divide(total, np.maximum(bent, _LEAST_BEND * total), out=np.ones_like(total), where=total > 0)


def learn_precision(residual: Residual) -> Precision:
    """Weights of the lights' best mean around each pixel, from their residuals.

    Lights separated from one mosaic err together, for each is predicted from all the samples around; what one misses
    of a reflection's sparkle the others have too much. So the lights share a weight as ``C^-1 1`` of the residuals'
    covariance C between them (generalised least squares), none below 0. The weight is the inverse variance of that
    mean's residual, times the part of it that displaces: brightness and contrast that change slowly leave a residual
    which the gradient of the speckle averages out, blurred noise one that it does not. It holds whatever spoils the
    mean there: camera noise, demosaicing, the erratic part of a reflection. Its unit is the median over the region.
    The pixel's own factor is that of a Student distribution, so that dust or a fragment does not spoil a node.
    """
    pixels, weighted = residual.reference.pixels, residual.weights > 0
    variance = window_means(pixels, residual.difference**2, residual.weights)
    typical = float(np.median(variance[variance > 0])) if variance.any() else 0.0
    if typical <= 0 or not weighted.any():
        return Precision(factor=np.ones_like(residual.weights), bend=np.ones_like(residual.weights[0]))
    contrast = float(np.var(_some(residual.values, weighted), dtype=np.float64))
    floor = np.float32(max(0.1 * typical, 1e-6 * contrast))
    share = _best_mean(residual, np.maximum(variance, floor), weighted)
    used, mean = share.max(axis=0) > 0, np.einsum("kp,kp->p", share, residual.difference)
    square = mean[None] ** 2
    around = spread(pixels, window_means(pixels, square, used[None].astype(np.float32)))[0]
    np.maximum(around, floor / len(share), out=around)
    trusted = displacing_share(residual.reference, mean, share > 0, around) * around
    unit = np.median(_some(trusted, used)) if used.any() else np.float32(0)
    np.divide(unit, trusted, out=trusted)
    np.power(trusted, np.float32(_TRUST), out=trusted)
    ratio = np.divide(square[0], around, out=square[0])
    bend = (np.float32(_FREEDOM) - ratio) / (np.float32(_FREEDOM) + ratio)
    trusted *= np.float32(_FREEDOM + 1) / (np.float32(_FREEDOM) + ratio)
    share *= trusted
    return Precision(factor=share, bend=bend)


def _best_mean(residual: Residual, variance: FloatImage, weighted: BoolArray) -> FloatImage:
    """Share (k, P) of each light in the mean of least variance; 0 where not `weighted` (k, P).

    `variance` (k, h, w) is the residuals' on the grid of `window_means`.
    """
    lights = len(variance)
    covariance = np.zeros((lights, lights, *variance.shape[1:]))
    covariance[range(lights), range(lights)] = variance
    for a, b in combinations(range(lights), 2):
        both = np.sqrt(residual.weights[a] * residual.weights[b])[None]
        product = (residual.difference[a] * residual.difference[b])[None]
        shared = window_means(residual.reference.pixels, product, both)[0]
        most = (1 - _OWN) * np.sqrt(variance[a] * variance[b])
        covariance[a, b] = covariance[b, a] = np.clip((1 - _OWN) * shared, -most, most)
    weights = np.maximum(spread(residual.reference.pixels, _solved_for_ones(covariance)), 0) * weighted
    total = weights.sum(axis=0)
    return np.asarray(weights / np.where(total > 0, total, np.float32(1)))


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


def _some(values: FloatImage, chosen: BoolArray) -> FloatImage:
    """About 100 000 of the `chosen` values (..., P)."""
    every = slice(None, None, max(1, values.size // 100_000))
    some = values[..., every][chosen[..., every]]
    return np.asarray(some if some.size else values[chosen])
