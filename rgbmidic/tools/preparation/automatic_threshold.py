"""The threshold that a test finds from its own frames, ``weights.threshold = "auto"`` (paper, section 3.2).

Every light is correlated alone, without weights, with its own first deformed frame; `set_up_threshold` finds what its
reflection disturbs. The paper looks at one light; here the one whose reflection disturbs most is taken, as the others'
may lie outside the region.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rgbmidic.correlation import Deformed, Reference, Status, TrackingState, track
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import at_pixels, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.settings import ELEMENT_SIZE, SolverSettings, TestSettings
from rgbmidic.weights.threshold import FALLBACK, SetUpThreshold, ThresholdWeights, blurred, set_up_threshold

logger = logging.getLogger(__name__)


def automatic_weights(
    settings: TestSettings,
    reference: IlluminationImages,
    region: Region,
    *,
    frames: int,
    images_of: Callable[[int], IlluminationImages],
) -> ThresholdWeights:
    """Weights by the threshold that the first deformed frame shows, else by the paper's; the log says which.

    Parameters
    ----------
    settings
        ``weights.blur`` and what the measurement needs of the other sections.
    reference
        Images of the reference state.
    region
        What is measured.
    frames
        Number of frames of the test.
    images_of
        Gives the images of a frame; the first deformed one is read.
    """
    blur, threshold, reason = settings.weights.blur, None, "there is no deformed frame"
    measured = range(settings.frames.first, frames, settings.frames.step)
    index = next((i for i in measured if i not in settings.frames.reference), None)
    if index is not None:
        reason = f"no disturbed zone in frame {index}"
        size, prefilter = settings.mesh.side, settings.solver.prefilter
        try:
            deformed = images_of(index)
            threshold = automatic_threshold(
                reference, deformed, region, blur=blur, element_size=size, prefilter=prefilter
            )
        except RgbmidicError as error:
            reason = f"frame {index} cannot be used: {error}"
    value = FALLBACK if threshold is None else threshold.value
    if threshold is None:
        logger.warning('weights.threshold = "auto": %s; the threshold is %.3g of the dynamic range', reason, value)
    else:
        zone_values = threshold.zone.radius, threshold.zone.centre, index
        logger.info("threshold %.3f: disturbed zone of radius %.0f px around %s in frame %d", value, *zone_values)
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
    mesh, thresholds = Tri3Mesh.from_region(region, element_size), list[SetUpThreshold]()
    typical = float(np.median(blurred(reference, blur)[:, region.mask], axis=1).max()) / reference.full_scale
    for light, name in enumerate(reference.names):
        reference_state = Reference.prepare(
            reference.values[light : light + 1], region, mesh=mesh, prefilter=prefilter, brightness="none"
        )
        deformed_state = Deformed.prepare(deformed.values[light : light + 1], prefilter=prefilter)
        solution = track(reference_state, deformed_state, TrackingState(displacement=None), SolverSettings(), None)
        if solution.status is Status.FAILED:
            logger.info("%s alone, without weights: %s", name, solution.reason)
            continue
        # of u and v the smaller shows a disturbance best
        for component, displacement in zip("uv", at_pixels(mesh, solution.displacement, reference.shape), strict=True):
            try:
                ripple = high_pass(displacement)
                threshold = set_up_threshold(ripple, reference, light=light, blur=blur, element_size=element_size)
            except InputError as error:
                logger.info("%s alone, without weights, %s: %s", name, component, error)
                continue
            values = [value for value in (threshold.value, threshold.contour) if typical < value <= 1]
            if values:
                thresholds.append(replace(threshold, value=values[0]))
            else:
                logger.info("%s alone, %s: the disturbed zone is not brighter than the rest", name, component)
    return max(thresholds, key=lambda threshold: threshold.zone.contrast, default=None)
