"""Weights from geometry: where each light reflects, from the places of lamps, camera and specimen (paper, section 3.2).

The paper's first method. The paint is rough: facets with a narrow specular lobe, tilted at random by the wrinkles. At
the scale of the speckle it reflects into the facets' lobe convolved with the law of the slopes (P. Beckmann and A.
Spizzichino, The Scattering of Electromagnetic Waves from Rough Surfaces, 1963; R. Cook and K. Torrance, ACM
Transactions on Graphics 1, 1982). That lobe is smooth and predictable; the erratic part within it (paper, section 2.3)
is not, which is why the prediction serves to weight the lights and not to correct the images.

The camera stands in the origin and looks along +z; x to the right, y downwards, lengths in mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflectance:
    """How a painted surface reflects, at the scale of the speckle.

    Radiance under unit irradiance: ``diffuse n.l + specular exp(-t^2/(2 width^2)) / (v.h)``, with t the tangent of the
    angle between the surface's normal n and the half-way vector h of the light's and the camera's directions l and v.

    Attributes
    ----------
    diffuse
        Mean diffuse reflection (albedo).
    specular
        Peak of the specular lobe, in the same unit.
    width_deg
        Standard deviation of the lobe, as the angle of the half-way vector: half of that by which the light turns.
    """

    diffuse: float
    specular: float
    width_deg: float

    def __post_init__(self) -> None:
        """Check the values."""
        if not (self.diffuse > 0 and self.specular >= 0 and 0 < self.width_deg < 45):
            raise InputError(
                f"a reflectance has a positive diffuse and a non-negative specular part and a width of 0 to 45 degrees;"
                f" given are {self.diffuse}, {self.specular}, {self.width_deg}"
            )

    @classmethod
    def from_goniometry(cls, *, diffuse: float, specular: float, width_deg: float) -> Reflectance:
        """From a lobe measured while the light turns about a fixed specimen (`rgbmidic.lab.measures.Lobe`).

        Parameters
        ----------
        diffuse, specular
            Grey levels at normal incidence and at the lobe's peak.
        width_deg
            Standard deviation of the lobe in the angle of the light, twice that of the half-way vector.
        """
        return cls(diffuse=diffuse, specular=specular, width_deg=width_deg / 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflection:
    """Where lights reflect, at points of a surface; NaN where a light or the camera does not see the surface.

    Attributes
    ----------
    slopes : ndarray, shape (k, 3, ...)
        The half-way vector relative to the normal, ``h/(n.h) - n``: the slope that a facet needs to be a mirror.
    lambert : ndarray, shape (k, ...)
        Cosine between normal and light.
    half : ndarray, shape (k, ...)
        Cosine v.h between the camera and the half-way vector.
    deviation_deg : ndarray, shape (k, ...)
        Angle between the light and the mirror direction of the camera's ray.
    """

    slopes: FloatArray
    lambert: FloatArray
    half: FloatArray
    deviation_deg: FloatArray

    def diffuse(self, reflectance: Reflectance) -> FloatArray:
        """Radiance (k, ...) of the diffuse light under unit irradiance across the rays."""
        return reflectance.diffuse * self.lambert

    def specular(self, reflectance: Reflectance) -> FloatArray:
        """Return the expected radiance (k, ...) of the specular light under unit irradiance across the rays."""
        square = (self.slopes**2).sum(axis=1)
        lobe = np.exp(-square / (2 * math.radians(reflectance.width_deg) ** 2))
        return np.asarray(reflectance.specular * lobe / self.half)

    def fraction(self, reflectance: Reflectance) -> FloatArray:
        """Return the expected specular fraction q/(d + q) of the light that reaches the camera, (k, ...), 0 to 1."""
        q = self.specular(reflectance)
        return np.asarray(q / (self.diffuse(reflectance) + q))


def reflection(points: FloatArray, normals: FloatArray, lamps: npt.ArrayLike) -> Reflection:
    """Where lamps reflect on a surface seen from the origin.

    Parameters
    ----------
    points, normals : ndarray, shape (3, ...)
        Positions (mm) and outward unit normals; NaN off the surface.
    lamps : array_like, shape (k, 3)
        Positions (mm).

    Raises
    ------
    InputError
        The shapes do not fit.
    """
    positions = np.asarray(lamps, dtype=np.float64)
    if points.shape != normals.shape or len(points) != 3 or positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(
            f"points and normals have shape (3, ...), lamps (k, 3); given are {points.shape}, {normals.shape}, "
            f"{positions.shape}"
        )
    view, light = _unit(-points), _unit(positions.reshape(-1, 3, *[1] * (points.ndim - 1)) - points, axis=1)
    halfway = _unit(light + view, axis=1)
    lambert, facing = (normals * light).sum(axis=1), (normals * view).sum(axis=0)
    mirror = 2 * facing * normals - view
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = halfway / (normals * halfway).sum(axis=1, keepdims=True) - normals
    seen = (lambert > 0) & (facing > 0)
    return Reflection(
        slopes=np.where(seen[:, None], slopes, np.nan),
        lambert=np.where(seen, lambert, np.nan),
        half=np.where(seen, (view * halfway).sum(axis=1), np.nan),
        deviation_deg=np.where(seen, np.degrees(np.arccos(np.clip((mirror * light).sum(axis=1), -1, 1))), np.nan),
    )


def angle_weights(deviation_deg: FloatArray, limit_deg: float = 15.0) -> FloatImage:
    """Binary weights: 0 within `limit_deg` of the mirror direction and where the deviation is NaN, 1 elsewhere.

    By default the limit is that within which the reflection corrupts the image (paper, Fig. 9).

    Raises
    ------
    InputError
        The limit is not an angle between 0 and 180 degrees.
    """
    if not 0 < limit_deg < 180:
        raise InputError(f"the limit angle lies between 0 and 180 degrees, not {limit_deg!r}")
    return (deviation_deg > limit_deg).astype(np.float32)


def surface_from_heights(
    heights: npt.ArrayLike, *, distance: float, focal_px: float, centre: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Points and normals of a surface given as a height map over the pixels of the reference image.

    Parameters
    ----------
    heights : array_like, shape (H, W)
        Height (mm) towards the camera over the plane at `distance`, at every pixel; NaN where not known. Smooth at the
        scale of the speckle: droplets and wrinkles belong to the reflectance.
    distance
        Distance (mm) of that plane from the camera.
    focal_px, centre
        Focal length and principal point (x, y) in px.

    Returns
    -------
    points, normals : ndarray, shape (3, H, W)

    Raises
    ------
    InputError
        Not one image, or a height that reaches the camera.
    """
    height = np.asarray(heights, dtype=np.float64)
    if height.ndim != 2 or min(height.shape) < 2:
        raise InputError(f"a height map is one image (H, W), not an array of shape {height.shape}")
    depth = distance - height
    if not np.nanmin(depth, initial=np.inf) > 0:
        raise InputError(f"heights must stay below the distance of {distance:g} mm to the camera")
    rows, columns = np.mgrid[: height.shape[0], : height.shape[1]]
    points = np.stack([depth * (columns - centre[0]) / focal_px, depth * (rows - centre[1]) / focal_px, depth])
    down, right = np.gradient(points, axis=(1, 2))
    return points, _unit(np.cross(down, right, axis=0))


def _unit(vectors: FloatArray, axis: int = 0) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=axis, keepdims=True))
