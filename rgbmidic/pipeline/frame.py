"""One frame of a test to one record, whatever the frame is like.

read -> one image per light -> weights -> images of the solve -> displacement and its uncertainty -> gaps filled ->
brightness of the lights -> record.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import Deformed, Solution, Start, Status
from rgbmidic.correlation.light_levels import brightness_change
from rgbmidic.correlation.renewal import Renewal
from rgbmidic.errors import FrameError, RgbmidicError
from rgbmidic.fields import fill
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.raw_samples import exposure_fault
from rgbmidic.pipeline.separation import correlated
from rgbmidic.results import FrameRecord
from rgbmidic.timing import stage, timed
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["failed_frame", "measure_frame"]

logger = logging.getLogger(__name__)

_THUMBNAIL = 256
"""Longest side in px of the picture of the weights that is kept of every frame."""
_DARK = 0.3
"""Share of its light in the reference under which a light is told to be failing."""


def measure_frame(plan: Plan, index: int, start: Start, renewed: Sequence[tuple[int, Solution]] = ()) -> FrameRecord:
    """Measure one frame of a test.

    A frame that cannot be read or measured gives a record with the reason, an error that is not one of rgbmidic's own
    included, whose traceback goes to the log.

    Parameters
    ----------
    plan
        What all frames share.
    index
        Which frame of the series.
    start
        From where its displacement is looked for; a frame of the reference starts from rest.
    renewed
        Index and solution of the last two of ``start.renewals``: all that the reference depends on that they make.
    """
    try:
        with timed(plan.timings) as seconds:
            values = _measure(plan, index, start, _renewal(plan, renewed))
        return FrameRecord.from_solution(**values, seconds=list(seconds.values()) or None)
    except RgbmidicError as error:
        reason = str(error)
        logger.warning("frame %d (%s) failed: %s", index, plan.series.name(index), reason)
    except Exception as error:  # whatever it is, the other frames can be measured
        reason = f"unexpected error: {type(error).__name__}: {error}"
        logger.exception("frame %d (%s) failed: %s", index, plan.series.name(index), reason)
    return failed_frame(plan, index, reason)


def failed_frame(plan: Plan, index: int, reason: str) -> FrameRecord:
    """The record of a frame that could not be measured at all."""
    return FrameRecord.failed(
        reason,
        nodes=len(plan.reference.mesh.nodes),
        lights=len(plan.images.names),
        number=plan.series.numbers[index],
        time_ns=plan.series.time_ns(index),
    )


def _measure(plan: Plan, index: int, start: Start, renewal: Renewal) -> dict[str, Any]:
    """What `FrameRecord.from_solution` is given."""
    settings, reference, name = plan.settings, plan.reference, plan.series.name(index)
    if index in settings.frames.reference:
        start = replace(start, displacement=np.zeros_like(reference.mesh.nodes))
    window = plan.window_of(start.displacement, renewal.displacement)
    here = plan.window.part_of(window)
    with stage("reading"):
        state = plan.series.read(index, window)
    with stage("separation"):
        images = plan.separation(state, window)
    if (len(images.values), *images.shape) != (len(reference.images), *window.shape):
        raise FrameError(f"{name} has the shape {images.values.shape}, the reference {reference.images.shape}")
    with stage("preparation"):
        weights, ready = plan.weights.deformed(images, index), correlated(images, settings.illumination)
        deformed = Deformed.prepare(ready, weights, prefilter=settings.solver.prefilter, origin=window.origin)
    statistics = settings.weights.method == "statistics"
    solution = renewal.track(deformed, start, settings.solver, statistics=statistics)
    if solution.status is Status.FAILED:
        there = tuple(replace(frame, values=frame.values[..., *here]) for frame in state)
        if fault := exposure_fault(there, plan.region.mask):
            solution = replace(solution, reason=f"{fault} ({solution.reason})")
        logger.warning("frame %d (%s) cannot be measured: %s", index, name, solution.reason)
    kept = fill(reference.mesh, solution, settings.solver.fill) if settings.solver.fill else solution
    moved = solution.displacement - reference.offset(deformed)
    brightness = brightness_change(plan.images.values, images.values, reference, moved)
    _tell_dark(name, images.names, brightness)
    match, best, renewals = _compared(plan, index, start, renewal, deformed, solution)
    step = -(-max(plan.window.shape) // _THUMBNAIL)
    reflection = images.reflection_index(step, here)
    return {
        "solution": kept,
        "number": plan.series.numbers[index],
        "time_ns": plan.series.time_ns(index),
        "brightness": brightness,
        "match": match,
        "best_match": best,
        "renewals": renewals,
        "weights_thumbnail": _in_bytes(weights[:, *here][:, ::step, ::step]),
        "reflection_thumbnail": None if reflection is None else _in_bytes(reflection),
        "inputs": plan.series.inputs(index, window),
    }


_Known = tuple[Plan, tuple[int, ...], Renewal]
_known: deque[_Known] = deque(maxlen=2)
"""References that later frames have become in this process: the last two."""


def _renewal(plan: Plan, renewed: Sequence[tuple[int, Solution]]) -> Renewal:
    """The reference that the frames `renewed` make in turn."""
    indices = tuple(index for index, _ in renewed)
    for known, frames, renewal in _known:
        if known is plan and frames == indices:
            return renewal
    renewal = Renewal.none(plan.reference)
    for index, solution in renewed:
        window = plan.window_of(solution.displacement[plan.reference.mesh.nearest(solution.measured)[1]])
        images = plan.separation(plan.series.read(index, window), window)
        weights = plan.weights.deformed(images, index)
        ready = correlated(images, plan.settings.illumination)
        renewal = renewal.renewed(solution, ready, weights, window.origin)
    _known.append((plan, indices, renewal))
    return renewal


def _compared(
    plan: Plan, index: int, start: Start, renewal: Renewal, deformed: Deformed, solution: Solution
) -> tuple[float, float, tuple[int, ...]]:
    """How well a frame matches its reference, the best match of the frames on it, and who follows as the reference."""
    if not (plan.settings.frames.renew and solution.measured.any()):
        return float("nan"), start.best_match, start.renewals
    match = renewal.match(deformed, solution)
    median = float(np.nanmedian(match)) if np.isfinite(match).any() else float("nan")
    best = float(np.fmax(start.best_match, np.float32(median)))
    if index in plan.settings.frames.reference or not renewal.is_due(match, best):
        return median, best, start.renewals
    logger.warning("frame %d (%s) becomes the reference of those after it", index, plan.series.name(index))
    return median, 0.0, (*start.renewals, plan.series.chosen.index(index))


def _tell_dark(name: str, lights: tuple[str, ...], brightness: FloatArray) -> None:
    for light, gain in zip(lights, brightness[:, 0], strict=True):
        if gain < _DARK:
            logger.warning("%s: %s gives %.0f %% of its light in the reference", name, light, 100 * gain)


def _in_bytes(shares: FloatImage) -> npt.NDArray[np.uint8]:
    return np.round(shares * 255).astype(np.uint8)
