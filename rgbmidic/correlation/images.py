"""Images prepared for correlation (holes, prefilter, spline, usable pixels), and means in a window around pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.owned_pixels import product_sums
from rgbmidic._kernels.splines import PAD, bspline_coefficients
from rgbmidic.errors import InputError
from rgbmidic.illumination.images import fill_holes
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage

_GAUSSIAN = np.exp(-(np.arange(-3, 4) ** 2) / 2)
PREFILTERS: dict[str, FloatArray] = {
    "none": np.ones(1),
    # zeros at the carriers (pi, 0), (0, pi), (pi, pi) of the Bayer mosaic
    "binomial": np.array([0.25, 0.5, 0.25]),
    "gaussian": _GAUSSIAN / _GAUSSIAN.sum(),
}
"""One-dimensional prefilters, applied along both axes; ``"gaussian"`` has a standard deviation of 1 px."""


def unmasked(array: npt.ArrayLike) -> AnyArray:
    """Return an array whose masked entries are NaN: as floats where there are any, else of the dtype given."""
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        values: Any = array if array.dtype.kind in "fc" else array.astype(np.float64)
        return np.asarray(np.ma.filled(values, np.nan))
    return np.asarray(array)


def as_light_stack(images: npt.ArrayLike, name: str) -> FloatImage:
    """Images (H, W) or (k, H, W) as a float32 stack (k, H, W).

    Raises
    ------
    InputError
        Another number of axes, not real numbers, or under 8 px in height or width.
    """
    stack = unmasked(images)
    if stack.ndim not in (2, 3) or stack.dtype.kind not in "uif":
        raise InputError(f"{name} must be a real image (H, W) or (k, H, W), not {stack.dtype} of shape {stack.shape}")
    stack = stack if stack.ndim == 3 else stack[None]
    if stack.shape[0] == 0 or min(stack.shape[1:]) < 8:
        last = "; the lights come first: np.moveaxis(images, -1, 0)" if stack.shape[2] < 8 <= stack.shape[1] else ""
        raise InputError(
            f"{name} must have at least one image of at least 8 x 8 px; given is shape {stack.shape}{last}"
        )
    return np.ascontiguousarray(stack, dtype=np.float32)


def apply_prefilter(image: FloatImage, prefilter: str) -> FloatImage:
    """Filter an image (H, W) along both axes with one of `PREFILTERS`.

    Raises
    ------
    InputError
        Unknown filter name.
    """
    taps = _taps(prefilter)
    return np.asarray(cv2.sepFilter2D(image, -1, taps, taps, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _taps(prefilter: str) -> FloatImage:
    if prefilter not in PREFILTERS:
        raise InputError(f"unknown prefilter {prefilter!r}; allowed are {', '.join(PREFILTERS)}")
    return PREFILTERS[prefilter].astype(np.float32)


def filter_variance(prefilter: str) -> np.float32:
    """Variance (square px) of a prefilter along an axis."""
    taps = _taps(prefilter)
    return np.float32((taps * (np.arange(len(taps)) - len(taps) // 2) ** 2).sum())


def usable_reach(prefilter: str) -> int:
    """Pixels to each side that a filtered value and its spline use."""
    return len(PREFILTERS[prefilter]) // 2 + 1


def usable_pixels(valid: BoolArray, prefilter: str) -> BoolArray:
    """Pixels whose filtered value and spline neighbourhood use valid pixels inside the image only."""
    reach = usable_reach(prefilter)
    element = np.ones((2 * reach + 1, 2 * reach + 1), dtype=np.uint8)
    eroded = cv2.erode(valid.view(np.uint8), element, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(eroded).view(bool)


def spline_coefficients(images: FloatImage, prefilter: str = "none") -> FloatImage:
    """Cubic B-spline coefficients of images (k, H, W), holes filled and prefiltered, padded by `PAD` on every side.

    Raises
    ------
    InputError
        Unknown filter name.
    """
    taps = _taps(prefilter)
    out = np.empty((len(images), *(side + 2 * PAD for side in images.shape[1:])), dtype=np.float32)
    for image, coefficients in zip(images, out, strict=True):
        bspline_coefficients(fill_holes(image), coefficients, taps[len(taps) // 2 :])
    return out


def spline_values(coefficients: FloatImage) -> FloatImage:
    """Evaluate the images (k, H, W) at the pixels from the coefficients of their splines."""
    mean = np.array([1, 4, 1], dtype=np.float32) / 6
    return np.stack([cv2.sepFilter2D(spline, -1, mean, mean)[PAD:-PAD, PAD:-PAD] for spline in coefficients])


def centred_products(moments: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Sum f g, f f and g g of what f and g are beyond their means, from moments (..., 6) as of `Residual`, (...)."""
    total, f, g, ff, fg, gg = np.moveaxis(moments, -1, 0)
    total, rounding = np.maximum(total, 1e-30), 2e-7  # three units of single precision
    beyond_f, beyond_g = (
        np.where(deviation > rounding * square, deviation, 0.0)
        for deviation, square in ((ff - f * f / total, ff), (gg - g * g / total, gg))
    )
    return fg - f * g / total, beyond_f, beyond_g


def window_sums(grid: AnyArray, sigma: float) -> AnyArray:
    """Sum a grid (h, w) of blocks in a Gaussian window of `sigma` blocks; beyond the grid there is nothing."""
    return np.asarray(cv2.GaussianBlur(grid, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))


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
        means, weight_means = (np.stack([window_sums(grid, sigma) for grid in grids]) for grids in (totals, weights))
        means /= np.maximum(weight_means, np.float32(1e-6), out=weight_means)
        return np.asarray(means, dtype=np.float32)


WINDOW = SlidingWindow()
"""The window that is used by default."""
