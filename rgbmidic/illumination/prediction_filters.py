"""Filters that predict the channels of a mosaic from the samples around, and the table of those a test has needed.

A filter depends on the phase in the 2x2 cell, on how much of their own the lights have, where each shows the texture,
and the noise; all are rounded, so that the tiles of a frame, and the frames of a test, share filters.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.demosaicing import prediction_taps
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.colour_factors import CHANNEL, channel_means
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import FloatArray, FloatImage

SIZE, WIDE = 5, 7
"""Side of the square of samples that a value is predicted from, and where the colours have nothing in common."""
LARGEST, SMALLEST = 10, -10
"""Range (powers of two, to which it is rounded) of the light-specific variance relative to the common one: beyond it
weights are 0 or 1, and twice as fine measures the same."""
OFFSET_VARIANCE = 10.0
"""Variance of an unknown constant under the texture: makes the filter's coefficients sum to one."""
SPARKLE_VARIANCE = 0.29
"""Variance (px²) of the aperture through which sparkle is seen: a square pixel, 1/12, and a lens blur of 0.45 px."""
STEP = 0.01
"""Fineness (px) in which a light's displacement is rounded: with .02 and .05 the error behind a lens with lateral
colour is 1 and 9 % larger."""
LEAST_NOISE = 1e-8
"""Least variance of the noise, relative to the texture's: keeps the system of equations regular."""
DISSIMILAR = 1.0
"""Fall (1/px²) of the logarithm of two lights' correlation with the square of what glints displace them by: a glint on
a droplet's flank is not the displaced texture alone. With 2 and 4 the error on raised droplets is 2 and 4 % larger at 8
degrees (benchmarks/reflections.py)."""
LEFT_OUT = 1e6
"""Variance of the noise with which a sample is left out."""
MOST_FILTERS = 16_384
"""Filters that a table keeps (20 MB): those of 16 frames of a megapixel that share none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Tiles:
    """The h x w tiles of a mosaic, by what decides on their filters.

    Attributes
    ----------
    specific : ndarray, shape (k, h, w)
        Light-specific variance, relative to the common one.
    noise : ndarray, shape (3, h, w)
        Variance of the camera noise of each channel, relative to the common texture's in it.
    displacement : ndarray, shape (k, 2, h, w)
        Place (x, y) at which each light shows the texture, px, by the lens.
    glints : ndarray, shape (k, 2, h, w)
        The same by what it reflects: added, and the lights are as much less alike.
    """

    specific: FloatArray
    noise: FloatArray
    displacement: FloatArray
    glints: FloatArray

    def codes(self) -> npt.NDArray[np.int16]:
        """Round them, (h w, n): tiles of one code share their filters."""
        level = np.log2(np.clip(self.specific, 2.0**SMALLEST, 2.0**LARGEST))
        half_octave = 2 * np.log2(np.maximum(self.noise, LEAST_NOISE))
        shape = -1, *self.specific.shape[1:]
        steps = [(field / STEP).reshape(shape) for field in (self.displacement + self.glints, self.glints)]
        codes = np.concatenate([level, half_octave, *steps])
        return np.ascontiguousarray(np.round(codes.reshape(len(codes), -1).T), dtype=np.int16)


@dataclass(slots=True)
class _Table:
    """The filters (M, 2, 3, size², 2) of one texture, by code, and the covariances that they are made of."""

    covariances: tuple[FloatArray, float, FloatArray]
    rows: dict[bytes, int]
    taps: FloatImage


class FilterTables:
    """Filters that were needed so far, by texture, pattern and what the sites see; kept as long as a test runs.

    They depend on nothing else, so that any frame finds the same in any order.
    """

    def __init__(self) -> None:
        self._tables: dict[tuple[object, ...], _Table] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[FilterTables], tuple[()]]:
        """Another process makes its own."""
        return FilterTables, ()

    def find(
        self, tiles: Tiles, texture: TextureModel, cfa: str, light_fraction: FloatArray, *, left_out: bool = False
    ) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
        """Return the filters for tiles.

        Parameters
        ----------
        tiles
            Of a mosaic.
        texture
            Autocorrelation of the common texture, and of the light-specific component.
        cfa
            Bayer pattern.
        light_fraction : ndarray, shape (4, k)
            Fraction of each light in the slope of each site's channel (`MosaicModel.light_fraction`).
        left_out
            Whether the sample at the pixel itself is left out.

        Returns
        -------
        index : ndarray, shape (h, w), int32
            Row of the table for each tile.
        taps : ndarray, shape (T, 2, 3, size², 2), float32
            As `rgbmidic._kernels.demosaicing.predict` takes them, with one output for each channel.
        size : int
            Side of the square of samples.
        """
        codes = tiles.codes()
        # a colour left to itself has only every other sample, so it needs to look farther
        size = SIZE if texture.specific < 0.5 else WIDE
        keys, first, index = np.unique(
            codes.view([("", codes.dtype)] * codes.shape[1]).ravel(), return_index=True, return_inverse=True
        )
        names = [key.tobytes() for key in keys]
        key = texture, cfa, light_fraction.tobytes(), left_out
        with self._lock:
            table = self._tables.get(key) or _Table(_covariances(texture, size), {}, _no_taps(size))
            missing = [n for n, name in enumerate(names) if name not in table.rows]
            if len(table.rows) + len(missing) > MOST_FILTERS:
                table, missing = _Table(table.covariances, {}, _no_taps(size)), list(range(len(names)))
            if missing:
                if len(self._tables) >= 4 and key not in self._tables:
                    self._tables.clear()
                held = LEFT_OUT if left_out else 0.0
                taps = _filters(codes[first[missing]], texture, cfa, light_fraction, held, table.covariances)
                rows = table.rows | {names[n]: len(table.taps) + position for position, n in enumerate(missing)}
                table = self._tables[key] = _Table(table.covariances, rows, np.concatenate([table.taps, taps]))
        found = np.array([table.rows[name] for name in names], dtype=np.int32)[index.ravel()]
        return found.reshape(tiles.specific.shape[1:]), table.taps, size


def _no_taps(size: int) -> FloatImage:
    return np.empty((0, 2, 3, size * size, 2), dtype=np.float32)


def _filters(
    codes: npt.NDArray[np.int16],
    texture: TextureModel,
    cfa: str,
    light_fraction: FloatArray,
    held: float,
    covariances: tuple[FloatArray, float, FloatArray],
) -> FloatImage:
    """Make the filters (T, 2, 3, size², 2) of T codes; `held` is the variance of the noise at the pixel itself."""
    size = len(covariances[2]) // 2 + 1
    lights = light_fraction.shape[1]
    level, half_octave, position, glint = np.split(codes.astype(np.float64), np.cumsum([lights, 3, 2 * lights]), axis=1)
    variance = np.exp2(level)
    spread = np.sqrt(1 + variance @ (channel_means(light_fraction) ** 2).T)
    glints = STEP * glint.reshape(-1, lights, 2)
    offset, phases = np.arange(size) - size // 2, list(np.ndindex(2, 2))
    cell = _site_kinds(cfa)
    taps = np.empty((len(codes), 4, 3, size, size))
    prediction_taps(
        np.ascontiguousarray(light_fraction, dtype=np.float64),
        np.ascontiguousarray(spread[:, CHANNEL]),
        variance,
        texture.specific,
        np.exp(-DISSIMILAR * ((glints[:, :, None] - glints[:, None]) ** 2).sum(axis=3)),
        np.ascontiguousarray(STEP * position).reshape(-1, lights, 2),
        np.exp2(half_octave / 2) / spread**2,
        held,
        *covariances,
        OFFSET_VARIANCE,
        np.stack([cell[np.ix_((offset + p) % 2, (offset + q) % 2)] for p, q in phases]),
        taps,
    )
    by_parity = taps.reshape(-1, 2, 2, 3, size * size).transpose(0, 1, 3, 4, 2)
    return np.ascontiguousarray(by_parity, dtype=np.float32)


def _site_kinds(cfa: str) -> npt.NDArray[np.int64]:
    """Return the kinds of site (`CHANNEL`) of the 2x2 cell of a pattern."""
    channels = cfa_channels(cfa)
    red_row = (channels == 0).any(axis=1, keepdims=True)
    return np.where(channels == 1, np.where(red_row, 1, 2), channels + (channels == 2)).astype(np.int64)


def _covariances(texture: TextureModel, size: int) -> tuple[FloatArray, float, FloatArray]:
    """Return the texture's autocorrelation, a step of squared distance (px²) apart, and a light's own component's.

    The latter is by the distance in rows and columns.
    """
    step = 1 / 256
    # to the farthest sample, of lights that lie as far apart as the square is wide
    table = texture(np.sqrt(step * np.arange(int(2.0 * (2 * size) ** 2 / step))))
    lag = np.arange(1 - size, size)
    square = np.asarray(lag[:, None] ** 2 + lag**2, dtype=np.float64)
    sparkle = np.exp(-square / (4 * SPARKLE_VARIANCE))
    # what a colour shows of its own is as coarse as the common texture where the specimen is coloured
    coarse = texture(np.sqrt(square)) + OFFSET_VARIANCE
    return table, step, np.asarray(texture.specific * coarse + (1 - texture.specific) * sparkle)
