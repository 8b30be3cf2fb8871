"""Local contrast of the images of the lights, and where none of them shows the specimen.

What lies in the dark, such as the background beside a specimen, is told from paint that reflects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic.illumination.images import DARK, IlluminationImages, local_mean
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.typing import BoolArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class ContrastConstants:
    """Constants of the local contrast.

    Attributes
    ----------
    contrast_widths
        Least and largest standard deviation (px) of the window in which the lights' local contrast is taken.
    speckles
        Of the window's standard deviation in between, in speckle sizes.
    blind
        Fraction of the usual contrast that no light reaches where the specimen cannot be seen; chosen.
    shade
        Fraction of the brightness of the brightest tenth below which an image is dark. Chosen: the background of the
        DIC Challenge's open-hole specimen has 0.1; the parts of a specimen that are lit less keep their contrast.
    max_hidden_fraction
        Fraction of the region that no light shows from which a warning is given; chosen.
    """

    contrast_widths: tuple[float, float] = (10.0, 40.0)
    speckles: float = 2.5
    blind: float = 0.5
    shade: float = 0.25
    max_hidden_fraction: float = 0.01


CONTRAST = ContrastConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalContrast:
    """Local statistics of the lights.

    Those of what is lit and of what lies in the dark, such as the background beside a specimen, are taken apart: the
    edge between them is no texture.

    Attributes
    ----------
    level : ndarray, shape (k, H, W), float32
        Local mean, DN.
    contrast : ndarray, shape (k, H, W), float32
        Local standard deviation in units of that mean, 0 where the light is dark or unknown.
    bright : ndarray, shape (k, H, W), bool
        Where the paint around is as bright as in the rest of the image.
    """

    level: FloatImage
    contrast: FloatImage
    bright: BoolArray

    @classmethod
    def of(
        cls, images: IlluminationImages, speckles: Sequence[float], inside: BoolArray, noise: NoiseModel | None
    ) -> LocalContrast:
        """Statistics in windows that hold many speckles, of which the sizes (px) are known or NaN, for a region.

        In the dark, where it would look like texture, camera noise is subtracted; where it is not known, half of the
        mean square difference of neighbouring pixels, which is most of noise and little of speckle.
        """
        sizes = [size for size in speckles if np.isfinite(size)]
        size = CONTRAST.speckles * np.median(sizes) if sizes else 0.0
        window = float(np.clip(size, *CONTRAST.contrast_widths))
        level, contrast = np.zeros((2, *images.values.shape), dtype=np.float32)
        is_bright = np.zeros(images.values.shape, dtype=bool)
        closing = np.ones((round(window), round(window)), dtype=np.uint8)  # wider than dark speckle
        for image, mean, relative, bright in zip(images.values, level, contrast, is_bright, strict=True):
            filled = np.nan_to_num(image, nan=images.full_scale)  # what is not known is saturated
            paint = cv2.morphologyEx(filled, cv2.MORPH_CLOSE, closing)
            bright[:] = paint >= CONTRAST.shade * np.quantile(paint[inside], 0.9)
            core = cv2.erode((~bright).astype(np.uint8), closing) > 0  # without the blurred rim of what is lit
            for region, sampled in ((bright, bright), (~bright, core)):
                if not region.any():
                    continue
                values = np.where(sampled, image, np.float32(np.nan))
                mean[region] = np.nan_to_num(local_mean(values, window))[region]
                square = local_mean(values**2, window)
                usable = region & np.isfinite(image) & (mean > DARK * images.full_scale)
                variance = square[usable] - mean[usable] ** 2
                if sampled is core and noise is None:
                    steps = np.diff(values, axis=1, append=np.float32(np.nan))
                    variance -= local_mean(steps**2, window)[usable] / 2
                elif sampled is core and noise is not None:
                    variance -= noise.variance(mean[usable])
                relative[usable] = np.sqrt(np.maximum(variance, 0)) / mean[usable]
        return cls(level=level, contrast=contrast, bright=is_bright)

    def low_contrast(self, inside: BoolArray) -> BoolArray:
        """Return a mask (H, W) of pixels where no light has half the contrast usual in the lit part of `inside`."""
        best, bright_region = self.contrast.max(axis=0), inside & self.bright.any(axis=0)
        return np.asarray(
            best < CONTRAST.blind * np.quantile(best[bright_region if bright_region.any() else inside], 0.9)
        )

    def background(self, inside: BoolArray) -> BoolArray:
        """Return the mask (H, W) of pixels with neither texture nor light: nothing can be measured."""
        return np.asarray(self.low_contrast(inside) & ~self.bright.any(axis=0))
