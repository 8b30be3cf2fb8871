"""Demosaicing that survives reflections: the speckle's own statistics fill in what a colour did not sample.

Usual methods assume that the three channels show one texture. Under coloured lights that holds where the paint is mat
and breaks where one light reflects. Here it is measured, block by block, how much of each channel's contrast is common
and how much its own (`rgbmidic.illumination.colour_factors`), and every channel is predicted from all the samples
around with exactly that trust (`rgbmidic.illumination.demosaic.prediction`). A channel in a reflection no longer leaks
into the others, its own sparkle is kept, the coarse lattices of red and blue are filled from what the others see; a
coloured specimen, whose channels have nothing in common, is reconstructed channel by channel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic._kernels.kriging import TILE, fill_unknown, predict
from rgbmidic.errors import InputError
from rgbmidic.frames.data import sampled_channels
from rgbmidic.illumination.colour_factors import (
    BLOCK,
    MEAN_BLOCK,
    ColourFactors,
    Moments,
    colour_factors,
    gather_moments,
    learn_texture,
    scaled,
    widened,
)
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.demosaic.base import check_mosaic, red_position
from rgbmidic.illumination.demosaic.prediction import SIZE, WIDE, FilterTable, prediction_filters
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.illumination.unmix import needed
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["SMALLEST_FRAME", "Reconstruction", "ReflectionAwareDemosaicer"]


SMALLEST_FRAME = 64
"""Rows and columns under which a frame holds too few speckles for statistics."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconstruction:
    """Channels with all that was found out on the way.

    Attributes
    ----------
    channels : LinearChannels
        (3, H, W), or the mixtures of them that were asked for.
    texture : TextureModel
        The one used: given, or learnt from the frame.
    factors : ColourFactors
        How each channel sees the texture, on a grid of 8 px.
    mean : (3, h, w) float32
        Local mean of each channel on a grid of 4 px.
    """

    channels: LinearChannels
    texture: TextureModel
    factors: ColourFactors
    mean: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class ReflectionAwareDemosaicer:
    """Predicts every channel from all the samples around, each trusted as far as it shows the common texture.

    Attributes
    ----------
    crosstalk : Crosstalk or None
        Lets the sparkle of one light that several channels see be told from the common texture; None: no crosstalk.
    texture : TextureModel or None
        The speckle's autocorrelation; None learns it from each frame. Frames of one test should share one.
    """

    crosstalk: Crosstalk | None = None
    texture: TextureModel | None = None

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Demosaic; see `Demosaicer`."""
        return self.reconstruct(mosaic).channels

    def reconstruct(self, mosaic: LinearMosaic, mixing: FloatArray | None = None) -> Reconstruction:
        """Demosaic and tell what was found out.

        Parameters
        ----------
        mosaic
            The linearised frame.
        mixing : (n, 3), or None
            Mixtures of the channels to give instead of them; not valid where a channel that matters in one
            (`rgbmidic.illumination.unmix.needed`) is not.

        Raises
        ------
        InputError
            The frame is smaller than 64 x 64 px.
        """
        check_mosaic(mosaic)
        if min(mosaic.values.shape) < SMALLEST_FRAME:
            raise InputError(
                f"reflection-aware demosaicing needs at least {SMALLEST_FRAME} x {SMALLEST_FRAME} px to know the "
                f'speckle; the frame has {mosaic.values.shape[1]} x {mosaic.values.shape[0]}: use method "malvar"'
            )
        saturated = np.asarray(mosaic.saturated, dtype=bool)
        values = np.ascontiguousarray(mosaic.values, dtype=np.float32)
        damaged = bool(saturated.any())
        if damaged:
            values = np.where(saturated, np.float32(np.nan), values)
        moments = gather_moments(values, red_position(mosaic.cfa), mosaic.noise)
        texture = learn_texture(moments) if self.texture is None else self.texture
        matrix = np.eye(3) if self.crosstalk is None else self.crosstalk.matrix
        factors = colour_factors(moments, texture.band, matrix, coloured=texture.private)
        table = _filters(factors, texture, mosaic.cfa)
        mixing = np.eye(3) if mixing is None else mixing
        out, unknown = _predict(moments, factors, table, mixing, damaged=damaged)
        valid = np.ones(out.shape, dtype=bool)
        if damaged:
            known = _validity(saturated, unknown, mosaic.cfa)
            valid = np.stack([known[matters].all(axis=0) for matters in needed(mixing)])
        channels = LinearChannels(values=out, valid=valid, full_scale=mosaic.full_scale)
        return Reconstruction(channels=channels, texture=texture, factors=factors, mean=moments.mean)


def _filters(factors: ColourFactors, texture: TextureModel, cfa: str) -> FilterTable:
    noise = np.median(factors.noise / (1 + factors.private), axis=(1, 2))
    # a colour left to itself has only every other sample, so it needs to look farther
    size = SIZE if texture.private < 0.5 else WIDE
    return prediction_filters(_per_tile(factors.private), noise, texture, cfa, size=size)


def _per_tile(grid: FloatArray) -> FloatArray:
    """Mean of a grid of blocks over the tiles; the last one may be narrower."""
    ratio = TILE // BLOCK
    missing = [(0, 0), *((0, -side % ratio) for side in grid.shape[1:])]
    padded = np.pad(grid, missing, mode="edge") if np.any(missing) else grid
    parts = [padded[:, row::ratio, column::ratio] for row, column in np.ndindex(ratio, ratio)]
    return np.asarray(sum(parts) / ratio**2)


def _predict(
    moments: Moments, factors: ColourFactors, table: FilterTable, mixing: FloatArray, *, damaged: bool
) -> tuple[FloatImage, BoolArray]:
    """Mixtures (n, H, W) of the channels and where samples stayed unknown (H, W)."""
    spread, pad = factors.spread.astype(np.float32), table.size // 2
    padded = scaled(moments, np.float32(1) / spread, pad=pad, width=table.index.shape[1] * TILE)
    rows, columns = moments.contrast.shape
    unknown = np.zeros(padded.shape, dtype=bool)
    if damaged:
        source = padded.copy()
        fill_unknown(source, _per_tile(factors.share), *moments.red, pad, padded, unknown)
    out = np.empty((len(mixing), rows, columns), dtype=np.float32)
    scale, mean = widened(spread, BLOCK, columns), widened(moments.mean, MEAN_BLOCK, columns)
    mixing = mixing.astype(np.float32)
    predict(padded, table.index, table.taps, table.size, scale, BLOCK, mean, MEAN_BLOCK, mixing, out)
    return out, unknown[pad : pad + rows, pad : pad + columns]


def _validity(saturated: BoolArray, unknown: BoolArray, cfa: str) -> BoolArray:
    """A channel is not known within a pixel of its own saturated samples, none where the texture is not known."""
    site = sampled_channels(cfa, saturated.shape)
    near = np.ones((3, 3), np.uint8)
    wide = cv2.dilate(unknown.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    own = [cv2.dilate((saturated & (site == c)).astype(np.uint8), near).astype(bool) for c in range(3)]
    return np.stack([~(mask | wide) for mask in own])
