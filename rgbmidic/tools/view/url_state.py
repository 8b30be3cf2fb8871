"""State of the view of a result, as the address of its page holds it: it can be kept and opened again."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlencode

from rgbmidic.fields import MEASURES, Units
from rgbmidic.settings import PROBE_NAME, ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.controls import BACKGROUNDS, CONTROLS
from rgbmidic.tools.view.marks import MARKS, SCALE, Mark, common_gauge, marks_of_probes

EXTRA_FIELDS = ("second", "third", "fourth")
"""Entries of the view that name fields beside the first."""
UNCERTAINTY = "uncertainty"
"""Name of the field beside the first that is its standard uncertainty, whatever that is."""


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
    over: str = BACKGROUNDS[0]
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
    clock: str = "offset"
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
        parsed = {
            entry.name: _parse_entry(entry, texts[entry.name], names) for entry in fields(cls) if entry.name in texts
        }
        valid: dict[str, Any] = {name: value for name, value in parsed.items() if value is not None}
        view = cls(**{"frame": frame, **valid})
        view, defaults = (
            replace(view, frame=min(max(view.frame, 0), frames - 1), since=min(view.since, frames - 1)),
            cls(),
        )
        return view if view.low < view.high else replace(view, low=defaults.low, high=defaults.high, range="frame")

    def with_probes(self, settings: ProbeSettings, min_gauge: float) -> Self:
        """Return the view with the probes stated, where its address has none.

        Strain gauges are among them if all have one length, `min_gauge` (px) or more, and the address states no other.
        """
        gauge, marks = common_gauge(settings), marks_of_probes(settings)
        if not gauge or gauge < min_gauge or self.gauge not in (0, gauge):
            gauge, marks = self.gauge, tuple(mark for mark in marks if mark.kind != "strain_gauge")
        return self if self.marks or not marks else replace(self, marks=marks, gauge=gauge)

    def with_channels(self, settings: ChannelSettings) -> Self:
        """Return the view with what ``[channels]`` states, unless its address names a file."""
        if self.channels or settings.file is None:
            return self
        align, align_to = settings.align or ("", "")
        clock = "trigger" if settings.trigger else "correlation" if settings.align else "offset"
        keys: dict[str, Any] = {"clock": clock, "offset": settings.offset, "area": settings.area or 0.0}
        keys |= {"trigger": settings.trigger or "", "align": align, "align_to": align_to, "force": settings.force or ""}
        return replace(self, channels=str(settings.file), **keys)

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

    def scale_settings(self, base: Path, stored: ScaleSettings) -> ScaleSettings | None:
        """Return ``[scale]`` as it is in view, its file relative to a folder, with the frame rate kept; None: none.

        Raises
        ------
        InputError
            Two scale marks and their distance make no scale.
        """
        if self.camera:
            return ScaleSettings(camera=base / self.camera, frame_rate=stored.frame_rate)
        points = [(mark.x, mark.y) for mark in self.marks if mark.kind == SCALE]
        if len(points) < 2 or not self.distance:
            return None
        units = Units.from_points(points, self.distance, length_std=self.distance_std)
        std = units.mm_per_pixel_std
        return ScaleSettings(mm_per_pixel=units.mm_per_pixel, mm_per_pixel_std=std, frame_rate=stored.frame_rate)

    def query(self) -> str:
        """Return the address without the frame: all that differs from the defaults."""
        defaults = type(self)()
        entries = {entry.name: getattr(self, entry.name) for entry in fields(self) if entry.name != "frame"}
        texts = {name: _format_entry(value) for name, value in entries.items() if value != getattr(defaults, name)}
        return urlencode(texts, safe=":,;")


def _format_entry(value: object) -> str:
    if isinstance(value, tuple):
        if value and isinstance(value[0], Mark):
            return ";".join(f"{mark.kind}:{mark.x:.6g},{mark.y:.6g}{mark.name and f',{mark.name}'}" for mark in value)
        return ",".join(f"{number:.6g}" for number in value)
    if isinstance(value, float):  # the offset of a clock may have more digits
        return text if float(text := f"{value:.6g}") == value else repr(value)
    return str(int(value) if isinstance(value, bool) else value)


def _parse_entry(entry: Field[Any], text: str, names: Sequence[str]) -> object:
    """Return the value that a text states for an entry; None where it is invalid."""
    options = CONTROLS[entry.name].options if entry.name in CONTROLS else {}
    try:
        if isinstance(entry.default, bool):
            return bool(int(text))
        if isinstance(entry.default, (int, float)):
            low, high = options.get("low", options.get("start")), options.get("high", options.get("end"))
            number = max(_number(text), -math.inf if low is None else low)
            return type(entry.default)(min(number, math.inf if high is None else high))
        if entry.name == "window":
            x_min, y_min, x_max, y_max = map(_number, text.split(","))
            return (x_min, y_min, x_max, y_max) if x_min < x_max and y_min < y_max else None
        if entry.name == "marks":
            tokens = [re.split("[:,]", mark) for mark in text.split(";")[: VIEWER.address_marks]]
            marks = tuple(Mark(kind, _number(x), _number(y), *name) for kind, x, y, *name in tokens)
            mark_names = [mark.name for mark in marks if mark.name]
            are_valid = all(mark.kind in MARKS for mark in marks) and all(map(PROBE_NAME.fullmatch, mark_names))
            return marks if are_valid and len(set(mark_names)) == len(mark_names) else None
    except (TypeError, ValueError):
        return None
    if entry.name in ("field", *EXTRA_FIELDS):
        return text if text in names or (text == UNCERTAINTY and entry.name in EXTRA_FIELDS) else None
    choices = {"over": BACKGROUNDS, "theme": ("light", "dark")}.get(entry.name, options.get("options"))
    if choices is not None:
        return text if text in [choice if isinstance(choice, str) else choice[0] for choice in choices] else None
    return text[: VIEWER.address_letters]


def _number(text: str) -> float:
    if not abs(number := float(text)) <= VIEWER.address_number:
        raise ValueError(text)
    return number
