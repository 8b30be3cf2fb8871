"""Controls of the page of a result: one table of them, and the widgets that it makes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import bokeh.models as bk
from bokeh.layouts import column, row

from rgbmidic.fields import MEASURES
from rgbmidic.tools.view.widgets import LIVE_REGION, Controls, SharedState, aria_group, script

BACKGROUNDS = ("reference", "deformed")
"""Images under the field, in the order of the buttons of `over`."""
PALETTES = ("viridis", "cividis", "plasma", "inferno", "RdBu_r", "PuOr_r", "twilight")
"""Colours that can be chosen, safe for the colour-blind: perceptually uniform ones, diverging ones, a cyclic one."""
CLOCKS = {"offset": "an offset", "trigger": "a trigger", "correlation": "correlation"}
"""Ways to relate the time of channels to that of the frames."""
WRITABLE_SECTIONS = ("probes", "channels", "scale")
"""Sections of a TEST.toml that the page can write."""
_RANGES = {"frame": "this frame", "test": "the whole test", "hand": "the two numbers"}
_MODES = ("Move", "Point", "Gauge", "Line", "Strain", "Box", "Circle")


@dataclass(frozen=True, slots=True)
class Control:
    """A control: its kind of widget, and the properties of that, which limit the value of an entry of the view."""

    widget: type[bk.UIElement]
    options: Mapping[str, Any]


def _choice(title: str, options: Iterable[Any] | None = None) -> Control:
    return Control(bk.Select, {"title": title, **({} if options is None else {"options": list(options)})})


def _number(title: str, **limits: float) -> Control:
    return Control(bk.NumericInput, {"title": title, "mode": "float", **limits})


def _count(title: str, **limits: int) -> Control:
    return Control(bk.Spinner, {"title": title, **limits})


def _check(label: str) -> Control:
    return Control(bk.Checkbox, {"label": label})


def _text(title: str, value: str = "") -> Control:
    return Control(bk.TextInput, {"title": title, "value": value})


def _button(label: str) -> Control:
    return Control(bk.Button, {"label": label})


def _group(label: str, labels: Sequence[str], active: int | None = 0) -> Control:
    look = {"labels": list(labels), "html_attributes": aria_group(label)}
    return Control(bk.RadioButtonGroup, {**look, "active": active})


_NOTE = Control(bk.Div, {})
_SECTION_CHOICE = {
    "labels": list(WRITABLE_SECTIONS),
    "active": [0],
    "html_attributes": aria_group("sections that are written"),
}

SECTIONS: Mapping[str, Sequence[Mapping[str, Control]]] = {
    "Field": (
        {"field": _choice("Field")},
        {"second": _choice("Second field")}, {"third": _choice("Third field")}, {"fourth": _choice("Fourth field")},
        {"over": _group("image", ["over the reference", "over the frame"], active=None)},
        {"opacity": Control(bk.Slider, {"title": "Opacity", "start": 0, "end": 1, "step": 0.05, "value": 1})},
        {"print": _button("Save PNG for print")},
    ),
    "Colours": (
        {"range": _choice("Colours from", _RANGES.items())},
        {"low": _number("lowest"), "high": _number("highest")},
        {"lock": _button("Lock the range")}, {"symmetric": _check("symmetric about 0")},
        {"palette": _choice("Palette", [("", "as suits the field"), *PALETTES])},
        {"levels": _count("Number of colours", low=2, high=256)},
        {"hatched": _check("hatch what is within 2 σ of 0")},
    ),
    "Layers": (
        {"directions": _check("principal directions")}, {"contours": _check("contour lines")},
        {"extremes": _check("smallest and largest value")}, {"blank": _check("nodes without data")},
        {"vectors": _check("displacement as arrows")},
        {"longer": _number("times their length (0: as there is room)", low=0)},
    ),
    "Derived": (
        {"gauge": _number("Strain gauge length, px (0: shortest)", low=0)},
        {"measure": _choice("Strain measure", MEASURES)},
        {"since": _count("Since frame (-1: the reference)", low=-1)}, {"rigid": _check("rigid motion removed")},
        {"rate_window": _count("Rates over frames (0: as stated, or 9)", low=0)},
    ),
    "Probes": (
        {"mode": _group("what a click sets", _MODES)},
        {"curve": _choice("Curve"), "along": _choice("Along x")},
        {"probe": _choice("Probe"), "name": _text("its name")},
        {"undo": _button("Undo"), "redo": _button("Redo"), "clear": _button("Clear")},
        {"csv": _button("Save CSV"), "png": _button("Save PNG")}, {"message": _NOTE},
    ),
    "Channels": (
        {"channels": _text("CSV file beside the test")},
        {"beside": _choice("Beside the curves"), "clock": _choice("Its time by", CLOCKS.items())},
        {"trigger": _choice("Trigger channel")},
        {"align": _choice("Channel"), "align_to": _choice("alike to")}, {"offset": _number("Offset, s")},
        {"drag": Control(bk.Toggle, {"label": "Drag the channel along the time"})},
        {"force": _choice("Force"), "area": _number("Section, mm²", low=0)}, {"channel_status": _NOTE},
    ),
    "File": (
        {"scale": _group("points of the scale", ["Move", "Two points of a distance"], active=None)},
        {"distance": _number("Length, mm", low=0), "distance_std": _number("± mm", low=0),
         "camera": _text("or camera")},
        {"scale_label": _NOTE}, {"file": _text("TEST.toml, beside test or result", "TEST.toml")},
        {"sections_to_write": Control(bk.CheckboxButtonGroup, _SECTION_CHOICE)},
        {"write": _button("Write"), "load_probes": _button("Take its probes")}, {"save_status": _NOTE},
    ),
}  # fmt: skip
"""Controls of a result by the section under which they stand, in rows: one section is shown at a time, and fits a
screen of 720 rows."""
CONTROLS = {name: control for rows in SECTIONS.values() for controls in rows for name, control in controls.items()}
"""All of them by their names: those of the entries of the view that they set, and others."""


class ResultControls(Controls):
    """Controls of the page of a result, with nothing chosen yet, by their names; parameters as `Controls`."""

    def __init__(self, last_frame: int, frame: int, *, dark: bool) -> None:
        super().__init__(last_frame, frame, dark=dark)
        self._models: dict[str, Any] = {}
        for name, control in CONTROLS.items():
            look = self.small if control.widget is bk.Checkbox else self.wide
            self._models[name] = control.widget(name={"field": "quantity"}.get(name, name), **control.options, **look)
        self.message = self._models["message"]
        self.section = self.group("section", "controls shown", SECTIONS)
        self.pointer_label = bk.Div(name="pointer_label", **self.wide)
        self.movie = bk.Toggle(label="Movie", name="movie", width=90, **self.small)
        folded = {"max-height": "48px", "overflow": "auto", "overflow-wrap": "anywhere"}
        look = {"styles": folded, "html_attributes": LIVE_REGION, **self.small}
        self.movie_status = bk.Div(name="movie_status", width=300, visible=False, **look)
        self.player = row(self.play, self.step, self.frame, self.movie, self.movie_status, sizing_mode="stretch_width")

    def __getitem__(self, name: str) -> Any:
        """Return the widget of a control."""
        return self._models[name]

    @property
    def side(self) -> Any:
        """The column of all controls, of which one section is shown."""
        flat, section_columns = {"sizing_mode": "stretch_width"}, list[Any]()
        for rows in SECTIONS.values():
            models = [[self[name] for name in controls] for controls in rows]
            lines = [row(*group, **flat) if len(group) > 1 else group[0] for group in models]
            section_columns.append(column(*lines, visible=not section_columns, **flat))
        self.section.js_on_change("active", script("turnTo", group=self.section, sections=section_columns))
        return column(self.description, self.section, *section_columns, self.theme, **flat)

    def wire(self, state: SharedState, tools: Sequence[Any], frame_mark: bk.Span) -> None:
        """Let the browser itself act; `frame_mark` marks the frame that is shown."""
        self.request_frames(state)
        for name in ("displayed_frame", "query"):
            state.js_on_change(name, script("showFrame", state=state, now=frame_mark))
        state.js_on_change("csv", script("keepCsv", state=state))
        state.js_on_change("png", script("keepPng", state=state))
        mode, scale = self["mode"], self["scale"]
        for group, group_tools, other_group in ((mode, tools[:-1], scale), (scale, [tools[0], tools[-1]], mode)):
            group.js_on_change("active", script("choose", group=group, tools=list(group_tools), other=other_group))
