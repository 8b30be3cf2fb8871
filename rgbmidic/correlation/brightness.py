"""Brightness of the deformed images in that of the reference: ``g(x + u) = a(x) f(x) + b(x)`` for every light.

The gain a is smooth over a window of some speckles, the offset b is a plane over the region; both are estimated in the
frame of the material from the pixels that both states show (paper, section 2.2, whose gain is linear on the mesh). What
a displacement changes of the gain is taken out of the reference's gradient (`GainFit.remainder`), so that the Hessian
counts only the information that the unknown gain leaves.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.correlation.images import centred_products
from rgbmidic.correlation.robust_fit import robust_fit
from rgbmidic.mesh import PixelMap
from rgbmidic.mesh.window import SlidingWindow, window_sums
from rgbmidic.typing import FloatArray, FloatImage

BrightnessModel = float | Literal["auto", "constant", "none"]
"""The setting ``solver.brightness``."""


def block_side(sigma: float) -> int:
    """Side (px) of the blocks on which a gain is estimated: the largest power of 2 up to the window's sigma."""
    return int(2 ** np.floor(np.log2(sigma)))


@dataclass(frozen=True, slots=True, kw_only=True)
class GainFit:
    """Gain of one field over another, by local linear regression in a Gaussian window (Fan and Gijbels 1996).

    Around a block the gain is linear, and such that the field and the gain times the other one have the same weighted
    sum and first moments in the window; a ridge holds its slope back where the pixels do not determine it.

    Attributes
    ----------
    pixels
        P owned pixels.
    weights : ndarray, shape (P,), float32
        Weights of the pixels.
    sigma
        Standard deviation of the window, px.
    side
        Of the blocks, px.
    sums, totals : ndarray, shape (h, w)
        Sums over blocks of the other field with the weights, and of these.
    coefficients : ndarray, shape (3, h, w)
        Factors that give the gain at a block from the weighted sums of a field and their first moments around it.
    """

    pixels: PixelMap
    weights: FloatImage
    sigma: float
    side: int
    sums: FloatArray
    totals: FloatArray
    coefficients: FloatArray

    @classmethod
    def over(cls, values: FloatImage, weights: FloatImage, pixels: PixelMap, sigma: float) -> GainFit:
        """Prepare the gain over `values` (P,) with `weights` (P,)."""
        side = block_side(sigma)
        sums, totals = pixels.weighted_block_sums(values, weights, side, with_weight=True)
        total, x, y, xx, xy, yy = _moments(sums, sigma / side, 2)
        # a ridge of half a per cent of the window's variance: beside gaps too narrow for a slope the mean counts. With
        # a tenth a slope of the light is followed too little at edges: coarse speckle errs there by twice as much
        spread = 0.005 * (sigma / side) ** 2 * total
        xx, yy = xx + spread, yy + spread
        cofactors = np.stack([xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y])
        determinant = (cofactors * (total, x, y)).sum(axis=0)
        min_determinant = 1e-6 * float(determinant.max(initial=0.0)) + 1e-300
        coefficients = np.where(
            determinant > min_determinant, cofactors / np.maximum(determinant, min_determinant), 0.0
        )
        return cls(
            pixels=pixels, weights=weights, sigma=sigma, side=side, sums=sums, totals=totals, coefficients=coefficients
        )

    def block_sums(self, field: FloatImage) -> FloatArray:
        """Sum a field (P,) with the weights over the blocks, (h, w)."""
        return np.asarray(self.pixels.weighted_block_sums(field, self.weights, self.side)[0])

    def gain(self, sums: FloatArray) -> FloatImage:
        """Return the gain (h, w) at the blocks of a field with such `sums`."""
        return np.asarray((self.coefficients * _moments(sums, self.sigma / self.side, 1)).sum(axis=0), dtype=np.float32)

    def remainder(self, field: FloatImage, values: FloatImage) -> FloatImage:
        """Return what a field (P,) has beyond its gain times the `values` (P,)."""
        gain = self.pixels.from_blocks(self.gain(self.block_sums(field))[None], self.side)[0]
        return np.asarray(field - gain * values)


