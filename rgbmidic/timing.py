"""Time that each stage of a frame takes.

The time of a stage that another one calls does not count with the caller.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

T = TypeVar("T")

STAGES = ("reading", "separation", "preparation", "search", "weights", "equations", "iteration", "conclusion", "rest")
"""Of a frame: its file; one image per light; filtered and interpolable images; an initial guess; comparison with the
reference and the weights from it; Hessian and factors; Gauss-Newton; the field and its uncertainty; all other work."""


_current: ContextVar[tuple[str, dict[str, float]] | None] = ContextVar("on", default=None)
"""Present stage, and the seconds of all stages."""


@contextmanager
def record_stages(enabled: bool = True) -> Iterator[dict[str, float]]:
    """Measure the seconds of every stage within the block; the dict is complete at its end, empty unless `enabled`."""
    if not enabled:
        yield {}
        return
    seconds = dict.fromkeys(STAGES, 0.0)
    token = _current.set(("rest", seconds))
    try:
        with stage("rest"):
            yield seconds
    finally:
        _current.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time within the block, or of the function decorated, to a stage of `STAGES`."""
    if (current := _current.get()) is None:
        yield
        return
    _, seconds = current
    token, start_time, seconds_before = _current.set((name, seconds)), time.perf_counter(), sum(seconds.values())
    try:
        yield
    finally:  # without what the stages within have counted
        seconds[name] += time.perf_counter() - start_time - (sum(seconds.values()) - seconds_before)
        _current.reset(token)


def timed_items(name: str, items: Iterable[T]) -> Iterator[T]:
    """Yield the items; the time to find the next one counts to a stage, the time of its use does not."""
    iterator = iter(items)
    while True:
        with stage(name):
            try:
                item = next(iterator)
            except StopIteration:
                return
        yield item
