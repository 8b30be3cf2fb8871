"""Displacement that a difference of two images shows around each pixel: its regression on the gradient in a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from rgbmidic._kernels.illumination import scores
from rgbmidic.correlation.assembly import BLOCK
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatArray, FloatImage

RANGE = 24.0
"""Standard deviation (px) of the window: what a reflection displaces changes over some 50 px. With 16 px errors on
raised droplets are up to 5 % larger (benchmarks/reflections.py)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalDisplacement:
    """On a grid of blocks of `BLOCK` px.

    Attributes
    ----------
    values : ndarray, shape (2, h, w)
        In x and y, px.
    variance : ndarray, shape (h, w)
        Of each, px²: the scatter of the blocks' scores about it.
    information : ndarray, shape (h, w)
        Sum of weight times squared gradient, half of it for each direction.
    """

    values: FloatArray
    variance: FloatArray
    information: FloatArray

    @classmethod
    def of(
        cls, pixels: PixelMap, difference: FloatImage, weights: FloatImage, gradient: FloatImage
    ) -> LocalDisplacement:
        """From a difference (P,) that is ``displacement . gradient`` and noise, for weights (P,), gradient (2, P)."""
        sums = np.empty((4, weights.size), dtype=np.float32)
        scores(difference[None], weights[None], gradient[0][None], gradient[1][None], sums)
        blocks = pixels.block_sums(sums[:3], BLOCK).astype(np.float64)
        x, y, power = (_window(one) for one in blocks)
        information = np.maximum(power / 2, 1e-30)
        values = np.stack([x, y]) / information
        scatter = ((blocks[:2] - values * blocks[2] / 2) ** 2).mean(axis=0)
        held = 4 * np.pi * (RANGE / BLOCK) ** 2  # blocks of a window
        return cls(values=values, variance=_window(scatter) / information**2 / held, information=information)


def _window(grid: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(grid, RANGE / BLOCK, mode="constant", truncate=3))
