"""What the commands of `rgbmidic` share: options, the result that they read, notes, tables and progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from typer import Argument, Option

from rgbmidic import command
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.results import Maps, Result
    from rgbmidic.settings import ScaleSettings, TestSettings

messages = Console(stderr=True)

Draw = Annotated[bool, Option("--figures/--no-figures", help="Write pictures into DIR/figures.")]
Measure = Annotated[str | None, Option(help="green-lagrange, hencky, biot or engineering.")]
Pixels = Annotated[bool, Option("--px", help="Lengths in px, though the scale is known.")]
Out = Annotated[Path, Option(help="Output folder; created if it does not exist.")]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
Test = Annotated[Path, Argument(metavar="TEST.toml", help="Settings of the test.")]
Workers = Annotated[int, Option(min=0, help="Frames at a time; 0: as many as cores.")]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Opened:
    """A result that a command reads, and the settings that stand in place of those it keeps, if any are stated."""

    result: Result
    settings: TestSettings | None

    @property
    def scale(self) -> ScaleSettings | None:
        """The scale of these settings; None: that of the result."""
        return None if self.settings is None else self.settings.scale

    def scale_in(self, *, px: bool) -> ScaleSettings | None:
        """The same, with lengths in px though the scale may be known."""
        from rgbmidic.settings import ScaleSettings

        return replace(self.scale or self.result.section(ScaleSettings), unit="px") if px else self.scale

    def maps(self, derived: Mapping[str, Any]) -> Maps:
        """The fields of the result, as the options of `derived_options` derive them."""
        from rgbmidic.results import Maps

        choices = dict(derived)
        return Maps.of(self.result, self.scale_in(px=choices.pop("px")), **choices)

    def frames(self, text: str) -> list[int] | None:
        """The measured ones of the frames that ``--frames`` states; None where it states none."""
        if (asked := command.read_frames(text)) is None:
            return None
        result, there = self.result, f"{self.result.path} has frames 0 to {len(self.result) - 1}"
        if max(asked) >= len(result):
            raise InputError(f"--frames {text}: {there}")
        if not (chosen := [frame for frame in asked if result.finished[frame]]):
            raise InputError(f"--frames {text}: none of them is measured; {there}")
        return chosen


def _open(options: Mapping[str, Any]) -> Opened:
    from rgbmidic.results import Result
    from rgbmidic.settings import read_test

    result, test = Result.open(options["result"], partial=options["partial"]), options["test"]
    return Opened(result=result, settings=None if test is None else read_test(test))


_RESULT_OPTIONS: dict[str, Any] = {
    "result": Annotated[Path, Argument(metavar="RESULT", help="Result folder that `rgbmidic run` wrote.")],
    "test": Annotated[
        Path | None,
        Option(help="TEST.toml whose [scale], [setup], [probes] and [channels] replace those of the result."),
    ],
    "partial": Annotated[bool, Option("--partial", help="Use the finished frames of an interrupted run.")],
}
opened_result = command.gather("opened", _RESULT_OPTIONS, _open, result=command.REQUIRED, partial=False)
"""Decorator of a command whose parameter `opened` is the result that it reads."""

_DERIVED: dict[str, Any] = {
    "gauge": Annotated[float | None, Option("--gauge-length", "--gauge", help="Virtual strain gauge, px.")],
    "measure": Measure,
    "since": Annotated[int | None, Option(metavar="N", help="Show the fields relative to frame N.")],
    "rigid_removed": Annotated[bool, Option("--remove-rigid", help="Remove the rigid motion.")],
    "window": Annotated[int | None, Option(help="Frames that a rate is taken over, 4 or more.")],
    "px": Pixels,
}
derived_options = command.gather("derived", _DERIVED, dict, rigid_removed=False, px=False)
"""Decorator of a command whose parameter `derived` states how fields are derived, as `rgbmidic.results.Maps.of`."""


def note(text: str) -> None:
    """Print a line on stderr as it is, however long."""
    messages.print(text, soft_wrap=True, markup=False, highlight=False)


def explain_first_run() -> None:
    """Print why the first run takes longer."""
    from rgbmidic._kernels import are_compiled

    if not are_compiled():
        note(
            "first run on this machine: kernels are compiled for its processor as they are needed, in all 15 to 40 s; "
            "later runs take them from a cache"
        )


def print_table(title: str, headings: list[str], rows: list[list[str]], words: Mapping[str, str] | None = None) -> None:
    """Print a table on stdout, and below it what words of its heading mean.

    It is as wide as it needs to be: where the terminal has fewer columns it breaks the lines, and nothing is cut off.
    """
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print(title)
    Console(soft_wrap=True, width=400).print(table)
    for heading, meaning in (words or {}).items():
        print(f"  {heading}: {meaning}")
    print()


@contextmanager
def progress_of(what: str) -> Iterator[Callable[[int, int, str], None]]:
    """A bar on stderr, and the function that moves it: frames done, their total, a line about the last one.

    Nothing is shown where nobody watches: an error stays one line, a log file stays short.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    rate, last = TextColumn("{task.fields[rate]}"), TextColumn("{task.fields[line]}", markup=False)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), rate, TimeRemainingColumn(), last)
    with Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal) as bar:
        task = bar.add_task(what, total=None, line="", rate="")

        def move(done: int, total: int, line: str) -> None:
            speed = bar.tasks[task].speed
            bar.update(task, completed=done, total=total, line=line, rate=f"{speed:.3g}/s" if speed else "")

        yield move
