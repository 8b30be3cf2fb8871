"""All lights on the pixel grid of the first: lateral colour registration undone.

Light j sees at x + rho_j(x) what the first light sees at x (`Registration`), in the reference and in the deformed state
alike; sampled there, its image shows every point where the first light's image shows it, before and after.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from rgbmidic._kernels.interpolation import PAD, bspline_coefficients, sample_with_gradient
from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.normalise import local_mean
from rgbmidic.illumination.registration import Registration
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["align"]


_NEGLIGIBLE = 0.002
"""A light that is nowhere farther than this (px) from the first is left as it is."""


def align(images: IlluminationImages, registration: Registration) -> IlluminationImages:
    """Bring every light to the first one's pixels by cubic B-spline interpolation.

    Pixels whose neighbourhood of interpolation is invalid or outside the image become invalid.

    Raises
    ------
    CalibrationError
        The registration is for other lights.
    """
    if registration.lights != images.names:
        raise CalibrationError(
            f"the registration is for the lights {', '.join(registration.lights)}, the images are of "
            f"{', '.join(images.names)}"
        )
    height, width = images.shape
    y, x = np.mgrid[:height, :width].reshape(2, -1).astype(np.float64)
    shifts = registration.displacement(np.stack([x, y], axis=1))
    values = images.values.copy()
    for light, shift in enumerate(shifts):
        if np.abs(shift).max() > _NEGLIGIBLE:
            values[light] = _sample(images.values[light], x + shift[:, 0], y + shift[:, 1])
    return replace(images, values=values, valid=np.isfinite(values))


def _sample(image: FloatImage, x: FloatArray, y: FloatArray) -> FloatImage:
    """Image (H, W) at points (x, y), flat; NaN outside and where the interpolation would touch a NaN."""
    height, width = image.shape
    valid = np.isfinite(image)
    filled = np.where(valid, image, np.nan_to_num(local_mean(image, 3.0), nan=float(np.nanmean(image))))
    coefficients = np.empty((height + 2 * PAD, width + 2 * PAD), dtype=np.float32)
    bspline_coefficients(np.ascontiguousarray(filled, dtype=np.float32), coefficients)
    value, slope_x, slope_y = np.empty((3, x.size), dtype=np.float32)
    sample_with_gradient(coefficients, x, y, value, slope_x, slope_y)
    touched = cv2.erode(valid.astype(np.uint8), np.ones((5, 5), np.uint8), borderValue=1).astype(bool)
    column = np.clip(np.round(x), 0, width - 1).astype(np.intp)
    row = np.clip(np.round(y), 0, height - 1).astype(np.intp)
    usable = touched[row, column] & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.where(usable, value, np.float32(np.nan)).reshape(image.shape)
