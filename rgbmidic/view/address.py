"""State of the view of a result, as the address of its page holds it: it can be kept and opened again."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self
from urllib.parse import urlencode

from rgbmidic.fields import MEASURES

__all__ = ["BESIDE", "KINDS", "OVER", "PALETTES", "UNCERTAINTY", "Mark", "ViewState", "probe_marks", "probe_place"]

KINDS = {"point": 1, "gauge": 2, "line": 2, "strain_gauge": 1, "region": 2, "circle": 2}
"""Probes that can be set with the pointer, and how many places each takes."""
OVER = ("reference", "deformed")
_LEAST, _LARGEST = {"levels": 2, "rate_window": 0}, 10**9
_MOST_MARKS = 200
"""Marks that an address may set: it has 8 kB at most, of some 25 a mark."""
BESIDE = ("second", "third", "fourth")
"""Entries of the view that name fields beside the first."""
UNCERTAINTY = "uncertainty"
"""Name of the field beside the first that is its standard uncertainty, whatever that is."""
PALETTES = ("viridis", "cividis", "plasma", "inferno", "RdBu_r", "PuOr_r", "twilight")
"""Colours that can be chosen, safe for the colour-blind: perceptually uniform ones, diverging ones, a cyclic one."""
_CHOICES = {
    "over": OVER, "range": ("frame", "test", "hand"), "theme": ("light", "dark"), "palette": PALETTES,
    "measure": MEASURES,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mark:
    """A place on the reference that belongs to a probe.

    Attributes
    ----------
    kind
        One of `KINDS`; those that take two places take marks of their kind in pairs.
    x, y
        Place in px on the reference.
    """

    kind: str
    x: float
    y: float


def probe_marks(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Return the marks of each complete probe by its name, such as ``point_1``: those of a kind in the order set."""
    found: dict[str, list[Mark]] = {}
    for kind, count in KINDS.items():
        of_kind = [mark for mark in marks if mark.kind == kind]
        found |= {f"{kind}_{n + 1}": of_kind[n * count : (n + 1) * count] for n in range(len(of_kind) // count)}
    return found


def probe_place(marks: Sequence[Mark], gauge: float) -> tuple[float, ...]:
    """Return the numbers that place the probe of some marks, as ``[probes]`` has them; strain gauges of a length."""
    places = [coordinate for mark in marks for coordinate in (mark.x, mark.y)]
    if marks[0].kind == "strain_gauge":
        return (*places, gauge)
    if marks[0].kind == "circle":
        return (*places[:2], math.dist(places[:2], places[2:]))
    return tuple(places)


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """Frame, field, colours, part of the image and probes in view.

    Attributes
    ----------
    frame
        Index of the frame in the result.
    field
        Name of the field.
    over
        Image under the field: the ``"reference"``, or the ``"deformed"`` one of the frame.
    range
        Source of the colour range: this ``"frame"``, the whole ``"test"``, or `low` and `high` (``"hand"``).
    low, high
        Ends of the colours by hand.
    symmetric
        Whether the colours of a signed field are as far below 0 as above.
    directions
        Whether principal directions are drawn.
    opacity
        Opacity of the field, from 0 to 1.
    second, third, fourth
        Names of fields beside it; ``"uncertainty"``: that of the first; empty: none.
    palette, levels
        Name of the colours, empty: those that suit the field; and their number.
    hatched
        Whether what lies within two standard uncertainties of 0 is hatched.
    vectors, longer
        Whether displacements are drawn as arrows, and so many times their length; 0: as long as there is room.
    contours, extremes, blank
        Whether lines between the colours, the places of the smallest and the largest value, and the nodes without data
        are drawn.
    gauge, measure
        Length of the virtual strain gauges in px, 0: the shortest; and the strain measure.
    since, rigid, rate_window
        As `Maps` has them; -1: the test's reference, 0: the usual window.
    curve
        Quantity of the probes whose curve is shown; empty: the first.
    line
        Line along which the field is shown in place of the curves; empty: none.
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
    second: str = ""
    third: str = ""
    fourth: str = ""
    palette: str = ""
    levels: int = 256
    hatched: bool = False
    vectors: bool = False
    longer: float = 0.0
    contours: bool = False
    extremes: bool = False
    blank: bool = False
    gauge: float = 0.0
    measure: str = MEASURES[0]
    since: int = -1
    rigid: bool = False
    rate_window: int = 0
    curve: str = ""
    line: str = ""
    theme: str = ""
    window: tuple[float, ...] = ()
    marks: tuple[Mark, ...] = ()

    @classmethod
    def from_query(cls, query: Mapping[str, Sequence[bytes]], *, frames: int, names: Sequence[str], frame: int) -> Self:
        """Read the view from an address; parts that are invalid are left at their defaults.

        Parameters
        ----------
        query
            Values of the address by their keys; the last one of each counts.
        frames
            Number of frames of the result.
        names
            Names of its fields.
        frame
            Index of the frame where the address states none.

        Returns
        -------
        ViewState
            A valid view of the result.
        """
        texts = {key: values[-1].decode("utf-8", "replace") for key, values in query.items() if values}
        asked = {entry.name: _value(entry.name, texts.get(entry.name, ""), names) for entry in fields(cls)}
        stated: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
        view = cls(**{"frame": frame, **stated})
        view, plain = replace(view, frame=min(max(view.frame, 0), frames - 1), since=min(view.since, frames - 1)), cls()
        return view if view.low < view.high else replace(view, low=plain.low, high=plain.high, range="frame")

    def query(self) -> str:
        """Return the address without the frame: all that differs from the defaults."""
        plain = type(self)()
        entries = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "frame"}
        texts = {name: _text(value) for name, value in entries.items() if value != getattr(plain, name)}
        return urlencode(texts, safe=":,;")


def _text(value: object) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], Mark):
            return ";".join(f"{mark.kind}:{mark.x:.6g},{mark.y:.6g}" for mark in value)
        return ",".join(f"{number:.6g}" for number in value)
    return f"{value:.6g}" if isinstance(value, float) else str(int(value) if isinstance(value, bool) else value)


def _value(name: str, text: str, names: Sequence[str]) -> object:
    """Return the value that a text states for an entry; None where it is invalid."""
    try:
        plain = getattr(ViewState(), name)
        if isinstance(plain, bool):
            return bool(int(text))
        if isinstance(plain, int):
            return min(max(int(text), _LEAST.get(name, -1)), _LARGEST)
        if isinstance(plain, float):
            number = _number(text)
            return min(max(number, 0.0), 1.0) if name == "opacity" else number
        if name == "window":
            left, top, right, bottom = map(_number, text.split(","))
            return (left, top, right, bottom) if left < right and top < bottom else None
        if name == "marks":
            places = [re.split("[:,]", mark) for mark in text.split(";")[:_MOST_MARKS]]
            marks = tuple(Mark(kind, _number(x), _number(y)) for kind, x, y in places)
            return marks if all(mark.kind in KINDS for mark in marks) else None
    except ValueError:
        return None
    if name in ("field", *BESIDE):
        return text if text in names or (text == UNCERTAINTY and name in BESIDE) else None
    if name in _CHOICES:
        return text if text in _CHOICES[name] else None
    return text[:100]


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number) or abs(number) > 1e9:
        raise ValueError(text)
    return number
