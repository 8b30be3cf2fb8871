"""The engine: frames are measured in the order of `rgbmidic.pipeline.plan`, by workers, into a sink.

`rgbmidic.measure` runs it with threads or a Dask cluster and a result folder, `rgbmidic.measure_sequence` with the
latest state alone and a few initial guesses.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from heapq import nsmallest
from typing import Any, Protocol

import cv2
import numpy as np

from rgbmidic._kernels.threads import set_threads, threads
from rgbmidic.correlation import NodeStatus, Status, TrackingState
from rgbmidic.correlation.solution import rank
from rgbmidic.errors import ConfigurationError, FrameError, RgbmidicError, import_optional
from rgbmidic.pipeline.frame import Measured, Updated, attempt, failed_frame
from rgbmidic.pipeline.plan import STRIDE, Plan, is_key, parent
from rgbmidic.results import FrameRecord
from rgbmidic.results.warnings import collect_messages

logger = logging.getLogger(__name__)


class Sink(Protocol):
    """Where measured frames go, by their places in the result."""

    def is_finished(self, place: int) -> bool:
        """Whether a frame is there already."""

    def start_after(self, place: int) -> TrackingState:
        """Initial guess of the frames that follow a finished one."""

    def updated(self, places: Sequence[int]) -> Updated:
        """Frames that became the reference, or the reference that they make."""

    def keep(self, place: int, found: Measured, after: TrackingState) -> None:
        """Take a frame, and the initial guess of those that follow it."""


class Schedule:
    """The frames that are still to be measured.

    A frame starts from its parent in the tree, or, where that one failed, from where it started. A key frame that is
    not measured well from there is measured once more from the frame just before it, and the better of both is kept.
    """

    def __init__(self, plan: Plan, sink: Sink, places: Iterable[int] = ()) -> None:
        self._plan, self._sink = plan, sink
        self._ready, self._wanted = list[tuple[int, TrackingState]](), set[int]()
        self._waiting: dict[int, list[int]] = {}
        self._first_tries: dict[int, Measured] = {}
        for place in places:
            self.want(place)

    @property
    def done(self) -> bool:
        """Whether nothing is left to be measured."""
        return not self._ready

    def want(self, place: int) -> None:
        """Have a frame measured, and all that it depends on."""
        if not (place in self._wanted or self._sink.is_finished(place)):
            self._wanted.add(place)
            self._start_from(parent(place), place)

    def _start_from(self, before: int | None, place: int) -> None:
        """Have a frame measured as soon as the frame `before` it is; None: from a search."""
        if before is None:
            self._ready.append((place, TrackingState(displacement=None)))
        elif self._sink.is_finished(before):
            self._ready.append((place, self._sink.start_after(before)))
        else:
            self._waiting.setdefault(before, []).append(place)
            self.want(before)

    def run(self, workers: Threads | Cluster) -> None:
        """Have workers measure the frames, and give each to the sink as it finishes.

        Raises
        ------
        ResultError
            The sink cannot be written.
        FrameError
            All files of the frames are gone.
        """
        running: dict[Future[Measured], tuple[int, TrackingState]] = {}
        while self._ready or running:
            while self._ready and len(running) < workers.slots:
                place, start = self._next(workers.slots)
                updated = self._sink.updated(start.reference_updates[-1:])  # all that the reference depends on
                # a key frame looks for what has been lost; frames between key frames follow what there is
                own = replace(start, unmeasured=0.0) if is_key(place) else start
                running[workers.submit(self._plan.series.selected[place], own, updated)] = place, start
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                place, start = running.pop(future)
                self._take(place, start, self._outcome(future, self._plan.series.selected[place]))

    def _next(self, slots: int) -> tuple[int, TrackingState]:
        """Take the frame that is to be measured next out of those that can be.

        Of the earliest chains, one more than several frames are measured at a time, it is that of the chain which is
        behind: at the end of a test none is left alone.
        """
        chains = nsmallest(slots + (slots > 1), self._ready, key=lambda one: one[0])
        found = min(chains, key=lambda one: one[0] % STRIDE)
        self._ready.remove(found)
        return found

    def _outcome(self, future: Future[Measured], index: int) -> Measured:
        """What a worker found, or why it found nothing."""
        try:
            found = future.result()
        except CancelledError:
            raise RgbmidicError(LOST_CLUSTER) from None
        except Exception as error:  # a worker of a cluster that died over the frame more often than the cluster allows
            reason = f"its worker died: {type(error).__name__}"
            return Measured(record=failed_frame(self._plan, index, reason))
        for level, text in found.messages:
            logger.log(level, "%s", text)
        return found

    def _take(self, place: int, start: TrackingState, found: Measured) -> None:
        """Keep a frame, or have it measured again, and release what waits for it."""
        if found.record.unread and (gone := self._plan.series.missing_lights()):
            raise FrameError(f"the frames are gone: {gone}; go on with --resume when they are there again")
        first = self._first_tries.pop(place, None)
        lost = found.record.status != Status.CONVERGED or rank_of(found.record)[1] > start.unmeasured + 0.01
        if first is None and is_key(place) and lost:  # a hundredth of the nodes more than where it started from
            self._first_tries[place] = found
            self._start_from(place - 1, place)
            return
        if first is not None:
            better = min(first, found, key=lambda one: rank_of(one.record))
            found = replace(better, record=replace(better.record, values={**better.record.values, "tries": 2}))
        after = following(self._plan, found.record.values, start)
        self._sink.keep(place, found, after)
        self._wanted.discard(place)
        self._ready += [(one, after) for one in self._waiting.pop(place, ())]


def rank_of(record: FrameRecord) -> tuple[bool, float]:
    """The smaller, the better a frame is measured (`rgbmidic.correlation.solution.rank`)."""
    return rank(int(record.status), record.node_status)


def following(plan: Plan, kept: Mapping[str, Any], start: TrackingState) -> TrackingState:
    """Where a frame starts that follows one that started from `start` and of which this is kept."""
    measured = kept["node_status"] == NodeStatus.MEASURED
    if not measured.any():
        return start
    reference, displacement = plan.reference, np.stack([kept["u"], kept["v"]], axis=1)
    after = start.extrapolate(reference.mesh, displacement, measured, reference.constants)
    updates, best = tuple(kept["reference_updates"].tolist()), float(kept["best_match"])
    return replace(after, reference_updates=updates, best_match=best)


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

    def submit(self, index: int, start: TrackingState, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured, at once where there is one thread."""
        if self._executor is None:
            done: Future[Measured] = Future()
            done.set_result(attempt(self._plan, index, start, updated))
            return done
        self._count(1)
        future = self._executor.submit(attempt, self._plan, index, start, updated)
        future.add_done_callback(lambda _: self._count(-1))
        return future

    def close(self) -> None:
        """Wait for the frames that have begun."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        set_threads(self._before[0])
        cv2.setNumThreads(self._before[1])

    def _count(self, more: int) -> None:
        """Divide the threads that share kernels among the frames that are being measured."""
        with self._lock:
            self._running += more
            each = max(self._before[0] // max(self._running, 1), 1)
            if each != threads():
                set_threads(each)
                cv2.setNumThreads(each)


class Cluster:
    """The workers of a Dask cluster; what a lost one was doing is done again by another."""

    def __init__(self, plan: Plan, address: str) -> None:
        distributed = import_optional("distributed", "cluster")
        # what becomes of the cluster is reported here, without its tracebacks; some loggers have levels of their own
        names = [name for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))]
        self._levels = {log: log.level for log in map(logging.getLogger, names)}
        for log in self._levels:
            log.setLevel(logging.CRITICAL + 1)
        try:
            self._client = distributed.Client(address, timeout=30, set_as_default=False)
            self._client.wait_for_workers(1, timeout=120)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigurationError(f"no Dask scheduler with workers answers at {address}: {error}") from None
        self._plan = self._client.scatter(plan, broadcast=True, hash=False)
        self._executor = self._client.get_executor(pure=False)

    @property
    def slots(self) -> int:
        """Threads of all workers there are now.

        Raises
        ------
        RgbmidicError
            The scheduler does not answer any more.
        """
        with _answering():
            return max(sum(map(int, self._client.nthreads().values())), 1)

    def submit(self, index: int, start: TrackingState, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured by some worker."""
        with _answering():
            future: Future[Measured] = self._executor.submit(_measure_elsewhere, self._plan, index, start, updated)
        return future

    def close(self) -> None:
        """Leave the cluster to others, without waiting for what is not finished."""
        self._executor.shutdown(wait=False)
        alive = self._client.status == "running"
        with suppress(OSError, RuntimeError, TimeoutError, CancelledError):  # a scheduler that is gone has let go of it
            self._client.close()
        if alive:  # else its threads complain for some time yet
            for log, level in self._levels.items():
                log.setLevel(level)


LOST_CLUSTER = "the Dask scheduler and its workers no longer answer; what was finished is kept: go on with --resume"


@contextmanager
def _answering() -> Iterator[None]:
    """Turn the errors of a scheduler that has gone into one of ours."""
    try:
        yield
    except (OSError, RuntimeError, CancelledError) as error:
        logger.debug("the Dask scheduler does not answer: %s", error)
        raise RgbmidicError(LOST_CLUSTER) from None


def open_workers(plan: Plan, count: int, scheduler: str | None = None) -> Threads | Cluster:
    """A Dask cluster where its scheduler is named, else `count` threads of this process."""
    return Threads(plan, count) if scheduler is None else Cluster(plan, scheduler)


def _measure_elsewhere(plan: Plan, index: int, start: TrackingState, updated: Updated) -> Measured:
    """Measure a frame in a worker of a cluster, on one thread; nobody reads its log."""
    cv2.setNumThreads(1)
    set_threads(1)
    with collect_messages() as messages:
        found = attempt(plan, index, start, updated)
    return Measured(record=found.record, messages=tuple(messages))
