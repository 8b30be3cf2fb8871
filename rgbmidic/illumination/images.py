"""Images of one mechanical state, one per light: their registration, their validity, and means around a pixel.

Lights and illuminations are the same. A lens magnifies each wavelength a little differently. With x the pixel of a
material point in the first light's image and c the image centre, light j sees the same point at x + rho_j(x),

    rho_j(x) = t + w J (x - c) + s (x - c) + q (|x - c| / R)^2 (x - c),    J (x, y) = (-y, x).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import check_fields
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.illumination.linear import LinearChannels
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

if TYPE_CHECKING:  # reading a result takes no kernels
    from rgbmidic.illumination.displacement import LightDisplacement

PARAMETERS = ("shift_x", "shift_y", "rotation", "scale", "radial")
"""Parameters of a light: px, px, rad (x towards y), relative magnification, relative magnification more at radius R."""


def check_names(lights: Sequence[str]) -> None:
    """Refuse names of lights that are no texts, are empty, or are the same.

    Raises
    ------
    CalibrationError
        A light has no name of its own.
    """
    texts = all(isinstance(name, str) and name.strip() for name in lights)
    if not texts or len({*lights}) != len(lights):
        raise CalibrationError(f"each light needs a name, different from the others'; given are {list(lights)}")


def registration_basis(points: npt.ArrayLike, centre: tuple[float, float], radius: float) -> FloatArray:
    """Return the displacement (M, 2, 5) at points (x, y) of shape (M, 2) per unit of each of the `PARAMETERS`."""
    arm = np.asarray(points, dtype=np.float64) - np.asarray(centre)
    x, y = arm.T
    unit, zero = np.ones_like(x), np.zeros_like(x)
    growth = (x**2 + y**2) / radius**2
    return np.stack([[unit, zero, -y, x, growth * x], [zero, unit, x, y, growth * y]]).transpose(2, 0, 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Registration:
    """Lateral registration of k lights against the first.

    Attributes
    ----------
    lights : tuple of str, length k
        Their names.
    parameters : ndarray, shape (k, 5)
        `PARAMETERS` of every light; the first light's are 0.
    centre : tuple of float
        Point (x, y) in px that rotation, scale and radial term do not move.
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
        check_fields(self, CalibrationError)
        check_names(self.lights)
        count, terms = len(self.lights), len(PARAMETERS)
        parameters = np.asarray(self.parameters, dtype=np.float64)
        if parameters.shape != (count, terms) or not np.isfinite(parameters).all() or parameters[0].any():
            raise CalibrationError(
                f"a registration of {count} lights has {terms} finite parameters per light, those of the first all 0; "
                f"given are {parameters.tolist()}"
            )
        if not 0 < self.radius < 1e9:
            raise CalibrationError(f"the radius of a registration must be positive, in px, not {self.radius}")
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
        """Tell whether any light is more than shifted."""
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

    def on_first_light(self, points: npt.ArrayLike, lights: Sequence[str]) -> tuple[FloatArray, FloatArray]:
        """Return where the first light's image shows what an image under some of the lights shows at points.

        What each of k lights together contributes is not known. With any contributions equally probable (uniform on
        the simplex) the mean of their parameters p is taken, and to their covariance ``sum of d d^T / (k (k + 1))`` is
        added with ``d = p - mean``.

        Parameters
        ----------
        points : array_like, shape (M, 2)
            Points (x, y) in px of the image under `lights`.
        lights
            Their names.

        Returns
        -------
        points : ndarray, shape (M, 2)
            In px of the first light's image.
        factor : ndarray, shape (M, 2, 5)
            Errors of the points per unit of five independent errors of the registration; zero where its covariance is
            not known.

        Raises
        ------
        CalibrationError
            The registration has no such light.
        """
        if unknown := [name for name in lights if name not in self.lights]:
            raise CalibrationError(
                f"the registration is of the lights {', '.join(self.lights)}, not {', '.join(unknown)}"
            )
        index = [self.lights.index(name) for name in dict.fromkeys(lights)]
        parameters = self.parameters[index].mean(axis=0)
        deviations = self.parameters[index] - parameters
        covariance = deviations.T @ deviations / (len(index) * (len(index) + 1))
        if self.covariance is not None:
            covariance = covariance + self.covariance[index].mean(axis=0)
        position = _checked(points)
        origin = position
        for _ in range(10):  # each gains a factor of the magnification, some thousandths
            basis = registration_basis(origin, self.centre, self.radius)
            origin = position - basis @ parameters
        variances, axes = np.linalg.eigh(covariance)
        return origin, basis @ (axes * np.sqrt(np.maximum(variances, 0)))


