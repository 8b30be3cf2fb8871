"""Arguments of functions, and fields of classes, that are of the types of their annotations or refused in one line."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ConfigurationError, InputError, RgbmidicError
from rgbmidic.settings.conversion import convert_fields, convert_value, type_hints
from rgbmidic.typing import AnyArray

_P = ParamSpec("_P")
_R = TypeVar("_R")
_SIMPLE = (float, int, bool, str, Path)


def unmasked(array: npt.ArrayLike) -> AnyArray:
    """Return an array whose masked entries are NaN: as floats where there are any, else of the dtype given."""
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        values: Any = array if array.dtype.kind in "fc" else array.astype(np.float64)
        return np.asarray(np.ma.filled(values, np.nan))
    return np.asarray(array)


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
    if kinds[0] not in _SIMPLE and get_origin(kinds[0]) not in (tuple, Literal):
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
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O":
            array = array.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.empty(0, dtype=str)
    if array.dtype.kind not in "buif":
        raise error(f"{label} is an array of real numbers, not {values!r:.80}")
    return array
