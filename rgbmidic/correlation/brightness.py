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
from rgbmidic.mesh import PixelMap
from rgbmidic.mesh.pixel_map import SlidingWindow, window_means
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

BrightnessModel = float | Literal["auto", "constant", "none"]
"""The setting ``solver.brightness``."""


def block_side(sigma: float) -> int:
    """Side (px) of the blocks on which a gain is estimated: the largest power of 2 up to the window's sigma."""
    return int(2 ** np.floor(np.log2(sigma)))


@dataclass(frozen=True, slots=True, kw_only=True)
class GainFit:
    """Gains of fields over others, by local linear regression in a Gaussian window (Fan and Gijbels 1996).

    Around a block the gain is linear, and such that the field and the gain times the other one have the same weighted
    sum and first moments in the window; a ridge holds its slope back where the pixels do not determine it.

    Attributes
    ----------
    pixels
        P owned pixels.
    weights : ndarray, shape (k, P), float32
        Weights of the pixels in each of the k fields.
    sigma
        Standard deviation of the window, px.
    side
        Of the blocks, px.
    sums, totals : ndarray, shape (k, h, w)
        Sums over blocks of the other fields with the weights, and of these.
    coefficients : ndarray, shape (3, k, h, w)
        Factors that give the gains at a block from the weighted sums of fields and their first moments around it.
    """

    pixels: PixelMap
    weights: FloatImage
    sigma: float
    side: int
    sums: FloatImage
    totals: FloatImage
    coefficients: FloatImage

    @classmethod
    def over(cls, values: FloatImage, weights: FloatImage, pixels: PixelMap, sigma: float) -> GainFit:
        """Prepare the gains over `values` (k, P) with `weights` (k, P)."""
        side, count = block_side(sigma), len(values)
        sums = pixels.weighted_block_sums(values, weights, side, with_weights=True)
        total, x, y, xx, xy, yy = _moments(sums[:count].astype(np.float64), sigma / side, 2)
        # a ridge of half a per cent of the window's variance: beside gaps too narrow for a slope the mean counts. With
        # a tenth a slope of the light is followed too little at edges: coarse speckle errs there by twice as much
        spread = 0.005 * (sigma / side) ** 2 * total
        xx, yy = xx + spread, yy + spread
        cofactors = np.stack([xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y])
        determinant = (cofactors * (total, x, y)).sum(axis=0)
        floor = 1e-6 * determinant.max(axis=(1, 2), keepdims=True, initial=0.0) + 1e-300
        coefficients = np.where(determinant > floor, cofactors / np.maximum(determinant, floor), 0.0).astype(np.float32)
        return cls(
            pixels=pixels,
            weights=weights,
            sigma=sigma,
            side=side,
            sums=sums[:count],
            totals=sums[count:],
            coefficients=coefficients,
        )

    def block_sums(self, fields: FloatImage) -> FloatImage:
        """Sum fields (k, P) with the weights over the blocks, (k, h, w)."""
        return self.pixels.weighted_block_sums(fields, self.weights, self.side)

    def gains(self, sums: FloatImage) -> FloatImage:
        """Return the gains (k, h, w) at the blocks of fields with such `sums`."""
        return np.asarray((self.coefficients * _moments(sums, self.sigma / self.side, 1)).sum(axis=0))

    def remainder(self, fields: FloatImage, values: FloatImage) -> FloatImage:
        """Return what fields (k, P) have beyond their gains times the `values` (k, P)."""
        gains = self.pixels.from_blocks(self.gains(self.block_sums(fields)), self.side)
        return np.asarray(fields - np.multiply(gains, values, out=gains))


def _moments(sums: AnyArray, sigma: float, order: int) -> AnyArray:
    """Moments of grids (k, h, w) about each block in a window of `sigma` blocks, (3 or 6, k, h, w).

    They are 1, x, y of `order` 1, and xx, xy, yy of 2, too.
    """
    reach = int(np.ceil(4 * sigma))
    window, arm = cv2.getGaussianKernel(2 * reach + 1, sigma), np.arange(-reach, reach + 1.0)[:, None]
    kernels = window, arm * window, arm * arm * window
    powers = [(x, total - x) for total in range(order + 1) for x in range(total, -1, -1)]
    out = np.empty((len(powers), *sums.shape), dtype=sums.dtype)
    for moments, (x, y) in zip(out, powers, strict=True):
        for grid, moment in zip(sums, moments, strict=True):
            cv2.sepFilter2D(grid, -1, kernels[x], kernels[y], dst=moment, borderType=cv2.BORDER_CONSTANT)
    return out


