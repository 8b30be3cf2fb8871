"""Values of a settings file converted to what the schema says, and back."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from rgbmidic.errors import ConfigurationError


def read_table(document: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Keys and values of a section of a file; empty where the section is not there.

    Parameters
    ----------
    document
        Sections of the file.
    name
        Of the section.

    Returns
    -------
    dict

    Raises
    ------
    ConfigurationError
        It is no section.
    """
    table = document.get(name, {})
    if not isinstance(table, Mapping):
        raise ConfigurationError(f"[{name}] must be a section with keys, not {table!r}")
    return dict(table)


def regular(path: Path) -> Path:
    """The path itself, unless a pipe, a socket or a device is there: to open one may wait, and to read it never end.

    Every file that is read is opened as this gives it. One that is missing is left for the opening to report.

    Parameters
    ----------
    path
        Of a file that is to be read.

    Returns
    -------
    Path

    Raises
    ------
    OSError
        It is not a regular file.
    """
    if "\0" in str(path):
        raise OSError("its name holds a NUL")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError("it is not a regular file but a pipe, a socket or a device")
    return path


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The sections of a TOML file.

    Parameters
    ----------
    path
        The file.
    what
        The file in words, for messages.

    Returns
    -------
    dict

    Raises
    ------
    ConfigurationError
        The file, `what` in words, is missing or not TOML.
    """
    try:
        return tomllib.loads(regular(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigurationError(f"{what} not found: {path}") from None
    except (OSError, ValueError) as error:  # text that is no UTF-8 or no TOML, a number of too many digits
        raise ConfigurationError(f"{path} is not a readable {what} (TOML): {error}") from None
    except RecursionError:
        raise ConfigurationError(f"{path} is not a readable {what} (TOML): nested too deeply") from None


def check_names(given: Iterable[str], allowed: Iterable[str], what: str, where: str) -> None:
    """Refuse a name that is not allowed.

    Parameters
    ----------
    given, allowed
        Names.
    what, where
        Noun for the names, and the place where they stand, for the message.

    Raises
    ------
    ConfigurationError
        A given name is not allowed; the message holds the closest one that is.
    """
    allowed = list(allowed)
    for name in given:
        if name not in allowed:
            close = difflib.get_close_matches(name, allowed, n=1)
            hint = f' (did you mean "{close[0]}"?)' if close else ""
            raise ConfigurationError(f'unknown {what} "{name}" in {where}{hint}; allowed are {", ".join(allowed)}')


_WORDS = {
    bool: "true or false",
    float: "a number",
    int: "a whole number",
    str: "a text in quotes",
    Path: "a file name in quotes",
}


def convert_value(value: Any, hint: Any, where: str, base: Path | str = "") -> Any:
    """A value converted to the type of a field.

    Parameters
    ----------
    value
        As TOML or Python gives it; numpy's scalars and arrays count as Python's.
    hint
        Type of the field.
    where
        Section and key, for messages.
    base
        Folder that relative paths start from.

    Returns
    -------
    object
        Of the type of the field.

    Raises
    ------
    ConfigurationError
        The value cannot be converted without a loss.
    """
    value, origin, kinds = _python(value), get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):  # X | None; a number | a word
        if value is None and NoneType in kinds:
            return None
        words = [word for kind in kinds[1:] if get_origin(kind) is Literal for word in get_args(kind)]
        if (type(value), value) in ((type(word), word) for word in words):  # 1 is no True
            return value
        if words and isinstance(value, str):
            known = ", ".join(_quoted(word) if isinstance(word, str) else str(word).lower() for word in words)
            raise ConfigurationError(f"{where} must be {_WORDS[kinds[0]]} or {known}, not {_quoted(value)}")
        return convert_value(value, kinds[0], where, base)
    if origin is tuple:
        return _convert_list(value, kinds, where, base)
    # ndarray; from numpy 2.5 on the alias NDArray itself. The class checks the shape of its arrays
    if str(getattr(origin, "__module__", "")).partition(".")[0] == "numpy":
        return value
    if origin is Literal:
        if value in kinds:
            return value
        raise ConfigurationError(f"{where} must be one of {', '.join(map(_quoted, kinds))}, not {_quoted(value)}")
    if isinstance(value, str | PurePath) and hint in (str, Path):
        return str(value) if hint is str else Path(base) / value
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ConfigurationError(f"{where} is a number of {len(str(abs(value)))} digits: TOML has up to 2**63")
    if isinstance(value, int | float if hint is float else hint) and isinstance(value, bool) == (hint is bool):
        return value if is_dataclass(hint) else hint(value)
    raise ConfigurationError(f"{where} must be {_WORDS.get(hint) or hint.__name__}, not {_quoted(value)}")


def _python(value: Any) -> Any:
    """Scalars and arrays of numpy as Python's, at any depth."""
    if type(value).__module__ == "numpy":
        value = value.tolist()
    return tuple(map(_python, value)) if isinstance(value, list | tuple) else value


