"""The page of a result: a field over the image, frame after frame, with curves of what is marked on it."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial, wraps
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, MouseMove, Tap
from bokeh.layouts import column, row
from bokeh.models import ColumnDataSource, Span

from rgbmidic.errors import RgbmidicError
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, Look, Mark
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.course import DAMAGED, Course
from rgbmidic.view.curve_panel import CurvePanel
from rgbmidic.view.curves import as_csv
from rgbmidic.view.fields import Fields, Values, robust_range
from rgbmidic.view.frames import Pictures
from rgbmidic.view.models import Asked, controls, course_plot, wire
from rgbmidic.view.picture import element_at, paint, palette, palette_name

__all__ = ["ResultPage"]

logger = logging.getLogger(__name__)

_TICK, _IDLE = 200, 1000
"""Ms between two looks at frames not yet in the time line, and at a result that may have grown."""
_FAILED = 2
_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#0072b2", "#f0e442", "#999999")
"""Okabe and Ito's colours, told apart by everyone."""
_FAULTS = {1: "#e69f00", 2: "#d1495b", DAMAGED: "#d1495b"}
_LETTERS = {
    "x_offset": 8,
    "y_offset": -4,
    "background_fill_color": "#15181c",
    "background_fill_alpha": 0.75,
    "text_font_size": "12px",
    "padding": 2,
}
_HELP = (
    "Choose <b>Point</b>, <b>Gauge</b> (two clicks), <b>Line</b> (two) or <b>Strain</b>, then click on the field: its "
    "curve appears beside it. Drag a mark to move it; Backspace removes a chosen one. Keys: ← → a frame, space plays."
)


def _told(method: Callable[..., None]) -> Callable[..., None]:
    """What goes wrong with the result is told on the page, in one line."""

    @wraps(method)
    def call(self: ResultPage, *arguments: Any, **named: Any) -> None:
        try:
            method(self, *arguments, **named)
        except RgbmidicError as error:
            self.complain(str(error))
        except Exception as error:  # the last resort of a page: it goes on, and says what happened
            logger.exception("the page failed")
            self.complain(f"{type(error).__name__}: {error}")

    return call


