"""Parts of both commands: errors become one line and an exit status, several commands take the same options.

And how those of `rgbmidic` print notes, tables and progress.
"""

from __future__ import annotations

import errno
import inspect
import io
import logging
import math
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from typer import Argument, Option
from typer.core import TyperGroup

from rgbmidic.errors import ConfigurationError, InputError, RgbmidicError, disk_reason, shorten

if TYPE_CHECKING:
    from rgbmidic.illumination.calibration import TargetLights

BAD_INPUT, FAILURE, INTERRUPTED = 2, 1, 130
REQUIRED = inspect.Parameter.empty

messages = Console(stderr=True)

Draw = Annotated[bool, Option("--figures/--no-figures", help="Write pictures into DIR/figures.")]
Measure = Annotated[str | None, Option(help="green-lagrange, hencky, biot or engineering.")]
Pixels = Annotated[bool, Option("--px", help="Lengths in px, though the scale is known.")]
Out = Annotated[Path, Option(help="Output folder; created if it does not exist.")]
Overwrite = Annotated[bool, Option("--overwrite", help="Replace existing files.")]
Test = Annotated[Path, Argument(metavar="TEST.toml", help="Settings of the test.")]
Workers = Annotated[int, Option(min=0, help="Frames at a time; 0: as many as cores.")]

FRAME_OPTIONS: dict[str, Any] = {
    "kind": Annotated[str | None, Option(help="bayer, rgb (3-CCD), monochrome; else as the files state, else bayer.")],
    "cfa": Annotated[str | None, Option(help="Bayer pattern RGGB, BGGR, GRBG or GBRG.")],
    "black_level": Annotated[float | None, Option(help="Grey level of a dark sample, DN.")],
    "white_level": Annotated[float | None, Option(help="Smallest saturated grey level, DN.")],
    "shape": Annotated[str | None, Option(help="ROWSxCOLUMNS of a headerless file, such as 512x768.")],
    "dtype": Annotated[str | None, Option(help="uint8, uint16 or >u2, of a headerless file.")],
}
"""Options that state what the files of frames do not, by the keys of ``[frames]``."""


TARGET_LIGHT_OPTIONS: dict[str, Any] = {
    "light": Annotated[
        list[str] | None,
        Option(help="NAME of the light under which the target was photographed; once per light where several were on."),
    ],
    "calibration": Annotated[
        Path | None, Option(help="Calibration file: its registration carries the scale to the first light's pixels.")
    ],
    "crop_origin": Annotated[
        str | None, Option(metavar="X,Y", help="Column and row of the calibrated frame at which the photograph begins.")
    ],
}
"""Options that state the light of a photograph from which a scale is taken."""


def read_target_lights(options: Mapping[str, Any]) -> TargetLights | None:
    """Return the lights that `TARGET_LIGHT_OPTIONS` state, with their calibration; None if they state nothing.

    Raises
    ------
    ConfigurationError
        Some are stated without the others.
    CalibrationError
        The calibration cannot be read, or has no registration of these lights.
    """
    names, file, crop = options["light"] or [], options["calibration"], options["crop_origin"]
    if names and file is not None:
        from rgbmidic.illumination.calibration import Calibration, TargetLights

        origin = None
        if crop is not None:
            x, y = read_coordinates(crop, "--crop-origin", "X,Y")
            if min(x, y) < 0 or x % 1 or y % 1:
                raise ConfigurationError(f"--crop-origin takes whole numbers from 0, not {crop!r}")
            origin = (int(x), int(y))
        return TargetLights(names=tuple(names), calibration=Calibration.read(file), crop_origin=origin)
    if names:
        raise ConfigurationError("--light needs --calibration, the file whose registration has that light")
    if file is not None or crop is not None:
        option = "--calibration" if file is not None else "--crop-origin"
        raise ConfigurationError(f"{option} is of use only with --light, the light of the photograph: state it too")
    return None


