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
wanted. What one light sparkles all channels see by their crosstalk, so that the samples of all colours say how much of
it to take off which. A filter depends on the phase in the 2x2 cell, on how much of their own the lights have, where
each shows the texture, and the noise; all are rounded, so that the tiles of a frame, and the frames of a test, share
filters (`FilterTables`).
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.demosaicing import TILE, fill_unknown, predict, prediction_taps
from rgbmidic._kernels.illumination import PAD, malvar
from rgbmidic.errors import InputError
from rgbmidic.frames.data import sampled_channels
from rgbmidic.illumination.colour_factors import (
    BLOCK,
    CHANNEL,
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
from rgbmidic.illumination.texture import COLOURED, TextureModel
from rgbmidic.settings import BAYER_PATTERNS
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


def red_position(cfa: str) -> tuple[int, int]:
    """Return row and column of red in the 2x2 cell of a Bayer pattern."""
    row, column = divmod(cfa.index("R"), 2)
    return row, column


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
    """A mosaic with all that was found out of it, from which every channel is predicted at every pixel.

    Attributes
    ----------
    mosaic : LinearMosaic
        The linearised frame.
    texture : TextureModel
        The one used: given, or learnt from the frame.
    model : MosaicModel
        The lights that the factors are of: on a coloured specimen those are the channels.
    moments : Moments
        Local means and moments of the mosaic.
    factors : ColourFactors
        How each channel sees the texture, on a grid of 8 px.
    displacement : LightDisplacement
        Of the lights' textures against each other, on a grid of 8 px.
    glints : ndarray, shape (k, 2, h, w)
        What the filters of each tile take into account of it, px.
    """

    mosaic: LinearMosaic
    texture: TextureModel
    model: MosaicModel
    moments: Moments
    factors: ColourFactors
    displacement: LightDisplacement
    glints: FloatArray

    def predicted(self, mixing: FloatArray | None = None, tables: FilterTables | None = None) -> LinearChannels:
        """Predict the channels, or mixtures of them, at every pixel.

        Parameters
        ----------
        mixing : (n, 3), or None
            Mixtures of the channels to give instead of them; not valid where a channel that matters in one
            (`rgbmidic.illumination.crosstalk.required_channels`) is not.
        tables
            Where the filters of a test are kept; None: they are made anew.

        Returns
        -------
        LinearChannels
            (3, H, W), or the n mixtures.
        """
        mixing, full_scale = np.eye(3) if mixing is None else mixing, self.mosaic.full_scale
        if not self.texture.common:
            channels = malvar_demosaic(self.mosaic)
            values = np.tensordot(mixing, channels.values, axes=1).astype(np.float32)
            return LinearChannels(values=values, valid=_mixed_validity(channels.valid, mixing), full_scale=full_scale)
        rows, columns = shape = self.mosaic.values.shape
        index, taps, size = self._filters(self.factors.light_specific, tables=tables)
        spread, pad = self.factors.spread.astype(np.float32), size // 2
        padded = normalise_contrast(self.moments, np.float32(1) / spread, pad=pad, width=index.shape[1] * TILE)
        out, valid = np.empty((len(mixing), *shape), dtype=np.float32), np.ones((len(mixing), *shape), dtype=bool)
        if self.mosaic.saturated.any():
            source, unknown = padded.copy(), np.zeros(padded.shape, dtype=bool)
            fill_unknown(source, _per_tile(1 / (1 + self.factors.specific)), *self.moments.red, pad, padded, unknown)
            unknown = unknown[pad : pad + rows, pad : pad + columns]
            valid = _mixed_validity(_validity(self.mosaic.saturated, unknown, self.mosaic.cfa), mixing)
        scale = upsample_rows(spread, BLOCK, columns)
        mean = upsample_rows(self.moments.channel_mean, MEAN_BLOCK, columns)
        predict(padded, index, taps, size, scale, BLOCK, mean, MEAN_BLOCK, mixing.astype(np.float32), out)
        return LinearChannels(values=out, valid=valid, full_scale=full_scale)

    def shows_common_texture(self) -> bool:
        """Tell whether samples are predicted no worse by the common texture found than if each light had half its own.

        By leaving each sample out in turn (Rasmussen and Williams, Gaussian processes, 2006, section 5.4.2).
        """
        specific = self.factors.light_specific
        half = self._left_out_error(np.maximum(specific, 1.0))
        return self._left_out_error(specific) <= CONTRADICTED * half

    def _left_out_error(self, specific: FloatArray) -> float:
        """Mean square error of samples that are left out, each over its channel's variance."""
        index, taps, size = self._filters(specific, left_out=True)
        spread, pad = self.factors.spread.astype(np.float32), size // 2
        rows, columns = self.mosaic.values.shape
        padded = normalise_contrast(self.moments, np.float32(1) / spread, pad=pad, width=index.shape[1] * TILE)
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
        self, specific: FloatArray, *, tables: FilterTables | None = None, left_out: bool = False
    ) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
        """Return the filters for the tiles of lights of a `specific` variance (`FilterTables.find`)."""
        noise, displacement = _per_tile(self.factors.noise), _per_tile(self.model.displacement)
        codes = filter_codes(_per_tile(specific), noise, displacement, self.glints)
        tables, fraction = tables or FilterTables(), self.factors.light_fraction
        return tables.find(codes, self.texture, self.mosaic.cfa, fraction, left_out=left_out)


