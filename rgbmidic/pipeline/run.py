"""The main job: a test's raw frames in, displacement fields with their uncertainty out."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic._kernels.threads import threads
from rgbmidic.correlation import NodeStatus, Solution, Status, TrackingState
from rgbmidic.errors import FrameError, InputError, ResultError
from rgbmidic.extensions import PREPARATIONS, load_extension
from rgbmidic.illumination.separation import LightSeparation
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.engine import Outcome, Schedule, dependants, next_start, open_workers, rank_of
from rgbmidic.pipeline.frame import ReferenceHistory, checksum, messages, read_state
from rgbmidic.pipeline.frame_quality import light_levels
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.user_objects import FrameSequence, check_object, check_type, describe
from rgbmidic.results import QUANTITIES, Origin, Result, ResultStore
from rgbmidic.results.provenance import PROVENANCE, read_provenance
from rgbmidic.results.quantities import NO_CHECKSUM
from rgbmidic.results.result import list_frames, read_shared
from rgbmidic.results.warnings import collect_messages, join_frame_warnings
from rgbmidic.settings import TestSettings, read_test
from rgbmidic.typing import ProgressCallback
from rgbmidic.weights import LightWeights

logger = logging.getLogger(__name__)

_OF_NODES = {
    array: [quantity.name for quantity in QUANTITIES.values() if quantity.source.startswith(f"{array}.")]
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
    region: Region | None = None,
    overwrite: bool = False,
    resume: bool = False,
    retry_failed: bool = False,
    frames: range | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    timings: bool = False,
    progress: ProgressCallback | None = None,
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
    region
        Pixels to measure, in px of the frame, instead of ``[region]``.
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

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> stack = np.stack([np.roll(speckle, frame, axis=1) for frame in range(2)])
    >>> frames, region = {"path": [], "kind": "monochrome"}, {"rectangle": [0, 0, 79, 79]}
    >>> settings = TestSettings.from_mapping({"frames": frames, "region": region, "mesh": {"element_size": 40}})
    >>> with TemporaryDirectory() as folder:
    ...     result = measure(settings, Path(folder) / "result", source=stack, workers=1)
    ...     round(float(np.nanmedian(result.u[1])), 2)
    1.0
    """
    if retry_failed and not resume:
        raise InputError("`retry_failed` goes with `resume`: it measures failed frames of a result again")
    if isinstance(settings, str | Path):
        settings = read_test(settings)
    check_type("settings", settings, TestSettings, "a TestSettings or the path of a TEST.toml")
    check_type("frames", frames, range | None, "a range of indices")
    check_type("workers", workers, int | None, "a whole number")
    check_type("region", region, Region | None, "a Region")
    check_object("progress", progress, "__call__")
    instances: dict[str, Any] = {"source": source, "separation": separation, "weights": weights, "mesh": mesh}
    instances |= {} if region is None else {"region": region}
    has_provenance = (resume or frames is not None) and (Path(out) / PROVENANCE).exists()
    provenance = read_provenance(Path(out)) if has_provenance else {}
    with collect_messages() as plan_messages:
        plan = replace(_plan_of(settings, instances, provenance, Path(out)), timings=timings)
    warnings = list(dict.fromkeys(text for level, text in plan_messages if level >= logging.WARNING))
    plan = replace(plan, notes={**plan.notes, "warnings": warnings})
    objects = {
        name: describe(instance) for name, instance in instances.items() if instance is not None and name != "source"
    }
    if settings.weights.method == "images":  # the masks, whatever their files are called
        objects["weights"] = describe(plan.weights)
    positions = _select_positions(plan.series.selected, frames)
    if workers is None:
        workers = threads() if separation is None and weights is None else 1
    origin = _origin(plan, objects, provenance.get("unread_files", ()))
    if frames is not None:
        writable_store = ResultStore.join(out, origin, frames=positions)
    elif resume:
        writable_store = ResultStore.resume(out, origin)
    else:
        writable_store = ResultStore.create(out, origin, overwrite=overwrite)
    with writable_store as store:
        if resume and frames is None:
            _invalidate_frames(plan, store, origin.names, retry_failed=retry_failed)
        sink = _ResultSink(plan, store, positions, progress)
        schedule = Schedule(plan, sink, positions)
        if schedule.done and frames is None and "finished" in read_provenance(store.path):
            logger.warning("%s is finished and whole: nothing is left to be measured", out)
            return Result.open(out)
        store.reopen()
        if not schedule.done:
            with closing(open_workers(plan, min(workers, len(positions)), scheduler)) as pool:
                schedule.run(pool)
        table, names = store.table(), ("status", "reason", "warnings")
        texts = ((position, messages(table.read(position, names))) for position in positions)
        for line in join_frame_warnings(texts, origin.names):
            logger.warning("%s", line)
        with collect_messages() as frame_messages:
            _warn_duplicate_frames(plan, store, positions, origin.names)
        if frames is None:
            store.finish([text for _, text in frame_messages])
    return Result.open(out, partial=frames is not None, check=False)


