"""Every colour from its own lattice alone: no leak between colours, at the price of their coarse sampling."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from rgbmidic._kernels.kriging import TILE, predict
from rgbmidic._kernels.texture import scaled_contrast, subtract_mean
from rgbmidic.errors import InputError
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.colour_factors import BLOCK, MEAN_BLOCK, local_means
from rgbmidic.illumination.demosaic.base import check_mosaic, red_position
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic
from rgbmidic.typing import BoolArray, FloatImage

__all__ = ["BandLimitedDemosaicer", "NormalisedMosaic"]


_SIZE = 11
"""Side of the square of samples of the band-limited reconstruction."""
_WIDTHS = (3.0, 2.0, 3.0)
"""Standard deviation (px) of the autocorrelation for which the filters are the best: to 1 % exact up to 0.9 rad/px for
red and blue, 1.3 rad/px for green, as far as 11 x 11 px can be."""
_NOISE = 1e-4
"""Noise, relative to the texture: bounds the amplification at the edge of the band."""
_OFFSET = 10.0
"""Variance of an unknown constant: a grey field stays as it is."""
_REACH = 5
"""Side of the square within which a saturated sample spoils a value; farther ones enter with a few per cent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BandLimitedDemosaicer:
    """The linear reconstruction of what each colour's own lattice resolves, from 11 x 11 px.

    Nothing leaks between the colours. Texture beyond their band folds back as a pattern that stands still while the
    specimen moves and pulls displacements towards whole pixels: it needs a coarse speckle.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Demosaic; see `Demosaicer`. Frames of at least 16 x 16 px."""
        check_mosaic(mosaic)
        rows, columns = mosaic.values.shape
        if min(rows, columns) < 16:
            raise InputError(f"a band-limited reconstruction needs at least 16 x 16 px, not {columns} x {rows}")
        red, saturated = red_position(mosaic.cfa), np.asarray(mosaic.saturated, bool)
        values = np.where(saturated, np.float32(np.nan), mosaic.values).astype(np.float32)
        mean = local_means(values, red)
        contrast = _contrast(values, mean, red)
        contrast[saturated] = 0
        height, width = (-(-side // TILE) for side in values.shape)
        unit = np.ones((3, -(-rows // BLOCK), -(-columns // BLOCK)), dtype=np.float32)
        pad = _SIZE // 2
        padded = np.empty((rows + 2 * pad, width * TILE + 2 * pad), dtype=np.float32)
        scaled_contrast(contrast, unit, *red, BLOCK, pad, padded)
        out = np.empty((3, rows, columns), dtype=np.float32)
        index = np.zeros((height, width), dtype=np.int32)
        predict(padded, index, _band_filters(mosaic.cfa), _SIZE, unit, BLOCK, mean, MEAN_BLOCK, out)
        valid = _validity(saturated, mosaic.cfa)
        return LinearChannels(
            values=np.where(valid, out, np.float32(np.nan)),
            valid=valid,
            full_scale=mosaic.full_scale,
            noise=mosaic.noise,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalisedMosaic:
    """No demosaicing: each sample divided by its colour's local mean is the texture, whatever its colour.

    All channels then show one texture, each with its own local mean: correlate one of them. With the prefilter [1 2 1]
    the floor that a demosaicing must beat. A channel in a reflection has less contrast and leaves a pattern.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels:
        """Channels that share one texture; see `Demosaicer`."""
        check_mosaic(mosaic)
        red, saturated = red_position(mosaic.cfa), np.asarray(mosaic.saturated, bool)
        values = np.where(saturated, np.float32(np.nan), mosaic.values).astype(np.float32)
        mean = local_means(values, red)
        rows, columns = values.shape
        level = np.stack([_expanded(grid, rows, columns) for grid in mean])
        site = np.tile(cfa_channels(mosaic.cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]
        own = np.take_along_axis(level, site[None], axis=0)[0]
        texture = np.divide(values, own, out=np.full_like(values, np.nan), where=own > 0)
        out = level * texture
        return LinearChannels(values=out, valid=np.isfinite(out), full_scale=mosaic.full_scale, noise=mosaic.noise)


def _contrast(values: FloatImage, mean: FloatImage, red: tuple[int, int]) -> FloatImage:
    out = np.empty_like(values)
    subtract_mean(values, mean, *red, MEAN_BLOCK, out)
    return out


def _expanded(grid: FloatImage, rows: int, columns: int) -> FloatImage:
    size = (grid.shape[1] * MEAN_BLOCK, grid.shape[0] * MEAN_BLOCK)
    return np.asarray(cv2.resize(grid, size, interpolation=cv2.INTER_LINEAR)[:rows, :columns])


def _validity(saturated: BoolArray, cfa: str) -> BoolArray:
    if not saturated.any():
        return np.ones((3, *saturated.shape), dtype=bool)
    rows, columns = saturated.shape
    site = np.tile(cfa_channels(cfa), (-(-rows // 2), -(-columns // 2)))[:rows, :columns]
    near = np.ones((_REACH, _REACH), np.uint8)
    return np.stack([cv2.dilate((saturated & (site == c)).astype(np.uint8), near) == 0 for c in range(3)])


@lru_cache(maxsize=8)
def _band_filters(cfa: str) -> FloatImage:
    """Filters (1, 2, 3, size², TILE) by row parity, channel and tap; the coefficients of each sum to one."""
    cell, offset = cfa_channels(cfa), np.arange(_SIZE) - _SIZE // 2
    points = np.stack(np.meshgrid(offset, offset, indexing="ij"), -1).reshape(-1, 2)
    taps = np.zeros((2, 2, 3, _SIZE**2))
    for p, q in np.ndindex(2, 2):
        channel = cell[np.ix_((offset + p) % 2, (offset + q) % 2)].ravel()
        for colour in range(3):
            mine = np.flatnonzero(channel == colour)
            apart = np.linalg.norm(points[mine][:, None] - points[mine][None], axis=-1)
            distance, width = np.linalg.norm(points[mine], axis=-1), _WIDTHS[colour]
            covariance = np.exp(-0.5 * (apart / width) ** 2) + _OFFSET + _NOISE * np.eye(len(mine))
            solution = np.linalg.solve(covariance, np.exp(-0.5 * (distance / width) ** 2) + _OFFSET)
            taps[p, q, colour, mine] = solution / solution.sum()
    return np.tile(taps.transpose(0, 2, 3, 1), TILE // 2)[None].astype(np.float32)
