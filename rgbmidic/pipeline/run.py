"""The main job: a test's raw frames in, displacement fields with their uncertainty out."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic._kernels.threads import threads
from rgbmidic.correlation import NodeStatus, Solution, Status, TrackingState
from rgbmidic.errors import FrameError, InputError, ResultError
from rgbmidic.illumination.separation import LightSeparation
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.engine import Schedule, following, open_workers, rank_of
from rgbmidic.pipeline.frame import Measured, Updated, checksum, messages, read_state
from rgbmidic.pipeline.objects import check_object, check_type, describe
from rgbmidic.pipeline.plan import Plan, dependants
from rgbmidic.pipeline.resolution import Progress, choose, refine
from rgbmidic.pipeline.source import FrameSequence
from rgbmidic.pipeline.suitability import light_levels
from rgbmidic.results import QUANTITIES, Origin, Result, ResultStore
from rgbmidic.results.provenance import PROVENANCE, read_provenance
from rgbmidic.results.quantities import NO_CHECKSUM
from rgbmidic.results.result import list_frames, read_shared
from rgbmidic.results.warnings import collect_messages, join_frame_warnings
from rgbmidic.settings import TestSettings, read_test
from rgbmidic.weights import LightWeights

logger = logging.getLogger(__name__)

_OF_NODES = {
    array: [one.name for one in QUANTITIES.values() if one.source.startswith(f"{array}.")]
    for array in ("displacement", "displacement_std", "bias_std", "edge_std", "strain", "strain_std")
}
"""Quantities of a frame that it makes a reference with, as columns of its solution's arrays."""


