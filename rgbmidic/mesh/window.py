"""Means in a window around the owned pixels, and sums in one over a grid of blocks."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic._kernels.owned_pixels import product_sums
from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.typing import AnyArray, FloatImage


def window_sums(grids: AnyArray, sigma: float) -> AnyArray:
    """Sum grids (..., h, w) of blocks in a Gaussian window of `sigma` blocks; beyond the grids there is nothing."""
    sums = np.empty(grids.shape, grids.dtype)  # whose grids are contiguous, whatever those given are
    for index in np.ndindex(grids.shape[:-2]):
        cv2.GaussianBlur(grids[index], (0, 0), sigma, dst=sums[index], borderType=cv2.BORDER_CONSTANT)
    return sums


@dataclass(frozen=True, slots=True, kw_only=True)
class SlidingWindow:
    """Gaussian window for means of fields around the owned pixels, applied on a grid of blocks.

    Attributes
    ----------
    sigma
        Its standard deviation, px: its 800 px, 4 pi times the square, give a variance to 5 % (derived), and it is
        narrow beside a reflection. Chosen; with half or twice of it in the weights lights under one differ by 3e-3 px
        at most, beside a gap by 6e-3 px, their uncertainty by 8 % (benchmarks/constants.py).
    step
        Side of the blocks, px: half the standard deviation, to which it adds 1 %.
    """

    sigma: float = 8.0
    step: int = 4

    def ratios(self, pixels: PixelMap, fields: FloatImage) -> FloatImage:
        """Sums of fields (n, P) around each block of the grid over that of the last one, (n - 1, h, w)."""
        sums = pixels.block_sums(fields, self.step)
        return self._means(sums[:-1], sums[-1:])

    def covariance(self, pixels: PixelMap, fields: FloatImage, weights: FloatImage) -> FloatImage:
        """Average the products of each two fields (k, P) around each block of the grid, (k, k, h, w).

        Their weight is the geometric mean of the fields' weights (k, P).
        """
        count = len(fields)
        sums = np.empty((count * (count + 1), *pixels.grid(self.step)), dtype=np.float32)
        product_sums(fields, weights, pixels.lines, pixels.run_offsets, pixels.offsets, self.step, sums)
        means = np.empty((count, count, *sums.shape[1:]), dtype=np.float32)
        first, second = np.tril_indices(count)
        means[first, second] = means[second, first] = self._means(sums[::2], sums[1::2])
        return means

    def _means(self, totals: FloatImage, weights: FloatImage) -> FloatImage:
        """Divide sums (n, h, w) by those of their weights (n, h, w) or (1, h, w), both blurred."""
        sigma = self.sigma / self.step
        means, weight_means = (window_sums(grids, sigma) for grids in (totals, weights))
        means /= np.maximum(weight_means, np.float32(1e-6), out=weight_means)
        return np.asarray(means, dtype=np.float32)


WINDOW = SlidingWindow()
"""The window that is used by default."""
