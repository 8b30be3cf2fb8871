"""Point lights: position, power, spectrum, and what the lens does to their colour."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.spectra import Led
from rgbmidic.typing import FloatArray

__all__ = ["NOMINAL_DISTANCE", "Light", "Vector", "rotation", "three_lights"]

NOMINAL_DISTANCE = 600.0
"""Distance (mm) at which a light of power 1 gives an ideal white the camera's `exposure`."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Light:
    """A point light; the irradiance falls with the square of the distance.

    Attributes
    ----------
    name
        What the light's image is called.
    position
        (x, y, z) in mm: x right, y down, z away from the camera, origin at the camera.
    power
        1 lights an ideal white that faces it at `NOMINAL_DISTANCE` to the camera's `exposure`.
    spectrum
        Needed where the crosstalk follows from spectra.
    magnification
        Relative radial magnification of the lens in this colour (lateral chromatic aberration).
    shift
        Further shift (x, y) of this colour's image, px.
    """

    name: str
    position: Vector
    power: float = 1.0
    spectrum: Led | None = None
    magnification: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.position).all() and self.power >= 0 and math.isfinite(self.power)):
            raise InputError(f"light {self.name}: position must be finite, power not negative: {self}")
        if not abs(self.magnification) < 0.1:
            raise InputError(f"light {self.name}: magnification is a small relative change, not {self.magnification}")

    def aimed(self, target: Vector, irradiance: float = 1.0) -> Light:
        """This light with the power that gives `irradiance` (1: the camera's exposure) at the target."""
        return replace(self, power=irradiance * math.dist(self.position, target) ** 2 / NOMINAL_DISTANCE**2)

    def turned(self, angle_deg: float, pivot: Vector, axis: Vector = (0.0, 1.0, 0.0)) -> Light:
        """This light turned about an axis through a pivot, as on the goniometer of paper section 2.3."""
        position = rotation(angle_deg, axis) @ (np.array(self.position) - pivot) + pivot
        return replace(self, position=(float(position[0]), float(position[1]), float(position[2])))


def rotation(angle_deg: float, axis: Vector) -> FloatArray:
    """Rotation matrix by an angle about an axis (Rodrigues)."""
    length = math.hypot(*axis)
    if length == 0:
        raise InputError("a rotation axis must not be the null vector")
    x, y, z = (component / length for component in axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(angle_deg)
    turn: FloatArray = np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
    return turn


def three_lights(
    target: Vector = (0.0, 0.0, NOMINAL_DISTANCE), aberration: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Light, ...]:
    """Red, green and blue lamps left, right and above the camera, all equally bright at the target.

    `aberration`: relative magnification of the lens in red, green and blue.
    """
    places = {"red": (-190.0, -12.0, 90.0), "green": (200.0, 15.0, 90.0), "blue": (10.0, -220.0, 60.0)}
    return tuple(
        Light(name=name, position=position, magnification=magnification).aimed(target)
        for (name, position), magnification in zip(places.items(), aberration, strict=True)
    )
