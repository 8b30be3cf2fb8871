"""Local normalisation: each light's image divided by its local mean.

A body that turns under fixed lights grows brighter or darker smoothly, and a reflection lifts the mean; dividing by
the local mean leaves the texture, which is what moves with the surface.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic._kernels.texture import divide_by_mean
from rgbmidic.errors import InputError
from rgbmidic.typing import FloatImage

__all__ = ["DARK", "local_mean", "normalise"]


DARK = 0.01
"""A light whose local mean is below this share of the full scale does not see the surface there."""
_WIDE = 4.0
"""Standard deviation (px) from which the mean is taken in an image of half the size."""
_RESIZED = 1 / 4 + 2 / 3
"""Variance (square px) that the mean of two pixels and the interpolation between such means add."""


def normalise(images: FloatImage, sigma: float, full_scale: float) -> FloatImage:
    """Divide images (k, H, W) by their local mean; NaN where invalid or dark.

    Parameters
    ----------
    images
        Grey levels above black; NaN marks invalid pixels.
    sigma
        Standard deviation of the Gaussian window in px, several speckles wide.
    full_scale
        Grey level of a just saturated sample; sets what counts as dark (`DARK`).

    Raises
    ------
    InputError
        `sigma` is not positive.
    """
    if not sigma > 0:
        raise InputError(f"the width of the local mean must be positive, not {sigma!r} px")
    out, dark = np.empty_like(images), np.float32(DARK * full_scale)
    for image, normalised in zip(images, out, strict=True):
        if sigma < _WIDE or not np.isfinite(image).all():
            divide_by_mean(image, local_mean(image, sigma), 1, dark, normalised)
        else:
            divide_by_mean(image, _half_blur(image, sigma), 2, dark, normalised)
    return out


def local_mean(image: FloatImage, sigma: float) -> FloatImage:
    """Gaussian mean (H, W) of the finite pixels around each pixel; NaN where there is none."""
    finite = np.isfinite(image)
    if finite.all():
        return _blur(image, sigma)
    weight = _blur(finite.astype(np.float32), sigma)
    total = _blur(np.where(finite, image, np.float32(0)), sigma)
    return np.where(weight > 1e-3, total / np.maximum(weight, np.float32(1e-3)), np.float32(np.nan))


def _blur(image: FloatImage, sigma: float) -> FloatImage:
    """Gaussian mean of an image (H, W)."""
    if sigma < _WIDE:
        return _gaussian(image, sigma)
    half = _half_blur(image, sigma)
    return np.asarray(cv2.resize(half, (half.shape[1], 2 * len(half)), interpolation=cv2.INTER_LINEAR)[: len(image)])


def _half_blur(image: FloatImage, sigma: float) -> FloatImage:
    """Gaussian mean of each two rows, from an image of half the size: as good, at a sixth of the time."""
    height, width = image.shape
    odd = height % 2, width % 2
    even = cv2.copyMakeBorder(image, 0, odd[0], 0, odd[1], cv2.BORDER_REPLICATE) if any(odd) else image
    half = cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA)
    blurred = _gaussian(np.asarray(half), np.sqrt(sigma**2 - _RESIZED) / 2)
    wide = cv2.resize(blurred, (even.shape[1], len(half)), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(wide[:, :width])


def _gaussian(image: FloatImage, sigma: float) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