def reconstruct(
    mosaic: LinearMosaic,
    crosstalk: Crosstalk | None = None,
    *,
    registration: Registration | None = None,
    texture: TextureModel | None = None,
) -> Reconstruction:
    """Find out how far the samples of a mosaic show the common texture, for the prediction of its channels.

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
    red, fitted_texture = red_position(mosaic.cfa), texture
    model = MosaicModel.of(crosstalk, registration, values.shape)
    gather = partial(gather_moments, values, red, mosaic.noise, model)
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
    result = Reconstruction(
        mosaic=mosaic,
        texture=fitted_texture,
        model=model,
        moments=moments,
        factors=factors,
        displacement=displacement,
        glints=_per_tile(glints),
    )
    if texture is None and fitted_texture.specific < COLOURED:
        return replace(result, texture=replace(fitted_texture, common=result.shows_common_texture()))
    return result


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


def _mixed_validity(valid: BoolArray, mixing: FloatArray) -> BoolArray:
    """Return where mixtures (n, H, W) of channels are valid: where all that matter in one are."""
    return np.stack([valid[matters].all(axis=0) for matters in required_channels(mixing)])


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
SITE_KINDS = {
    cfa: np.array([[{"R": 0, "G": 2 - ("R" in row), "B": 3}[colour] for colour in row] for row in (cfa[:2], cfa[2:])])
    for cfa in BAYER_PATTERNS
}
"""Kinds of site (`CHANNEL`) of the 2x2 cell of each pattern."""
MOST_FILTERS = 16_384
"""Filters that a table keeps (20 MB): those of 16 frames of a megapixel that share none."""


def filter_codes(
    specific: FloatArray, noise: FloatArray, displacement: FloatArray, glints: FloatArray
) -> npt.NDArray[np.int16]:
    """Round what decides on the filters of the h x w tiles of a mosaic: tiles of one code share their filters.

    Parameters
    ----------
    specific : ndarray, shape (k, h, w)
        Light-specific variance, relative to the common one.
    noise : ndarray, shape (3, h, w)
        Variance of the camera noise of each channel, relative to the common texture's in it.
    displacement : ndarray, shape (k, 2, h, w)
        Place (x, y) at which each light shows the texture, px, by the lens.
    glints : ndarray, shape (k, 2, h, w)
        The same by what it reflects: added, and the lights are as much less alike.

    Returns
    -------
    ndarray, shape (h, w, n), int16
    """
    level = np.log2(np.clip(specific, 2.0**SMALLEST, 2.0**LARGEST))
    half_octave = 2 * np.log2(np.maximum(noise, LEAST_NOISE))
    shape = -1, *specific.shape[1:]
    steps = [(field / STEP).reshape(shape) for field in (displacement + glints, glints)]
    return np.ascontiguousarray(np.round(np.moveaxis(np.concatenate([level, half_octave, *steps]), 0, 2)), np.int16)


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
        self,
        codes: npt.NDArray[np.int16],
        texture: TextureModel,
        cfa: str,
        light_fraction: FloatArray,
        *,
        left_out: bool = False,
    ) -> tuple[npt.NDArray[np.int32], FloatImage, int]:
        """Return the filters for tiles.

        Parameters
        ----------
        codes : ndarray, shape (h, w, n), int16
            Of the tiles (`filter_codes`).
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
        # a colour left to itself has only every other sample, so it needs to look farther
        size = SIZE if texture.specific < 0.5 else WIDE
        rows, columns, length = codes.shape
        names = [code.tobytes() for code in codes.reshape(-1, length)]
        key = texture, cfa, light_fraction.tobytes(), left_out
        with self._lock:
            table = self._tables.get(key) or _Table(_covariances(texture, size), {}, _no_taps(size))
            needed = dict.fromkeys(names)
            missing = [name for name in needed if name not in table.rows]
            if len(table.rows) + len(missing) > MOST_FILTERS:
                table, missing = _Table(table.covariances, {}, _no_taps(size)), list(needed)
            if missing:
                if len(self._tables) >= 4 and key not in self._tables:
                    self._tables.clear()
                held, new_codes = LEFT_OUT if left_out else 0.0, np.frombuffer(b"".join(missing), np.int16)
                taps = _filters(new_codes.reshape(-1, length), texture, cfa, light_fraction, held, table.covariances)
                new_rows = {name: len(table.taps) + position for position, name in enumerate(missing)}
                table = _Table(table.covariances, table.rows | new_rows, np.concatenate([table.taps, taps]))
                self._tables[key] = table
        index = np.array([table.rows[name] for name in names], dtype=np.int32)
        return index.reshape(rows, columns), table.taps, size


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
    cell = SITE_KINDS[cfa]
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
