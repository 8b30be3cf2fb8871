"""Who measures frames: this process, several processes of this machine, or a Dask cluster."""

from __future__ import annotations

import importlib
import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from typing import Any, Self

import cv2

from rgbmidic._kernels.threads import set_threads, start_threads
from rgbmidic.correlation import Solution, Start
from rgbmidic.errors import ConfigurationError, RgbmidicError
from rgbmidic.pipeline.frame import measure_frame
from rgbmidic.pipeline.plan import Plan
from rgbmidic.results import FrameRecord

logger = logging.getLogger(__name__)

_START = 180.0
"""Seconds in which a worker process must have started: 5 are usual, 40 were seen on two cores shared by eight programs;
one that gets no memory for its threads never answers."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RGBMIDIC_THREADS")
"""What libraries read, when they start, for the number of their threads."""

Updated = Sequence[tuple[int, Solution]]
"""Index and solution of frames that became the reference, see `measure_frame`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What a worker gives back of a frame: its record, and what there was to say (level and text)."""

    record: FrameRecord
    messages: tuple[tuple[int, str], ...]


class Workers(ABC):
    """Measure frames, as many at a time as there are `slots`."""

    slots: int

    @abstractmethod
    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured."""

    def wait(self, running: Collection[Future[Measured]]) -> set[Future[Measured]]:
        """Wait for the first of some frames to end."""
        return wait(running, return_when=FIRST_COMPLETED).done

    def restart(self) -> None:  # noqa: B027 most have nothing to do
        """Begin anew after a worker has died."""

    def close(self) -> None:  # noqa: B027
        """Stop, without waiting for what is not finished."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Here(Workers):
    """The present process, one frame after the other, each on all its threads."""

    slots = 1

    def __init__(self, plan: Plan) -> None:
        self._plan = plan

    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
        """Measure the frame at once."""
        done: Future[Measured] = Future()
        done.set_result(Measured(record=measure_frame(self._plan, index, start, updated), messages=()))
        return done


class Processes(Workers):
    """Processes of this machine, which share its cores."""

    def __init__(self, plan: Plan, count: int) -> None:
        self.slots, self._threads = count, max(available_cores() // count, 1)
        self._plan = _pickled(plan)
        self._processes: set[BaseProcess] = set()
        self._executor: Executor = self._begin()

    def _begin(self) -> ProcessPoolExecutor:
        others, keepers = set(multiprocessing.active_children()), set(_keepers())
        with _environment(dict.fromkeys(_THREADS, str(self._threads))):
            spawn = multiprocessing.get_context("spawn")  # threads do not survive a fork
            pool = ProcessPoolExecutor(self.slots, spawn, initializer=_prepare, initargs=(self._plan, self._threads))
            # the processes must start while the environment says how many threads they have
            try:
                started = list[Future[int]]()
                for _ in range(self.slots):
                    with _uninterrupted():  # else half of what it needs is sent to a process
                        started.append(pool.submit(os.getpid))
                self._keeper = next(iter(set(_keepers()) - keepers))
                for one in started:
                    _first([one], self._keeper, _START)
                    one.result(0)
            except BaseException as error:
                _end(pool, set(multiprocessing.active_children()) - others)
                if not isinstance(error, (BrokenExecutor, OSError, RuntimeError, TimeoutError)):
                    raise
                reason = f"no answer in {_START:.0f} s" if isinstance(error, TimeoutError) else error
                raise ConfigurationError(
                    f"{self.slots} worker processes cannot be started: {reason}; is there memory and room for their "
                    "processes and threads? With --workers 1 the frames are measured in this process"
                ) from None
        self._processes = set(multiprocessing.active_children()) - others
        return pool

    def submit(self, index: int, start: Start, updated: Updated = ()) -> Future[Measured]:
        """Have one frame measured by the next free process."""
        try:
            return self._executor.submit(_measure_elsewhere, None, index, start, updated, self._threads)
        except BrokenExecutor as error:
            broken: Future[Measured] = Future()
            broken.set_exception(error)
            return broken

    def wait(self, running: Collection[Future[Measured]]) -> set[Future[Measured]]:
        """Wait for the first of some frames to end, or for all to be lost."""
        return _first(running, self._keeper)

    def restart(self) -> None:
        """Begin with new processes."""
        self.close()
        self._executor = self._begin()

    def close(self) -> None:
        """Stop, without waiting for what is not finished."""
        _end(self._executor, self._processes)


_LOOK = 2.0
"""Seconds between looks at whether the thread that keeps the processes lives. Chosen: nobody waits longer in vain."""


def _keepers() -> Iterator[threading.Thread]:
    """The threads that keep the processes of executors, one each."""
    return (thread for thread in threading.enumerate() if type(thread).__module__ == "concurrent.futures.process")


def _first(running: Collection[Future[Any]], keeper: threading.Thread, most: float = float("inf")) -> set[Future[Any]]:
    """Wait for the first to end, for `most` seconds; where their `keeper` dies, as without memory, all of them do."""
    end = time.monotonic() + most
    while not (done := wait(running, _LOOK, FIRST_COMPLETED).done) and time.monotonic() < end:
        if not keeper.is_alive():
            for future in running:
                if not future.done():
                    future.set_exception(BrokenExecutor("the thread that keeps the worker processes ended"))
    return done


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Have this thread, and the processes that it starts, get no Ctrl-C and no SIGTERM before the end of the block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_STOPS = (signal.SIGINT, signal.SIGTERM)


def _pickled(plan: Plan) -> bytes:
    """The plan for another process.

    Raises
    ------
    ConfigurationError
        An object that a script gave cannot be sent; it is named.
    """
    try:
        return pickle.dumps(plan, protocol=pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # objects raise what they like
        given = {"frame source": getattr(plan.series, "source", plan.series)}
        given |= {"separation": plan.separation, "weights": plan.weights}
        for what, one in given.items():
            try:
                pickle.dumps(one, protocol=pickle.HIGHEST_PROTOCOL)
            except Exception as reason:
                raise ConfigurationError(
                    f"the {what} ({type(one).__name__}) cannot be sent to another process: {reason}; measure with "
                    "workers=1, or give one that can be pickled, such as a class of a module that opens its file where "
                    "it reads"
                ) from None
        raise ConfigurationError(f"the test cannot be sent to another process: {error}") from None


class Cluster(Workers):
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
    def slots(self) -> int:  # type: ignore[override]
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
            future: Future[Measured] = self._executor.submit(_measure_elsewhere, self._plan, index, start, updated, 1)
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


def open_workers(plan: Plan, count: int, scheduler: str | None = None) -> Workers:
    """A Dask cluster where its scheduler is named, else `count` processes; a single one is this process."""
    if scheduler is not None:
        return Cluster(plan, scheduler)
    return Processes(plan, count) if count > 1 else Here(plan)


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Messages(logging.Handler):
    """Keeps what one thread logs."""

    def __init__(self) -> None:
        super().__init__()
        self.thread, self.kept = threading.get_ident(), list[tuple[int, str]]()

    def emit(self, record: logging.LogRecord) -> None:
        if record.thread == self.thread:
            self.kept.append((record.levelno, self.format(record)))


def _measure_elsewhere(plan: Plan | None, index: int, start: Start, updated: Updated, threads: int) -> Measured:
    """Measure a frame in another process, whose log nobody reads; None: of the test that it was prepared for."""
    _use_threads(threads)
    plan = plan or _prepared
    assert plan is not None
    logger, handler = logging.getLogger("rgbmidic"), _Messages()
    logger.addHandler(handler)
    try:
        return Measured(record=measure_frame(plan, index, start, updated), messages=tuple(handler.kept))
    finally:
        logger.removeHandler(handler)


_prepared: Plan | None = None
"""In a worker process: the test that it measures frames of."""


def _prepare(plan: bytes, threads: int) -> None:
    """Begin a worker process, with all the threads it will have: where one cannot be had, it is known at once."""
    global _prepared
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the first one decides
    if hasattr(signal, "pthread_sigmask"):  # of `_uninterrupted`
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _use_threads(threads)
    start_threads()
    _prepared = pickle.loads(plan)


def _end(pool: Executor, processes: set[BaseProcess]) -> None:
    """End a pool and its processes, also one that would never answer: what they were doing nobody waits for."""
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.kill()


def _end_with_parent() -> None:
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _use_threads(threads: int) -> None:
    cv2.setNumThreads(threads)
    set_threads(threads)


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Environment variables while something starts."""
    before = {name: os.environ[name] for name in values if name in os.environ}
    os.environ.update(values)
    try:
        yield
    finally:
        for name in values:
            os.environ.pop(name, None)
        os.environ.update(before)
