"""Controls of the page of a result: one table of them, and the widgets that it makes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import bokeh.models as bk
from bokeh.layouts import column, row

from rgbmidic.fields import MEASURES
from rgbmidic.tools.view.widgets import (
    LIVE_REGION,
    NOTE,
    Control,
    Controls,
    SharedState,
    aria_group,
    button,
    check,
    choice,
    count,
    group,
    number,
    script,
    text,
)

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


_SECTION_CHOICE = {
    "labels": list(WRITABLE_SECTIONS),
    "active": [0],
    "html_attributes": aria_group("sections that are written"),
}

SECTIONS: Mapping[str, Sequence[Mapping[str, Control]]] = {
    "Field": (
        {"field": choice("Field")},
        {"second": choice("Second field")}, {"third": choice("Third field")}, {"fourth": choice("Fourth field")},
        {"over": group("image", ["over the reference", "over the frame"], active=None)},
        {"opacity": Control(bk.Slider, {"title": "Opacity", "start": 0, "end": 1, "step": 0.05, "value": 1})},
        {"print": button("Save PNG for print")},
    ),
    "Colours": (
        {"range": choice("Colours from", _RANGES.items())},
        {"low": number("lowest"), "high": number("highest")},
        {"lock": button("Lock the range")}, {"symmetric": check("symmetric about 0")},
        {"palette": choice("Palette", [("", "as suits the field"), *PALETTES])},
        {"levels": count("Number of colours", low=2, high=256)},
        {"hatched": check("hatch what is within 2 σ of 0")},
    ),
    "Layers": (
        {"directions": check("principal directions")}, {"contours": check("contour lines")},
        {"extremes": check("smallest and largest value")}, {"blank": check("nodes without data")},
        {"vectors": check("displacement as arrows")},
        {"longer": number("times their length (0: as there is room)", low=0)},
    ),
    "Derived": (
        {"gauge": number("Strain gauge length, px (0: shortest)", low=0)},
        {"measure": choice("Strain measure", MEASURES)},
        {"since": count("Since frame (-1: the reference)", low=-1)}, {"rigid": check("rigid motion removed")},
        {"rate_window": count("Rates over frames (0: as stated, or 9)", low=0)},
    ),
    "Probes": (
        {"mode": group("what a click sets", _MODES)},
        {"curve": choice("Curve"), "along": choice("Along x")},
        {"probe": choice("Probe"), "name": text("its name")},
        {"undo": button("Undo"), "redo": button("Redo"), "clear": button("Clear")},
        {"csv": button("Save CSV"), "png": button("Save PNG")}, {"message": NOTE},
    ),
    "Channels": (
        {"channels": text("CSV file beside the test")},
        {"beside": choice("Beside the curves"), "clock": choice("Its time by", CLOCKS.items())},
        {"trigger": choice("Trigger channel")},
        {"align": choice("Channel"), "align_to": choice("alike to")}, {"offset": number("Offset, s")},
        {"drag": Control(bk.Toggle, {"label": "Drag the channel along the time"})},
        {"force": choice("Force"), "area": number("Section, mm²", low=0)}, {"channel_status": NOTE},
    ),
    "File": (
        {"scale": group("points of the scale", ["Move", "Two points of a distance"], active=None)},
        {"distance": number("Length, mm", low=0), "distance_std": number("± mm", low=0),
         "camera": text("or camera")},
        {"scale_label": NOTE}, {"file": text("TEST.toml, beside test or result", "TEST.toml")},
        {"sections_to_write": Control(bk.CheckboxButtonGroup, _SECTION_CHOICE)},
        {"write": button("Write"), "load_probes": button("Take its probes")}, {"save_status": NOTE},
    ),
}  # fmt: skip
"""Controls of a result by the section under which they stand, in rows: one section is shown at a time, and fits a
screen of 720 rows."""
_ROWS = [controls for rows in SECTIONS.values() for controls in rows]
CONTROLS = {name: control for controls in _ROWS for name, control in controls.items()}
"""All of them by their names: those of the entries of the view that they set, and others."""


class ResultControls(Controls):
    """Controls of the page of a result, with nothing chosen yet; parameters as `Controls`."""

    def __init__(self, last_frame: int, frame: int, *, dark: bool) -> None:
        super().__init__([*_ROWS, {"section": group("controls shown", SECTIONS)}], last_frame, frame, dark=dark)
        self.pointer_label = bk.Div(name="pointer_label", **self.wide)
        self.movie = bk.Toggle(label="Movie", name="movie", width=90, **self.small)
        folded = {"max-height": "48px", "overflow": "auto", "overflow-wrap": "anywhere"}
        look = {"styles": folded, "html_attributes": LIVE_REGION, **self.small}
        self.movie_status = bk.Div(name="movie_status", width=300, visible=False, **look)
        self.player = row(self.play, self.step, self.frame, self.movie, self.movie_status, sizing_mode="stretch_width")

    @property
    def side(self) -> Any:
        """The column of all controls, of which one section is shown."""
        flat, section_columns = {"sizing_mode": "stretch_width"}, list[Any]()
        for rows in SECTIONS.values():
            section_columns.append(column(*self.lines(rows), visible=not section_columns, **flat))
        self["section"].js_on_change("active", script("turnTo", group=self["section"], sections=section_columns))
        return column(self.description, self["section"], *section_columns, self.theme, **flat)

    def wire(self, state: SharedState, tools: Sequence[Any], frame_mark: bk.Span) -> None:
        """Let the browser itself act; `frame_mark` marks the frame that is shown."""
        self.request_frames(state)
        for name in ("displayed_frame", "query"):
            state.js_on_change(name, script("showFrame", state=state, now=frame_mark))
        state.js_on_change("csv", script("keepCsv", state=state))
        state.js_on_change("png", script("keepPng", state=state))
        mode, scale = self["mode"], self["scale"]
        for buttons, group_tools, other_group in ((mode, tools[:-1], scale), (scale, [tools[0], tools[-1]], mode)):
            buttons.js_on_change("active", script("choose", group=buttons, tools=list(group_tools), other=other_group))