class ResultPage:
    """One opened page, which changes what it shows as its visitor asks.

    Parameters
    ----------
    document
        Of the visitor.
    result
        As it was when the page was opened.
    look
        What the address asks for.
    """

    def __init__(self, document: Document, result: Result, look: Look) -> None:
        self.document, self.result, self.look = document, result, look
        self.fields, self.pictures, self.course = Fields.of(result), Pictures(result=result), Course(len(result))
        self.values: Values | None = None
        self._shown, self._key = dict[Mark, Mark](), ("", -1, False)
        self._test_range = lru_cache(8)(lambda name, count: self.fields.range_of_test(name))
        self.asked, self.dark = Asked(name="state", asked=look.frame, shown=look.frame), look.theme == "dark"
        self.parts = p = controls(len(result), dark=self.dark)
        edges = look.window or Canvas.around(result.nodes)
        self.canvas = Canvas(document, list(KINDS), edges, self._redraw)
        self._joined = ColumnDataSource({name: [] for name in ("xs", "ys", "colour", "x", "y", "text")})
        self.canvas.plot.multi_line("xs", "ys", source=self._joined, line_color="colour", line_width=3)
        self.canvas.plot.text("x", "y", "text", source=self._joined, text_color="colour", **_LETTERS)
        self.strip, self._shares, self._faults = course_plot(len(result))
        self._now = Span(dimension="height", line_color="#d1495b", line_width=1.5)
        self.strip.add_layout(self._now)
        self.curves = CurvePanel(document, chosen=look.curve, select=p.curve, told=p.told, hint=_HELP)
        self._begin()
        wire(self.asked, self.parts, self.canvas.tools)
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p = self.parts
        side = column(
            p.words, p.field, p.over, p.opacity, p.range, row(p.low, p.high), p.symmetric,
            p.mode, p.curve, row(p.clear, p.csv), p.told, p.theme, sizing_mode="stretch_width",
        )  # fmt: skip
        player = row(p.play, p.step, p.frame, sizing_mode="stretch_width")
        drawn = {"plot": self.canvas.plot, "course": self.strip, "curves": self.curves.plot}
        return {"head": p.head, "under": p.under, "side": side, "player": player, **drawn}

    def _begin(self) -> None:
        """Let the controls show what the address asks for."""
        p, look = self.parts, self.look
        p.field.options = [(name, field.label) for name, field in self.fields.all.items()]
        p.field.value, p.opacity.value, p.range.value = look.field, look.opacity, look.range
        p.over.active = ("reference", "deformed").index(look.over)
        p.low.value, p.high.value, p.symmetric.active = look.low, look.high, look.symmetric
        p.frame.value = look.frame
        p.told.text, p.head.text = _HELP, self._title()

    def _listen(self) -> None:
        p, plot = self.parts, self.canvas
        self.asked.on_change(
            "asked", lambda attr, old, new: self.show(frame=min(self.asked.asked, len(self.result) - 1))
        )
        for name, control in (("field", p.field), ("range", p.range)):
            control.on_change("value", partial(self._chosen, name))
        p.curve.on_change("value", self._curve_chosen)
        p.opacity.on_change("value", partial(self._chosen, "opacity"))
        p.symmetric.on_change("active", partial(self._chosen, "symmetric"))
        p.over.on_change("active", lambda attr, old, new: self.show(over=("reference", "deformed")[p.over.active]))
        for spinner in (p.low, p.high):
            spinner.on_change("value", lambda attr, old, new: self._by_hand())
        plot.marks.on_change("data", lambda attr, old, new: self._marked())
        p.clear.on_click(lambda: plot.place([]))
        p.csv.on_click(lambda: self._save())
        plot.plot.on_event(MouseMove, self._hover)
        for strip in (self.strip, self.curves.plot):
            strip.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())
        self.document.add_periodic_callback(self._tick, _TICK)
        self.document.add_periodic_callback(self._grow, _IDLE)

    def _ready(self) -> None:
        self.canvas.resize()
        self.show()
        if self.look.marks:
            self._read_curves()

    def complain(self, text: str) -> None:
        """Tell what went wrong; the page goes on."""
        self.parts.words.text = f'<b style="color:var(--warn)">{html.escape(text)}</b>'
        self.asked.shown = self.asked.asked

    def _chosen(self, name: str, attr: str, old: object, new: Any) -> None:
        self.show(**{name: new})

    def _curve_chosen(self, attr: str, old: object, new: str) -> None:
        self.look = replace(self.look, curve=new)
        self.asked.query = self.look.query()

    def _by_hand(self) -> None:
        low, high = self.parts.low.value, self.parts.high.value
        if self.look.range == "hand" and low is not None and high is not None and low < high:
            self.show(low=float(low), high=float(high))

    @_told
    def show(self, **changes: Any) -> None:
        """Draw the page with what changed."""
        self.look = replace(self.look, **changes)
        self.document.hold("combine")
        try:
            self._draw()
        finally:
            self.document.unhold()

    def _draw(self) -> None:
        look, field = self.look, self.fields.all[self.look.field]
        values = self.values = self._read()
        picture, remark = self.pictures.frame(look.frame) if look.over == "deformed" else (self.pictures.reference, "")
        low, high = self._ends(values)
        colours = palette(palette_name(field.kind, symmetric=self._symmetric))
        image = paint(
            self.canvas.window,
            picture,
            (self._nodes(), self.result.elements, values.values),
            (low, high),
            colours,
            opacity=look.opacity,
            stepped=field.stepped,
            around=30 if self.dark else 235,
        )
        self.canvas.show(image)
        self.canvas.colour((low, high), colours, field.label)
        self.parts.low.visible = self.parts.high.visible = look.range == "hand"
        self.parts.symmetric.visible = field.signed and look.range != "hand"
        self.parts.words.text = self._words(values, remark)
        self._place_marks()
        self._now.location = look.frame
        self.curves.point(look.frame)
        self.asked.query, self.asked.shown = look.query(), self.asked.asked

    def _redraw(self) -> None:
        """Another part of the image is in view."""
        wanted = self.canvas.wanted
        self.show(window=() if wanted == Canvas.around(self.result.nodes) else wanted)

    def _read(self) -> Values:
        """The field in the frame; read anew where another one is asked for, or the frame was measured since."""
        key = (self.look.field, self.look.frame, bool(self.result.finished[self.look.frame]))
        if self.values is None or key != self._key:
            read = self.fields.read(self.look.field, self.look.frame)
            self._key = key
            return read
        return self.values

    @property
    def _symmetric(self) -> bool:
        return self.look.symmetric and self.fields.all[self.look.field].signed

    def _ends(self, values: Values) -> tuple[float, float]:
        """Values of the first and last colour."""
        look, field = self.look, self.fields.all[self.look.field]
        fixed = {"codes": (-0.5, len(field.codes) - 0.5), "share": (0.0, 1.0), "angle": (-90.0, 90.0)}
        if look.range == "hand":
            return look.low, look.high
        if field.kind in fixed:
            return fixed[field.kind]
        if look.range == "test":
            low, high = self._test_range(look.field, int(self.result.finished.sum()))
        else:
            low, high = robust_range(values) or (0.0, 1.0)
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if self._symmetric else (low, high)

    def _nodes(self) -> FloatArray:
        """Where the nodes are drawn."""
        return self.values.moved if self.look.over == "deformed" and self.values else self.result.nodes

    def _words(self, values: Values, remark: str) -> str:
        """What is shown, in words."""
        look, field = self.look, self.fields.all[self.look.field]
        head = next(self.result.table.each(["status", "reason", "iterations", "node_status", "time_ns"], [look.frame]))
        missing = float(np.mean(head["node_status"] != 0))
        end = QUANTITIES["status"].codes[head["status"]] if self.result.finished[look.frame] else "not measured yet"
        time = "" if head["time_ns"] == UNKNOWN_TIME else f", {head['time_ns'] * 1e-9:.6g} s"
        lost = f", {missing:.1%} of the nodes not measured" if missing and head["status"] != _FAILED else ""
        name = html.escape(self.result.names[look.frame])
        lines = [f"Frame {look.frame} of {len(self.result) - 1}: {name}{time}", f"{end}{lost}"]
        if head["reason"] and self.result.finished[look.frame]:
            lines[1] = f'<span style="color:var(--warn)">{end}: {html.escape(head["reason"])}</span>'
        if not np.isfinite(values.values).any():
            lines.append("Nothing is measured here: choose another frame below.")
        lines.append(f"<b>{html.escape(field.label)}</b>: {html.escape(field.meaning.partition(':')[0])}")
        return "<br>".join([*lines, *([html.escape(remark)] if remark else [])])

    def _hover(self, event: Any) -> None:
        """The value under the pointer."""
        if self.values is None or event.x is None or event.y is None:
            return
        found = element_at(self._nodes(), self.result.elements, event.x, event.y)
        text = f"x {event.x:.1f}, y {event.y:.1f} px: "
        if found is None:
            text += "outside the mesh"
        else:
            nodes, weights = found
            field = self.fields.all[self.look.field]
            weights = np.eye(3)[weights.argmax()] if field.stepped else weights
            value, std = (float(weights @ part[nodes]) for part in (self.values.values, self.values.std))
            text += f"<b>{html.escape(field.name)} = {html.escape(field.text(value, std))}</b>"
        self.parts.under.text = text

    def _place_marks(self) -> None:
        """Draw marks where their material is, and join those that belong together."""
        nodes = self._nodes()
        at = [self._carried(mark, self.result.nodes, nodes) for mark in self.look.marks]
        self._shown = dict(zip(at, self.look.marks, strict=True))
        self.canvas.place(at)
        joined = [
            (kind, number, [m for m in at if m.kind == kind][number * count : (number + 1) * count])
            for kind, count in KINDS.items()
            for number in range(sum(m.kind == kind for m in at) // count)
        ]
        colours = [_COLOURS[place % len(_COLOURS)] for place in range(len(joined))]
        self.curves.colours = {
            f"{kind}_{number + 1}": colour for (kind, number, _), colour in zip(joined, colours, strict=True)
        }
        self._joined.data = {
            "xs": [[m.x for m in own] for *_, own in joined],
            "ys": [[m.y for m in own] for *_, own in joined],
            "colour": colours,
            "x": [own[0].x for *_, own in joined],
            "y": [own[0].y for *_, own in joined],
            "text": [name.replace("_", " ") for name in self.curves.colours],
        }

    def _carried(self, mark: Mark, before: FloatArray, after: FloatArray) -> Mark:
        """A mark where its place in the mesh `before` is in the mesh `after`; as it is where that is nowhere."""
        found = None if before is after else element_at(before, self.result.elements, mark.x, mark.y)
        if found is None:
            return mark
        x, y = found[1] @ after[found[0]]
        return Mark(mark.kind, float(x), float(y)) if np.isfinite(x + y) else mark

    @_told
    def _marked(self) -> None:
        """Marks were set, moved or removed: where they are on the reference, and what they read off."""
        now = self.canvas.set
        if now == list(self._shown):
            return
        nodes = self._nodes()
        marks = tuple(self._shown.get(m) or self._carried(m, nodes, self.result.nodes) for m in now)
        self.show(marks=marks)
        self._read_curves()

    def _read_curves(self) -> None:
        gauge = shortest_gauge(self.fields.physical.mesh)
        self.curves.read(self.result, self.look.marks, gauge, lambda: self.curves.point(self.look.frame))

    def _save(self) -> None:
        if self.curves.histories is None:
            self.parts.told.text = "There is no curve yet: set a mark on the field first."
        else:
            self.asked.csv = as_csv(self.curves.histories)

    def _jump(self, event: Any) -> None:
        """To the frame that was clicked in the time line or among the curves."""
        frame = self.curves.frame(event.x) if event.model is self.curves.plot else event.x
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    @_told
    def _tick(self) -> None:
        """Look at some frames more for the time line."""
        if self.course.advance(self.result):
            known = np.flatnonzero(np.isfinite(self.course.share))
            self._shares.data = {"x": known, "y": 100 * self.course.share[known]}
            bad = [(frame, code) for code in _FAULTS for frame in np.flatnonzero(self.course.status == code).tolist()]
            self._faults.data = {
                "x": [frame for frame, _ in bad],
                "y": [100.0] * len(bad),
                "colour": [_FAULTS[code] for _, code in bad],
            }
            self.parts.head.text = self._title()

    def _title(self) -> str:
        return f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {self.course.words()}"

    @_told
    def _grow(self) -> None:
        """Take in what a run has added; who looks at the last frame goes on with it."""
        if self.result.finished.all():
            return
        new = self.result.refresh()
        before, after = np.flatnonzero(self.result.finished), np.flatnonzero(new.finished)
        if len(after) == len(before):
            return
        self.result, self.fields = new, replace(self.fields, result=new)
        self._read_curves()
        if not len(before) or self.look.frame == before[-1]:
            self.parts.frame.value = int(after[-1])
        else:
            self.show()
