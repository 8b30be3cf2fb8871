"""What both commands share: every error is one line and an exit status, and sizes are written one way."""

from __future__ import annotations

import errno
import io
import logging
import re
import sys
import traceback
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rgbmidic.errors import InputError, RgbmidicError, disk_reason

if TYPE_CHECKING:
    import typer

__all__ = ["FAILURE", "execute", "fail", "help_where_alone", "main", "optional", "read_place", "read_shape"]

BAD_INPUT, FAILURE, INTERRUPTED = 2, 1, 130


def main(app: typer.Typer) -> None:
    """Run a command with the arguments of this process and end it; ``--debug`` shows where an error comes from."""
    from rich.console import Console
    from rich.logging import RichHandler

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names that are no text, as standard error prints them
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    handler = RichHandler(console=Console(stderr=True), show_time=False, show_path=False, markup=False)
    loggers = [logging.getLogger(name) for name in ("rgbmidic", "rgbmidic_calibration")]
    for logger in loggers:  # not the root: other libraries talk to programmers
        logger.addHandler(handler)
    status = execute(app, arguments, debug=len(arguments) < len(sys.argv) - 1)
    for logger in loggers:
        logger.removeHandler(handler)
    sys.exit(status)


def execute(app: typer.Typer, arguments: list[str], *, debug: bool = False) -> int:
    """Run a command; its exit status: 0, 1 where it failed, 2 where the input is wrong, 130 where it was stopped."""
    import typer

    try:
        status = app(args=arguments, standalone_mode=False) or 0
        if status != INTERRUPTED:  # typer's own answer to Ctrl-C
            return int(status)
        raise KeyboardInterrupt
    except (KeyboardInterrupt, typer.Abort):
        return fail("interrupted; what was finished is kept", INTERRUPTED)
    except Exception as error:  # the last resort of a command: whatever it is becomes one line and an exit status
        if debug:
            traceback.print_exc()
        if isinstance(error, RgbmidicError):
            return fail(str(error), BAD_INPUT)
        if (usage := getattr(error, "format_message", None)) is not None:  # typer's own, whichever click it brings
            return fail(usage() or str(error), BAD_INPUT)
        if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE):
            return fail(disk_reason(error), FAILURE)
        return fail(f"{type(error).__name__}: {error} (run again with --debug for the details)", FAILURE)


def fail(message: str, status: int) -> int:
    """Print an error as one line; gives the status back."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return status


def help_where_alone(context: typer.Context) -> None:
    """Print the help of a group of commands where none of them is named."""
    if context.invoked_subcommand is None:
        print(context.get_help())


def optional(module: str, extra: str) -> Any:
    """A module that needs packages of an extra.

    Raises
    ------
    InputError
        They are not installed.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("rgbmidic"):
            raise
        raise InputError(f'this needs the package {error.name}: pip install "rgbmidic[{extra}]"') from None


def read_place(text: str, option: str, form: str) -> tuple[float, ...]:
    """The numbers of a place that is stated in a `form` such as ``"X0,Y0:X1,Y1"``.

    Raises
    ------
    InputError
        It is not of that form.
    """
    groups = [part.split(",") for part in text.split(":")]
    try:
        numbers = [[float(number) for number in group] for group in groups]
    except ValueError:
        numbers = []
    if [len(group) for group in numbers] != [len(group.split(",")) for group in form.split(":")]:
        raise InputError(f"{option} is {form} in px, such as {_EXAMPLES[form]}, not {text!r}")
    return tuple(number for group in numbers for number in group)


_EXAMPLES = {"X,Y": "120,85.5", "X0,Y0:X1,Y1": "40,60:200,60", "X,Y:R": "120,85:30", "X,Y:LENGTH": "120,85:75"}


def read_shape(text: str | None) -> tuple[int, int] | None:
    """Rows and columns that ``--shape ROWSxCOLUMNS`` states (a comma will do as well); None where nothing is stated.

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
