"""Weights by a threshold: where a light is bright it reflects, and is excluded (paper, section 3.2).

The paper's second method: blur the image so that the speckle vanishes, and exclude what is brighter than a fraction of
the dynamic range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.typing import FloatImage

__all__ = ["ThresholdWeights", "blurred", "threshold_weights"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ThresholdWeights:
    """One threshold for all lights and frames; a `LightWeights`.

    Attributes
    ----------
    threshold, blur
        As in `threshold_weights`.
    notes
        The threshold, where it was found from the test's own frames.
    """

    threshold: float
    blur: float
    notes: Mapping[str, float] = field(default_factory=dict)

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Binary weights (k, H, W)."""
        return threshold_weights(images, threshold=self.threshold, blur=self.blur)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Binary weights (k, H, W)."""
        return threshold_weights(images, threshold=self.threshold, blur=self.blur)


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
