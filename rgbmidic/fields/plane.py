"""The camera and the plane of the specimen: from pixels to millimetres, through the lens and a tilted plane.

A point (x, y) of the image is first freed from the lens distortion (Brown, Photogrammetric Engineering 37, 1971, in
OpenCV's form): ``x = c + f d(n)`` with the normalised coordinates n and
``d(n) = n (1 + k1 r^2 + k2 r^4 + k3 r^6) + (2 p1 nx ny + p2 (r^2 + 2 nx^2), p1 (r^2 + 2 ny^2) + 2 p2 nx ny)``. The
plane of the specimen is a homography H of the undistorted pixel, counted from the middle of the frame, to mm (Hartley
and Zisserman, Multiple View Geometry, 2004, section 2.3). Its axes are those of the image: the middle of the top left
pixel is (0, 0) mm, and in the middle of the frame x runs along the rows.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.field import Displacement
from rgbmidic.fields.quantity import Units
from rgbmidic.illumination.calibration import has_schema, read_document, write_document
from rgbmidic.illumination.images import Registration
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.source import Plane
from rgbmidic.renamed import state_new_names
from rgbmidic.text import format_with_std
from rgbmidic.typing import FloatArray, as_numbers

logger = logging.getLogger(__name__)

LENS_PARAMETERS = ("f", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
"""Focal length and principal point in px, then the distortion in OpenCV's order."""
_PLANE_PARAMETERS = ("h11", "h12", "h13", "h21", "h22", "h23", "h31", "h32")
_SCHEMA, _VERSION = "rgbmidic-camera", 1
_SPAN = 10.0
"""Half the distance (px) over which the uncertainty of the local scale is taken: any that is short (derived)."""


def distorted(lens: FloatArray, points: FloatArray) -> FloatArray:
    """Return where the lens images points (N, 2) of an ideal camera, both in px.

    Parameters
    ----------
    lens : ndarray, shape (8,)
        `LENS_PARAMETERS`.
    points : ndarray, shape (N, 2)
        Undistorted points (x, y).
    """
    focal, centre, (k1, k2, p1, p2, k3) = lens[0], lens[1:3], lens[3:]
    n = (points - centre) / focal
    x, y = n.T
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    tangential = np.stack(
        [2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], axis=1
    )
    return np.asarray(centre + focal * (n * radial[:, None] + tangential))


def undistorted(lens: FloatArray, points: FloatArray) -> FloatArray:
    """Return the inverse of `distorted` at points (N, 2), px; NaN where the distortion has none.

    By fixed-point iteration, which gains a factor of 15 with each step where the distortion is 2 % (derived): 25 steps
    leave 1e-9 px where each gains a factor of 3, and fewer are taken where none moves a point by more than 1e-10 px,
    which rounding leaves at 1000 px.
    """
    straight = points
    with np.errstate(invalid="ignore", over="ignore"):  # where there is no inverse
        for _ in range(25):
            step = points - distorted(lens, straight)
            straight = straight + step
            if not (np.abs(step) > 1e-10).any():
                break
        return np.asarray(np.where(np.abs(distorted(lens, straight) - points) < 1e-6, straight, np.nan))


def _homography(values: FloatArray) -> FloatArray:
    """Return the homography (3, 3) of parameters (16,)."""
    return np.asarray(np.r_[values[8:], 1.0].reshape(3, 3))


