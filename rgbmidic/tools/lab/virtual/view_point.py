"""A second camera in a virtual test: the same scene and its states in the axes of a camera that stands elsewhere."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import CameraCalibration
from rgbmidic.tools.scene.camera import Camera, SecondCamera, Vector, rotation
from rgbmidic.tools.scene.scene import Body, Scene, State
from rgbmidic.tools.scene.zones import material_points, points_and_normals
from rgbmidic.tools.stereo import CameraPair
from rgbmidic.typing import AnyArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewPoint:
    """A camera and its place: it sees a point p of the scene's axes at ``rotation p + translation``.

    Attributes
    ----------
    camera
        The camera.
    rotation : ndarray, shape (3, 3)
        From the scene's axes to the camera's.
    translation : ndarray, shape (3,)
        mm.
    """

    camera: Camera
    rotation: FloatArray
    translation: FloatArray

    @classmethod
    def around(cls, scene: Scene, angle_deg: float, azimuth_deg: float = 0.0, roll_deg: float = 0.0) -> Self:
        """Place the scene's camera elsewhere on a sphere, about the point of its axis as deep as the body's front.

        Parameters
        ----------
        scene
            The scene.
        angle_deg
            Angle from the scene's camera.
        azimuth_deg
            Direction in which it stands from there: 0 to the right, 90 below.
        roll_deg
            Turn about its own axis.

        Returns
        -------
        ViewPoint
        """
        azimuth, pivot = math.radians(azimuth_deg), np.array([0.0, 0.0, scene.body.front[2]])
        turn = rotation(angle_deg, (-math.sin(azimuth), math.cos(azimuth), 0.0))
        turn = rotation(roll_deg, (0.0, 0.0, 1.0)) @ turn
        return cls(camera=scene.camera, rotation=turn, translation=pivot - turn @ pivot)

    @classmethod
    def both(cls, scene: Scene, second: SecondCamera) -> tuple[Self, Self]:
        """Return the scene's camera where it is, the left one, and the second camera, the right one.

        Parameters
        ----------
        scene
            The scene.
        second
            How the second camera stands.

        Returns
        -------
        left, right : ViewPoint
        """
        right = cls.around(scene, second.angle_deg, second.azimuth_deg, second.roll_deg)
        changes = {name: value for name in ("shape", "focal_px") if (value := getattr(second, name)) is not None}
        return cls.around(scene, 0.0), replace(right, camera=replace(scene.camera, **changes))

    def scene(self, scene: Scene) -> Scene:
        """Return the scene as this camera has it: the lamps in its axes. The body needs the states of `state`.

        Parameters
        ----------
        scene
            The scene.

        Returns
        -------
        Scene
        """
        positions = [self.rotation @ np.array(light.position) + self.translation for light in scene.lights]
        lights = zip(scene.lights, positions, strict=True)
        moved = tuple(replace(light, position=_vector(place)) for light, place in lights)
        return replace(scene, camera=self.camera, lights=moved)

    def state(self, body: Body, state: State | None = None) -> State:
        """Return a state of the body in this camera's axes.

        Parameters
        ----------
        body
            The body.
        state
            In the scene's axes; None: the body at rest.

        Returns
        -------
        State

        Raises
        ------
        InputError
            The body spins during the exposure.
        """
        state = state or State()
        if state.spin_deg:
            raise InputError("a second camera sees no body that spins during the exposure: leave spin_deg out")
        turn, origin = state.pose(body)
        vector = np.ravel(cv2.Rodrigues(self.rotation @ turn @ body.attitude.T)[0])
        angle = float(np.linalg.norm(vector))
        return replace(
            state,
            angle_deg=float(np.degrees(angle)),
            axis=_vector(vector) if angle else (0.0, 1.0, 0.0),
            pivot=body.centre,
            translation=_vector(self.rotation @ origin + self.translation - body.centre),
            velocity=_vector(self.rotation @ np.array(state.velocity)),
        )


def _vector(values: AnyArray) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def true_pair(scene: Scene, left: ViewPoint, right: ViewPoint) -> CameraPair:
    """Return the cameras that a perfect calibration would find.

    Parameters
    ----------
    scene
        The scene.
    left, right
        The cameras.

    Returns
    -------
    CameraPair
    """
    first, second = (
        CameraCalibration(
            shape=view.camera.shape,
            lens=np.r_[view.camera.lenses(scene.lights)[0], np.zeros(5)],
            details={"first_light": scene.lights[0].name},
        )
        for view in (left, right)
    )
    poses = ((view.rotation, view.translation) for view in (left, right))
    return CameraPair.of_poses((first, second), *poses)


def true_motion(scene: Scene, left: ViewPoint, pixels: FloatArray, state: State) -> tuple[FloatArray, FloatArray]:
    """Return the material points that the left camera sees at rest, and their displacement in a state.

    Parameters
    ----------
    scene
        The scene.
    left
        The left camera.
    pixels : ndarray, shape (N, 2)
        Points (x, y) in px of the left frame.
    state
        In the scene's axes.

    Returns
    -------
    points, displacement : ndarray, shape (N, 3)
        mm, left camera's axes; NaN off the body.
    """
    seen = left.scene(scene)
    at_rest, moved = left.state(scene.body), left.state(scene.body, state)
    material = material_points(seen, at_rest, (pixels[:, 0], pixels[:, 1]))
    points, deformed = (points_and_normals(seen, material, pose)[0].T for pose in (at_rest, moved))
    return points, deformed - points
