"""The errors rgbmidic raises: one base class, so that a command can turn any of them into one clear line.

Every message says what is wrong, what is allowed and what was given, and names the file or key it is about.
"""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from rgbmidic.renamed import refuse_old_names

_LONG_WORD, _LONGEST = re.compile(r"\S{1000,}"), 4000
"""Characters that no name of a file or key has (Linux allows 255 for a name), and a screenful of them."""
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")


def printable(name: str | os.PathLike[str]) -> str:
    r"""Return a file's name as text that can be printed and stored: bytes that are not UTF-8 as ``\xff``."""
    return os.fspath(name).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def disk_reason(error: OSError) -> str:
    """Return in a few words why a file cannot be opened, read or written."""
    if error.errno not in (errno.EMFILE, errno.ENFILE):
        return error.strerror or str(error)
    return f"{error.strerror}: this process may open no more (ulimit -n shows the limit and raises it)"


def first_line(error: Exception) -> str:
    """Return the first line of another library's message; the error's name if it has none, as a MemoryError."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__


def shorten(line: str) -> str:
    """Shorten long words of a message, and a message of more than some 4,000 characters."""
    line = _LONG_WORD.sub(lambda word: f"{word[0][:100]}...{word[0][-40:]} ({len(word[0])} characters)", line)
    if len(line) > _LONGEST:
        line = f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 4 :]} (shortened from {len(line)} characters)"
    return line


class RgbmidicError(Exception):
    r"""Base of all errors that rgbmidic raises on purpose.

    The message is one line: line ends and other control characters, which come from damaged files and from other
    libraries, stand in it as ``\n``, ``\x1b``. What it quotes of a file is cut where it is longer than a reader needs.

    Examples
    --------
    >>> issubclass(InputError, RgbmidicError) and issubclass(InputError, ValueError)
    True
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(shorten(_CONTROL.sub(lambda match: ascii(match[0])[1:-1], printable(message))))


class InputError(RgbmidicError, ValueError):
    """An array or value handed to a function is not what the function accepts."""


class ConfigurationError(RgbmidicError, ValueError):
    """A configuration file has a missing, unknown, misspelt or contradictory entry."""


class FrameError(RgbmidicError, ValueError):
    """A frame file is missing, damaged, or not the raw frame it is said to be."""


class CalibrationError(RgbmidicError, ValueError):
    """A calibration file or capture is missing, damaged, outdated or unusable."""


class RegionError(RgbmidicError, ValueError):
    """A region of interest is empty, outside the image or too small for one element."""


class ResultError(RgbmidicError, ValueError):
    """A result folder is missing, damaged, or would be overwritten."""


class AnotherTestError(ResultError):
    """A result is of other settings, calibration or frames than those that are to be gone on with."""


@contextmanager
def convert_disk_errors(error_type: type[RgbmidicError], failure: str) -> Iterator[None]:
    """Convert an OSError inside the block into an `error_type` that states the `failure` and its reason."""
    try:
        yield
    except OSError as error:
        raise error_type(f"{failure}: {disk_reason(error)}") from None


def damaged_file(path: Path, reason: object) -> FrameError:
    """Return the error for a file that cannot be read whole."""
    return FrameError(f"{path} is damaged or truncated: {reason}")


@contextmanager
def library_faults(path: Path, *allowed: type[Exception]) -> Iterator[None]:
    """Turn what another library raises over a damaged file, in many kinds, into a FrameError; but for `allowed`."""
    try:
        yield
    except Exception as error:
        if isinstance(error, (RgbmidicError, *allowed)):
            raise
        raise damaged_file(path, first_line(error)) from None


def import_optional(module: str, extra: str) -> Any:
    """Import a module that needs the packages of an extra.

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


__getattr__ = refuse_old_names(__name__)