def _projected(homography: FloatArray, points: FloatArray) -> FloatArray:
    """Map points (N, 2) by a homography (3, 3)."""
    homogeneous = np.c_[points, np.ones(len(points))] @ homography.T
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraCalibration(Plane):
    """Lens and plane of a camera, as ``rgbmidic-calibrate camera`` writes them; either may be unknown.

    Attributes
    ----------
    shape : tuple of int
        Rows and columns of the frames.
    lens : ndarray, shape (8,), or None
        `LENS_PARAMETERS`; None: the lens does not distort, and its focal length is not known.
    homography : ndarray, shape (3, 3), or None
        Maps the undistorted pixel, relative to the middle of the frame, to mm on the plane; None: not measured.
    covariance : ndarray, shape (16, 16)
        Covariance of the parameters of the lens and of the first eight entries of the homography, row by row; 0 for a
        parameter that is not known or was held fixed.
    details : mapping
        Other content of the file: residuals, views, tilt, provenance.
    name : str
        File name, for messages.

    Examples
    --------
    >>> camera = CameraCalibration(shape=(400, 600), homography=np.diag([0.05, 0.05, 1.0]))
    >>> scale, std = camera.scale(np.array([300.0, 200.0]))
    >>> round(scale, 6), std
    (0.05, 0.0)
    """

    shape: tuple[int, int]
    lens: FloatArray | None = None
    homography: FloatArray | None = None
    covariance: FloatArray = field(default_factory=lambda: np.zeros((16, 16)))
    details: Mapping[str, Any] = field(default_factory=dict)
    name: str = "camera calibration"

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        for key, shape in (("lens", (8,)), ("homography", (3, 3)), ("covariance", (16, 16))):
            value = getattr(self, key)
            if value is None:
                continue
            needed = f"{self.name}: {key} must be finite with shape {shape}"
            values = as_numbers(value, needed, shape, error=CalibrationError)
            object.__setattr__(self, key, values)
        if self.lens is not None and self.lens[0] <= 0:
            raise CalibrationError(f"{self.name}: the focal length must be positive, not {self.lens[0]:g} px")
        if self.homography is not None and self.homography[2, 2] != 1:
            raise CalibrationError(f"{self.name}: the last entry of the homography must be 1")
        if (np.diag(self.covariance) < 0).any() or not np.allclose(self.covariance, self.covariance.T):
            raise CalibrationError(f"{self.name}: the covariance must be symmetric, its diagonal not negative")

    @property
    def centre(self) -> FloatArray:
        """Middle (x, y) of the frame, px."""
        return np.array([(self.shape[1] - 1) / 2, (self.shape[0] - 1) / 2])

    @property
    def parameters(self) -> FloatArray:
        """Parameters (16,) of the map, in the order of `covariance`."""
        lens = np.r_[1.0, self.centre, np.zeros(5)] if self.lens is None else self.lens
        if self.homography is None:
            raise InputError(f"{self.name} holds no plane: photograph the target on it (`rgbmidic-calibrate camera`)")
        return np.asarray(np.r_[lens, self.homography.ravel()[:8]])

    def to_mm(self, points: FloatArray) -> FloatArray:  # noqa: D102
        return self._to_mm(points, self.parameters)

    def _to_mm(self, points: FloatArray, values: FloatArray) -> FloatArray:
        """Return `to_mm` with `values` (16,) as parameters."""
        straight = points if self.lens is None else undistorted(values[:8], points)
        return _projected(_homography(values), straight - self.centre)

    def to_px(self, points: FloatArray) -> FloatArray:  # noqa: D102
        values = self.parameters
        inverse = np.asarray(np.linalg.inv(_homography(values)), dtype=np.float64)
        straight = _projected(inverse, points) + self.centre
        return straight if self.lens is None else distorted(values[:8], straight)

    def jacobian(self, points: FloatArray) -> FloatArray:  # noqa: D102
        values = self.parameters
        lens, homography = values[:8], _homography(values)
        straight, bent = points, np.broadcast_to(np.eye(2), (len(points), 2, 2))
        if self.lens is not None:
            straight = undistorted(lens, points)
            # central differences over 1 px: their error is the third derivative of the map over 24, 1e-8 of the scale
            # at a distortion of 2 % over 500 px (derived)
            steps = np.eye(2) / 2
            bent = np.stack([distorted(lens, straight + h) - distorted(lens, straight - h) for h in steps], axis=2)
        x, y, w = homography @ np.c_[straight - self.centre, np.ones(len(points))].T
        plane_points = np.stack([x / w, y / w], axis=1)
        flat = (homography[:2, :2] - plane_points[:, :, None] * homography[2, :2]) / w[:, None, None]
        return np.asarray(flat @ np.linalg.inv(bent))

    def sensitivity(self, points: FloatArray) -> FloatArray:
        """Derivative (N, 2, 16) of `to_mm` by the `parameters`, scaled by the root of the covariance's diagonal.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points (x, y) of the image, px.

        Returns
        -------
        ndarray, shape (N, 2, 16)
        """
        return self._by_parameters(lambda values: self._to_mm(points, values))

    def _by_parameters(self, function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Derivative (..., 16) of a function (...) of the parameters, scaled as `sensitivity` states."""
        values = self.parameters
        steps = np.diag(np.sqrt(np.diag(self.covariance)))
        derivatives = [(function(values + step) - function(values - step)) / 2 for step in steps]
        return np.stack(derivatives, axis=-1)

    def in_image_axes(self) -> tuple[Self, FloatArray]:
        """Return the camera with the plane in the axes of the image, and the motion (3, 3) of its points to there.

        The top left pixel is (0, 0) mm, and in the middle of the frame x runs along the rows.

        Returns
        -------
        camera : CameraCalibration
        motion : ndarray, shape (3, 3)
        """
        assert self.homography is not None
        homography = self.homography
        slope = homography[:2, :2] - np.outer(homography[:2, 2], homography[2, :2])
        x, y = slope[:, 0] / np.linalg.norm(slope[:, 0])
        motion = np.eye(3)
        motion[:2, :2] = [[x, y], [-y, x]]
        motion[1] *= np.sign(np.linalg.det(slope))
        motion[:2, 2] = -replace(self, homography=motion @ homography).to_mm(np.zeros((1, 2)))[0]
        aligned = motion @ homography
        return replace(self, homography=aligned / aligned[2, 2]), motion

    @property
    def correlation(self) -> FloatArray:
        """Correlation coefficients (16, 16) of the parameters; 0 where one is not known or held."""
        scale = np.sqrt(np.diag(self.covariance))
        product = np.outer(scale, scale)
        return np.asarray(np.divide(self.covariance, product, out=np.zeros_like(product), where=product > 0))

    @property
    def tilt_deg(self) -> tuple[float, float]:
        """Angle between the plane's normal and the optical axis, and its standard uncertainty, degrees.

        NaN where the lens is not known: without its focal length and principal point a homography does not say where
        the camera stands.
        """
        if self.lens is None:
            return float("nan"), float("nan")
        slope, slopes = self._slope(self.parameters), self._by_parameters(self._slope)
        size = float(np.hypot(*slope))
        along = slope / size if size > 0 else np.array([1.0, 0.0])
        std = np.sqrt(along @ (slopes @ self.correlation @ slopes.T) @ along) / (1 + size**2)
        return float(np.degrees(np.arctan(size))), float(np.degrees(std))

    def _slope(self, values: FloatArray) -> FloatArray:
        """Slope (2,) of the plane's normal against the optical axis, with `values` (16,) as parameters."""
        offset = values[1:3] - self.centre
        camera = np.array([[values[0], 0, offset[0]], [0, values[0], offset[1]], [0, 0, 1.0]])
        back = np.linalg.inv(_homography(values))
        first, second = np.linalg.solve(camera, back)[:, :2].T
        normal = np.cross(first, second)
        return np.asarray(normal[:2] / normal[2])

    def scale(self, point: FloatArray) -> tuple[float, float]:
        """Return mm per px at a point (2,), the root of the map's determinant there, and its standard uncertainty.

        Parameters
        ----------
        point : ndarray, shape (2,)
            Point (x, y) of the image, px.

        Returns
        -------
        scale, std : float
            In mm per px.
        """
        scale = float(np.sqrt(np.linalg.det(self.jacobian(point[None])[0])))
        neighbours = point + _SPAN * np.array([[-1.0, 0], [1, 0], [0, -1], [0, 1]])
        plane_points, slopes = self.to_mm(neighbours), self.sensitivity(neighbours)
        (along, across), (d_along, d_across) = (
            (values[1] - values[0], values[3] - values[2]) for values in (plane_points, slopes)
        )
        area = along[0] * across[1] - along[1] * across[0]
        slope = d_along[0] * across[1] + along[0] * d_across[1] - (d_along[1] * across[0] + along[1] * d_across[0])
        return scale, float(scale * np.sqrt(slope @ self.correlation @ slope) / (2 * area))

    def check(self, shape: tuple[int, int]) -> None:
        """Refuse frames of a `shape` (rows, columns) that it was not made with.

        Parameters
        ----------
        shape
            Rows and columns of the frames.

        Raises
        ------
        CalibrationError
            The shape is another one.
        InputError
            The calibration holds no plane.
        """
        if self.shape != tuple(shape):
            raise CalibrationError(
                f"{self.name} (scale.camera) was made with frames of {self.shape[1]} x {self.shape[0]} px, those of "
                f"the test have {shape[1]} x {shape[0]} px: calibrate with frames of the size of the test's"
            )
        _ = self.parameters

    def check_light(self, registration: Registration | None) -> None:
        """Refuse a test whose first light, in px of whose image it measures, is not that of the camera.

        A warning where the camera states no light, but another light's magnification differs from the first one's by
        more than the uncertainty of the scale; or where it states one and the test has no registration.

        Parameters
        ----------
        registration
            That of the test's lights; None: there is none.

        Raises
        ------
        CalibrationError
            The camera is of the image of a light that is not the first.
        """
        of_camera = self.details.get("first_light")
        if registration is None:
            if of_camera is not None:
                text = "%s (scale.camera) is of light %s's image; without a registration in calibration.file the "
                logger.warning(text + "images of all lights are taken to lie on that one", self.name, of_camera)
            return
        first, *other_lights = registration.lights
        if of_camera not in (None, first):
            raise CalibrationError(
                f"{self.name} (scale.camera) is of light {of_camera}'s image, the test measures in px of that of light "
                f"{first}, the first of calibration.file: calibrate both with the lights in one order"
            )
        (scale, std), magnification = self.scale(self.centre), np.abs(registration.parameters[1:, 3])
        if of_camera is None and other_lights and magnification.max() > std / scale:
            worst_light, percent = other_lights[int(magnification.argmax())], 100 * magnification.max()
            logger.warning(
                f"{self.name} (scale.camera) states no light: if its target was photographed under {worst_light}, "
                f"lengths in mm are {percent:.2g} % off, because px are those of light {first}'s image "
                "(rgbmidic-calibrate camera --light)"
            )

    def summary(self) -> str:
        """Return scale in the middle of the frame and tilt, with their standard uncertainties, as text.

        Returns
        -------
        str
        """
        (scale, scale_std), (tilt, tilt_std) = self.scale(self.centre), self.tilt_deg
        tilt_text = (
            f"tilt {format_with_std(tilt, tilt_std, 'degrees')}"
            if np.isfinite(tilt)
            else "tilt not known without a lens"
        )
        light = f" of light {first}'s image" if (first := self.details.get("first_light")) else ""
        return f"{format_with_std(scale, scale_std, 'mm per px')}{light} in the middle of the frame, {tilt_text}"

    def jacobian_std(self, points: FloatArray) -> FloatArray:
        """Standard uncertainty (N,) that the calibration leaves in a displacement of one px at points (N, 2), mm.

        Of both components of its error together, as the rms over the displacement's directions.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            Points (x, y) of the image, px.

        Returns
        -------
        ndarray, shape (N,)
            In mm per px.
        """
        steps = _SPAN * np.eye(2)
        slopes = [(self.sensitivity(points + step) - self.sensitivity(points - step)) / (2 * _SPAN) for step in steps]
        total = sum(np.einsum("nip,pq,niq->n", slope, self.correlation, slope) for slope in slopes)
        return np.asarray(np.sqrt(total / 2))

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
    @checked
    def read(cls, path: Path | str) -> Self:
        """Read the file that ``rgbmidic-calibrate camera`` wrote.

        Parameters
        ----------
        path
            The file.

        Returns
        -------
        CameraCalibration

        Raises
        ------
        CalibrationError
            The file is missing, not JSON, of another schema or version, or damaged.
        """
        return cls.from_document(read_document(path, "camera calibration", _SCHEMA, _VERSION), str(path))

    @classmethod
    def from_document(cls, document: Mapping[str, Any], name: str) -> Self:
        """Take the content of such a file, as `to_document` gives it; `name` it in messages.

        Parameters
        ----------
        document
            Content of the file.
        name
            What messages call it.

        Returns
        -------
        CameraCalibration

        Raises
        ------
        CalibrationError
            The content is damaged.
        """
        try:
            rows, columns = (int(side) for side in document["shape"])
            lens = document.get("lens")
            return cls(
                shape=(rows, columns),
                lens=None if lens is None else np.array([lens[key] for key in LENS_PARAMETERS], dtype=np.float64),
                homography=document.get("homography"),
                covariance=document["covariance"],
                details=document.get("details") or {},
                name=name,
            )
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            reason = f"missing key {error}" if isinstance(error, KeyError) else error
            raise CalibrationError(f"{name} is damaged: {reason}") from None

    def to_document(self) -> dict[str, Any]:
        """Return the content of the file, in plain values.

        Returns
        -------
        dict
        """
        return {
            "schema": _SCHEMA,
            "schema_version": _VERSION,
            "shape": list(self.shape),
            "lens": None if self.lens is None else dict(zip(LENS_PARAMETERS, self.lens.tolist(), strict=True)),
            "homography": None if self.homography is None else self.homography.tolist(),
            "parameters": [*LENS_PARAMETERS, *_PLANE_PARAMETERS],
            "covariance": self.covariance.tolist(),
            "details": dict(self.details),
        }

    def write(self, path: Path | str) -> None:
        """Write the file; errors as `rgbmidic.illumination.calibration.write_document`.

        Parameters
        ----------
        path
            File to write.
        """
        write_document(path, self.to_document())


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rectification:
    """Change of coordinates from px of the image to rectified px, in which a mm on the plane has one length everywhere.

    A point x lies at ``camera.to_mm(x) / units.mm_per_pixel``, and a displacement u of it becomes the difference of
    both ends. Strain, probes and rates are taken in rectified px as they are in px where no camera is stated: then
    nothing is changed. The standard uncertainty of a displacement follows by the Jacobian; the camera's own is
    stated beside it as that of a scale is, a fraction of every length: `CameraCalibration.jacobian_std`, the rms over
    the mesh, over the scale. In strain it is left out, as a scale's is; tests/truth/test_camera.py has what it leaves.

    Attributes
    ----------
    camera
        Lens and plane; None: not stated.
    image
        The mesh in px of the image.
    mesh
        The mesh in rectified px.
    units
        With the millimetres for a rectified px, or for a px where a scale is stated in place of a camera. Chosen such
        that the median element of both meshes has one size.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 80, 60), shape=(80, 100)), element_size=20)
    >>> Rectification(camera=None, image=mesh, mesh=mesh, units=Units()).probe_coordinates((40.0, 30.0), 1)
    (40.0, 30.0)
    """

    camera: CameraCalibration | None
    image: Tri3Mesh
    mesh: Tri3Mesh
    units: Units

    @classmethod
    def of(cls, mesh: Tri3Mesh, units: Units, camera: CameraCalibration | None = None) -> Self:
        """Rectify a mesh in px of the image by a `camera`, or leave it with the `units`.

        Parameters
        ----------
        mesh
            Mesh in px of the image.
        units
            Units of the result where there is no camera.
        camera
            Lens and plane; None: the image is not rectified.

        Returns
        -------
        Rectification

        Raises
        ------
        InputError
            The camera holds no plane, or the mesh reaches where its distortion has no inverse.
        """
        if camera is None:
            return cls(camera=None, image=mesh, mesh=mesh, units=units)
        plane_points = camera.to_mm(mesh.nodes)
        if not np.isfinite(plane_points).all():
            raise InputError(f"the lens of {camera.name} does not image all of the mesh: its distortion has no inverse")
        size = Tri3Mesh(nodes=plane_points, elements=mesh.elements).size / mesh.size
        sampled_nodes = mesh.nodes[:: len(mesh.nodes) // 200 + 1]  # the uncertainty is a polynomial of low degree
        std = float(np.sqrt(np.mean(camera.jacobian_std(sampled_nodes) ** 2)))
        flat = Tri3Mesh(nodes=plane_points / size, elements=mesh.elements)
        units = Units(mm_per_pixel=size, mm_per_pixel_std=std)
        return cls(camera=camera, image=mesh, mesh=flat, units=units)

    def probe_coordinates(self, coordinates: Sequence[float], points: int) -> tuple[float, ...]:
        """Rectify the numbers that place a probe: so many points (x, y) one after the other, then lengths.

        Parameters
        ----------
        coordinates
            Numbers in px of the image.
        points
            Number of points that they begin with.

        Returns
        -------
        tuple of float
            In rectified px.
        """
        if self.camera is None or self.units.mm_per_pixel is None:
            return tuple(map(float, coordinates))
        ends = np.array(coordinates[: 2 * points], dtype=np.float64).reshape(-1, 2)
        return (*(self.camera.to_mm(ends) / self.units.mm_per_pixel).ravel().tolist(), *coordinates[2 * points :])

    def displacement(self, displacement: Displacement) -> Displacement:
        """Rectify the displacement of every node and its standard uncertainty; NaN stays NaN.

        Parameters
        ----------
        displacement
            In px of the image, shape (2, N).

        Returns
        -------
        Displacement
            The same in rectified px.
        """
        if self.camera is None or self.units.mm_per_pixel is None:
            return displacement
        deformed = self.image.nodes + displacement.values.T
        along = self.camera.to_mm(deformed) / self.units.mm_per_pixel - self.mesh.nodes
        squares = (self.camera.jacobian(deformed) / self.units.mm_per_pixel) ** 2
        turned = displacement.with_arrays(lambda std: np.sqrt(np.einsum("nij,jn->in", squares, std**2)))
        return replace(turned, values=along.T)
