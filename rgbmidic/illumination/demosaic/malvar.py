"""Demosaicing by fixed linear filters: Malvar, He and Cutler (2004)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic._kernels.demosaic import PAD, malvar, pad_mosaic
from rgbmidic.illumination.demosaic.base import check_mosaic, red_position
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic
from rgbmidic.typing import FloatImage

__all__ = ["MalvarDemosaicer"]


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
        check_mosaic(mosaic)
        values = np.empty((3, *mosaic.values.shape), dtype=np.float32)
        malvar(_padded(mosaic), *red_position(mosaic.cfa), values)
        return LinearChannels(values=values, valid=np.isfinite(values), full_scale=mosaic.full_scale)


def _padded(mosaic: LinearMosaic) -> FloatImage:
    """The mosaic (H + 4, W + 4), mirrored about its border pixels, NaN where saturated."""
    rows, columns = mosaic.values.shape
    padded = np.empty((rows + 2 * PAD, columns + 2 * PAD), dtype=np.float32)
    pad_mosaic(np.ascontiguousarray(mosaic.values, dtype=np.float32), np.asarray(mosaic.saturated, bool), padded)
    return padded
