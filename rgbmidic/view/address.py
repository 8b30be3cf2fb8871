"""What a page of a result shows, as the address of the page holds it: it can be kept, and opened again as it was."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self
from urllib.parse import urlencode

__all__ = ["KINDS", "OVER", "Look", "Mark"]

KINDS = {"point": 1, "gauge": 2, "line": 2, "strain_gauge": 1}
"""Probes that can be set with the pointer, and how many places each takes."""
OVER = ("reference", "deformed")
_MOST_MARKS = 200
_CHOICES = {"over": OVER, "range": ("frame", "test", "hand"), "theme": ("light", "dark")}


@dataclass(frozen=True, slots=True)
class Mark:
    """A place that belongs to a probe.

    Attributes
    ----------
    kind
        One of `KINDS`; those that take two places take marks of their kind in pairs.
    x, y
        In px on the reference.
    """

    kind: str
    x: float
    y: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """What is looked at.

    Attributes
    ----------
    frame
        Place in the result.
    field
        Name of the field.
    over
        What it lies over: the ``"reference"`` image, or the ``"deformed"`` one of the frame.
    range
        What rules the colours: this ``"frame"``, the whole ``"test"``, or `low` and `high` (``"hand"``).
    low, high
        Ends of the colours by hand.
    symmetric
        Whether the colours of a signed field are as far below 0 as above.
    directions
        Whether principal directions are drawn.
    opacity
        Of the field, from 0 to 1.
    curve
        Quantity of the probes whose curve is shown; empty: the first.
    theme
        ``"light"``, ``"dark"``, or empty: as the browser likes it.
    window
        Edges (left, top, right, bottom) of the image in view, px; empty: all of the mesh.
    marks
        Places of the probes.
    """

    frame: int = 0
    field: str = "u"
    over: str = "reference"
    range: str = "frame"
    low: float = -1.0
    high: float = 1.0
    symmetric: bool = False
    directions: bool = False
    opacity: float = 0.85
    curve: str = ""
    theme: str = ""
    window: tuple[float, ...] = ()
    marks: tuple[Mark, ...] = ()

    @classmethod
    def from_query(cls, query: Mapping[str, Sequence[bytes]], *, frames: int, names: Sequence[str], frame: int) -> Self:
        """What an address asks for, as far as it makes sense for a result of `frames` frames with these fields; what
        does not is as if it were not said, and `frame` stands for a frame that is not said."""
        told = {key: values[-1].decode("utf-8", "replace") for key, values in query.items() if values}
        asked = {entry.name: _value(entry.name, told.get(entry.name, ""), names) for entry in fields(cls)}
        known: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
        look = cls(**{"frame": frame, **known})
        look, plain = replace(look, frame=min(max(look.frame, 0), frames - 1)), cls()
        return look if look.low < look.high else replace(look, low=plain.low, high=plain.high, range="frame")

    def query(self) -> str:
        """What the address says beside the frame: all that is not as at the beginning."""
        plain = type(self)()
        kept = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "frame"}
        told = {name: _text(value) for name, value in kept.items() if value != getattr(plain, name)}
        return urlencode(told, safe=":,;")


def _text(value: object) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], Mark):
            return ";".join(f"{mark.kind}:{mark.x:.6g},{mark.y:.6g}" for mark in value)
        return ",".join(f"{number:.6g}" for number in value)
    return f"{value:.6g}" if isinstance(value, float) else str(int(value) if isinstance(value, bool) else value)


def _value(name: str, text: str, names: Sequence[str]) -> object:
    """What a text means for an entry; None where it means nothing."""
    try:
        if name == "frame":
            return int(text)
        if name in ("low", "high", "opacity"):
            number = _number(text)
            return min(max(number, 0.0), 1.0) if name == "opacity" else number
        if name in ("symmetric", "directions"):
            return bool(int(text))
        if name == "window":
            left, top, right, bottom = map(_number, text.split(","))
            return (left, top, right, bottom) if left < right and top < bottom else None
        if name == "marks":
            return tuple(map(_mark, text.split(";")[:_MOST_MARKS]))
    except ValueError:
        return None
    if name == "field":
        return text if text in names else None
    if name in _CHOICES:
        return text if text in _CHOICES[name] else None
    return text[:100]


def _mark(text: str) -> Mark:
    kind, _, place = text.partition(":")
    x, y = place.split(",")
    if kind not in KINDS:
        raise ValueError(kind)
    return Mark(kind, _number(x), _number(y))


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number) or abs(number) > 1e9:
        raise ValueError(text)
    return number
