"""Displacement of the lights' textures against each other, from one mosaic.

Where paint reflects, glints sit on the flanks of raised droplets: the light that is reflected shows the common texture
displaced by some tenths of a pixel, and the displacement slides as the surface turns. Its variance hardly shows that.
Each sample minus its best prediction from the samples of the other colours around it is regressed on the gradient
predicted likewise; the crosstalk turns the channels' displacements into those of the lights.

Which of several lights shows the texture where it is, is a question of agreement (`agreement`): a light counts by its
precision and by the precision of the others that show it at the same place.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from scipy.linalg import pinv

from rgbmidic._kernels.demosaicing import displacement_sums
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.colour_factors import BLOCK, ColourFactors, Moments, blurred, scaled
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import FloatArray, FloatImage

SIZE, REACH = 5, 8
"""Side of the square of samples of a prediction, px; rows and columns over which predictions are correlated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LightDisplacement:
    """Displacement of the lights' textures from their mean.

    Attributes
    ----------
    values : ndarray, shape (k, 2, h, w)
        In x and y (px), on a grid of blocks of 8 px.
    std : ndarray, shape (k, h, w)
        Standard uncertainty in each direction, px.
    """

    values: FloatArray
    std: FloatArray

    @property
    def significant(self) -> FloatArray:
        """The displacement shrunk towards 0 by what chance explains of it (James and Stein 1961), (k, 2, h, w)."""
        most = 1.25  # standard deviations that chance may make in each direction
        chance = 2 * most**2 * (self.std**2).sum(axis=0)
        gain = 1 - chance / np.maximum((self.values**2).sum(axis=(0, 1)), 1e-12)
        return np.asarray(self.values * np.maximum(gain, 0))


def agreement(
    displacement: FloatArray,
    variance: FloatArray,
    precision: FloatArray,
    *,
    harmless: float = 0.03,
    alone: float = 0.1,
) -> tuple[FloatArray, FloatArray]:
    """How far lights are to be believed about a place, and how far those that are agree with another one.

    Parameters
    ----------
    displacement : ndarray, shape (k, 2, h, w)
        Where each light shows the texture, px.
    variance : ndarray, shape (k, h, w)
        Of chance in each direction, px².
    precision : ndarray, shape (k, h, w)
        Of each light's displacement; in any unit.
    harmless
        Distance (px) of two lights at which each counts half for the other. Half and twice of it change the error of
        raised droplets by 2 % at most (benchmarks/reflections.py).
    alone
        What a light with which no other agrees counts: the square of it is its weight against lights that agree.

    Returns
    -------
    tuple of ndarray, shape (k, h, w) and (h, w)
        Weights of the lights, their sum 1; the weighted mean, 0 to 1, of how far each agrees with its nearest.
    """
    believed = precision / np.maximum(precision.sum(axis=0), 1e-30)
    alike, nearest = np.zeros_like(believed), np.zeros_like(believed)
    lights = range(len(believed))
    for light in lights:
        for other in lights:
            if other != light:
                apart = ((displacement[light] - displacement[other]) ** 2).sum(axis=0)
                beyond = np.maximum(apart - 2 * (variance[light] + variance[other]), 0)
                near = 1 / (1 + beyond / harmless**2)
                alike[light] += believed[other] * near
                nearest[light] = np.maximum(nearest[light], near)
        alike[light] /= np.maximum(1 - believed[light], 1e-6)
    weights = believed * (alone + alike) ** 2
    weights /= np.maximum(weights.sum(axis=0), 1e-30)
    return weights, (weights * nearest).sum(axis=0)


