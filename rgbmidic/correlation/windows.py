"""Means in a Gaussian window around each pixel, taken on a coarser grid."""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic._kernels.grid import block_sums
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatImage

__all__ = ["spread", "window_means"]

_RANGE = 8.0
"""Standard deviation (px) of the window: wide enough to tell a variance, narrow beside a reflection."""
_COARSE = 4
"""Reduction of the grid on which that window is applied."""


def window_means(pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
    """Weighted means (n, h, w) of fields (n, P) around each block of the grid, for weights (n, P)."""
    index, shape = pixels.blocks(_COARSE)
    sums = np.zeros((2, len(fields), shape[0] * shape[1]), dtype=np.float32)
    for total, values in zip(sums, (fields * weights, weights), strict=True):
        block_sums(np.ascontiguousarray(values, dtype=np.float32), index, total)
    total, share = (np.stack([_blur(grid.reshape(shape)) for grid in one]) for one in sums)
    return np.asarray(total / np.maximum(share, np.float32(1e-6)))


def spread(pixels: PixelMap, grids: FloatImage) -> FloatImage:
    """Such means (n, h, w) at the pixels (n, P)."""
    return np.stack([pixels.from_blocks(np.ascontiguousarray(grid, dtype=np.float32), _COARSE) for grid in grids])


def _blur(grid: FloatImage) -> FloatImage:
    sigma = _RANGE / _COARSE
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)
