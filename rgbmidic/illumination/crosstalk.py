"""Crosstalk between lights and camera channels, ``channels = A @ lights``.

A varies over the field where the light falls on the colour filters at an angle (wide lenses, microlenses). It is then
``A(x, y) = matrix + sum of coefficients x Legendre products``: the products average to zero over the field, so `matrix`
stays the mean and whoever ignores the variation makes the smallest error.

The two greens of a Bayer mosaic, in rows with red and in rows with blue, see red and blue light differently: their
neighbours leak into them. `Crosstalk.sites` has a row for each; `Crosstalk.matrix` has their mean.

The lights are ``A^-1 channels`` at every pixel (`unmix`). Light j sees
at x + rho_j(x) what the first light sees at x (`Registration`), in the reference and in the deformed state alike; the
solve reads it there. Sampled there (`IlluminationImages.on_first_light`), its image shows every point where the first
light's image shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.illumination import unmix as unmix_kernel
from rgbmidic.arguments import check_fields, checked
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.illumination.images import IlluminationImages, check_names
from rgbmidic.illumination.linear import LinearChannels
from rgbmidic.typing import BoolArray, FloatArray


def legendre_products(points: npt.ArrayLike, shape: tuple[int, int], order: int) -> FloatArray:
    """Return products of Legendre polynomials in x and y up to a total degree, on the field scaled to [-1, 1].

    Parameters
    ----------
    points : array_like, shape (..., 2)
        Points (x, y) in px.
    shape
        Rows and columns of the field.
    order
        Largest total degree.

    Returns
    -------
    ndarray, shape (..., T)
        ``P_a(2x/(W-1) - 1) P_b(2y/(H-1) - 1)`` ordered by degree a + b, then by b; the first is 1,
        T = (order + 1)(order + 2)/2.
    """
    from numpy.polynomial import legendre

    xy = np.asarray(points, dtype=np.float64)
    scaled = 2 * xy / (np.array(shape[::-1]) - 1) - 1
    in_x, in_y = (legendre.legvander(scaled[..., axis], order) for axis in (0, 1))
    terms = [in_x[..., total - b] * in_y[..., b] for total in range(order + 1) for b in range(total + 1)]
    return np.stack(terms, axis=-1)


@dataclass(frozen=True, slots=True, kw_only=True)
class CrosstalkField:
    """The polynomial by which the crosstalk matrix departs from its mean over the field.

    Attributes
    ----------
    order : int
        Total degree of the polynomial, at least 1.
    coefficients : ndarray, shape (T - 1, C, k)
        One matrix per Legendre product after the constant one (`legendre_products`).
    shape : tuple of int
        Rows and columns of the frames.
    std : ndarray, shape (T - 1, C, k), or None
        Standard uncertainty of every coefficient.
    """

    order: int
    coefficients: FloatArray
    shape: tuple[int, int]
    std: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self, CalibrationError)
        values = np.asarray(self.coefficients, dtype=np.float64)
        terms = (self.order + 1) * (self.order + 2) // 2 - 1
        if self.order < 1 or values.ndim != 3 or len(values) != terms or not np.isfinite(values).all():
            raise CalibrationError(
                f"a crosstalk field of order {self.order} needs {terms} finite matrices, not an array of {values.shape}"
            )
        object.__setattr__(self, "coefficients", values)
        object.__setattr__(self, "shape", (int(self.shape[0]), int(self.shape[1])))
        if min(self.shape) < 2:
            raise CalibrationError(f"a crosstalk field spans frames of 2 x 2 px and more, not {self.shape}")
        if self.std is not None:
            if self.std.size != values.size:
                raise CalibrationError(
                    f"the uncertainty of a field {values.shape} is of its shape, not {self.std.shape}"
                )
            object.__setattr__(self, "std", np.asarray(self.std, dtype=np.float64).reshape(values.shape))


@dataclass(frozen=True, slots=True, kw_only=True)
class Crosstalk:
    """The matrix of how strongly each camera channel sees each light.

    Attributes
    ----------
    matrix : ndarray, shape (C, k)
        A in ``channels = A @ lights``; the largest entry of every column is 1. Its mean where it varies.
    lights : tuple of str, length k
        Their names, in the order of the columns.
    covariance : ndarray, shape (C k, C k), or None
        Covariance of the entries, taken row by row (``matrix.ravel()``).
    std : ndarray, shape (C, k), or None
        Standard uncertainty of every entry; from the covariance where that is given.
    field : CrosstalkField or None
        How A varies over the field; None: it is the same everywhere.
    green_difference : ndarray, shape (k,), or None
        Entries of the greens in rows with red minus those of the greens in rows with blue, whose mean `matrix` has;
        its mean over the field. None: the greens are equal, or there is one only (3-CCD).
    green_difference_std : ndarray, shape (k,), or None
        Its standard uncertainty.
    light_levels : ndarray, shape (k,), or None
        Mean level of each light in its captures, DN above dark in the channel that sees it best.
    """

    matrix: FloatArray
    lights: tuple[str, ...]
    std: FloatArray | None = None
    covariance: FloatArray | None = None
    field: CrosstalkField | None = None
    green_difference: FloatArray | None = None
    green_difference_std: FloatArray | None = None
    light_levels: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check the values and convert them to their types."""
        check_fields(self, CalibrationError)
        check_names(self.lights)
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.ndim != 2 or matrix.shape[1] != len(self.lights) or matrix.shape[1] > matrix.shape[0]:
            raise CalibrationError(
                f"a crosstalk matrix has one row per camera channel and one column per light, at most as many lights "
                f"as channels; given is shape {matrix.shape} for the lights {', '.join(self.lights)}"
            )
        if not np.isfinite(matrix).all():
            raise CalibrationError("the crosstalk matrix has entries that are not finite numbers")
        condition = np.linalg.cond(matrix)
        if not condition < 1e3:
            raise CalibrationError(
                f"the crosstalk matrix cannot be inverted (condition number {condition:.3g}, allowed is below 1000): "
                "two lights look the same to the camera"
            )
        if self.field is not None and self.field.coefficients.shape[1:] != matrix.shape:
            raise CalibrationError(
                f"the field of the crosstalk is for matrices of shape {self.field.coefficients.shape[1:]}, "
                f"the matrix has {matrix.shape}"
            )
        object.__setattr__(self, "matrix", matrix)
        std, size = self.std, matrix.size
        if self.covariance is not None:
            covariance = np.asarray(self.covariance, dtype=np.float64)
            if covariance.shape != (size, size) or not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
                raise CalibrationError(
                    f"the covariance of the crosstalk matrix must be {size} x {size} finite numbers with no negative "
                    f"variance; given is shape {covariance.shape}"
                )
            object.__setattr__(self, "covariance", covariance)
            std = np.sqrt(np.diag(covariance))
        if std is not None:
            object.__setattr__(self, "std", np.asarray(std, dtype=np.float64).reshape(matrix.shape))
        self._check_lights()

    def _check_lights(self) -> None:
        """Check what has one number per light."""
        for name in ("green_difference", "green_difference_std", "light_levels"):
            if (figures := getattr(self, name)) is None:
                continue
            values = np.asarray(figures, dtype=np.float64)
            if len(self.matrix) != 3 or values.shape != (len(self.lights),) or not np.isfinite(values).all():
                raise CalibrationError(
                    f"{name} of a crosstalk of three camera channels has one finite number per light "
                    f"({', '.join(self.lights)}); given is shape {values.shape} for {len(self.matrix)} channels"
                )
            if name == "green_difference_std" and (self.green_difference is None or (values < 0).any()):
                raise CalibrationError("green_difference_std belongs to a green_difference and is not negative")
            if name == "light_levels" and (values <= 0).any():
                raise CalibrationError(f"light_levels are positive, not {', '.join(map(str, values))}")
            object.__setattr__(self, name, values)

    @classmethod
    def identity(cls, lights: tuple[str, ...]) -> Crosstalk:
        """No crosstalk: every light is seen by its own channel alone."""
        return cls(matrix=np.eye(len(lights)), lights=lights)

    def cropped(self, origin: tuple[int, int], shape: tuple[int, int]) -> Crosstalk:
        """Return the crosstalk on frames of `shape` that begin at `origin` (column, row) of the calibrated ones.

        The lights keep their units, so that the largest entries of the new mean need not be 1; its uncertainty is that
        of the whole field's.
        """
        if self.field is None:
            return self
        # the polynomial in the crop's own coordinates, from its values at as many points as determine it
        order = self.field.order
        y, x = (np.linspace(0, side - 1, order + 1) for side in shape)
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        inverse = np.linalg.pinv(legendre_products(points, shape, order))
        matrices = np.tensordot(inverse, self.at(points + origin), axes=1)
        return replace(
            self, matrix=matrices[0], field=CrosstalkField(order=order, coefficients=matrices[1:], shape=shape)
        )

    def at(self, points: npt.ArrayLike) -> FloatArray:
        """Return A at points (x, y) in px of shape (..., 2): shape (..., C, k)."""
        if self.field is None:
            return np.broadcast_to(self.matrix, (*np.shape(points)[:-1], *self.matrix.shape))
        terms = legendre_products(points, self.field.shape, self.field.order)[..., 1:]
        return np.asarray(self.matrix + np.tensordot(terms, self.field.coefficients, axes=1))

    @property
    def sites(self) -> FloatArray:
        """The matrix (4, k) of the sites of a Bayer cell: R, G in rows with red, G in rows with blue, B."""
        red, green, blue = self.matrix
        half = 0.0 if self.green_difference is None else self.green_difference / 2
        return np.stack([red, green + half, green - half, blue])

    @property
    def unmixing(self) -> FloatArray:
        """The matrix (k, C) that turns channels into lights: the (pseudo-)inverse of A."""
        return np.asarray(np.linalg.pinv(self.matrix), dtype=np.float64)

    def unmixing_at(self, points: npt.ArrayLike) -> FloatArray:
        """Return the (pseudo-)inverse of A at points (x, y) in px of shape (..., 2): shape (..., k, C)."""
        if self.field is None:
            return np.broadcast_to(self.unmixing, (*np.shape(points)[:-1], *self.unmixing.shape))
        return np.asarray(np.linalg.pinv(self.at(points)), dtype=np.float64)

    @property
    def condition_number(self) -> float:
        """Ratio of the largest to the smallest singular value of A."""
        return float(np.linalg.cond(self.matrix))

    @property
    def noise_amplification(self) -> FloatArray:
        """Noise of each light's image over the noise of one camera channel, shape (k,)."""
        return np.asarray(np.sqrt((self.unmixing**2).sum(axis=1)))

    @property
    def leakage_std(self) -> FloatArray | None:
        """Standard uncertainty (k, k) of what light j (column) leaves in the image of light i (row) after unmixing.

        An error dA leaves ``-A^-1 dA`` there.
        """
        if self.covariance is None:
            return None
        channels, lights = self.matrix.shape
        blocks = self.covariance.reshape(channels, lights, channels, lights)
        variance = np.einsum("ic,cjdj,id->ij", self.unmixing, blocks, self.unmixing)
        return np.asarray(np.sqrt(np.maximum(variance, 0)))

    def checkerboard(self, green_difference: FloatArray) -> FloatArray:
        """Return the checkerboard (k, k) that light j (column), alone at level 1, leaves in the image of light i (row).

        Unmixing with one row for both greens leaves plus this at the greens in rows with red, minus this at those in
        rows with blue.

        Parameters
        ----------
        green_difference : ndarray, shape (k,)
            What the row does not take into account: all of `green_difference` where the greens are taken as equal, its
            uncertainty where they are not.
        """
        return np.outer(self.unmixing[:, 1], green_difference) / 2