def local_gain_fits(
    values: FloatImage, weights: FloatImage, pixels: PixelMap, sigma: float | None
) -> tuple[GainFit, ...]:
    """Prepare the local gain over grey levels (k, P) in a window of `sigma` px; none where the gain is one number."""
    if sigma is None:
        return ()
    return tuple(GainFit.over(f, w, pixels, sigma) for f, w in zip(values, weights, strict=True))


def _moments(sums: FloatArray, sigma: float, order: int) -> FloatArray:
    """Moments 1, x, y of `order` 1, xx, xy, yy of 2, too, (3 or 6, h, w) about blocks in a window of `sigma` blocks."""
    reach = int(np.ceil(4 * sigma))
    window, arm = cv2.getGaussianKernel(2 * reach + 1, sigma), np.arange(-reach, reach + 1.0)[:, None]
    kernels = window, arm * window, arm * arm * window
    powers = [(x, total - x) for total in range(order + 1) for x in range(total, -1, -1)]
    return np.stack(
        [cv2.sepFilter2D(sums, -1, kernels[x], kernels[y], borderType=cv2.BORDER_CONSTANT) for x, y in powers]
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Brightness:
    """Brightness of the deformed images of a pass.

    Attributes
    ----------
    gain : ndarray, shape (k,)
        Of each light; 1 where it shows nothing.
    offset : ndarray, shape (k, 3)
        Of each light: its constant, and its slopes along the columns and rows of the rectangle around the pixels.
    fits : tuple
        `GainFit` of each light's local gain; None where the gain is one number.
    """

    gain: FloatArray
    offset: FloatArray
    fits: tuple[GainFit | None, ...]

    def inverse_gain(
        self, light: int, difference: FloatImage, shape: tuple[int, int], min_ratio: float
    ) -> tuple[FloatImage, int]:
        """Return 1 / a of a light from its difference f - g (P,), for `correct_brightness`, and the side of its blocks.

        It covers the rectangle of `shape` around the pixels. The local gain is that of these very grey levels, so that
        a displacement leaves no gain behind. It is at least `min_ratio` of the light's gain.
        """
        fit, gain, offset = self.fits[light], self.gain[light], self.offset[light]
        if fit is None:
            side, grid = max(shape), np.full((1, 1), 1 / gain)
        else:
            side = fit.side
            rows, columns = np.ogrid[: fit.sums.shape[0], : fit.sums.shape[1]]
            x, y = (columns + 0.5) * side - 0.5, (rows + 0.5) * side - 0.5
            plane = offset[0] + offset[1] * x + offset[2] * y
            local = fit.gain(fit.sums - fit.block_sums(difference) - plane * fit.totals)
            grid = 1 / np.maximum(local, np.float32(min_ratio * gain))
        if min(grid.shape) > 1:  # linear beyond the centres of the outermost blocks, too
            grid = np.pad(grid, 1, mode="reflect", reflect_type="odd")
            grid = np.clip(grid, 0, 1 / (min_ratio * gain), dtype=np.float32)
        else:
            grid = np.pad(grid, 1, mode="edge")
        size = grid.shape[1] * side, grid.shape[0]
        return np.asarray(cv2.resize(grid.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)), side


ELEMENTS = 300
"""Elements from which a light's gain and offset are found: their medians are known to 7 % of the scatter (derived)."""


def gain_and_offset(moments: FloatArray, centres: FloatArray, min_correlation: float) -> tuple[FloatArray, FloatArray]:
    """Find the gain (k,) and the offset (k, 3) of each light, from elements that show the same texture in both states.

    The gain is the ratio of the standard deviations, which noise that is alike in both states changes little. It is NaN
    for a light of which a tenth of the elements or fewer show the same, such as one that is off: chance alone makes
    one in 60 correlate (`SolverConstants.min_gain_correlation`). Its offset is the difference of the means.

    Parameters
    ----------
    moments : ndarray, shape (k, E, 6)
        Sums of w, w f, w g, w f f, w f g, w g g over elements.
    centres : ndarray, shape (E, 2)
        Column and row of the elements.
    min_correlation
        Correlation coefficient of both states from which an element counts; -1: all with a texture do.
    """
    gains, offsets = np.full(len(moments), np.nan), np.zeros((len(moments), 3))
    for light, sums in enumerate(moments):
        (total, f, g, *_), (fg, ff, gg) = sums.T, centred_products(sums)
        total = np.maximum(total, 1e-30)
        is_correlated = (ff > 0) & (gg > 0) & (fg > min_correlation * np.sqrt(ff * gg))
        offsets[light, 0] = (g.sum() - f.sum()) / total.sum()
        if is_correlated.sum() > 0.1 * (ff > 0).sum():
            sample = np.flatnonzero(is_correlated)[:: 1 + int(is_correlated.sum()) // ELEMENTS]
            gain = np.sqrt(gg[sample] / ff[sample])
            gains[light] = np.median(gain)
            offsets[light] = _offset_plane(centres[sample], (g[sample] - gain * f[sample]) / total[sample])
    return gains, offsets


def _offset_plane(points: FloatArray, values: FloatArray) -> FloatArray:
    """Fit constant and slopes (3,) of a plane to offsets (M,) at points (M, 2), with Cauchy weights.

    Reflections give single elements offsets, too: of the plane the fraction counts that it has of its mean square and
    of the scatter about it together.
    """
    middle, size = points.mean(axis=0), max(float(np.ptp(points, axis=0).max()), 1.0)
    basis = np.c_[np.ones(len(points)), (points - middle) / size]
    plane, scatter = np.array([np.median(values), 0.0, 0.0]), _scatter(values - np.median(values))
    for _ in range(3 if len(points) >= 12 else 0):  # of four elements for each unknown, until the scatter has settled
        if not scatter:
            break
        plane = robust_fit(basis[None], values[None, :, None], 1e-3 * len(points), scatter)[0, :, 0]
        scatter = _scatter(values - basis @ plane)
    square = float(((basis @ plane) ** 2).mean())
    plane = plane * square / max(square + scatter**2, 1e-300)
    slopes = plane[1:] / size
    return np.array([plane[0] - slopes @ middle, *slopes])


def _scatter(values: FloatArray) -> float:
    """Return the standard deviation of a normal distribution with the same median of the absolute values."""
    return 1.5 * float(np.median(np.abs(values)))


def window_width(
    values: FloatImage, gradient: FloatImage, weights: FloatImage, pixels: PixelMap, constants: SolverConstants
) -> float:
    """Find the standard deviation (px) of the gain's window from the speckle.

    It is a multiple of the correlation length ``sqrt(var f / mean |grad f|^2)``: the standard deviation of the Gaussian
    that makes such a speckle of white noise.

    Parameters
    ----------
    values, weights : ndarray, shape (k, P)
        Grey levels of the reference and their weights.
    gradient : ndarray, shape (2, k, P)
        Their gradient, grey levels per px.
    pixels
        P owned pixels.
    constants
        Of the solve.
    """
    step = SlidingWindow().step
    grids = [
        pixels.block_sums(np.stack([w * f, w * f * f, w * (gx * gx + gy * gy), w]), step).astype(np.float64)
        for f, gx, gy, w in zip(values, *gradient, weights, strict=True)
    ]

    def width(moments: list[FloatArray]) -> float:
        lengths = []
        for f, ff, slope, total in moments:
            if (textured := slope > 0).any():
                f, ff, slope, total = f[textured], ff[textured], slope[textured], total[textured]
                lengths.append(np.sqrt(np.median(np.maximum(ff - f * f / total, 0) / slope)))
        length = float(np.median(lengths)) if lengths else 0.0
        return max(constants.gain_window_factor * length, 6.0)  # one and a half blocks of its grid

    # over the region at first, in which shading counts as speckle
    sigma = width([grid.sum(axis=(1, 2))[:, None] for grid in grids])
    return width([np.stack([window_sums(one, sigma / step) for one in grid]) for grid in grids])
