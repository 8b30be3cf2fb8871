"""From a Bayer mosaic to three channels at every pixel.

Fixed linear filters (Malvar, He, Cutler 2004) and normalisation assume that the channels show one texture. Under
coloured lights that holds where the paint is mat and breaks where one light reflects.

The reflection-aware method measures, block by block, how much of each channel's contrast is common and how much
channel-specific (`rgbmidic.illumination.colour_factors`), and predicts every channel at every pixel from the samples
around with exactly that trust (simple kriging). A channel in a reflection no longer leaks into the others, its sparkle
is kept, the coarse lattices of red and blue are filled from what the others see; a coloured specimen, whose channels
have nothing in common, is reconstructed channel by channel.

The contrast of channel c, divided by its own spread, is ``sqrt(s_c) a + sqrt(1 - s_c) e_c + n_c``: common texture a of
autocorrelation C, channel-specific component e_c, and camera noise, with s_c the fraction of the common texture. The
best linear prediction of a channel at a pixel from the N x N samples around it has the filter ``(K + V)^-1 k``, with K
the covariance of the samples, V their noise and k their covariance with what is wanted. It depends on the pixel's phase
in the 2x2 cell and on the three fractions alone, so the filters of a frame are a small table. What one light sparkles
all channels see by their crosstalk: the components e_c of two channels go together as ``A V A^T`` of the lights'
variances V, so that the samples of all colours say how much of it to take off which.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.demosaicing import TILE, fill_unknown, predict, prediction_taps
from rgbmidic._kernels.illumination import PAD, malvar
from rgbmidic.errors import InputError
from rgbmidic.frames.data import cfa_channels, sampled_channels
from rgbmidic.illumination.colour_factors import (
    BLOCK,
    MEAN_BLOCK,
    ColourFactors,
    SiteModel,
    channel_means,
    colour_factors,
    enlarged,
    gather_moments,
    learn_texture,
    local_means,
    scaled,
    widened,
)
from rgbmidic.illumination.crosstalk import Crosstalk, needed
from rgbmidic.illumination.displacement import LightDisplacement, light_displacement, seen_lights
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic
from rgbmidic.illumination.texture import TextureModel
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
    known = np.where(mosaic.saturated, np.float32(np.nan), mosaic.values)
    padded = cv2.copyMakeBorder(known, PAD, PAD, PAD, PAD, cv2.BORDER_REFLECT_101)
    malvar(padded, *red_position(mosaic.cfa), values)
    return LinearChannels(values=values, valid=np.isfinite(values), full_scale=mosaic.full_scale)


def normalised_demosaic(mosaic: LinearMosaic) -> LinearChannels:
    """Channels that show one image: each sample divided by its colour's local mean is the speckle, whatever its colour.

    Each has its own local mean: correlate one of them. With the prefilter [1 2 1] the floor that a demosaicing must
    beat. A channel in a reflection has less contrast and leaves a pattern.
    """
    values = np.where(mosaic.saturated, np.float32(np.nan), mosaic.values)
    level = enlarged(channel_means(local_means(values, red_position(mosaic.cfa))), MEAN_BLOCK, values.shape)
    own = np.take_along_axis(level, sampled_channels(mosaic.cfa, values.shape)[None], axis=0)[0]
    out = level * np.divide(values, own, out=np.full_like(values, np.nan), where=own > 0)
    return LinearChannels(values=out, valid=np.isfinite(out), full_scale=mosaic.full_scale)


SIZE, WIDE = 5, 7
"""Side of the square of samples that a value is predicted from, and where the colours have nothing in common."""
LARGEST, SMALLEST = 10, int(__import__('os').environ.get('SM','-10'))
"""Range (powers of two, to which it is rounded) of the channel-specific variance relative to the common one: beyond it
weights are 0 or 1, and twice as fine measures the same."""
OFFSET_VARIANCE = 10.0
"""Variance of an unknown constant under the texture: makes the filter's coefficients sum to one."""
SPARKLE_VARIANCE = 0.29
"""Variance (px²) of the aperture through which sparkle is seen: a square pixel, 1/12, and a lens blur of 0.45 px."""
DISPLACEMENT_STEP, _MOST_STEPS = float(__import__("os").environ.get("PSTEP", "0.02")), 32
"""Fineness (px) in which a light's displacement is rounded, and the most steps of it."""
DISSIMILAR = 1.0
"""Fall (1/px²) of the logarithm of two lights' correlation with the square of their distance: a glint on a droplet's
flank is not the displaced texture alone. With 2 and 4 the error on raised droplets is 2 and 4 % larger at 8 degrees
(benchmarks/reflections.py)."""