def _checked(points: npt.ArrayLike) -> FloatArray:
    position = np.asarray(points, dtype=np.float64)
    if position.ndim != 2 or position.shape[1] != 2:
        raise InputError(f"points have shape (M, 2), not {position.shape}")
    return position


def frame_geometry(shape: tuple[int, int]) -> tuple[tuple[float, float], float]:
    """Return centre (x, y) and half diagonal in px of a frame of `shape` (rows, columns)."""
    height, width = shape
    return ((width - 1) / 2, (height - 1) / 2), float(np.hypot(width, height) / 2)


REFLECTING = 0.2
"""Reflection index from which a light counts as reflecting."""


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class IlluminationImages:
    """The k illumination images of one mechanical state.

    Attributes
    ----------
    values : ndarray, shape (k, H, W), float32
        Grey level each light alone would give (DN above black in the channel the light is named after);
        NaN where not valid.
    valid : ndarray, shape (k, H, W), bool
        False where the value is unknown, for instance because a saturated sample took part in it.
    names : tuple of str, length k
        The lights' names.
    full_scale : float
        Grey level of a just saturated camera sample (DN above black).
    reflection : ndarray, shape (k, h, w), or None
        What `reflection_index` interpolates, on a grid of blocks of 8 px.
    displacement : LightDisplacement or None
        Of the lights' textures against each other in this frame, on the same grid: a light whose reflection is seen on
        the flanks of raised droplets shows the texture displaced. None where the separation does not look for it.
    texture : TextureModel or None
        The speckle's autocorrelation as the separation took it: hand it on to the other frames of a test; None where
        the separation does not use it.
    origin : tuple of int
        Column and row of the frame at which the images begin.
    registration : Registration or None
        Where in its own image a light shows what the first one shows at a pixel of the frame; None: at the same pixel.

    Examples
    --------
    >>> values = np.full((2, 4, 5), 100.0)
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red", "blue"), full_scale=255.0)
    >>> images.shape, images.valid.all()
    ((4, 5), np.True_)
    """

    values: FloatImage
    valid: BoolArray
    names: tuple[str, ...]
    full_scale: float
    reflection: FloatArray | None = None
    displacement: LightDisplacement | None = None
    texture: TextureModel | None = None
    origin: tuple[int, int] = (0, 0)
    registration: Registration | None = None

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        values = np.ascontiguousarray(self.values, dtype=np.float32)
        if values.ndim != 3:
            raise InputError(f"illumination images have shape (k, H, W), not {values.shape}")
        valid = np.asarray(self.valid, dtype=bool)
        if not np.isfinite(values.sum()):  # NaN and infinity spread to it
            valid = valid & np.isfinite(values)
        if len(self.names) != len(values):
            raise InputError(f"{len(values)} illumination images cannot carry the {len(self.names)} names {self.names}")
        if self.registration is not None and self.registration.lights != self.names:
            raise CalibrationError(
                f"the registration is for the lights {', '.join(self.registration.lights)}, the images are of "
                f"{', '.join(self.names)}"
            )
        object.__setattr__(self, "values", values if valid.all() else np.where(valid, values, np.float32(np.nan)))
        object.__setattr__(self, "valid", valid)

    @classmethod
    def in_succession(cls, frames: Sequence[LinearChannels], names: Sequence[str] = ()) -> IlluminationImages:
        """Join lights fired one after the other before a monochrome camera, from one frame (1, H, W) of each.

        Parameters
        ----------
        frames
            One of each light.
        names
            The lights' names; by default they are numbered.

        Returns
        -------
        IlluminationImages

        Raises
        ------
        InputError
            The frames have different shapes, or the calibration that `names` come from is of another number of lights.
        """
        if names and len(names) != len(frames):
            raise InputError(
                f"the frames show {len(frames)} lights in succession (frames.path or frames.lights), but the "
                f"calibration is of {len(names)}: {', '.join(names)}"
            )
        if len(shapes := {frame.values.shape for frame in frames}) > 1:
            raise InputError(f"frames of lights in succession must have one shape; given are {sorted(shapes)}")
        return cls(
            values=np.concatenate([frame.values for frame in frames]),
            valid=np.concatenate([frame.valid for frame in frames]),
            names=tuple(names)
            or (("light",) if len(frames) == 1 else tuple(f"light {i + 1}" for i in range(len(frames)))),
            full_scale=frames[0].full_scale,
        )

    def with_origin(self, origin: tuple[int, int]) -> IlluminationImages:
        """Return the images as those of a part of the frame that begins at the pixel `origin` (column, row).

        Parameters
        ----------
        origin
            Column and row of the part's first pixel in the frame.

        Returns
        -------
        IlluminationImages
        """
        registration = self.registration
        return replace(
            self, origin=origin, registration=registration and registration.cropped((-origin[0], -origin[1]))
        )

    def on_first_light(self) -> IlluminationImages:
        """Resample every light onto the first one's pixels by cubic B-splines: for pictures, not for a correlation.

        A correlation reads each light where its `registration` says, without resampling it. Pixels whose neighbourhood
        of interpolation is invalid or outside the image become invalid.

        Returns
        -------
        IlluminationImages
            On the pixel grid of the first light, without a registration.

        Examples
        --------
        >>> registration = Registration.identity(("red", "blue"), (4, 5))
        >>> values = np.ones((2, 4, 5))
        >>> images = IlluminationImages(
        ...     values=values, valid=values > 0, names=("red", "blue"), full_scale=255, registration=registration
        ... )
        >>> images.on_first_light().registration is None
        True
        """
        from rgbmidic._kernels.splines import PAD, bspline_coefficients, sample_with_gradient

        if (registration := self.registration) is None:
            return self
        height, width = self.shape
        rows = 64  # warped at a time: their positions take less memory than an image
        values, spline = self.values.copy(), np.empty((height + 2 * PAD, width + 2 * PAD), dtype=np.float32)
        for light, image in enumerate(self.values):
            bspline_coefficients(fill_holes(image), spline)
            near_hole = cv2.dilate(np.isnan(image).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
            for top in range(0, height, rows):
                strip = values[light, top : top + rows]
                y, x = np.mgrid[top : top + len(strip), :width].reshape(2, -1).astype(np.float64)
                shift = registration.displacement(np.stack([x, y], axis=1) + self.origin)[light].T
                if np.abs(shift).max() > 0.002:  # px: a fifth of the noise floor of DIC in good images, .01 px
                    x, y = x + shift[0], y + shift[1]
                    sampled = np.empty((3, x.size), dtype=np.float32)
                    sample_with_gradient(spline, x, y, *sampled)
                    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
                    row, column = (np.round(np.where(inside, at, 0)).astype(np.intp) for at in (y, x))
                    usable = inside & ~near_hole[row, column]
                    strip[:] = np.where(usable, sampled[0], np.float32(np.nan)).reshape(strip.shape)
        return replace(self, values=values, valid=np.isfinite(values), registration=None)

    def reflection_index(self, step: int = 1, within: tuple[slice, slice] | None = None) -> FloatImage | None:
        """Return the fraction of a light that is not diffuse, from a single frame.

        Parameters
        ----------
        step
            Distance in px of the pixels at which it is wanted.
        within
            Rows and columns, which begin at whole multiples of 8; None: all.

        Returns
        -------
        ndarray, shape (k, H, W), or None
            0 where a light's contrast is that of the light with the most contrast there, towards 1 in its reflection;
            None where the separation does not give it.
        """
        from rgbmidic.illumination.colour_factors import BLOCK, upsample  # reading a result takes no kernels

        if self.reflection is None:
            return None
        rows, columns = within or (slice(0, self.shape[0]), slice(0, self.shape[1]))
        grid = self.reflection[:, rows.start // BLOCK : -(-rows.stop // BLOCK)]
        shape = rows.stop - rows.start, columns.stop - columns.start
        return upsample(grid[..., columns.start // BLOCK : -(-columns.stop // BLOCK)], BLOCK, shape, step)

    @property
    def shape(self) -> tuple[int, int]:
        """Image size (H, W)."""
        return self.values.shape[1], self.values.shape[2]


DARK = 0.01
"""A light whose local mean is below this fraction of the full scale does not see the surface there."""
_DARK_WINDOW = 10.0
"""Standard deviation (px) of the window of that mean: two to three speckles."""
_WIDE = 4.0
"""Standard deviation (px) from which an image of half the size gives the mean: as good, at a sixth of the time."""
_RESIZED = 1 / 4 + 2 / 3
"""Variance (square px) that the mean of two pixels, 1/4, and the interpolation between such means, 2/3, add."""


def without_dark_pixels(images: IlluminationImages, weights: FloatImage) -> FloatImage:
    """Set weights (k, H, W) to 0 where the local mean of a light is at most `DARK` of the full scale.

    Parameters
    ----------
    images
        One image a light.
    weights : ndarray, shape (k, H, W), float32
        Weights of the pixels.

    Returns
    -------
    ndarray, shape (k, H, W), float32
    """
    threshold, out = DARK * images.full_scale, weights
    for light, image in enumerate(images.values):
        reduced = cv2.resize(image, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
        if not np.isfinite(reduced).all():
            reduced = cv2.resize(np.nan_to_num(image), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)
        if reduced.min() <= threshold:  # else no mean over a wider window is
            is_dark = ~(local_mean(image, _DARK_WINDOW) > threshold)
            out = weights.copy() if out is weights else out
            out[light][is_dark] = 0
    return out


def local_mean(image: FloatImage, sigma: float) -> FloatImage:
    """Return the Gaussian mean (H, W) of the finite pixels around each pixel; NaN where there is none."""
    finite = np.isfinite(image)
    if finite.all():
        return _blur(image, sigma)
    weight = _blur(finite.astype(np.float32), sigma)
    total = _blur(np.where(finite, image, np.float32(0)), sigma)
    return np.where(weight > 1e-3, total / np.maximum(weight, np.float32(1e-3)), np.float32(np.nan))


def fill_holes(image: FloatImage, sigma: float = 3.0) -> FloatImage:
    """Replace the NaN of an image (H, W) by the Gaussian mean of the finite pixels around, or farther away of all.

    The values carry no weight in what is measured; they only keep the recursion of a spline finite and quiet.

    Parameters
    ----------
    image : ndarray, shape (H, W), float32
        Grey levels.
    sigma
        Standard deviation of the mean's window, px.
    """
    finite = np.isfinite(image)
    if finite.all():
        return image
    mean, everywhere = local_mean(image, sigma), image.sum(dtype=np.float64, where=finite) / max(finite.sum(), 1)
    return np.where(finite, image, np.nan_to_num(mean, nan=everywhere))


def _blur(image: FloatImage, sigma: float) -> FloatImage:
    """Return the Gaussian mean of an image (H, W)."""
    if sigma < _WIDE:
        return _gaussian(image, sigma)
    half = _half_blur(image, sigma)
    return np.asarray(cv2.resize(half, (half.shape[1], 2 * len(half)), interpolation=cv2.INTER_LINEAR)[: len(image)])


def _half_blur(image: FloatImage, sigma: float) -> FloatImage:
    """Return the Gaussian mean of each two rows, from an image of half the size."""
    height, width = image.shape
    odd = height % 2, width % 2
    padded = cv2.copyMakeBorder(image, 0, odd[0], 0, odd[1], cv2.BORDER_REPLICATE) if any(odd) else image
    half = cv2.resize(padded, (padded.shape[1] // 2, padded.shape[0] // 2), interpolation=cv2.INTER_AREA)
    blurred = _gaussian(np.asarray(half), np.sqrt(sigma**2 - _RESIZED) / 2)
    wide = cv2.resize(blurred, (padded.shape[1], len(half)), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(wide[:, :width])


def _gaussian(image: FloatImage, sigma: float) -> FloatImage:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)