def measure(
    settings: TestSettings | Path | str,
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
    workers: int | None = None,
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
        Settings, or the path of a TEST.toml that holds them.
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
        Number of frames that are measured at a time, each by a thread of this process. None: one for each core, or as
        the environment's RGBMIDIC_THREADS states, but 1 with a `separation` or `weights`, which more than one thread
        would call at a time. A `source` is read by one thread at a time.
    scheduler
        Address of the scheduler of a Dask cluster, instead of threads of this process.
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
    if isinstance(settings, str | Path):
        settings = read_test(settings)
    check_type("settings", settings, TestSettings, "a TestSettings or the path of a TEST.toml")
    check_type("frames", frames, range | None, "a range of indices")
    check_type("workers", workers, int | None, "a whole number")
    check_object("progress", progress, "__call__")
    given: dict[str, Any] = {"source": source, "separation": separation, "weights": weights, "mesh": mesh}
    begun = (resume or frames is not None) and (Path(out) / PROVENANCE).exists()
    kept = read_provenance(Path(out)) if begun else {}
    with collect_messages() as before:
        plan = replace(_plan_of(settings, given, kept, Path(out)), timings=timings)
    warnings = list(dict.fromkeys(text for level, text in before if level >= logging.WARNING))
    plan = replace(plan, notes={**plan.notes, "warnings": warnings})
    objects = {name: describe(one) for name, one in given.items() if one is not None and name != "source"}
    if settings.weights.method == "images":  # the masks, whatever their files are called
        objects["weights"] = describe(plan.weights)
    places = _places(plan.series.selected, frames)
    if workers is None:
        workers = threads() if separation is None and weights is None else 1
    origin = _origin(plan, objects, kept.get("unread_files", ()))
    if frames is not None:
        opened = ResultStore.join(out, origin, frames=places)
    elif resume:
        opened = ResultStore.resume(out, origin)
    else:
        opened = ResultStore.create(out, origin, overwrite=overwrite)
    with opened as store:
        if resume and frames is None:
            _take_back(plan, store, origin.names, retry_failed=retry_failed)
        sink = _Folder(plan, store, places, progress)
        schedule = Schedule(plan, sink, places)
        if schedule.done and frames is None and "finished" in read_provenance(store.path):
            logger.warning("%s is finished and whole: nothing is left to be measured", out)
            return Result.open(out)
        store.reopen()
        if not schedule.done:
            with closing(open_workers(plan, min(workers, len(places)), scheduler)) as others:
                schedule.run(others)
        table = store.table().iterate(["status", "reason", "warnings"], places)
        texts = ((place, messages(kept)) for place, kept in zip(places, table, strict=True))
        for line in join_frame_warnings(texts, origin.names):
            logger.warning("%s", line)
        with collect_messages() as together:
            _tell_repeated(plan, store, places, origin.names)
        if frames is None:
            store.finish([text for _, text in together])
    return Result.open(out, partial=frames is not None, check=False)


def _plan_of(settings: TestSettings, given: Mapping[str, Any], kept: Mapping[str, Any], out: Path) -> Plan:
    """The plan of a test: elements and mesh are those of the provenance `kept` of a result that is gone on with."""
    sized, notes = settings.mesh, dict[str, Any]()
    if sized.element_size == "auto":
        choice = notes["element_size"] = kept.get("element_size") or asdict(choose(settings, **given))
        sized = replace(sized, element_size=choice["element_size"])
    refines = settings.mesh.refine is not False
    if refines and given["mesh"] is not None:
        raise InputError("mesh.refine is for a mesh made here, and a mesh is given: leave one of them out")
    plan = Plan.from_settings(replace(settings, mesh=replace(sized, refine=False)), **given)
    if refines and "refinement" in kept:
        stored = read_shared(out, kept)
        finer = Tri3Mesh(nodes=stored["nodes"] - plan.window.origin, elements=stored["elements"])
        plan, notes["refinement"] = plan.on_mesh(finer), kept["refinement"]
    elif refines:
        plan = refine(plan, settings.mesh.refine)
    return replace(plan, settings=settings, notes={**plan.notes, **notes})


class _Folder:
    """The sink of a result folder."""

    def __init__(self, plan: Plan, store: ResultStore, places: range, progress: Progress | None) -> None:
        self._plan, self._store, self._places, self._progress = plan, store, places, progress
        self._finished = store.finished()

    def is_finished(self, place: int) -> bool:
        """Whether a frame is in the folder."""
        return bool(self._finished[place])

    def start_after(self, place: int) -> TrackingState:
        """Initial guess after a finished frame: from the last that is measured up to there.

        Where a frame failed all before it are finished, since a key frame that fails waits for the one before it.
        """
        names = ("u", "v", "node_status", "reference_updates", "best_match")
        for kept in self._store.table().iterate(names, range(place, -1, -1)):
            if (kept["node_status"] == NodeStatus.MEASURED).any():
                return following(self._plan, kept, TrackingState(displacement=None))
        return TrackingState(displacement=None)

    def updated(self, places: Sequence[int]) -> Updated:
        """Indices and solutions of the frames that became the reference, as the folder holds them."""
        if not places:
            return ()
        mesh, lights, chosen = self._plan.reference.mesh, len(self._plan.images.names), self._plan.series.selected
        blank, found = Solution.failed(mesh, lights, "", np.zeros(0)), []
        names = [*chain(*_OF_NODES.values()), "node_status", "rigid"]
        for place, kept in zip(places, self._store.table().iterate(names, places), strict=True):
            arrays: dict[str, Any] = {"node_status": kept["node_status"], "rigid": kept["rigid"].astype(np.float64)}
            for name, parts in _OF_NODES.items():
                arrays[name] = np.stack([kept[part] for part in parts], axis=1, dtype=np.float64)
            found.append((chosen[place], replace(blank, **arrays)))
        return found

    def keep(self, place: int, found: Measured, after: TrackingState) -> None:
        """Write a frame, and report what became of it."""
        record, places = found.record, self._places
        self._store.write_frame(place, record)
        self._finished[place] = True
        if self._progress is None:
            return
        done, status = int(self._finished[places.start : places.stop].sum()), Status(record.status)
        line = f"{status.name.lower().replace('_', ' ')}: {record.reason}"
        if status is Status.CONVERGED:
            line = f"converged in {record.iterations} iterations, {1 - rank_of(record)[1]:.0%} of the nodes measured"
        self._progress(done, len(places), f"{self._plan.series.name(self._plan.series.selected[place])}: {line}")


def _take_back(plan: Plan, store: ResultStore, names: Sequence[str], *, retry_failed: bool) -> None:
    """Take back the frames that are to be measured again, and those whose bits depend on what becomes of them.

    A damaged frame comes back with the same bits, unless it had failed because it could not be read.
    """
    table = store.table()
    lost = np.flatnonzero(table.without_damaged(ended="finished" in read_provenance(store.path)).damaged).tolist()
    changed, readable, tries = list[int](), list[int](), [2] * len(names)
    for place, there in enumerate(table.finished.tolist()):
        try:
            kept = next(table.iterate(["status", "unread", "tries"], [place] if there else []))
        except (ResultError, StopIteration):  # damaged, or not there: whatever it was
            changed.append(place)
            continue
        tries[place] = kept["tries"]
        if kept["unread"]:
            with suppress(FrameError):
                read_state(plan, plan.series.selected[place])
                readable.append(place)
                continue
        if retry_failed and kept["status"] == Status.FAILED:
            changed.append(place)
    if lost:
        logger.warning("lost to damage and measured again: %s", list_frames(lost, names))
    if readable:
        again_for = list_frames(readable, names)
        logger.warning("measured again with what started from it, since it can be read now: %s", again_for)
    store.discard({*lost, *dependants([*changed, *readable], tries)})


def _tell_repeated(plan: Plan, store: ResultStore, places: range, names: Sequence[str]) -> None:
    """Warn of frames with the samples of the frame before or of the reference, bit for bit."""
    sums = [kept["checksum"] for kept in store.table().iterate(["checksum"], places)]
    pairs = zip(places[1:], sums[1:], sums, strict=False)
    repeated = [place for place, mine, before in pairs if mine == before != NO_CHECKSUM]
    chosen, references = plan.series.selected, plan.settings.frames.reference
    measured = dict(zip(chosen[places.start : places.stop], sums, strict=True))
    with suppress(FrameError):
        of_reference = {measured.get(one) or checksum(read_state(plan, one, plan.window)[0]) for one in references}
        copies = [place for place, mine in zip(places, sums, strict=True) if mine in of_reference - {NO_CHECKSUM}]
        copies = [place for place in copies if chosen[place] not in references and place not in repeated]
        if copies:
            logger.warning(
                "frames are the reference, bit for bit, which camera noise makes impossible; their displacement of 0 "
                "is not measured: %s; were frames lost and filled up, or files copied?",
                list_frames(copies, names),
            )
    if repeated:
        what = "all frames repeat" if len(repeated) == len(places) - 1 else "frames that repeat"
        logger.warning(
            f"{what} the one before, bit for bit, which camera noise makes impossible: {list_frames(repeated, names)}; "
            "were frames lost and filled up, or files copied?"
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


def _origin(plan: Plan, objects: Mapping[str, str], unread_before: Collection[str]) -> Origin:
    """What the result keeps of what all frames share; `objects` are descriptions of those that were given."""
    series, recording = plan.series, plan.series.recording
    fingerprint, unread = series.fingerprint(unread_before)
    levels = light_levels(plan.images, plan.region).items()
    usable = np.isfinite(plan.images.values[:, plan.region.mask]).mean(axis=1)
    return Origin(
        nodes=plan.reference.mesh.nodes + plan.window.origin,
        elements=plan.reference.mesh.elements,
        names=[series.name(index) for index in series.selected],
        finite_elements=plan.finite_elements,
        placement=plan.placement,
        lights=plan.images.names,
        settings=plan.settings,
        inputs={" + ".join(plan.settings.frames.path) or "source": fingerprint, **objects},
        readers=getattr(series, "packages", ()),
        references=[place for place, index in enumerate(series.selected) if index in plan.settings.frames.reference],
        reference=plan.images.values,
        notes={
            **getattr(plan.weights, "notes", {}),
            **plan.notes,
            "grey_levels": {"brightness": plan.solver.brightness, "gain_window": plan.reference.gain_window},
            "frame_rate": recording.frame_rate,
            "exposure_ns": recording.exposure_ns,
            "lost_frames": series.n_lost,
            "unread_files": list(unread),
            "frame_shape": list(plan.window.frame),
            "reference_origin": list(plan.window.origin),
            "reference_exposure": [
                {"light": light, "median": level, "excluded": float(1 - part)}
                for (light, level), part in zip(levels, usable, strict=True)
            ],
        },
    )
