"""Two calibrated cameras and how they stand to each other: the file that ``rgbmidic-calibrate stereo`` writes.

A point X in mm lies in the axes of the left camera: its origin is the left camera's centre of projection, x along the
rows of its frame, y down the columns, z along the optical axis, away from the camera. The right camera sees it at
``R X + t``; either lens images ``n = (x / z, y / z)`` at ``c + f d(n)`` (`rgbmidic.fields.plane`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from rgbmidic.errors import CalibrationError
from rgbmidic.fields import CameraCalibration
from rgbmidic.fields.plane import LENS_PARAMETERS, distorted, undistorted
from rgbmidic.illumination.calibration import has_schema, read_document, write_document
from rgbmidic.typing import AnyArray, FloatArray, as_numbers

_SCHEMA, _VERSION = "rgbmidic-stereo", 1
_POSE = tuple(f"{name}_{axis}" for name in ("rotation", "translation") for axis in "xyz")
PAIR_PARAMETERS = (*(f"{side}_{name}" for side in ("left", "right") for name in LENS_PARAMETERS), *_POSE)
"""Lens of the left and of the right camera (px and the distortion's own), rotation vector (rad), translation (mm)."""
_COUNT = len(PAIR_PARAMETERS)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraPair:
    """A left and a right camera with their lenses and their relative pose.

    Attributes
    ----------
    left, right : CameraCalibration
        Lens and frame of each; the first light's, if their details name one.
    rotation : ndarray, shape (3,)
        Rotation vector (axis times angle, rad) from the left camera's axes to the right one's.
    translation : ndarray, shape (3,)
        Place of the left camera in the right one's axes, mm: ``x_right = R x_left + t``.
    covariance : ndarray, shape (22, 22)
        Covariance of `PAIR_PARAMETERS`; 0 for what was held fixed.
    details : mapping
        Other content of the file: residuals, views, provenance.
    name : str
        File name, for messages.

    Examples
    --------
    >>> import numpy as np
    >>> camera = CameraCalibration(shape=(480, 640), lens=[2000, 319.5, 239.5, 0, 0, 0, 0, 0])
    >>> pair = CameraPair(left=camera, right=camera, rotation=[0, -0.4, 0], translation=[230, 0, 50])
    >>> round(pair.angle_deg, 1), round(pair.baseline)
    (22.9, 235)
    """

    left: CameraCalibration
    right: CameraCalibration
    rotation: FloatArray
    translation: FloatArray
    covariance: FloatArray = field(default_factory=lambda: np.zeros((_COUNT, _COUNT)))
    details: Mapping[str, Any] = field(default_factory=dict)
    name: str = "stereo calibration"

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        for key, shape in (("rotation", (3,)), ("translation", (3,)), ("covariance", (_COUNT, _COUNT))):
            needed = f"{self.name}: {key} must be finite with shape {shape}"
            object.__setattr__(self, key, as_numbers(getattr(self, key), needed, shape, error=CalibrationError))
        for side in ("left", "right"):
            if getattr(self, side).lens is None:
                raise CalibrationError(f"{self.name}: the {side} camera has no lens, whose focal length is needed")
        if (np.diag(self.covariance) < 0).any() or not np.allclose(self.covariance, self.covariance.T):
            raise CalibrationError(f"{self.name}: the covariance must be symmetric, its diagonal not negative")
        if not np.linalg.norm(self.translation) > 0:
            raise CalibrationError(
                f"{self.name}: both cameras stand at one place: there is no depth without a baseline"
            )
        if not np.linalg.norm(self.rotation) <= np.pi:
            raise CalibrationError(f"{self.name}: the rotation is {np.linalg.norm(self.rotation):g} rad, at most pi")

    @classmethod
    def of_poses(
        cls,
        cameras: tuple[CameraCalibration, CameraCalibration],
        left: tuple[FloatArray, FloatArray],
        right: tuple[FloatArray, FloatArray],
    ) -> Self:
        """Relate two cameras by where each stands in the axes of a scene.

        Parameters
        ----------
        cameras
            Left and right camera.
        left, right
            Rotation (3, 3) and translation (3,), mm, from the scene's axes to either camera's.

        Returns
        -------
        CameraPair
        """
        turn = right[0] @ left[0].T
        rotation = np.asarray(cv2.Rodrigues(turn)[0], dtype=np.float64).ravel()
        return cls(left=cameras[0], right=cameras[1], rotation=rotation, translation=right[1] - turn @ left[1])

    @property
    def cameras(self) -> tuple[CameraCalibration, CameraCalibration]:
        """Left and right camera."""
        return self.left, self.right

    @property
    def poses(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Rotation (3, 3) and translation (3,) from the left camera's axes to either camera's."""
        turn = np.asarray(cv2.Rodrigues(self.rotation)[0], dtype=np.float64)
        return (np.eye(3), np.zeros(3)), (turn, self.translation)

    @property
    def baseline(self) -> float:
        """Distance of the cameras, mm."""
        return float(np.linalg.norm(self.translation))

    @property
    def angle_deg(self) -> float:
        """Angle between the optical axes, degrees."""
        return float(np.degrees(np.arccos(np.clip(self.poses[1][0][2, 2], -1, 1))))

    @property
    def exchanged(self) -> Self:
        """The pair with the right camera as the left one, taken as exact."""
        turn, shift = self.poses[1]
        return replace(
            self,
            left=self.right,
            right=self.left,
            rotation=-self.rotation,
            translation=-turn.T @ shift,
            covariance=np.zeros_like(self.covariance),
        )

    @property
    def parameters(self) -> FloatArray:
        """Values (22,) of `PAIR_PARAMETERS`."""
        assert self.left.lens is not None
        assert self.right.lens is not None
        return np.concatenate([self.left.lens, self.right.lens, self.rotation, self.translation])

    def with_parameters(self, values: FloatArray) -> Self:
        """Return the pair with other values of `PAIR_PARAMETERS`.

        Parameters
        ----------
        values : ndarray, shape (22,)
            The values.

        Returns
        -------
        CameraPair
        """
        left, right = replace(self.left, lens=values[:8]), replace(self.right, lens=values[8:16])
        return replace(self, left=left, right=right, rotation=values[16:19], translation=values[19:])

    @property
    def parameter_errors(self) -> FloatArray:
        """M independent errors (22, M) of unit variance of the parameters, which make up the covariance.

        M is the rank of the covariance.
        """
        scale = np.sqrt(np.diag(self.covariance))
        product = np.outer(scale, scale)
        relative = np.divide(self.covariance, product, out=np.zeros_like(product), where=product > 0)
        variances, vectors = np.linalg.eigh(relative)
        variances[variances < 1e-12] = 0.0  # rounding
        return np.asarray((scale[:, None] * vectors * np.sqrt(variances))[:, variances > 0])

    def parameter_slopes(self, points: FloatArray) -> FloatArray:
        """Return the derivative (N, 4, 22) of the coordinates in the left and the right frame by the parameters.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In mm, left camera's axes.

        Returns
        -------
        ndarray, shape (N, 4, 22)
        """
        _, of_left, _ = project_with_slopes(self.parameters[:8], points, (np.zeros(3), np.zeros(3)))
        _, of_right, of_pose = project_with_slopes(self.parameters[8:16], points, (self.rotation, self.translation))
        slopes = np.zeros((len(points), 4, _COUNT))
        slopes[:, :2, :8], slopes[:, 2:, 8:16], slopes[:, 2:, 16:] = of_left, of_right, of_pose
        return slopes

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return where points are seen by the left and by the right camera.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            In mm, left camera's axes.

        Returns
        -------
        left, right : ndarray, shape (N, 2)
            (x, y) in px; NaN for points behind a camera.
        """
        pixels = []
        for camera, (turn, shift) in zip(self.cameras, self.poses, strict=True):
            assert camera.lens is not None
            inside = points @ turn.T + shift
            depth = np.where(inside[:, 2:] > 0, inside[:, 2:], np.nan)
            pixels.append(distorted(camera.lens, camera.lens[0] * inside[:, :2] / depth + camera.lens[1:3]))
        return pixels[0], pixels[1]

    def check(self, shapes: tuple[tuple[int, int], tuple[int, int]]) -> None:
        """Refuse frames of other shapes (rows, columns) than the cameras were calibrated with.

        Parameters
        ----------
        shapes
            Of the left and of the right camera's frames.

        Raises
        ------
        CalibrationError
            A shape is another one.
        """
        for side, camera, shape in zip(("left", "right"), self.cameras, shapes, strict=True):
            if camera.shape != tuple(shape):
                raise CalibrationError(
                    f"{self.name}: the {side} camera was calibrated with frames of {camera.shape[1]} x "
                    f"{camera.shape[0]} px, those of its test have {shape[1]} x {shape[0]} px: calibrate with frames "
                    "of the size of the test's"
                )

    def check_lights(self, lights: tuple[Sequence[str], Sequence[str]]) -> None:
        """Refuse a test whose first light, in px of whose image it measures, is not that of its camera.

        Parameters
        ----------
        lights
            Names of the lights of the left and of the right test in their order; empty where they are not known.

        Raises
        ------
        CalibrationError
            A camera is of the image of another light.
        """
        for side, camera, names in zip(("left", "right"), self.cameras, lights, strict=True):
            stated_light = camera.details.get("first_light")
            if stated_light is not None and names and names[0] != stated_light:
                raise CalibrationError(
                    f"{self.name}: the {side} camera is of light {stated_light}'s image, its test measures in px of "
                    f"that of light {names[0]}, the first of its calibration.file"
                )

    @classmethod
    def is_in(cls, path: Path) -> bool:
        """Return whether a file is one that `read` reads, if not damaged.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        bool
        """
        return has_schema(path, _SCHEMA)

    @classmethod
    def read(cls, path: Path | str) -> Self:
        """Read the file that ``rgbmidic-calibrate stereo`` wrote.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        CameraPair

        Raises
        ------
        CalibrationError
            The file is missing, not JSON, of another schema or version, or damaged.
        """
        document, name = read_document(path, "stereo calibration", _SCHEMA, _VERSION), str(path)
        try:
            cameras = {
                side: CameraCalibration.from_document(document[side], f"{name}: the {side} camera")
                for side in ("left", "right")
            }
            return cls(
                **cameras,
                rotation=document["rotation_rad"],
                translation=document["translation_mm"],
                covariance=document["covariance"],
                details=dict(document.get("details") or {}),
                name=name,
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, CalibrationError):
                raise
            reason = f"missing key {error}" if isinstance(error, KeyError) else error
            raise CalibrationError(f"{name} is damaged: {reason}") from None

    def write(self, path: Path | str) -> None:
        """Write the file; errors as `rgbmidic.illumination.calibration.write_document`.

        Parameters
        ----------
        path
            File to write.
        """
        document = {
            "schema": _SCHEMA,
            "schema_version": _VERSION,
            "left": self.left.to_document(),
            "right": self.right.to_document(),
            "rotation_rad": self.rotation.tolist(),
            "translation_mm": self.translation.tolist(),
            "parameters": list(PAIR_PARAMETERS),
            "covariance": self.covariance.tolist(),
            "details": dict(self.details),
        }
        write_document(path, document)

    def summary(self) -> str:
        """Return focal lengths, baseline and angle of the axes as text.

        Returns
        -------
        str
        """
        focal = " and ".join(f"{lens[0]:.1f}" for lens in (self.parameters[:8], self.parameters[8:16]))
        return (
            f"focal lengths {focal} px, baseline {self.baseline:.3f} mm, {self.angle_deg:.2f} degrees between the axes"
        )


def project_with_slopes(
    lens: FloatArray, points: FloatArray, pose: tuple[AnyArray, AnyArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where a lens images points (N, 3), px (N, 2), and the derivatives of that by lens and pose.

    Parameters
    ----------
    lens : ndarray, shape (8,)
        See `rgbmidic.fields.plane.LENS_PARAMETERS`.
    points : ndarray, shape (N, 3)
        mm.
    pose
        Rotation vector and translation from the axes of the points to those of the camera.

    Returns
    -------
    pixels : ndarray, shape (N, 2)
    by_lens : ndarray, shape (N, 2, 8)
    by_pose : ndarray, shape (N, 2, 6)
    """
    pixels, slopes = cv2.projectPoints(np.ascontiguousarray(points), *pose, lens_matrix(lens), lens[3:])[:2]
    slopes = np.asarray(slopes, dtype=np.float64).reshape(len(points), 2, -1)
    by_lens = np.concatenate([slopes[..., 6:7] + slopes[..., 7:8], slopes[..., 8:15]], axis=2)
    return np.asarray(pixels, dtype=np.float64)[:, 0], by_lens, slopes[..., :6]


def lens_matrix(lens: FloatArray) -> FloatArray:
    """Return the matrix of a lens as OpenCV has it, without its distortion.

    Parameters
    ----------
    lens : ndarray, shape (8,)
        See `rgbmidic.fields.plane.LENS_PARAMETERS`.

    Returns
    -------
    ndarray, shape (3, 3)
    """
    return np.array([[lens[0], 0, lens[1]], [0, lens[0], lens[2]], [0, 0, 1.0]])


def image_plane(camera: CameraCalibration, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points (N, 2) freed from the lens, in units of the focal length, and their derivative (N, 2, 2) by the px.

    Parameters
    ----------
    camera
        With a lens.
    pixels : ndarray, shape (N, 2)
        Points (x, y) of the frame.

    Returns
    -------
    points : ndarray, shape (N, 2)
    slopes : ndarray, shape (N, 2, 2)
    """
    lens = camera.lens
    assert lens is not None
    straight = undistorted(lens, pixels)
    # central differences over 1 px, as `CameraCalibration.jacobian`
    steps = np.eye(2) / 2
    bent = np.stack([distorted(lens, straight + step) - distorted(lens, straight - step) for step in steps], axis=2)
    return (straight - lens[1:3]) / lens[0], np.linalg.inv(bent) / lens[0]
