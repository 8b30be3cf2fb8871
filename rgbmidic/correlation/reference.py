"""The two sides of the minimisation: the reference state, prepared once, and a deformed state, prepared per frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rgbmidic._kernels.correlation import (
    BLOCK,
    compare_states,
    element_hessian,
    element_sums,
    element_vector,
)
from rgbmidic._kernels.owned_pixels import add_second_derivatives, interpolate_nodal
from rgbmidic._kernels.splines import pixel_gradient, sample_with_gradient
from rgbmidic._kernels.threads import aside
from rgbmidic.correlation.assembly import Assembly, mean_residual_leverage
from rgbmidic.correlation.brightness import (
    BrightnessModel,
    GainFit,
    window_width,
)
from rgbmidic.correlation.constants import USUAL, SolverConstants
from rgbmidic.correlation.images import (
    filter_variance,
    spline_coefficients,
    spline_values,
    usable_pixels,
    usable_reach,
)
from rgbmidic.correlation.texture import TextureGradient
from rgbmidic.derived import Derivable
from rgbmidic.errors import InputError
from rgbmidic.illumination.images import DARK, Registration
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.mesh.pixel_map import SlidingWindow
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage

_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Deformed:
    """The k images of a deformed state, ready to be interpolated.

    Attributes
    ----------
    coefficients : ndarray, shape (k, H + 2 PAD, W + 2 PAD), float32
        Cubic B-spline coefficients of the images, holes filled and prefiltered.
    weights : ndarray, shape (k, H, W), float32
        0 where a pixel is excluded or must not be interpolated.
    nonuniform_weight_blocks : ndarray, shape (k, h + 1, w + 1), int32
        Number of blocks of `BLOCK` px, above and to the left, with a weight other than 1.
    origin : tuple of int
        Column and row of the frame at which the images begin.

    Examples
    --------
    >>> Deformed.prepare(np.ones((3, 40, 60), dtype=np.float32)).weights.shape
    (3, 40, 60)
    """

    coefficients: FloatImage
    weights: FloatImage
    origin: tuple[int, int] = (0, 0)
    nonuniform_weight_blocks: npt.NDArray[np.int32] = field(init=False)

    def __post_init__(self) -> None:
        """Count the blocks with a weight other than 1."""
        object.__setattr__(
            self, "nonuniform_weight_blocks", np.stack([_count_nonuniform_blocks(weight) for weight in self.weights])
        )

    def contains(self, points: FloatArray, std: FloatArray) -> BoolArray:
        """Find the points that lie between pixels of the images, as far as their uncertainty says.

        Parameters
        ----------
        points : ndarray, shape (N, 2)
            x and y in px, counted from the first pixel.
        std : ndarray, shape (N, 2)
            Their standard uncertainty, px; NaN where not known. Four times of it may be noise, which 1 of 30,000 points
            on the border exceeds.

        Returns
        -------
        ndarray, shape (N,), bool
        """
        margin, limits = 4 * np.nan_to_num(std), np.array(self.weights.shape[:0:-1]) - 1
        return np.asarray(((points >= -margin) & (points <= limits + margin)).all(axis=1))

    def images_on_first_light(self, registration: Registration | None = None) -> tuple[FloatImage, FloatImage]:
        """Return the images, holes filled and prefiltered, and the weights, both (k, H, W) on the first light's pixels.

        The others follow by the affine motion nearest to their registration: good enough to look at and search in.

        Parameters
        ----------
        registration
            Of the lights; None: their images lie on one another.

        Returns
        -------
        images, weights : ndarray, shape (k, H, W), float32
        """
        values, weights = spline_values(self.coefficients), self.weights
        if registration is not None:
            weights = weights.copy()
            corners = np.array([[0, 0], [values.shape[2], 0], [0, values.shape[1]]], dtype=np.float32)
            for light, shift in enumerate(registration.displacement(corners + self.origin)):
                transform = cv2.getAffineTransform(corners, (corners + shift).astype(np.float32))
                for image in (values[light], weights[light]):
                    image[:] = cv2.warpAffine(image, transform, image.shape[::-1], flags=_WARP)
        return values, weights

    @classmethod
    def prepare(
        cls,
        images: FloatImage,
        weights: FloatImage | None = None,
        *,
        prefilter: str = "none",
        origin: tuple[int, int] = (0, 0),
    ) -> Deformed:
        """Fill holes of images, filter them and prepare their splines.

        Parameters
        ----------
        images : ndarray, shape (k, H, W), float32
            Grey levels, NaN where invalid.
        weights : ndarray, shape (k, H, W), float32, optional
            In [0, 1]; 1 without.
        prefilter
            One of `PREFILTERS`.
        origin
            Column and row of the frame at which the images begin.

        Returns
        -------
        Deformed

        Raises
        ------
        InputError
            Unknown prefilter.
        """
        return cls(
            coefficients=spline_coefficients(images, prefilter),
            weights=_usable_weights(images, weights, prefilter),
            origin=origin,
        )


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference(Derivable):
    """The reference state: its mesh and its images; everything a frame needs and no frame changes.

    Attributes
    ----------
    mesh, pixels, assembly
        TRI3 mesh, pixel map, sparse structure of the normal equations.
    material : Tri3Mesh
        The mesh on the first frame, where fields are recovered and strains count, and distances are those where the
        sides of a crack meet: `mesh` itself before any reference update.
    origin : tuple of int
        Column and row of the frame at which the images begin; mesh and pixels count from there.
    images, weights : ndarray, shape (k, H, W), float32
        Holes filled and prefiltered; 0 where excluded. In pictures: all lights on the pixels of the first.
    registration : Registration or None
        Where in its own image, of this state and of the deformed ones, a light shows what the first one shows at a
        pixel of the frame: there it is read; None: at the same pixel.
    residual_leverage : float, or ndarray of shape (E,) on a graded mesh
        Fraction of the variance of a block's score that the fit leaves in the residual (`mean_residual_leverage`).
    values, pixel_weights : ndarray, shape (k, P), float32
        The same at the owned pixels; the values with what `filtered_as` changes, the weights 0 where a light is dark.
    inverse_level : ndarray, shape (k, P), float32
        One over the local mean of `values`, in units of which residual and gradient are.
    brightness
        ``solver.brightness``.
    gain_fit : GainFit or None
        Of the lights' local gains with the `pixel_weights`; None where the gain is one number.
    gradient : ndarray, shape (2, k, P), float32
        Gradient of the texture common to the lights, as each shows it, in local means per px; without what is a gain.
    rim : ndarray, shape (P,), float32
        1 at the pixels whose filtered grey level holds some of what lies beyond the region, else 0.
    texture : TextureGradient
        What it is computed from.
    prefilter : str
        One of `PREFILTERS`.
    constants : SolverConstants
        Of the solve.

    Examples
    --------
    >>> from rgbmidic.mesh import Region
    >>> region = Region.from_rectangle((0, 0, 59, 39), shape=(40, 60))
    >>> images = np.random.default_rng(0).uniform(50, 200, (1, 40, 60)).astype(np.float32)
    >>> reference = Reference.prepare(images, region, mesh=Tri3Mesh.from_region(region, element_size=20))
    >>> reference.pixels.shape
    (40, 60)
    """

    mesh: Tri3Mesh
    pixels: PixelMap
    assembly: Assembly
    material: Tri3Mesh
    origin: tuple[int, int]
    residual_leverage: float | FloatArray
    images: FloatImage
    weights: FloatImage
    values: FloatImage
    inverse_level: FloatImage
    gain_fit: GainFit | None
    brightness: BrightnessModel
    gradient: FloatImage
    pixel_weights: FloatImage
    rim: FloatImage
    texture: TextureGradient
    prefilter: str
    registration: Registration | None = None
    constants: SolverConstants = USUAL

    @classmethod
    def prepare(
        cls,
        images: FloatImage,
        region: Region,
        weights: FloatImage | None = None,
        *,
        mesh: Tri3Mesh,
        prefilter: str = "none",
        origin: tuple[int, int] = (0, 0),
        material: Tri3Mesh | None = None,
        registration: Registration | None = None,
        brightness: BrightnessModel = "auto",
        constants: SolverConstants = USUAL,
    ) -> Reference:
        """Prepare the reference state.

        Parameters
        ----------
        images : ndarray, shape (k, H, W), float32
            Grey levels, NaN where invalid.
        region
            Pixels to measure; region and mesh count from the first pixel of the images.
        weights : ndarray, shape (k, H, W), float32, optional
            In [0, 1]; 1 without.
        mesh
            Of the region.
        prefilter
            One of `PREFILTERS`.
        origin
            Column and row of the frame at which the images begin.
        material
            Mesh on the first frame, where this is a later one; its nodes are those of `mesh`.
        registration
            Of the lights, where their images do not lie on one grid; the region is then that of the first light.
        brightness
            Model of the deformed images' brightness, as ``solver.brightness``.
        constants
            Of the solve.

        Returns
        -------
        Reference

        Raises
        ------
        InputError
            The region belongs to images of another size; unknown prefilter; grey levels without a gain.
        """
        if region.mask.shape != images.shape[1:]:
            raise InputError(f"the region is for images of shape {region.mask.shape}, not {images.shape[1:]}")
        state = Deformed.prepare(images, weights, prefilter=prefilter, origin=origin)
        inside, unmixed = np.ones(region.mask.shape, dtype=np.float32), usable_pixels(region.mask, prefilter)
        if region.rectangle is None:  # what lies beyond an outline may be another body, or a hole
            inside *= unmixed
        if len(cracks := mesh.crack_edges):  # what lies beyond a crack moves otherwise
            inside *= usable_pixels(~rasterise_lines(mesh.nodes[cracks], region.mask.shape), prefilter)
        mapped, assembly, material = aside(PixelMap.from_mesh, mesh, region), Assembly.from_mesh(mesh), material or mesh
        # what each frame needs of it, found while the pixels are
        _ = material.linear_fit_offset, material.colouring
        pixels, (prepared_images, usable) = mapped.result(), state.images_on_first_light(registration)
        rim = pixels.gather(np.float32(1) - unmixed)
        usable = usable * inside
        if registration is None:
            values, weighted, light_gradient = (
                pixels.gather(prepared_images),
                pixels.gather(usable),
                _gradient(state.coefficients, pixels),
            )
        else:
            values, weighted, light_gradient = _sample_registered_lights(
                state, mesh, pixels, pixels.gather(inside), registration
            )
        del state  # before what needs most memory
        sigma = brightness if isinstance(brightness, int | float) else None
        if brightness == "auto":
            sigma = window_width(values, light_gradient, weighted, pixels, constants)
        level = _local_level(values, weighted, pixels, sigma)
        if sigma is not None:
            weighted *= level > DARK * level.max()  # residuals are relative to it
        inverse_level, fit = np.float32(1) / level, None
        if sigma is not None:
            fit = GainFit.over(values, weighted, pixels, sigma)
            for axis in light_gradient:
                axis[:] = fit.remainder(axis, values)  # what a gain may be is no displacement
        light_gradient *= inverse_level
        texture = TextureGradient.of_images(light_gradient, weighted, pixels, constants.gradient_correlation_bounds)
        gradient = texture.matched(pixels)
        return cls(
            mesh=mesh,
            pixels=pixels,
            assembly=assembly,
            material=material,
            origin=origin,
            residual_leverage=mean_residual_leverage(
                mesh, pixels, assembly, (gradient, weighted), prefilter, constants
            ),
            images=prepared_images,
            weights=usable,
            values=values,
            inverse_level=inverse_level,
            gain_fit=fit,
            brightness=brightness,
            gradient=gradient,
            pixel_weights=weighted,
            rim=rim,
            texture=texture,
            prefilter=prefilter,
            registration=registration,
            constants=constants,
        )

    @property
    def gain_window(self) -> float | None:
        """Standard deviation (px) of the window of the gain; None where the gain is one number."""
        return None if self.gain_fit is None else self.gain_fit.sigma

    def filtered_as(self, displacement: FloatArray) -> Reference:
        """Return the reference with the grey levels that the prefilter leaves of it where it is deformed.

        A filter of the variance s^2 adds ``s^2/2`` of the Laplacian. That along the axes of the deformed images is
        ``C^-1 : grad grad`` in those of the reference, with C the right Cauchy-Green tensor: a pattern that is
        compressed loses more contrast, and what the two states differ by would displace it.

        Parameters
        ----------
        displacement : ndarray, shape (N, 2)
            Of the nodes, px.

        Returns
        -------
        Reference
            With other `values`; itself where the surface is hardly strained.
        """
        (xx, xy), (yx, yy) = np.moveaxis(np.eye(2) + self.mesh.element_gradient(displacement), 0, -1)
        inverse = np.stack([xy**2 + yy**2, -(xx * xy + yx * yy), xx**2 + yx**2], axis=1)
        inverse /= np.maximum((xx * yy - xy * yx) ** 2, 1e-9)[:, None]
        stretch_change = np.clip(inverse - (1, 0, 1), -1, 4)  # beyond, compressed to .45, one term is not enough
        stretch_change[torn_elements(self.mesh, displacement, self.constants)] = 0  # that is no strain
        if np.sqrt((stretch_change**2).mean()) < 0.01:  # twice the strain: half a per cent of it errs by .00016 px
            return self
        factors = filter_variance(self.prefilter) / 2 * (stretch_change * (1, 2, 1)).astype(np.float32)
        values, (first_row, first_column, _, _) = self.values.copy(), self.pixels.bounds
        add_second_derivatives(
            factors, self.images, self.pixels.lines, self.pixels.run_offsets, first_row, first_column, values
        )
        return replace(self, values=values)  # whose means over the window of a gain are the same

    def with_gain_window(self, sigma: float) -> Reference:
        """Return the reference with a gain that is smooth over a narrower window.

        Parameters
        ----------
        sigma
            Standard deviation of the window, px.

        Returns
        -------
        Reference
        """
        fit = GainFit.over(self.values, self.pixel_weights, self.pixels, sigma)
        gradient = np.stack([fit.remainder(axis / self.inverse_level, self.values) for axis in self.gradient])
        return replace(self, gain_fit=fit, gradient=gradient * self.inverse_level)

    def offset(self, deformed: Deformed) -> FloatArray:
        """Column and row of these images (2,) at which those of a deformed state begin.

        Parameters
        ----------
        deformed
            The deformed images, which may be a part of the frame.

        Returns
        -------
        ndarray, shape (2,)
            In px.
        """
        return np.subtract(deformed.origin, self.origin).astype(np.float64)

    def warps(
        self, deformed: Deformed, displacements: Sequence[FloatArray]
    ) -> Iterator[tuple[slice, tuple[AnyArray, ...]]]:
        """Yield lights that move alike, and where their deformed images show the pixels; see `warp_arguments`.

        A light's registration is part of it, as linear in each element as the displacement, here and in the reference's
        own grey levels: what the elements do not follow of it cancels.

        Parameters
        ----------
        deformed
            The deformed images.
        displacements : sequence of ndarray, shape (N, 2)
            Nodal displacement of each light in px.

        Yields
        ------
        slice, tuple of ndarray
        """
        is_common = self.registration is None and all(one is displacements[0] for one in displacements)
        for light, displacement in enumerate(displacements[:1] if is_common else displacements):
            motion = displacement - self.offset(deformed)
            if self.registration is not None:
                motion = motion + self.registration.displacement(self.mesh.nodes + displacement + self.origin, light)
            lights = slice(None) if is_common else slice(light, light + 1)
            yield lights, warp_arguments(self.mesh, self.pixels, motion)

    def blocks(self, weight: FloatImage, gradient: Iterable[FloatImage]) -> FloatArray:
        """Element blocks (E, 3, 3, 3) of ``sum w D phi_a phi_b``, D = (gx gx, gx gy, gy gy), for fields (P,).

        Parameters
        ----------
        weight : ndarray, shape (P,)
            Weight w of every owned pixel.
        gradient : iterable of ndarray, shape (P,)
            Gradient of the grey level along x and y.

        Returns
        -------
        ndarray, shape (E, 3, 3, 3)
        """
        out = np.zeros((len(self.mesh.elements), 3, 3, 3))
        element_hessian(*gradient, weight, *self.pixels.positions, out)
        return out

    def hessians(self, weights: FloatImage) -> list[FloatArray]:
        """Element blocks of each light's Hessian for pixel weights (k, P).

        Parameters
        ----------
        weights : ndarray, shape (k, P)
            Weight of every light at the owned pixels.

        Returns
        -------
        list of ndarray, shape (E, 3, 3, 3)
            One array a light.
        """
        return [self.blocks(*light) for light in zip(weights, self.gradient.swapaxes(0, 1), strict=True)]

    def projected(
        self, weights: FloatImage, difference: FloatImage, gradient: Iterable[FloatImage] | None = None
    ) -> FloatArray:
        """Sum the right-hand sides of lights over each element: ``sum w r grad f phi``.

        Parameters
        ----------
        weights, difference : ndarray, shape (k, P) or (P,)
            Weight w and residual r at every owned pixel.
        gradient : iterable of ndarray, shape (k, P) or (P,)
            Along x and y, if it is not the reference's own.

        Returns
        -------
        ndarray, shape (k, E, 3, 2) or (E, 3, 2)
            By element, corner and axis.
        """
        vectors = np.empty((*weights.shape[:-1], len(self.mesh.elements), 3, 2))
        gradient = self.gradient if gradient is None else gradient
        fields = (np.atleast_2d(field) for field in (weights, difference, *gradient))
        element_vector(*fields, *self.pixels.positions, vectors.reshape(-1, *vectors.shape[-3:]))
        return vectors

    def sums(self, values: FloatImage, factor: FloatImage) -> FloatArray:
        """Sum fields (n, P) over each element, and their products with a `factor` (P,); shape (n, E, 2).

        Parameters
        ----------
        values : ndarray, shape (n, P)
            Fields at the owned pixels.
        factor : ndarray, shape (P,)
            What they are multiplied with in the second sum.

        Returns
        -------
        ndarray, shape (n, E, 2)
            Sums of the fields, and of their products with the factor.
        """
        out = np.empty((len(values), len(self.mesh.elements), 2))
        element_sums(values, factor, self.pixels.offsets, out)
        return out


def torn_elements(mesh: Tri3Mesh, displacement: FloatArray, constants: SolverConstants = USUAL) -> BoolArray:
    """Find the elements (E,) whose nodes have gone with different bodies, as a displacement (N, 2) has it.

    Their stretch C, the right Cauchy-Green tensor, differs from the median of the elements around.
    """
    deformation = np.eye(2) + mesh.element_gradient(displacement)
    stretch = np.swapaxes(deformation, 1, 2) @ deformation - np.eye(2)
    torn = np.asarray(np.linalg.norm(stretch, axis=(1, 2)) > constants.max_relative_stretch)
    if torn.any():
        centre = mesh.centres
        neighbours = cKDTree(centre).query(
            centre[torn], k=[*range(1, min(constants.neighbour_count, len(centre)) + 1)]
        )[1]
        excess = stretch[torn] - np.median(stretch[neighbours], axis=1)
        torn[torn] = np.linalg.norm(excess, axis=(1, 2)) > constants.max_relative_stretch
    return torn


def warp_arguments(mesh: Tri3Mesh, pixels: PixelMap, motion: FloatArray) -> tuple[AnyArray, ...]:
    """Runs of pixels, elements, shape functions and a motion (N, 2) of the nodes, for the kernels that follow it."""
    return pixels.runs, pixels.run_offsets, pixels.origin, mesh.elements, pixels.barycentric, motion


def _usable_weights(images: FloatImage, weights: FloatImage | None, prefilter: str) -> FloatImage:
    """Return the weight (k, H, W) of each pixel, 0 where it or its neighbourhood is invalid."""
    usable, reach = np.ones_like(images) if weights is None else weights.copy(), usable_reach(prefilter)
    for image, weight in zip(images, usable, strict=True):
        if weight.min() > 0 and np.isfinite(image.sum()):  # NaN and infinity spread to it
            weight[:reach] = weight[-reach:] = weight[:, :reach] = weight[:, -reach:] = 0
        else:
            valid = np.isfinite(image)
            valid &= weight > 0
            weight[~usable_pixels(valid, prefilter)] = 0
    return usable


def _sample_registered_lights(
    state: Deformed, mesh: Tri3Mesh, pixels: PixelMap, inside: FloatImage, registration: Registration
) -> tuple[FloatImage, FloatImage, FloatImage]:
    """Grey levels and weights (k, P), gradient (2, k, P) of lights at what the first one shows at the owned pixels.

    `inside` (P,) is the weight of these pixels themselves.
    """
    x, y = pixels.columns, pixels.rows
    values, weights = (np.empty((len(state.weights), inside.size), dtype=np.float32) for _ in range(2))
    gradient, shift = (
        np.empty((2, *leading_shape, inside.size), dtype=np.float32) for leading_shape in (values.shape[:1], ())
    )
    zero, unused, moments = np.zeros_like(inside[None]), np.empty_like(inside), np.empty((1, len(mesh.elements), 6))
    is_changed = np.ones(moments.shape[:2], dtype=bool)
    for light, motion in enumerate(registration.displacement(mesh.nodes + state.origin)):
        one, warp = slice(light, light + 1), warp_arguments(mesh, pixels, motion)
        images = state.coefficients[one], state.weights[one], zero, inside[None], is_changed
        compare_states(*images, *warp, pixels.offsets, values[one], weights[one], moments)
        interpolate_nodal(motion, mesh.elements, *pixels.positions, shift)
        sample_with_gradient(state.coefficients[light], x + shift[0], y + shift[1], unused, *gradient[:, light])
    return np.negative(values, out=values), weights, gradient


def _count_nonuniform_blocks(weight: FloatImage) -> npt.NDArray[np.int32]:
    """See `Deformed.nonuniform_weight_blocks`, for one weight (H, W)."""
    below, right = (-side % BLOCK for side in weight.shape)
    partial = np.pad(weight != 1, ((0, below), (0, right))) if below or right else weight != 1
    rows = partial.view(np.uint64).reshape(-1, BLOCK, partial.shape[1] // BLOCK)  # a number for each row of a block
    return np.asarray(cv2.integral((np.bitwise_or.reduce(rows, axis=1) != 0).view(np.uint8)), dtype=np.int32)


def rasterise_lines(lines: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    """Pixels (H, W) under lines with the ends (C, 2, 2) in px."""
    image = np.zeros(shape, dtype=np.uint8)
    shift = 8  # fixed-point bits of OpenCV's coordinates
    cv2.polylines(image, list(np.round(lines * 2**shift).astype(np.int32)), False, 1, shift=shift)
    return image.astype(bool)


def _gradient(coefficients: FloatImage, pixels: PixelMap) -> FloatImage:
    """Gradient (2, k, P) of splines at the owned pixels."""
    gradient = np.empty((2, len(coefficients), pixels.local_x.size), dtype=np.float32)
    for light, spline in enumerate(coefficients):
        pixel_gradient(pixels.lines, spline, *pixels.bounds[:2], *gradient[:, light])
    return gradient


def _local_level(values: FloatImage, weights: FloatImage, pixels: PixelMap, sigma: float | None) -> FloatImage:
    """Local means (k, P) of grey levels in windows of `sigma` px, at least `DARK` of the largest; None: over all."""
    level, below = np.empty_like(values), np.zeros(len(values))
    for light, (f, w, out) in enumerate(zip(values, weights, level, strict=True)):
        if sigma is None:
            out[:] = abs((w * f).sum(dtype=np.float64)) / max(w.sum(dtype=np.float64), 1e-30) or 1.0
        else:
            window = SlidingWindow(sigma=sigma)
            out[:] = pixels.from_blocks(window.ratios(pixels, np.stack([w * f, w])), window.step)[0]
            if out.min() < 0:
                below[light] = (w * (out < 0)).sum() / max(w.sum(), np.float32(1e-30))
            np.maximum(out, np.float32(DARK * out.max() or 1.0), out=out)
    if below.min() > 0.1:  # one of several lights may be off
        raise InputError(
            f"the reference has local means below 0 in {below.min():.0%} of the region, which show no gain: grey "
            'levels are counted from black (add one number to all images), or state brightness = "constant"'
        )
    return level
