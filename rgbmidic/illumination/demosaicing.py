"""From a Bayer mosaic to three channels at every pixel.

Fixed linear filters (Malvar, He, Cutler 2004) and normalisation assume that the channels show one texture. Under
coloured lights that holds where the paint is mat and breaks where one light reflects.

The reflection-aware method measures, block by block, how much of each channel's contrast is common and how much
channel-specific (`rgbmidic.illumination.colour_factors`), and predicts every channel at every pixel from the samples
around with exactly that trust (simple kriging). A channel in a reflection no longer leaks into the others, its sparkle
is kept, the coarse lattices of red and blue are filled from what the others see; a coloured specimen, whose channels
have nothing in common, is reconstructed channel by channel.

The contrast at a site of kind s is ``sum_l A_sl alpha_l (a(y - d_l) + e_l)`` and camera noise
(`rgbmidic.illumination.colour_factors`): common texture a of autocorrelation C, shown displaced by the lens, and
light-specific components e_l. The best linear prediction of a channel at a pixel from the N x N samples around it has
the filter ``(K + V)^-1 k``, with K the covariance of the samples, V their noise and k their covariance with what is
wanted (`rgbmidic.illumination.prediction_filters`). What one light sparkles all channels see by their crosstalk, so
that the samples of all colours say how much of it to take off which.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.demosaicing import TILE, fill_unknown, predict
from rgbmidic._kernels.illumination import PAD, malvar
from rgbmidic.errors import InputError
from rgbmidic.frames.data import cfa_channels, sampled_channels
from rgbmidic.illumination.colour_factors import (
    BLOCK,
    MEAN_BLOCK,
    ColourFactors,
    Moments,
    MosaicModel,
    channel_means,
    colour_factors,
    gather_moments,
    learn_texture,
    local_means,
    normalise_contrast,
    upsample,
    upsample_rows,
)
from rgbmidic.illumination.crosstalk import Crosstalk, required_channels
from rgbmidic.illumination.displacement import LightDisplacement, light_displacement
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic
from rgbmidic.illumination.prediction_filters import FilterTables, Tiles
from rgbmidic.illumination.texture import COLOURED, TextureModel
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


def red_position(cfa: str) -> tuple[int, int]:
    """Return row and column of red in the 2x2 cell of a Bayer pattern."""
    row, column = np.argwhere(cfa_channels(cfa) == 0)[0]
    return int(row), int(column)


def malvar_demosaic(mosaic: LinearMosaic) -> LinearChannels:
    """Bilinear averages corrected by the Laplacian of the channel sampled at the pixel.

    Assumes that the channels share their texture: where a light reflects, that light's sparkle leaks into the others.

    References
    ----------
    H. S. Malvar, L. He, R. Cutler, High-quality linear interpolation for demosaicing of Bayer-patterned color images,
    IEEE ICASSP 2004, figure 2.
    """
    values = np.empty((3, *mosaic.values.shape), dtype=np.float32)
    samples = np.where(mosaic.saturated, np.float32(np.nan), mosaic.values)
    padded = cv2.copyMakeBorder(samples, PAD, PAD, PAD, PAD, cv2.BORDER_REFLECT_101)
    malvar(padded, *red_position(mosaic.cfa), values)
    return LinearChannels(values=values, valid=np.isfinite(values), full_scale=mosaic.full_scale)


def normalised_demosaic(mosaic: LinearMosaic) -> LinearChannels:
    """Channels that show one image: each sample divided by its colour's local mean is the speckle, whatever its colour.

    Each has its own local mean: correlate one of them. With the prefilter [1 2 1] the floor that a demosaicing must
    beat. A channel in a reflection has less contrast and leaves a pattern.
    """
    values = np.where(mosaic.saturated, np.float32(np.nan), mosaic.values)
    level = upsample(channel_means(local_means(values, red_position(mosaic.cfa))), MEAN_BLOCK, values.shape)
    sampled_level = np.take_along_axis(level, sampled_channels(mosaic.cfa, values.shape)[None], axis=0)[0]
    out = level * np.divide(values, sampled_level, out=np.full_like(values, np.nan), where=sampled_level > 0)
    return LinearChannels(values=out, valid=np.isfinite(out), full_scale=mosaic.full_scale)


CONTRADICTED = 1.03
"""Error of samples left out, over that with half of each light its own, from which they contradict a common texture.
Chosen: 1.05 to 1.5 on printed disks, 1.00 on a coin, .2 to .7 on rendered speckle (measured)."""
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
    displacement : LightDisplacement
        Of the lights' textures against each other, on a grid of 8 px.
    model : MosaicModel
        The lights that the factors are of: on a coloured specimen those are the channels.
    """

    channels: LinearChannels
    texture: TextureModel
    factors: ColourFactors
    mean: FloatImage
    displacement: LightDisplacement
    model: MosaicModel


