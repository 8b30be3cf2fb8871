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

from rgbmidic._kernels.owned_pixels import corrected_difference
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
    sums : ndarray, shape (h, w)
        Weighted sums of the other field over blocks.
    coefficients : ndarray, shape (3, h, w)
        Factors that give the gain at a block from the weighted sums of a field and their first moments around it.
    """

    pixels: PixelMap
    weights: FloatImage
    sigma: float
    sums: FloatArray
    coefficients: FloatArray

    @classmethod
    def over(cls, values: FloatImage, weights: FloatImage, pixels: PixelMap, sigma: float) -> GainFit:
        """Prepare the gain over `values` (P,) with `weights` (P,)."""
        (sums,) = pixels.weighted_block_sums(values[None], weights, _STEP)
        total, x, y, xx, xy, yy = _moments(sums, sigma, 2)
        # beside gaps too narrow for a slope the mean counts
        spread = 0.1 * (sigma / _STEP) ** 2 * total
        xx, yy = xx + spread, yy + spread
        cofactors = np.stack([xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y])
        determinant = (cofactors * (total, x, y)).sum(axis=0)
        least = 1e-6 * float(determinant.max(initial=0.0))
        coefficients = np.where(determinant > least, cofactors / np.maximum(determinant, max(least, 1e-300)), 0.0)
        return cls(pixels=pixels, weights=weights, sigma=sigma, sums=sums, coefficients=coefficients)

    def sums_of(self, field: FloatImage) -> FloatArray:
        """Weighted sums (h, w) of a field (P,) over the blocks."""
        return self.pixels.weighted_block_sums(field[None], self.weights, _STEP)[0]

    def gain(self, sums: FloatArray) -> FloatImage:
        """Gain (h, w) at the blocks of a field with such `sums`."""
        return (self.coefficients * _moments(sums, self.sigma, 1)).sum(axis=0).astype(np.float32)

    def residual(self, field: FloatImage, values: FloatImage) -> FloatImage:
        """Return what a field (P,) has beyond its gain times the `values` (P,)."""
        gain = self.pixels.from_blocks(self.gain(self.sums_of(field))[None], _STEP)[0]
        return np.asarray(field - gain * values)


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
    pixels
        P owned pixels of the reference.
    values : ndarray, shape (k, P), float32
        Grey levels of the reference.
    level : ndarray, shape (k, P), float32
        Their local mean, the unit of the residual.
    gain : ndarray, shape (k,)
        Of each light, median over the elements; 1 where it shows nothing.
    offset : ndarray, shape (k, 3)
        Of each light: its constant, and its slopes along columns and rows of the rectangle around the pixels.
    fits : tuple of GainFit
        Of each light; empty where the gain is one number.
    least_gain
        Least local gain over that of the light.
    """

    pixels: PixelMap
    values: FloatImage
    level: FloatImage
    gain: FloatArray
    offset: FloatArray
    fits: tuple[GainFit, ...]
    offset_sums: FloatArray
    least_gain: float

    @classmethod
    def between(
        cls, pixels: PixelMap, values: FloatImage, level: FloatImage, weights: FloatImage, moments: FloatArray,
        centres: FloatArray, sigma: float | None, constants: SolverConstants,
    ) -> Brightness:
        """Estimate."""
        gain, offset = gain_and_offset(moments, centres, constants)
        fits, sums = (), np.zeros(0)
        if sigma is not None:
            fits = tuple(GainFit.over(f, w, pixels, sigma) for f, w in zip(values, weights, strict=True))
            shape = np.indices(fits[0].sums.shape)
            rows, columns = ((one + 0.5) * _STEP - 0.5 for one in shape)
            sums = []
            for w, b in zip(weights, offset, strict=True):
                number = pixels.block_sums(w[None], _STEP)[0]
                sums.append((b[0] + b[1] * columns + b[2] * rows) * number)
        return cls(pixels=pixels, values=values, level=level, gain=gain, offset=offset, fits=fits, offset_sums=np.array(sums), least_gain=constants.least_gain)

    def residual(self, light: int, difference: FloatImage) -> FloatImage:
        """Residual (P,) in units of the reference's local mean, from the `difference` (P,) f - g of the grey levels."""
        gain = np.full((1, 1), self.gain[light], dtype=np.float32)
        if self.fits:
            fit = self.fits[light]
            gain = fit.gain(fit.sums - fit.sums_of(difference) - self.offset_sums[light])
        out = np.empty_like(difference)
        least = np.float32(self.least_gain * self.gain[light])
        corrected_difference(
            self.pixels.lines, self.values[light], self.level[light], difference, gain, self.offset[light], least, _STEP, out
        )
        return out


def gain_and_offset(moments: FloatArray, centres: FloatArray, constants: SolverConstants) -> tuple[FloatArray, FloatArray]:
    """Gain (k,) and offset (k, 3) of each light, from elements that show the same texture in both states.

    The gain is the ratio of the standard deviations, which noise that is alike in both states changes little.

    Parameters
    ----------
    moments : ndarray, shape (k, E, 6)
        Sums of w, w f, w g, w f f, w f g, w g g over elements.
    centres : ndarray, shape (E, 2)
        Column and row of the elements.
    constants
        Of the solve.
    """
    gains, offsets = np.ones(len(moments)), np.zeros((len(moments), 3))
    for light, sums in enumerate(moments):
        total, f, g, ff, fg, gg = sums.T
        total = np.maximum(total, 1e-30)
        ff, fg, gg = ff - f * f / total, fg - f * g / total, gg - g * g / total
        alike = (ff > 0) & (fg > constants.lit * np.sqrt(np.maximum(ff * gg, 0)))
        if not alike.any():
            continue
        gain = np.sqrt(np.maximum(gg[alike], 0) / ff[alike])
        offset = (g[alike] - gain * f[alike]) / total[alike]
        gains[light] = np.median(gain)
        offsets[light] = _plane(centres[alike], offset)
    return gains, offsets


def _plane(points: FloatArray, values: FloatArray) -> FloatArray:
    """Constant and slopes (3,) of a plane through values (M,) at points (M, 2): a fit with Cauchy weights."""
    middle, size = points.mean(axis=0), max(float(np.ptp(points, axis=0).max()), 1.0)
    basis = np.c_[np.ones(len(points)), (points - middle) / size]
    found, left = np.array([np.median(values), 0.0, 0.0]), values - np.median(values)
    for _ in range(10 if len(points) > 12 else 0):
        scale = 1.5 * float(np.median(np.abs(left)))
        if not scale:
            break
        weight = 1 / (1 + (left / scale) ** 2)
        system = (basis * weight[:, None]).T @ basis + np.diag([0, 1e-3, 1e-3]) * weight.sum()
        found = np.linalg.solve(system, (basis * weight[:, None]).T @ values)
        left = values - basis @ found
    # what scatters as much as that is no offset of the light, but reflections
    plane, scatter = basis @ found, 1.5 * float(np.median(np.abs(left)))
    found = found * (mean := float((plane**2).mean())) / max(mean + scatter**2, 1e-30)
    slopes = found[1:] / size
    return np.array([found[0] - slopes @ middle, *slopes])


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
