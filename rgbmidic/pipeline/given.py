"""Objects that a script gives to a measurement: what they must be, and what a result keeps of them."""

from __future__ import annotations

import hashlib
import re
from types import UnionType
from typing import Any

import numpy as np

from rgbmidic.errors import InputError


def check_object(name: str, given: object, *methods: str) -> None:
    """Refuse an object that a script gave, unless it is None or has all of these methods.

    Raises
    ------
    InputError
        It lacks one of them.
    """
    if given is not None and not all(callable(getattr(given, method, None)) for method in methods):
        needed = "can be called" if methods == ("__call__",) else f"has {' and '.join(f'{name}()' for name in methods)}"
        raise InputError(f"{name} must be an object that {needed}, not {class_name(given)}")


def check_type(name: str, given: object, kind: type | UnionType, allowed: str) -> None:
    """Refuse what is not of a kind.

    Raises
    ------
    InputError
        It is of another one.
    """
    if not isinstance(given, kind):
        raise InputError(f"{name} must be {allowed}, not {class_name(given)}")


def describe(given: Any, longest: int = 120) -> str:
    """What a result keeps of an object that a script gave: its ``describe()`` where it has one, else what it shows.

    Functions and objects without a representation of their own give their name only: two of one name cannot be told
    apart. More than the `longest` number of characters are cut and get their checksum: people read the text, the
    comparison reads the checksum.
    """
    if callable(told := getattr(given, "describe", None)):
        text = f"{class_name(given)}: {told()}"
    elif callable(given) and hasattr(given, "__qualname__"):
        text = f"{given.__module__}.{given.__qualname__}"
    elif isinstance(given, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(given).tobytes()).hexdigest()
        text = f"{given.dtype} array of shape {given.shape}, {digest[:16]}"
    elif repr(given) == object.__repr__(given):
        text = class_name(given)
    else:
        text = f"{class_name(given)}: " + re.sub(r" at 0x[0-9a-fA-F]+", "", repr(given))
    if len(text) > longest:
        return f"{text[:longest]} ... {hashlib.sha256(text.encode()).hexdigest()[:16]}"
    return text


def class_name(given: object) -> str:
    """Return module and name of the class of an object."""
    return f"{type(given).__module__}.{type(given).__qualname__}"
