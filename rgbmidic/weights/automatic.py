"""The weighting threshold of a test, found from its own first deformed frame (paper, section 3.2).

Every light is first correlated alone and without weights. Where its reflection disturbs the displacement, the grey
level on the contour of the disturbed zone becomes the threshold of all lights and frames. The paper looks at one light;
here the one whose reflection disturbs most is taken, as the others' may lie outside the region.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rgbmidic.correlation import Status, correlate
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import at_pixels, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.settings import ELEMENT_SIZE, TestSettings
from rgbmidic.typing import FloatImage
from rgbmidic.weights.disturbed_zone import SetUpThreshold, set_up_threshold
from rgbmidic.weights.threshold import ThresholdWeights, blurred

__all__ = ["FALLBACK", "automatic_threshold", "automatic_weights"]

logger = logging.getLogger(__name__)

FALLBACK = 2 / 3
"""Threshold where no reflection disturbs the first deformed frame: the paper's."""


def automatic_weights(
    settings: TestSettings,
    reference: IlluminationImages,
    region: Region,
    *,
    frames: int,
    images_of: Callable[[int], IlluminationImages],
) -> ThresholdWeights:
    """Weights by the threshold that the first deformed frame shows, else by the paper's; the log says which.

    Parameters as in `rgbmidic.weights.prepare_weights`.
    """
    blur, found, why = settings.weights.blur, None, "there is no deformed frame"
    measured = range(settings.frames.first, frames, settings.frames.step)
    index = next((i for i in measured if i not in settings.frames.reference), None)
    if index is not None:
        why = f"no disturbed zone in frame {index}"
        size, prefilter = settings.element_size, settings.solver.prefilter
        try:
            deformed = images_of(index)
            found = automatic_threshold(reference, deformed, region, blur=blur, element_size=size, prefilter=prefilter)
        except RgbmidicError as error:
            why = f"frame {index} cannot be used: {error}"
    value = FALLBACK if found is None else found.value
    if found is None:
        logger.warning('weights.threshold = "auto": %s; the threshold is %.3g of the dynamic range', why, value)
    else:
        place = found.zone.radius, found.zone.centre, index
        logger.info("threshold %.3f: disturbed zone of radius %.0f px around %s in frame %d", value, *place)
    return ThresholdWeights(threshold=value, blur=blur, notes={"weights_threshold": value})


def automatic_threshold(
    reference: IlluminationImages,
    deformed: IlluminationImages,
    region: Region,
    *,
    blur: float = 10.0,
    element_size: float = ELEMENT_SIZE,
    prefilter: str = "binomial",
) -> SetUpThreshold | None:
    """Threshold from the reference and one deformed state, or None where no light's reflection disturbs.

    A threshold that would exclude more than half of any light's image is not taken: without the margin below the
    contour if that helps, else not at all, as the reflection is not told from the rest by its brightness.

    Parameters
    ----------
    reference, deformed
        Illumination images of the two states.
    region
        What is measured.
    blur
        Standard deviation (px) of the blur that the weights will use.
    element_size
        px.
    prefilter
        Of the correlation; a Bayer mosaic needs ``"binomial"``.
    """
    found = []
    typical = float(np.median(blurred(reference, blur)[:, region.mask], axis=1).max()) / reference.full_scale
    for light, name in enumerate(reference.names):
        for component, field in _displacement(reference, deformed, region, light, element_size, prefilter):
            try:
                threshold = set_up_threshold(high_pass(field), reference, light=light, blur=blur)
            except InputError as error:
                logger.info("%s alone, without weights, %s: %s", name, component, error)
                continue
            values = [value for value in (threshold.value, threshold.contour) if typical < value <= 1]
            if not values:
                logger.info("%s alone, %s: the disturbed zone is not brighter than the rest", name, component)
                continue
            found.append(replace(threshold, value=values[0]))
    return max(found, key=lambda threshold: threshold.zone.contrast, default=None)


def _displacement(
    reference: IlluminationImages,
    deformed: IlluminationImages,
    region: Region,
    light: int,
    element_size: float,
    prefilter: str,
) -> list[tuple[str, FloatImage]]:
    """u and v (H, W) of one light alone, without weights; the smaller of the two shows a disturbance best."""
    solution = correlate(
        reference.values[light],
        deformed.values[light],
        region=region,
        element_size=element_size,
        prefilter=prefilter,
        statistics=False,
    )
    if solution.status is Status.FAILED:
        logger.info("%s alone, without weights: %s", reference.names[light], solution.reason)
        return []
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    fields = at_pixels(mesh, solution.displacement, reference.shape)
    return list(zip("uv", fields, strict=True))
