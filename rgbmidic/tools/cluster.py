"""The workers of a Dask cluster, which measure the frames of a test in place of this process' threads."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress

import cv2

from rgbmidic._kernels.threads import set_threads
from rgbmidic.correlation import TrackingState
from rgbmidic.errors import ConfigurationError, RgbmidicError, import_optional
from rgbmidic.pipeline.engine import LOST_CLUSTER, Outcome
from rgbmidic.pipeline.frame import ReferenceHistory, measure_frame_safely
from rgbmidic.pipeline.plan import Plan
from rgbmidic.results import FrameRecord
from rgbmidic.results.warnings import collect_messages

logger = logging.getLogger(__name__)


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

    def submit(self, position: int, start: TrackingState, updated: ReferenceHistory = ()) -> Future[Outcome]:
        """Have one frame measured by some worker; what it logged is logged here."""
        outcome: Future[Outcome] = Future()

        def report(of_worker: Future[tuple[FrameRecord, list[tuple[int, str]]]]) -> None:
            try:
                record, messages = of_worker.result()
            except (CancelledError, Exception) as error:
                outcome.set_exception(error)
                return
            for level, text in messages:
                logger.log(level, "%s", text)
            outcome.set_result((record, None))

        with _answering():
            self._executor.submit(_measure, self._plan, position, start, updated).add_done_callback(report)
        return outcome

    def close(self) -> None:
        """Leave the cluster to others, without waiting for what is not finished."""
        self._executor.shutdown(wait=False)
        alive = self._client.status == "running"
        with suppress(OSError, RuntimeError, TimeoutError, CancelledError):  # a scheduler that is gone has let go of it
            self._client.close()
        if alive:  # else its threads complain for some time yet
            for log, level in self._levels.items():
                log.setLevel(level)


@contextmanager
def _answering() -> Iterator[None]:
    """Turn the errors of a scheduler that has gone into one of ours."""
    try:
        yield
    except (OSError, RuntimeError, CancelledError) as error:
        logger.debug("the Dask scheduler does not answer: %s", error)
        raise RgbmidicError(LOST_CLUSTER) from None


def _measure(
    plan: Plan, position: int, start: TrackingState, updated: ReferenceHistory
) -> tuple[FrameRecord, list[tuple[int, str]]]:
    """Measure a frame in a worker, on one thread; nobody reads its log."""
    cv2.setNumThreads(1)
    set_threads(1)
    with collect_messages() as messages:
        record, _ = measure_frame_safely(plan, position, start, updated)
    return record, messages