def light_displacement(
    moments: Moments,
    factors: ColourFactors,
    texture: TextureModel,
    matrix: FloatArray,
    cfa: str,
    *,
    window: float = 20.0,
) -> LightDisplacement:
    """Displacement of the lights' textures against each other.

    Parameters
    ----------
    moments, factors, texture
        Of the mosaic.
    matrix : ndarray, shape (3, k)
        Crosstalk.
    cfa
        Bayer pattern.
    window
        Standard deviation (px) of the window in which a displacement is taken: glints change their place over some
        50 px.

    Returns
    -------
    LightDisplacement
    """
    slope = np.median(factors.slope, axis=(1, 2))
    octave = np.round(np.log2(np.maximum(np.median(factors.noise, axis=(1, 2)), 2.0**-20)))
    taps, response, chance = _filters(texture, tuple((2.0**octave).tolist()), cfa)
    padded = scaled(moments, (1 / factors.slope).astype(np.float32), pad=SIZE // 2)
    sums = np.empty((3, 5, *(-(-side // BLOCK) for side in moments.contrast.shape)), dtype=np.float32)
    displacement_sums(padded, taps, BLOCK, *moments.red, sums)
    around = np.array([[blurred(grid, window / BLOCK) for grid in one] for one in sums.swapaxes(0, 1)], np.float64)
    square = around[2] + 1e-12
    shift = around[:2].swapaxes(0, 1) / square[:, None]
    back = pinv(response @ seen_lights(matrix, slope), rtol=0.05)
    back -= back.mean(axis=0)
    # standard deviation of as many independent products: a window holds so many blocks
    alone = np.sqrt(around[3] / (square * np.maximum(around[4], 1e-6) * (4 * np.pi * (window / BLOCK) ** 2)))
    values = np.tensordot(back, shift, axes=1)
    pairs = np.einsum("lc,ld,cd->lcd", back, back, chance)
    variance = np.maximum(np.tensordot(pairs, alone[:, None] * alone, axes=2), 1e-12)
    return LightDisplacement(values=values, std=np.sqrt(variance))


def seen_lights(matrix: FloatArray, slope: FloatArray) -> FloatArray:
    """Fraction (3, k, ...) of each light in the slope (3, ...) of each channel on the common texture."""
    lights = np.tensordot(np.linalg.pinv(matrix), slope, axes=1)
    lights = np.maximum(lights, 0.02 * lights.max())
    parts = matrix.reshape(*matrix.shape, *(1,) * (slope.ndim - 1)) * lights
    return np.asarray(parts / parts.sum(axis=1, keepdims=True))


@lru_cache(maxsize=64)
def _filters(texture: TextureModel, noise: tuple[float, ...], cfa: str) -> tuple[FloatImage, FloatArray, FloatArray]:
    """Filters of residual and gradient from the samples of the other colours, and what they make of a displacement.

    Returns
    -------
    tuple
        Taps as `rgbmidic._kernels.demosaicing.displacement_sums` takes them; (3, 3): displacement found for each
        channel (row) per displacement of each channel's texture; (3, 3): covariance of two channels' sums of residual
        times gradient over the root of the variances of as many independent products (Isserlis' theorem).
    """
    cell, offset, middle = cfa_channels(cfa), np.arange(SIZE) - SIZE // 2, SIZE**2 // 2
    places = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)  # x, y
    apart = places[:, None] - places
    # over the texture's variance: that of an unknown constant under it, that by which the other colours' prediction may
    # be wrong; the distance (px) over which the derivative of the autocorrelation is taken
    constant, wrong, step = 10.0, 0.02, 0.25
    covariance = texture(np.linalg.norm(apart, axis=-1)) + constant
    ends = [[texture(np.linalg.norm(apart + s * step * e, axis=-1)) for s in (1, -1)] for e in np.eye(2)]
    derivative = [(after - before) / (2 * step) for after, before in ends]  # of the texture at a, with that at b
    taps = np.zeros((2, 2, 3, SIZE**2))
    moved, unit = np.zeros((3, 3)), np.zeros(3)
    phases = list(np.ndindex(2, 2))
    colours = [cell[np.ix_((offset + p) % 2, (offset + q) % 2)].ravel() for p, q in phases]
    for phase, channel in zip(phases, colours, strict=True):
        own, others = channel[middle], channel != channel[middle]
        system = covariance[np.ix_(others, others)] + np.diag(np.take(noise, channel[others]) + wrong)
        wanted = np.stack([covariance[middle, others], *(one[middle, others] for one in derivative)], axis=1)
        taps[phase][:, others] = np.linalg.solve(system, wanted).T
        taps[phase][0] *= -1
        taps[phase][0, middle] = 1
        residual, *gradients = taps[phase]
        for one, gradient in zip(derivative, gradients, strict=True):
            unit[own] += gradient @ covariance @ gradient
            moved[own] -= np.bincount(channel, residual * (one @ gradient), minlength=3)
    lag = np.arange(-REACH - SIZE + 1, REACH + SIZE)
    around = texture(np.hypot(lag[:, None], lag))

    def moment(first: int, one: int, second: int, other: int) -> FloatArray:
        """Covariance of a filter's output at a phase with another's at lags up to `REACH` rows and columns."""
        a, b = (taps[phases[n]][m].reshape(SIZE, SIZE) for n, m in ((first, one), (second, other)))
        level = np.take(noise, colours[first]).reshape(SIZE, SIZE)
        b = np.pad(b, SIZE - 1)
        white = np.pad(_correlated(b, a * level), REACH - SIZE + 1)[::-1, ::-1]
        return _correlated(around, _correlated(b, a)) + white

    total, alone = np.zeros((3, 3)), np.zeros(3)
    parity = np.arange(-REACH, REACH + 1) % 2
    for first, second in product(range(4), repeat=2):
        own, other = colours[first][middle], colours[second][middle]
        (p, q), (r, s) = phases[first], phases[second]
        met = np.outer(parity == (r - p) % 2, parity == (s - q) % 2)
        for axis in (1, 2):
            square = moment(first, 0, second, 0) * moment(first, axis, second, axis)
            cross = moment(first, 0, second, axis) * moment(first, axis, second, 0)
            total[own, other] += (square + cross)[met].sum()
            if first == second:
                alone[own] += square[REACH, REACH]
    # 256 columns at a time: what a core's fastest cache holds of their filters
    lanes: FloatImage = np.tile(taps.transpose(0, 2, 3, 1), 128).astype(np.float32)
    return lanes, moved / unit[:, None], total / np.sqrt(alone[:, None] * alone)


def _correlated(image: FloatArray, kernel: FloatArray) -> FloatArray:
    """Correlation of a kernel with an image where it lies within."""
    return np.asarray(np.einsum("ijkl,kl", np.lib.stride_tricks.sliding_window_view(image, kernel.shape), kernel))