def _plan_of(settings: TestSettings, instances: Mapping[str, Any], provenance: Mapping[str, Any], out: Path) -> Plan:
    """Make the plan of a test: elements and mesh are those of the `provenance` of a result that is gone on with."""
    sized, notes = settings.mesh, dict[str, Any]()
    if sized.element_size == "auto":
        choice = notes["element_size"] = provenance.get("element_size") or asdict(
            _prepare("mesh.element_size")(settings, **instances)
        )
        sized = replace(sized, element_size=choice["element_size"])
    refines = settings.mesh.refine is not False
    if refines and instances["mesh"] is not None:
        raise InputError("mesh.refine is for a mesh made here, and a mesh is given: leave one of them out")
    plan = Plan.from_settings(replace(settings, mesh=replace(sized, refine=False)), **instances)
    if refines and "refinement" in provenance:
        stored = read_shared(out, provenance)
        finer = Tri3Mesh(nodes=stored["nodes"] - plan.window.origin, elements=stored["elements"])
        plan, notes["refinement"] = plan.on_mesh(finer), provenance["refinement"]
    elif refines:
        plan = _prepare("mesh.refine")(plan, settings.mesh.refine)
    return replace(plan, settings=settings, notes={**plan.notes, **notes})


def _prepare(key: str) -> Callable[..., Any]:
    """Return what finds the value of a key of TEST.toml on the test's own frames."""
    return load_extension(PREPARATIONS, key, key)


class _ResultSink:
    """The sink of a result folder."""

    def __init__(self, plan: Plan, store: ResultStore, positions: range, progress: ProgressCallback | None) -> None:
        self._plan, self._store, self._positions, self._progress = plan, store, positions, progress
        self._finished = store.finished()

    def is_finished(self, position: int) -> bool:
        """Return whether a frame is in the folder."""
        return bool(self._finished[position])

    def start_after(self, position: int) -> TrackingState:
        """Initial guess after a finished frame: from the last that is measured up to there.

        Where a frame failed all before it are finished, since a key frame that fails waits for the one before it.
        """
        names, table = ("u", "v", "node_status", "reference_updates", "best_match"), self._store.table()
        for earlier in range(position, -1, -1):
            values = table.read(earlier, names)
            if (values["node_status"] == NodeStatus.MEASURED).any():
                return next_start(self._plan, values, TrackingState(displacement=None))
        return TrackingState(displacement=None)

    def updated(self, positions: Sequence[int]) -> ReferenceHistory:
        """Positions and solutions of the frames that became the reference, as the folder holds them."""
        if not positions:
            return ()
        mesh, lights = self._plan.reference.mesh, len(self._plan.images.names)
        blank, updates = Solution.failed(mesh, lights, "", np.zeros(0)), []
        names, table = [*chain(*_OF_NODES.values()), "node_status", "rigid"], self._store.table()
        for position in positions:
            values = table.read(position, names)
            arrays: dict[str, Any] = {"node_status": values["node_status"], "rigid": values["rigid"].astype(np.float64)}
            for name, columns in _OF_NODES.items():
                arrays[name] = np.stack([values[column] for column in columns], axis=1, dtype=np.float64)
            updates.append((position, replace(blank, **arrays)))
        return updates

    def keep(self, position: int, outcome: Outcome, initial_guess: TrackingState) -> None:
        """Write a frame, and report what became of it."""
        record, positions = outcome[0], self._positions
        self._store.write_frame(position, record)
        self._finished[position] = True
        if self._progress is None:
            return
        done, status = int(self._finished[positions.start : positions.stop].sum()), Status(record.status)
        line = f"{status.name.lower().replace('_', ' ')}: {record.reason}"
        if status is Status.CONVERGED:
            line = f"converged in {record.iterations} iterations, {1 - rank_of(record)[1]:.0%} of the nodes measured"
        self._progress(done, len(positions), f"{self._plan.series.name(self._plan.series.selected[position])}: {line}")


