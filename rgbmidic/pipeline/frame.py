"""One frame of a test to one record, whatever the frame is like.

read -> one image per light -> weights -> images of the solve -> displacement -> brightness of the lights -> its
uncertainty -> gaps filled -> record.
"""

from __future__ import annotations

import logging
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import machine
from rgbmidic.correlation import (
    Deformed,
    Solution,
    Status,
    TrackingState,
    discretisation_error,
    fill,
    unresolved_strain,
    with_one_sided_error,
)
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.errors import FrameError, RgbmidicError
from rgbmidic.frames.data import Window
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.separation import RawState, light_images
from rgbmidic.pipeline.frame_quality import (
    SUITABILITY,
    clipping,
    exposure_fault,
    saturated_fraction,
    too_small,
    unsteady,
)
from rgbmidic.pipeline.lamps import LEAST_GAIN, dimmed_lights
from rgbmidic.pipeline.plan import STRIDE, Plan
from rgbmidic.results import FrameRecord
from rgbmidic.timing import record_stages, stage
from rgbmidic.typing import FloatImage

logger = logging.getLogger(__name__)

ReferenceHistory = Sequence[tuple[int, Solution]] | ReferenceUpdate
"""Position and solution of the last frame that became the reference, all that it depends on; or the reference."""


def measure_frame(plan: Plan, index: int, start: TrackingState, updated: ReferenceHistory = ()) -> FrameRecord:
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
    updated
        Position, in the frames chosen, and solution of the last of ``start.reference_updates``, all that the reference
        depends on; or that reference.

    Returns
    -------
    FrameRecord

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic.settings import TestSettings
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> frames, region = {"path": [], "kind": "monochrome"}, {"rectangle": [0, 0, 79, 79]}
    >>> settings = TestSettings.from_mapping({"frames": frames, "region": region})
    >>> plan = Plan.from_settings(settings, source=np.stack([speckle, np.roll(speckle, 1, axis=1)]))
    >>> measure_frame(plan, 1, TrackingState(displacement=None)).status
    0
    """
    return measure_frame_safely(plan, plan.series.selected.index(index), start, updated)[0]


def measure_frame_safely(
    plan: Plan, position: int, start: TrackingState, updated: ReferenceHistory = ()
) -> tuple[FrameRecord, Solution | None]:
    """Measure the frame at a position in those chosen, as `measure_frame`; its solution is returned, too."""
    try:
        return solve_frame(plan, position, start, updated)
    except RgbmidicError as error:
        reason, unread = str(error), isinstance(error, _UnreadError)
    except Exception as error:  # whatever it is, the other frames can be measured
        reason, unread = f"unexpected error: {type(error).__name__}: {error}", False
        index = plan.series.selected[position]
        logger.exception("frame %d (%s) failed: %s", index, plan.series.name(index), reason)
    return failed_frame(plan, position, reason, unread=unread), None


def _reference_of(plan: Plan, updated: ReferenceHistory) -> ReferenceUpdate:
    """The reference that an update makes; the first without."""
    if isinstance(updated, ReferenceUpdate):
        return updated

    def make() -> ReferenceUpdate:
        reference_update = ReferenceUpdate.none(plan.reference)
        for position, solution in updated:
            reference_update = next_reference(plan, reference_update, position, solution)
        return reference_update

    return plan.process.reference_update(tuple(position for position, _ in updated), make)


def failed_frame(plan: Plan, position: int, reason: str, *, unread: bool = False) -> FrameRecord:
    """The record of a frame that could not be measured at all, or even not be read."""
    index, time_ns = plan.series.selected[position], None
    with suppress(FrameError):  # a movie that is gone tells no times
        time_ns = plan.series.time_ns(index)
    nodes, lights, number = len(plan.reference.mesh.nodes), len(plan.images.names), plan.series.numbers[index]
    return FrameRecord.failed(reason, nodes=nodes, lights=lights, number=number, time_ns=time_ns, unread=unread)


def messages(values: Mapping[str, Any]) -> list[str]:
    """Warnings of a frame of which ``status``, ``reason`` and ``warnings`` are kept, and how it ended if not well."""
    texts = list[str](map(str, values["warnings"]))
    if values["reason"]:
        end = "did not converge" if values["status"] == Status.NOT_CONVERGED else "cannot be measured"
        texts.append(f"{end}: {values['reason']}")
    return texts


class _UnreadError(FrameError):
    """A frame that cannot be read, at least now."""


def read_state(plan: Plan, index: int, window: Window | None = None) -> tuple[RawState, dict[str, str]]:
    """The raw frames of a state, or the part of them in a `window`, and path and fingerprint of their files.

    Raises
    ------
    FrameError
        They cannot be read.
    """
    try:
        with plan.process.reading:
            return plan.series.read(index, window), plan.series.inputs(index, window)
    except (FrameError, OSError) as error:
        raise _UnreadError(str(error)) from error


def solve_frame(
    plan: Plan, position: int, start: TrackingState, updated: ReferenceHistory
) -> tuple[FrameRecord, Solution]:
    """Measure a frame: its record, and its solution in full.

    Parameters
    ----------
    plan, position, start, updated
        As `measure_frame_safely`.

    Raises
    ------
    RgbmidicError
        The frame cannot be read or is not what the settings say.
    """
    settings, reference, index = plan.settings, plan.reference, plan.series.selected[position]
    if index in settings.frames.reference:
        start = replace(start, displacement=np.zeros_like(reference.mesh.nodes))
    with record_stages(plan.timings) as seconds:
        reference_update = _reference_of(plan, updated)
        window = plan.window_of(start.displacement, reference_update.displacement)
        reference_slices = plan.window.slices_in(window)
        with stage("reading"):
            state, inputs = read_state(plan, index, window)
        windowed_state = state
        if window != plan.window and not isinstance(state, IlluminationImages):
            windowed_state = tuple(replace(frame, values=frame.values[..., *reference_slices]) for frame in state)
        warnings = exposure_warnings(plan, windowed_state)
        with stage("separation"):
            images = light_images(plan.separation, state, window)
        if (len(images.values), *images.shape) != (len(reference.images), *window.shape):
            name = plan.series.name(index)
            raise FrameError(f"{name} has the shape {images.values.shape}, the reference {reference.images.shape}")
        with stage("preparation"):
            grey_levels, weights = plan.prepared(images, index)
            deformed = Deformed.prepare(grey_levels, weights, prefilter=settings.solver.prefilter, origin=window.origin)
            step = -(-max(plan.window.shape) // 256)  # of the pictures of weights and reflections, 256 px at most
            weights_thumbnail = _to_uint8(weights[:, *reference_slices][:, ::step, ::step])
            del grey_levels, weights  # a tenth of what a frame needs
        tracked = reference_update.track(deformed, start, settings.solver, plan.method)
        has_data = bool(tracked.measured.any())
        # of a frame without data the lamps are looked at as if it were at rest
        moved = tracked.displacement if has_data else np.zeros_like(tracked.displacement)
        brightness = plan.lamps.change(images.values, moved - reference.offset(deformed))
        dimmed = dimmed_lights(images.names, brightness)
        if tracked.status is not Status.CONVERGED:
            tracked = replace(tracked, reason="; ".join(_reasons(plan, windowed_state, dimmed, tracked)))
        solution = tracked
        if tracked.disagreement:
            warnings.append(tracked.disagreement)
        if has_data:
            with stage("conclusion"):
                solution = _with_mesh_error(plan, position, deformed, tracked)
                if unresolved := unresolved_strain(reference.mesh, tracked, solution):
                    warnings.append(unresolved)
            warnings += [
                f"{light} gives less than {LEAST_GAIN:.0%} of its light in the reference" for light, _ in dimmed
            ]
        match, best, becomes_reference = _compare_with_reference(
            plan, index, start, reference_update, deformed, solution
        )
        if becomes_reference:
            warnings.append("becomes the reference of those after it")
        warnings += _blur_warning(plan, position, start, solution)
        reflection, frame_checksum = images.reflection_index(step, reference_slices), checksum(windowed_state)
        filled = fill(reference.mesh, solution, settings.solver.fill) if settings.solver.fill else solution
    record = FrameRecord.from_solution(
        filled,
        number=plan.series.numbers[index],
        time_ns=plan.series.time_ns(index),
        warnings=warnings,
        inputs=inputs,
        machine=machine(),
        checksum=frame_checksum,
        match=match,
        best_match=best,
        reference_updates=(*start.reference_updates, *((position,) if becomes_reference else ())),
        brightness=brightness if has_data else np.full_like(brightness, np.nan),
        weights_thumbnail=weights_thumbnail,
        reflection_thumbnail=None if reflection is None else _to_uint8(reflection),
        seconds=list(seconds.values()) or None,
    )
    return record, filled


def _with_mesh_error(plan: Plan, position: int, deformed: Deformed, tracked: Solution) -> Solution:
    """Return the solution with the discretisation error that the settings ask for, else that of one side."""
    is_key_frame = position % STRIDE == 0 or position == len(plan.series.selected) - 1
    if plan.settings.mesh.error is True or (plan.settings.mesh.error == "key" and is_key_frame):
        return discretisation_error(plan.reference, deformed, tracked, plan.settings.solver, plan.method)
    return with_one_sided_error(plan.reference.mesh, tracked)


def checksum(state: RawState) -> int:
    """Return the CRC-32 of the samples of a state."""
    samples = (state,) if isinstance(state, IlluminationImages) else state
    return zlib.crc32(b"".join(frame.values.tobytes() for frame in samples))


def _reasons(plan: Plan, state: RawState, dimmed: Sequence[tuple[str, float]], solution: Solution) -> list[str]:
    """Return why a frame did not converge or cannot be measured, what may be the cause, and what to change.

    `state` is cut to the reference's window; `dimmed` are the lights whose lamp seems to fail.
    """
    if plan.reference_motion > SUITABILITY.blur:  # of the reference, whatever else a frame shows
        return [unsteady(plan.reference_motion)]
    causes = [fault] if (fault := exposure_fault(state, plan.region.mask)) else []
    causes += [
        f"{light} shows the speckle with {gain:.0%} of its contrast in the reference: look at lamp and exposure"
        for light, gain in dimmed
        if not fault
    ]
    if small := too_small(plan.element_size, plan.speckle):
        causes.append(small)
    if not causes and solution.status is Status.NOT_CONVERGED:
        causes = [f"larger elements (mesh.element_size, {plan.element_size:g} px) hold such nodes"]
        if solution.iterations >= plan.settings.solver.max_iterations:
            causes = [f"solver.max_iterations is {plan.settings.solver.max_iterations}: allow more, or {causes[0]}"]
    return [solution.reason, *causes]


def next_reference(plan: Plan, before: ReferenceUpdate, position: int, solution: Solution) -> ReferenceUpdate:
    """The reference that the frame at a position becomes, measured with `solution` on the reference `before`.

    Raises
    ------
    RgbmidicError
        The frame cannot be read, or no element of it is measured.
    """
    window = plan.window_of(solution.displacement[plan.reference.mesh.nearest_nodes(solution.measured)[1]])
    return before.updated(solution, *prepared_frame(plan, plan.series.selected[position], window), window.origin)


def prepared_frame(plan: Plan, index: int, window: Window) -> tuple[FloatImage, FloatImage]:
    """Grey levels and weights of a window of a frame, (k, H, W) each, see `Plan.prepared`."""
    state, _ = read_state(plan, index, window)
    return plan.prepared(light_images(plan.separation, state, window), index)


def _compare_with_reference(
    plan: Plan,
    index: int,
    start: TrackingState,
    reference_update: ReferenceUpdate,
    deformed: Deformed,
    solution: Solution,
) -> tuple[float, float, bool]:
    """Return how well a frame matches its reference, the best match up to it, and whether it becomes the reference."""
    if not (plan.settings.frames.update_reference and solution.measured.any()):
        return float("nan"), start.best_match, False
    match = reference_update.match(deformed, solution)
    median = float(np.nanmedian(match)) if np.isfinite(match).any() else float("nan")
    best = float(np.fmax(start.best_match, np.float32(median)))
    is_due = index not in plan.settings.frames.reference and reference_update.is_due(match, best)
    return median, 0.0 if is_due else best, is_due


def exposure_warnings(plan: Plan, state: RawState) -> list[str]:
    """Return what is doubtful about the exposure of a frame that is cut to the reference's window, a text each.

    They have no figures of the frame, so that one line says it of many frames.
    """
    warnings, max_saturated = list[str](), plan.saturated + SUITABILITY.saturated
    if saturated_fraction(state, plan.region.mask) > max_saturated:
        warnings.append(
            f"more than {max_saturated:.0%} of the samples in the region are saturated, {plan.saturated:.0%} in the "
            "reference: look at the exposure"
        )
    if plan.clipped_at is None and (pile_up := clipping(state)):
        warnings.append(pile_up[1])
    return warnings


def _blur_warning(plan: Plan, position: int, start: TrackingState, solution: Solution) -> list[str]:
    """Warn of motion blur: of a frame that starts from the one before it, which is known to be exposed for how long."""
    if (
        position % STRIDE == 0  # a key frame
        or start.displacement is None
        or not solution.measured.any()
        or not plan.exposure
    ):
        return []
    before, index = plan.series.selected[position - 1], plan.series.selected[position]
    times = [plan.series.time_ns(number) for number in (before, index)]
    rate = plan.settings.scale.frame_rate or plan.series.recording.frame_rate
    if None not in times:
        seconds = 1e-9 * float(np.diff(np.array(times, dtype=np.int64))[0])
    else:
        seconds = (plan.series.numbers[index] - plan.series.numbers[before]) / rate if rate else 0.0
    distances = np.hypot(*(solution.displacement - start.displacement)[solution.measured].T)
    if seconds <= 0 or plan.exposure / seconds * float(np.quantile(distances, 0.95)) <= SUITABILITY.blur:
        return []
    exposed = f"while it is exposed ({1e6 * plan.exposure:g} µs)"
    return [f"motion blur: the specimen moves by more than {SUITABILITY.blur:g} px {exposed}"]


def _to_uint8(fractions: FloatImage) -> npt.NDArray[np.uint8]:
    return np.round(fractions * 255).astype(np.uint8)
