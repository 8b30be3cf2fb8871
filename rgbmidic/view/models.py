"""The parts of the page of a result: plots, controls, and the few lines of script that run in the browser.

The marks that are set on a field: they move with the material, and those of one probe are joined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.core.properties import Int, String
from bokeh.model import DataModel
from bokeh.models import (
    Button,
    Checkbox,
    ColumnDataSource,
    CustomJS,
    Div,
    InlineStyleSheet,
    NumericInput,
    RadioButtonGroup,
    Select,
    Slider,
    Span,
    Spinner,
    Toggle,
)

from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, Mark
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.picture import element_at

__all__ = ["TOOL", "Asked", "Controls", "MarkLayer", "controls", "pump", "sheet", "theme_button", "wire"]

_DARK = """
:host { color: #e6e9ec; }
.bk-input, .bk-btn { background-color: #24292f !important; color: #e6e9ec !important; }
.bk-input, .bk-btn { border-color: #4b545e !important; }
.bk-btn.bk-active { background-color: #2f6fb0 !important; }
:host, .bk-input, .bk-btn { font-size: 13px; }
.bk-btn { padding: 5px 5px; }
.noUi-target { background: #24292f; border-color: #4b545e; box-shadow: none; }
"""
_LIGHT = ":host { color: #1b1f24; } :host, .bk-input, .bk-btn { font-size: 13px; } .bk-btn { padding: 5px 5px; }"
_SHORT = 150
"""Smallest number of ms between two frames that are played: what eyes follow, and 6 to 7 a second."""

PUMP = """
if (state.asked !== state.shown) return;           // one frame on its way at a time
if (slider.value !== state.shown) { state.asked = slider.value; return; }
if (!play.active) return;
const wait = Math.max(0, (window.rgbmidic_next || 0) - performance.now());
setTimeout(() => {
  if (!play.active || slider.value !== state.shown) return;
  window.rgbmidic_next = performance.now() + %d;
  slider.value = slider.value + step.value > slider.end ? slider.start : slider.value + step.value;
}, wait);
"""
TOOL = "tools[cb_obj.active].active = true"
SHOWN = """
now.setv({location: state.shown}, {sync: false});
history.replaceState(null, "", "?frame=" + state.shown + (state.query && "&" + state.query));
"""
_KEEP = """
const keep = (blob, name) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  URL.revokeObjectURL(link.href);
};
"""
KEEP_CSV = f"""{_KEEP}
if (!state.csv) return;
keep(new Blob([state.csv], {{type: "text/csv"}}), "history.csv");
state.csv = "";
"""
KEEP_PNG = f"""{_KEEP}
Bokeh.index.get_one(plot).export("png").to_blob().then((blob) => keep(blob, "history.png"));
"""


class Asked(DataModel):  # type: ignore[misc]  # see pyproject.toml
    """What browser and server tell each other: frame asked for, frame shown, rest of the address, a file to keep."""

    asked = Int(0)
    shown = Int(0)
    query = String("")
    csv = String("")


@dataclass(frozen=True, slots=True, kw_only=True)
class Controls:
    """What is set beside the plots, and the words."""

    head: Div
    field: Select
    over: RadioButtonGroup
    opacity: Slider
    range: Select
    low: NumericInput
    high: NumericInput
    symmetric: Checkbox
    directions: Checkbox
    words: Div
    under: Div
    mode: RadioButtonGroup
    curve: Select
    clear: Button
    csv: Button
    png: Button
    told: Div
    theme: Button
    frame: Slider
    play: Toggle
    step: Spinner


def sheet(*, dark: bool) -> InlineStyleSheet:
    """How controls look."""
    return InlineStyleSheet(css=_DARK if dark else _LIGHT)


def theme_button(*, dark: bool, **style: Any) -> Button:
    """A button that opens the page anew, light or dark."""
    other = "light" if dark else "dark"
    turn = f"const u = new URL(location.href); u.searchParams.set('theme', '{other}'); location.replace(u.href)"
    button = Button(label=f"{other.capitalize()} page", **style)
    button.js_on_click(CustomJS(code=turn))
    return button


def pump(state: Asked, slider: Slider, play: Toggle, step: Spinner) -> None:
    """Let the slider ask for frames, and play them."""
    asks = CustomJS(args={"state": state, "slider": slider, "play": play, "step": step}, code=PUMP % _SHORT)
    slider.js_on_change("value", asks)
    play.js_on_change("active", asks)
    state.js_on_change("shown", asks)


def controls(frames: int, *, dark: bool) -> Controls:
    """The controls, with nothing chosen yet."""
    sheets = [sheet(dark=dark)]
    wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
    last = max(frames - 1, 1)
    return Controls(
        head=Div(**wide),
        field=Select(title="Field", name="quantity", **wide),
        over=RadioButtonGroup(labels=["over the reference", "over the frame"], name="over", **wide),
        opacity=Slider(title="Opacity", start=0, end=1, step=0.05, value=1, **wide),
        range=Select(
            title="Colours from",
            name="range",
            options=[("frame", "this frame"), ("test", "the whole test"), ("hand", "the two numbers")],
            **wide,
        ),
        low=NumericInput(title="lowest", name="low", mode="float", **wide),
        high=NumericInput(title="highest", name="high", mode="float", **wide),
        symmetric=Checkbox(label="symmetric about 0", name="symmetric", stylesheets=sheets),
        directions=Checkbox(label="principal directions", name="directions", stylesheets=sheets),
        words=Div(name="words", **wide),
        under=Div(name="under", **wide),
        mode=RadioButtonGroup(labels=["Move", "Point", "Gauge", "Line", "Strain"], active=0, name="mode", **wide),
        curve=Select(title="Curve", name="curve", **wide),
        clear=Button(label="Clear", **wide),
        csv=Button(label="Save CSV", **wide),
        png=Button(label="Save PNG", **wide),
        told=Div(name="told", **wide),
        theme=theme_button(dark=dark, **wide),
        frame=Slider(title="Frame", name="frame", start=0, end=last, step=1, value=0, disabled=frames < 2, **wide),
        play=Toggle(label="▶ Play", name="play", width=90, stylesheets=sheets),
        step=Spinner(name="step", low=1, high=last, value=1, width=70, stylesheets=sheets),
    )


def wire(state: Asked, parts: Controls, tools: Sequence[Any], now: Span, curves: Any) -> None:
    """What happens in the browser itself; `now` marks the frame that is shown, `curves` is a plot."""
    pump(state, parts.frame, parts.play, parts.step)
    shown = CustomJS(args={"state": state, "now": now}, code=SHOWN)
    state.js_on_change("shown", shown)
    state.js_on_change("query", shown)
    state.js_on_change("csv", CustomJS(args={"state": state}, code=KEEP_CSV))
    parts.png.js_on_click(CustomJS(args={"plot": curves}, code=KEEP_PNG))
    parts.mode.js_on_change("active", CustomJS(args={"tools": list(tools)}, code=TOOL))


_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#0072b2", "#f0e442", "#999999")
"""Okabe and Ito's colours, told apart by everyone."""
_LETTERS = {
    "x_offset": 8,
    "y_offset": -4,
    "background_fill_color": "#15181c",
    "background_fill_alpha": 0.75,
    "text_font_size": "12px",
    "padding": 2,
}


class MarkLayer:
    """The marks on a canvas.

    Parameters
    ----------
    canvas
        Where they are set and drawn.
    elements : ndarray, shape (E, 3)
        Of the mesh that carries them.

    Attributes
    ----------
    colours
        Of each probe that the marks make, by its name.
    """

    def __init__(self, canvas: Canvas, elements: npt.NDArray[np.int32]) -> None:
        self.colours: dict[str, str] = {}
        self._canvas, self._elements, self._shown = canvas, elements, dict[Mark, Mark]()
        self._joined = ColumnDataSource({name: [] for name in ("xs", "ys", "colour", "x", "y", "text")})
        canvas.plot.multi_line("xs", "ys", source=self._joined, line_color="colour", line_width=3)
        canvas.plot.text("x", "y", "text", source=self._joined, text_color="colour", **_LETTERS)

    def place(self, marks: Sequence[Mark], reference: FloatArray, nodes: FloatArray) -> None:
        """Draw marks of the reference where their material is when the nodes (N, 2) are where they are now."""
        at = [self._carried(mark, reference, nodes) for mark in marks]
        shown = dict(zip(at, marks, strict=True))
        if shown == self._shown:
            return
        self._shown = shown
        self._canvas.place(at)
        probes = _probes(at)
        self.colours = {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(probes)}
        self._joined.data = {
            "xs": [[mark.x for mark in own] for own in probes.values()],
            "ys": [[mark.y for mark in own] for own in probes.values()],
            "colour": list(self.colours.values()),
            "x": [own[0].x for own in probes.values()],
            "y": [own[0].y for own in probes.values()],
            "text": [name.replace("_", " ") for name in probes],
        }

    def taken(self, nodes: FloatArray, reference: FloatArray) -> tuple[Mark, ...] | None:
        """The marks as they were set over nodes that are there now, on the reference; None: none was set or moved."""
        now = self._canvas.set
        if now == list(self._shown):
            return None
        return tuple(self._shown.get(mark) or self._carried(mark, nodes, reference) for mark in now)

    def _carried(self, mark: Mark, before: FloatArray, after: FloatArray) -> Mark:
        """A mark where its place in the mesh `before` is in the mesh `after`; as it is where that is nowhere."""
        found = None if before is after else element_at(before, self._elements, mark.x, mark.y)
        if found is None:
            return mark
        x, y = found[1] @ after[found[0]]
        return Mark(mark.kind, float(x), float(y)) if np.isfinite(x + y) else mark


def _probes(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """The marks of each whole probe, by its name."""
    found: dict[str, list[Mark]] = {}
    for kind, count in KINDS.items():
        own = [mark for mark in marks if mark.kind == kind]
        found |= {f"{kind}_{n + 1}": own[n * count : (n + 1) * count] for n in range(len(own) // count)}
    return found
