"""Displacement uncertainty expected from one frame, in closed form: nothing is solved.

As in `rgbmidic.scene.forecast` the covariance of the nodes is ``M^-1 S M^-1``, with M the Hessian of the weighted sum
over the lights and S the covariance of its right-hand side. M follows from the speckle's autocorrelation and the
contrast of each light; S from the `Disturbances` of two states, each convolved with a kernel whose transfer function is
the root of the spectrum of the speckle's gradient. Every light counts with the inverse variance of its residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.assembly import Assembly
from rgbmidic.correlation.equations import SEEN
from rgbmidic.correlation.images import PREFILTERS, apply_prefilter
from rgbmidic.correlation.nodes import LOST
from rgbmidic.correlation.recovery import NodeColouring, Recovery, functional_std, linear_fit_offset
from rgbmidic.illumination.images import local_mean
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.lab.inspection.samples import Disturbances
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["Prediction", "expected_std", "predict"]


_GRID, _REACH = 64, 16
"""Frequencies on which the kernel is computed, and the distance (px) to which it is kept: speckle's gradients are
correlated over a speckle or two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Prediction:
    """Standard uncertainty of u, and of v, at the nodes (N,), px; NaN where a node is not measured.

    Attributes
    ----------
    std
        Of all lights together.
    noise, mosaic
        The parts of it from camera noise, and from what the mosaic did not sample.
    alone : tuple of ndarray
        Of every light alone.
    """

    std: FloatArray
    noise: FloatArray
    mosaic: FloatArray
    alone: tuple[FloatArray, ...]


def predict(
    mesh: Tri3Mesh,
    region: Region,
    *,
    contrast: FloatImage,
    level: FloatImage,
    disturbances: Disturbances,
    texture: TextureModel | None,
    prefilter: str,
) -> Prediction:
    """What a second state of a frame is expected to be measured with.

    Parameters
    ----------
    mesh, region
        What is measured.
    contrast, level : ndarray, shape (k, H, W)
        Local standard deviation of each light in units of its local mean, 0 where the light is not known; and that
        mean, DN.
    disturbances
        Of one state, DN; those of the other are as large and independent.
    texture
        The speckle's autocorrelation; None: there is none, and nothing can be measured.
    prefilter
        Of the solve (`rgbmidic.correlation.images.PREFILTERS`).
    """
    if texture is None:
        nothing = np.full(len(mesh.nodes), np.nan)
        return Prediction(std=nothing, noise=nothing, mosaic=nothing, alone=(nothing,) * len(contrast))
    light = contrast > 0
    energy, kernel = _gradient(texture, prefilter)

    def filtered(draws: FloatImage, change: Callable[[FloatImage], FloatImage]) -> Iterator[FloatImage]:
        """Draws (n, k, H, W) relative to the level of the light, one (k, H, W) after the other, every image changed."""
        for draw in draws:
            relative = np.divide(draw, level, out=np.zeros_like(draw), where=light)
            yield np.stack([change(image) for image in relative])

    def variance(change: Callable[[FloatImage], FloatImage]) -> FloatImage:
        """Local mean square (k, H, W) of all disturbances of one state."""
        total = np.zeros_like(contrast)
        for draws in parts:
            for images in filtered(draws, change):
                total += images**2 / np.float32(len(draws))
        return _smooth(total, region.mask, mesh.size)

    parts = disturbances.noise[None], disturbances.mosaic
    own = np.sqrt(np.maximum(contrast**2 - variance(lambda image: image), 0) * light)
    residual = variance(lambda image: apply_prefilter(image, prefilter))
    pull = np.divide(own, residual, out=np.zeros_like(own), where=residual > 0)
    pixels = PixelMap.from_mesh(mesh, region)

    def scores(draws: FloatImage) -> FloatArray:
        """Score (1 + k, E) of all lights together and of each alone, between two states."""
        total = np.zeros((1 + len(pull), *pull.shape[1:]), dtype=np.float32)
        for images in filtered(draws, lambda image: np.asarray(cv2.filter2D(image, -1, kernel), dtype=np.float32)):
            images *= pull
            total[0] += images.sum(axis=0) ** 2 / np.float32(len(draws))
            total[1:] += images**2 / np.float32(len(draws))
        return 2 * _element_means(_smooth(total, region.mask, mesh.size), pixels)

    noise, mosaic = (scores(draws) for draws in parts)
    information = energy * _element_means(pull * own, pixels)
    together = expected_std(mesh, information.sum(axis=0), noise[0] + mosaic[0], noise[0], mosaic[0])
    alone = [expected_std(mesh, info, score)[0] for info, score in zip(information, (noise + mosaic)[1:], strict=True)]
    return Prediction(std=together[0], noise=together[1], mosaic=together[2], alone=tuple(alone))