def read_range(text: str, where: str) -> range:
    """The whole numbers that ``"a:b"`` stands for: a and all up to b, without b.

    Parameters
    ----------
    text
        Such as ``"0:20"``.
    where
        Section and key, or option, for messages.

    Returns
    -------
    range

    Raises
    ------
    ConfigurationError
        It is something else, or nothing is in it.
    """
    found = re.fullmatch(r"\s*(\d{1,18})\s*:\s*(\d{1,18})\s*", text)
    if not found or int(found[1]) >= int(found[2]):
        raise ConfigurationError(f'{where} must be a range such as "0:20" (0 to 19), not {_quoted(text)}')
    return range(int(found[1]), int(found[2]))


_LONGEST = 100_000
"""Most frames in a range for an average. A reference of n frames adds 1/n to a frame's variance: 100 are enough, and
this is a thousand times that. A longer range is a slip, and took a minute and 3 GB until the frames refused it."""


def _convert_list(value: Any, kinds: tuple[Any, ...], where: str, base: Path | str) -> tuple[Any, ...]:
    if kinds == (int, Ellipsis) and isinstance(value, str):
        value = read_range(value, where)
    if isinstance(value, range):
        if len(value) > _LONGEST:
            raise ConfigurationError(f"{where} names {len(value)} frames; at most {_LONGEST} are allowed")
        value = tuple(value)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        entries = value if _depth(value) > _hint_depth(kinds[0]) else [value]  # a single one needs no brackets
        return tuple(convert_value(entry, kinds[0], where, base) for entry in entries)
    if not isinstance(value, tuple) or len(value) != len(kinds):
        raise ConfigurationError(f"{where} must be {len(kinds)} values in brackets, not {_quoted(value)}")
    return tuple(convert_value(entry, kind, where, base) for entry, kind in zip(value, kinds, strict=True))


def _depth(value: Any) -> int:
    """How deep lists are nested in a value; an empty one may be of any depth."""
    return 1 + min(map(_depth, value), default=9) if isinstance(value, tuple) else 0


def _hint_depth(hint: Any) -> int:
    return 1 + _hint_depth(get_args(hint)[0]) if get_origin(hint) is tuple else 0


def _quoted(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(plain(value))


def plain(value: Any) -> Any:
    """Value as TOML and JSON hold it: a dataclass as a dict, an array or a tuple as a list, NaN as None.

    Parameters
    ----------
    value
        A dataclass, an array, a tuple, a path, a number or a text.

    Returns
    -------
    dict, list, str, number or None
    """
    if is_dataclass(value):
        return {entry.name: plain(getattr(value, entry.name)) for entry in fields(value)}
    value = _python(value)
    if isinstance(value, tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, float) and math.isnan(value):
        return None
    return str(value) if isinstance(value, Path) else value
