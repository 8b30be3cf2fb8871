"""The engine: frames are measured by workers, each as soon as the frame that it starts from is there, into a sink.

The frames are the leaves of a tree of base `STRIDE`, whatever the number of workers: a frame starts from the one before
it, every 16th from the 16th before, every 256th from the 256th before, and so on, so that chunks of consecutive frames
can be measured side by side once their key frame is, and any range of frames needs only some key frames of those before
it. A key frame that is not measured well from there is measured once more from the frame just before it, and the better
of both is kept. `rgbmidic.measure` runs it with threads, or workers of a tool, and a result folder,
`rgbmidic.measure_sequence` with the latest state alone and a few initial guesses.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from heapq import nsmallest
from typing import Any, Protocol

import cv2
import numpy as np

from rgbmidic._kernels.threads import set_threads, threads
from rgbmidic.correlation import NodeStatus, Solution, Status, TrackingState
from rgbmidic.correlation.solution import rank
from rgbmidic.errors import FrameError, RgbmidicError
from rgbmidic.extensions import WORKERS, load_extension
from rgbmidic.pipeline.frame import ReferenceHistory, failed_frame, measure_frame_safely
from rgbmidic.pipeline.plan import STRIDE, Plan
from rgbmidic.results import FrameRecord

logger = logging.getLogger(__name__)


def parent(position: int) -> int | None:
    """The frame that a frame starts from; None for the first."""
    if position == 0:
        return None
    step = 1
    while position % (step * STRIDE) == 0:
        step *= STRIDE
    return position - step


def is_key(position: int) -> bool:
    """Return whether a frame starts from one that is not just before it."""
    return position > 0 and position % STRIDE == 0


def dependants(positions: Iterable[int], tries: Sequence[int]) -> set[int]:
    """Some frames, and all that depend on them, directly or through others, of a test with as many as `tries`.

    A frame depends on the one that it starts from; a key frame of 2 `tries` also on the one just before it.
    """
    affected = set(positions)
    for position, try_count in enumerate(tries):
        if parent(position) in affected or (try_count > 1 and position - 1 in affected):
            affected.add(position)
    return affected


Outcome = tuple[FrameRecord, Solution | None]
"""The record of a frame, and its solution where this process has it."""


class Sink(Protocol):
    """A sink takes the measured frames, by their positions in the result."""

    def is_finished(self, position: int) -> bool:
        """Return whether a frame is in the result already."""

    def start_after(self, position: int) -> TrackingState:
        """Initial guess of the frames that follow a finished one."""

    def updated(self, positions: Sequence[int]) -> ReferenceHistory:
        """Frames that became the reference, or the reference that they make."""

    def keep(self, position: int, outcome: Outcome, initial_guess: TrackingState) -> None:
        """Take a frame, and the initial guess of those that follow it."""


class Workers(Protocol):
    """Workers measure frames, several at a time: threads of the process, or a tool's."""

    @property
    def slots(self) -> int:
        """Number of frames that are measured at a time."""

    def submit(self, position: int, start: TrackingState, updated: ReferenceHistory = ()) -> Future[Outcome]:
        """Have one frame measured."""

    def close(self) -> None:
        """Let the workers go."""


OpenWorkers = Callable[[Plan, str], Workers]
"""What makes workers of a plan and the address of their scheduler."""


