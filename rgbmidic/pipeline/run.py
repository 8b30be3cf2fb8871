"""The main job: a test's raw frames in, displacement fields with their uncertainty out, each kept as it finishes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rgbmidic._kernels import are_compiled
from rgbmidic.correlation import Status
from rgbmidic.errors import FrameError, InputError, ResultError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.frame import read_state
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.schedule import Schedule, dependants
from rgbmidic.pipeline.separation import LightSeparation
from rgbmidic.pipeline.source import FrameSequence, describe
from rgbmidic.pipeline.workers import available_cores, open_workers
from rgbmidic.results import Origin, Result, ResultStore
from rgbmidic.results.provenance import PROVENANCE, read_provenance
from rgbmidic.results.store import listed
from rgbmidic.settings import TestSettings
from rgbmidic.weights import LightWeights

__all__ = ["measure"]

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
    """Measure a test: displacement of every frame against the reference.

    The result is the same, bit for bit, for any number of workers, and whether or not it was interrupted and resumed or
    measured part by part.

    Parameters
    ----------
    settings
        What `rgbmidic.settings.read_test` reads from TEST.toml.
    out
        Result folder; nothing is written to it before settings, calibration, region and reference are found good.
    source
        The frames, in place of files: whatever has a length and a frame by index (`FrameSequence`), such as a numpy
        stack (T, H, W); the settings then have ``frames.path = []``.
    separation
        From a raw frame to one image per light, in place of the package's (`LightSeparation`).
    weights
        How much each light counts at each pixel (`rgbmidic.weights.LightWeights`), in place of what ``[weights]``
        names; with ``weights.method = "statistics"`` they are multiplied by those, with ``"none"`` they count alone.
    mesh
        In px of the frame, in place of the one made from region and ``[mesh]``.
    overwrite
        Replace a result that is already there.
    resume
        Go on with a result that is already there: its settings, calibration and frames must be the same, and the
        objects must describe themselves as then. Frames that
        are damaged there are measured again; so are those that could not be read and now can, with all that started
        from them.
    retry_failed
        With `resume`, measure again all frames that failed, and all that started from them.
    frames
        Only these of the frames that the settings choose, counted as there, into a folder that other processes may fill
        at the same time; when all are measured, `rgbmidic.results.finish_result` ends the result. None: all.
    workers
        Number of processes of this machine; with 1 the frames are measured in this one; None: one for each core, but
        none for fewer than `FRAMES_A_WORKER` frames. A script that asks for more than 1 must be guarded by
        ``if __name__ == "__main__"``.
    scheduler
        Address of the scheduler of a Dask cluster, instead of processes of this machine.
    timings
        Keep the seconds that each stage of a frame takes (`seconds` of a result): they differ from run to run.
    progress
        Called after every frame with the number of frames done, their total and a line about the last one.

    Returns
    -------
    Result
        A frame that cannot be read or measured is kept as failed with its reason; the others go on.

    Raises
    ------
    RgbmidicError
        The settings, the calibration, the region or the reference frames are not usable, the result cannot be written,
        or what is in `out` is another test's.
    """
    if retry_failed and not resume:
        raise InputError("--retry-failed goes with --resume: it measures failed frames of a result again")
    given = {"source": source, "separation": separation, "weights": weights, "mesh": mesh}
    plan = Plan.from_settings(settings, source=source, separation=separation, weights=weights, mesh=mesh)
    plan = replace(plan, timings=timings)
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
        if frames is None:
            store.finish()
    return Result.open(out, partial=frames is not None, check=False)


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
        if kept["unread"] and _can_be_read(plan, chosen[place]):
            readable.append(place)
        elif retry_failed and kept["status"] == Status.FAILED:
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


def _can_be_read(plan: Plan, index: int) -> bool:
    try:
        return bool(read_state(plan, index))
    except FrameError:
        return False


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
        lights=plan.images.names,
        settings=plan.settings,
        inputs={" + ".join(plan.settings.frames.path) or "source": fingerprint, **objects},
        references=[place for place, index in enumerate(series.chosen) if index in plan.settings.frames.reference],
        reference=plan.images.values,
        notes={
            **getattr(plan.weights, "notes", {}),
            "frame_rate": recording.frame_rate,
            "exposure_ns": recording.exposure_ns,
            "lost_frames": series.lost,
            "unread_files": list(unread),
            "frame_shape": list(plan.window.frame),
            "reference_origin": list(plan.window.origin),
        },
    )
    if part is not None:
        return ResultStore.join(out, origin, frames=part)
    if resume:
        return ResultStore.resume(out, origin)
    return ResultStore.create(out, origin, overwrite=overwrite)
