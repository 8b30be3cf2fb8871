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
from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from rgbmidic.correlation.reference import Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.illumination.displacement import agreement
from rgbmidic.typing import FloatArray, FloatImage


def light_displacement(
    residual: Residual, weights: FloatImage, gradient: Callable[[int], FloatImage]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement of each light from a solution, in a window around each block.

    Parameters
    ----------
    residual
        At the solution.
    weights : ndarray, shape (k, P)
        Of the pixels.
    gradient
        Gradient (2, P) of a light on which its residual is regressed.

    Returns
    -------
    displacement : ndarray, shape (k, 2, h, w)
        In x and y, px.
    variance : ndarray, shape (k, h, w)
        By chance in each direction, px².
    information : ndarray, shape (k, h, w)
        In each direction.
    """
    reference, reach = residual.reference, residual.reference.constants.bias_range
    block, lights = reference.constants.block, range(len(weights))
    fields = ((residual.difference[light], weights[light], *gradient(light)) for light in lights)
    # scores in x and y, and their information, (k, 3, h, w)
    blocks = np.stack([reference.score_sums(block, *(field[None] for field in light))[:3] for light in fields])
    sigma = (0, 0, reach / block, reach / block)
    around = gaussian_filter(blocks, sigma, mode="constant", truncate=3)
    half = np.maximum(around[:, 2] / 2, 1e-30)
    displacement = around[:, :2] / half[:, None]
    # scatter of the blocks' scores about the window's displacement, a window holding so many blocks
    scatter = ((blocks[:, :2] - displacement * blocks[:, 2:] / 2) ** 2).mean(axis=1)
    held = 4 * np.pi * (reach / block) ** 2
    return displacement, gaussian_filter(scatter, sigma[1:], mode="constant", truncate=3) / half**2 / held, half


def settled_gradient(residual: Residual, weights: FloatImage) -> Reference:
    """Return the reference with the gradients for the rest of a solve, from the residual at a solution.

    A light is matched with the mean of all lights only as far as what it alone shows follows the solution.
    """
    reference = residual.reference
    texture, constants = reference.texture, reference.constants
    if len(weights) < 3 or not texture.together.any():
        return reference
    displacement, variance, _ = light_displacement(residual, weights, reference.channel_specific)
    beyond = np.maximum((displacement**2).sum(axis=1) - 2 * variance, 0)
    consistency = 1 / (1 + beyond / constants.follows**2)
    return replace(reference, gradient=texture.matched(reference.pixels, consistency, constants.block))


def light_bias(residual: Residual, weights: FloatImage) -> tuple[FloatArray, FloatArray]:
    """Bias at the nodes, from the residual at a solution with these pixel weights (k, P); none with one light.

    Returns
    -------
    bias : ndarray, shape (N, 2)
        What is to be added to the displacement, px.
    std : ndarray, shape (N, 5)
        Standard uncertainty that is left of u, v, exx, eyy and exy: a bias that is alike over the reach of the window
        changes by so much over it.
    """
    reference = residual.reference
    mesh, pixels, count = reference.mesh, reference.pixels, len(weights)
    if count == 1:
        return np.zeros_like(mesh.nodes), np.zeros((len(mesh.nodes), 5))
    displacement, variance, half = light_displacement(residual, weights, lambda light: reference.gradient[:, light])
    precision = half / np.maximum(half.sum(axis=0), 1e-30)
    believed, agree = agreement(displacement, variance, precision)
    part = precision + agree * (believed - precision)
    mean = (part[:, None] * displacement).sum(axis=0)
    apart = np.maximum((displacement - mean) ** 2 - variance[:, None], 0)
    left = count / (count - 1) * (part[:, None] ** 2 * apart).sum(axis=0)
    off = mean - (precision[:, None] * displacement).sum(axis=0)
    block, reach = reference.constants.block, reference.constants.bias_range
    top, left_edge = pixels.bounds[:2]
    place = (mesh.nodes[:, ::-1] - (top, left_edge)).T / block - 0.5
    at_nodes = [map_coordinates(one, place, order=1, mode="nearest") for one in (*off, *left)]
    bias, square = np.stack(at_nodes, axis=1).reshape(-1, 2, 2).swapaxes(0, 1)
    x, y = np.sqrt(square).T
    return bias, np.stack([x, y, x / reach, y / reach, np.hypot(x, y) / (2 * reach)], axis=1)
