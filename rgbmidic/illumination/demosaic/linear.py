"""Demosaicing by fixed linear filters: bilinear, and Malvar, He and Cutler (2004)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbmidic._kernels import demosaic as kernels
from rgbmidic.illumination.demosaic.base import check_mosaic, padded_mosaic, red_position
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic

__all__ = ["BilinearDemosaicer", "MalvarDemosaicer"]


@dataclass(frozen=True, slots=True, kw_only=True)
class BilinearDemosaicer:
    """A missing channel is the average of its two or four nearest samples.

    No colour leaks into another, but the filter blurs and the blur differs from pixel to pixel: the sensor-fixed
    pattern this leaves pulls displacements towards whole pixels. For comparison, not for measuring.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Demosaic; see `Demosaicer`."""
        return _filtered(mosaic, kernels.bilinear)


@dataclass(frozen=True, slots=True, kw_only=True)
class MalvarDemosaicer:
    """Bilinear averages corrected by the Laplacian of the channel sampled at the pixel.

    Assumes that the channels share their texture: where a light reflects, that light's sparkle leaks into the others.

    References
    ----------
    H. S. Malvar, L. He, R. Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images,
    IEEE ICASSP 2004, figure 2.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Demosaic; see `Demosaicer`."""
        return _filtered(mosaic, kernels.malvar)


def _filtered(mosaic: LinearMosaic, kernel: Callable[..., Any]) -> LinearChannels:
    check_mosaic(mosaic)
    values = np.empty((3, *mosaic.values.shape), dtype=np.float32)
    kernel(padded_mosaic(mosaic), *red_position(mosaic.cfa), values)
    return LinearChannels(values=values, valid=np.isfinite(values), full_scale=mosaic.full_scale, noise=mosaic.noise)
