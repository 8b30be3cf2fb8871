"""Controls of a page, the scripts that run in the browser, and the marks of probes, which move with the material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from typing import Any

import bokeh.models as bk
import numpy as np
import numpy.typing as npt
from bokeh.core.properties import Int, String
from bokeh.layouts import column, row
from bokeh.model import DataModel

from rgbmidic.fields import MEASURES
from rgbmidic.report.style import OKABE_ITO
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import PALETTES, SCALE, Mark, probe_marks
from rgbmidic.view.canvas import LETTERS, Canvas, beside, columns
from rgbmidic.view.picture import element_at

_SHORT = 150
"""Smallest number of ms between two frames that are played: 6 to 7 a second, which the eye can follow."""


def page_file(name: str) -> str:
    """Text of a file of the page that lies beside this module."""
    return files("rgbmidic.view").joinpath(name).read_text(encoding="utf-8")


def script(name: str, **parts: Any) -> bk.CustomJS:
    """Call a function of page.js in the browser with parts of the page, and plain values, by their names."""
    return bk.CustomJS(args=parts, code=f"rgbmidic.{name}({{{', '.join(parts)}}})")


class SharedState(DataModel):  # type: ignore[misc]  # see pyproject.toml
    """State that browser and server share: frame asked for, frame shown, rest of the address, a file to keep."""

    asked = Int(0)
    shown = Int(0)
    query = String("")
    csv = String("")


class Controls:
    """Controls that every page has: texts, theme, and the player of the frames.

    Parameters
    ----------
    last
        Index of the last frame.
    frame
        Index of the frame in view at first.
    dark
        Whether the page is dark.

    Attributes
    ----------
    small, wide
        Options of a control of fixed width, and of one as wide as its column.
    player
        The row of play button, step and slider.
    """

    def __init__(self, last: int, frame: int, *, dark: bool) -> None:
        styles = ("widgets.css", "dark.css") if dark else ("widgets.css",)
        self.small: dict[str, Any] = {"stylesheets": [bk.InlineStyleSheet(css=page_file(name)) for name in styles]}
        self.wide = wide = {**self.small, "sizing_mode": "stretch_width"}
        other, most = "light" if dark else "dark", max(last, 1)
        self.head, self.description = bk.Div(**wide), bk.Div(name="description", **wide)
        self.message = bk.Div(name="message", **wide)
        self.theme = bk.Button(label=f"{other.capitalize()} page", **wide)
        self.theme.js_on_click(script("turn", theme=other))
        self.frame = bk.Slider(
            title="Frame", name="frame", start=0, end=most, step=1, value=frame, disabled=last < 1, **wide
        )
        self.play = bk.Toggle(label="▶ Play", name="play", width=90, **self.small)
        self.step = bk.Spinner(name="step", low=1, high=most, value=1, width=70, **self.small)
        self.step.html_attributes = {"role": "group", "aria-label": "frames that Play and the arrow keys go on by"}
        self.description.html_attributes = {"aria-live": "polite"}
        self.player = row(self.play, self.step, self.frame, sizing_mode="stretch_width")

    def ask(self, state: SharedState) -> None:
        """Let the slider ask for frames, and play them."""
        asks = script("pump", state=state, slider=self.frame, play=self.play, step=self.step, wait=_SHORT)
        self.frame.js_on_change("value", asks)
        self.play.js_on_change("active", asks)
        state.js_on_change("shown", asks)


SECTIONS = ("Field", "Colours", "Layers", "Derived", "Probes", "Channels", "File")
"""Headings of the controls of a result: one section is shown at a time, and fits a screen of 720 rows."""
WRITTEN = ("probes", "channels", "scale")
"""Sections of a TEST.toml that the page can write."""
MODES = ("Move", "Point", "Gauge", "Line", "Strain", "Box", "Circle")
_ENDS = [("frame", "this frame"), ("test", "the whole test"), ("hand", "the two numbers")]
_NUMBER = {"mode": "float"}
_CLOCKS = [("offset", "an offset"), ("trigger", "a trigger"), ("correlation", "correlation")]
CONTROLS: tuple[tuple[str, str, type[bk.Widget], str, dict[str, Any]], ...] = (
    ("field", "Field", bk.Select, "Field", {}),
    ("second", "Field", bk.Select, "Second field", {}),
    ("third", "Field", bk.Select, "Third field", {}),
    ("fourth", "Field", bk.Select, "Fourth field", {}),
    ("opacity", "Field", bk.Slider, "Opacity", {"start": 0, "end": 1, "step": 0.05, "value": 1}),
    ("range", "Colours", bk.Select, "Colours from", {"options": _ENDS}),
    ("low", "Colours", bk.NumericInput, "lowest", _NUMBER),
    ("high", "Colours", bk.NumericInput, "highest", _NUMBER),
    ("symmetric", "Colours", bk.Checkbox, "symmetric about 0", {}),
    ("palette", "Colours", bk.Select, "Palette", {"options": [("", "as suits the field"), *PALETTES]}),
    ("levels", "Colours", bk.Spinner, "Number of colours", {"low": 2, "high": 256}),
    ("hatched", "Colours", bk.Checkbox, "hatch what is within 2 σ of 0", {}),
    ("directions", "Layers", bk.Checkbox, "principal directions", {}),
    ("contours", "Layers", bk.Checkbox, "contour lines", {}),
    ("extremes", "Layers", bk.Checkbox, "smallest and largest value", {}),
    ("blank", "Layers", bk.Checkbox, "nodes without data", {}),
    ("vectors", "Layers", bk.Checkbox, "displacement as arrows", {}),
    ("longer", "Layers", bk.NumericInput, "times their length (0: as there is room)", {**_NUMBER, "low": 0}),
    ("gauge", "Derived", bk.NumericInput, "Strain gauge length, px (0: shortest)", {**_NUMBER, "low": 0}),
    ("measure", "Derived", bk.Select, "Strain measure", {"options": list(MEASURES)}),
    ("since", "Derived", bk.Spinner, "Since frame (-1: the reference)", {"low": -1}),
    ("rigid", "Derived", bk.Checkbox, "rigid motion removed", {}),
    ("rate_window", "Derived", bk.Spinner, "Rates over frames (0: as stated, or 9)", {"low": 0}),
    ("along", "Probes", bk.Select, "Along x", {}),
    ("channels", "Channels", bk.TextInput, "CSV file beside the test", {}),
    ("beside", "Channels", bk.Select, "Beside the curves", {}),
    ("clock", "Channels", bk.Select, "Its time by", {"options": _CLOCKS}),
    ("offset", "Channels", bk.NumericInput, "Offset, s", _NUMBER),
    ("trigger", "Channels", bk.Select, "Trigger channel", {}),
    ("align", "Channels", bk.Select, "Channel", {}),
    ("align_to", "Channels", bk.Select, "alike to", {}),
    ("force", "Channels", bk.Select, "Force", {}),
    ("area", "Channels", bk.NumericInput, "Section, mm²", {**_NUMBER, "low": 0}),
    ("distance", "File", bk.NumericInput, "Length, mm", {**_NUMBER, "low": 0}),
    ("distance_std", "File", bk.NumericInput, "± mm", {**_NUMBER, "low": 0}),
    ("camera", "File", bk.TextInput, "or camera", {}),
)
"""Every control that sets an entry of the view: entry, section, kind, text and options."""


class ResultControls(Controls):
    """Controls of the page of a result, with nothing chosen yet; parameters as `Controls`.

    Attributes
    ----------
    of : dict
        The control of each entry of the view.
    """

    def __init__(self, last: int, frame: int, *, dark: bool) -> None:
        super().__init__(last, frame, dark=dark)
        wide, self.of = self.wide, dict[str, Any]()
        for entry, _, kind, text, options in CONTROLS:
            name = {"field": "quantity"}.get(entry, entry)
            told, look = ("label", self.small) if kind is bk.Checkbox else ("title", wide)
            self.of[entry] = kind(name=name, **{told: text}, **options, **look)
        self.over = bk.RadioButtonGroup(labels=["over the reference", "over the frame"], name="over", **wide)
        self.under = bk.Div(name="under", **wide)
        self.section = bk.RadioButtonGroup(labels=list(SECTIONS), active=0, name="section", **wide)
        self.mode = bk.RadioButtonGroup(labels=list(MODES), active=0, name="mode", **wide)
        self.curve = bk.Select(title="Curve", name="curve", **wide)
        self.movie = bk.Toggle(label="Movie", name="movie", width=90, **self.small)
        folded = {"max-height": "48px", "overflow": "auto", "overflow-wrap": "anywhere"}
        self.said = bk.Div(name="said", width=300, visible=False, styles=folded, **self.small)
        self.said.html_attributes = {"aria-live": "polite"}
        self.player = row(self.play, self.step, self.frame, self.movie, self.said, sizing_mode="stretch_width")
        labels = ("Lock the range", "Undo", "Redo", "Clear", "Save CSV", "Save PNG", "Write", "Take its probes")
        self.lock, self.undo, self.redo, self.clear, self.csv, self.png, self.write, self.take = (
            bk.Button(label=name, name=name.lower(), **wide) for name in labels
        )
        self.probe = bk.Select(title="Probe", name="probe", **wide)
        self.name = bk.TextInput(title="its name", name="name", **wide)
        self.drag = bk.Toggle(label="Drag the channel along the time", name="drag", **wide)
        self.scale = bk.RadioButtonGroup(labels=["Move", "Two points of a distance"], name="scale", **wide)
        self.file = bk.TextInput(title="TEST.toml, beside test or result", name="file", value="TEST.toml", **wide)
        self.what = bk.CheckboxButtonGroup(labels=list(WRITTEN), active=[0], name="what", **wide)
        self.told, self.written, self.scaled = (bk.Div(name=name, **wide) for name in ("told", "written", "scaled"))
        groups: dict[Any, str] = {self.over: "image", self.section: "controls shown", self.mode: "what a click sets"}
        groups |= {self.scale: "points of the scale", self.what: "sections that are written"}
        for group, says in groups.items():
            group.html_attributes = {"role": "group", "aria-label": says}

    @property
    def side(self) -> Any:
        """The column of all controls, of which one section is shown."""
        flat = {"sizing_mode": "stretch_width"}
        parts: dict[str, list[Any]] = {name: [] for name in SECTIONS}
        for entry, section, *_ in CONTROLS:
            parts[section].append(self.of[entry])
        parts["Field"].insert(4, self.over)
        low, high = (parts["Colours"].pop(1) for _ in "lh")
        parts["Colours"][1:1] = [row(low, high, **flat), self.lock]
        lines = row(self.curve, self.of["along"], **flat), row(self.probe, self.name, **flat)
        buttons = row(self.undo, self.redo, self.clear, **flat), row(self.csv, self.png, **flat)
        parts["Probes"] = [self.mode, *lines, *buttons, self.message]
        file, beside, clock, offset, trigger, align, align_to, force, area = parts["Channels"]
        pairs = row(align, align_to, **flat), row(force, area, **flat)
        clocks = row(beside, clock, **flat), trigger, pairs[0], offset, self.drag
        parts["Channels"] = [file, *clocks, pairs[1], self.told]
        known = row(*parts["File"], **flat)
        writes = self.file, self.what, row(self.write, self.take, **flat), self.written
        parts["File"] = [self.scale, known, self.scaled, *writes]
        shown = [column(*parts[name], visible=not place, **flat) for place, name in enumerate(SECTIONS)]
        self.section.js_on_change("active", script("turnTo", group=self.section, sections=shown))
        return column(self.description, self.section, *shown, self.theme, **flat)

    def wire(self, state: SharedState, tools: Sequence[Any], now: bk.Span, curves: Sequence[Any]) -> None:
        """Let the browser itself act; `now` marks the frame that is shown, `curves` are plots."""
        self.ask(state)
        for name in ("shown", "query"):
            state.js_on_change(name, script("shown", state=state, now=now))
        state.js_on_change("csv", script("keepCsv", state=state))
        self.png.js_on_click(script("keepPng", plots=list(curves)))
        groups = (self.mode, tools[:-1], self.scale), (self.scale, [tools[0], tools[-1]], self.mode)
        for group, own, other in groups:
            group.js_on_change("active", script("choose", group=group, tools=list(own), other=other))


_COLOURS = tuple(OKABE_ITO.values())
_PROBE = "xs ys colour x y text side along down"

_TURN = np.linspace(0, 2 * np.pi, 49)


def _outline(ends: Sequence[Mark], gauge: float) -> tuple[list[float], list[float]]:
    """Return the x and y of the lines that show a probe."""
    xs, ys = [mark.x for mark in ends], [mark.y for mark in ends]
    if ends[0].kind == "region":
        return [xs[0], xs[1], xs[1], xs[0], xs[0]], [ys[0], ys[0], ys[1], ys[1], ys[0]]
    if ends[0].kind in ("circle", "strain_gauge"):
        radius = gauge / 2 if len(ends) == 1 else float(np.hypot(xs[1] - xs[0], ys[1] - ys[0]))
        return (xs[0] + radius * np.cos(_TURN)).tolist(), (ys[0] + radius * np.sin(_TURN)).tolist()
    return xs, ys


class MarkLayer:
    """Marks of probes on a canvas, which move with the material.

    Parameters
    ----------
    canvas
        Plot on which they are set and drawn.
    elements : ndarray, shape (E, 3)
        Elements of the mesh that carries them.

    Attributes
    ----------
    colours
        Colour of each probe that the marks make, by its name.
    """

    def __init__(self, canvas: Canvas, elements: npt.NDArray[np.int32]) -> None:
        self.colours: dict[str, str] = {}
        self._canvas, self._elements, self._shown = canvas, elements, dict[object, tuple[Mark, Mark]]()
        self._drawn: object = None
        self._joined = bk.ColumnDataSource(columns(_PROBE), name="probes")
        canvas.plot.multi_line("xs", "ys", source=self._joined, line_color="colour", line_width=3)
        canvas.plot.text("x", "y", "text", source=self._joined, border_line_color="colour", **LETTERS)

    def place(
        self,
        marks: Sequence[Mark],
        reference: FloatArray,
        nodes: FloatArray,
        values: Mapping[str, str],
        gauge: float,
    ) -> None:
        """Draw marks, which lie on the `reference` (N, 2) of the nodes, where the nodes (N, 2) carry them.

        Each probe shows its value of `values`; strain gauges are circles of the length `gauge` (px).
        """
        at = [self._carried(mark, reference, nodes) for mark in marks]
        self._shown = {mark.key: (mark, own) for mark, own in zip(at, marks, strict=True)}
        self._canvas.place(at)
        drawn = (at, dict(values), gauge, self._canvas.window)
        if drawn == self._drawn:
            return
        self._drawn = drawn
        ends = [mark for mark in at if mark.kind == SCALE]
        probes = {**probe_marks(at), **({SCALE: ends} if len(ends) > 1 else {})}
        self.colours = {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(probes)}
        lines = [_outline(ends, gauge) for ends in probes.values()]
        texts = [
            (ends[0].x, ends[0].y, f"{name.replace('_', ' ')}{values.get(name, '')}") for name, ends in probes.items()
        ]
        placed = beside(texts, self._canvas.window)
        parts = zip(lines, self.colours.values(), texts, placed, strict=True)
        self._joined.data = columns(_PROBE, [(*line, colour, *text, *side) for line, colour, text, side in parts])

    def taken(self, nodes: FloatArray, reference: FloatArray) -> tuple[Mark, ...] | None:
        """Return the marks, set over nodes (N, 2), on the `reference` (N, 2); None where none has changed."""
        now = self._canvas.set
        if now == [mark for mark, _ in self._shown.values()]:
            return None
        marks = []
        for mark in now:
            shown, own = self._shown.get(mark.key, (None, mark))
            marks.append(own if mark == shown else self._carried(mark, nodes, reference))
        return tuple(marks)

    def _carried(self, mark: Mark, before: FloatArray, after: FloatArray) -> Mark:
        """Carry a mark from the nodes `before` to those `after`; outside the mesh or without data it stays."""
        found = None if before is after else element_at(before, self._elements, mark.x, mark.y)
        if found is None:
            return mark
        x, y = found[1] @ after[found[0]]
        return replace(mark, x=float(x), y=float(y)) if np.isfinite(x + y) else mark
