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
        parts = weights, weights * self.bend
        total, bent = (reference.mesh.to_nodes(reference.pixels.by_element(part.sum(axis=0))) for part in parts)
        return np.divide(total, np.maximum(bent, _LEAST_BEND * total), out=np.ones_like(total), where=total > 0)


def learn_precision(residual: Residual) -> Precision:
    """Weights of the lights' best mean around each pixel, from their residuals.

    Lights separated from one mosaic err together, for each is predicted from all the samples around; what one misses
    of a reflection's sparkle the others have too much. So the weights are ``C^-1 1`` of the residuals' covariance C
    between the lights (generalised least squares), not the inverse of each light's own variance, none below 0. That
    variance is the residual's, times the part of it that displaces: brightness and contrast that change slowly leave a
    residual which the gradient of the speckle averages out, blurred noise one that it does not. C holds whatever
    spoils a light there: camera noise, demosaicing, the erratic part of a reflection. Its unit is the median variance
    over all lights. The pixel's own factor is that of a Student distribution of the mean's residual, so that dust or a
    fragment does not spoil a node.
    """
    pixels, weighted = residual.reference.pixels, residual.weights > 0
    means = window_means(pixels, residual.difference**2, residual.weights)
    variance = spread(pixels, means)
    typical = _typical(variance, weighted)
    if typical <= 0:
        return Precision(factor=np.ones_like(residual.weights), bend=np.ones_like(residual.weights[0]))
    contrast = float(np.var(residual.values[weighted], dtype=np.float64))
    floor = np.float32(max(0.1 * typical, 1e-6 * contrast))
    variance = np.maximum(variance, floor)
    variance *= displacing_share(residual, variance)
    trusted = (_typical(variance, weighted) / variance) ** (_TRUST / 2) * weighted
    together = _together(residual, np.maximum(means, floor), trusted)
    factor = np.maximum(trusted * together, 0)
    robust, bend = _student(residual, factor, floor)
    return Precision(factor=np.asarray(factor * robust, dtype=np.float32), bend=bend)


def _together(residual: Residual, variance: FloatImage, trusted: FloatImage) -> FloatImage:
    """Sums (k, P) over the lights of the inverse of their residuals' correlation times `trusted` (k, P).

    `variance` (k, h, w) is the residuals' on the grid of `window_means`.
    """
    lights = len(trusted)
    correlation = np.ones((*variance.shape[1:], lights, lights))
    for a, b in combinations(range(lights), 2):
        both = np.sqrt(residual.weights[a] * residual.weights[b])[None]
        product = (residual.difference[a] * residual.difference[b])[None]
        shared = window_means(residual.reference.pixels, product, both)[0]
        shared = (1 - _OWN) * shared / np.sqrt(variance[a] * variance[b])
        correlation[..., a, b] = correlation[..., b, a] = np.clip(shared, _OWN - 1, 1 - _OWN)
    inverse = np.linalg.inv(correlation).astype(np.float32)
    return np.stack(
        [
            (spread(residual.reference.pixels, inverse[..., light].transpose(2, 0, 1)) * trusted).sum(axis=0)
            for light in range(lights)
        ]
    )


def _student(residual: Residual, factor: FloatImage, floor: np.float32) -> tuple[FloatImage, FloatImage]:
    """Student's factor (P,) on a pixel's weight and the bend of the loss, from the lights' mean residual."""
    total = factor.sum(axis=0)
    used = np.asarray(total > 0, dtype=np.float32)
    mean = (factor * residual.difference).sum(axis=0) / np.where(used, total, np.float32(1))
    pixels = residual.reference.pixels
    variance = spread(pixels, window_means(pixels, mean[None] ** 2, used[None]))[0]
    ratio = mean**2 / np.maximum(variance, floor / len(factor))
    return (_FREEDOM + 1) / (_FREEDOM + ratio), (_FREEDOM - ratio) / (_FREEDOM + ratio)


def _typical(variance: FloatImage, weighted: BoolArray) -> float:
    """Median where `weighted`, from about 100 000 values."""
    if not weighted.any():
        return 0.0
    return float(np.median(variance[weighted][:: max(1, int(weighted.sum()) // 100_000)]))
