"""Means in a Gaussian window around each pixel, taken on a coarser grid."""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic._kernels.grid import product_sums
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatImage

__all__ = ["spread", "window_covariance", "window_means"]

_RANGE = 8.0
"""Standard deviation (px) of the window: wide enough to tell a variance, narrow beside a reflection."""
_COARSE = 4
"""Reduction of the grid on which that window is applied."""


def window_means(pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
    """Weighted means (n, h, w) of fields (n, P) around each block of the grid, for weights (n, P)."""
    return _means(pixels.block_sums(fields * weights, _COARSE), pixels.block_sums(weights, _COARSE))


def window_covariance(pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
    """Means (k, k, h, w) of the products of each two fields (k, P) around each block of the grid, weighted by the
    geometric mean of their weights (k, P)."""
    count = len(fields)
    sums = np.empty((count, count, 2, *pixels.grid(_COARSE)), dtype=np.float32)
    product_sums(fields, weights, pixels.lines, pixels.line_offsets, _COARSE, sums)
    means = np.empty((count, count, *sums.shape[3:]), dtype=np.float32)
    for a in range(count):
        means[a, : a + 1] = means[: a + 1, a] = _means(sums[a, : a + 1, 0], sums[a, : a + 1, 1])
    return means


def _means(totals: FloatImage, shares: FloatImage) -> FloatImage:
    """Sums (n, h, w) over those of their weights, both blurred."""
    both = zip(totals, shares, strict=True)
    return np.stack([_blur(total) / np.maximum(_blur(share), np.float32(1e-6)) for total, share in both])


def spread(pixels: PixelMap, grids: FloatImage) -> FloatImage:
    """Such means (n, h, w) at the pixels (n, P)."""
    return pixels.from_blocks(grids, _COARSE)


def _blur(grid: FloatImage) -> FloatImage:
    sigma = _RANGE / _COARSE
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
