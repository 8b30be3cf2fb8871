"""How much each light counts at each pixel of every state of a test: one protocol for all methods (paper, section 3.2).

The weight of a pixel is the product of its weight in the reference image and in the deformed image at the place the
pixel has moved to; the solve brings the latter back.

By statistics, the default, every valid pixel counts fully at first; what the residual of a pass shows of the lights'
precision around each pixel is a factor on that in the next one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.weights import best_mean, robust_weights
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.extensions import LIGHT_WEIGHTS, load_extension
from rgbmidic.frames import read_mask
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh.pixel_map import WINDOW, SlidingWindow
from rgbmidic.renamed import state_new_names
from rgbmidic.settings import TestSettings
from rgbmidic.typing import FloatImage, unmasked
from rgbmidic.weights.precision import Precision
from rgbmidic.weights.threshold import ThresholdWeights

if TYPE_CHECKING:
    from rgbmidic.correlation import PrecisionMethod, Residual


class LightWeights(Protocol):
    """Weights (k, H, W) float32 in [0, 1] of every state of a test; 0 where an image is not valid.

    It may also have

    - ``notes``: numbers that were found out about the weights, by name, for the provenance;
    - ``describe()``: a text that says what they are; another text is another test, which `resume` refuses;
    - ``precision(residual)``: a factor on them, learnt from the residual (`rgbmidic.correlation.PrecisionMethod`).

    Examples
    --------
    >>> class SecondLight:
    ...     def reference(self, images: IlluminationImages) -> FloatImage:
    ...         return np.stack([np.full(images.shape, light == 1, dtype=np.float32) for light in range(3)])
    ...
    ...     def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
    ...         return self.reference(images)
    >>> weights: LightWeights = SecondLight()
    """

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Weights of the reference images.

        Parameters
        ----------
        images
            One image a light.

        Returns
        -------
        ndarray, shape (k, H, W), float32
        """
        ...

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Weights of the images of frame `index`.

        Parameters
        ----------
        images
            One image a light.
        index
            Index of the frame.

        Returns
        -------
        ndarray, shape (k, H, W), float32
        """
        ...


@dataclass(frozen=True, slots=True, eq=False)
class MaskWeights:
    """Masks made by hand, one per light; a `LightWeights`.

    Where a mask says 0 its light is excluded, in the reference and in every deformed frame alike: reflections of lamps
    and camera that stand still stay where they are.

    Attributes
    ----------
    masks : array_like, shape (k, H, W), or callable
        Weights from 0 to 1 over the whole frame; or a function that gives them from the `IlluminationImages` of a
        state.
    names
        What messages call each mask; by default its number.

    Raises
    ------
    InputError
        The masks are not (k, H, W), or not from 0 to 1.

    Examples
    --------
    >>> values = np.full((2, 4, 5), 100.0)
    >>> images = IlluminationImages(values=values, valid=values > 0, names=("red", "blue"), full_scale=255.0)
    >>> masks = np.ones((2, 4, 5))
    >>> masks[1, :, :2] = 0  # a lamp's reflection
    >>> MaskWeights(masks).deformed(images, 1)[1, 0].tolist()
    [0.0, 0.0, 1.0, 1.0, 1.0]
    """

    masks: npt.ArrayLike | Callable[[IlluminationImages], npt.ArrayLike]
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.masks):
            object.__setattr__(self, "masks", _fractions(self.masks))

    @classmethod
    def read(cls, paths: Sequence[Path]) -> MaskWeights:
        """Read one image per light.

        Values count by their fraction of the largest in the file (`rgbmidic.frames.read_mask`).

        Parameters
        ----------
        paths
            One file a light.

        Returns
        -------
        MaskWeights

        Raises
        ------
        FrameError
            An image is missing, damaged, or no mask.
        InputError
            They have different sizes.
        """
        masks = list[FloatImage]()
        for path in paths:
            masks.append(read_mask(path))
            if masks[-1].shape != masks[0].shape:
                raise InputError(
                    f"weights.images need one size: {path} has {_size(masks[-1])} px, {paths[0]} {_size(masks[0])}"
                )
        return cls(np.stack(masks), tuple(map(str, paths)))

    def describe(self) -> str:
        """Shape and checksum of the masks; the name of a function.

        Returns
        -------
        str
        """
        if callable(self.masks):
            return f"masks by {getattr(self.masks, '__qualname__', type(self.masks).__qualname__)}"
        masks = np.asarray(self.masks)
        return f"masks of shape {masks.shape}, {hashlib.sha256(masks.tobytes()).hexdigest()[:16]}"

    def reference(self, images: IlluminationImages) -> FloatImage:
        """The masks where the images are valid.

        Parameters
        ----------
        images
            One image a light.

        Returns
        -------
        ndarray, shape (k, H, W), float32

        Raises
        ------
        InputError
            The masks are not one per light, of the size of the frame.
        """
        masks = _fractions(self.masks(images)) if callable(self.masks) else np.asarray(self.masks)
        (x, y), (height, width) = images.origin, images.shape
        window_masks = masks if callable(self.masks) else masks[:, y : y + height, x : x + width]
        if window_masks.shape != images.values.shape:
            file_names = f" ({', '.join(self.names)})" if self.names else ""
            raise InputError(
                f"there must be one mask per light ({', '.join(images.names)}), of the size of the frame; given are "
                f"{len(masks)} masks{file_names} of {_size(masks)} px, the images have {_size(images.values)} px"
            )
        return np.where(images.valid, window_masks, np.float32(0))

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """The masks where the images are valid.

        Parameters
        ----------
        images
            One image a light.
        index
            Index of the frame.

        Returns
        -------
        ndarray, shape (k, H, W), float32
        """
        return self.reference(images)


def _fractions(masks: npt.ArrayLike) -> FloatImage:
    values = np.asarray(masks)
    if values.ndim != 3 or values.dtype.kind not in "buif":
        raise InputError(f"masks have shape (k, H, W), one per light; given is {values.dtype} {values.shape}")
    if not np.isfinite(values).all() or values.min(initial=0) < 0 or values.max(initial=0) > 1:
        raise InputError(f"masks count from 0 to 1; given are {values.min():g} to {values.max():g}")
    return np.ascontiguousarray(values, dtype=np.float32)


def _size(image: FloatImage) -> str:
    return f"{image.shape[-1]} x {image.shape[-2]}"


def precision_method(weights: Any, method: str) -> PrecisionMethod | None:
    """Return what learns from the residual: the `weights`, the statistics where `method` is that, or None.

    Parameters
    ----------
    weights
        The method of weighting, or the weights themselves.
    method
        ``weights.method`` of the settings.

    Returns
    -------
    PrecisionMethod or None

    Examples
    --------
    >>> precision_method(None, "statistics") == Statistics()
    True
    """
    if hasattr(weights, "precision"):
        return weights  # type: ignore[no-any-return]
    return Statistics() if method == "statistics" else None


_LARGEST = 1e9
"""Weight whose square, summed over the pixels of a mesh, single precision still holds."""


def as_weights(weights: npt.ArrayLike | None, shape: tuple[int, ...], name: str) -> FloatImage | None:
    """Return weights as a float32 stack, or None where none are given.

    Parameters
    ----------
    weights : array_like, shape (H, W) or (k, H, W), optional
        Finite and not negative.
    shape : tuple of int
        Shape (k, H, W) of the stack.
    name
        Of the argument, for error messages.

    Returns
    -------
    ndarray, shape (k, H, W), float32, or None

    Raises
    ------
    InputError
        Another shape, negative or not finite.

    Examples
    --------
    >>> as_weights(np.array([[0, 1], [1, 1]]), (2, 2), "masks").dtype
    dtype('float32')
    """
    if weights is None:
        return None
    values = unmasked(weights)
    if values.dtype.kind not in "buif":
        raise InputError(f"{name} must be real numbers, not {values.dtype}")
    if values.shape not in (shape, shape[1:]):
        raise InputError(f"{name} must have shape {shape[1:]} or {shape}; given is {values.dtype} {values.shape}")
    if not (values.min(initial=0) >= 0 and values.max(initial=0) <= _LARGEST):  # NaN spreads to both
        raise InputError(f"{name} must be finite, not negative, and {_LARGEST:g} at most")
    return np.ascontiguousarray(np.broadcast_to(values, shape), dtype=np.float32)


class PrepareWeights(Protocol):
    """A method of weighting that a tool adds (`rgbmidic.extensions.LIGHT_WEIGHTS`)."""

    def __call__(
        self, settings: TestSettings, *, lights: Sequence[str], shape: tuple[int, int], frames: int
    ) -> LightWeights:
        """Return the weights of a test, for the names of its lights and the shape (H, W) and number of its frames."""
        ...


def prepare_weights(
    settings: TestSettings, *, lights: Sequence[str], shape: tuple[int, int], frames: int
) -> LightWeights:
    """The method of weighting that the settings name; a `PrepareWeights`.

    Parameters
    ----------
    settings
        ``[weights]`` and what its method needs of the other sections.
    lights
        Names of the lights.
    shape
        Rows and columns of the frames.
    frames
        Number of frames of the test.

    Returns
    -------
    LightWeights

    Raises
    ------
    ConfigurationError
        The scene of the method ``"geometry"`` is not readable or not that of the test; the masks of the method
        ``"images"`` are not one per light or not of the size of the frames; the threshold is ``"auto"``, which takes
        the frames of a test (`rgbmidic.measure`).
    FrameError
        A mask cannot be read.

    Examples
    --------
    >>> from rgbmidic.settings import read_test
    >>> weights = prepare_weights(read_test("test.toml"), lights=("red", "green", "blue"), shape=(40, 60), frames=2)
    >>> type(weights).__name__
    'Statistics'
    """
    weights = settings.weights
    if weights.method == "images":
        masks = MaskWeights.read(weights.images)
        mask_values = np.asarray(masks.masks)
        if mask_values.shape != (len(lights), *shape):
            raise ConfigurationError(
                f"weights.images must name one mask per light ({', '.join(lights)}), of the frames' "
                f"{shape[1]} x {shape[0]} px; given are {len(mask_values)} ({', '.join(masks.names)}) of "
                f"{_size(mask_values)} px"
            )
        return masks
    if weights.method == "threshold":
        if weights.threshold == "auto":
            raise ConfigurationError('weights.threshold = "auto" is found from the frames of a test; state a number')
        return ThresholdWeights(threshold=weights.threshold, blur=weights.blur)
    if weights.method in ("statistics", "none"):
        return Statistics() if weights.method == "statistics" else ValidPixels()
    prepare = load_extension(LIGHT_WEIGHTS, weights.method, "weights.method")
    return prepare(settings, lights=lights, shape=shape, frames=frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidPixels:
    """Every valid pixel counts fully: no weighting. A `LightWeights`."""

    notes: ClassVar[Mapping[str, float]] = {}

    def reference(self, images: IlluminationImages) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics(ValidPixels):
    """Every valid pixel counts by what the residual around it shows. A `LightWeights` and a `PrecisionMethod`.

    Attributes
    ----------
    freedom
        Degrees of freedom of the Student distribution taken for the residual (Lange et al., J. Am. Stat. Assoc. 84,
        1989, who found 4 to work well). With 2 or 8 lights under a reflection differ by 3e-3 px at most, beside a gap
        by 5e-3, their uncertainty by 4 % (benchmarks/constants.py).
    independent_fraction
        Fraction of its variance that each light's residual is taken to have for itself. Chosen; with half or twice of
        it lights differ by 2e-4 px at most (benchmarks/constants.py).
    window
        In which variances are found.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic import measure_sequence
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(1, 80, 80)), (0, 1.5, 1.5))
    >>> states = [speckle, np.roll(speckle, 1, axis=2)]
    >>> solutions = measure_sequence(states, element_size=40, weights=Statistics(independent_fraction=0.2))
    >>> [solution.status.name for solution in solutions]
    ['CONVERGED', 'CONVERGED']
    """

    freedom: float = 4.0
    independent_fraction: float = 0.1
    window: SlidingWindow = WINDOW

    def precision(self, residual: Residual) -> Precision:
        """Weights of the lights' best mean around each pixel, from their residuals.

        Lights separated from one mosaic err together, for each is predicted from all the samples around; what one
        misses of a reflection's sparkle the others have too much. So the lights divide a weight as ``C^-1 1`` of the
        residuals' covariance C between them (generalised least squares), none below 0. The weight is the inverse
        variance of that mean's residual to the power .75, for it is itself uncertain, times the part of it that
        displaces: brightness and contrast that change slowly leave a residual which the gradient of the speckle
        averages out, blurred noise one that it does not. It holds whatever corrupts the mean there: camera noise,
        demosaicing, the erratic part of a reflection. Its unit is the median over the region. The rim, whose filtered
        grey levels hold some of what lies beyond the region, is judged by itself: beside a background at rest it hardly
        counts. The pixel's own factor is that of a Student distribution, so that dust or a fragment does not corrupt a
        node.

        Parameters
        ----------
        residual
            Of the pass before.

        Returns
        -------
        Precision
        """
        pixels, weights = residual.reference.pixels, residual.weights
        covariance = self.window.covariance(pixels, residual.difference, weights)
        lights = range(len(weights))
        typical = _typical(covariance[lights, lights])
        if typical <= 0:
            return Precision(factor=np.ones_like(weights), loss_curvature=np.ones_like(weights[0]))
        floor = np.float32(1e-6 * residual.contrast)  # where two images are the same no variance is 0
        factor = pixels.from_blocks(_best_fractions(covariance, floor, self.independent_fraction), self.window.step)
        rim, min_variance = residual.reference.rim, floor / len(factor)
        mean, bend, has_weight = np.empty_like(rim), np.empty_like(rim), np.empty((2, rim.size), dtype=np.float32)
        best_mean(factor, weights, residual.difference, rim, mean, has_weight)
        variance, rim_variance = (self.window.covariance(pixels, mean[None], part[None])[0] for part in has_weight)
        unit = max(np.float32(_typical(variance)), min_variance)
        variance, rim_variance = np.maximum((variance, rim_variance), min_variance)
        variance_map = pixels.from_blocks(variance, self.window.step)[0]
        # the rim shows another body: of the some 16 values of a window chance makes 4 times in 1 of 1e7
        differs = rim_variance > 4 * variance
        if differs.any():
            rim_map = pixels.from_blocks(np.where(differs, rim_variance, variance), self.window.step)[0]
            np.copyto(variance_map, rim_map, where=rim > 0)
        inner_weight, rim_weight = has_weight
        inner_weight += rim_weight
        inner_weight /= variance_map
        displacing = residual.design_effect(mean, inner_weight)
        robust_weights(mean, variance_map, displacing, unit, np.float32(self.freedom), factor, bend)
        return Precision(factor=factor, loss_curvature=bend)


def _typical(variance: FloatImage) -> float:
    """Median of a variance that is known on a grid (..., h, w), 0 where it is not; one in four shows it."""
    subsample = variance[..., ::2, ::2]
    positive = subsample[subsample > 0]
    return float(np.median(positive)) if positive.size else 0.0


def _best_fractions(covariance: FloatImage, min_variance: np.float32, independent_fraction: float) -> FloatImage:
    """Solve ``C x = 1`` for the lights' fractions (k, h, w) of the mean of least variance, up to a factor.

    C is the residuals' `covariance` (k, k, h, w), with variances of `min_variance` or more, of which each light has the
    fraction `independent_fraction` for itself.
    """
    lights = range(len(covariance))
    matrices = covariance.copy()
    matrices[lights, lights] = np.maximum(matrices[lights, lights], min_variance)
    for a, b in combinations(lights, 2):
        max_covariance = (1 - independent_fraction) * np.sqrt(matrices[a, a] * matrices[b, b])
        matrices[a, b] = matrices[b, a] = np.clip(
            (1 - independent_fraction) * matrices[a, b], -max_covariance, max_covariance
        )
    fractions: FloatImage = np.ones_like(matrices[0])
    # elimination on whole grids: ten times as fast as a LAPACK call for each block
    for a, b in combinations(lights, 2):
        ratio = matrices[b, a] / matrices[a, a]
        matrices[b, a + 1 :] -= ratio * matrices[a, a + 1 :]
        fractions[b] -= ratio * fractions[a]
    for a in reversed(lights):
        fractions[a] = (fractions[a] - (matrices[a, a + 1 :] * fractions[a + 1 :]).sum(axis=0)) / matrices[a, a]
    return np.asarray(fractions)