def _invalidate_frames(plan: Plan, store: ResultStore, names: Sequence[str], *, retry_failed: bool) -> None:
    """Take back the frames that are to be measured again, and those whose bits depend on what becomes of them.

    A damaged frame comes back with the same bits, unless it had failed because it could not be read.
    """
    table = store.table()
    lost = np.flatnonzero(table.without_damaged(ended="finished" in read_provenance(store.path)).damaged).tolist()
    changed, readable, tries = list[int](), list[int](), [2] * len(names)
    for position, is_finished in enumerate(table.finished.tolist()):
        values = dict[str, Any]()
        with suppress(ResultError):  # damaged, or not there: whatever it was
            values = table.read(position, ["status", "unread", "tries"]) if is_finished else {}
        if not values:
            changed.append(position)
            continue
        tries[position] = values["tries"]
        if values["unread"]:
            with suppress(FrameError):
                read_state(plan, plan.series.selected[position])
                readable.append(position)
                continue
        if retry_failed and values["status"] == Status.FAILED:
            changed.append(position)
    if lost:
        logger.warning("lost to damage and measured again: %s", list_frames(lost, names))
    if readable:
        readable_frames = list_frames(readable, names)
        logger.warning("measured again with what started from it, since it can be read now: %s", readable_frames)
    store.discard({*lost, *dependants([*changed, *readable], tries)})


def _warn_duplicate_frames(plan: Plan, store: ResultStore, positions: range, names: Sequence[str]) -> None:
    """Warn of frames with the samples of the frame before or of the reference, bit for bit."""
    table = store.table()
    sums = [table.read(position, ["checksum"])["checksum"] for position in positions]
    pairs = zip(positions[1:], sums[1:], sums, strict=False)
    repeated = [position for position, crc, before in pairs if crc == before != NO_CHECKSUM]
    selected, references = plan.series.selected, plan.settings.frames.reference
    measured = dict(zip(selected[positions.start : positions.stop], sums, strict=True))
    with suppress(FrameError):
        of_reference = {
            measured.get(index) or checksum(read_state(plan, index, plan.window)[0]) for index in references
        }
        copies = [
            position for position, crc in zip(positions, sums, strict=True) if crc in of_reference - {NO_CHECKSUM}
        ]
        copies = [position for position in copies if selected[position] not in references and position not in repeated]
        if copies:
            logger.warning(
                "frames are the reference, bit for bit, which camera noise makes impossible; their displacement of 0 "
                "is not measured: %s; were frames lost and filled up, or files copied?",
                list_frames(copies, names),
            )
    if repeated:
        subject = "all frames repeat" if len(repeated) == len(positions) - 1 else "frames that repeat"
        logger.warning(
            f"{subject} the one before, bit for bit, which camera noise makes impossible: "
            f"{list_frames(repeated, names)}; were frames lost and filled up, or files copied?"
        )


def _select_positions(selected: range, frames: range | None) -> range:
    """Places in the result of the frames that are to be measured.

    Raises
    ------
    FrameError
        There is none of them.
    """
    positions = [position for position, index in enumerate(selected) if frames is None or index in frames]
    if frames is not None and (not positions or frames.stop > selected[-1] + 1):
        raise FrameError(
            f"`frames` are {frames.start} to {frames.stop - 1}; the test has the frames {selected[0]} to {selected[-1]}"
        )
    return range(positions[0], positions[-1] + 1)


def _origin(plan: Plan, objects: Mapping[str, str], unread_before: Collection[str]) -> Origin:
    """Return what a result keeps of all frames in common; `objects` describes the objects that a script gave."""
    series, recording = plan.series, plan.series.recording
    fingerprint, unread = series.fingerprint(unread_before)
    levels = light_levels(plan.images, plan.region).items()
    usable = np.isfinite(plan.images.values[:, plan.region.mask]).mean(axis=1)
    return Origin(
        nodes=plan.reference.mesh.nodes + plan.window.origin,
        elements=plan.reference.mesh.elements,
        names=[series.name(index) for index in series.selected],
        labels=plan.labels,
        lights=plan.images.names,
        settings=plan.settings,
        inputs={" + ".join(plan.settings.frames.path) or "source": fingerprint, **objects},
        readers=getattr(series, "packages", ()),
        references=[
            position for position, index in enumerate(series.selected) if index in plan.settings.frames.reference
        ],
        reference=plan.images.values,
        notes={
            **getattr(plan.weights, "notes", {}),
            **plan.notes,
            "grey_levels": {"brightness": plan.settings.solver.brightness, "gain_window": plan.reference.gain_window},
            "frame_rate": recording.frame_rate,
            "exposure_ns": recording.exposure_ns,
            "lost_frames": series.n_lost,
            "unread_files": list(unread),
            "frame_shape": list(plan.window.frame),
            "reference_origin": list(plan.window.origin),
            "reference_exposure": [
                {"light": light, "median": level, "excluded": float(1 - fraction)}
                for (light, level), fraction in zip(levels, usable, strict=True)
            ],
        },
    )
