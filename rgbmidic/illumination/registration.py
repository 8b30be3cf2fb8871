"""Lateral colour registration: where each light sees the point that the first light sees at a pixel.

A lens magnifies each wavelength a little differently. With x the pixel of a material point in the first light's image
and c the image centre, light j sees the same point at x + rho_j(x),

    rho_j(x) = t + w J (x - c) + s (x - c) + q (|x - c| / R)^2 (x - c),    J (x, y) = (-y, x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.typing import FloatArray

__all__ = ["PARAMETERS", "Registration", "frame_geometry", "registration_basis"]


PARAMETERS = ("shift_x", "shift_y", "rotation", "scale", "radial")
"""Parameters of a light: px, px, rad (x towards y), relative magnification, relative magnification more at radius R."""


def registration_basis(points: npt.ArrayLike, centre: tuple[float, float], radius: float) -> FloatArray:
    """Return the displacement (M, 2, 5) at points (x, y) of shape (M, 2) per unit of each of the `PARAMETERS`."""
    arm = np.asarray(points, dtype=np.float64) - np.asarray(centre)
    x, y = arm.T
    one, none = np.ones_like(x), np.zeros_like(x)
    growth = (x**2 + y**2) / radius**2
    return np.stack([np.stack([one, none, -y, x, growth * x]), np.stack([none, one, x, y, growth * y])]).transpose(
        2, 0, 1
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Lateral registration of k lights against the first.

    Attributes
    ----------
    lights : tuple of str, length k
    parameters : ndarray, shape (k, 5)
        `PARAMETERS` of every light; the first light's are 0.
    centre : tuple of float
        Point (x, y) in px that rotation, scale and radial term leave where it is.
    radius : float
        R in px: where the radial term is stated.
    covariance : ndarray, shape (k, 5, 5), or None
        Covariance of each light's parameters.
    """

    lights: tuple[str, ...]
    parameters: FloatArray
    centre: tuple[float, float]
    radius: float
    covariance: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        count, terms = len(self.lights), len(PARAMETERS)
        parameters = np.asarray(self.parameters, dtype=np.float64)
        if parameters.shape != (count, terms) or not np.isfinite(parameters).all() or parameters[0].any():
            raise CalibrationError(
                f"a registration of {count} lights has {terms} finite parameters per light, those of the first all 0; "
                f"given are {parameters.tolist()}"
            )
        if not self.radius > 0:
            raise CalibrationError(f"the radius of a registration must be positive, not {self.radius}")
        object.__setattr__(self, "parameters", parameters)
        object.__setattr__(self, "centre", (float(self.centre[0]), float(self.centre[1])))
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=np.float64)
            if covariance.shape != (count, terms, terms) or not np.isfinite(covariance).all():
                raise CalibrationError(
                    f"the covariance of a registration of {count} lights has shape ({count}, {terms}, {terms}), "
                    f"not {covariance.shape}"
                )
            object.__setattr__(self, "covariance", covariance)

    @classmethod
    def identity(cls, lights: tuple[str, ...], shape: tuple[int, int]) -> Registration:
        """All lights see every point at the same pixel of a frame of `shape` (rows, columns)."""
        centre, radius = frame_geometry(shape)
        return cls(lights=lights, parameters=np.zeros((len(lights), 5)), centre=centre, radius=radius)

    @property
    def depends_on_place(self) -> bool:
        """Whether any light is more than shifted."""
        return bool(self.parameters[:, 2:].any())

    def cropped(self, origin: tuple[int, int]) -> Registration:
        """Return the registration on frames that begin at the pixel `origin` (column, row) of the calibrated ones."""
        return replace(self, centre=(self.centre[0] - origin[0], self.centre[1] - origin[1]))

    def displacement(self, points: npt.ArrayLike, light: int | None = None) -> FloatArray:
        """rho_j: what light 1 sees at point x is seen by light j at x + rho_j(x).

        Parameters
        ----------
        points : array_like, shape (M, 2)
            Points (x, y) in px of the first light's image.
        light
            Number of the light; None: all.

        Returns
        -------
        ndarray, shape (k, M, 2) or (M, 2)
            In px; zero for the first light.
        """
        x, y = (_checked(points) - self.centre).T
        along, down, turn, scale, radial = self.parameters[slice(None) if light is None else light].T[..., None]
        growth = scale + radial * ((x * x + y * y) / self.radius**2)
        return np.stack([along - turn * y + growth * x, down + turn * x + growth * y], axis=-1)

    def displacement_std(self, points: npt.ArrayLike) -> FloatArray | None:
        """Return the standard uncertainty (k, M, 2) in px of `displacement`; None where the covariance is not known."""
        if self.covariance is None:
            return None
        basis = registration_basis(_checked(points), self.centre, self.radius)
        return np.asarray(np.sqrt(np.einsum("mdp,kpq,mdq->kmd", basis, self.covariance, basis)))


def _checked(points: npt.ArrayLike) -> FloatArray:
    place = np.asarray(points, dtype=np.float64)
    if place.ndim != 2 or place.shape[1] != 2:
        raise InputError(f"points have shape (M, 2), not {place.shape}")
    return place


def frame_geometry(shape: tuple[int, int]) -> tuple[tuple[float, float], float]:
    """Return centre (x, y) and half diagonal in px of a frame of `shape` (rows, columns)."""
    height, width = shape
    return ((width - 1) / 2, (height - 1) / 2), float(np.hypot(width, height) / 2)
