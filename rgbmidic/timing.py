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
"""Of a frame: its file; one image per light; normalised and interpolable images; an initial guess; comparison with the
reference and the weights from it; Hessian and factors; Gauss-Newton; the field and its uncertainty; all other work."""


_on: ContextVar[tuple[str, dict[str, float]] | None] = ContextVar("on", default=None)
"""Stage that is on, and the seconds of all."""


@contextmanager
def timed(wanted: bool = True) -> Iterator[dict[str, float]]:
    """Measure the seconds of every stage within the block; the dict is complete at its end, empty unless `wanted`."""
    if not wanted:
        yield {}
        return
    seconds = dict.fromkeys(STAGES, 0.0)
    token = _on.set(("rest", seconds))
    try:
        with stage("rest"):
            yield seconds
    finally:
        _on.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time within the block, or of the function decorated, to a stage of `STAGES`."""
    if (outer := _on.get()) is None:
        yield
        return
    _, seconds = outer
    token, started, counted = _on.set((name, seconds)), time.perf_counter(), sum(seconds.values())
    try:
        yield
    finally:  # without what the stages within have counted
        seconds[name] += time.perf_counter() - started - (sum(seconds.values()) - counted)
        _on.reset(token)


def each(name: str, items: Iterable[T]) -> Iterator[T]:
    """Yield the items; the time to find the next one counts to a stage, the time of its use does not."""
    left = iter(items)
    while True:
        with stage(name):
            try:
                found = next(left)
            except StopIteration:
                return
        yield found
