"""Weights by statistics, the default: the lights' precision together around each pixel, from the residual of the solve.

Every valid pixel counts fully at first; what the residual of a pass shows is a factor on that in the next one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import ClassVar

import numpy as np

from rgbmidic._kernels.lights import best_mean, robust_weights
from rgbmidic.correlation.images import spread, window_covariance, window_means
from rgbmidic.correlation.residual import Precision, Residual
from rgbmidic.correlation.uncertainty import displacing_fraction
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.typing import FloatImage

__all__ = ["Statistics", "ValidPixels"]

_FREEDOM = 4.0
"""Degrees of freedom of the Student distribution taken for the residual (Lange et al., J. Am. Stat. Assoc. 84, 1989,
who found 4 to work well). With 2 or 8 lights under a reflection differ by 2e-3 px at most, beside a gap by 4e-2, their
uncertainty by 11 % (benchmarks/constants.py)."""
_LEAST_VARIANCE = 0.1
"""Least variance of a light's residual that is believed, over the median of all. Chosen; with half or twice of it
lights under a reflection do not change, those beside a gap by 8e-2 px at most, their uncertainty by 42 %
(benchmarks/constants.py)."""
_ROUNDING = 1e-6
"""Least variance of a residual, over that of the grey levels, where two images are the same. Chosen; with half or twice
of it nothing changes (benchmarks/constants.py)."""
_OWN = 0.1
"""Fraction of its variance that each light's residual is taken to have for itself: .03 to .3 measure the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidPixels:
    """Every valid pixel counts fully: no weighting. A `LightWeights`."""

    notes: ClassVar[Mapping[str, float]] = {}

    def reference(self, images: IlluminationImages) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics(ValidPixels):
    """Every valid pixel counts by what the residual around it shows. A `LightWeights` and a `PrecisionMethod`."""

    def precision(self, residual: Residual) -> Precision:
        """Weights of the lights' best mean around each pixel, from their residuals.

        Lights separated from one mosaic err together, for each is predicted from all the samples around; what one
        misses of a reflection's sparkle the others have too much. So the lights divide a weight as ``C^-1 1`` of the
        residuals' covariance C between them (generalised least squares), none below 0. The weight is the inverse
        variance of that mean's residual to the power .75, for it is itself uncertain, times the part of it that
        displaces: brightness and contrast that change slowly leave a residual which the gradient of the speckle
        averages out, blurred noise one that it does not. It holds whatever corrupts the mean there: camera noise,
        demosaicing, the erratic part of a reflection. Its unit is the median over the region. The pixel's own factor is
        that of a Student distribution, so that dust or a fragment does not corrupt a node.
        """
        pixels, weights = residual.reference.pixels, residual.weights
        covariance = window_covariance(pixels, residual.difference, weights)
        lights = range(len(weights))
        typical = _typical(covariance[lights, lights])
        if typical <= 0:
            return Precision(factor=np.ones_like(weights), bend=np.ones_like(weights[0]))
        floor = np.float32(max(_LEAST_VARIANCE * typical, _ROUNDING * residual.contrast))
        factor = spread(pixels, _best_fractions(covariance, floor))
        mean, used, bend = np.empty((3, factor.shape[1]), dtype=np.float32)
        best_mean(factor, weights, residual.difference, mean, used, bend)
        variance, least = window_means(pixels, bend[None], used[None]), floor / len(factor)
        around = spread(pixels, np.maximum(variance, least))[0]
        displacing = displacing_fraction(residual.reference, mean, used / around)
        unit = max(np.float32(_typical(variance)), least)
        robust_weights(mean, around, displacing, unit, np.float32(_FREEDOM), factor, bend)
        return Precision(factor=factor, bend=bend)


def _typical(variance: FloatImage) -> float:
    """Median of a variance that is known on a grid (..., h, w), 0 where it is not; one in four shows it."""
    some = variance[..., ::2, ::2]
    known = some[some > 0]
    return float(np.median(known)) if known.size else 0.0


def _best_fractions(covariance: FloatImage, least: np.float32) -> FloatImage:
    """Solve ``C x = 1`` for the lights' fractions (k, h, w) of the mean of least variance, up to a factor.

    C is the residuals' `covariance` (k, k, h, w), with variances of `least` or more.
    """
    lights = range(len(covariance))
    matrices = covariance.copy()
    matrices[lights, lights] = np.maximum(matrices[lights, lights], least)
    for a, b in combinations(lights, 2):
        most = (1 - _OWN) * np.sqrt(matrices[a, a] * matrices[b, b])
        matrices[a, b] = matrices[b, a] = np.clip((1 - _OWN) * matrices[a, b], -most, most)
    fractions: FloatImage = np.ones_like(matrices[0])
    # elimination on whole grids: ten times as fast as a LAPACK call for each block
    for a, b in combinations(lights, 2):
        ratio = matrices[b, a] / matrices[a, a]
        matrices[b, a + 1 :] -= ratio * matrices[a, a + 1 :]
        fractions[b] -= ratio * fractions[a]
    for a in reversed(lights):
        fractions[a] = (fractions[a] - (matrices[a, a + 1 :] * fractions[a + 1 :]).sum(axis=0)) / matrices[a, a]
    return np.asarray(fractions)