def reconstruct(
    mosaic: LinearMosaic,
    crosstalk: Crosstalk | None = None,
    *,
    registration: Registration | None = None,
    texture: TextureModel | None = None,
    mixing: FloatArray | None = None,
    tables: FilterTables | None = None,
) -> Reconstruction:
    """Predict every channel from all the samples around, each trusted as far as it shows the common texture.

    Parameters
    ----------
    mosaic
        The linearised frame.
    crosstalk
        Distinguishes the sparkle of one light that several channels see from the common texture; None: no crosstalk.
    registration
        Where the lens puts each light's image: samples of another light show the texture displaced; None: they do not.
    texture
        The speckle's autocorrelation; None learns it from the frame. Frames of one test should share one.
    mixing : (n, 3), or None
        Mixtures of the channels to give instead of them; not valid where a channel that matters in one
        (`rgbmidic.illumination.crosstalk.required_channels`) is not.
    tables
        Where the filters of a test are kept; None: they are made anew.

    Returns
    -------
    Reconstruction

    Raises
    ------
    InputError
        The frame is smaller than 64 x 64 px.
    """
    values = mosaic.values
    if min(values.shape) < SMALLEST_FRAME:
        raise InputError(
            f"reflection-aware demosaicing needs at least {SMALLEST_FRAME} x {SMALLEST_FRAME} px to know the "
            f'speckle; the frame has {values.shape[1]} x {values.shape[0]}: use method "malvar"'
        )
    if mosaic.saturated.any():
        values = np.where(mosaic.saturated, np.float32(np.nan), values)
    model, fitted_texture = MosaicModel.of(crosstalk, registration, values.shape), texture
    gather = partial(gather_moments, values, red_position(mosaic.cfa), mosaic.noise, model)
    moments = gather(texture)
    if fitted_texture is None:
        fitted_texture = learn_texture(moments, model)
        if model.displacement.any():  # what the lattices cannot see of displaced lights follows from a first texture
            fitted_texture = learn_texture(gather(fitted_texture), model)
            moments = gather(fitted_texture)
    factors = colour_factors(moments, fitted_texture, model)
    displacement = light_displacement(moments, factors, fitted_texture, model)
    glints = displacement.significant
    if fitted_texture.specific >= COLOURED:
        # a coloured specimen has no texture in common that could tell how the channels see the lights
        model = MosaicModel.of(None, None, values.shape)
        factors = colour_factors(moments, fitted_texture, model)
        displacement, glints = displacement.without_glints, np.zeros_like(glints)
    frame = _Frame(mosaic=mosaic, model=model, moments=moments, factors=factors, glints=_per_tile(glints))
    if texture is None and fitted_texture.specific < COLOURED:
        fitted_texture = replace(fitted_texture, common=frame.shows_common_texture(fitted_texture))
    mixing = np.eye(3) if mixing is None else mixing
    if fitted_texture.common:
        channels = frame.predicted(fitted_texture, mixing, tables)
    else:
        by_channel = malvar_demosaic(mosaic)
        out = np.tensordot(mixing, by_channel.values, axes=1).astype(np.float32)
        valid = np.stack([by_channel.valid[matters].all(axis=0) for matters in required_channels(mixing)])
        channels = LinearChannels(values=out, valid=valid, full_scale=mosaic.full_scale)
    return Reconstruction(
        channels=channels,
        texture=fitted_texture,
        factors=factors,
        mean=moments.channel_mean,
        displacement=displacement,
        model=model,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Frame:
    """A mosaic, and what was found out of it."""

    mosaic: LinearMosaic
    model: MosaicModel
    moments: Moments
    factors: ColourFactors
    glints: FloatArray

    def predicted(
        self, texture: TextureModel, mixing: FloatArray, tables: FilterTables | None = None
    ) -> LinearChannels:
        """Return mixtures of the channels, each predicted from the samples around."""
        rows, columns = shape = self.mosaic.values.shape
        index, taps, size = self._filters(texture, self.factors.light_specific, tables=tables)
        padded, pad = self._contrast(index.shape[1], size), size // 2
        out, valid = np.empty((len(mixing), *shape), dtype=np.float32), np.ones((len(mixing), *shape), dtype=bool)
        if self.mosaic.saturated.any():
            source, unknown = padded.copy(), np.zeros(padded.shape, dtype=bool)
            fill_unknown(source, _per_tile(1 / (1 + self.factors.specific)), *self.moments.red, pad, padded, unknown)
            channel_valid = _validity(
                self.mosaic.saturated, unknown[pad : pad + rows, pad : pad + columns], self.mosaic.cfa
            )
            valid = np.stack([channel_valid[matters].all(axis=0) for matters in required_channels(mixing)])
        scale = upsample_rows(self.factors.spread, BLOCK, columns)
        mean = upsample_rows(self.moments.channel_mean, MEAN_BLOCK, columns)
        predict(padded, index, taps, size, scale, BLOCK, mean, MEAN_BLOCK, mixing.astype(np.float32), out)
        return LinearChannels(values=out, valid=valid, full_scale=self.mosaic.full_scale)

    def shows_common_texture(self, texture: TextureModel) -> bool:
        """Tell whether samples are predicted no worse by the common texture found than if each light had half its own.

        By leaving each sample out in turn (Rasmussen and Williams, Gaussian processes, 2006, section 5.4.2).
        """
        specific = self.factors.light_specific
        half = self._left_out_error(texture, np.maximum(specific, 1.0))
        return self._left_out_error(texture, specific) <= CONTRADICTED * half

    def _left_out_error(self, texture: TextureModel, specific: FloatArray) -> float:
        """Mean square error of samples that are left out, each over its channel's variance."""
        index, taps, size = self._filters(texture, specific, left_out=True)
        padded, pad, (rows, columns) = self._contrast(index.shape[1], size), size // 2, self.mosaic.values.shape
        unit_scale, zero_mean = (np.full((3, 1, columns), level, np.float32) for level in (1, 0))
        out = np.empty((3, rows, columns), dtype=np.float32)
        predict(padded, index, taps, size, unit_scale, rows, zero_mean, rows, np.eye(3, dtype=np.float32), out)
        site = sampled_channels(self.mosaic.cfa, (rows, columns))
        sample = padded[pad : pad + rows, pad : pad + columns]
        difference = np.take_along_axis(out, site[None], axis=0)[0] - sample
        finite = np.isfinite(difference)
        squares = ([(plane[finite & (site == c)] ** 2).sum() for c in range(3)] for plane in (difference, sample))
        return float(sum(error / max(signal, 1e-12) for error, signal in zip(*squares, strict=True)))

    def _filters(
        self,
        texture: TextureModel,
        specific: FloatArray,
        *,
        tables: FilterTables | None = None,
        left_out: bool = False,
    ) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
        """Return the filters for the tiles of lights of a `specific` variance (`FilterTables.find`)."""
        tiles = Tiles(
            specific=_per_tile(specific),
            noise=_per_tile(self.factors.noise),
            displacement=_per_tile(self.model.displacement),
            glints=self.glints,
        )
        tables, fraction = tables or FilterTables(), self.factors.light_fraction
        return tables.find(tiles, texture, self.mosaic.cfa, fraction, left_out=left_out)

    def _contrast(self, tiles: int, size: int) -> FloatImage:
        """Return the samples' contrast over its spread, padded for filters of a side; NaN where saturated."""
        spread = self.factors.spread.astype(np.float32)
        return normalise_contrast(self.moments, np.float32(1) / spread, pad=size // 2, width=tiles * TILE)


def _per_tile(grid: FloatArray) -> FloatArray:
    """Average grids (..., h, w) of blocks over the tiles; the last one may be narrower."""
    ratio = TILE // BLOCK
    missing = [*[(0, 0)] * (grid.ndim - 2), *((0, -side % ratio) for side in grid.shape[-2:])]
    padded = np.pad(grid, missing, mode="edge") if np.any(missing) else grid
    sublattices = [padded[..., row::ratio, column::ratio] for row, column in np.ndindex(ratio, ratio)]
    return np.asarray(sum(sublattices) / ratio**2)


def _validity(saturated: BoolArray, unknown: BoolArray, cfa: str) -> BoolArray:
    """Return where channels are known: not within a pixel of their saturated samples, nor where texture is unknown."""
    site = sampled_channels(cfa, saturated.shape)
    near = np.ones((3, 3), np.uint8)
    wide = cv2.dilate(unknown.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    near_saturated = [cv2.dilate((saturated & (site == c)).astype(np.uint8), near).astype(bool) for c in range(3)]
    return np.stack([~(mask | wide) for mask in near_saturated])
