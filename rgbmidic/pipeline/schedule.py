"""Which frame is measured next, and from where it starts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import replace
from heapq import nsmallest
from typing import Any

import numpy as np

from rgbmidic.correlation import NodeStatus, Solution, Start, Status
from rgbmidic.errors import FrameError, RgbmidicError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.frame import failed_frame
from rgbmidic.pipeline.order import STRIDE, better, children, lineage, loses, parent, rank_of
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.workers import LOST_CLUSTER, Measured, Workers
from rgbmidic.results import QUANTITIES, FrameRecord, ResultStore
from rgbmidic.typing import AnyArray

logger = logging.getLogger(__name__)


_KEPT = ("u", "v", "node_status", "reference_updates", "best_match")
_STRAIN = ("exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std")
_MEASURED = ("u", "v", "u_std", "v_std", *_STRAIN, "node_status", "rigid")
"""Quantities of a frame that the next one starts from, and that it makes a reference with."""

Progress = Callable[[int, int, str], None]


class Schedule:
    """The frames of a test that are still to be measured.

    A frame starts from its parent in the tree of `rgbmidic.pipeline.order`, or, where that one failed, from where it
    started. A key frame that is not measured well from there is measured once more from the frame just before it, and
    the better of both is kept.
    """

    def __init__(self, plan: Plan, store: ResultStore, places: range) -> None:
        self._plan, self._store, self._places = plan, store, places
        self._finished = store.finished()
        self._wanted = np.zeros_like(self._finished)
        self._ready: list[tuple[int, Start]] = []
        self._waiting: dict[int, list[int]] = {}
        self._first_tries: dict[int, FrameRecord] = {}
        self._running: dict[Future[Measured], tuple[int, Start]] = {}
        for position in places:
            self._want(position)

    @property
    def done(self) -> bool:
        """Whether nothing is left to be measured."""
        return not (self._ready or self._running)

    def run(self, workers: Workers, progress: Progress | None = None) -> None:
        """Have frames measured, and keep each in the store as it finishes.

        Parameters
        ----------
        workers
            Who measures.
        progress
            Called after every frame with the number of frames done, their total and a line about the last one.

        Raises
        ------
        ResultError
            The store cannot be written.
        FrameError
            All files of the frames are gone.
        """
        while not self.done:
            while self._ready and len(self._running) < workers.slots:
                self._submit(workers, *self._next(workers.slots))
            for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                position, start = self._running.pop(future)
                self._take(position, start, self._outcome(future, position), progress)

    def _next(self, slots: int) -> tuple[int, Start]:
        """Take the frame that is to be measured next out of those that can be.

        Of the earliest chains, one more than several frames are measured at a time, it is that of the chain which is
        behind: at the end of a test none is left alone.
        """
        chains = nsmallest(slots + (slots > 1), self._ready, key=lambda one: one[0])
        found = min(chains, key=lambda one: one[0] % STRIDE)
        self._ready.remove(found)
        return found

    def _submit(self, workers: Workers, position: int, start: Start) -> None:
        last = start.reference_updates[-2:]  # all that the reference which they make depends on
        mesh, lights = self._plan.reference.mesh, len(self._plan.images.names)
        found = [_solution(mesh, lights, kept) for kept in self._store.table().each(_MEASURED, last)] if last else []
        future = workers.submit(self._index(position), start, list(zip(map(self._index, last), found, strict=True)))
        self._running[future] = position, start

    def _index(self, position: int) -> int:
        """Place in the series of a frame of the result."""
        return self._plan.series.chosen[position]

    def _outcome(self, future: Future[Measured], position: int) -> FrameRecord:
        """What a worker found, or why it found nothing."""
        try:
            measured = future.result()
        except CancelledError:
            raise RgbmidicError(LOST_CLUSTER) from None
        except Exception as error:  # a worker of a cluster that died over the frame more often than the cluster allows
            name = self._plan.series.name(self._index(position))
            logger.warning("a worker died while %s was measured (%s)", name, str(error) or type(error).__name__)
            return failed_frame(self._plan, self._index(position), f"its worker died: {type(error).__name__}")
        for level, text in measured.messages:
            logger.log(level, "%s", text)
        return measured.record

    def _take(self, position: int, start: Start, record: FrameRecord, progress: Progress | None) -> None:
        """Keep a record, or have the frame measured again, and release what waits for it."""
        if record.unread and (gone := self._plan.series.gone()):
            raise FrameError(f"the frames are gone: {gone}; go on with --resume when they are there again")
        first = self._first_tries.pop(position, None)
        if first is None and loses(position, record, start):
            self._first_tries[position] = record
            before = position - 1  # it may have to be measured first
            if self._finished[before]:
                self._ready.append((position, self._start_after(before)))
            else:
                self._waiting.setdefault(before, []).append(position)
                self._want(before)
            return
        if first is not None:
            record = better(first, record)
            record = replace(record, values={**record.values, "tries": 2})
        self._store.write_frame(position, record)
        self._finished[position] = True
        next_start = following(self._plan, record.values, start)
        released = [child for child in children(position, len(self._finished)) if self._wanted[child]]
        for after in (*released, *self._waiting.pop(position, ())):
            self._ready.append((after, next_start))
        if progress is not None:
            places = self._places
            done, status = int(self._finished[places.start : places.stop].sum()), Status(record.status)
            line = f"{status.name.lower().replace('_', ' ')}: {record.reason}"
            if status is Status.CONVERGED:
                measured = 1 - rank_of(record)[1]
                line = f"converged in {record.iterations} iterations, {measured:.0%} of the nodes measured"
            progress(done, len(places), f"{self._plan.series.name(self._index(position))}: {line}")

    def _want(self, position: int) -> None:
        """Have a frame measured, and all that it depends on."""
        first = None
        for place in lineage(position):
            if self._finished[place]:
                break
            if self._wanted[place]:
                return
            self._wanted[place], first = True, place
        if first is not None:
            before = parent(first)
            self._ready.append((first, Start(displacement=None) if before is None else self._start_after(before)))

    def _start_after(self, position: int) -> Start:
        """Where a frame starts that follows a finished one: from the last that is measured up to there.

        Where a frame failed all before it are finished, since a key frame that fails waits for the one before it.
        """
        table = self._store.table()
        for kept in table.each(_KEPT, range(position, -1, -1)):
            if (kept["node_status"] == NodeStatus.MEASURED).any():
                return following(self._plan, kept, Start(displacement=None))
        return Start(displacement=None)


def following(plan: Plan, kept: Mapping[str, Any], start: Start) -> Start:
    """Where a frame starts that follows one that started from `start` and of which this is kept."""
    measured = kept["node_status"] == NodeStatus.MEASURED
    if not measured.any():
        return start
    after = start.after(plan.reference.mesh, np.stack([kept["u"], kept["v"]], axis=1), measured)
    updates, best = tuple(kept["reference_updates"].tolist()), float(kept["best_match"])
    return replace(after, reference_updates=updates, best_match=best)


def _solution(mesh: Tri3Mesh, lights: int, kept: Mapping[str, Any]) -> Solution:
    """What a result keeps of a measured frame, as the solution that makes it a reference: the field table undone."""
    columns: dict[str, list[AnyArray]] = {}
    for name in _MEASURED:
        values = kept[name]
        attribute = QUANTITIES[name].source.partition(".")[0]
        columns.setdefault(attribute, []).append(values.astype(np.float64) if values.dtype.kind == "f" else values)
    found: dict[str, Any] = {
        name: np.stack(parts, axis=1) if len(parts) > 1 else parts[0] for name, parts in columns.items()
    }
    return replace(Solution.failed(mesh, lights, "", np.zeros(0)), **found)


def _error(future: Future[Measured]) -> BaseException | None:
    try:
        return future.exception()
    except CancelledError:
        raise RgbmidicError(LOST_CLUSTER) from None