def prediction_filters(
    specific: FloatArray,
    noise: FloatArray,
    texture: TextureModel,
    cfa: str,
    *,
    seen: FloatArray,
    displacement: FloatArray,
    alike: FloatArray,
) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
    tiles = specific.shape[1:]
    lights = len(specific)
    size = SIZE if texture.specific < 0.5 else WIDE
    if PSIZE:
        size = PSIZE
    level = np.round(np.log2(np.clip(specific, 2.0**SMALLEST, 2.0**LARGEST))).astype(np.int64)
    steps = np.round(displacement / DISPLACEMENT_STEP).astype(np.int64)
    code = np.concatenate([level, steps.reshape(-1, *tiles), np.round(100 * alike).astype(np.int64).reshape(-1, *tiles)]).reshape(-1, tiles[0]*tiles[1])
    _, first, index, number = np.unique(code, axis=1, return_index=True, return_inverse=True, return_counts=True)
    index = index.ravel()
    variance: FloatArray = np.exp2(level.reshape(lights, -1).T[first].astype(np.float64))
    moved = DISPLACEMENT_STEP * np.moveaxis(steps.reshape(*steps.shape[:2], -1)[..., first], -1, 0)
    noisy = np.stack([np.bincount(index, one) for one in noise.reshape(3, -1)], axis=1) / number[:, None]
    channels = np.stack([seen[0], (seen[1] + seen[2]) / 2, seen[3]])
    spread = np.sqrt(1 + variance @ (channels**2).T)
    noisy = noisy / spread**2
    offset, phases = np.arange(size) - size // 2, list(np.ndindex(2, 2))
    sites = np.stack([site_classes(cfa)[np.ix_((offset + p) % 2, (offset + q) % 2)] for p, q in phases])
    taps = np.empty((len(variance), 4, 3, size, size))
    prediction_taps(
        np.ascontiguousarray(seen, dtype=np.float64),
        np.ascontiguousarray(spread[:, [0, 1, 1, 2]]),
        variance,
        texture.specific,
        np.ascontiguousarray(np.moveaxis(alike.reshape(lights, lights, -1)[..., first], -1, 0)),
        np.ascontiguousarray(moved.astype(np.float64)),
        np.maximum(noisy, 1e-8),
        *_covariances(texture, size),
        OFFSET_VARIANCE,
        sites.astype(np.int64),
        taps,
    )
    by_parity = taps.reshape(-1, 2, 2, 3, size * size).transpose(0, 1, 3, 4, 2)
    return index.reshape(tiles).astype(np.int32), np.ascontiguousarray(by_parity, dtype=np.float32), size


import os
PSIZE = int(os.environ.get("PSIZE", 0))

def site_classes(cfa):
    """0 R, 1 G in red rows, 2 G in blue rows, 3 B of the 2x2 cell."""
    channel = cfa_channels(cfa)
    red_row = np.argwhere(channel == 0)[0][0]
    out = np.array([[0, 1, 3][c] for c in channel.ravel()]).reshape(2, 2)
    out[1 - red_row][out[1 - red_row] == 1] = 2
    return out


