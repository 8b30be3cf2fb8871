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
_CHUNK = 128
"""Points at a time: what a core's fastest cache holds."""


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
        return self._levels(sum_of_cosines(x, y, self.waves, self.phases))

    def image(self, shape: tuple[int, int], motion: Affine | None = None) -> Array:
        """Grey levels (H, W) at the pixel centres once every material point has moved."""
        motion = motion or Affine()
        inverse, middle = np.linalg.inv(np.array(motion.gradient)), _middle(shape)
        origin = middle - inverse @ (middle + np.array(motion.shift))
        along = self.waves @ inverse
        phase = self.phases + self.waves @ origin
        return self._levels(_on_grid(np.arange(shape[1]), np.arange(shape[0]), along, phase))

    def _levels(self, total: Array) -> Array:
        """Grey levels of a sum of cosines."""
        return np.asarray(self.mean + self.contrast * np.sqrt(2 / len(self.waves)) * total)


def sum_of_cosines(x: Array, y: Array, waves: Array, phases: Array) -> Array:
    """The sum of plane waves (N, 2), of phases (N,), at any points x and y."""
    x, y = np.broadcast_arrays(x, y)
    if x.ndim == 2 and (x == x[:1]).all() and (y == y[:, :1]).all():
        return _on_grid(x[0], y[:, 0], waves, phases)
    points, turns = np.stack([x.ravel(), y.ravel(), np.ones(x.size)]), np.c_[waves, phases] / (2 * np.pi)
    total = np.empty(x.size)
    for first in range(0, x.size, _CHUNK):
        angles = points[:, first : first + _CHUNK].T @ turns.T
        angles -= np.rint(angles)  # within half a turn single precision errs by 1e-6 of the contrast
        total[first : first + _CHUNK] = np.cos((2 * np.pi * angles).astype(np.float32)).sum(axis=1)
    return total.reshape(x.shape)


def _on_grid(x: Array, y: Array, waves: Array, phases: Array) -> Array:
    """The sum of the cosines at the crossings of columns x and rows y."""
    columns = np.exp(1j * (waves[:, :1] * x + phases[:, None]))
    rows = np.exp(1j * (y[:, None] * waves[:, 1]))
    return np.asarray((rows @ columns).real)


def rigid_pair(shape: tuple[int, int], shift: tuple[float, float], seed: int = 0, speckle: float = 4.0) -> list[Array]:
    """Reference and deformed image of a rigid shift (u, v) in px."""
    texture = Texture.random(seed, speckle)
    return [texture.image(shape), texture.image(shape, Affine(shift=shift))]


def noisy_pair(pair: list[Array], sigma: float, random: np.random.Generator) -> list[Array]:
    """The images with independent white noise of standard deviation `sigma` grey levels."""
    return [image + random.normal(scale=sigma, size=image.shape) for image in pair]


def _middle(shape: tuple[int, int]) -> Array:
    return np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
