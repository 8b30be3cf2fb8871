"""What the two states look like at the displacement found: do they match, how bright, how far apart, where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from rgbmidic._kernels.correlation import element_moments, element_vector, interpolate_nodal
from rgbmidic._kernels.grid import block_sums, score_sums
from rgbmidic.correlation.problem import Reference
from rgbmidic.correlation.system import factorise
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage

__all__ = ["Comparison"]


_MATCHED = (0.4, 0.6)
"""Correlation coefficient under which the images of an element do not match: for poor images and for good ones."""
_WORSE = 8.0
"""In between: how many times farther from 1 than the median of the elements."""
_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual."""
_RANGE = 8.0
"""Standard deviation (px) of the window in which the variance of the residual is estimated."""
_COARSE = 4
"""Reduction of the grid on which that window is applied."""
_BLOCK = 13
"""Side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter."""
_TRUST = 0.75
"""Power of the inverse variance that makes the weight: under 1, for the variance is itself uncertain."""
_LEAST_RATIO = 1e-2
"""Least share of a residual's variance that is taken to displace."""
_EVEN = 0.6
"""Standard deviation (blocks) of the window in which the information of a block is taken."""
_MOSTLY_FITTED = 2.0
"""Nodes per block from which (elements under 9 px) the sums of blocks are checked against `_least_ratio`..."""
_FEW_BLOCKS = 9
"""...and blocks in the region up to which they are."""
_REACH = 3
"""Farthest move (px) of the autocorrelations in it."""
_SCORE_RANGE = 30.0
"""Standard deviation (px) of the window over which block sums are averaged."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Both states at the owned pixels of the reference.

    Attributes
    ----------
    reference
        The reference state.
    values : ndarray, shape (k, P), float32
        Grey levels f of the reference, corrected for brightness.
    warped : ndarray, shape (k, P), float32
        Grey levels g(x + u); NaN outside the image.
    weights : ndarray, shape (k, P), float32
        Weights given, brought back by the displacement.
    """

    reference: Reference
    values: FloatImage
    warped: FloatImage
    weights: FloatImage

    @cached_property
    def residual(self) -> FloatImage:
        """f - g(x + u), shape (k, P); 0 where g is not known."""
        return np.asarray(np.nan_to_num(self.values - self.warped, nan=0.0), dtype=np.float32)

    def without(self, deviation: FloatImage) -> Comparison:
        """The same, less what a displacement known to be missing (2, P), in px, leaves in the residual."""
        x, y = self.reference.gradient_x * deviation[0], self.reference.gradient_y * deviation[1]
        return replace(self, values=self.values - x - y)

    def matched(self, least: float | None = None) -> BoolArray:
        """Elements (E,) whose images match: zero-mean correlation coefficient of all lights together.

        Elements without weight or texture in the reference say nothing and count as matched. `least` is the
        coefficient from which an element matches; None judges it by what the others reach.
        """
        mesh = self.reference.mesh
        moments = np.zeros((len(mesh.elements), 6))
        fg, ff, gg = np.zeros((3, len(mesh.elements)))
        for value, warped, weight in zip(self.values, self.warped, self.weights, strict=True):
            element_moments(value, warped, weight, self.reference.pixels.offsets, moments)
            total, f, g, f2, product, g2 = moments.T
            total = np.maximum(total, 1e-30)
            fg += product - f * g / total
            ff += f2 - f * f / total
            gg += g2 - g * g / total
        own = _correlation(fg, ff, gg)
        # a few speckles can match by chance; those of all elements around a node hardly
        around = _correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
        coefficient = np.minimum(own, np.median(around[mesh.elements], axis=1))
        if least is None:
            textured = coefficient[ff > 0]
            typical = float(np.median(textured)) if textured.size else 1.0
            least = float(np.clip(1 - _WORSE * (1 - typical), *_MATCHED))
        return np.asarray(coefficient >= least)

    def misfit(self, weights: FloatImage, measured: BoolArray) -> FloatArray:
        """Weighted rms residual around each node (N,), over its median: 1 is ordinary, 3 is suspicious.

        `weights` (k, P) are those of the solve, in units of the inverse variance of the residual.
        """
        mesh, offsets = self.reference.mesh, self.reference.pixels.offsets
        owner = np.repeat(np.arange(len(mesh.elements)), np.diff(offsets))
        sums = [
            np.asarray(np.bincount(owner, weights=part.sum(axis=0), minlength=len(mesh.elements)), dtype=np.float64)
            for part in (weights * self.residual**2, weights > 0)
        ]
        around = mesh.to_nodes(sums[0]) / np.maximum(mesh.to_nodes(sums[1]), 1.0)
        typical = float(np.median(around[measured])) if measured.any() else 0.0
        return np.sqrt(around / typical) if typical > 0 else np.ones_like(around)

    def brightness(self, kind: str) -> FloatImage:
        """Reference grey levels (k, P) brought to the brightness and contrast of the deformed images.

        ``"global"``: one gain and offset per light. ``"local"``: gain and offset as linear shape functions on the
        mesh (grey-level correction, paper, section 2.2). In both, f is taken as ``a g + b``; what is returned is
        ``(f - b) / a`` of the uncorrected reference.
        """
        correct = {"global": self._global, "local": self._local}[kind]
        return np.stack([correct(light) for light in range(len(self.values))])

    def _global(self, light: int) -> FloatImage:
        f: FloatImage = self.reference.values[light]
        g: FloatImage = self.warped[light]
        weight = np.where(np.isfinite(g), self.weights[light], np.float32(0)).astype(np.float64)
        total = weight.sum()
        if not total:
            return f
        g = np.asarray(np.nan_to_num(g))
        mean_f, mean_g = (weight * f).sum() / total, (weight * g).sum() / total
        # both images carry the same noise: the ratio of the deviations is not attenuated by it
        spread_f, spread_g = (float((weight * (i - m) ** 2).sum()) for i, m in ((f, mean_f), (g, mean_g)))
        gain = np.sqrt(spread_f / spread_g) if spread_f > 0 and spread_g > 0 else 1.0
        corrected: FloatImage = np.asarray((f - mean_f) / gain + mean_g, dtype=np.float32)
        return corrected

    def _local(self, light: int) -> FloatImage:
        reference, pixels = self.reference, self.reference.pixels
        f: FloatImage = reference.values[light]
        g: FloatImage = np.nan_to_num(self.warped[light])
        weight = np.where(np.isfinite(self.warped[light]), self.weights[light], np.float32(0))
        if not weight.any():
            return f
        scale = float(np.sqrt((weight * g * g).sum() / weight.sum())) or 1.0
        g = g / np.float32(scale)
        system = reference.equations.matrix(reference.blocks(weight, g, np.ones_like(g)))
        smooth = 1e-3 * system.diagonal().mean() * reference.equations.smoothness
        parts = np.zeros((len(reference.mesh.elements), 3, 2))
        wf = weight * f
        element_vector(wf * g, wf, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, parts)
        nodal = factorise((system + smooth).tocsc())(reference.equations.vector(parts)).reshape(-1, 2)
        fields = np.empty((2, f.size), dtype=np.float32)
        interpolate_nodal(
            nodal, reference.mesh.elements, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, fields
        )
        gain = np.maximum(fields[0] / np.float32(scale), np.float32(0.05))
        corrected: FloatImage = np.asarray((f - fields[1]) / gain, dtype=np.float32)
        return corrected

    def precision(self) -> tuple[FloatImage, FloatImage]:
        """Factor (k, P) on the weights: inverse variance of a light around each pixel, and robust at the pixel;
        and the derivative of the robust loss over that factor (k, P), which the uncertainty needs.

        The variance is that of the residual, times the part of it that displaces: brightness and contrast that change
        slowly leave a residual which the gradient of the speckle averages out, blurred noise one that it does not. It
        holds whatever spoils a light there: camera noise, demosaicing, the erratic part of a reflection. Its unit is
        the median over all lights. The pixel's own factor is that of a Student distribution, so that dust or a
        fragment does not spoil a node.
        """
        variance = self._local_variance()
        seen = self.weights > 0
        typical = _typical(variance, seen)
        if typical <= 0:
            return np.ones_like(self.weights), np.ones_like(self.weights)
        texture = float(np.var(self.values[seen], dtype=np.float64))
        variance = np.maximum(variance, np.float32(max(0.1 * typical, 1e-6 * texture)))
        ratio = self.residual**2 / variance
        robust = (_FREEDOM + 1) / (_FREEDOM + ratio)
        bend = (_FREEDOM - ratio) / (_FREEDOM + ratio)
        variance *= self._displacing(variance)
        factor = (_typical(variance, seen) / variance) ** _TRUST * robust
        return np.asarray(factor, dtype=np.float32), np.asarray(bend, dtype=np.float32)

    def _displacing(self, variance: FloatImage) -> FloatImage:
        """Variance of each light's scores over what white noise of that `variance` (k, P) would give, (k, P)."""
        pixels = self.reference.pixels
        sums = self._score_sums(np.asarray((self.weights > 0) / variance, dtype=np.float32))
        ratios = [self._score_ratios(*light)[0] for light in sums]
        return np.stack([pixels.from_blocks(np.maximum(r[0] + r[2], _LEAST_RATIO), _BLOCK) for r in ratios])

    def _local_variance(self) -> FloatImage:
        """Weighted Gaussian mean (k, P) of the squared residual around each pixel, found on a coarser grid."""
        index, shape = self.reference.pixels.blocks(_COARSE)
        sums = np.zeros((2, len(self.weights), shape[0] * shape[1]), dtype=np.float32)
        for total, field in zip(sums, (self.residual**2 * self.weights, self.weights), strict=True):
            block_sums(field, index, total)
        total, share = (np.stack([_blur(one.reshape(shape), _RANGE / _COARSE) for one in lights]) for lights in sums)
        mean = total / np.maximum(share, np.float32(1e-6))
        return np.stack([self.reference.pixels.from_blocks(one, _COARSE) for one in mean])

    def noise_hessian(self, weights: FloatImage) -> FloatArray:
        """Element blocks (E, 3, 3, 3) of the Hessian that noise alone has: what the residual, which holds the noise of
        both images, differs by from pixel to pixel."""
        pixels = self.reference.pixels
        top, left, _, _ = pixels.bounds
        total = np.zeros((len(self.reference.mesh.elements), 3, 3, 3))
        for weight, residual in zip(weights, self.residual, strict=True):
            window = pixels.window(residual) / np.float32(np.sqrt(2))
            slopes = [np.diff(window, axis=axis, append=0)[pixels.rows - top, pixels.columns - left] for axis in (1, 0)]
            total += self.reference.blocks(weight, *slopes)
        return total

    def score_covariance(self, step_weights: FloatImage, measured: int) -> FloatArray:
        """Element blocks (E, 3, 3, 3) of the covariance of the right-hand side, from the residual itself.

        The score ``q = sum_j w_j r_j grad f_j`` of a pixel is correlated over the reach of filters, demosaicing and
        speckle and between the lights; the variance of its sum over blocks wider than that reach holds all of it
        (the block estimator of the long-run variance). Fitting `measured` nodes has taken their share out of it.
        """
        used = np.asarray(step_weights.any(axis=0), dtype=np.float32)
        x, y, information, _ = self._score_sums(step_weights).sum(axis=0)
        index, shape = self.reference.pixels.blocks(_BLOCK)
        count = np.zeros((1, information.size), dtype=np.float32)
        block_sums(used[None], index, count)
        ratios, level = self._score_ratios(x, y, information, count.reshape(shape).astype(np.float64))
        share = _BLOCK**2 * measured / max(float(used.sum()), 1.0)
        ratios = ratios / (1 - min(share, 0.75))
        if share > _MOSTLY_FITTED or used.sum() < _FEW_BLOCKS * _BLOCK**2:  # the fit leaves little of a block's sum
            mean = float((ratios[0] + ratios[2]).mean())
            ratios *= max(1.0, self._least_ratio(step_weights, measured) / max(mean, 1e-30))
        return self._spread(level * ratios, used)

    def _least_ratio(self, weights: FloatImage, measured: int) -> float:
        """Least variance of the scores over their information, from residual and gradient at short distances apart.

        ``sum_d R_r(d) R_g(d) / R_g(0)`` with the autocorrelations of ``sqrt(w) r`` and of ``sqrt(w) grad f``: what
        noise that no fit has touched, correlated by filters and demosaicing, would give.
        """
        pixels, reference = self.reference.pixels, self.reference
        total = information = independent = 0.0
        for light, weight in enumerate(weights):
            number = float((weight > 0).sum())
            if not number:
                continue
            root = np.sqrt(weight)
            parts = self.residual[light], reference.gradient_x[light], reference.gradient_y[light]
            noise, *slopes = (_autocorrelation(pixels.window(root * part)) for part in parts)
            gradient = slopes[0] + slopes[1]
            total += float((noise * gradient).sum()) / number
            information += float(gradient[0])
            independent += number * float(noise[0] ** 2 / max((noise**2).sum(), 1e-300))
        freedom = 1 - 2 * measured / max(independent, 1e-30)
        return total / max(information, 1e-300) / max(freedom, 0.1)

    def _score_sums(self, weights: FloatImage) -> FloatArray:
        """Sums (k, 4, rows, columns) over blocks of the lights' scores in x and y, their information, and pixels."""
        reference = self.reference
        index, shape = reference.pixels.blocks(_BLOCK)
        sums = np.zeros((len(weights), 4, shape[0] * shape[1]))
        score_sums(self.residual, weights, reference.gradient_x, reference.gradient_y, index, sums)
        return sums.reshape(len(weights), 4, *shape)

    def _score_ratios(
        self, x: FloatArray, y: FloatArray, information: FloatArray, count: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Covariance (xx, xy, yy) of the scores of blocks over their information, and the information per pixel.

        A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
        smooth, and averaged, is its ratio to the information; xx + yy is 1 for white noise and ideal weights.
        """
        level = _blur(information, _EVEN) / np.maximum(_blur(count, _EVEN), 1e-6)
        scale = np.divide(1, np.sqrt(level), out=np.zeros_like(level), where=(level > 0) & (count > 0))
        x, y = x * scale, y * scale
        around = _blur(count, _SCORE_RANGE / _BLOCK)
        # half a block's worth of the mean over the region: beside a hole few blocks speak
        prior, total = 0.5 * _BLOCK**2, max(float(count.sum()), 1.0)
        ratios = [
            (_blur(product, _SCORE_RANGE / _BLOCK) + prior * float(product.sum()) / total) / (around + prior)
            for product in (x * x, x * y, y * y)
        ]
        return np.stack(ratios), level

    def _spread(self, density: FloatArray, used: FloatImage) -> FloatArray:
        """Element blocks of a score variance per pixel (xx, xy, yy) that is constant in each element."""
        mesh, reference = self.reference.mesh, self.reference
        top, left, _, _ = reference.pixels.bounds
        place = mesh.nodes[mesh.elements].mean(axis=1) - (left, top)
        centre = np.round(place / _BLOCK - 0.5).astype(int)
        column = np.clip(centre[:, 0], 0, density.shape[2] - 1)
        row = np.clip(centre[:, 1], 0, density.shape[1] - 1)
        # summed over the pixels in use: at an edge they do not cover the element evenly
        mass = reference.blocks(used, np.ones_like(used), np.zeros_like(used))[..., :1]
        return np.asarray(mass * density[:, row, column].T[:, None, None, :])


def _autocorrelation(image: FloatImage) -> FloatArray:
    """Sums of products of an image with itself moved by up to `_REACH` rows and columns, the one not moved first."""
    rows, columns = image.shape
    sums = [float(np.vdot(image, image))]
    for i in range(_REACH + 1):
        for j in range(-_REACH if i else 1, _REACH + 1):
            if i >= rows or abs(j) >= columns:
                continue
            first = image[i:, max(j, 0) : columns + min(j, 0)]
            second = image[: rows - i, max(-j, 0) : columns - max(j, 0)]
            sums += [float(np.vdot(first, second))] * 2  # and the opposite move
    return np.array(sums)


def _typical(variance: FloatImage, seen: BoolArray) -> float:
    """Median where `seen`, from about 100 000 values."""
    return float(np.median(variance[seen][:: max(1, int(seen.sum()) // 100_000)])) if seen.any() else 0.0


def _blur(image: AnyArray, sigma: float) -> AnyArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))


def _correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from centred products; 1 where the reference has nothing to compare, 0 where only the
    deformed image has nothing."""
    empty = ff <= 1e-9 * ff.max(initial=0.0)
    blank = gg <= 1e-9 * ff
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    return np.where(empty, 1.0, np.where(blank, 0.0, fg / np.where(empty | blank, 1.0, scale)))
