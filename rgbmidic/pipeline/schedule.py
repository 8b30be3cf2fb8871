"""The engine: frames are measured in the order of `rgbmidic.pipeline.order`, by workers, into a sink.

`rgbmidic.measure` runs it with threads or a cluster and a result folder, `rgbmidic.measure_sequence` with the latest
state alone and a few initial guesses.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from dataclasses import replace
from heapq import nsmallest
from typing import Any, Protocol

import numpy as np

from rgbmidic.correlation import NodeStatus, Start
from rgbmidic.errors import FrameError, RgbmidicError
from rgbmidic.pipeline.frame import Measured, failed_frame
from rgbmidic.pipeline.order import STRIDE, better, children, lineage, loses, parent
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.workers import LOST_CLUSTER, Updated, Workers

logger = logging.getLogger(__name__)


class Sink(Protocol):
    """Where measured frames go, by their places in the result."""

    def is_finished(self, place: int) -> bool:
        """Whether a frame is there already."""

    def start_after(self, place: int) -> Start:
        """Initial guess of the frames that follow a finished one."""

    def updated(self, places: Sequence[int]) -> Updated:
        """Frames that became the reference, for workers that make it of them."""

    def keep(self, place: int, found: Measured, after: Start) -> None:
        """Take a frame, and the initial guess of those that follow it."""


class Schedule:
    """The frames that are still to be measured.

    A frame starts from its parent in the tree, or, where that one failed, from where it started. A key frame that is
    not measured well from there is measured once more from the frame just before it, and the better of both is kept.
    """

    def __init__(self, plan: Plan, sink: Sink, places: Iterable[int] = ()) -> None:
        self._plan, self._sink = plan, sink
        self._ready = list[tuple[int, Start]]()
        self._wanted = set[int]()
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
        first = None
        for ancestor in lineage(place):
            if self._sink.is_finished(ancestor):
                break
            if ancestor in self._wanted:
                return
            self._wanted.add(ancestor)
            first = ancestor
        if first is not None:
            before = parent(first)
            self._ready.append((first, Start(displacement=None) if before is None else self._sink.start_after(before)))

    def run(self, workers: Workers) -> None:
        """Have workers measure the frames, and give each to the sink as it finishes.

        Raises
        ------
        ResultError
            The sink cannot be written.
        FrameError
            All files of the frames are gone.
        """
        running: dict[Future[Measured], tuple[int, Start]] = {}
        while self._ready or running:
            while self._ready and len(running) < workers.slots:
                place, start = self._next(workers.slots)
                last = start.reference_updates[-2:]  # all that the reference which they make depends on
                running[workers.submit(self._index(place), start, self._sink.updated(last))] = place, start
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                place, start = running.pop(future)
                self._take(place, start, self._outcome(future, place))

    def _next(self, slots: int) -> tuple[int, Start]:
        """Take the frame that is to be measured next out of those that can be.

        Of the earliest chains, one more than several frames are measured at a time, it is that of the chain which is
        behind: at the end of a test none is left alone.
        """
        chains = nsmallest(slots + (slots > 1), self._ready, key=lambda one: one[0])
        found = min(chains, key=lambda one: one[0] % STRIDE)
        self._ready.remove(found)
        return found

    def _index(self, place: int) -> int:
        """Place in the series of a frame of the result."""
        return self._plan.series.chosen[place]

    def _outcome(self, future: Future[Measured], place: int) -> Measured:
        """What a worker found, or why it found nothing."""
        try:
            found = future.result()
        except CancelledError:
            raise RgbmidicError(LOST_CLUSTER) from None
        except Exception as error:  # a worker of a cluster that died over the frame more often than the cluster allows
            index, kind = self._index(place), type(error).__name__
            name = self._plan.series.name(index)
            logger.warning("a worker died while %s was measured (%s)", name, str(error) or kind)
            return Measured(record=failed_frame(self._plan, index, f"its worker died: {kind}"))
        for level, text in found.messages:
            logger.log(level, "%s", text)
        return found

    def _take(self, place: int, start: Start, found: Measured) -> None:
        """Keep a frame, or have it measured again, and release what waits for it."""
        if found.record.unread and (gone := self._plan.series.gone()):
            raise FrameError(f"the frames are gone: {gone}; go on with --resume when they are there again")
        first = self._first_tries.pop(place, None)
        if first is None and loses(place, found.record, start):
            self._first_tries[place] = found
            before = place - 1  # it may have to be measured first
            if self._sink.is_finished(before):
                self._ready.append((place, self._sink.start_after(before)))
            else:
                self._waiting.setdefault(before, []).append(place)
                self.want(before)
            return
        if first is not None:
            record = better(first.record, found.record)
            tried = replace(record, values={**record.values, "tries": 2})
            found = replace(first if record is first.record else found, record=tried)
        after = following(self._plan, found.record.values, start)
        self._sink.keep(place, found, after)
        self._wanted.discard(place)
        released = [child for child in children(place, max(self._wanted, default=0) + 1) if child in self._wanted]
        self._ready += [(one, after) for one in (*released, *self._waiting.pop(place, ()))]


def following(plan: Plan, kept: Mapping[str, Any], start: Start) -> Start:
    """Where a frame starts that follows one that started from `start` and of which this is kept."""
    measured = kept["node_status"] == NodeStatus.MEASURED
    if not measured.any():
        return start
    after = start.after(plan.reference.mesh, np.stack([kept["u"], kept["v"]], axis=1), measured)
    updates, best = tuple(kept["reference_updates"].tolist()), float(kept["best_match"])
    return replace(after, reference_updates=updates, best_match=best)
