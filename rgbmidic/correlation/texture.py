"""Gradient of the texture that the lights have in common, as each of them shows it.

Of three lights or more, each is matched with the mean gradient of the *others*; of two with the mean of both. What one
light alone shows (the sparkle of its reflection, what the lattice of its camera colour makes of it) is in its own
gradient and in its own residual alike. Their product does not average out: it pulls to whole pixels, and to where a
sparkle has stayed that does not follow the surface. The others' gradient is an instrument in the statistical sense: it
knows the texture and nothing of that.

Where the lights' gradients differ the instrument is weak, and errors of the separation, which cancel in the mean of the
lights, cancel only under one gradient for all. There it is the mean of all lights, unless what a light alone shows is
displaced against the solution (`rgbmidic.correlation.light_bias`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from rgbmidic.mesh import PixelMap
from rgbmidic.mesh.pixel_map import WINDOW
from rgbmidic.typing import FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class TextureGradient:
    """Gradient of the lights' images, and what their common texture is in it.

    The contrasts are those of the regression of a light's gradient on the mean, in a window, which makes the Hessian
    the light's sensitivity to a displacement. Grids have blocks of `WINDOW.step` px.

    Attributes
    ----------
    images : ndarray, shape (2, k, P), float32
        Gradient of each light's image, in local means per px, without what is a gain.
    texture : ndarray, shape (2, P), float32
        Sum of it over the lights; where some have no weight, k times the mean of the others.
    in_others : ndarray, shape (k, h, w), float32
        Contrast of a light in the sum of the others.
    in_all : ndarray, shape (k, h, w), float32
        In the sum of all.
    mean_fraction : ndarray, shape (k, h, w), float32
        Fraction, 0 to 1, of the mean of all lights in the gradient that a light is matched with, if what it alone shows
        is not displaced.
    """

    images: FloatImage
    texture: FloatImage
    in_others: FloatImage
    in_all: FloatImage
    mean_fraction: FloatImage

    @classmethod
    def of_images(
        cls, gradient: FloatImage, weights: FloatImage, pixels: PixelMap, correlation_bounds: tuple[float, float]
    ) -> TextureGradient:
        """Find the common texture of the `gradient` (2, k, P) of images with weights (k, P).

        `correlation_bounds` is the correlation of a light's gradient with that of the others up to which all lights are
        averaged, and from which the others are. Of two lights both are: a single other one may be the one that
        reflects.
        """
        if len(weights) == 1:
            blank = np.zeros((1, *pixels.grid(WINDOW.step)), dtype=np.float32)
            return cls(images=gradient, texture=gradient[:, 0], in_others=blank, in_all=blank, mean_fraction=blank)
        has_weight, lights = (weights > 0).astype(np.float32), len(weights)
        scale = np.float32(lights) / np.maximum(has_weight.sum(axis=0), np.float32(1))
        texture = np.einsum("akp,kp->ap", gradient, has_weight) * scale
        grids = []
        for light, weight in zip(gradient.swapaxes(0, 1), has_weight, strict=True):
            products = np.stack(
                [(a * b).sum(axis=0) for a, b in ((light, light), (light, texture), (texture, texture))]
            )
            square, along, total = WINDOW.ratios(
                pixels, np.concatenate([products, np.ones_like(products[:1])]) * weight
            )
            along_others, beside = along - square, total - 2 * along + square  # products with the sum of the others
            correlation = _quotient(along_others, np.sqrt(np.maximum(square * beside, 0)))
            mean_fraction = np.clip(
                (correlation_bounds[1] - correlation) / (correlation_bounds[1] - correlation_bounds[0]), 0, 1
            )
            grids.append(
                (
                    _quotient(along_others, beside),
                    _quotient(along, total),
                    mean_fraction if lights > 2 else 0 * mean_fraction + 1,
                )
            )
        in_others, in_all, mean_fraction = np.array(grids).swapaxes(0, 1)
        return cls(images=gradient, texture=texture, in_others=in_others, in_all=in_all, mean_fraction=mean_fraction)

    def matched(self, pixels: PixelMap, consistency: FloatArray | None = None, side: int = 1) -> FloatImage:
        """Gradient (2, k, P) that the lights are matched with.

        Parameters
        ----------
        pixels
            P owned pixels.
        consistency : ndarray, shape (k, h, w), optional
            How far what a light alone shows follows the solution, 0 to 1, on a grid of blocks of `side` px; 1 without.
        side
            Side of these blocks, px.
        """
        if len(self.in_all) == 1:
            return self.images
        mean_fraction = self.mean_fraction
        if consistency is not None:
            blocks = (np.indices(mean_fraction.shape[1:]) + 0.5) * (WINDOW.step / side) - 0.5
            mean_fraction = mean_fraction * [
                map_coordinates(grid, blocks, order=1, mode="nearest") for grid in consistency
            ]
        of_others, of_all = (1 - mean_fraction) * self.in_others, mean_fraction * self.in_all
        out = np.empty_like(self.images)
        for light, grids in enumerate(zip(of_others + of_all, of_others, strict=True)):
            of_texture, of_own = pixels.from_blocks(np.stack(grids), WINDOW.step)
            np.multiply(self.texture, of_texture, out=out[:, light])
            out[:, light] -= of_own * self.images[:, light]
        return out


def _quotient(along: FloatImage, square: FloatImage) -> FloatImage:
    return np.maximum(np.divide(along, square, out=np.zeros_like(along), where=square > 0), 0)
