"""Means in a Gaussian window around each pixel, taken on a coarser grid."""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatImage

__all__ = ["spread", "window_means"]

_RANGE = 8.0
"""Standard deviation (px) of the window: wide enough to tell a variance, narrow beside a reflection."""
_COARSE = 4
"""Reduction of the grid on which that window is applied."""


def window_means(pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
    """Weighted means (n, h, w) of fields (n, P) around each block of the grid, for weights (n, P)."""
    means = []
    for field, weight in zip(fields, weights, strict=True):
        total, share = (_blur(pixels.block_means(values, _COARSE)) for values in (field * weight, weight))
        means.append(total / np.maximum(share, np.float32(1e-6 / _COARSE**2)))
    return np.stack(means)


def spread(pixels: PixelMap, grids: FloatImage) -> FloatImage:
    """Such means (n, h, w) at the pixels (n, P)."""
    return pixels.from_blocks(grids, _COARSE)


def _blur(grid: FloatImage) -> FloatImage:
    sigma = _RANGE / _COARSE
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