@lru_cache(maxsize=64)
def _covariances(texture: TextureModel, size: int) -> tuple[FloatArray, float, FloatArray]:
    """Return the texture's autocorrelation, a step of squared distance (px²) apart, and a colour's own component's.

    The latter is by the distance in rows and columns.
    """
    step = 1 / 256
    table = texture(np.sqrt(step * np.arange(int(2.0 * (size + 1) ** 2 / step))))
    lag = np.arange(1 - size, size)
    square = np.asarray(lag[:, None] ** 2 + lag**2, dtype=np.float64)
    sparkle = np.exp(-square / (4 * SPARKLE_VARIANCE))
    # what a colour shows of its own is as coarse as the common texture where the specimen is coloured
    coarse = texture(np.sqrt(square)) + OFFSET_VARIANCE
    return table, step, np.asarray(texture.specific * coarse + (1 - texture.specific) * sparkle)


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
    """

    channels: LinearChannels
    texture: TextureModel
    factors: ColourFactors
    mean: FloatImage
    displacement: LightDisplacement


def reconstruct(
    mosaic: LinearMosaic,
    crosstalk: Crosstalk | None = None,
    *,
    texture: TextureModel | None = None,
    mixing: FloatArray | None = None,
    registration=None,
) -> Reconstruction:
    """Predict every channel from all the samples around, each trusted as far as it shows the common texture.

    Parameters
    ----------
    mosaic
        The linearised frame.
    crosstalk
        Distinguishes the sparkle of one light that several channels see from the common texture; None: no crosstalk.
    texture
        The speckle's autocorrelation; None learns it from the frame. Frames of one test should share one.
    mixing : (n, 3), or None
        Mixtures of the channels to give instead of them; not valid where a channel that matters in one
        (`rgbmidic.illumination.crosstalk.needed`) is not.

    Returns
    -------
    Reconstruction

    Raises
    ------
    InputError
        The frame is smaller than 64 x 64 px.
    """
    values, damaged, columns = mosaic.values, bool(mosaic.saturated.any()), mosaic.values.shape[1]
    if min(values.shape) < SMALLEST_FRAME:
        raise InputError(
            f"reflection-aware demosaicing needs at least {SMALLEST_FRAME} x {SMALLEST_FRAME} px to know the "
            f'speckle; the frame has {columns} x {values.shape[0]}: use method "malvar"'
        )
    if damaged:
        values = np.where(mosaic.saturated, np.float32(np.nan), values)
    red = red_position(mosaic.cfa)
    matrix = np.eye(3) if crosstalk is None else crosstalk.matrix
    lights = matrix.shape[1]
    difference = getattr(crosstalk, "green_difference", None)
    difference = np.zeros(lights) if difference is None else difference
    sites = np.stack([matrix[0], matrix[1] + difference / 2, matrix[1] - difference / 2, matrix[2]])
    grid = tuple(-(-side // BLOCK) for side in values.shape)
    apart = np.zeros((lights, 2, *grid))
    if registration is not None:
        y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1) * BLOCK + (BLOCK - 1) / 2
        rho = registration.displacement(np.stack([x, y], axis=1))
        apart = (rho - rho.mean(axis=0)).reshape(lights, *grid, 2).transpose(0, 3, 1, 2)
    model = SiteModel(sites=sites, apart=apart, texture=texture)
    moments = gather_moments(values, red, mosaic.noise, model)
    if texture is None and registration is not None:
        from dataclasses import replace
        for _ in range(int(os.environ.get("PIT", 1))):
            model = replace(model, texture=learn_texture(moments, model))
            moments = gather_moments(values, red, mosaic.noise, model)
    texture = learn_texture(moments, model) if texture is None else texture
    factors = colour_factors(moments, texture, model)
    displacement = light_displacement(moments, factors, texture, matrix)
    glints = _per_tile(displacement.significant)
    alike = np.exp(-DISSIMILAR * (((_per_tile(displacement.significant)[:, None] - _per_tile(displacement.significant)[None])) ** 2).sum(axis=2))
    index, taps, size = prediction_filters(
        _per_tile(np.full_like(factors.of_lights, float(os.environ['PF'])) if os.environ.get('PF') else factors.of_lights * float(os.environ.get('PV','1'))),
        _per_tile(factors.noise),
        texture,
        mosaic.cfa,
        seen=factors.seen,
        displacement=_per_tile(apart) + glints,
        alike=alike,
    )
    spread, pad = factors.spread.astype(np.float32), size // 2
    padded = scaled(moments, np.float32(1) / spread, pad=pad, width=index.shape[1] * TILE)
    mixing = np.eye(3) if mixing is None else mixing
    out = np.empty((len(mixing), *values.shape), dtype=np.float32)
    valid = np.ones(out.shape, dtype=bool)
    if damaged:
        source, unknown = padded.copy(), np.zeros(padded.shape, dtype=bool)
        fill_unknown(source, _per_tile(1 / (1 + factors.specific)), *moments.red, pad, padded, unknown)
        known = _validity(mosaic.saturated, unknown[pad : pad + len(values), pad : pad + columns], mosaic.cfa)
        valid = np.stack([known[matters].all(axis=0) for matters in needed(mixing)])
    scale, mean = widened(spread, BLOCK, columns), widened(moments.channel_mean, MEAN_BLOCK, columns)
    predict(padded, index, taps, size, scale, BLOCK, mean, MEAN_BLOCK, mixing.astype(np.float32), out)
    channels = LinearChannels(values=out, valid=valid, full_scale=mosaic.full_scale)
    return Reconstruction(
        channels=channels, texture=texture, factors=factors, mean=moments.channel_mean, displacement=displacement if not os.environ.get("PD") else __import__('dataclasses').replace(displacement, values=displacement.values*0)
    )


def _per_tile(grid: FloatArray) -> FloatArray:
    """Average grids (..., h, w) of blocks over the tiles; the last one may be narrower."""
    ratio = TILE // BLOCK
    missing = [*[(0, 0)] * (grid.ndim - 2), *((0, -side % ratio) for side in grid.shape[-2:])]
    padded = np.pad(grid, missing, mode="edge") if np.any(missing) else grid
    parts = [padded[..., row::ratio, column::ratio] for row, column in np.ndindex(ratio, ratio)]
    return np.asarray(sum(parts) / ratio**2)


def _validity(saturated: BoolArray, unknown: BoolArray, cfa: str) -> BoolArray:
    """Return where channels are known: not within a pixel of their saturated samples, nor where texture is unknown."""
    site = sampled_channels(cfa, saturated.shape)
    near = np.ones((3, 3), np.uint8)
    wide = cv2.dilate(unknown.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    own = [cv2.dilate((saturated & (site == c)).astype(np.uint8), near).astype(bool) for c in range(3)]
    return np.stack([~(mask | wide) for mask in own])
