"""Files of settings and their sections, converted to the dataclasses of the schema."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

from rgbmidic.arguments import convert_field, convert_fields, type_hints
from rgbmidic.disk import require_regular_file
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
