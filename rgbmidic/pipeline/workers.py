"""Who measures the frames: threads of this process, or the workers of a Dask cluster.

Kernels, numpy and OpenCV let go of the interpreter's lock, which a frame holds for 2 to 6 % of its time (measured), so
threads measure side by side what processes would, share the plan and the kernels, and start at once.
"""

from __future__ import annotations

import importlib
import logging
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import cv2

from rgbmidic._kernels.threads import keep_memory, set_threads, threads
from rgbmidic.correlation import Solution, Start
from rgbmidic.errors import ConfigurationError, RgbmidicError
from rgbmidic.pipeline.frame import Measured, measure_frame
from rgbmidic.pipeline.plan import Plan

logger = logging.getLogger(__name__)

Updated = Sequence[tuple[int, Solution]]
"""Index and solution of frames that became the reference, see `measure_frame`."""


class Workers(Protocol):
    """Measure frames, as many at a time as there are slots."""

    @property
    def slots(self) -> int:
        """How many."""

    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured."""


class Threads:
    """Threads of this process, each with a frame; those that share a kernel are divided among the frames.

    A single one is the caller's own thread.
    """

    def __init__(self, plan: Plan, count: int) -> None:
        import numba  # noqa: F401  of two threads that import it at once, one may find half of it

        keep_memory()
        self.slots, self._plan, self._running = count, plan, 0
        self._lock, self._before = threading.Lock(), (threads(), cv2.getNumThreads())
        self._executor = ThreadPoolExecutor(count, thread_name_prefix="rgbmidic-frames") if count > 1 else None

    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured, at once where there is one thread."""
        if self._executor is None:
            done: Future[Measured] = Future()
            done.set_result(self._measured(index, start, updated))
            return done
        self._count(1)
        future = self._executor.submit(self._measured, index, start, updated)
        future.add_done_callback(lambda _: self._count(-1))
        return future

    def close(self) -> None:
        """Wait for the frames that have begun."""
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        set_threads(self._before[0])
        cv2.setNumThreads(self._before[1])

    def _measured(self, index: int, start: Start, updated: Updated) -> Measured:
        return Measured(record=measure_frame(self._plan, index, start, updated))

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
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError:
            raise ConfigurationError(
                "a Dask cluster needs the packages dask and distributed: install rgbmidic[cluster]"
            ) from None
        # what becomes of the cluster is reported here, without its tracebacks; some loggers have levels of their own
        names = [
            name for name in logging.root.manager.loggerDict if name.partition(".")[0] in ("distributed", "tornado")
        ]
        self._levels = {logging.getLogger(name): logging.getLogger(name).level for name in names}
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

    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
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


class _Messages(logging.Handler):
    """Keeps what one thread logs."""

    def __init__(self) -> None:
        super().__init__()
        self.thread, self.kept = threading.get_ident(), list[tuple[int, str]]()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            self.kept.append((record.levelno, self.format(record)))


def _measure_elsewhere(plan: Plan, index: int, start: Start, updated: Updated) -> Measured:
    """Measure a frame in a worker of a cluster, on one thread; nobody reads its log."""
    cv2.setNumThreads(1)
    set_threads(1)
    logger, handler = logging.getLogger("rgbmidic"), _Messages()
    logger.addHandler(handler)
    try:
        return Measured(record=measure_frame(plan, index, start, updated), messages=tuple(handler.kept))
    finally:
        logger.removeHandler(handler)
