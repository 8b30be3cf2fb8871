"""Axes in which a stereo result is: those of the left camera, of the mean plane, or through three points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import MeshPoints
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray, as_numbers

AxesChoice = Literal["plane", "camera"] | Sequence[Sequence[float]]
"""``"plane"``, ``"camera"``, or three points (x, y) in px of the left reference."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Axes:
    """Right-handed axes in space.

    Attributes
    ----------
    origin : ndarray, shape (3,)
        mm, in the left camera's axes.
    rotation : ndarray, shape (3, 3)
        Unit vectors of x, y and z in the left camera's axes, row by row.
    description : str
        What they are.
    """

    origin: FloatArray
    rotation: FloatArray
    description: str

    @classmethod
    def of(cls, choice: AxesChoice, mesh: Tri3Mesh | None, points: FloatArray) -> Axes:
        """Lay axes through a surface.

        Parameters
        ----------
        choice
            ``"camera"``: those of the left camera, x to the right, y down, z away from it. ``"plane"``: the plane that
            fits the undeformed surface best, its middle the origin, x as the left camera's rows run on it, y down, z
            away from the cameras. Three points in px of the left reference: the origin, a point on the x axis, and one
            on the side of the plane z = 0 where y is positive.
        mesh
            N nodes in px of the left frame, for axes through three points; None: not needed.
        points : ndarray, shape (N, 3)
            The undeformed surface at the nodes, mm, left camera's axes.

        Returns
        -------
        Axes

        Raises
        ------
        InputError
            Another choice, a point outside the mesh, or three points on a line.
        """
        if isinstance(choice, str):
            if choice == "camera":
                return cls(origin=np.zeros(3), rotation=np.eye(3), description="of the left camera")
            if choice != "plane":
                raise InputError(f'axes are "plane", "camera" or three points (x, y) in px, not {choice!r}')
            origin = points.mean(axis=0)
            normal = np.linalg.svd(points - origin, full_matrices=False)[2][2]
            normal *= -1.0 if normal[2] < 0 else 1.0
            return cls._from(origin, np.array([1.0, 0.0, 0.0]), normal, "of the plane that fits the surface best")
        needed = "axes through points need three points (x, y) in px of the left reference"
        pixels = as_numbers(choice, needed, (3, 2), error=InputError)
        if mesh is None:
            raise InputError(f"{needed}, on its mesh")
        mesh_points = MeshPoints.of(mesh, pixels)
        mesh_points.check("a point of the axes")
        first, second, third = np.stack([mesh_points.read(values) for values in points.T], axis=1)
        normal = np.cross(second - first, third - first)
        if not np.linalg.norm(normal) > 1e-3 * np.linalg.norm(second - first) * np.linalg.norm(third - first):
            raise InputError(f"{needed} that do not lie on a line; given are {pixels.tolist()}")
        text = "through " + ", ".join(f"({x:g}, {y:g})" for x, y in pixels) + " px of the left reference"
        return cls._from(first, second - first, normal, text)

    @classmethod
    def _from(cls, origin: FloatArray, along: FloatArray, normal: FloatArray, description: str) -> Axes:
        z = normal / np.linalg.norm(normal)
        x = along - (along @ z) * z
        x /= np.linalg.norm(x)
        return cls(origin=origin, rotation=np.stack([x, np.cross(z, x), z]), description=description)

    def points(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the left camera's axes in these axes.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            mm.

        Returns
        -------
        ndarray, shape (N, 3)
        """
        return np.asarray((points - self.origin) @ self.rotation.T)

    def covariance(self, covariance: FloatArray) -> FloatArray:
        """Return covariances (N, 3, 3) in these axes.

        Parameters
        ----------
        covariance : ndarray, shape (N, 3, 3)
            In the left camera's axes.

        Returns
        -------
        ndarray, shape (N, 3, 3)
        """
        return np.asarray(self.rotation @ covariance @ self.rotation.T)
