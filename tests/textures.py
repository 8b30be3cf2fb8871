"""Speckle that is known at every point of the plane, so that a deformed image is exact and never an interpolated one.

The texture is a sum of cosines with random wave vectors. Under an affine map a cosine stays a cosine, and
``cos(a x + b y + p)`` separates into factors of x and y: an image is one matrix product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Matrix = tuple[tuple[float, float], tuple[float, float]]
_IDENTITY: Matrix = ((1.0, 0.0), (0.0, 1.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Affine:
    """The motion ``x -> F (x - c) + c + t`` of material points x = (x, y) in px; c is the middle of the image."""

    shift: tuple[float, float] = (0.0, 0.0)
    gradient: Matrix = _IDENTITY

    @classmethod
    def strain_and_rotation(cls, strain: float, degrees: float, shift: tuple[float, float] = (0.0, 0.0)) -> Affine:
        """Equal stretch along x and y, then a rotation, then a shift in px."""
        c, s = (1 + strain) * np.cos(np.radians(degrees)), (1 + strain) * np.sin(np.radians(degrees))
        return cls(shift=shift, gradient=((c, -s), (s, c)))

    def displacement(self, points: Array, shape: tuple[int, int]) -> Array:
        """(u, v) in px of points (N, 2) of the reference image of `shape` (H, W)."""
        gradient = np.array(self.gradient)
        return np.asarray((points - _middle(shape)) @ (gradient - np.eye(2)).T + np.array(self.shift))


@dataclass(frozen=True, slots=True, kw_only=True)
class Texture:
    """Speckle of `speckle` px (full width at half maximum): mean 200, standard deviation `contrast` grey levels."""

    waves: Array
    phases: Array
    mean: float = 200.0
    contrast: float = 50.0

    @classmethod
    def random(cls, seed: int = 0, speckle: float = 4.0, waves: int = 300, contrast: float = 50.0) -> Texture:
        """A texture whose autocorrelation is that of Gaussian spots of the stated width."""
        random = np.random.default_rng(seed)
        spot = speckle / 2.355
        vectors = random.normal(size=(waves, 2)) / (spot * np.sqrt(2))
        return cls(waves=vectors, phases=random.uniform(0, 2 * np.pi, waves), contrast=contrast)

    def at(self, x: Array, y: Array) -> Array:
        """Grey levels at any points, for motions that are not affine."""
        total = np.zeros(np.shape(x))
        for (a, b), phase in zip(self.waves, self.phases, strict=True):
            total += np.cos(a * x + b * y + phase)
        return np.asarray(self.mean + self.contrast * np.sqrt(2 / len(self.waves)) * total)

    def image(self, shape: tuple[int, int], motion: Affine | None = None) -> Array:
        """Grey levels (H, W) at the pixel centres once every material point has moved."""
        motion = motion or Affine()
        inverse, middle = np.linalg.inv(np.array(motion.gradient)), _middle(shape)
        origin = middle - inverse @ (middle + np.array(motion.shift))
        along = self.waves @ inverse
        phase = self.phases + self.waves @ origin
        x, y = np.arange(shape[1]), np.arange(shape[0])
        columns = np.exp(1j * (along[:, :1] * x + phase[:, None]))
        rows = np.exp(1j * (y[:, None] * along[:, 1]))
        return np.asarray(self.mean + self.contrast * np.sqrt(2 / len(self.waves)) * (rows @ columns).real)


def rigid_pair(shape: tuple[int, int], shift: tuple[float, float], seed: int = 0, speckle: float = 4.0) -> list[Array]:
    """Reference and deformed image of a rigid shift (u, v) in px."""
    texture = Texture.random(seed, speckle)
    return [texture.image(shape), texture.image(shape, Affine(shift=shift))]


def noisy_pair(pair: list[Array], sigma: float, random: np.random.Generator) -> list[Array]:
    """The images with independent white noise of standard deviation `sigma` grey levels."""
    return [image + random.normal(scale=sigma, size=image.shape) for image in pair]


def _middle(shape: tuple[int, int]) -> Array:
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
