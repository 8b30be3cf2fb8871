"""Point lights, polarisers and the camera of a scene.

Lights have a position, a power, a spectrum and the magnification of the lens in their colour; the camera has a
pin-hole projection, lateral colour, a lens blur, colour channels, noise and quantisation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import bounded, checked
from rgbmidic.errors import InputError
from rgbmidic.frames.data import cfa_channels, sampled_channels
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import PARAMETERS, Registration, frame_geometry
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.tools.scene import SceneSection
from rgbmidic.tools.scene.spectra import Led, Sensitivities, spectral_response
from rgbmidic.typing import FloatArray

NOMINAL_DISTANCE = 600.0
"""Distance (mm) at which a light of power 1 gives an ideal white the camera's `exposure`."""
DISTANCE = 600.0
"""mm from the camera to the object's front point."""
PIXEL = 0.055
"""mm per px on the object."""

Vector = tuple[float, float, float]
Floating = TypeVar("Floating", bound=np.floating)


@dataclass(frozen=True, slots=True, kw_only=True)
class Light(SceneSection):
    """A point light; the irradiance falls with the square of the distance.

    Attributes
    ----------
    name
        Name of the light and of its image.
    position
        (x, y, z) in mm: x right, y down, z away from the camera, origin at the camera.
    power
        1 lights an ideal white that faces it at `NOMINAL_DISTANCE` to the camera's `exposure`.
    spectrum
        Needed where the crosstalk follows from spectra.
    magnification
        Relative magnification of the lens about the principal point in this colour: its focal length is
        ``focal_px (1 + magnification)``. None: that of the camera's lateral colour.
    shift
        Shift (x, y) of the principal point in this colour, px.
    """

    name: str
    position: Vector
    power: float = bounded(1.0, at_least=0)
    spectrum: Led | None = None
    magnification: float | None = bounded(None, above=-0.1, below=0.1)
    shift: tuple[float, float] = (0.0, 0.0)

    def aimed(self, target: Vector, irradiance: float = 1.0) -> Light:
        """Return the light with the power that gives `irradiance` (1: the camera's exposure) at the target.

        Parameters
        ----------
        target
            Point (x, y, z) in mm, in the camera's axes.
        irradiance
            In units of the camera's exposure.

        Returns
        -------
        Light
        """
        return replace(self, power=irradiance * math.dist(self.position, target) ** 2 / NOMINAL_DISTANCE**2)

    def turned(self, angle_deg: float, pivot: Vector, axis: Vector = (0.0, 1.0, 0.0)) -> Light:
        """Return the light turned about an axis through a pivot, as on the goniometer of paper section 2.3.

        Parameters
        ----------
        angle_deg
            Angle in degrees.
        pivot
            Point (x, y, z) in mm, in the camera's axes.
        axis
            Direction of the axis.

        Returns
        -------
        Light
        """
        position = rotation(angle_deg, axis) @ (np.array(self.position) - pivot) + pivot
        return replace(self, position=position.tolist())


@dataclass(frozen=True, slots=True, kw_only=True)
class Polarisers(SceneSection):
    """Crossed linear polarisers, one before every lamp and one before the camera.

    Diffuse light counts as depolarised, the reflection as polarised like the lamp but for a small fraction.

    Attributes
    ----------
    extinction
        Light that the pair lets pass crossed, over parallel: 1e-2 of common film, 1e-4 of the best.
    transmission
        Fraction of the depolarised light that both let pass: 0.25 of ideal polarisers, some 0.15 of film (30 % of an
        unpolarised lamp through a parallel pair). More than 0.25 needs lamps that are polarised themselves.
    depolarised
        Fraction of the reflection that has lost its polarisation. One reflection, however the facet is tilted, keeps
        it; 0.01 bounds what the relief of a dielectric paint reflects twice: the second time some 5 % return (Fresnel,
        refractive index 1.5, 45 degrees), and a fifth of the light at most meets a second facet.
    """

    extinction: float = bounded(1e-2, at_least=0, at_most=1)
    transmission: float = bounded(0.25, above=0, at_most=0.5)
    depolarised: float = bounded(0.01, at_least=0, at_most=1)

    @property
    def glare(self) -> float:
        """Fraction of the reflection that is left, over that of the diffuse light.

        Polarisers that transmit k1 along and k2 across their axis let pass (k1 + k2)^2/4 of depolarised light and k1 k2
        of what keeps its polarisation; the extinction is 2 k1 k2/(k1^2 + k2^2) (Mueller matrices; see the tests).
        """
        return 2 * self.extinction / (1 + self.extinction) * (1 - self.depolarised) + self.depolarised


