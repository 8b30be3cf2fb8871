"""One frame of a test to one record, whatever the frame is like.

read -> one image per light -> weights -> images of the solve -> displacement and its uncertainty -> gaps filled ->
brightness of the lights -> record. `correlate` is the same for one pair of states, arrays in and out.
"""

from __future__ import annotations

import ctypes
import logging
import zlib
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import aside, machine
from rgbmidic.correlation import (
    Deformed,
    PrecisionMethod,
    Reference,
    Solution,
    Start,
    Status,
    discretisation_error,
    fill,
    solve,
    track,
)
from rgbmidic.correlation.images import as_light_stack
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.residual import brightness_change
from rgbmidic.errors import ConfigurationError, FrameError, InputError, RgbmidicError
from rgbmidic.frames.data import Window
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.images import normalise as divide_by_local_mean
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.plan import SATURATED, Plan, exposure_fault, saturated_fraction, too_small
from rgbmidic.pipeline.source import RawState, correlated
from rgbmidic.results import FrameRecord
from rgbmidic.settings import ELEMENT_SIZE, SolverSettings, check_names, grey_levels
from rgbmidic.timing import stage, timed
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights import Statistics, as_weights, precision_method

logger = logging.getLogger(__name__)

STRIDE = 16
"""Frames from one key frame to the next: so many workers are kept busy by one chain of key frames."""
_THUMBNAIL = 256
"""Longest side in px of the picture of the weights that is kept of every frame."""
_DARK = 0.3
"""Share of its light in the reference under which a light is told to be failing."""


