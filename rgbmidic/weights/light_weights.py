"""How much each light counts at each pixel of every state of a test: one protocol for all methods (paper, section 3.2).

The weight of a pixel is the product of its weight in the reference image and in the deformed image at the place the
pixel has moved to; the solve brings the latter back.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import PrecisionMethod
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.frames import read_frame
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region
from rgbmidic.settings import TestSettings
from rgbmidic.typing import FloatImage
from rgbmidic.weights.statistics import Statistics, ValidPixels
from rgbmidic.weights.threshold import ThresholdWeights, automatic_weights

__all__ = ["LightWeights", "MaskWeights", "precision_method", "prepare_weights"]


class LightWeights(Protocol):
    """Weights (k, H, W) float32 in [0, 1] of every state of a test; 0 where an image is not valid.

    It may also have

    - ``notes``: numbers that were found out about the weights, by name, for the provenance;
    - ``describe()``: a text that says what they are; another text is another test, which `resume` refuses;
    - ``precision(residual)``: a factor on them, learnt from the residual (`rgbmidic.correlation.PrecisionMethod`).
    """

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Weights of the reference images."""
        ...

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Weights of the images of frame `index`."""
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
    """

    masks: npt.ArrayLike | Callable[[IlluminationImages], npt.ArrayLike]
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.masks):
            object.__setattr__(self, "masks", _fractions(self.masks))

    @classmethod
    def read(cls, paths: Sequence[Path]) -> MaskWeights:
        """Read one image per light.

        An image of one value besides 0 counts fully where it is not 0; one of several values counts by their fraction
        of the largest that its type has (255 in 8 bit, 65535 in 16 bit).

        Raises
        ------
        FrameError
            An image is missing or damaged, or has colours.
        InputError
            They have different sizes.
        """
        masks = list[FloatImage]()
        for path in paths:
            frame = read_frame(path, kind="monochrome")
            values, one = frame.values[0], frame.values.max(initial=0)
            plain = bool(((values == 0) | (values == one)).all())
            masks.append((values > 0 if plain else values / frame.white_level).astype(np.float32))
            if masks[-1].shape != masks[0].shape:
                raise InputError(
                    f"weights.images need one size: {path} has {_size(masks[-1])} px, {paths[0]} {_size(masks[0])}"
                )
        return cls(np.stack(masks), tuple(map(str, paths)))

    def describe(self) -> str:
        """Shape and checksum of the masks; the name of a function."""
        if callable(self.masks):
            return f"masks by {getattr(self.masks, '__qualname__', type(self.masks).__qualname__)}"
        masks = np.asarray(self.masks)
        return f"masks of shape {masks.shape}, {hashlib.sha256(masks.tobytes()).hexdigest()[:16]}"

    def reference(self, images: IlluminationImages) -> FloatImage:
        """The masks where the images are valid."""
        masks = _fractions(self.masks(images)) if callable(self.masks) else np.asarray(self.masks)
        (x, y), (height, width) = images.origin, images.shape
        part = masks if callable(self.masks) else masks[:, y : y + height, x : x + width]
        if part.shape != images.values.shape:
            told = f" ({', '.join(self.names)})" if self.names else ""
            raise InputError(
                f"there must be one mask per light ({', '.join(images.names)}), of the size of the frame; given are "
                f"{len(masks)} masks{told} of {_size(masks)} px, the images have {_size(images.values)} px"
            )
        return np.where(images.valid, part, np.float32(0))

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """The masks where the images are valid."""
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
    """What learns from the residual: the `weights`, or the statistics where `method` is that; None if nothing does."""
    if hasattr(weights, "precision"):
        return weights  # type: ignore[no-any-return]
    return Statistics() if method == "statistics" else None


def prepare_weights(
    settings: TestSettings,
    reference: IlluminationImages,
    region: Region,
    *,
    shape: tuple[int, int] | None = None,
    frames: int,
    images_of: Callable[[int], IlluminationImages],
) -> LightWeights:
    """The method of weighting that the settings name.

    Parameters
    ----------
    settings
        ``[weights]`` and what its method needs of the other sections.
    reference
        Images of the reference state.
    region
        What is measured.
    shape
        Rows and columns of the frames, of which the images may show a part; None: they show all.
    frames
        Number of frames of the test.
    images_of
        Gives the images of a frame; the automatic threshold looks at the first deformed one.

    Raises
    ------
    ConfigurationError
        The scene of the method ``"geometry"`` is not readable or not that of the test; the masks of the method
        ``"images"`` are not one per light or not of the size of the frames.
    FrameError
        A mask cannot be read.
    """
    weights = settings.weights
    if weights.method == "geometry":
        from rgbmidic.weights.geometry import GeometryWeights  # the scene, which no other method needs

        return GeometryWeights.prepare(settings, lights=reference.names, shape=shape or reference.shape, frames=frames)
    if weights.method == "images":
        masks = MaskWeights.read(weights.images)
        given, frame = np.asarray(masks.masks), shape or reference.shape
        if given.shape != (len(reference.names), *frame):
            raise ConfigurationError(
                f"weights.images must name one mask per light ({', '.join(reference.names)}), of the frames' "
                f"{frame[1]} x {frame[0]} px; given are {len(given)} ({', '.join(masks.names)}) of {_size(given)} px"
            )
        return masks
    if weights.method != "threshold":
        return Statistics() if weights.method == "statistics" else ValidPixels()
    if weights.threshold == "auto":
        return automatic_weights(settings, reference, region, frames=frames, images_of=images_of)
    return ThresholdWeights(threshold=weights.threshold, blur=weights.blur)
