"""Weights p_j of the lights: where each light reflects, it is excluded (paper, section 3.2).

The paper's second method: blur the image so that the speckle vanishes, and exclude what is brighter than a fraction of
the dynamic range. The weight of a pixel is the product of its weight in the reference image and in the deformed image
at the place the pixel has moved to; the solve brings the latter back.
"""

from __future__ import annotations

import cv2
import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.settings import WeightSettings
from rgbmidic.typing import FloatImage

__all__ = ["blurred", "light_weights", "threshold_weights"]


def light_weights(images: IlluminationImages, settings: WeightSettings) -> FloatImage:
    """Weights (k, H, W) in [0, 1] of one state by the method of `settings`; 0 where an image is not valid.

    Only the threshold acts on the images: statistics come from the residual, in the solve, and geometry from a scene.

    Raises
    ------
    InputError
        The threshold is ``"auto"``: it must be found first (`rgbmidic.lab.study.automatic_threshold`).
    """
    if settings.method != "threshold":
        return images.valid.astype(np.float32)
    if isinstance(settings.threshold, str):
        raise InputError('weights.threshold is "auto": it must be found from two states before it can be applied')
    return threshold_weights(images, threshold=settings.threshold, blur=settings.blur)


def threshold_weights(images: IlluminationImages, *, threshold: float = 2 / 3, blur: float = 10.0) -> FloatImage:
    """Binary weights: 0 where the blurred image exceeds a fraction of the dynamic range, 1 elsewhere.

    Parameters
    ----------
    images
        Illumination images of one state, shape (k, H, W).
    threshold
        Fraction of the camera's dynamic range (`images.full_scale`); the paper finds and uses 2/3.
    blur
        Standard deviation of the Gaussian blur in px, several speckles wide.

    Returns
    -------
    ndarray, shape (k, H, W), float32
        Invalid (saturated) pixels count as full scale in the blur and have weight 0.
    """
    limit = threshold * images.full_scale
    bright = blurred(images, blur) > limit
    return (images.valid & ~bright).astype(np.float32)


def blurred(images: IlluminationImages, blur: float) -> FloatImage:
    """Gaussian blur (k, H, W) of each light's image, invalid pixels taken as full scale."""
    filled = np.where(images.valid, images.values, np.float32(images.full_scale))
    return np.stack([cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REFLECT_101) for image in filled])
