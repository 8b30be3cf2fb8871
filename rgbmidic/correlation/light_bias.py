"""Bias of the lights: what one shows displaced more than in the reference, against the others.

A light's residual at the solution, projected on its gradient in a window, is its own displacement from the solution.
Noise makes some thousandths of a pixel of it; more is a reflection that does not follow the surface, or follows it with
the droplets' flanks. The solution is the mean of the lights by their precision, so it holds some of each light's bias.
Where lights agree with each other (`rgbmidic.illumination.displacement.agreement`) the others' part is taken off the
solution. What is left of the disagreement is its uncertainty, as of the weighted mean of measurements whose biases are
independent; of two lights that disagree nobody knows which is right, and half their distance is uncertain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.illumination.displacement import agreement
from rgbmidic.typing import FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class LightScores:
    """Sums of the lights' scores and their information over blocks, from the residual at a solution.

    Attributes
    ----------
    score : ndarray, shape (k, 2, h, w)
        In x and y.
    information : ndarray, shape (k, h, w)
        In each direction.
    side : int
        Of the blocks, px.
    reach : float
        Standard deviation (px) of the window in which their scatter is taken.
    """

    score: FloatArray
    information: FloatArray
    side: int
    reach: float

    @classmethod
    def of(cls, residual: Residual, weights: FloatImage, gradient: Callable[[int], FloatImage]) -> LightScores:
        """Sum with pixel weights (k, P) and a `gradient` (2, P) of each light, on which its residual is regressed."""
        reference, side = residual.reference, residual.reference.constants.block
        lights = ((residual.difference[n], weights[n], *gradient(n)) for n in range(len(weights)))
        sums = np.stack([reference.score_sums(side, *(field[None] for field in light))[:3] for light in lights])
        return cls(score=sums[:, :2], information=sums[:, 2] / 2, side=side, reach=reference.constants.bias_range)

    def displacement(self, range_: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Displacement of each light from the solution in a window of so many px (standard deviation).

        Returns
        -------
        displacement : ndarray, shape (k, 2, h, w)
            In x and y, px.
        variance : ndarray, shape (k, h, w)
            By chance in each direction, px²: from the scatter of the blocks' scores about it.
        information : ndarray, shape (k, h, w)
            Mean over the window.
        """
        information = np.maximum(self._around(self.information, range_), 1e-30)
        displacement = self._around(self.score, range_) / information[:, None]
        blocks = 4 * np.pi * (range_ / self.side) ** 2  # that a window holds
        square = ((self.score - displacement * self.information[:, None]) ** 2).mean(axis=1)
        return displacement, self._around(square, self.reach) / information**2 / blocks, information

    def _around(self, grids: FloatArray, range_: float) -> FloatArray:
        sigma = (0,) * (grids.ndim - 2) + (range_ / self.side,) * 2
        return np.asarray(gaussian_filter(grids, sigma, mode="constant", truncate=3))


def settled_gradient(residual: Residual, weights: FloatImage) -> Reference:
    """Return the reference with the gradients for the rest of a solve, from the residual at a solution.

    A light is matched with the mean of all lights only as far as what it alone shows follows the solution.
    """
    reference = residual.reference
    texture, constants = reference.texture, reference.constants
    if len(weights) < 3 or not texture.together.any():
        return reference
    scores = LightScores.of(residual, weights, reference.channel_specific)
    displacement, variance, _ = scores.displacement(constants.bias_range)
    beyond = np.maximum((displacement**2).sum(axis=1) - 2 * variance, 0)
    consistency = 1 / (1 + beyond / constants.follows**2)
    return replace(reference, gradient=texture.matched(reference.pixels, consistency, constants.block))


def light_bias(residual: Residual, equations: Equations) -> tuple[FloatArray, FloatArray]:
    """Bias at the nodes, from the residual at a solution and the equations it was found with; none with one light.

    Where a light's displacement changes within the window by more than chance, it is taken in a window of a third.

    Returns
    -------
    bias : ndarray, shape (N, 2)
        What is to be added to the displacement, px.
    std : ndarray, shape (N, 5)
        Standard uncertainty that is left of u, v, exx, eyy and exy: a bias that is alike over the reach of the window
        changes by so much over it.
    """
    reference, weights = residual.reference, equations.weights
    mesh, pixels, count, constants = reference.mesh, reference.pixels, len(weights), reference.constants
    reach = constants.bias_range
    if count == 1:
        return np.zeros_like(mesh.nodes), np.zeros((len(mesh.nodes), 5))
    scores = LightScores.of(residual, weights, lambda light: reference.gradient[:, light])
    displacement, variance, information = scores.displacement(reach)
    local, chance, _ = scores.displacement(constants.local_bias_range)
    beyond = local - displacement
    beyond *= np.maximum(1 - constants.local_bias * chance / np.maximum((beyond**2).sum(axis=1), 1e-30), 0)[:, None]
    displacement = displacement + beyond
    precision = information / np.maximum(information.sum(axis=0), 1e-30)
    believed, agree = agreement(displacement, variance, precision)
    part = precision + agree * (believed - precision)
    mean = (part[:, None] * displacement).sum(axis=0)
    apart = np.maximum((displacement - mean) ** 2 - variance[:, None], 0)
    left = count / (count - 1) * (part[:, None] ** 2 * apart).sum(axis=0)
    left += ((part - precision)[:, None] * beyond).sum(axis=0) ** 2
    off = mean - (precision[:, None] * displacement).sum(axis=0)
    top, left_edge = pixels.bounds[:2]
    place = (mesh.nodes[:, ::-1] - (top, left_edge)).T / scores.side - 0.5
    at_nodes = [map_coordinates(one, place, order=1, mode="nearest") for one in (*off, *left)]
    bias, square = np.stack(at_nodes, axis=1).reshape(-1, 2, 2).swapaxes(0, 1)
    x, y = np.sqrt(np.einsum("nij,nj->ni", equations.deformation**2, square)).T
    return equations.turned(bias), np.stack([x, y, x / reach, y / reach, np.hypot(x, y) / (2 * reach)], axis=1)
