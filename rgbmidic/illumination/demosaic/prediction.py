"""Linear prediction of every channel at every pixel from the samples around it (simple kriging).

The contrast of channel c, divided by its own spread, is ``sqrt(s_c) a + sqrt(1 - s_c) e_c + n_c``: common texture a of
autocorrelation C, what is private to the channel, and camera noise, with s_c the share of the common texture. The best
linear prediction of a channel at a pixel from the N x N samples around it has the filter ``(K + V)^-1 k``, with K the
covariance of the samples, V their noise and k their covariance with what is wanted. It depends on the pixel's phase in
the 2x2 cell and on the three shares alone, so the filters of a frame are a small table.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.kriging import TILE
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["SIZE", "WIDE", "FilterTable", "prediction_filters"]


SIZE, WIDE = 5, 7
"""Side of the square of samples that a value is predicted from, and where the colours have nothing in common."""
LEVELS_PER_OCTAVE = 1
"""Fineness in which a channel's private variance is rounded; twice as fine measures the same."""
LARGEST, SMALLEST = 10, -10
"""Range (powers of two) of the private variance relative to the common one."""
OFFSET_VARIANCE = 10.0
"""Variance of an unknown constant under the texture: makes the filter's coefficients sum to one."""
SPARKLE_VARIANCE = 0.29
"""Variance (px²) of the aperture through which sparkle is seen: a square pixel, 1/12, and a lens blur of 0.45 px."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterTable:
    """Filters of the tiles of a frame.

    Attributes
    ----------
    index : (h, w) int32
        Row of `taps` for each tile.
    taps : (T, 2, n, size², 16) float32
        As `rgbmidic._kernels.kriging.predict` takes them.
    size : int
        Side of the square of samples.
    """

    index: npt.NDArray[np.int32]
    taps: FloatImage
    size: int = SIZE


def prediction_filters(
    private: FloatArray, noise: npt.ArrayLike, texture: TextureModel, cfa: str, *, size: int = SIZE
) -> FilterTable:
    """The table of filters for tiles whose channels have some private variance.

    Parameters
    ----------
    private : (3, h, w)
        Variance private to each channel in each tile, relative to the common one.
    noise : (3,)
        Variance of the camera noise of each channel relative to the channel's own variance.
    texture
        Autocorrelation of the common texture, and of what is private.
    cfa
        Bayer pattern.
    size
        Side of the square of samples, odd.

    Returns
    -------
    FilterTable
        With one output for each channel.
    """
    level = np.round(LEVELS_PER_OCTAVE * np.log2(np.clip(private, 2.0**SMALLEST, 2.0**LARGEST))).astype(np.int64)
    code = (level[0] * 1000 + level[1]) * 1000 + level[2]
    _, first, index = np.unique(code, return_index=True, return_inverse=True)
    share = 1 / (1 + 2.0 ** (level.reshape(3, -1).T[first] / LEVELS_PER_OCTAVE))
    taps = _solved(share, np.asarray(noise, dtype=np.float64), texture, cfa, size)
    lanes = np.tile(taps.reshape(-1, 2, 2, 3, size * size).transpose(0, 1, 3, 4, 2), TILE // 2)
    return FilterTable(
        index=index.reshape(level.shape[1:]).astype(np.int32),
        taps=lanes.astype(np.float32),
        size=size,
    )


def _solved(share: FloatArray, noise: FloatArray, texture: TextureModel, cfa: str, size: int) -> FloatArray:
    """Filters (T, 4, 3, size²) for shares (T, 3) of the common texture."""
    common, fine = _covariances(texture, size)
    # what a colour shows of its own is as coarse as the common texture where the specimen is coloured
    private = texture.private * common + (1 - texture.private) * fine
    centre, count = size * size // 2, len(share)
    taps = np.empty((count, 4, 3, size * size))
    for phase, channel in enumerate(_channels_around(cfa, size)):
        root, own = np.sqrt(share[:, channel]), np.sqrt(1 - share[:, channel])
        same = channel[:, None] == channel[None]
        samples = root[:, :, None] * root[:, None] * common + own[:, :, None] * own[:, None] * (same * private)
        samples[:, np.arange(size * size), np.arange(size * size)] += np.maximum(noise, 1e-8)[channel]
        mine = channel[:, None] == np.arange(3)
        wanted = root[:, :, None] * np.sqrt(share)[:, None] * common[:, centre, None]
        wanted += (1 - share)[:, None] * (mine * private[:, centre, None])
        solution = np.linalg.solve(samples, wanted)
        taps[:, phase] = solution.transpose(0, 2, 1)
    return taps


@lru_cache(maxsize=64)
def _covariances(texture: TextureModel, size: int) -> tuple[FloatArray, FloatArray]:
    """Covariance between the samples of the square: of the texture, and of the sparkle of a reflection."""
    offset = np.arange(size) - size // 2
    points = np.stack(np.meshgrid(offset, offset, indexing="ij"), -1).reshape(-1, 2)
    apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
    return texture(apart) + OFFSET_VARIANCE, np.exp(-(apart**2) / (4 * SPARKLE_VARIANCE))


@lru_cache(maxsize=64)
def _channels_around(cfa: str, size: int) -> list[npt.NDArray[np.intp]]:
    """Channel of each sample of the square, for the four phases of its centre: (0, 0), (0, 1), (1, 0), (1, 1)."""
    cell, offset = cfa_channels(cfa), np.arange(size) - size // 2
    return [cell[np.ix_((offset + p) % 2, (offset + q) % 2)].ravel() for p in (0, 1) for q in (0, 1)]
