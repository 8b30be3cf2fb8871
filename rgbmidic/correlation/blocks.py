"""The table of blocks of a comparison: what each light's residual shows, summed over squares of pixels.

Whatever a frame states beyond its solution is a function of this one table. A pixel's score ``w r grad f`` is
correlated over the reach of filters, demosaicing and speckle, and between the lights; the variance of its sum over
blocks wider than that reach holds all of it (the block estimator of the long-run variance).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates

from rgbmidic._kernels.owned_pixels import score_sums
from rgbmidic.correlation.assembly import block_side
from rgbmidic.correlation.reference import Reference
from rgbmidic.mesh.window import window_sums
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

if TYPE_CHECKING:
    from rgbmidic.correlation.residual import Residual


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockTable:
    """Sums over blocks, for each light or for all together.

    Attributes
    ----------
    sums : ndarray, shape (n, 4, h, w) or (n, 6, h, w)
        Scores ``w r grad f`` in x and y, their information ``w |grad f|^2`` in both, and the number of pixels with
        weight; then ``w grad f . grad`` of the grey levels of the reference and of the deformed image.
    side : int
        Of the blocks, px.
    reference
        Whose pixels they hold.
    """

    sums: FloatArray
    side: int
    reference: Reference

    @classmethod
    def of(cls, reference: Reference, side: int, rows: Iterable[tuple[FloatImage, ...]]) -> BlockTable:
        """Sum for each row of the table its lights' residuals, weights, and gradients along x and y, all (k, P).

        The last two sums need the grey levels of the reference, and one over their local mean.
        """
        pixels, sums = reference.pixels, []
        for fields in rows:
            out = np.empty((len(fields), *pixels.grid(side)), dtype=np.float32)
            columns = (*fields, *fields[:2])[:6]
            score_sums(*columns, pixels.lines, pixels.run_offsets, pixels.offsets, side, out)
            sums.append(out)
        return cls(sums=np.array(sums, dtype=np.float64), side=side, reference=reference)

    @classmethod
    def of_lights(cls, residual: Residual, weights: FloatImage, side: int) -> BlockTable:
        """Sum each light for itself, with the weights (k, P) of the solve."""
        reference = residual.reference
        lights = (
            (values[None] for values in light)
            for light in zip(residual.difference, weights, *reference.gradient, strict=True)
        )
        return cls.of(reference, side, map(tuple, lights))

    @classmethod
    def of_all(cls, residual: Residual, weights: FloatImage) -> BlockTable:
        """Sum all lights together, over blocks that grow with the elements."""
        reference = residual.reference
        side = block_side(reference.pixels, reference.mesh.size, reference.constants)
        states = residual.difference, weights, *reference.gradient, reference.values, reference.inverse_level
        return cls.of(reference, side, [states])

    def at(self, grids: AnyArray, points: FloatArray) -> FloatArray:
        """Interpolate grids (n, h, w) at points (M, 2) in px, (n, M)."""
        coordinates = (points[:, ::-1] - self.reference.pixels.bounds[:2]).T / self.side - 0.5
        return np.stack([map_coordinates(grid, coordinates, order=1, mode="nearest") for grid in grids])

    def displacement(self, range_: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement of each light from the solution in a window of so many px (standard deviation).

        Returns
        -------
        displacement : ndarray, shape (k, 2, h, w)
            In x and y, px.
        variance : ndarray, shape (k, h, w)
            By chance in each direction, px²: from the scatter of the blocks' scores about it.
        information : ndarray, shape (k, h, w)
            Mean over the window, of each direction.
        """
        score, axis_information = self.sums[:, :2], self.sums[:, 2] / 2
        information = np.maximum(self._mean(axis_information, range_), 1e-30)
        displacement = self._mean(score, range_) / information[:, None]
        blocks = 4 * np.pi * (range_ / self.side) ** 2  # that a window holds
        square = ((score - displacement * axis_information[:, None]) ** 2).mean(axis=1)
        mean_square = self._mean(square, self.reference.constants.bias_range)
        return displacement, mean_square / information**2 / blocks, information

    def _mean(self, grids: FloatArray, range_: float) -> FloatArray:
        """Mean of grids (..., h, w) over a window of a standard deviation of so many px."""
        means = [window_sums(grid, range_ / self.side) for grid in grids.reshape(-1, *grids.shape[-2:])]
        return np.reshape(means, grids.shape)

    def design_effect(self) -> FloatArray:
        """Variance of the scores over their information: products xx, xy, yy of each light, (k, 3, h, w).

        xx + yy is 1 for white noise and ideal weights. They are raised where blocks are few, so that an error over its
        stated uncertainty has the variance 1.
        """
        constants = self.reference.constants
        prior = constants.prior_blocks * self.side**2
        window = 4 * np.pi * (constants.score_range / self.side) ** 2
        effects = []
        for score, count in zip(self._relative(self.sums[:, :2]), self.sums[:, 3], strict=True):
            (x, y), typical, pixel_count = score, _typical_square(score, count), self.windowed_sums(count)
            # an estimate from n blocks has 2 n degrees of freedom; the mean of its inverse is n / (n - 1) times too
            # large; of one block, less one, a quarter: the variance is hardly known, and stated 4 times larger
            number = np.minimum(window * pixel_count, count.sum()) / self.side**2
            small_sample_factor = number / np.maximum(number - 1, 0.25)
            products = (x * x, typical), (x * y, 0.0), (y * y, typical)
            effects.append(
                [
                    (self.windowed_sums(square) + prior * mean) / (pixel_count + prior) * small_sample_factor
                    for square, mean in products
                ]
            )
        return np.array(effects)

    def correlation(self) -> FloatArray:
        """Correlation of the scores of each two lights over the blocks around that both see, (k, k, h, w)."""
        scores, counts, lights = self._relative(self.sums[:, :2]), self.sums[:, 3], range(len(self.sums))
        prior = self.reference.constants.prior_blocks * self.side**2
        typical = [2 * prior * _typical_square(score, count) for score, count in zip(scores, counts, strict=True)]
        out = np.zeros((len(scores), *counts.shape))
        for a, b in product(lights, lights):
            common = (counts[a] > 0) & (counts[b] > 0)
            along, *squares = (
                self.windowed_sums(common * (scores[i] * scores[j]).sum(axis=0)) for i, j in ((a, b), (a, a), (b, b))
            )
            scale = np.sqrt((squares[0] + typical[a]) * (squares[1] + typical[b]))
            np.divide(along, scale, out=out[a, b], where=scale > 0)
        return out

    def sensitivity(self, points: FloatArray) -> FloatArray:
        """Texture of the deformed image over that of the reference, along the gradient of the latter, at points (M, 2).

        Where glare or paint has changed since, the deformed image shows less of it. 1 where there is no texture.
        """
        reference, deformed = self.at(self.sums[0, 4:], points)
        return np.asarray(np.divide(deformed, reference, out=np.ones_like(deformed), where=reference > 0))

    def windowed_sums(self, grid: AnyArray) -> AnyArray:
        """Sums of a grid over the window in which scores are averaged, up to a factor."""
        return window_sums(grid, self.reference.constants.score_range / self.side)

    def typical_ratio(self, scores: FloatArray) -> float:
        """Typical square of other scores (2, h, w) of all lights together over that of the table's."""
        numerator, denominator = (
            _typical_square(self._relative(values[None])[0], self.sums[0, 3]) for values in (scores, self.sums[0, :2])
        )
        return numerator / denominator if denominator > 0 else 0.0

    def _relative(self, scores: FloatArray) -> FloatArray:
        """Scores (k, 2, h, w) over the root of the information around them.

        A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
        smooth, and averaged, is its ratio to the information.
        """
        smoothing, out = self.reference.constants.information_smoothing, np.zeros_like(scores)
        for (information, count), score, relative in zip(self.sums[:, 2:4], scores, out, strict=True):
            level = window_sums(information, smoothing) / np.maximum(window_sums(count, smoothing), 1e-6)
            np.divide(score, np.sqrt(level), out=relative, where=(level > 0) & (count > 0))
        return out


def _typical_square(score: FloatArray, count: FloatArray) -> float:
    """Square of a relative score (2, h, w) in one direction, per pixel, typical of the region's blocks.

    A median, so that what does not match has no part in it: ``x^2 + y^2`` of two independent Gaussian scores is
    distributed exponentially, with a median of 2 ln 2 variances.
    """
    is_full = count >= 0.5 * count.max(initial=0.0)
    square = (score**2).sum(axis=0)[is_full] / np.maximum(count[is_full], 1.0)
    return float(np.median(square)) / (2 * np.log(2)) if square.size else 0.0
