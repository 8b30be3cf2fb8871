"""Bias of the lights: what one shows displaced more than in the reference, against the others.

A light's residual at the solution, projected on its gradient in a window, is its own displacement from the solution.
Noise makes some thousandths of a pixel of it; more is a reflection that does not follow the surface, or follows it with
the droplets' flanks. The solution is the mean of the lights by their precision, so it holds some of each light's bias.
Where lights agree with each other (`rgbmidic.illumination.displacement.consensus_weights`) the others' part is taken
off the solution. What is left of the disagreement is its uncertainty, as of the weighted mean of measurements whose
biases are independent; where no lights agree, all are displaced, each to the side of its lamp, and the biases cancel in
part. Of two lights that disagree nobody knows which is right.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.illumination.displacement import BIAS_CORRELATION_RANGE, consensus_weights
from rgbmidic.typing import FloatArray, FloatImage


def with_consistent_gradient(residual: Residual, weights: FloatImage) -> Reference:
    """Return the reference with the gradients for the rest of a solve, from the residual at a solution.

    A light is matched with the mean of all lights only as far as what it alone shows follows the solution.
    """
    reference = residual.reference
    texture, constants = reference.texture, reference.constants
    if len(weights) < 3 or not texture.mean_fraction.any():
        return reference
    table = BlockTable.of(residual, weights, gradient=texture.images - reference.gradient)
    displacement, variance, _ = table.displacement(constants.bias_range)
    excess = np.maximum((displacement**2).sum(axis=1) - 2 * variance, 0)
    consistency = 1 / (1 + excess / constants.half_weight_displacement**2)
    return replace(reference, gradient=texture.matched(reference.pixels, consistency, table.side))


def light_bias(table: BlockTable, equations: Equations) -> tuple[FloatArray, FloatArray]:
    """Bias at the nodes, from the table of a solution and the equations it was found with; none with one light.

    Returns
    -------
    bias : ndarray, shape (N, 2)
        What is to be added to the displacement, px.
    std : ndarray, shape (N, 5)
        Standard uncertainty that is left of u, v, exx, eyy and exy: the slopes have that of a field of its correlation.
    """
    nodes, constants = table.reference.mesh.nodes, table.reference.constants
    if len(table.sums) == 1:
        return np.zeros_like(nodes), np.zeros((len(nodes), 5))
    displacement, variance, information = table.displacement(constants.bias_range)
    change, change_variance = _local_change(table, displacement)
    displacement = displacement + change
    precision = information / np.maximum(information.sum(axis=0), 1e-30)
    consensus, agreement = consensus_weights(displacement, variance, precision)
    shift = agreement * (consensus - precision)
    remaining = _variance_of_mean(displacement, variance + change_variance, precision + shift)
    remaining += (shift[:, None] * change).sum(axis=0) ** 2
    # where none agree all are displaced, to the sides of their lamps, and an estimate from so few needs both directions
    across = constants.bias_across
    none_agree = 2 / (len(displacement) + 1) * ((1 - across) * remaining + across * remaining[::-1])
    remaining = agreement * remaining + (1 - agreement) * none_agree
    correction = (shift[:, None] * displacement).sum(axis=0)
    bias, square = table.at(np.concatenate([correction, remaining]), nodes).T.reshape(-1, 2, 2).swapaxes(0, 1)
    x, y = np.sqrt(np.einsum("nij,nj->ni", equations.deformation**2, square)).T
    reach = np.sqrt(2) * BIAS_CORRELATION_RANGE
    return equations.turned(bias), np.stack([x, y, x / reach, y / reach, np.hypot(x, y) / (2 * reach)], axis=1)


def _local_change(table: BlockTable, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change (k, 2, h, w) of the lights' displacement within its window beyond chance, and its variance (k, h, w).

    It is that of a window of a third, less what chance makes of it (James and Stein 1961).
    """
    constants = table.reference.constants
    local, chance, _ = table.displacement(constants.local_bias_range)
    change = local - displacement
    gain = np.maximum(1 - constants.local_bias_threshold * chance / np.maximum((change**2).sum(axis=1), 1e-30), 0)
    return change * gain[:, None], 2 * chance * gain  # twice: its scatter is taken about the local displacement itself


def _variance_of_mean(displacement: FloatArray, variance: FloatArray, weights: FloatArray) -> FloatArray:
    """Variance (2, h, w) of the weighted mean of lights whose biases are independent, from their scatter beyond chance.

    `displacement` is (k, 2, h, w), its `variance` by chance and the `weights` are (k, h, w).
    """
    mean, count = (weights[:, None] * displacement).sum(axis=0), len(weights)
    scatter = np.maximum((displacement - mean) ** 2 - variance[:, None], 0)
    return np.asarray(count / (count - 1) * (weights[:, None] ** 2 * scatter).sum(axis=0))