def measure_frame(plan: Plan, index: int, start: Start, updated: Sequence[tuple[int, Solution]] = ()) -> FrameRecord:
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
        Index and solution of the last two of ``start.reference_updates``: all that the reference they make depends on.
    """
    _keep_memory()
    try:
        with timed(plan.timings) as seconds:
            values = solve_frame(plan, index, start, _updated_reference(plan, updated))
        return FrameRecord.from_solution(**values, seconds=list(seconds.values()) or None)
    except RgbmidicError as error:
        reason, unread = str(error), isinstance(error, _UnreadError)
        logger.warning("frame %d (%s) failed: %s", index, plan.series.name(index), reason)
    except Exception as error:  # whatever it is, the other frames can be measured
        reason, unread = f"unexpected error: {type(error).__name__}: {error}", False
        logger.exception("frame %d (%s) failed: %s", index, plan.series.name(index), reason)
    return failed_frame(plan, index, reason, unread=unread)


@cache
def _keep_memory() -> None:
    """Have glibc keep what a frame gives back for the next one: arrays of up to 1 GiB are no longer mapped anew.

    Pages that the system fills with zeros first took 3 to 8 % of the CPU time of a raw frame of 1 Mpx, and 26 % of one
    of 4 Mpx, whose arrays exceed the 32 MB up to which glibc learns to keep them (measured).
    """
    with suppress(OSError, AttributeError, TypeError):  # another C library
        mallopt = ctypes.CDLL(None).mallopt
        for parameter in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD (malloc.h)
            mallopt(parameter, 2**30)


def failed_frame(plan: Plan, index: int, reason: str, *, unread: bool = False) -> FrameRecord:
    """The record of a frame that could not be measured at all, or even not be read."""
    time_ns = None
    with suppress(FrameError):  # a movie that is gone tells no times
        time_ns = plan.series.time_ns(index)
    return FrameRecord.failed(
        reason,
        nodes=len(plan.reference.mesh.nodes),
        lights=len(plan.images.names),
        number=plan.series.numbers[index],
        time_ns=time_ns,
        unread=unread,
    )


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
        return plan.series.read(index, window), plan.series.inputs(index, window)
    except (FrameError, OSError) as error:
        raise _UnreadError(str(error)) from error


def solve_frame(plan: Plan, index: int, start: Start, reference_update: ReferenceUpdate) -> dict[str, Any]:
    """What `FrameRecord.from_solution` is given: the ``solution`` of a frame, and what else its record holds.

    Parameters
    ----------
    plan, index, start
        As `measure_frame`.
    reference_update
        The reference that ``start.reference_updates`` make.

    Raises
    ------
    RgbmidicError
        The frame cannot be read or is not what the settings say.
    """
    settings, reference, name = plan.settings, plan.reference, plan.series.name(index)
    if index in settings.frames.reference:
        start = replace(start, displacement=np.zeros_like(reference.mesh.nodes))
    window = plan.window_of(start.displacement, reference_update.displacement)
    here = plan.window.part_of(window)
    with stage("reading"):
        state, inputs = read_state(plan, index, window)
    there = state
    if not isinstance(state, IlluminationImages):
        there = tuple(replace(frame, values=frame.values[..., *here]) for frame in state)
    if (share := saturated_fraction(there, plan.region.mask)) > plan.saturated + SATURATED:
        words = "%s: %.0f %% of the samples in the region are saturated, %.0f %% in the reference: look at the exposure"
        logger.warning(words, name, 100 * share, 100 * plan.saturated)
    with stage("separation"):
        images = plan.lights(state, window)
    if (len(images.values), *images.shape) != (len(reference.images), *window.shape):
        raise FrameError(f"{name} has the shape {images.values.shape}, the reference {reference.images.shape}")
    with stage("preparation"):
        weights, ready = plan.frame_weights(images, index), correlated(images, plan.normalise)
        deformed = Deformed.prepare(ready, weights, prefilter=plan.solver.prefilter, origin=window.origin)
        step = -(-max(plan.window.shape) // _THUMBNAIL)
        thumbnail = _in_bytes(weights[:, *here][:, ::step, ::step])
        del weights, ready  # a tenth of what a frame needs
    method = precision_method(plan.weights, settings.weights.method)
    solution = reference_update.track(deformed, start, plan.solver, method)
    if solution.status is not Status.CONVERGED:
        causes = _causes(plan, there, images, reference.offset(deformed), solution)
        solution = replace(solution, reason="; ".join([solution.reason, *causes]))
        end = "cannot be measured" if solution.status is Status.FAILED else "did not converge"
        logger.warning("frame %d (%s) %s: %s", index, name, end, solution.reason)
    if _asks_for_error(plan, index) and solution.measured.any():
        with stage("conclusion"):
            solution = discretisation_error(reference, deformed, solution, plan.solver, method)
    kept = fill(reference.mesh, solution, settings.solver.fill) if settings.solver.fill else solution
    moved = solution.displacement - reference.offset(deformed)
    brightness = brightness_change(plan.images.values, images.values, reference, moved)
    _tell_dark(name, images.names, brightness)
    match, best, reference_updates = _compared(plan, index, start, reference_update, deformed, solution)
    reflection = images.reflection_index(step, here)
    samples = (there,) if isinstance(there, IlluminationImages) else there
    return {
        "solution": kept,
        "number": plan.series.numbers[index],
        "time_ns": plan.series.time_ns(index),
        "brightness": brightness,
        "match": match,
        "best_match": best,
        "reference_updates": reference_updates,
        "weights_thumbnail": thumbnail,
        "reflection_thumbnail": None if reflection is None else _in_bytes(reflection),
        "inputs": inputs,
        "machine": machine(),
        "checksum": zlib.crc32(b"".join(one.values.tobytes() for one in samples)),
    }


def _asks_for_error(plan: Plan, index: int) -> bool:
    """Whether the settings ask for the discretisation error of a frame."""
    asked, place = plan.settings.mesh_error, plan.series.chosen.index(index)
    return asked is True or (asked == "key" and (place % STRIDE == 0 or place == len(plan.series.chosen) - 1))


def _causes(
    plan: Plan, state: RawState, images: IlluminationImages, offset: FloatArray, solution: Solution
) -> list[str]:
    """What may be why a frame did not converge or cannot be measured, and what to change.

    `state` is cut to the reference's window, which begins at `offset` (x, y) in the `images`' own.
    """
    causes = [fault] if (fault := exposure_fault(state, plan.region.mask)) else []
    there = np.where(np.isfinite(solution.displacement), solution.displacement, 0) - offset
    gains = brightness_change(plan.images.values, images.values, plan.reference, there)[:, 0]
    causes += [
        f"{light} shows the speckle with {gain:.0%} of its contrast in the reference: look at lamp and exposure"
        for light, gain in zip(images.names, gains, strict=True)
        if gain < _DARK and not fault
    ]
    if small := too_small(plan.element_size, plan.speckle):
        causes.append(small)
    if not causes and solution.status is Status.NOT_CONVERGED:
        causes = [f"larger elements (mesh.element_size, {plan.element_size:g} px) hold such nodes"]
        if solution.iterations >= plan.settings.solver.max_iterations:
            causes = [f"solver.max_iterations is {plan.settings.solver.max_iterations}: allow more, or {causes[0]}"]
    return causes


def next_reference(plan: Plan, before: ReferenceUpdate, index: int, solution: Solution) -> ReferenceUpdate:
    """The reference that frame `index` becomes, measured with `solution` on the reference `before`.

    Raises
    ------
    RgbmidicError
        The frame cannot be read, or no element of it is measured.
    """
    window = plan.window_of(solution.displacement[plan.reference.mesh.nearest(solution.measured)[1]])
    images = plan.lights(read_state(plan, index, window)[0], window)
    ready = correlated(images, plan.normalise)
    return before.updated(solution, ready, plan.frame_weights(images, index), window.origin)


def _updated_reference(plan: Plan, updated: Sequence[tuple[int, Solution]]) -> ReferenceUpdate:
    """The reference that the frames `updated` make in turn."""

    def make() -> ReferenceUpdate:
        reference_update = ReferenceUpdate.none(plan.reference)
        for index, solution in updated:
            reference_update = next_reference(plan, reference_update, index, solution)
        return reference_update

    return plan.updates.get(tuple(index for index, _ in updated), make)


def _compared(
    plan: Plan, index: int, start: Start, reference_update: ReferenceUpdate, deformed: Deformed, solution: Solution
) -> tuple[float, float, tuple[int, ...]]:
    """How well a frame matches its reference, the best match of the frames on it, and who follows as the reference."""
    if not (plan.settings.frames.update_reference and solution.measured.any()):
        return float("nan"), start.best_match, start.reference_updates
    match = reference_update.match(deformed, solution)
    median = float(np.nanmedian(match)) if np.isfinite(match).any() else float("nan")
    best = float(np.fmax(start.best_match, np.float32(median)))
    if index in plan.settings.frames.reference or not reference_update.is_due(match, best):
        return median, best, start.reference_updates
    logger.warning("frame %d (%s) becomes the reference of those after it", index, plan.series.name(index))
    return median, 0.0, (*start.reference_updates, plan.series.chosen.index(index))


def _tell_dark(name: str, lights: tuple[str, ...], brightness: FloatArray) -> None:
    for light, gain in zip(lights, brightness[:, 0], strict=True):
        if gain < _DARK:
            logger.warning("%s: %s gives %.0f %% of its light in the reference", name, light, 100 * gain)


def _in_bytes(shares: FloatImage) -> npt.NDArray[np.uint8]:
    return np.round(shares * 255).astype(np.uint8)


def correlate(
    reference: npt.ArrayLike,
    deformed: npt.ArrayLike,
    *,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    cracks: Sequence[npt.ArrayLike] = (),
    weights: npt.ArrayLike | None = None,
    initial: npt.ArrayLike | None = None,
    deformed_weights: npt.ArrayLike | None = None,
    normalise: float | Literal["auto"] | None = None,
    statistics: bool | PrecisionMethod = True,
    mesh_error: bool = False,
    **options: Any,
) -> Solution:
    """Measure the displacement between two states seen under k lights (k = 1: plain DIC).

    Parameters
    ----------
    reference, deformed : array_like, shape (H, W) or (k, H, W)
        Grey levels; NaN marks an invalid pixel.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    cracks
        Paths, each of corners (x, y) in px, along which the mesh is split, see `Tri3Mesh.from_region`.
    weights : array_like, shape (H, W) or (k, H, W), optional
        Weight of each light at each pixel of the reference, finite and not negative; 0 excludes the pixel.
    initial : array_like, shape (2,) or (N, 2), optional
        Initial guess of the displacement (u, v) in px; None: it is found by a search.
    deformed_weights
        Like `weights`, on the deformed images.
    normalise
        Standard deviation in px of the Gaussian of the local mean by which every image is first divided; ``"auto"``: 10
        px, 30 px if there are cracks. None: grey levels are not changed.
    statistics
        True: weight the lights by the statistics of the residual around each pixel (`rgbmidic.weights.Statistics`).
        False: only by `weights`. Or an object with a method of your own.
    mesh_error
        Estimate the discretisation error, too (`rgbmidic.discretisation_error`).
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults: prefilter, rigid, brightness, fill,
        tolerance, max_iterations.

    Returns
    -------
    Solution
        With `nodes` (N, 2), `elements` (E, 3), `displacement` (N, 2) in px, `displacement_std` (N, 2) in px,
        `status`, and more.

    Raises
    ------
    InputError
        The images have different shapes, a weight or initial guess does not fit them, or a setting is unknown.
    RegionError
        The region is empty, too small or outside the image.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(120, 160)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 2, axis=1), region=(20, 20, 140, 100))
    >>> solution.status.name
    'CONVERGED'
    >>> np.allclose(solution.displacement, (2, 0), atol=0.01)
    True
    """
    f, g = as_light_stack(reference, "reference"), as_light_stack(deformed, "deformed")
    if f.shape != g.shape:
        raise InputError(f"reference and deformed images must have one shape; given are {f.shape} and {g.shape}")
    height, width = f.shape[1:]
    if not isinstance(region, Region):
        region = Region.from_rectangle(region if region is not None else (0, 0, width - 1, height - 1), (height, width))
    mesh = Tri3Mesh.from_region(region, element_size, cracks)
    cracked = len(mesh.crack_edges) > 0
    sigma, solver = grey_levels(0.0 if normalise is None else normalise, solver_settings(options), cracked=cracked)
    if sigma:
        f, g = (divide_by_local_mean(stack, sigma, float(np.nanmax(stack, initial=0.0))) for stack in (f, g))
    given = as_weights(weights, f.shape, "weights"), as_weights(deformed_weights, f.shape, "deformed_weights")
    second = aside(Deformed.prepare, g, given[1], prefilter=solver.prefilter)
    first = Reference.prepare(f, region, given[0], mesh=mesh, prefilter=solver.prefilter)
    method = (Statistics() if statistics else None) if isinstance(statistics, bool) else statistics
    start = initial_displacement(initial, len(mesh.nodes))
    if start is None:
        solution = track(first, second.result(), Start(displacement=None), solver, method)
    else:
        solution = solve(first, second.result(), start, solver, method)
    if mesh_error:
        solution = discretisation_error(first, second.result(), solution, solver, method)
    return fill(mesh, solution, solver.fill) if solver.fill else solution


def solver_settings(options: dict[str, Any]) -> SolverSettings:
    """The settings of the solve that options of a function state.

    Raises
    ------
    InputError
        An option is unknown or out of range.
    """
    try:
        check_names(options, (entry.name for entry in fields(SolverSettings)), "option", "correlate")
        return SolverSettings(**options)
    except ConfigurationError as error:
        raise InputError(str(error)) from None


def initial_displacement(initial: npt.ArrayLike | None, nodes: int) -> FloatArray | None:
    """Return an initial guess as an array, or None where none is given.

    Parameters
    ----------
    initial : array_like, shape (2,) or (N, 2), optional
        Displacement (u, v) in px.
    nodes
        Number N of nodes of the mesh.

    Returns
    -------
    ndarray, shape (N, 2), or None

    Raises
    ------
    InputError
        Not (2,) or (N, 2), or not finite.
    """
    if initial is None:
        return None
    values = np.asarray(initial, dtype=np.float64)
    if values.shape not in ((2,), (nodes, 2)) or not np.isfinite(values).all():
        raise InputError(f"initial must be finite with shape (2,) or ({nodes}, 2); given is shape {values.shape}")
    return np.broadcast_to(values, (nodes, 2)).copy()
