"""The main job: a test's raw frames in, displacement fields with their uncertainty out.

`measure` keeps each frame's result in a folder as it finishes; `measure_sequence` takes one state after the other, as a
camera gives them, and yields each solution before it asks for the next, in constant memory. Initial guesses, tracking
and reference updates are the same, frame for frame.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels import are_compiled
from rgbmidic.correlation import Solution, Start, Status
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.errors import FrameError, InputError, ResultError, RgbmidicError
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.frame import STRIDE, next_reference, read_state, solve_frame, solver_settings
from rgbmidic.pipeline.plan import Choice, Plan, light_levels
from rgbmidic.pipeline.resolution import choose, on_mesh, refine
from rgbmidic.pipeline.schedule import Schedule, dependants, following, is_key, loses, parent, rank_of
from rgbmidic.pipeline.source import FrameSequence, LightSeparation, describe
from rgbmidic.pipeline.workers import available_cores, open_workers
from rgbmidic.results import FrameRecord, Origin, Result, ResultStore
from rgbmidic.results.provenance import PROVENANCE, read_provenance
from rgbmidic.results.quantities import NO_CHECKSUM
from rgbmidic.results.store import listed, read_mesh
from rgbmidic.settings import (
    ELEMENT_SIZE,
    FrameSettings,
    IlluminationSettings,
    RegionSettings,
    TestSettings,
    WeightSettings,
)
from rgbmidic.weights import LightWeights, MaskWeights

logger = logging.getLogger(__name__)

FRAMES_A_WORKER = 8
"""Fewer frames are not worth a process, which takes some 5 s to start."""

Progress = Callable[[int, int, str], None]


def measure(
    settings: TestSettings,
    out: Path | str,
    *,
    source: FrameSequence | None = None,
    separation: LightSeparation | None = None,
    weights: LightWeights | None = None,
    mesh: Tri3Mesh | None = None,
    overwrite: bool = False,
    resume: bool = False,
    retry_failed: bool = False,
    frames: range | None = None,
    workers: int | None = 1,
    scheduler: str | None = None,
    timings: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Measure a test: displacement of every frame relative to the reference.

    The result is identical, bit for bit, for any number of workers, and also if the run is interrupted and resumed or
    done in parts.

    Parameters
    ----------
    settings
        Settings, as `rgbmidic.settings.read_test` reads them from TEST.toml.
    out
        Result folder; nothing is written before settings, calibration, region and reference have been checked.
    source
        The frames, instead of files: any object with a length and a frame for each index (`FrameSequence`), such as a
        numpy stack (T, H, W). The settings then have ``frames.path = []``.
    separation
        Function from a raw frame to one image per light, instead of the package's (`LightSeparation`).
    weights
        Weights of the lights at each pixel (`rgbmidic.weights.LightWeights`), instead of those of ``[weights]``. With
        ``weights.method = "statistics"`` they are multiplied by those, with ``"none"`` they are used alone.
    mesh
        Mesh in px of the frame, instead of the one made from region and ``[mesh]``.
    overwrite
        Replace an existing result.
    resume
        Continue an existing result: its settings, calibration and frames must be the same, and the descriptions of the
        objects must not have changed. Damaged frames are measured again, as are frames that could not be read before
        and now can; the same holds for all frames whose initial guess came from them.
    retry_failed
        With `resume`, measure again all frames that failed, and all whose initial guess came from them.
    frames
        Only these of the frames that the settings choose, with the same numbers; other processes may write to the
        folder at the same time. When all are measured, `rgbmidic.results.finish_result` finishes the result. None: all.
    workers
        Number of processes on this machine. 1: the frames are measured in the present process; None: one for each core,
        but none for fewer than `FRAMES_A_WORKER` frames. A script with more than 1 must be guarded by
        ``if __name__ == "__main__"``.
    scheduler
        Address of the scheduler of a Dask cluster, instead of processes of this machine.
    timings
        Store the time of each stage of a frame in seconds (`seconds` of a result); it differs from run to run.
    progress
        Called after every frame with the number of frames done, their total and a line about the last one.

    Returns
    -------
    Result
        A frame that cannot be read or measured is stored as failed with the reason; the others are measured.

    Raises
    ------
    RgbmidicError
        The settings, the calibration, the region or the reference frames are not usable, the result cannot be written,
        or `out` contains the result of another test.
    """
    if retry_failed and not resume:
        raise InputError("--retry-failed goes with --resume: it measures failed frames of a result again")
    given: dict[str, Any] = {"source": source, "separation": separation, "weights": weights, "mesh": mesh}
    choice: Choice | None = None
    begun = (resume or frames is not None) and (Path(out) / PROVENANCE).exists()
    kept = read_provenance(Path(out)) if begun else {}
    if settings.element_size == "auto":
        choice = Choice(**kept["element_size"]) if kept.get("element_size") else choose(settings, **given)
    if settings.mesh_refine is not False and mesh is not None:
        raise InputError("mesh.refine is for a mesh made here, and a mesh is given: leave one of them out")
    sized = settings if choice is None else replace(settings, element_size=choice.element_size)
    plan = Plan.from_settings(replace(sized, mesh_refine=False), **given)
    if settings.mesh_refine is not False:
        plan = _refined(plan, settings.mesh_refine, Path(out), kept)
    plan = replace(plan, settings=settings, choice=choice, timings=timings)
    objects = {name: describe(one) for name, one in given.items() if one is not None and name != "source"}
    if settings.weights.method == "images":  # the masks, whatever their files are called
        objects["weights"] = describe(plan.weights)
    places = _places(plan.series.chosen, frames)
    if workers is None:
        workers = max(min(available_cores(), len(places) // FRAMES_A_WORKER), 1)
    with _store(plan, Path(out), places if frames else None, objects, overwrite=overwrite, resume=resume) as store:
        if resume and frames is None:
            _take_back(plan, store, retry_failed=retry_failed)
        schedule = Schedule(plan, store, places)
        if schedule.done and frames is None and "finished" in read_provenance(store.path):
            logger.warning("%s is finished and whole: nothing is left to be measured", out)
            return Result.open(out)
        store.reopen()
        if workers > 1 and not are_compiled():  # the other processes then find all compiled
            with open_workers(plan, 1) as here:
                schedule.run(here, progress, most=1)
        if not schedule.done:
            with open_workers(plan, min(workers, len(places)), scheduler) as others:
                schedule.run(others, progress)
        _tell_repeated(plan, store, places)
        if frames is None:
            store.finish()
    return Result.open(out, partial=frames is not None, check=False)


def _refined(plan: Plan, frame: int | bool, out: Path, kept: Mapping[str, Any]) -> Plan:
    """The plan on a mesh refined in a frame, or on that of the result in `out`, with the provenance `kept`."""
    if "refinement" not in kept:
        return refine(plan, frame)
    stored = read_mesh(out, kept)
    mesh = Tri3Mesh(nodes=stored["nodes"] - plan.window.origin, elements=stored["elements"])
    return replace(on_mesh(plan, mesh), refinement=kept["refinement"])


def _take_back(plan: Plan, store: ResultStore, *, retry_failed: bool) -> None:
    """Take back the frames that are to be measured again, and those whose bits depend on what becomes of them.

    A damaged frame comes back with the same bits, unless it had failed because it could not be read.
    """
    table = store.table()
    damaged = table.without_damaged(ended="finished" in read_provenance(store.path)).damaged
    names, chosen = [plan.series.name(index) for index in plan.series.chosen], plan.series.chosen
    changed, readable, tries = list[int](), list[int](), [2] * len(names)
    for place, there in enumerate(table.finished.tolist()):
        try:
            kept = next(table.each(["status", "unread", "tries"], [place] if there else []))
        except (ResultError, StopIteration):  # damaged, or not there: whatever it was
            changed.append(place)
            continue
        tries[place] = kept["tries"]
        if kept["unread"]:
            with suppress(FrameError):
                read_state(plan, chosen[place])
                readable.append(place)
                continue
        if retry_failed and kept["status"] == Status.FAILED:
            changed.append(place)
    lost = np.flatnonzero(damaged).tolist()
    again = {*lost, *changed, *readable, *dependants([*changed, *readable], tries)}
    if lost:
        logger.warning("lost to damage and measured again: %s", listed(lost, names))
    if readable:
        logger.warning(
            "measured again with what started from it, since it can be read now: %s", listed(readable, names)
        )
    store.discard(again)


def _tell_repeated(plan: Plan, store: ResultStore, places: range) -> None:
    """Warn of frames with the samples of the frame before, bit for bit."""
    sums = [kept["checksum"] for kept in store.table().each(["checksum"], places)]
    pairs = zip(places[1:], sums[1:], sums, strict=False)
    repeated = [place for place, mine, before in pairs if mine == before != NO_CHECKSUM]
    if repeated:
        names = [plan.series.name(index) for index in plan.series.chosen]
        what = "all frames repeat" if len(repeated) == len(places) - 1 else "frames that repeat"
        logger.warning(
            "%s the one before, bit for bit, which camera noise makes impossible: %s; were frames lost and filled up, "
            "or files copied?",
            what,
            listed(repeated, names),
        )


def _places(chosen: range, frames: range | None) -> range:
    """Places in the result of the frames that are to be measured.

    Raises
    ------
    FrameError
        There is none of them.
    """
    places = [place for place, index in enumerate(chosen) if frames is None or index in frames]
    if frames is not None and (not places or frames.stop > chosen[-1] + 1):
        raise FrameError(
            f"--frames names {frames.start} to {frames.stop - 1}; the test has the frames {chosen[0]} to {chosen[-1]}"
        )
    return range(places[0], places[-1] + 1)


def _store(
    plan: Plan, out: Path, part: range | None, objects: dict[str, str], *, overwrite: bool, resume: bool
) -> ResultStore:
    series = plan.series
    recording = series.recording
    begun = (resume or part is not None) and (out / PROVENANCE).exists()
    fingerprint, unread = series.fingerprint(read_provenance(out).get("unread_files", ()) if begun else ())
    origin = Origin(
        nodes=plan.reference.mesh.nodes + plan.window.origin,
        elements=plan.reference.mesh.elements,
        names=[series.name(index) for index in series.chosen],
        finite_elements=plan.finite_elements,
        placement=plan.placement,
        lights=plan.images.names,
        settings=plan.settings,
        inputs={" + ".join(plan.settings.frames.path) or "source": fingerprint, **objects},
        readers=getattr(series, "packages", ()),
        references=[place for place, index in enumerate(series.chosen) if index in plan.settings.frames.reference],
        reference=plan.images.values,
        notes={
            **getattr(plan.weights, "notes", {}),
            **({} if plan.choice is None else {"element_size": asdict(plan.choice)}),
            **({} if plan.refinement is None else {"refinement": plan.refinement}),
            "grey_levels": {"normalise": plan.normalise, "brightness": plan.solver.brightness},
            "frame_rate": recording.frame_rate,
            "exposure_ns": recording.exposure_ns,
            "lost_frames": series.lost,
            "unread_files": list(unread),
            "frame_shape": list(plan.window.frame),
            "reference_origin": list(plan.window.origin),
            "reference_exposure": list(_exposure(plan)),
            "calibration_figures": plan.calibration,
        },
    )
    if part is not None:
        return ResultStore.join(out, origin, frames=part)
    if resume:
        return ResultStore.resume(out, origin)
    return ResultStore.create(out, origin, overwrite=overwrite)


def _exposure(plan: Plan) -> Iterator[dict[str, Any]]:
    """Yield of each light the median grey level in the region of the reference, and the part that is not usable."""
    levels, inside = light_levels(plan.images, plan.region), plan.images.values[:, plan.region.mask]
    for (light, level), part in zip(levels.items(), inside, strict=True):
        yield {"light": light, "median": level, "excluded": float(1 - np.isfinite(part).mean())}


def measure_sequence(
    states: Iterable[Any],
    settings: TestSettings | None = None,
    *,
    reference: Any = None,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    normalise: float | Literal["auto"] = "auto",
    statistics: bool = True,
    update_reference: bool = False,
    separation: LightSeparation | None = None,
    weights: LightWeights | npt.ArrayLike | None = None,
    mesh: Tri3Mesh | None = None,
    **options: Any,
) -> Iterator[Solution]:
    """Measure states one by one, each as soon as it is available: from a list, a generator, a camera.

    Every solution is identical, bit for bit, to that of `rgbmidic.measure` for the same frames. Only the reference and
    a few initial guesses are kept between states, whatever their number. To write a result folder, pass the frames to
    `rgbmidic.measure` as `source`.

    Parameters
    ----------
    states
        Without `settings` arrays (H, W) or (k, H, W), one image per light, NaN where not valid, or
        `IlluminationImages`.
        With `settings` anything that a frame source may return (`rgbmidic.pipeline.FrameSequence`), such as raw frames.
    settings
        Settings of a test, with ``frames.path = []``; they replace `region`, `element_size`, `normalise`,
        `statistics`, `update_reference` and the `options`.
    reference
        The reference state; None: the first of the `states`, which is measured like the others.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    normalise
        Standard deviation in px of the Gaussian of the local mean by which every image is first divided; 0: grey levels
        are not changed; ``"auto"``: 10 px, 30 px if the mesh has cracks.
    statistics
        Weight every light by the inverse variance of its own residual around each pixel, robustly.
    update_reference
        Whether a later state becomes the reference when the correlation with the present one is low.
    separation, mesh
        As in `rgbmidic.measure`.
    weights
        As in `rgbmidic.measure`; or an array (k, H, W) from 0 to 1 that applies to every state.
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults.

    Yields
    ------
    Solution
        One for each state, relative to the reference. A state that cannot be measured is `Status.FAILED` with its
        reason; the next states are measured.

    Raises
    ------
    RgbmidicError
        The settings contradict themselves or the objects, or the reference is not usable.
    """
    remaining = iter(states)
    own = reference is None
    if own:
        try:
            reference = next(remaining)
        except StopIteration:
            raise InputError("there is no state to measure: the sequence is empty") from None
    latest = _Latest(reference=reference, light_images=settings is None)
    mask = region if isinstance(region, Region) else None
    if settings is None:
        height, width = np.shape(getattr(reference, "values", reference))[-2:]
        corners: Any = (0, 0, width - 1, height - 1)
        if region is not None and not isinstance(region, Region):
            corners = tuple(region)
        settings = TestSettings(
            frames=FrameSettings(path=(), update_reference=update_reference),
            region=RegionSettings(rectangle=corners),
            element_size=element_size,
            illumination=IlluminationSettings(normalise=normalise),
            weights=WeightSettings(method="statistics" if statistics else "none"),
            solver=solver_settings(options),
        )
    elif options or region is not None:
        told = ", ".join([*options, *(["region"] if region is not None else [])])
        raise InputError(f"settings are given: state in them what {told} says")
    if settings.weights.threshold == "auto":
        raise InputError('weights.threshold = "auto" looks at the first deformed frame, which a sequence has not yet')
    counted: Any = weights if weights is None or hasattr(weights, "deformed") else MaskWeights(cast(Any, weights))
    frames = replace(settings.frames, reference=(0,), first=0 if own else 1, last=None, step=1)
    plan = Plan.from_settings(
        replace(settings, frames=frames), source=latest, separation=separation, weights=counted, mesh=mesh, region=mask
    )
    return _solutions(plan, latest, chain([reference], remaining) if own else remaining)


@dataclass(slots=True)
class _Latest:
    """A frame source of the reference, frame 0, and of the latest state, whatever its number."""

    reference: Any
    light_images: bool
    state: Any = None

    def __len__(self) -> int:
        return sys.maxsize

    def __getitem__(self, index: int) -> Any:
        state = self.state if index else self.reference
        if self.light_images and not hasattr(state, "values"):
            return np.asarray(state, dtype=np.float32)
        return state


def _solutions(plan: Plan, latest: _Latest, states: Iterable[Any]) -> Iterator[Solution]:
    """The solution of each state, from the starts and with the second tries of `Schedule`."""
    starts: dict[int, Start] = {}
    updates: dict[tuple[int, ...], ReferenceUpdate] = {(): ReferenceUpdate.none(plan.reference)}
    last = NO_CHECKSUM
    for position, latest.state in enumerate(states):
        index, before = plan.series.chosen[position], parent(position)
        start = Start(displacement=None) if before is None else starts[before]
        found, after, checksum = _solved(plan, index, start, updates, key=is_key(position))
        if checksum == last != NO_CHECKSUM:
            logger.warning("state %d repeats the one before, bit for bit", position)
        last = checksum
        if is_key(position) and loses(found, start):
            closer = starts[position - 1]
            again, after_again, _ = _solved(plan, index, closer, updates, key=True)
            if rank_of(again) < rank_of(found):
                found, after, start = again, after_again, closer
            elif not found.measured.any():
                after = closer
        if (frames := after.reference_updates[-2:]) not in updates:
            updates[frames] = next_reference(plan, updates[start.reference_updates[-2:]], index, found)
        starts[position] = after
        # a later state starts from this one, from the first, or from the last at a multiple of a power of STRIDE
        needed, step = {0, position}, STRIDE
        while step <= position:
            needed.add(position // step * step)
            step *= STRIDE
        starts = {place: one for place, one in starts.items() if place in needed}
        kept = {(), *(one.reference_updates[-2:] for one in starts.values())}
        updates = {frames: one for frames, one in updates.items() if frames in kept}
        yield found


def _solved(
    plan: Plan, index: int, start: Start, updates: dict[tuple[int, ...], ReferenceUpdate], *, key: bool
) -> tuple[Solution, Start, int]:
    """The solution of the latest state from a start, where the one after it starts, and the state's checksum."""
    try:
        given = replace(start, unmeasured=0.0) if key else start
        values = solve_frame(plan, index, given, updates[start.reference_updates[-2:]])
    except RgbmidicError as error:
        logger.warning("%s failed: %s", plan.series.name(index), error)
        mesh, lights = plan.reference.mesh, len(plan.images.names)
        return Solution.failed(mesh, lights, str(error), np.zeros(0)), start, NO_CHECKSUM
    return values["solution"], following(plan, FrameRecord.from_solution(**values).values, start), values["checksum"]
