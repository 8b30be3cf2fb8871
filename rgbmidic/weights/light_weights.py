"""How much each light counts at each pixel of every state of a test: one protocol for all methods (paper, section 3.2).

The weight of a pixel is the product of its weight in the reference image and in the deformed image at the place the
pixel has moved to; the solve brings the latter back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region
from rgbmidic.settings import TestSettings
from rgbmidic.typing import FloatImage
from rgbmidic.weights.geometry import GeometryWeights
from rgbmidic.weights.threshold import ThresholdWeights, automatic_weights

__all__ = ["LightWeights", "ValidPixels", "prepare_weights"]


class LightWeights(Protocol):
    """Weights (k, H, W) float32 in [0, 1] of every state of a test; 0 where an image is not valid."""

    @property
    def notes(self) -> Mapping[str, float]:
        """What was found out about the weights, for the provenance."""
        ...

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Weights of the reference images."""
        ...

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Weights of the images of frame `index`."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ValidPixels:
    """Every valid pixel counts fully: for weights by statistics, which come from the residual in the solve, and none.

    A `LightWeights`.
    """

    notes: ClassVar[Mapping[str, float]] = {}

    def reference(self, images: IlluminationImages) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """1 where an image is valid."""
        return images.valid.astype(np.float32)


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
        The scene of the method ``"geometry"`` is not readable or not that of the test.
    """
    weights = settings.weights
    if weights.method == "geometry":
        return GeometryWeights.prepare(settings, lights=reference.names, shape=shape or reference.shape, frames=frames)
    if weights.method != "threshold":
        return ValidPixels()
    if weights.threshold == "auto":
        return automatic_weights(settings, reference, region, frames=frames, images_of=images_of)
    return ThresholdWeights(threshold=weights.threshold, blur=weights.blur)
