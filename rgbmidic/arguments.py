"""Values in the types of annotations and within bounds: of a settings file, a function's arguments, a class's fields.

What cannot be converted without a loss is refused in one line.
"""

from __future__ import annotations

import functools
import inspect
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import MISSING, Field, field, fields, is_dataclass
from pathlib import Path, PurePath
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from rgbmidic.errors import ConfigurationError, InputError, RgbmidicError

_P = ParamSpec("_P")
_R = TypeVar("_R")
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


@functools.cache
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
    >>> from rgbmidic.settings import read_section
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


def checked(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Refuse what a function cannot take, before it begins: texts for numbers, arrays of texts, infinite numbers.

    Numbers, texts, tuples of them, arrays, mappings and objects of the package's own classes are looked at, whose
    annotations say what they are; shapes, bounds and NaN in an array are the function's own business.

    Raises
    ------
    InputError
        An argument is not of the type of its annotation.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        bound = signature.bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            if signature.parameters[name].kind is not inspect.Parameter.VAR_KEYWORD:
                bound.arguments[name] = _converted(
                    value, type_hints(function).get(name), f"{function.__name__}: {name}", InputError
                )
        return function(*bound.args, **bound.kwargs)

    return call


def check_fields(instance: object, error: type[RgbmidicError] = InputError) -> None:
    """Convert the fields of a frozen dataclass to the types of their annotations, or refuse them.

    Raises
    ------
    RgbmidicError
        A field is not of the type of its annotation.
    """
    name = type(instance).__name__
    convert_fields(instance, lambda entry, value, hint: _converted(value, hint, f"{entry.name} of {name}", error))


def convert_fields(instance: object, convert: Callable[[Field[Any], Any, Any], Any]) -> None:
    """Replace each field of a frozen dataclass by what `convert` makes of the field, its value and its annotation."""
    hints = type_hints(cast(Any, type(instance)))
    for entry in fields(cast(Any, instance)):
        object.__setattr__(instance, entry.name, convert(entry, getattr(instance, entry.name), hints[entry.name]))


def _converted(value: Any, hint: Any, label: str, error: type[RgbmidicError]) -> Any:
    """Value in the type of the annotation, as it is where that is none of those that `checked` names."""
    kinds = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    if value is None and NoneType in kinds:
        return None
    if classes := _classes(kinds):
        if not isinstance(value, classes):
            names = " or ".join(kind.__name__ for kind in classes)
            raise error(f"{label} must be of type {names}, not {value!r:.80}")
        return value
    if any(str(getattr(get_origin(kind), "__module__", "")).startswith("numpy") for kind in kinds):
        return _array(value, label, error)
    if kinds[0] not in _TYPE_NAMES and get_origin(kinds[0]) not in (tuple, Literal):
        return value
    try:
        value = convert_value(value, hint, label)
    except ConfigurationError as wrong:
        raise error(str(wrong)) from None
    except TypeError:  # no value of a Literal can be compared with it
        raise error(f"{label} cannot be {value!r:.80}") from None
    if isinstance(value, float) and not math.isfinite(value):
        raise error(f"{label} must be finite, not {value}")
    if isinstance(value, Path) and "\0" in str(value):
        raise error(f"{label} is no name of a file: it holds a NUL")
    return value


def _classes(kinds: tuple[Any, ...]) -> tuple[type, ...]:
    """Return the classes of which a value must be; none where a kind is neither one of the package's nor a mapping."""
    origins = [get_origin(kind) or kind for kind in kinds if kind is not NoneType]
    is_ours = all(
        kind in (Mapping, dict)
        or (
            isinstance(kind, type)
            and kind.__module__.startswith("rgbmidic.")
            and not getattr(kind, "_is_protocol", False)
        )
        for kind in origins
    )
    return tuple(origins) if is_ours else ()


def _array(values: Any, label: str, error: type[RgbmidicError]) -> Any:
    """Values as an array of numbers."""
    import numpy as np  # which reading the settings does without

    try:
        array = np.asarray(values)
        if array.dtype.kind == "O":
            array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0, dtype=str)
    if array.dtype.kind not in "buif":
        raise error(f"{label} is an array of real numbers, not {values!r:.80}")
    return array
