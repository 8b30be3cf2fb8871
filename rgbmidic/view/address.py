"""State of the view of a result, as the address of its page holds it: it can be kept and opened again."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlencode

from rgbmidic.fields import MEASURES, Units
from rgbmidic.settings import PROBE_NAME, ChannelSettings, ScaleSettings

KINDS = {"point": 1, "gauge": 2, "line": 2, "strain_gauge": 1, "region": 2, "circle": 2}
"""Probes that can be set with the pointer, and how many places each takes."""
SCALE = "scale"
MARKS = (*KINDS, SCALE)
"""Kinds of marks: those of probes, and two points of a known distance."""
CLOCKS = ("offset", "trigger", "correlation")
"""Ways to relate the time of channels to that of the frames."""
OVER = ("reference", "deformed")
_LEAST, _LARGEST = {"levels": 2, "rate_window": 0}, 10**9
_LONGEST = 1000
"""Letters of a text in an address: a path on a disk has seldom more."""
_MOST_MARKS = 200
"""Marks that an address may set: it has 8 kB at most, of some 25 a mark."""
_KEPT = 100
"""Steps that can be undone: more than a hand takes back one by one, at some hundred bytes each."""
BESIDE = ("second", "third", "fourth")
"""Entries of the view that name fields beside the first."""
UNCERTAINTY = "uncertainty"
"""Name of the field beside the first that is its standard uncertainty, whatever that is."""
PALETTES = ("viridis", "cividis", "plasma", "inferno", "RdBu_r", "PuOr_r", "twilight")
"""Colours that can be chosen, safe for the colour-blind: perceptually uniform ones, diverging ones, a cyclic one."""
_CHOICES = {
    "over": OVER, "range": ("frame", "test", "hand"), "theme": ("light", "dark"), "palette": PALETTES,
    "measure": MEASURES, "clock": CLOCKS,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mark:
    """A place on the reference that belongs to a probe.

    Attributes
    ----------
    kind
        One of `MARKS`; those that take two places take marks of their kind in pairs.
    x, y
        Place in px on the reference.
    name
        Name of the probe of which it is the first mark; empty: its kind and number.
    key
        The same for a mark that is moved or renamed, however many have its values.
    """

    kind: str
    x: float
    y: float
    name: str = ""
    key: object = field(default_factory=object, compare=False, repr=False, kw_only=True)


class Steps:
    """Marks, which can be undone and done again; the moves of a mark that is dragged are one step.

    Parameters
    ----------
    now
        Marks at first.

    Attributes
    ----------
    now
        The marks.
    """

    def __init__(self, now: tuple[Mark, ...]) -> None:
        self.now, self._past, self._future, self._moved = now, list[Any](), list[Any](), -1

    def keep(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step."""
        other = [at for at, pair in enumerate(zip(self.now, marks, strict=False)) if pair[0] != pair[1]]
        one = len(marks) == len(self.now) and len(other) == 1
        moved = other[0] if one and replace(marks[other[0]], x=0, y=0) == replace(self.now[other[0]], x=0, y=0) else -1
        if moved < 0 or moved != self._moved:
            self._past = [*self._past[-_KEPT:], self.now]
        self.now, self._future, self._moved = marks, [], moved

    def go(self, *, back: bool) -> tuple[Mark, ...]:
        """Return to the marks before the last step, or do again the one that was undone last."""
        source, target = (self._past, self._future) if back else (self._future, self._past)
        if source:
            target.append(self.now)
            self.now, self._moved = source.pop(), -1
        return self.now


