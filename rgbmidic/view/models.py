"""The parts of the page of a result: plots, controls, and the few lines of script that run in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bokeh.core.properties import Int, String
from bokeh.model import DataModel
from bokeh.models import (
    BoxZoomTool,
    Button,
    Checkbox,
    ColorBar,
    ColumnDataSource,
    CustomJS,
    Div,
    InlineStyleSheet,
    LinearColorMapper,
    NumericInput,
    PanTool,
    PointDrawTool,
    RadioButtonGroup,
    Range1d,
    ResetTool,
    SaveTool,
    Select,
    Slider,
    Span,
    Spinner,
    Toggle,
    WheelZoomTool,
)
from bokeh.plotting import figure

from rgbmidic.view.address import KINDS

__all__ = ["Asked", "Controls", "Plots", "controls", "plots", "wire"]

_DARK = """
:host { color: #e6e9ec; }
.bk-input, .bk-btn { background-color: #24292f !important; color: #e6e9ec !important; border-color: #4b545e !important; }
.bk-btn.bk-active { background-color: #2f6fb0 !important; }
.noUi-target { background: #24292f; border-color: #4b545e; box-shadow: none; }
"""
_LIGHT = ":host { color: #1b1f24; }"
_LETTERS = {"background_fill_color": "#15181c", "background_fill_alpha": 0.75, "text_font_size": "12px", "padding": 2}
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
ADDRESS = "history.replaceState(null, '', '?' + state.query)"
DOWNLOAD = """
if (!state.csv) return;
const link = document.createElement("a");
link.href = URL.createObjectURL(new Blob([state.csv], {type: "text/csv"}));
link.download = "history.csv";
link.click();
URL.revokeObjectURL(link.href);
state.csv = "";
"""


class Asked(DataModel):
    """What browser and server tell each other: the frame asked for, the one shown, the address, a file to keep."""

    asked = Int(0)
    shown = Int(0)
    query = String("")
    csv = String("")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plots:
    """The plots with what they draw."""

    field: Any
    image: ColumnDataSource
    colours: LinearColorMapper
    marks: ColumnDataSource
    joined: ColumnDataSource
    tools: tuple[Any, ...]
    course: Any
    shares: ColumnDataSource
    faults: ColumnDataSource
    curves: Any
    lines: ColumnDataSource
    bands: ColumnDataSource
    now: tuple[Span, Span]


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
    words: Div
    under: Div
    mode: RadioButtonGroup
    curve: Select
    clear: Button
    csv: Button
    told: Div
    theme: Button
    frame: Slider
    play: Toggle
    step: Spinner


def plots(frames: int) -> Plots:
    """The plots, empty."""
    field = figure(
        name="plot",
        title=" ",
        x_range=Range1d(0, 1),
        y_range=Range1d(1, 0),
        sizing_mode="stretch_both",
        min_border=4,
        x_axis_label="x (px)",
        y_axis_label="y (px)",
        tools=[],
        toolbar_location="above",
    )
    field.grid.visible = False
    image = ColumnDataSource({name: [] for name in ("image", "x", "y", "dw", "dh")})
    field.image_rgba("image", "x", "y", "dw", "dh", source=image)
    colours = LinearColorMapper(palette=["#000000"], low=0, high=1)
    field.add_layout(ColorBar(color_mapper=colours, width=14), "right")
    marks = ColumnDataSource({"x": [], "y": [], "kind": []}, name="marks")
    joined = ColumnDataSource({"xs": [], "ys": [], "colour": [], "x": [], "y": [], "text": []})
    field.multi_line("xs", "ys", source=joined, line_color="colour", line_width=3)
    field.text("x", "y", "text", source=joined, text_color="colour", x_offset=8, y_offset=-4, **_LETTERS)
    dots = field.scatter("x", "y", source=marks, size=9, fill_color="white", line_color="black", line_width=1.5)
    draw = tuple(
        PointDrawTool(renderers=[dots], empty_value=kind, visible=False) for kind in KINDS
    )
    pan, wheel = PanTool(), WheelZoomTool(zoom_on_axis=False)
    field.add_tools(pan, wheel, BoxZoomTool(match_aspect=True), ResetTool(), SaveTool(filename="field"), *draw)
    field.toolbar.active_drag, field.toolbar.active_scroll, field.toolbar.logo = pan, wheel, None
    course, shares, faults = _course(frames)
    curves, lines, bands = _curves()
    now = tuple(Span(dimension="height", line_color="#d1495b", line_width=1.5) for _ in range(2))
    course.add_layout(now[0])
    curves.add_layout(now[1])
    return Plots(
        field=field,
        image=image,
        colours=colours,
        marks=marks,
        joined=joined,
        tools=(pan, *draw),
        course=course,
        shares=shares,
        faults=faults,
        curves=curves,
        lines=lines,
        bands=bands,
        now=now,
    )


def _course(frames: int) -> tuple[Any, ColumnDataSource, ColumnDataSource]:
    """The time line: how many nodes each frame measures, and the frames that failed."""
    plot = figure(
        name="course",
        sizing_mode="stretch_both",
        x_range=Range1d(-0.5, max(frames - 0.5, 0.5)),
        y_range=Range1d(0, 105),
        x_axis_label=None,
        y_axis_label="nodes (%)",
        tools=[],
        toolbar_location=None,
        min_border=2,
    )
    plot.yaxis.ticker = [0, 50, 100]
    shares, faults = ColumnDataSource({"x": [], "y": []}), ColumnDataSource({"x": [], "y": [], "colour": []})
    plot.varea("x", 0, "y", source=shares, fill_color="#6baed6", fill_alpha=0.6)
    plot.segment("x", 0, "x", "y", source=faults, line_color="colour", line_width=2)
    return plot, shares, faults


def _curves() -> tuple[Any, ColumnDataSource, ColumnDataSource]:
    plot = figure(
        name="curves",
        sizing_mode="stretch_both",
        min_border=4,
        tools="pan,wheel_zoom,box_zoom,reset,save,hover",
        toolbar_location="above",
    )
    plot.toolbar.logo = None
    lines = ColumnDataSource({"xs": [], "ys": [], "colour": [], "name": []}, name="lines")
    bands = ColumnDataSource({"xs": [], "ys": [], "colour": []}, name="bands")
    plot.patches("xs", "ys", source=bands, fill_color="colour", fill_alpha=0.25, line_alpha=0)
    drawn = plot.multi_line("xs", "ys", source=lines, line_color="colour", line_width=1.5, legend_field="name")
    plot.x_range.renderers = plot.y_range.renderers = [drawn]  # the values rule, not the widest band
    plot.hover.renderers, plot.hover.tooltips = [drawn], [("", "@name"), ("at", "$snap_x"), ("value", "$snap_y")]
    plot.legend.visible, plot.legend.location, plot.legend.label_text_font_size = False, "top_left", "11px"
    plot.legend.background_fill_alpha = 0.6
    return plot, lines, bands


def controls(frames: int, *, dark: bool) -> Controls:
    """The controls, with nothing chosen yet."""
    sheets = [InlineStyleSheet(css=_DARK if dark else _LIGHT)]
    wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
    half: dict[str, Any] = {"stylesheets": sheets, "width": 112}
    last = max(frames - 1, 1)
    return Controls(
        head=Div(**wide),
        field=Select(title="Field", name="field", **wide),
        over=RadioButtonGroup(labels=["over the reference", "over the frame"], name="over", **wide),
        opacity=Slider(title="Opacity", start=0, end=1, step=0.05, value=1, **wide),
        range=Select(
            title="Colours from",
            name="range",
            options=[("frame", "this frame"), ("test", "the whole test"), ("hand", "the two numbers")],
            **wide,
        ),
        low=NumericInput(title="lowest", name="low", mode="float", **half),
        high=NumericInput(title="highest", name="high", mode="float", **half),
        symmetric=Checkbox(label="symmetric about 0", name="symmetric", stylesheets=sheets),
        words=Div(name="words", **wide),
        under=Div(name="under", min_height=64, **wide),
        mode=RadioButtonGroup(
            labels=["Move", "Point", "Gauge", "Line", "Strain"], active=0, name="mode", **wide
        ),
        curve=Select(title="Curve", name="curve", **wide),
        clear=Button(label="Remove all", **half),
        csv=Button(label="Save CSV", name="save_csv", **half),
        told=Div(name="told", **wide),
        theme=Button(label="Light page" if dark else "Dark page", **wide),
        frame=Slider(title="Frame", name="frame", start=0, end=last, step=1, value=0, **wide),
        play=Toggle(label="▶ Play", name="play", width=90, stylesheets=sheets),
        step=Spinner(name="step", low=1, high=last, value=1, width=70, stylesheets=sheets),
    )


def wire(state: Asked, parts: Controls, drawn: Plots) -> None:
    """What happens in the browser itself."""
    models = {"state": state, "slider": parts.frame, "play": parts.play, "step": parts.step}
    pump = CustomJS(args=models, code=PUMP % _SHORT)
    parts.frame.js_on_change("value", pump)
    parts.play.js_on_change("active", pump)
    state.js_on_change("shown", pump)
    state.js_on_change("query", CustomJS(args={"state": state}, code=ADDRESS))
    state.js_on_change("csv", CustomJS(args={"state": state}, code=DOWNLOAD))
    tools = CustomJS(args={"tools": list(drawn.tools)}, code="tools[cb_obj.active].active = true")
    parts.mode.js_on_change("active", tools)
    turn = "const u = new URL(location.href); u.searchParams.set('theme', '%s'); location.replace(u.href)"
    parts.theme.js_on_click(CustomJS(code=turn % ("light" if parts.theme.label.startswith("Light") else "dark")))
