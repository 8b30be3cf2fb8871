"""Where the time of a frame goes: seconds in every stage, what a stage calls of other stages not counted with it.

The bar that shows how far a long command has come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn

__all__ = ["STAGES", "each", "progress_bar", "stage", "timed"]

T = TypeVar("T")

STAGES = ("reading", "separation", "preparation", "search", "weights", "equations", "iteration", "conclusion", "rest")
"""Of a frame: its file; one image per light; normalised and interpolable images; a start; comparison with the reference
and the weights from it; Hessian and factors; Gauss-Newton; the field and its uncertainty; and all other work."""


class _Clock:
    """Gives the time since the last switch to the stage that was on."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._on, self._since = "rest", time.perf_counter()

    def switch(self, name: str) -> str:
        """Turn to a stage; the one before."""
        before, now = self._on, time.perf_counter()
        self.seconds[before] += now - self._since
        self._on, self._since = name, now
        return before


_clock: ContextVar[_Clock | None] = ContextVar("clock", default=None)


@contextmanager
def timed(wanted: bool = True) -> Iterator[dict[str, float]]:
    """Measure the stages of what is done within; the seconds of each are there at the end, none unless `wanted`."""
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
    """What is done within, or by the function decorated, belongs to a stage of `STAGES`."""
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
    """The items; finding the next one belongs to a stage, what is done with it does not."""
    left = iter(items)
    while True:
        with stage(name):
            found = next(left, _END)
        if found is _END:
            return
        yield found  # type: ignore[misc]


_END = object()


@contextmanager
def progress_bar(what: str, console: Console) -> Iterator[Callable[[int, int, str], None]]:
    """A bar, and the function that moves it: frames done, their total, a line about the last one.

    Nothing is shown where nobody watches: an error stays one line, a log file stays short.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    last = TextColumn("{task.fields[line]}", markup=False)
    with Progress(*columns, last, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None, line="")
        yield lambda done, total, line: bar.update(task, completed=done, total=total, line=line)


class _Rate(ProgressColumn):
    """Frames per second."""

    def render(self, task: Task) -> str:
        return f"{task.speed:.3g}/s" if task.speed else ""
