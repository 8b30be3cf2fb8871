"""How precise each light is around each pixel, learnt from its own residual: what weights the lights by statistics."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic._kernels.grid import block_sums
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.scores import displacing_share
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["Precision", "learn_precision"]

_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual."""
_RANGE = 8.0
"""Standard deviation (px) of the window in which the variance of the residual is estimated."""
_COARSE = 4
"""Reduction of the grid on which that window is applied."""
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
        Factor on the weights: inverse variance of the light around the pixel, and robust at the pixel.
    bend : ndarray, shape (k, P), float32
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
    """Inverse variance of every light around each pixel, from the residual.

    The variance is that of the residual, times the part of it that displaces: brightness and contrast that change
    slowly leave a residual which the gradient of the speckle averages out, blurred noise one that it does not. It
    holds whatever spoils a light there: camera noise, demosaicing, the erratic part of a reflection. Its unit is
    the median over all lights. The pixel's own factor is that of a Student distribution, so that dust or a
    fragment does not spoil a node.
    """
    variance = _local_variance(residual)
    weighted = residual.weights > 0
    typical = _typical(variance, weighted)
    if typical <= 0:
        return Precision(factor=np.ones_like(residual.weights), bend=np.ones_like(residual.weights))
    contrast = float(np.var(residual.values[weighted], dtype=np.float64))
    variance = np.maximum(variance, np.float32(max(0.1 * typical, 1e-6 * contrast)))
    ratio = residual.difference**2 / variance
    robust = (_FREEDOM + 1) / (_FREEDOM + ratio)
    bend = (_FREEDOM - ratio) / (_FREEDOM + ratio)
    variance *= displacing_share(residual, variance)
    factor = (_typical(variance, weighted) / variance) ** _TRUST * robust
    return Precision(factor=np.asarray(factor, dtype=np.float32), bend=np.asarray(bend, dtype=np.float32))


def _local_variance(residual: Residual) -> FloatImage:
    """Weighted Gaussian mean (k, P) of the squared residual around each pixel, found on a coarser grid."""
    pixels, weights = residual.reference.pixels, residual.weights
    index, shape = pixels.blocks(_COARSE)
    sums = np.zeros((2, len(weights), shape[0] * shape[1]), dtype=np.float32)
    for total, field in zip(sums, (residual.difference**2 * weights, weights), strict=True):
        block_sums(field, index, total)
    total, share = (np.stack([_blur(grid.reshape(shape)) for grid in lights]) for lights in sums)
    mean = total / np.maximum(share, np.float32(1e-6))
    return np.stack([pixels.from_blocks(grid, _COARSE) for grid in mean])


def _blur(grid: FloatImage) -> FloatImage:
    sigma = _RANGE / _COARSE
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


def _typical(variance: FloatImage, weighted: BoolArray) -> float:
    """Median where `weighted`, from about 100 000 values."""
    if not weighted.any():
        return 0.0
    return float(np.median(variance[weighted][:: max(1, int(weighted.sum()) // 100_000)]))
