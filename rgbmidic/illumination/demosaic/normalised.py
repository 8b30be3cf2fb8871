"""No demosaicing: the mosaic divided by each colour's local mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.frames.data import sampled_channels
from rgbmidic.illumination.colour_factors import MEAN_BLOCK, enlarged, local_means
from rgbmidic.illumination.demosaic.base import check_mosaic, red_position
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic

__all__ = ["NormalisedMosaic"]


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalisedMosaic:
    """Each sample divided by its colour's local mean is the speckle, whatever its colour.

    All channels then show one image, each with its own local mean: correlate one of them. With the prefilter [1 2 1]
    the floor that a demosaicing must beat. A channel in a reflection has less contrast and leaves a pattern.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Channels that share one image; see `Demosaicer`."""
        check_mosaic(mosaic)
        saturated = np.asarray(mosaic.saturated, bool)
        values = np.where(saturated, np.float32(np.nan), mosaic.values).astype(np.float32)
        level = enlarged(local_means(values, red_position(mosaic.cfa)), MEAN_BLOCK, values.shape)
        own = np.take_along_axis(level, sampled_channels(mosaic.cfa, values.shape)[None], axis=0)[0]
        out = level * np.divide(values, own, out=np.full_like(values, np.nan), where=own > 0)
        return LinearChannels(values=out, valid=np.isfinite(out), full_scale=mosaic.full_scale)