@checked
def rotation(angle_deg: float, axis: Vector) -> FloatArray:
    """Return the rotation matrix by an angle about an axis (Rodrigues)."""
    length = math.hypot(*axis)
    if length == 0:
        raise InputError("a rotation axis must not be the null vector")
    x, y, z = (component / length for component in axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(angle_deg)
    turn: FloatArray = np.eye(3) + math.sin(angle) * skew + (1 - math.cos(angle)) * (skew @ skew)
    return turn


@checked
def three_lights(target: Vector = (0.0, 0.0, NOMINAL_DISTANCE)) -> tuple[Light, ...]:
    """Return the red, green and blue lamps left, right and above the camera, all equally bright at the target."""
    positions = {"red": (-190.0, -12.0, 90.0), "green": (200.0, 15.0, 90.0), "blue": (10.0, -220.0, 60.0)}
    return tuple(Light(name=name, position=position).aimed(target) for name, position in positions.items())


REFERENCE_CROSSTALK = ((1.0, 0.10, 0.02), (0.14, 1.0, 0.16), (0.03, 0.12, 1.0))
"""Rows: camera R, G, B; columns: red, green and blue light. Milder than consumer cameras under LEDs; what the measured
matrix costs instead is a table of docs/explanation/demosaicing.md."""
MEASURED_CROSSTALK = ((1.0, 0.10, 0.05), (0.10, 1.0, 0.33), (0.01, 0.29, 1.0))
"""Nikon D5100 under LEDs at 630, 525 and 465 nm of 18, 30 and 20 nm full width at half maximum: two digits of what
`rgbmidic-calibrate design` predicts from its sensitivities, measured at the National Physical Laboratory (Darrodi et
al., J. Opt. Soc. Am. A 32, 2015) and shipped by colour-science (BSD-3-Clause). The median of nine measured cameras has
.24 and .33 between green and blue."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Camera(SceneSection):
    """A camera at the origin that looks along +z, x to the right and y downwards.

    Attributes
    ----------
    shape
        Rows and columns of the frame.
    focal_px
        Focal length in px: distance / (mm per px at that distance).
    lateral_colour
        Lateral colour of the lens, px at the corner of the frame: by so much each light's image of it lies further
        from the principal point than that of the light before, in the order of the lights. It is a magnification, so
        it grows from the middle outwards; displacements are in px of the first light's image, which has `focal_px`. A
        light that states its `magnification` has that instead. The lamps before a monochrome camera count as of one
        colour: there it is 0. An 8 mm lens had 1 to 2 px (docs/explanation/real-captures.md).
    lens_blur
        Standard deviation of the Gaussian lens blur (px), on top of the pixel's square aperture.
    kind
        ``"bayer"``: one colour per pixel; ``"rgb"``: all three at every pixel (3-CCD); ``"monochrome"``.
    cfa
        Bayer pattern.
    crosstalk
        A in channels = A . lights, shape (3, k), or (1, k) for a monochrome camera. None: from `sensitivities` and the
        lights' spectra, or without these the identity (all ones for a monochrome camera).
    sensitivities
        Spectral sensitivities, for a crosstalk that follows from physics.
    green_difference
        Response of the greens in rows with red minus that of the greens in rows with blue, per light, in the unit of
        the crosstalk (1: the channel that sees the light best); the crosstalk has their mean. Empty: the greens are
        equal. One sensor had -.015, -.001 and .010 under 650, 550 and 450 nm (docs/explanation/real-captures.md): it
        depends on the make, and on rendered speckle 15 % cost nothing (docs/explanation/when-not.md).
    exposure
        Fraction of full scale of an ideal white under a light of power 1 at its nominal distance, in the
        channel that sees the light best.
    bits
        Depth of the analogue-digital converter; samples saturate at 2**bits - 1.
    black_level
        Grey level of a dark sample.
    gain
        Electrons per grey level.
    read_noise
        Standard deviation in electrons.
    samples
        Rays per pixel and direction: ``samples**2`` rays per pixel. None: as many as the paint needs
        (`rgbmidic.tools.lab.virtual.rendering.rays_per_pixel`).
    exposure_time
        Seconds; a body with a velocity is blurred over it.
    """

    shape: tuple[int, int] = bounded(at_least=2)
    focal_px: float = bounded(DISTANCE / PIXEL, above=0)
    lateral_colour: float = bounded(0.5, above=-20, below=20)
    lens_blur: float = bounded(0.45, at_least=0, at_most=20)
    kind: Literal["bayer", "rgb", "monochrome"] = "bayer"
    cfa: str = "RGGB"
    crosstalk: FloatArray | None = None
    sensitivities: Sensitivities | None = None
    green_difference: tuple[float, ...] = ()
    exposure: float = bounded(0.5, above=0)
    bits: int = bounded(12, at_least=8, at_most=16)
    black_level: int = bounded(64, at_least=0)
    gain: float = bounded(4.0, above=0)
    read_noise: float = bounded(12.0, at_least=0)
    samples: int | None = bounded(None, at_least=1, at_most=64)
    exposure_time: float = bounded(0.0, at_least=0)

    def _problems(self) -> Iterator[str]:
        cfa_channels(self.cfa)
        if not self.black_level < self.white_level:
            yield f"black_level must be below saturation at {self.white_level}, not {self.black_level}"
        if self.green_difference and self.kind != "bayer":
            yield f'green_difference is of a camera of kind "bayer", not "{self.kind}"'
        if self.crosstalk is not None:
            object.__setattr__(self, "crosstalk", np.asarray(self.crosstalk, dtype=np.float64))

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (x, y) in px: the middle of the frame."""
        return (self.shape[1] - 1) / 2, (self.shape[0] - 1) / 2

    @property
    def channels(self) -> int:
        """Number of colour channels."""
        return 1 if self.kind == "monochrome" else 3

    @property
    def white_level(self) -> int:
        """Grey level at which samples saturate."""
        return int(2**self.bits - 1)

    @property
    def full_scale(self) -> float:
        """Saturation above black, DN."""
        return float(self.white_level - self.black_level)

    @property
    def noise(self) -> NoiseModel:
        """The noise in the terms of the rest of rgbmidic; read noise in DN, quantisation not included."""
        return NoiseModel(gain=self.gain, read_noise=self.read_noise / self.gain)

    def response(self, lights: tuple[Light, ...]) -> FloatArray:
        """Return the response (C, k) of each channel to each light; its largest entry is 1.

        Parameters
        ----------
        lights
            k lights.

        Returns
        -------
        ndarray, shape (C, k)

        Raises
        ------
        InputError
            The crosstalk does not fit the lights, or a light lacks its spectrum.
        """
        matrix = np.ones((1, len(lights))) if self.kind == "monochrome" else np.eye(3)[:, : len(lights)]
        if self.crosstalk is not None:
            matrix = self.crosstalk
        elif self.sensitivities is not None:
            spectra = tuple(light.spectrum for light in lights if light.spectrum is not None)
            if len(spectra) != len(lights):
                raise InputError("camera sensitivities are given, so every light needs its spectrum")
            matrix = spectral_response(self.sensitivities, spectra)
            matrix = matrix.mean(axis=0, keepdims=True) if self.kind == "monochrome" else matrix
        if matrix.shape != (self.channels, len(lights)) or not np.isfinite(matrix).all() or matrix.min() < 0:
            raise InputError(
                f"the crosstalk of a {self.kind} camera under {len(lights)} lights is a matrix of shape "
                f"({self.channels}, {len(lights)}) of numbers not negative, not {matrix.tolist()}"
            )
        if not (matrix.max(axis=0) > 0).all():
            raise InputError(f"the camera does not see every light: crosstalk {matrix.tolist()}")
        return np.asarray(matrix / matrix.max())

    def mixing(self, lights: tuple[Light, ...]) -> FloatArray:
        """Return A (C, k) in channels = A . light images; every column's largest entry is 1.

        Parameters
        ----------
        lights
            k lights.

        Returns
        -------
        ndarray, shape (C, k)
        """
        matrix = self.response(lights)
        return np.asarray(matrix / matrix.max(axis=0))

    def true_crosstalk(self, lights: tuple[Light, ...]) -> Crosstalk:
        """Return the crosstalk that a perfect calibration would find.

        Parameters
        ----------
        lights
            k lights.

        Returns
        -------
        Crosstalk

        Raises
        ------
        InputError
            The difference of the greens does not fit the lights, or is more than what they see.
        """
        matrix, names = self.mixing(lights), tuple(light.name for light in lights)
        if not (difference := self.green_difference):
            return Crosstalk(matrix=matrix, lights=names)
        if len(difference) != len(lights) or (np.abs(difference) > 2 * matrix[1]).any():
            raise InputError(
                f"green_difference has one number per light ({', '.join(names)}), of at most twice its crosstalk in G "
                f"({', '.join(f'{entry:.3g}' for entry in matrix[1])}); not {list(difference)}"
            )
        return Crosstalk(matrix=matrix, lights=names, green_difference=np.array(difference))

    def lenses(self, lights: tuple[Light, ...]) -> FloatArray:
        """Return focal length and principal point (x, y) of the lens in the colour of each light, px.

        Parameters
        ----------
        lights
            k lights.

        Returns
        -------
        ndarray, shape (k, 3)
        """
        step = 0.0 if self.kind == "monochrome" else self.lateral_colour / math.hypot(*self.centre)
        steps = np.arange(len(lights)) * step
        magnifications = [
            lateral if li.magnification is None else li.magnification for li, lateral in zip(lights, steps, strict=True)
        ]
        centres = np.array([light.shift for light in lights]) + self.centre
        return np.column_stack([self.focal_px * (1 + np.array(magnifications)), centres])

    def true_registration(self, lights: tuple[Light, ...]) -> Registration | None:
        """Return the registration that a perfect calibration would find; None: the lens images all colours alike.

        Parameters
        ----------
        lights
            k lights.

        Returns
        -------
        Registration or None
        """
        lenses = self.lenses(lights)
        if (lenses == lenses[0]).all():
            return None
        parameters = np.zeros((len(lights), len(PARAMETERS)))
        parameters[:, :2] = lenses[:, 1:] - lenses[0, 1:]
        parameters[:, PARAMETERS.index("scale")] = lenses[:, 0] / lenses[0, 0] - 1
        centre, (_, radius) = (float(lenses[0, 1]), float(lenses[0, 2])), frame_geometry(self.shape)
        names = tuple(light.name for light in lights)
        return Registration(lights=names, parameters=parameters, centre=centre, radius=radius)


@dataclass(frozen=True, slots=True, kw_only=True)
class SecondCamera(SceneSection):
    """A second camera before the same scene: it looks at where the first one's axis meets the body, from as far away.

    Attributes
    ----------
    angle_deg
        Angle between the two optical axes.
    azimuth_deg
        Direction in which it stands from the first camera: 0 to the right, 90 below.
    roll_deg
        By so much it is turned about its own optical axis.
    shape
        Rows and columns of its frame; None: as the first camera's.
    focal_px
        Its focal length, px; None: as the first camera's.
    """

    angle_deg: float = bounded(22.0, above=0, below=120)
    azimuth_deg: float = 0.0
    roll_deg: float = 0.0
    shape: tuple[int, int] | None = bounded(None, at_least=2)
    focal_px: float | None = bounded(None, above=0)


def reference_camera(shape: tuple[int, int], **changes: object) -> Camera:
    """Return RGGB, 12 bit, 4 e-/DN, read noise 12 e-, lens blur 0.45 px, 0.055 mm per px; `changes` to any setting.

    Its lens has no lateral colour unless `changes` state it, so that a scene shows one cause at a time; a camera of a
    SCENE.toml has. A monochrome camera has no crosstalk of its own.

    Parameters
    ----------
    shape
        Rows and columns.
    **changes
        Fields of `Camera` that differ.

    Returns
    -------
    Camera
    """
    if changes.get("kind") != "monochrome" and "sensitivities" not in changes:
        changes = {"crosstalk": np.array(REFERENCE_CROSSTALK), **changes}
    changes = {"lateral_colour": 0.0, **changes}
    return Camera(shape=shape, **changes)  # type: ignore[arg-type]


def mosaic_samples(channels: npt.NDArray[Floating], cfa: str) -> npt.NDArray[Floating]:
    """Return the samples (H, W) that a colour filter array takes of channels (3, H, W), or of sites (4, H, W).

    The sites are red, green in rows with red, green in rows with blue, and blue.
    """
    shape = channels.shape[1], channels.shape[2]
    index = sampled_channels(cfa, shape)
    if len(channels) == 4:
        index = index + (index == 2) + (green_signs(cfa, shape) < 0)
    return np.asarray(np.take_along_axis(channels, index[None], axis=0)[0])


def green_signs(cfa: str, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Return 1 at the greens in rows with red, -1 at those in rows with blue and 0 elsewhere, (H, W)."""
    channels = sampled_channels(cfa, (2, 2))
    cell = np.where(channels == 1, np.where((channels == 0).any(axis=1, keepdims=True), 1, -1), 0)
    return np.tile(cell, (-(-shape[0] // 2), -(-shape[1] // 2)))[: shape[0], : shape[1]].astype(np.float32)
