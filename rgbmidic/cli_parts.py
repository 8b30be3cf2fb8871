"""What the commands of `rgbmidic` share: options, notes, tables and progress."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from rgbmidic import command
from rgbmidic.errors import InputError

if TYPE_CHECKING:
    from rgbmidic.results import Result
    from rgbmidic.settings import TestSettings

_WIDE = 400
"""Columns that a table may take: where the terminal has fewer it breaks the lines, and nothing is cut off."""


messages = Console(stderr=True)


def note(text: str) -> None:
    """Print a line on stderr as it is, however long."""
    messages.print(text, soft_wrap=True, markup=False, highlight=False)


def read_settings(test: Path | None) -> TestSettings | None:
    """Settings of a TEST.toml, None where none is stated."""
    from rgbmidic.settings import read_test

    return None if test is None else read_test(test)


Out = Annotated[Path, typer.Option("--out", help="Output folder; created if it does not exist.")]


Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]


Reading = Annotated[
    Path | None,
    typer.Option(
        "--test", help="TEST.toml whose [scale], [setup], [probes] and [channels] replace those of the result."
    ),
]


Partial = Annotated[bool, typer.Option("--partial", help="Use the finished frames of an interrupted run.")]


Measure = Annotated[str | None, typer.Option("--measure", help="green-lagrange, hencky, biot or engineering.")]


_DERIVED: dict[str, Any] = {
    "gauge": Annotated[float | None, typer.Option("--gauge-length", "--gauge", help="Virtual strain gauge, px.")],
    "measure": Measure,
    "since": Annotated[int | None, typer.Option("--since", metavar="N", help="Show the fields relative to frame N.")],
    "rigid_removed": Annotated[bool, typer.Option("--remove-rigid", help="Remove the rigid motion.")],
    "window": Annotated[int | None, typer.Option("--window", help="Frames that a rate is taken over, 4 or more.")],
}
"""Options that state how fields are derived, by the keys of `rgbmidic.results.Maps.of`."""


derived_options = command.gather("derived", _DERIVED, lambda options: options, rigid_removed=False)


def chosen_frames(result: Result, text: str) -> list[int] | None:
    """The measured ones of the frames that ``--frames`` states; None where it states none."""
    if (asked := command.read_frames(text)) is None:
        return None
    if max(asked) >= len(result):
        raise InputError(f"--frames {text}: {result.path} has frames 0 to {len(result) - 1}")
    chosen = [frame for frame in asked if result.finished[frame]]
    if not chosen:
        raise InputError(f"--frames {text}: none of them is measured; {result.path} has frames 0 to {len(result) - 1}")
    return chosen


def explain_first_run() -> None:
    """Print why the first run takes longer."""
    from rgbmidic._kernels import are_compiled

    if not are_compiled():
        note(
            "first run on this machine: kernels are compiled for its processor as they are needed, in all some 40 s; "
            "later runs take them from a cache"
        )


def print_table(title: str, headings: list[str], rows: list[list[str]], words: Mapping[str, str] | None = None) -> None:
    """Print a table on stdout, and below it what words of its heading mean."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print(title)
    Console(soft_wrap=True, width=_WIDE).print(table)
    for heading, meaning in (words or {}).items():
        print(f"  {heading}: {meaning}")
    print()


def progress_of(what: str) -> AbstractContextManager[Callable[[int, int, str], None]]:
    """A bar on stderr for people who watch, see `rgbmidic.timing`."""
    from rgbmidic.progress import progress_bar

    return progress_bar(what, messages)
