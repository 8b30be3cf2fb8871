"""One state of the paper's experiment measured with one method."""

from __future__ import annotations

import numpy as np

from rgbmidic.correlation import NodeStatus
from rgbmidic.fields import at_pixels, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.lab.study.bench import Bench
from rgbmidic.lab.study.competitors import Competitor
from rgbmidic.lab.study.perturbation import area_means, area_stds, residual_percent
from rgbmidic.lab.study.results import Measurement
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.threshold import threshold_weights

__all__ = ["field_at_pixels", "measure_state"]


def measure_state(
    competitor: Competitor,
    reference: IlluminationImages,
    images: IlluminationImages,
    bench: Bench,
    truth: FloatArray,
) -> tuple[Measurement, FloatImage]:
    """Measure one state with one method.

    Parameters
    ----------
    competitor
        The method, prepared with `reference`.
    reference, images
        Reference and state.
    bench
        The scene, with its areas.
    truth : ndarray, shape (2, H, W)
        Exact displacement.

    Returns
    -------
    tuple
        The measurement, and the displacement (2, H, W) at the pixels.
    """
    field, measured, status = field_at_pixels(competitor, images)
    none = np.full(len(bench.areas), np.nan)
    perturbation = error = none
    if np.isfinite(field[1]).sum() > 10:
        ripple = high_pass(field[1])
        perturbation = area_stds(ripple, bench.areas)
        error = area_stds(high_pass(field[1] - truth[1]), bench.areas)
        residual = np.mean(
            [
                residual_percent(reference.values[i], images.values[i], np.asarray(field, dtype=np.float64))
                for i in competitor.lights
            ]
        )
        frontier = _frontier(ripple, competitor, images)
    else:
        residual, frontier = np.float64(np.nan), float("nan")
    measurement = Measurement(
        perturbation=perturbation,
        error=error,
        mean=np.stack([area_means(part, bench.areas) for part in field]),
        residual=float(residual),
        measured=measured,
        frontier=frontier,
        status=status,
    )
    return measurement, field


def field_at_pixels(competitor: Competitor, images: IlluminationImages) -> tuple[FloatImage, float, str]:
    """Displacement at the pixels, share of the nodes measured, and how the solve ended."""
    solution = competitor.measure(images)
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    field = at_pixels(mesh, solution.displacement, images.shape)
    return field, float((solution.node_status == NodeStatus.MEASURED).mean()), solution.status.name.lower()


def _frontier(ripple: FloatArray, competitor: Competitor, images: IlluminationImages) -> float:
    """P within an element of the masks' frontiers, over P beside it: on the side where it is larger.

    On either side of a frontier other lights are seen, and fewer lights give more noise; a band that the frontier
    itself disturbs is worse than both. The mask of the deformed state is taken where it is, within a few px of where
    the displacement brings it.
    """
    import cv2

    if competitor.threshold is None:
        return float("nan")
    after = threshold_weights(images, threshold=competitor.threshold, blur=competitor.blur)
    masks = ((competitor.reference.weights > 0) & (after > 0)).astype(np.uint8)
    edge = np.zeros(images.shape, dtype=np.uint8)
    for mask in masks:
        edge |= np.asarray(cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)), dtype=np.uint8)
    distance = cv2.distanceTransform(1 - edge, cv2.DIST_L2, 5) if edge.any() else np.full(images.shape, np.inf)
    known = np.isfinite(ripple)
    beside = known & (distance > ELEMENT_SIZE) & (distance <= 3 * ELEMENT_SIZE)
    sides = [beside & (masks.sum(axis=0) == count) for count in range(len(masks) + 1)]
    level = max(
        (float((ripple[side] ** 2).mean()) for side in sides if side.sum() >= 20 * ELEMENT_SIZE**2), default=0.0
    )
    band = known & (distance <= ELEMENT_SIZE)
    if level == 0 or band.sum() < 20 * ELEMENT_SIZE**2:
        return float("nan")
    return float(np.sqrt((ripple[band] ** 2).mean() / level))
