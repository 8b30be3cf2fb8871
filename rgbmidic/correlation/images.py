"""Images prepared for correlation: holes, prefilter, spline, usable pixels."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.splines import PAD, bspline_coefficients
from rgbmidic.errors import InputError
from rgbmidic.illumination.images import fill_holes
from rgbmidic.typing import BoolArray, FloatArray, FloatImage, unmasked

_GAUSSIAN = np.exp(-(np.arange(-3, 4) ** 2) / 2)
PREFILTERS: dict[str, FloatArray] = {
    "none": np.ones(1),
    # zeros at the carriers (pi, 0), (0, pi), (pi, pi) of the Bayer mosaic
    "binomial": np.array([0.25, 0.5, 0.25]),
    "gaussian": _GAUSSIAN / _GAUSSIAN.sum(),
}
"""One-dimensional prefilters, applied along both axes; ``"gaussian"`` has a standard deviation of 1 px."""


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
