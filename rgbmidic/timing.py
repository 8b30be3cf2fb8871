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


class _Clock:
    """Clock of one frame: every switch adds the time since the last one to the stage that was on."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._on, self._since = "rest", time.perf_counter()

    def switch(self, name: str) -> str:
        """Switch to a stage and return the one before."""
        before, now = self._on, time.perf_counter()
        self.seconds[before] += now - self._since
        self._on, self._since = name, now
        return before


_clock: ContextVar[_Clock | None] = ContextVar("clock", default=None)


@contextmanager
def timed(wanted: bool = True) -> Iterator[dict[str, float]]:
    """Measure the seconds of every stage within the block; the dict is complete at its end, empty unless `wanted`."""
    if not wanted:
        yield {}
        return
    clock = _Clock()
    token = _clock.set(clock)
    try:
        yield clock.seconds
    finally:
        clock.switch("rest")
        _clock.reset(token)


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time within the block, or of the function decorated, to a stage of `STAGES`."""
    clock = _clock.get()
    if clock is None:
        yield
        return
    before = clock.switch(name)
    try:
        yield
    finally:
        clock.switch(before)


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
