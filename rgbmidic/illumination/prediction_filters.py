"""Filters that predict the channels of a mosaic from the samples around, and the table of those a test has needed.

A filter depends on the phase in the 2x2 cell, on how much of their own the lights have, where each shows the texture,
and the noise; all are rounded, so that the tiles of a frame, and the frames of a test, share filters.
"""

from __future__ import annotations

import threading
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.demosaicing import prediction_taps
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.mosaic_model import CHANNEL, channel_means
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


class FilterTables:
    """Filters that were needed so far, by texture, pattern and what the sites see; kept as long as a test runs.

    They depend on nothing else, so that any frame finds the same in any order.
    """

    def __init__(self) -> None:
        self._tables: dict[tuple[object, ...], tuple[dict[bytes, int], FloatImage]] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[type[FilterTables], tuple[()]]:
        """Another process makes its own."""
        return FilterTables, ()

    def find(
        self,
        codes: npt.NDArray[np.int16],
        texture: TextureModel,
        cfa: str,
        light_fraction: FloatArray,
        *,
        left_out: bool,
    ) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
        """Return the row of the table for each of T codes, the table (M, 2, 3, size², 2), and the square's side."""
        # a colour left to itself has only every other sample, so it needs to look farther
        size = SIZE if texture.specific < 0.5 else WIDE
        keys, first, index = np.unique(
            codes.view([("", codes.dtype)] * codes.shape[1]).ravel(), return_index=True, return_inverse=True
        )
        names = [key.tobytes() for key in keys]
        table = texture, cfa, light_fraction.tobytes(), left_out
        with self._lock:
            rows, taps = self._tables.get(table, ({}, np.empty((0, 2, 3, size * size, 2), dtype=np.float32)))
            missing = [n for n, name in enumerate(names) if name not in rows]
            if len(rows) + len(missing) > MOST_FILTERS:
                rows, taps, missing = {}, taps[:0], list(range(len(names)))
            if missing:
                new_taps = _filters(
                    codes[first[missing]], texture, cfa, light_fraction, size, LEFT_OUT if left_out else 0.0
                )
                rows = rows | {names[n]: len(taps) + position for position, n in enumerate(missing)}
                taps = np.concatenate([taps, new_taps])
                if len(self._tables) >= 4 and table not in self._tables:
                    self._tables.clear()
                self._tables[table] = rows, taps
        return np.array([rows[name] for name in names], dtype=np.int32)[index.ravel()], taps, size


def prediction_filters(
    specific: FloatArray,
    noise: FloatArray,
    texture: TextureModel,
    cfa: str,
    *,
    light_fraction: FloatArray,
    displacement: FloatArray,
    glints: FloatArray,
    tables: FilterTables | None = None,
    left_out: bool = False,
) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
    """Return the filters for tiles whose lights have some variance of their own.

    Parameters
    ----------
    specific : (k, h, w)
        Light-specific variance in each tile, relative to the common one.
    noise : (3, h, w)
        Variance of the camera noise of each channel, relative to the common texture's in it.
    texture
        Autocorrelation of the common texture, and of the light-specific component.
    cfa
        Bayer pattern.
    light_fraction : (4, k)
        Fraction of each light in the slope of each site's channel (`MosaicModel.light_fraction`).
    displacement : (k, 2, h, w)
        Place (x, y) at which each light shows the texture, px, by the lens.
    glints : (k, 2, h, w)
        The same by what it reflects: added, and the lights are as much less alike.
    tables
        Where filters are kept; None: they are not.
    left_out
        Whether the sample at the pixel itself is left out.

    Returns
    -------
    index : (h, w) int32
        Row of the table for each tile.
    taps : (T, 2, 3, size², 2) float32
        As `rgbmidic._kernels.demosaicing.predict` takes them, with one output for each channel.
    size : int
        Side of the square of samples.
    """
    tiles = specific.shape[1:]
    level = np.log2(np.clip(specific, 2.0**SMALLEST, 2.0**LARGEST))
    half_octave = 2 * np.log2(np.maximum(noise, LEAST_NOISE))
    steps = [(field / STEP).reshape(-1, *tiles) for field in (displacement + glints, glints)]
    codes = np.concatenate([level, half_octave, *steps]).reshape(-1, tiles[0] * tiles[1]).T
    rounded = np.ascontiguousarray(np.round(codes), dtype=np.int16)
    index, taps, size = (tables or FilterTables()).find(rounded, texture, cfa, light_fraction, left_out=left_out)
    return index.reshape(tiles), taps, size


def _filters(
    codes: npt.NDArray[np.int16], texture: TextureModel, cfa: str, light_fraction: FloatArray, size: int, held: float
) -> FloatImage:
    """Make the filters (T, 2, 3, size², 2) of T codes."""
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
        *_covariances(texture, size),
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


@lru_cache(maxsize=8)
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
