"""A bar on stderr for people who watch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn


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