def expected_std(mesh: Tri3Mesh, information: FloatArray, *scores: FloatArray) -> FloatArray:
    """Standard uncertainty (n, N) of a displacement component at the nodes, px; NaN where they see too little.

    Parameters
    ----------
    mesh
        The mesh.
    information, *scores : ndarray, shape (E,)
        Per pixel of each element: of the Hessian, and n variances of the right-hand side.
    """
    area = mesh.to_nodes(mesh.areas)
    density = mesh.to_nodes(information * mesh.areas) / area
    seen = density > SEEN * np.median(density[density > 0]) if (density > 0).any() else np.zeros(len(density), bool)
    if not seen.any():
        return np.full((len(scores), len(density)), np.nan)
    assembly = Assembly.from_mesh(mesh)
    mass = ((1 + np.eye(3)) / 12)[..., None] * np.array([1.0, 0.0, 1.0])

    def assembled(values: FloatArray) -> sp.csc_matrix:
        return assembly.matrix((values * mesh.areas)[:, None, None, None] * mass)

    # elements that no light sees must not make the system singular
    solve = assembly.factorise(assembled(np.maximum(information, 1e-3 * SEEN * np.median(density[seen]))))
    used = np.asarray(seen[mesh.elements].all(axis=1))
    recovery = Recovery.over(mesh, used, density, linear_fit_offset(mesh))
    along_x, colouring = [(recovery.displacement_functionals[0], seen)], NodeColouring.from_mesh(mesh)
    std = np.stack([functional_std(solve, assembled(score), colouring, along_x)[:, 0] for score in scores])
    return np.where(seen & (std < LOST), std, np.nan)


def _gradient(texture: TextureModel, prefilter: str) -> tuple[float, FloatImage]:
    """Mean square (px^-2) of the texture's gradient along a direction after the prefilter; and the kernel that turns a
    disturbance into one whose square, per pixel, is the variance of the right-hand side."""
    frequency = np.fft.fftfreq(_GRID)
    taps = PREFILTERS[prefilter]
    place = np.arange(len(taps)) - len(taps) // 2
    line = (taps @ np.cos(2 * np.pi * place[:, None] * frequency)) ** 2
    filtered = np.outer(line, line)
    radius = np.hypot(frequency[:, None], frequency)
    gradient = (2 * np.pi * radius) ** 2 / 2 * texture.spectrum(radius)
    kernel = np.fft.fftshift(np.fft.ifft2(np.sqrt(gradient) * filtered).real)
    near = slice(_GRID // 2 - _REACH, _GRID // 2 + _REACH + 1)
    return float((gradient * filtered).mean()), kernel[near, near].astype(np.float32)


def _smooth(images: FloatImage, inside: BoolArray, width: float) -> FloatImage:
    """Local means of images (n, H, W) over what lies inside the region, over about an element and its neighbours."""
    return np.stack([np.nan_to_num(local_mean(np.where(inside, image, np.float32(np.nan)), width)) for image in images])


def _element_means(images: FloatImage, pixels: PixelMap) -> FloatArray:
    """Means (n, E) of images (n, H, W) over the pixels of each element; 0 for one without pixels."""
    total = np.cumsum(pixels.gather(images), axis=1, dtype=np.float64)
    ends = np.pad(total, ((0, 0), (1, 0)))[:, pixels.offsets]
    return np.asarray(np.diff(ends, axis=1) / np.maximum(np.diff(pixels.offsets), 1))