def inverse_gains(
    difference: FloatImage,
    gain: FloatArray,
    offset: FloatArray,
    fit: GainFit | None,
    shape: tuple[int, int],
    min_ratio: float,
) -> tuple[FloatImage, int]:
    """Return 1 / a of the lights from their differences f - g (k, P), for `correct_brightness`.

    The local gain is that of these very grey levels, so that a displacement leaves no gain behind. It is at least
    `min_ratio` of the light's `gain` (k,); a light that shows nothing, whose gain is NaN, has 1.

    Returns
    -------
    inverse_gains : ndarray, shape (k, h + 2, W), float32
        In rows of blocks that cover the rectangle of `shape` around the pixels, and one more all around.
    side : int
        Of the blocks, px.
    """
    one = np.float32(1)
    typical = np.nan_to_num(gain, nan=1.0)[:, None, None].astype(np.float32)
    if fit is None:
        side, grids = max(shape), 1 / typical
    else:
        side, (_, height, width) = fit.side, fit.sums.shape
        rows, columns = np.ogrid[:height, :width]
        x, y = (columns + 0.5) * side - 0.5, (rows + 0.5) * side - 0.5
        constant, along_x, along_y = offset.T[:, :, None, None]
        plane = (constant + along_x * x + along_y * y).astype(np.float32)
        local = fit.gains(fit.sums - fit.block_sums(difference) - plane * fit.totals)
        grids = np.where(np.isfinite(gain[:, None, None]), 1 / np.maximum(local, min_ratio * typical), one)
    margin = (0, 0), (1, 1), (1, 1)
    if min(grids.shape[1:]) > 1:  # linear beyond the centres of the outermost blocks, too
        grids = np.pad(grids, margin, mode="reflect", reflect_type="odd")
        grids = np.clip(grids, 0, 1 / (min_ratio * typical))
    else:
        grids = np.pad(grids, margin, mode="edge")
    out = np.empty((*grids.shape[:2], grids.shape[2] * side), dtype=np.float32)
    for grid, image in zip(grids, out, strict=True):
        cv2.resize(grid, image.shape[::-1], dst=image, interpolation=cv2.INTER_LINEAR)
    return out, side


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
    total, f, g = np.moveaxis(moments[..., :3], 2, 0)
    fg, ff, gg = centred_products(moments)
    offsets[:, 0] = (g.sum(axis=1) - f.sum(axis=1)) / np.maximum(total.sum(axis=1), 1e-30)
    is_correlated = (ff > 0) & (gg > 0) & (fg > min_correlation * np.sqrt(ff * gg))
    samples, levels = {}, {}
    for light, candidates in enumerate(is_correlated):
        if candidates.sum() > 0.1 * (ff[light] > 0).sum():
            samples[light] = sample = np.flatnonzero(candidates)[:: 1 + int(candidates.sum()) // ELEMENTS]
            gain = np.sqrt(gg[light, sample] / ff[light, sample])
            gains[light] = np.median(gain)
            levels[light] = (g[light, sample] - gain * f[light, sample]) / total[light, sample]
    if samples:
        offsets[[*samples]] = _offset_planes([centres[sample] for sample in samples.values()], [*levels.values()])
    return gains, offsets


def _offset_planes(points: list[FloatArray], values: list[FloatArray]) -> FloatArray:
    """Fit constant and slopes (k, 3) of planes to the lights' offsets (M,) at points (M, 2), with Cauchy weights.

    Reflections give single elements offsets, too: of the plane the fraction counts that it has of its mean square and
    of the scatter about it together.
    """
    numbers = np.array([*map(len, values)])
    functions, planes = np.zeros((len(values), 4, numbers.max())), np.zeros((len(values), 3))  # 0 counts nowhere
    middle = np.array([one.mean(axis=0) for one in points])
    size = np.array([max(float(np.ptp(one, axis=0).max()), 1.0) for one in points])
    for light, (at, value) in enumerate(zip(points, values, strict=True)):
        functions[light, :, : len(value)] = np.ones(len(value)), *((at - middle[light]) / size[light]).T, value
        planes[light, 0] = np.median(value)
    basis, held = functions[:, :3], np.multiply.outer(numbers, np.diag([1e-9, 1e-3, 1e-3]))
    for _ in range(12):  # 4 do
        fitted = np.einsum("la,lam->lm", planes, basis)  # no BLAS, whose sums may depend on threads
        deviation = np.abs(functions[:, 3] - fitted)
        # the standard deviation of a normal distribution with the same median
        scatter = [1.5 * np.partition(one[:n], n // 2)[n // 2] for one, n in zip(deviation, numbers, strict=True)]
        weight = 1 / (1 + (deviation / np.maximum(scatter, 1e-30)[:, None]) ** 2)
        sums, last = np.einsum("lam,lbm->lab", basis * weight[:, None], functions), planes
        planes = np.linalg.solve(sums[..., :3] + held, sums[..., 3:])[..., 0]
        planes = np.where(numbers[:, None] >= 12, planes, last)  # four elements for each unknown
        if (np.abs(planes - last).max(axis=1) <= np.multiply(0.01, scatter)).all():  # it is known to less
            break
    square = (fitted**2).sum(axis=1) / numbers
    planes *= (square / np.maximum(square + np.square(scatter), 1e-300))[:, None]
    slopes = planes[:, 1:] / size[:, None]
    return np.column_stack([planes[:, 0] - (slopes * middle).sum(axis=1), slopes])


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
    grids, products = [], np.empty((4, values.shape[1]), dtype=np.float32)
    for f, gx, gy, w in zip(values, *gradient, weights, strict=True):
        np.multiply(f, w, out=products[0])
        np.multiply(f, products[0], out=products[1])
        np.multiply(gx, gx, out=products[2])
        products[2] += np.multiply(gy, gy, out=products[3])
        products[2] *= w
        products[3] = w
        grids.append(pixels.block_sums(products, step).astype(np.float64))

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
    return width([np.stack([window_means(one, sigma / step) for one in grid]) for grid in grids])
