"""Sections and values of a settings file converted to the dataclasses of the schema, and back."""

from __future__ import annotations

import difflib
import math
import operator
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from functools import cache
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from rgbmidic.errors import ConfigurationError

_Section = TypeVar("_Section")


def read_table(document: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the keys and values of a section of a file; empty where the section is not there.

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

    Examples
    --------
    >>> read_table({"scale": {"frame_rate": 1000}}, "scale"), read_table({}, "scale")
    ({'frame_rate': 1000}, {})
    """
    table = document.get(name, {})
    if not isinstance(table, Mapping):
        raise ConfigurationError(f"[{name}] must be a section with keys, not {table!r}")
    return dict(table)


def require_regular_file(path: Path) -> Path:
    """Return path itself, unless a pipe, a socket or a device is there: to open one may wait, and to read it never end.

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

    Examples
    --------
    >>> require_regular_file(Path("test.toml")).name
    'test.toml'
    """
    if "\0" in str(path):
        raise OSError("its name holds a NUL")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError("it is not a regular file but a pipe, a socket or a device")
    return path


def read_toml(path: Path, description: str) -> dict[str, Any]:
    """Return the sections of a TOML file.

    Parameters
    ----------
    path
        The file.
    description
        The file in words, for messages.

    Returns
    -------
    dict

    Raises
    ------
    ConfigurationError
        The file, `description` in words, is missing or not TOML.

    Examples
    --------
    >>> read_toml(Path("test.toml"), "test")["calibration"]
    {'file': 'calibration.json'}
    """
    try:
        return tomllib.loads(require_regular_file(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigurationError(f"{description} not found: {path}") from None
    except (OSError, ValueError) as error:  # text that is no UTF-8 or no TOML, a number of too many digits
        raise ConfigurationError(f"{path} is not a readable {description} (TOML): {error}") from None
    except RecursionError:
        raise ConfigurationError(f"{path} is not a readable {description} (TOML): nested too deeply") from None


def check_names(names: Iterable[str], allowed: Iterable[str], noun: str, location: str) -> None:
    """Refuse a name that is not allowed.

    Parameters
    ----------
    names, allowed
        Names.
    noun, location
        Noun for the names, and the place where they stand, for the message.

    Raises
    ------
    ConfigurationError
        A name is not allowed; the message holds the closest one that is.

    Examples
    --------
    >>> check_names(["fil"], ["model", "fill"], "key", "[solver]")
    Traceback (most recent call last):
    rgbmidic.errors.ConfigurationError: unknown key "fil" in [solver] (did you mean "fill"?); allowed are model, fill
    """
    allowed = list(allowed)
    for name in names:
        if name not in allowed:
            close = difflib.get_close_matches(name, allowed, n=1)
            hint = f' (did you mean "{close[0]}"?)' if close else ""
            raise ConfigurationError(f'unknown {noun} "{name}" in {location}{hint}; allowed are {", ".join(allowed)}')


_TYPE_NAMES = {
    bool: "true or false",
    float: "a number",
    int: "a whole number",
    str: "a text in quotes",
    Path: "a file name in quotes",
}


def convert_value(value: Any, hint: Any, key: str, base: Path | str = "") -> Any:
    """Return a value converted to the type of a field.

    Parameters
    ----------
    value
        As TOML or Python gives it; numpy's scalars and arrays count as Python's.
    hint
        Type of the field.
    key
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

    Examples
    --------
    >>> convert_value([1, 2], tuple[float, ...], "region.corner")
    (1.0, 2.0)
    """
    value, origin, kinds = _to_python(value), get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):  # X | None; a number | a word
        if value is None and NoneType in kinds:
            return None
        words = [word for kind in kinds[1:] if get_origin(kind) is Literal for word in get_args(kind)]
        if (type(value), value) in ((type(word), word) for word in words):  # 1 is no True
            return value
        if words and isinstance(value, str):
            alternatives = ", ".join(_quoted(word) if isinstance(word, str) else str(word).lower() for word in words)
            raise ConfigurationError(f"{key} must be {_TYPE_NAMES[kinds[0]]} or {alternatives}, not {_quoted(value)}")
        return convert_value(value, kinds[0], key, base)
    if origin is tuple:
        return _convert_list(value, kinds, key, base)
    # ndarray; from numpy 2.5 on the alias NDArray itself. The class checks the shape of its arrays
    if str(getattr(origin, "__module__", "")).partition(".")[0] == "numpy":
        return value
    if origin is Literal:
        if value in kinds:
            return value
        raise ConfigurationError(f"{key} must be one of {', '.join(map(_quoted, kinds))}, not {_quoted(value)}")
    if isinstance(value, str | PurePath) and hint in (str, Path):
        return str(value) if hint is str else Path(base) / value
    if isinstance(value, int) and abs(value) >= 2**63:
        raise ConfigurationError(f"{key} is a number of {len(str(abs(value)))} digits: TOML has up to 2**63")
    if isinstance(value, int | float if hint is float else hint) and isinstance(value, bool) == (hint is bool):
        return value if is_dataclass(hint) else hint(value)
    raise ConfigurationError(f"{key} must be {_TYPE_NAMES.get(hint) or hint.__name__}, not {_quoted(value)}")


def _to_python(value: Any) -> Any:
    """Return the scalars and arrays of numpy as Python's, at any depth."""
    if type(value).__module__ == "numpy":
        value = value.tolist()
    return tuple(map(_to_python, value)) if isinstance(value, list | tuple) else value


def read_range(text: str, key: str) -> range:
    """Return the whole numbers that ``"a:b"`` stands for: a and all up to b, without b.

    Parameters
    ----------
    text
        Such as ``"0:20"``.
    key
        Section and key, or option, for messages.

    Returns
    -------
    range

    Raises
    ------
    ConfigurationError
        It is something else, or nothing is in it.

    Examples
    --------
    >>> read_range("0:20", "frames.reference")
    range(0, 20)
    """
    match = re.fullmatch(r"\s*(\d{1,18})\s*:\s*(\d{1,18})\s*", text)
    if not match or int(match[1]) >= int(match[2]):
        raise ConfigurationError(f'{key} must be a range such as "0:20" (0 to 19), not {_quoted(text)}')
    return range(int(match[1]), int(match[2]))


def _convert_list(value: Any, kinds: tuple[Any, ...], key: str, base: Path | str) -> tuple[Any, ...]:
    if kinds == (int, Ellipsis) and isinstance(value, str):
        value = read_range(value, key)
    if isinstance(value, range):
        # a reference of n frames adds 1/n to a frame's variance: 100 are enough, and a longer range than this is a slip
        # that took a minute and 3 GB until the frames refused it
        max_count = 100_000
        if len(value) > max_count:
            raise ConfigurationError(f"{key} names {len(value)} frames; at most {max_count} are allowed")
        value = tuple(value)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        entries = value if _depth(value) > _hint_depth(kinds[0]) else [value]  # a single one needs no brackets
        return tuple(convert_value(entry, kinds[0], key, base) for entry in entries)
    if not isinstance(value, tuple) or len(value) != len(kinds):
        raise ConfigurationError(f"{key} must be {len(kinds)} values in brackets, not {_quoted(value)}")
    return tuple(convert_value(entry, kind, key, base) for entry, kind in zip(value, kinds, strict=True))


def _depth(value: Any) -> int:
    """Return the depth to which lists are nested in a value; an empty one may be of any depth."""
    return 1 + min(map(_depth, value), default=9) if isinstance(value, tuple) else 0


def _hint_depth(hint: Any) -> int:
    return 1 + _hint_depth(get_args(hint)[0]) if get_origin(hint) is tuple else 0


def _quoted(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(to_plain(value))


def to_plain(value: Any) -> Any:
    """Value as TOML and JSON hold it: a dataclass as a dict, an array or a tuple as a list, what is not finite as None.

    Parameters
    ----------
    value
        A dataclass, a mapping, an array, a list or a tuple, a path, a number or a text.

    Returns
    -------
    dict, list, str, number or None

    Examples
    --------
    >>> to_plain({"file": Path("a.csv"), "size": (1.0, math.nan)})
    {'file': 'a.csv', 'size': [1.0, None]}
    """
    if is_dataclass(value):
        return {entry.name: to_plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    value = _to_python(value)
    if isinstance(value, tuple):
        return [to_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


@cache
def type_hints(settings: Any) -> dict[str, Any]:
    """Return the types of the fields of a class of settings, which take a while to resolve."""
    return get_type_hints(settings)


def bounded(default: Any = MISSING, **bounds: float) -> Any:
    """Return a field whose number, or every number of it, keeps the bounds `above`, `at_least`, `at_most`, `below`.

    Parameters
    ----------
    default
        Value where none is stated; none: the key is required.
    **bounds
        Bounds by their names.

    Returns
    -------
    dataclasses.Field

    Examples
    --------
    >>> from dataclasses import make_dataclass
    >>> Gauge = make_dataclass("Gauge", [("length", float, bounded(10.0, above=0))], frozen=True, kw_only=True)
    >>> read_section(Gauge, "gauge", {"length": 4}).length
    4.0
    >>> read_section(Gauge, "gauge", {"length": -4})
    Traceback (most recent call last):
    rgbmidic.errors.ConfigurationError: gauge.length must be above 0, not -4
    """
    return field(default=default, metadata={"bounds": bounds})


_BOUNDS = {"above": operator.gt, "at_least": operator.ge, "at_most": operator.le, "below": operator.lt}


def convert_field(entry: Field[Any], value: Any, hint: Any, key: str, base: Path | str = "") -> Any:
    """Return a value in the type of a field, every number of it finite and within the field's bounds."""
    value = convert_value(value, hint, key, base)
    for number in _numbers(value):
        if not math.isfinite(number):
            raise ConfigurationError(f"{key} must be finite, not {number}")
        for bound, limit in entry.metadata.get("bounds", {}).items():
            if not _BOUNDS[bound](number, limit):
                raise ConfigurationError(f"{key} must be {bound.replace('_', ' ')} {limit:g}, not {number:g}")
    return value


def _numbers(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for entry in value for number in _numbers(entry)]
    return [value] if isinstance(value, int | float) else []


def convert_fields(instance: object, convert: Callable[[Field[Any], Any, Any], Any]) -> None:
    """Replace each field of a frozen dataclass by what `convert` makes of the field, its value and its annotation."""
    hints = type_hints(cast(Any, type(instance)))
    for entry in fields(cast(Any, instance)):
        object.__setattr__(instance, entry.name, convert(entry, getattr(instance, entry.name), hints[entry.name]))


class CheckedSettings:
    """Settings that are checked when they are made: every field by its type and bounds, then what keys must keep."""

    __slots__ = ()
    section = ""

    def __post_init__(self) -> None:
        convert_fields(
            self,
            lambda entry, value, hint: convert_field(entry, value, hint, f"{self.section}.{entry.name}".lstrip(".")),
        )
        for problem in self._problems():
            raise ConfigurationError(problem)

    def _problems(self) -> Iterator[str]:
        """Normalise what depends on other keys, and yield what contradicts them, a sentence each."""
        return iter(())


def read_section(
    kind: type[_Section], name: str, content: Mapping[str, Any], base: Path | str = ".", /, **values: Any
) -> _Section:
    """Object of a dataclass from the keys and plain values of a section: of TEST.toml, SCENE.toml or a calibration.

    Parameters
    ----------
    kind
        Class of the section, such as `FrameSettings`.
    name
        Name of the section, for messages.
    content
        Its keys and values.
    base
        Folder that relative paths start from.
    **values
        Fields that are no keys of the section.

    Returns
    -------
    object of `kind`

    Raises
    ------
    ConfigurationError
        A key is unknown, missing, of the wrong type, out of range, or contradicts another.

    Examples
    --------
    >>> from rgbmidic.settings import FrameSettings
    >>> read_section(FrameSettings, "frames", {"path": "frames/*.dng", "step": 2}).step
    2
    """
    hints = {key: hint for key, hint in type_hints(cast(Any, kind)).items() if key not in values}
    check_names(content, hints, "key", f"[{name}]")
    for entry in fields(cast(Any, kind)):
        if entry.name in content:
            value, hint, full_key = content[entry.name], hints[entry.name], f"{name}.{entry.name}"
            inner = next((candidate for candidate in (hint, *get_args(hint)) if is_dataclass(candidate)), None)
            if inner is not None and isinstance(value, Mapping):
                value = read_section(cast(Any, inner), full_key, value, base)
            values[entry.name] = convert_field(entry, value, hint, full_key, base)
        elif entry.default is entry.default_factory is MISSING and entry.name not in values:
            raise ConfigurationError(f"{name}.{entry.name} is missing")
    return kind(**values)


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object of a JSON file (`object_pairs_hook`), as TOML reads it: a key stated twice is an error.

    Parameters
    ----------
    pairs
        Keys and values of the object, in its order.

    Returns
    -------
    dict

    Raises
    ------
    ValueError
        A key is stated twice.

    Examples
    --------
    >>> import json
    >>> json.loads('{"a": 1, "a": 2}', object_pairs_hook=unique_keys)
    Traceback (most recent call last):
    ValueError: the key "a" is stated twice
    """
    keys = [key for key, _ in pairs]
    if len(document := dict(pairs)) < len(keys):
        raise ValueError(f'the key "{next(key for key in document if keys.count(key) > 1)[:40]}" is stated twice')
    return document