def probe_marks(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Return the marks of each complete probe by its name, else kind and number: those of a kind in the order set."""
    found: dict[str, list[Mark]] = {}
    for kind, count in KINDS.items():
        of_kind = [mark for mark in marks if mark.kind == kind]
        for n in range(len(of_kind) // count):
            name = of_kind[n * count].name
            usual = not name or name in found
            found[f"{kind}_{n + 1}" if usual else name] = of_kind[n * count : (n + 1) * count]
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
    curve, along
        Quantity of the probes whose curve is shown, empty: the first; and the one along x, empty: the time.
    line
        Line along which the field is shown in place of the curves; empty: none.
    channels, clock, offset, trigger, align, align_to, area, force
        CSV file beside the test, and what ``[channels]`` states of it; `clock`: which of offset (s), trigger and
        correlation of the channel `align` with the curve `align_to` counts. The area (mm²) 0: not stated.
    beside
        Channel that is drawn beside the curves; empty: none.
    distance, distance_std
        Distance of the two scale marks in mm and its standard uncertainty; 0: not stated.
    camera
        File with lens and plane in place of that; empty: none.
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
    along: str = ""
    channels: str = ""
    clock: str = CLOCKS[0]
    offset: float = 0.0
    trigger: str = ""
    align: str = ""
    align_to: str = ""
    area: float = 0.0
    force: str = ""
    beside: str = ""
    distance: float = 0.0
    distance_std: float = 0.0
    camera: str = ""
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

    def with_channels(self, stated: ChannelSettings) -> Self:
        """Return the view with what ``[channels]`` states, unless its address names a file."""
        if self.channels or stated.file is None:
            return self
        align, align_to = stated.align or ("", "")
        clock = CLOCKS[1] if stated.trigger else CLOCKS[2] if stated.align else CLOCKS[0]
        keys: dict[str, Any] = {"clock": clock, "offset": stated.offset, "area": stated.area or 0.0}
        keys |= {"trigger": stated.trigger or "", "align": align, "align_to": align_to, "force": stated.force or ""}
        return replace(self, channels=str(stated.file), **keys)

    def channel_settings(self, base: Path) -> ChannelSettings:
        """Return ``[channels]`` as it is in view, its file relative to a folder; what is not chosen yet is left out."""
        if not self.channels:
            return ChannelSettings()
        clocks: dict[str, Any] = {
            "offset": {"offset": self.offset},
            "trigger": {"trigger": self.trigger or None},
            "correlation": {"align": (self.align, self.align_to) if self.align and self.align_to else None},
        }
        return ChannelSettings(
            file=base / self.channels, area=max(self.area, 0) or None, force=self.force or None, **clocks[self.clock]
        )

    def scale_settings(self, base: Path, kept: ScaleSettings) -> ScaleSettings | None:
        """Return ``[scale]`` as it is in view, its file relative to a folder, with the frame rate kept; None: none.

        Raises
        ------
        InputError
            Two scale marks and their distance make no scale.
        """
        if self.camera:
            return ScaleSettings(camera=base / self.camera, frame_rate=kept.frame_rate)
        ends = [(mark.x, mark.y) for mark in self.marks if mark.kind == SCALE]
        if len(ends) < 2 or not self.distance:
            return None
        units = Units.from_points(ends, self.distance, length_std=self.distance_std)
        std = units.mm_per_pixel_std
        return ScaleSettings(mm_per_pixel=units.mm_per_pixel, mm_per_pixel_std=std, frame_rate=kept.frame_rate)

    def query(self) -> str:
        """Return the address without the frame: all that differs from the defaults."""
        plain = type(self)()
        entries = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "frame"}
        texts = {name: _text(value) for name, value in entries.items() if value != getattr(plain, name)}
        return urlencode(texts, safe=":,;")


def _text(value: object) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], Mark):
            return ";".join(f"{mark.kind}:{mark.x:.6g},{mark.y:.6g}{mark.name and f',{mark.name}'}" for mark in value)
        return ",".join(f"{number:.6g}" for number in value)
    if isinstance(value, float):  # the offset of a clock may have more digits
        return text if float(text := f"{value:.6g}") == value else repr(value)
    return str(int(value) if isinstance(value, bool) else value)


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
            marks = tuple(Mark(kind, _number(x), _number(y), *name) for kind, x, y, *name in places)
            named = [mark.name for mark in marks if mark.name]
            known = all(mark.kind in MARKS for mark in marks) and all(map(PROBE_NAME.fullmatch, named))
            return marks if known and len(set(named)) == len(named) else None
    except (TypeError, ValueError):
        return None
    if name in ("field", *BESIDE):
        return text if text in names or (text == UNCERTAINTY and name in BESIDE) else None
    if name in _CHOICES:
        return text if text in _CHOICES[name] else None
    return text[:_LONGEST]


def _number(text: str) -> float:
    number = float(text)
    if not math.isfinite(number) or abs(number) > 1e10:  # seconds since 1970 are 2e9
        raise ValueError(text)
    return number