NEGLIGIBLE = 0.25
"""A clipped channel makes a light invalid only if its coefficient is above this fraction of the light's largest: the
light's own channel does, a neighbour's crosstalk of some 10 % does not. Two lights of three see on where the third
saturates; what leaks from beyond full scale is smooth or judged by the residual like the rest of a reflection."""


@checked
def unmix(channels: LinearChannels, crosstalk: Crosstalk, *, negligible: float = NEGLIGIBLE) -> IlluminationImages:
    """Return one image per light from camera channels: ``lights = A^-1 channels`` (pseudo-inverse for k < C).

    Parameters
    ----------
    channels
        Values (C, H, W) above black, with their validity.
    crosstalk
        A, shape (C, k), everywhere the same or varying over the field.
    negligible
        Coefficients of A^-1 below this fraction of the largest of their row do not make a light invalid; a clipped
        channel then counts with the value it has.

    Returns
    -------
    IlluminationImages
        (k, H, W); invalid where any channel with a non-negligible coefficient is.

    Raises
    ------
    InputError
        The channels do not fit the crosstalk matrix.

    Examples
    --------
    >>> channels = LinearChannels(values=np.full((3, 4, 5), 110.0), valid=np.full((3, 4, 5), True), full_scale=4095.0)
    >>> crosstalk = Crosstalk(matrix=1.1 * np.eye(3), lights=("red", "green", "blue"))
    >>> unmix(channels, crosstalk).values[:, 0, 0].round(3)
    array([100., 100., 100.], dtype=float32)
    """
    colours = crosstalk.matrix.shape[0]
    if channels.values.ndim != 3 or len(channels.values) != colours or channels.valid.shape != channels.values.shape:
        raise InputError(
            f"the crosstalk matrix has {colours} camera channels; the channels given have shape "
            f"{channels.values.shape}, their validity {channels.valid.shape}"
        )
    shape = channels.values.shape[1:]
    if crosstalk.field is not None and crosstalk.field.shape != shape:
        calibrated = crosstalk.field.shape
        raise InputError(
            f"the crosstalk varies over a field of {calibrated[1]} x {calibrated[0]} px; the frame has {shape[1]} x "
            f"{shape[0]} px: calibrate with frames of the size of the test"
        )
    # A^-1 at every `step`-th pixel and beyond the last ones, (GY, GX, k, C); one cell of the grid where it is constant
    # interpolated over 32 px at most
    step = max(shape) if crosstalk.field is None else max(min(32, min(shape) // 16), 2)
    y, x = (step * np.arange((side - 1) // step + 2) for side in shape)
    grid = crosstalk.unmixing_at(np.stack(np.meshgrid(x, y), axis=-1)).astype(np.float32)
    values = np.empty((len(crosstalk.lights), *shape), dtype=np.float32)
    valid = np.empty(values.shape, dtype=bool)
    unmix_kernel(
        np.ascontiguousarray(channels.values, dtype=np.float32),
        np.ascontiguousarray(channels.valid, dtype=bool),
        grid,
        step,
        required_channels(crosstalk.unmixing, negligible),
        values,
        valid,
    )
    return IlluminationImages(values=values, valid=valid, names=crosstalk.lights, full_scale=channels.full_scale)


def required_channels(matrix: FloatArray, negligible: float = NEGLIGIBLE) -> BoolArray:
    """Find the channels that must be valid for each light that ``matrix @ channels`` gives.

    Parameters
    ----------
    matrix : ndarray, shape (k, C)
        A^-1, or what else makes lights of channels.
    negligible
        Fraction of the largest entry of a row under which a channel need not be valid.

    Returns
    -------
    ndarray, shape (k, C), bool
    """
    return np.asarray(np.abs(matrix) > negligible * np.abs(matrix).max(axis=1, keepdims=True))
