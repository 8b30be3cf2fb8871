"""Bias of the lights: what one shows displaced more than in the reference, against the others.

A light's residual at the solution, projected on its gradient in a window, is its own displacement from the solution.
Noise makes some thousandths of a pixel of it; more is a reflection that does not follow the surface, or follows it with
the droplets' flanks. The solution is the mean of the lights by their precision, so it holds some of each light's bias.
Where lights agree with each other (`rgbmidic.illumination.displacement.agreement`) the others' part is taken off the
solution. What is left of the disagreement is its uncertainty, as of the weighted mean of measurements whose biases are
independent; of two lights that disagree nobody knows which is right, and half their distance is uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from rgbmidic.correlation.assembly import BLOCK
from rgbmidic.correlation.local_displacement import RANGE, LocalDisplacement
from rgbmidic.correlation.residual import Residual
from rgbmidic.illumination.displacement import agreement
from rgbmidic.typing import FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class LightBias:
    """Bias of the solution from lights that are displaced, at the nodes.

    Attributes
    ----------
    values : ndarray, shape (N, 2)
        What is to be added to the displacement, px.
    std : ndarray, shape (N, 2)
        Standard uncertainty that is left, px; alike over some `RANGE` px.
    """

    values: FloatArray
    std: FloatArray

    @classmethod
    def of(cls, residual: Residual, weights: FloatImage) -> LightBias:
        """From the residual at a solution with these pixel weights (k, P); none with one light."""
        reference = residual.reference
        mesh, pixels, count = reference.mesh, reference.pixels, len(weights)
        if count == 1:
            return cls(values=np.zeros_like(mesh.nodes), std=np.zeros_like(mesh.nodes))
        lights = zip(residual.difference, weights, reference.gradient.swapaxes(0, 1), strict=True)
        shown = [LocalDisplacement.of(pixels, *light) for light in lights]
        displacement, variance = np.stack([one.values for one in shown]), np.stack([one.variance for one in shown])
        information = np.stack([one.information for one in shown])
        precision = information / information.sum(axis=0)
        believed, agree = agreement(displacement, variance, precision)
        part = precision + agree * (believed - precision)
        mean = (part[:, None] * displacement).sum(axis=0)
        apart = np.maximum((displacement - mean) ** 2 - variance[:, None], 0)
        left = count / (count - 1) * (part[:, None] ** 2 * apart).sum(axis=0)
        off = mean - (precision[:, None] * displacement).sum(axis=0)
        top, left_edge = pixels.bounds[:2]
        place = (mesh.nodes[:, ::-1] - (top, left_edge)).T / BLOCK - 0.5
        at_nodes = [map_coordinates(one, place, order=1, mode="nearest") for one in (*off, *left)]
        values, rest = np.stack(at_nodes, axis=1).reshape(-1, 2, 2).swapaxes(0, 1)
        return cls(values=values, std=np.sqrt(rest))

    def of_recovered(self) -> FloatArray:
        """Standard uncertainty (N, 5) of u, v, exx, eyy and exy: a bias alike over `RANGE` changes so much over it."""
        x, y = self.std.T
        return np.stack([x, y, x / RANGE, y / RANGE, np.hypot(x, y) / (2 * RANGE)], axis=1)
