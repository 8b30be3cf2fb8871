"""The table of blocks of a comparison: what each light's residual shows, summed over squares of pixels.

A pixel's score is ``w r h``, with the weight w, the residual r and the gradient h of the equation that is solved (docs:
how it works). It is correlated over the reach of filters, demosaicing and speckle, and between the lights; the variance
of its sum over blocks wider than that reach holds all of it (the block estimator of the long-run variance).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from rgbmidic._kernels.owned_pixels import score_sums
from rgbmidic.correlation.reference import Reference
from rgbmidic.mesh.pixel_map import window_means
from rgbmidic.typing import AnyArray, FloatArray, FloatImage

if TYPE_CHECKING:
    from rgbmidic.correlation.residual import Residual


@dataclass(frozen=True, slots=True, kw_only=True)
class BlockTable:
    """Sums over blocks, of each light or of all together.

    Attributes
    ----------
    sums : ndarray, shape (k, 4, h, w)
        Scores ``w r h`` in x and y, their information ``w |h|^2`` in both, and the number of pixels with weight.
    common : ndarray, shape (4, h, w)
        Sums over the lights: scores in x and y with the gradient of each light's own image, and ``w h . grad`` of the
        grey levels of the reference and of the deformed image. (0, h, w) for a gradient that is not the solve's.
    side : int
        Of the blocks, px.
    reference
        Whose pixels they hold.
    """

    sums: FloatArray
    common: FloatArray
    side: int
    reference: Reference

    @classmethod
    def of(
        cls,
        residual: Residual,
        weights: FloatImage,
        *,
        gradient: FloatImage | None = None,
        deviation: FloatImage | None = None,
    ) -> BlockTable:
        """Sum each light for itself.

        Parameters
        ----------
        residual
            The comparison.
        weights : ndarray, shape (k, P), float32
            Of the solve.
        gradient : ndarray, shape (2, k, P), float32, optional
            With which scores are made; None: that of the solve.
        deviation : ndarray, shape (E, 2, 6), float32, optional
            What the field has beyond the solution (`curved_deviation`), whose effect is no part of the residual.
        """
        reference, pixels = residual.reference, residual.reference.pixels
        side = reference.constants.score_block_side
        grid = pixels.grid(side)
        sums = np.empty((len(weights), 4, *grid), dtype=np.float32)
        common = np.empty((4 if gradient is None else 0, *grid), dtype=np.float32)
        gradients = (reference.gradient, reference.texture.images) if gradient is None else (gradient, gradient)
        # where the last sums are asked for they need the grey levels of the reference, and one over their local mean
        levels = (reference.values, reference.inverse_level) if gradient is None else (weights, weights)
        polynomials = np.empty((0, 2, 6), dtype=np.float32) if deviation is None else deviation
        fields = residual.difference, weights, *gradients[0], *gradients[1], *levels
        geometry = pixels.local_x, pixels.local_y, pixels.lines, pixels.run_offsets, pixels.offsets
        score_sums(*fields, polynomials, *geometry, side, sums, common)
        return cls(sums=sums.astype(np.float64), common=common.astype(np.float64), side=side, reference=reference)

    def over_elements(self) -> BlockTable:
        """Merge blocks where elements are larger: what these cannot follow is alike over them."""
        reference = self.reference
        side = reference.constants.merged_block_side(reference.mesh.size, reference.pixels.bounds[2:])
        sums, common = (_merged(grids, side // self.side) for grids in (self.sums, self.common))
        return replace(self, sums=sums, common=common, side=side)

    def together(self) -> BlockTable:
        """Return the table of all lights as one, whose pixels are those of the light that shows most of a block."""
        sums = self.sums.sum(axis=0)
        sums[3] = self.sums[:, 3].max(axis=0)
        return replace(self, sums=sums[None])

    def with_common_scores(self) -> BlockTable:
        """Put back what the fit has taken of the scores that the lights have in common, by their information of it."""
        reference = self.reference
        lost = 1 / np.sqrt(reference.residual_leverage) - 1
        if np.ndim(lost):  # of the element nearest to each block
            rows, columns = (np.indices(self.sums.shape[2:]) + 0.5) * self.side
            centres = np.stack([columns, rows], axis=-1) + reference.pixels.bounds[1::-1]
            lost = np.asarray(lost)[cKDTree(reference.mesh.centres).query(centres)[1]]
        information, sums = self.sums[:, 2], self.sums.copy()
        fraction = information / np.maximum(information.sum(axis=0), 1e-30)
        sums[:, :2] += (lost * fraction)[:, None] * self.sums[:, :2].sum(axis=0)
        return replace(self, sums=sums)

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
        information = np.maximum(window_means(axis_information, range_ / self.side), 1e-30)
        displacement = window_means(score, range_ / self.side) / information[:, None]
        blocks = 4 * np.pi * (range_ / self.side) ** 2  # that a window holds
        square = ((score - displacement * axis_information[:, None]) ** 2).mean(axis=1)
        mean_square = window_means(square, self.reference.constants.bias_range / self.side)
        return displacement, mean_square / information**2 / blocks, information

    def design_effect(self) -> FloatArray:
        """Variance of the scores over their information: products xx, xy, yy of each light, (k, 3, h, w).

        xx + yy is 1 for white noise and ideal weights. They are raised where blocks are few, so that an error over its
        stated uncertainty has the variance 1.
        """
        constants = self.reference.constants
        prior = constants.prior_blocks * self.side**2
        window = 4 * np.pi * (constants.score_range / self.side) ** 2
        scores, counts = self._relative(self.sums[:, :2]), self.sums[:, 3]
        pixel_counts = self.windowed_means(counts)
        # an estimate from n blocks has 2 n degrees of freedom; the mean of its inverse is n / (n - 1) times too large;
        # of one block, less one, a quarter: the variance is hardly known, and stated 4 times larger
        number = np.minimum(window * pixel_counts, counts.sum(axis=(1, 2), keepdims=True)) / self.side**2
        small_sample_factor = number / np.maximum(number - 1, 0.25)
        typical = prior * np.multiply.outer(_typical_squares(scores, counts), [1.0, 0.0, 1.0])[:, :, None, None]
        products = self.windowed_means(scores[:, [0, 0, 1]] * scores[:, [0, 1, 1]])
        effects = (products + typical) / (pixel_counts + prior)[:, None] * small_sample_factor[:, None]
        return np.asarray(effects)

    def correlation(self) -> FloatArray:
        """Correlation of the scores of each two lights over the blocks around that both see, (k, k, h, w)."""
        scores, counts = self._relative(self.sums[:, :2]), self.sums[:, 3]
        prior = self.reference.constants.prior_blocks * self.side**2
        typical = 2 * prior * _typical_squares(scores, counts)[:, None, None]
        a, b = np.indices((len(counts), len(counts)))
        common = (counts[a] > 0) & (counts[b] > 0)
        along, first, second = (
            self.windowed_means(common * (scores[i] * scores[j]).sum(axis=2)) for i, j in ((a, b), (a, a), (b, b))
        )
        scale = np.sqrt((first + typical[a]) * (second + typical[b]))
        return np.asarray(np.divide(along, scale, out=np.zeros_like(along), where=scale > 0))

    def sensitivity(self, points: FloatArray) -> FloatArray:
        """Texture of the deformed image over that of the reference, along the gradient of the latter, at points (M, 2).

        Where glare or paint has changed since, the deformed image shows less of it. 1 where there is no texture.
        """
        smoothing = self.reference.constants.information_smoothing
        reference, deformed = self.at(window_means(self.common[2:], smoothing), points)
        return np.asarray(np.divide(deformed, reference, out=np.ones_like(deformed), where=reference > 0))

    def windowed_means(self, grids: AnyArray) -> AnyArray:
        """Means of grids (..., h, w) over the window in which scores are averaged."""
        return window_means(grids, self.reference.constants.score_range / self.side)

    def disagreement_by_chance(self) -> float:
        """Typical square of the scores that the gradients of the lights' own images add, over that of all scores."""
        table = self.together()
        total = table.sums[0, :2]
        square, alone = (
            _typical_squares(table._relative(scores[None]), table.sums[:, 3])[0]
            for scores in (total, self.common[:2] - total)
        )
        return float(alone / square) if square > 0 else 0.0

    def _relative(self, scores: FloatArray) -> FloatArray:
        """Scores (k, 2, h, w) over the root of the information around them.

        A light's precision changes a hundredfold at the edge of a reflection, the scores' variance with it: what is
        smooth, and averaged, is its ratio to the information.
        """
        counts = self.sums[:, 3]
        information, pixels = window_means(self.sums[:, 2:4], self.reference.constants.information_smoothing).swapaxes(
            0, 1
        )
        level = information / np.maximum(pixels, 1e-6)
        usable = ((level > 0) & (counts > 0))[:, None]
        return np.asarray(np.divide(scores, np.sqrt(level)[:, None], out=np.zeros_like(scores), where=usable))


def _merged(grids: FloatArray, number: int) -> FloatArray:
    """Sum grids (..., h, w) over squares of `number` blocks a side; those at the end may hold fewer."""
    for axis in (-2, -1):
        grids = np.add.reduceat(grids, np.arange(0, grids.shape[axis], number), axis=axis) if number > 1 else grids
    return grids


def _typical_squares(scores: FloatArray, counts: FloatArray) -> FloatArray:
    """Square (k,) of relative scores (k, 2, h, w) in one direction, per pixel, typical of the region's blocks.

    A median, so that what does not match has no part in it: ``x^2 + y^2`` of two independent Gaussian scores is
    distributed exponentially, with a median of 2 ln 2 variances.
    """
    typical = np.zeros(len(scores))
    for light, (square, count) in enumerate(zip((scores**2).sum(axis=1), counts, strict=True)):
        if (is_full := count >= 0.5 * count.max(initial=0.0)).any():
            typical[light] = np.median(square[is_full] / np.maximum(count[is_full], 1.0)) / (2 * np.log(2))
    return typical
