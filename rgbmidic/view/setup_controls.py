"""The controls of the page that sets a test up."""

from __future__ import annotations

import html
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from bokeh.layouts import column, row
from bokeh.models import Button, Checkbox, Div, RadioButtonGroup, Select, Slider, Spinner, TextInput, Toggle

from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.view.draft import Draft
from rgbmidic.view.models import sheet, theme_button
from rgbmidic.view.setup_frames import RAW

__all__ = ["SetupControls", "setup_controls"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupControls:
    """What is set beside the frame, and the words."""

    head: Div
    words: Div
    picture: Select
    glare: Checkbox
    mode: RadioButtonGroup
    hole: RadioButtonGroup
    undo: Button
    next: Button
    clear: Button
    size: Spinner
    reference: Spinner
    first: Spinner
    last: Spinner
    calibration: TextInput
    inspect: Button
    theme: Button
    told: Div
    file: TextInput
    write: Button
    out: TextInput
    go: Button
    ran: Div
    frame: Slider
    step: Spinner
    play: Toggle

    @property
    def side(self) -> Any:
        """The column left of the frame."""
        wide = partial(row, sizing_mode="stretch_width")
        buttons, numbers = wide(self.undo, self.next, self.clear), wide(self.reference, self.first, self.last)
        parts = (self.words, self.picture, self.glare, self.mode, self.hole, buttons, self.size, numbers)
        return column(*parts, self.calibration, self.inspect, self.theme, sizing_mode="stretch_width")

    @property
    def player(self) -> Any:
        """The row under the frame."""
        return row(self.play, self.step, self.frame, sizing_mode="stretch_width")


def setup_controls(draft: Draft, last: int, out: Path, *, dark: bool) -> SetupControls:
    """The controls as a draft of frames 0 to `last` says, whose result goes to `out`."""
    sheets, frames = [sheet(dark=dark)], draft.frames
    wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
    number: dict[str, Any] = {"low": 0, "high": last, "step": 1, **wide}
    reference, end, most = frames.reference[0], last if frames.last is None else frames.last, max(last, 1)
    size = draft.section("mesh").get("element_size", ELEMENT_SIZE)
    calibration = str(draft.section("calibration").get("file", ""))
    return SetupControls(
        head=Div(text=f"<b>{html.escape(str(draft.file))}</b> &nbsp; a test to set up", **wide),
        words=Div(name="words", **wide),
        picture=Select(title="Picture", name="picture", options=[RAW], value=RAW, **wide),
        glare=Checkbox(label="mark saturated samples", active=True, stylesheets=sheets),
        mode=RadioButtonGroup(labels=["Move", "Rectangle", "Polygon", "Circle"], active=0, name="mode", **wide),
        hole=RadioButtonGroup(labels=["Hole", "Round hole"], active=None, name="hole", **wide),
        undo=Button(label="Undo", **wide),
        next=Button(label="Next hole", **wide),
        clear=Button(label="Clear", **wide),
        size=Spinner(title="Element size (px)", name="size", low=4, value=size, step=1, **wide),
        reference=Spinner(title="Reference", name="reference", value=reference, **number),
        first=Spinner(title="First", name="first", value=frames.first, **number),
        last=Spinner(title="Last", name="last", value=end, **number),
        calibration=TextInput(title="Calibration file", name="calibration", value=calibration, **wide),
        inspect=Button(label="Inspect", **wide),
        theme=theme_button(dark=dark, **wide),
        told=Div(name="told", **wide),
        file=TextInput(title="Write to", name="file", value=str(draft.file), **wide),
        write=Button(label="Write TEST.toml", **wide),
        out=TextInput(title="Result folder", name="out", value=str(out), **wide),
        go=Button(label="Run", button_type="primary", **wide),
        ran=Div(name="ran", **wide),
        frame=Slider(title="Frame", name="frame", start=0, end=most, value=reference, disabled=last < 1, **wide),
        step=Spinner(name="step", low=1, high=most, value=1, width=70, stylesheets=sheets),
        play=Toggle(label="▶ Play", name="play", width=90, stylesheets=sheets),
    )