def application(name: str, cls: type[TyperGroup] = TyperGroup) -> typer.Typer:
    """Make an application whose help is plain text and whose errors `main` reports."""
    return typer.Typer(
        name=name,
        cls=cls,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def main(app: typer.Typer) -> None:
    """Run a command with the arguments of this process and end it; ``--debug`` shows where an error comes from."""
    from rich.logging import RichHandler

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names that are no text, as standard error prints them
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    handler = RichHandler(console=Console(stderr=True), show_time=False, show_path=False, markup=False)
    handler.addFilter(OnceFilter())
    handler.setFormatter(OptionFormatter())
    loggers = [logging.getLogger(name) for name in ("rgbmidic", "rgbmidic_calibration")]
    for logger in loggers:  # not the root: other libraries talk to programmers
        logger.addHandler(handler)
    status = execute(app, arguments, debug=len(arguments) < len(sys.argv) - 1)
    for logger in loggers:
        logger.removeHandler(handler)
    sys.exit(status)


class OptionFormatter(logging.Formatter):
    """A formatter that reports the arguments that a message of the library names as options."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a record."""
        return name_options(super().format(record))


class OnceFilter(logging.Filter):
    """A filter that passes each text once: a message repeated for another mesh or file of a test is one line."""

    def __init__(self) -> None:
        super().__init__()
        self._texts = set[str]()

    def filter(self, record: logging.LogRecord) -> bool:
        """Report whether the text of a record is new."""
        is_new = (text := record.getMessage()) not in self._texts
        self._texts.add(text)
        return is_new


def execute(app: typer.Typer, arguments: list[str], *, debug: bool = False) -> int:
    """Run a command and return its exit status: 0, 1 if it failed, 2 if the input is wrong, 130 if it was stopped."""
    previous_handler = signal.signal(
        signal.SIGTERM, signal.default_int_handler
    )  # as Ctrl-C, which a background job ignores
    try:
        status = app(args=arguments, standalone_mode=False) or 0
        if status != INTERRUPTED:  # typer's own answer to Ctrl-C
            return int(status)
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        return fail("interrupted; what was finished is kept", INTERRUPTED)
    except Exception as error:  # the last resort of a command: whatever it is becomes one line and an exit status
        if isinstance(error, typer.Abort) and isinstance(error.__cause__, EOFError):
            error = error.__cause__  # which typer takes for Ctrl-D; no command asks for input: a file ended early
        if debug:
            traceback.print_exc()
        if isinstance(error, RgbmidicError):
            return fail(str(error), BAD_INPUT)
        if (usage := getattr(error, "format_message", None)) is not None:  # typer's own, whichever click it brings
            return fail(usage() or str(error), BAD_INPUT)
        if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
            return fail(disk_reason(error))
        return fail(f"{type(error).__name__}: {error} (run again with --debug for the details)")
    finally:
        signal.signal(signal.SIGTERM, previous_handler)


def fail(message: str, status: int = FAILURE) -> int:
    """Print an error as one line and return the status."""
    print(f"error: {shorten(' '.join(name_options(message).split()))}", file=sys.stderr)
    return status


_ARGUMENT = re.compile("`([a-z_]+)(=True)?`")
_OPTIONS = {
    "point_pairs": "points", "points": "point", "scale": "test",
    "lights": "light", "flats": "flat", "simultaneous": "together",
    "angle_deg": "stereo",
}  # fmt: skip
"""Options that have another name than the argument that they state."""


def name_options(message: str) -> str:
    """Replace the arguments of functions that a message of the library names, such as `overwrite=True`, by options."""
    return _ARGUMENT.sub(lambda match: f"--{_OPTIONS.get(match[1], match[1]).replace('_', '-')}", message)


def print_help_without_command(context: typer.Context) -> None:
    """Print the help of a group of commands if none of them was given."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def collect_options(
    name: str, options: Mapping[str, Any], convert: Callable[[dict[str, Any]], Any], **defaults: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a decorator of a command whose parameter `name` is built from several options.

    Parameters
    ----------
    name
        Parameter of the command; it gets the value that `convert` returns for the options.
    options
        Annotated type of every option by its key.
    convert
        Function of the options' values by key.
    **defaults
        Values of options that are left out, None where none is given here; ``REQUIRED`` for one that may not be.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @wraps(function)
        def wrapper(**values: Any) -> None:
            option_values = {key: values.pop(key) for key in options}
            function(**values, **{name: convert(option_values)})

        signature = inspect.signature(function, eval_str=True)
        parameters: list[inspect.Parameter] = []
        for parameter in signature.parameters.values():
            hints = options if parameter.name == name else {parameter.name: parameter.annotation}
            kind = inspect.Parameter.KEYWORD_ONLY
            for key, hint in hints.items():
                default = defaults.get(key) if parameter.name == name else parameter.default
                parameters.append(inspect.Parameter(key, kind, default=default, annotation=hint))
        wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        vars(wrapper)["__signature__"] = signature.replace(parameters=parameters)
        return wrapper

    return decorate


def read_coordinates(text: str, option: str, template: str) -> tuple[float, ...]:
    """Return the finite numbers of a `template` such as ``"X0,Y0:X1,Y1"``, or with commas between all of them.

    Raises
    ------
    InputError
        They are not of that form.
    """
    templates = (template, template.replace(":", ","), template.replace("Y0,X1", "Y0:X1"))
    comma_counts = [[group.count(",") for group in pattern.split(":")] for pattern in (*templates, text)]
    numbers = _numbers(text.replace(":", ","))
    if not numbers or comma_counts[-1] not in comma_counts[:-1] or not all(map(math.isfinite, numbers)):
        unit = " in px" if "X" in template and "MM" not in template else ""
        raise InputError(f"{option} is {template}{unit}, such as {_EXAMPLES[template]}, not {text!r}")
    return numbers


def read_pair(text: str, option: str) -> tuple[float, float]:
    """Return the two finite numbers of ``LOW:HIGH``; an `InputError` where it is something else."""
    low, high = read_coordinates(text, option, "LOW:HIGH")
    return low, high


def _numbers(text: str) -> tuple[float, ...]:
    """Return the numbers between commas; an empty tuple if the text is something else."""
    try:
        return tuple(float(token) for token in text.split(","))
    except ValueError:
        return ()


def read_frames(text: str, option: str = "--frames") -> list[int] | None:
    """Return the indices of frames that an option states, such as ``"0,5,10:20"`` (10 to 19); None if it is empty.

    Raises
    ------
    InputError
        It is something else.
    """
    if not text:
        return None
    matches = [re.fullmatch(r"\s*(\d{1,15})\s*(?::\s*(\d{1,15})\s*)?", token) for token in text.split(",")]
    ranges = [range(int(match[1]), int(match[2] or int(match[1]) + 1)) for match in matches if match]
    if len(ranges) < len(matches) or not all(ranges) or sum(map(len, ranges)) > 10**7:  # more are a slip
        raise InputError(f"{option} are indices and ranges such as 0,5,10:20 (10 to 19), not {text!r}")
    return [*chain(*ranges)]


_EXAMPLES = {
    "X,Y": "120,85.5",
    "X0,Y0:X1,Y1": "40,60:200,60",
    "X,Y:R": "120,85:30",
    "X,Y:LENGTH": "120,85:75",
    "X,Y:R0,R1": "120,85:60,110",
    "X0,Y0,X1,Y1": "40,60,200,160",
    "X_MM,Y_MM:X_PX,Y_PX": "0,12.5:40,610",
    "LOW:HIGH": "-0.01:0.01",
}


def picture_path(table: Path) -> Path:
    """Return the path of the picture beside a table; an `InputError` if that is the table itself."""
    if table.suffix.lower() == ".png":
        raise InputError(f"--out is the table, such as {table.with_suffix('.csv').name}, not {table.name!r}")
    return table.with_suffix(".png")


def read_lengths(text: str, option: str) -> tuple[float, ...]:
    """Return different positive lengths in px between commas; an `InputError` if the text is something else."""
    values = _numbers(text)
    is_invalid = len(set(values)) < len(values) or not all(math.isfinite(value) and value > 0 for value in values)
    if is_invalid or (text.strip() and not values):
        requirement = "different lengths in px with commas between them, such as 10,16,25"
        raise InputError(f"{option} are {requirement}, not {text!r}")
    return values


def read_statement(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of `FRAME_OPTIONS` that are stated, as `rgbmidic.settings.FrameSettings` takes them.

    Raises
    ------
    InputError
        ``--shape`` has another form than ROWSxCOLUMNS.
    """
    values = {**options, "shape": read_shape(options["shape"])}
    return {key: value for key, value in values.items() if value is not None}


frame_options = collect_options("statement", FRAME_OPTIONS, read_statement)
"""Decorator of a command whose parameter `statement` holds what the `FRAME_OPTIONS` state."""


def read_shape(text: str | None) -> tuple[int, int] | None:
    """Return the rows and columns of ``--shape ROWSxCOLUMNS`` (a comma will do as well); None if it is empty.

    Raises
    ------
    InputError
        Anything else.
    """
    if not text:
        return None
    size = re.fullmatch(r"(\d+)[x,](\d+)", text)
    if not size:
        raise InputError(f"--shape is ROWSxCOLUMNS, such as 512x768, not {text!r}")
    return int(size[1]), int(size[2])


def note(text: str) -> None:
    """Print a line on stderr as it is, however long."""
    messages.print(text, soft_wrap=True, markup=False, highlight=False)


def print_table(
    title: str, headings: list[str], rows: list[list[str]], glossary: Mapping[str, str] | None = None
) -> None:
    """Print a table on stdout, and below it a glossary of its headings.

    It is as wide as it needs to be: where the terminal has fewer columns it breaks the lines, and nothing is cut off.
    """
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    print(title)
    Console(soft_wrap=True, width=400, markup=False).print(table)  # a name may have brackets
    for heading, explanation in (glossary or {}).items():
        print(f"  {heading}: {explanation}")
    print()


@contextmanager
def progress_bar(task_name: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show a progress bar on stderr and yield the function that moves it: frames done, their total, a last line.

    Nothing is shown if stderr is no terminal: an error stays one line, a log file stays short. A note says why the
    first run takes longer.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from rgbmidic._kernels import are_compiled

    if not are_compiled():
        note(
            "first run on this machine: kernels are compiled for its processor as they are needed, in all 15 to 40 s; "
            "later runs take them from a cache"
        )
    rate, last_line = TextColumn("{task.fields[rate]}"), TextColumn("{task.fields[line]}", markup=False)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        rate,
        TimeRemainingColumn(),
        last_line,
    )
    with Progress(*columns, console=messages, transient=True, disable=not messages.is_terminal) as bar:
        task = bar.add_task(task_name, total=None, line="", rate="")

        def move(done: int, total: int, line: str) -> None:
            speed = bar.tasks[task].speed
            bar.update(task, completed=done, total=total, line=line, rate=f"{speed:.3g}/s" if speed else "")

        yield move
