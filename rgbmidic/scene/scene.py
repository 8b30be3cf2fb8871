"""What stands in front of the camera: bodies, their states, and the scene they make with paint, lights and camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from rgbmidic._kernels import render as kernels
from rgbmidic.errors import InputError
from rgbmidic.scene.camera import Camera
from rgbmidic.scene.in_plane import InPlaneField
from rgbmidic.scene.light import Light, Vector, rotation
from rgbmidic.scene.surface import Surface
from rgbmidic.typing import FloatArray

__all__ = ["Body", "Cylinder", "Plate", "Scene", "Sphere", "State"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Sphere:
    """A sphere. `centre` in mm, camera axes."""

    radius: float = 41.25
    centre: Vector = (0.0, 0.0, 641.25)

    def __post_init__(self) -> None:
        _check_size(self.radius, self.radius, self.centre[2] - self.radius)

    @property
    def front(self) -> Vector:
        """The point nearest to the camera's plane, about which the paper's sphere turns."""
        return self.centre[0], self.centre[1], self.centre[2] - self.radius

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return np.eye(3)

    def parameters(self) -> FloatArray:
        """[kind, radius, half width, half height] for the kernels."""
        return np.array([kernels.SPHERE, self.radius, np.inf, np.inf])


@dataclass(frozen=True, slots=True, kw_only=True)
class Cylinder:
    """The mantle of a cylinder; its axis is parallel to y until it is tilted (degrees about z)."""

    radius: float = 15.0
    length: float = 1000.0
    centre: Vector = (0.0, 0.0, 615.0)
    tilt_deg: float = 0.0

    def __post_init__(self) -> None:
        _check_size(self.radius, self.length, self.centre[2] - self.radius)

    @property
    def front(self) -> Vector:
        """Middle of the generatrix nearest to the camera."""
        return self.centre[0], self.centre[1], self.centre[2] - self.radius

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return rotation(self.tilt_deg, (0.0, 0.0, 1.0))

    def parameters(self) -> FloatArray:
        """[kind, radius, half width, half height] for the kernels."""
        return np.array([kernels.CYLINDER, self.radius, np.inf, self.length / 2])


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """A flat plate facing the camera until it is tilted: degrees about y, then about x."""

    width: float = 75.0
    height: float = 50.0
    centre: Vector = (0.0, 0.0, 600.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        _check_size(self.width, self.height, self.centre[2])

    @property
    def front(self) -> Vector:
        """The plate's middle."""
        return self.centre

    @property
    def attitude(self) -> FloatArray:
        """Rotation from the body's axes to the camera's in the reference state."""
        return rotation(self.tilt_deg[1], (1.0, 0.0, 0.0)) @ rotation(self.tilt_deg[0], (0.0, 1.0, 0.0))

    def parameters(self) -> FloatArray:
        """[kind, radius, half width, half height] for the kernels."""
        return np.array([kernels.PLATE, 0.0, self.width / 2, self.height / 2])


Body = Sphere | Cylinder | Plate


@dataclass(frozen=True, slots=True, kw_only=True)
class State:
    """Where the body is: in-plane displacement of a plate, then rotation about a pivot, then translation.

    Attributes
    ----------
    angle_deg, axis
        Rotation about an axis (camera directions) through the pivot.
    pivot
        Point on the axis (mm); None: the body's front point.
    translation
        mm.
    displacement
        In-plane displacement of a plate; None: none.
    velocity, spin_deg
        mm/s and degrees per second (same axis and pivot) during the camera's exposure time.
    """

    angle_deg: float = 0.0
    axis: Vector = (0.0, 1.0, 0.0)
    pivot: Vector | None = None
    translation: Vector = (0.0, 0.0, 0.0)
    displacement: InPlaneField | None = None
    velocity: Vector = (0.0, 0.0, 0.0)
    spin_deg: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the body moves during the exposure."""
        return any(self.velocity) or self.spin_deg != 0

    def after(self, seconds: float) -> State:
        """The state some time later, at rest."""
        x, y, z = (p + v * seconds for p, v in zip(self.translation, self.velocity, strict=True))
        angle = self.angle_deg + self.spin_deg * seconds
        return replace(self, angle_deg=angle, translation=(x, y, z), velocity=(0.0, 0.0, 0.0), spin_deg=0.0)

    def pose(self, body: Body) -> tuple[FloatArray, FloatArray]:
        """Rotation R (3, 3) and origin t (3,): camera point = R . body point + t."""
        pivot = np.array(body.front if self.pivot is None else self.pivot)
        turn = rotation(self.angle_deg, self.axis)
        origin = turn @ (np.array(body.centre) - pivot) + pivot + np.array(self.translation)
        return turn @ body.attitude, origin


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A body with its paint, the lights and the camera."""

    body: Body
    lights: tuple[Light, ...]
    camera: Camera
    surface: Surface = field(default_factory=Surface)

    def __post_init__(self) -> None:
        names = [light.name for light in self.lights]
        if not names or len(set(names)) < len(names):
            raise InputError(f"a scene has at least one light, and every light its own name; given are {names}")
        self.camera.response(self.lights)

    def light(self, name: str) -> Light:
        """The light of that name."""
        for light in self.lights:
            if light.name == name:
                return light
        raise InputError(f"no light {name!r}; the scene has {', '.join(light.name for light in self.lights)}")

    def with_light(self, light: Light) -> Scene:
        """The same scene with the light of that name exchanged."""
        self.light(light.name)
        return replace(self, lights=tuple(light if old.name == light.name else old for old in self.lights))

    def mirror_position(self, distance: float, state: State | None = None) -> Vector:
        """Where a lamp must stand for its reflection to cover the body's front point, seen from the camera.

        On a flat plate it covers the whole field. `distance` from the front point in mm.
        """
        turn, origin = (state or State()).pose(self.body)
        point = turn @ self.body.attitude.T @ (np.array(self.body.front) - np.array(self.body.centre)) + origin
        normal = turn @ np.array([0.0, 0.0, -1.0])
        view = -point / np.linalg.norm(point)
        position = point + distance * (2 * (normal @ view) * normal - view)
        return float(position[0]), float(position[1]), float(position[2])


def _check_size(a: float, b: float, front: float) -> None:
    if not (a > 0 and b > 0 and math.isfinite(front) and front > 0):
        raise InputError(f"a body has positive sizes ({a}, {b} mm) and lies in front of the camera (z {front} mm)")