class Schedule:
    """The frames that are still to be measured.

    A frame starts from its parent in the tree, or, where that one failed, from where it started. A key frame that is
    not measured well from there is measured once more from the frame just before it, and the better of both is kept.
    """

    def __init__(self, plan: Plan, sink: Sink, positions: Iterable[int] = ()) -> None:
        self._plan, self._sink = plan, sink
        self._ready, self._wanted = list[tuple[int, TrackingState]](), set[int]()
        self._waiting: dict[int, list[int]] = {}
        self._first_tries: dict[int, Outcome] = {}
        for position in positions:
            self.want(position)

    @property
    def done(self) -> bool:
        """Return whether nothing is left to be measured."""
        return not self._ready

    def want(self, position: int) -> None:
        """Have a frame measured, and all that it depends on."""
        if not (position in self._wanted or self._sink.is_finished(position)):
            self._wanted.add(position)
            self._start_from(parent(position), position)

    def _start_from(self, before: int | None, position: int) -> None:
        """Have a frame measured as soon as the frame `before` it is; None: from a search."""
        if before is None:
            self._ready.append((position, TrackingState(displacement=None)))
        elif self._sink.is_finished(before):
            self._ready.append((position, self._sink.start_after(before)))
        else:
            self._waiting.setdefault(before, []).append(position)
            self.want(before)

    def run(self, workers: Workers) -> None:
        """Have workers measure the frames, and give each to the sink as it finishes.

        Raises
        ------
        ResultError
            The sink cannot be written.
        FrameError
            All files of the frames are gone.
        """
        running: dict[Future[Outcome], tuple[int, TrackingState]] = {}
        while self._ready or running:
            while self._ready and len(running) < workers.slots:
                position, start = self._next(workers.slots)
                last = start.reference_updates[-1:]  # all that the reference depends on
                updated = self._sink.updated(last) if last else ()
                # a key frame looks for what has been lost; frames between key frames follow what there is
                frame_start = replace(start, unmeasured=0.0) if is_key(position) else start
                running[workers.submit(position, frame_start, updated)] = position, start
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                position, start = running.pop(future)
                self._take(position, start, self._outcome(future, position))

    def _next(self, slots: int) -> tuple[int, TrackingState]:
        """Take the frame that is to be measured next out of those that can be.

        Of the earliest chains, one more than several frames are measured at a time, it is that of the chain which is
        behind: at the end of a test none is left alone.
        """
        chains = nsmallest(slots + (slots > 1), self._ready, key=lambda item: item[0])
        entry = min(chains, key=lambda item: item[0] % STRIDE)
        self._ready.remove(entry)
        return entry

    def _outcome(self, future: Future[Outcome], position: int) -> Outcome:
        """Return the outcome of a worker, or a failed frame with the reason where the worker died."""
        try:
            return future.result()
        except CancelledError:
            raise RgbmidicError(LOST_CLUSTER) from None
        except Exception as error:  # a worker of a cluster that died over the frame more often than the cluster allows
            reason = f"its worker died: {type(error).__name__}"
            return failed_frame(self._plan, position, reason), None

    def _take(self, position: int, start: TrackingState, outcome: Outcome) -> None:
        """Keep a frame, or have it measured again, and release what waits for it."""
        record, solution = outcome
        if record.unread and (gone := self._plan.series.missing_lights()):
            raise FrameError(f"the frames are gone: {gone}; go on with `resume=True` when they are there again")
        first = self._first_tries.pop(position, None)
        if first is None and is_key(position) and self._has_lost(record, start):
            self._first_tries[position] = outcome
            self._start_from(position - 1, position)
            return
        if first is not None:
            record, solution = min(first, outcome, key=lambda item: rank_of(item[0]))
            record = replace(record, values={**record.values, "tries": 2})
        initial_guess = next_start(self._plan, record.values, start)
        self._sink.keep(position, (record, solution), initial_guess)
        self._wanted.discard(position)
        self._ready += [(item, initial_guess) for item in self._waiting.pop(position, ())]

    @staticmethod
    def _has_lost(record: FrameRecord, start: TrackingState) -> bool:
        """Tell whether a frame is not measured well: a hundredth of the nodes more lost than where it started from."""
        return record.status != Status.CONVERGED or rank_of(record)[1] > start.unmeasured + 0.01


def rank_of(record: FrameRecord) -> tuple[bool, float]:
    """The smaller, the better a frame is measured (`rgbmidic.correlation.solution.rank`)."""
    return rank(int(record.status), record.node_status)


def next_start(plan: Plan, values: Mapping[str, Any], start: TrackingState) -> TrackingState:
    """Return the initial guess of the frames after one that started from `start` and has these `values`."""
    measured = values["node_status"] == NodeStatus.MEASURED
    if not measured.any():
        return start
    reference, displacement = plan.reference, np.stack([values["u"], values["v"]], axis=1)
    initial_guess = start.extrapolate(reference.mesh, displacement, measured, reference.constants)
    updates, best = tuple(values["reference_updates"].tolist()), float(values["best_match"])
    return replace(initial_guess, reference_updates=updates, best_match=best)


class Threads:
    """Threads of this process, each with a frame; those that share a kernel are divided among the frames.

    Kernels, numpy and OpenCV let go of the interpreter's lock, which a frame holds for 2 to 6 % of its time (measured),
    so threads measure side by side what processes would, share the plan and the kernels, and start at once. A single
    one is the caller's own thread.
    """

    def __init__(self, plan: Plan, count: int) -> None:
        import numba  # noqa: F401  of two threads that import it at once, one may find half of it

        self.slots, self._plan, self._running = count, plan, 0
        self._lock, self._before = threading.Lock(), (threads(), cv2.getNumThreads())
        self._executor = ThreadPoolExecutor(count, thread_name_prefix="rgbmidic-frames") if count > 1 else None

    def submit(self, position: int, start: TrackingState, updated: ReferenceHistory = ()) -> Future[Outcome]:
        """Have one frame measured, at once where there is one thread."""
        if self._executor is None:
            done: Future[Outcome] = Future()
            done.set_result(measure_frame_safely(self._plan, position, start, updated))
            return done
        self._count(1)
        future = self._executor.submit(measure_frame_safely, self._plan, position, start, updated)
        future.add_done_callback(lambda _: self._count(-1))
        return future

    def close(self) -> None:
        """Wait for the frames that have begun."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        set_threads(self._before[0])
        cv2.setNumThreads(self._before[1])

    def _count(self, change: int) -> None:
        """Divide the threads that share kernels among the frames that are being measured."""
        with self._lock:
            self._running += change
            threads_per_frame = max(self._before[0] // max(self._running, 1), 1)
            if threads_per_frame != threads():
                set_threads(threads_per_frame)
                cv2.setNumThreads(threads_per_frame)


LOST_CLUSTER = (
    "the Dask scheduler and its workers no longer answer; what was finished is kept: go on with `resume=True`"
)
"""What a schedule reports whose workers are gone."""


def open_workers(plan: Plan, count: int, scheduler: str | None = None) -> Workers:
    """Workers of a cluster where its scheduler is named, else `count` threads of this process."""
    return Threads(plan, count) if scheduler is None else load_extension(WORKERS, "dask", "scheduler")(plan, scheduler)
