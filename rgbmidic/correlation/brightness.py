"""Brightness of the deformed images in that of the reference: ``g(x + u) = a(x) f(x) + b`` for every light.

The gain a is smooth over a window of some speckles, the offset b is one number a light; both are estimated in the frame
of the material, from the pixels that both states show (paper, section 2.2, whose gain is linear on the mesh). What a
displacement changes of the gain is no motion that is seen: it is taken out of the gradient of the reference alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

BrightnessModel = float | Literal["auto", "constant", "none"]
"""Standard deviation (px) of the window of the gain; by the speckle; one gain and offset a light; none."""

_STEP = 4
"""Side of the blocks (px) on which the gain is estimated: no more than the standard deviation of the narrowest window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GainFit:
    """Gain of one field over another, by local linear regression in a Gaussian window (Fan and Gijbels 1996).

    Attributes
    ----------
    pixels
        P owned pixels.
    weights : ndarray, shape (P,), float32
        Weights of the pixels.
    sigma
        Standard deviation of the window, px.
    coefficients : ndarray, shape (3, h, w)
        Factors that give the gain at a block from the sums of a field and its first moments around it.
    """

    pixels: PixelMap
    weights: FloatImage
    sigma: float
    coefficients: FloatArray

    @classmethod
    def of(cls, pixels: PixelMap, weights: FloatImage, values: FloatImage, sigma: float) -> GainFit:
        """Prepare the gain over `values` (P,)."""
        sums = pixels.block_sums((weights * values)[None], _STEP)[0].astype(np.float64)
        total, x, y, xx, xy, yy = _moments(sums, sigma, 2)
        # beside gaps too narrow for a slope the mean counts
        spread = 0.1 * (sigma / _STEP) ** 2 * total
        xx, yy = xx + spread, yy + spread
        cofactors = np.stack([xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y])
        determinant = (cofactors * (total, x, y)).sum(axis=0)
        least = 1e-6 * float(determinant.max(initial=0.0))
        coefficients = np.where(determinant > least, cofactors / np.maximum(determinant, max(least, 1e-300)), 0.0)
        return cls(pixels=pixels, weights=weights, sigma=sigma, coefficients=coefficients)

    def gain(self, field: FloatImage) -> FloatImage:
        """Gain (P,) of a field (P,) over the values."""
        sums = self.pixels.block_sums((self.weights * field)[None], _STEP)[0].astype(np.float64)
        gain = (self.coefficients * _moments(sums, self.sigma, 1)).sum(axis=0)
        return self.pixels.from_blocks(gain[None].astype(np.float32), _STEP)[0]


def _moments(sums: FloatArray, sigma: float, order: int) -> FloatArray:
    """Sums of blocks in a window around each, and their moments about it: of 1, x, y, and xx, xy, yy of the second."""
    rows, columns = (np.arange(side, dtype=np.float64) for side in sums.shape)
    rows = rows[:, None]

    def around(grid: FloatArray) -> AnyArray:
        return cv2.GaussianBlur(grid, (0, 0), sigma / _STEP, borderType=cv2.BORDER_CONSTANT)

    total, x, y = around(sums), around(sums * columns), around(sums * rows)
    first = [total, x - columns * total, y - rows * total]
    if order == 1:
        return np.stack(first)
    xx, xy, yy = (around(sums * product) for product in (columns * columns, columns * rows, rows * rows))
    second = [
        xx - 2 * columns * x + columns * columns * total,
        xy - columns * y - rows * x + columns * rows * total,
        yy - 2 * rows * y + rows * rows * total,
    ]
    return np.stack(first + second)


@dataclass(frozen=True, slots=True, kw_only=True)
class Brightness:
    """Brightness of the deformed images of a pass.

    Attributes
    ----------
    values : ndarray, shape (k, P), float32
        Grey levels of the reference.
    level : ndarray, shape (k, P), float32
        Their local mean, the unit of the residual.
    gain, offset : ndarray, shape (k,)
        Of each light, medians over the elements; 1 and 0 where it shows nothing.
    fits : tuple of GainFit
        Of each light; empty where the gain is one number.
    least_gain
        Least local gain over that of the light.
    """

    values: FloatImage
    level: FloatImage
    gain: FloatArray
    offset: FloatArray
    fits: tuple[GainFit, ...]
    least_gain: float

    def residual(self, light: int, difference: FloatImage) -> FloatImage:
        """Residual (P,) in units of the reference's local mean, from the `difference` (P,) f - g of the grey levels."""
        f = self.values[light]
        g = f - difference
        if self.offset[light]:
            g -= np.float32(self.offset[light])
        if self.fits:
            gain = np.maximum(self.fits[light].gain(g), np.float32(self.least_gain * self.gain[light]))
            g /= gain
        elif self.gain[light] != 1:
            g /= np.float32(self.gain[light])
        return np.asarray((f - g) / self.level[light])


def gain_and_offset(moments: FloatArray, constants: SolverConstants) -> tuple[FloatArray, FloatArray]:
    """Gain and offset (k,) of each light, medians over elements that show the same texture in both states.

    The gain is the ratio of the standard deviations, which noise that is alike in both states changes little.

    Parameters
    ----------
    moments : ndarray, shape (k, E, 6)
        Sums of w, w f, w g, w f f, w f g, w g g over elements.
    constants
        Of the solve.
    """
    total, f, g, ff, fg, gg = np.moveaxis(moments, -1, 0)
    total = np.maximum(total, 1e-30)
    ff, fg, gg = ff - f * f / total, fg - f * g / total, gg - g * g / total
    alike = (ff > 0) & (fg > constants.lit * np.sqrt(np.maximum(ff * gg, 0)))
    gain = np.sqrt(np.divide(np.maximum(gg, 0), ff, out=np.ones_like(ff), where=alike))
    offset = (g - gain * f) / total
    found = [(float(np.median(a[seen])), float(np.median(b[seen]))) if seen.any() else (1.0, 0.0)
             for a, b, seen in zip(gain, offset, alike, strict=True)]
    return np.array(found).T[0], np.array(found).T[1]


def window_width(values: FloatImage, gradient: FloatImage, weights: FloatImage, pixels: PixelMap, constants: SolverConstants) -> float:
    """Width (px) of the window by the speckle of `values` (k, P) with the `gradient` (2, k, P).

    Correlation length sqrt(var f / mean |grad f|^2), the standard deviation of the filter that makes such a speckle of white noise.
    """
    from rgbmidic.correlation.images import SlidingWindow

    sigma = float(max(pixels.bounds[2:]))
    lengths = []
    for _ in range(2):
        window, lengths = SlidingWindow(sigma=sigma), []
        for f, gx, gy, w in zip(values, *gradient, weights, strict=True):
            mean, square, slope = window.ratios(pixels, np.stack([w * f, w * f * f, w * (gx * gx + gy * gy), w]))
            seen = slope > 0
            if seen.any():
                lengths.append(float(np.sqrt(np.median(np.maximum(square - mean * mean, 0)[seen] / slope[seen]))))
        sigma = max(constants.brightness_speckles * float(np.median(lengths)) if lengths else sigma, constants.brightness_least)
    return sigma
