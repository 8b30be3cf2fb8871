"""The page of a result: a field over the image, frame after frame, with curves of what is marked on it."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, MouseMove, Tap
from bokeh.layouts import column, row

from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, OVER, Look
from rgbmidic.view.canvas import Canvas, DirectionLayer
from rgbmidic.view.curves import Course, CurvePanel, TimeLine, as_csv, places
from rgbmidic.view.fields import (
    Fields,
    Pictures,
    Values,
    frame_words,
    guarded,
    pointed_words,
    robust_range,
    warning,
    watched,
)
from rgbmidic.view.models import Asked, MarkLayer, controls, wire
from rgbmidic.view.picture import AROUND, paint, palette, palette_name

__all__ = ["ResultPage"]

_TICK, _IDLE = 200, 1000
"""Ms between two looks at frames not yet in the time line; at a result that may have grown, and for its picture."""
_HELP = (
    "Choose <b>Point</b>, <b>Gauge</b> (two clicks), <b>Line</b> (two) or <b>Strain</b>, then click on the field: its "
    "curve appears beside it. Drag a mark to move it; Backspace removes a chosen one. Keys: ← → a frame, space plays."
)


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
    course
        Of the result; other pages may have filled it.
    """

    def __init__(self, document: Document, result: Result, look: Look, course: Course) -> None:
        self.document, self.result, self.look = document, result, look
        self.fields, self.pictures, self.course = Fields.of(result), Pictures(result=result), course
        self.values: Values | None = None
        self._pointer: tuple[float, float] | None = None
        self._key = ("", -1, -1)
        self._test_range = lru_cache(8)(lambda name, changes: self.fields.range_of_test(name))
        self._changes = self._size = 0
        self.asked, self.dark = Asked(name="state", asked=look.frame, shown=look.frame), look.theme == "dark"
        self.parts = p = controls(len(result), dark=self.dark)
        self.canvas = Canvas(document, list(KINDS), look.window or Canvas.around(result.nodes), self._redraw)
        self.directions, self.marks = DirectionLayer(self.canvas), MarkLayer(self.canvas, result.elements)
        self.timeline = TimeLine(len(result), look.frame)
        self.curves = CurvePanel(document, chosen=look.curve, select=p.curve, told=p.told, hint=_HELP)
        self._begin()
        wire(self.asked, self.parts, self.canvas.tools, self.timeline.now, self.curves.plot)
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p, wide = self.parts, partial(row, sizing_mode="stretch_width")
        side = column(
            p.words, p.field, p.over, p.opacity, p.range, wide(p.low, p.high), p.symmetric, p.directions,
            p.mode, p.curve, wide(p.clear, p.csv, p.png), p.told, p.theme, sizing_mode="stretch_width",
        )  # fmt: skip
        player = wide(p.play, p.step, p.frame)
        drawn = {"plot": self.canvas.plot, "course": self.timeline.plot, "curves": self.curves.plot}
        return {"head": p.head, "under": p.under, "side": side, "player": player, **drawn}

    def _begin(self) -> None:
        """Let the controls show what the address asks for."""
        p, look = self.parts, self.look
        p.field.options = [(name, field.label) for name, field in self.fields.all.items()]
        p.field.value, p.opacity.value, p.range.value = look.field, look.opacity, look.range
        p.over.active = OVER.index(look.over)
        p.low.value, p.high.value, p.symmetric.active = look.low, look.high, look.symmetric
        p.directions.active, p.frame.value = look.directions, look.frame
        p.told.text, p.head.text = _HELP, self._title()

    def _listen(self) -> None:
        p = self.parts
        for model, key, change in (
            (self.asked, "asked", lambda frame: {"frame": min(frame, len(self.result) - 1)}),
            (p.field, "value", lambda name: {"field": name}),
            (p.range, "value", lambda name: {"range": name}),
            (p.opacity, "value", lambda value: {"opacity": value}),
            (p.symmetric, "active", lambda active: {"symmetric": active}),
            (p.directions, "active", lambda active: {"directions": active}),
            (p.over, "active", lambda place: {"over": OVER[place]}),
            (p.curve, "value", lambda name: {"curve": name}),
            (p.low, "value", lambda low: self._by_hand()),
            (p.high, "value", lambda high: self._by_hand()),
        ):
            model.on_change(key, partial(self._changed, change))
        self.canvas.marks.on_change("data", lambda attr, old, new: self._marked())
        p.clear.on_click(lambda: self.canvas.place([]))
        p.csv.on_click(lambda: self._save())
        self.canvas.plot.on_event(MouseMove, self._hover)
        for plot in (self.timeline.plot, self.curves.plot):
            plot.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())

    def _ready(self) -> None:
        self.canvas.resize()
        self.show()
        if self.look.marks:
            self._read_curves()
        for act, every in ((self._tick, _TICK), (self._grow, _IDLE), (self._tell_course, _IDLE)):
            self.document.add_periodic_callback(partial(self._regularly, act), every)

    def _regularly(self, act: Callable[[], None]) -> None:
        """Do something, unless the browser has gone and nobody looks."""
        if watched(self.document):
            guarded(act, self.complain)

    def complain(self, text: str) -> None:
        """Tell what went wrong; the page goes on."""
        self.parts.words.text = warning(text)
        self.asked.shown = self.asked.asked

    def _changed(self, change: Callable[[Any], dict[str, Any]], attr: str, old: object, new: Any) -> None:
        self.show(**change(new))

    def _by_hand(self) -> dict[str, float]:
        low, high = self.parts.low.value, self.parts.high.value
        return {"low": float(low), "high": float(high)} if None not in (low, high) and low < high else {}

    def show(self, **changes: Any) -> None:
        """Draw the page with what changed."""
        self.look = replace(self.look, **changes)
        self.document.hold("combine")
        try:
            guarded(self._draw, self._blank)
        finally:
            self.document.unhold()

    def _blank(self, text: str) -> None:
        """Show nothing of what cannot be drawn, least of all what was drawn before it."""
        self.values, self._key = None, ("", -1, -1)
        self.canvas.clear()
        self.directions.hide()
        self._read_out()
        self.curves.point(self.look.frame)
        self.asked.query = self.look.query()
        self.complain(text)

    def _draw(self) -> None:
        look, field = self.look, self.fields.all[self.look.field]
        values = self.values = self._read()
        picture, remark = self.pictures.frame(look.frame) if look.over == "deformed" else (self.pictures.reference, "")
        ends, colours = self._ends(values), palette(palette_name(field.kind, symmetric=self._symmetric))
        if look.range == "hand" and (self.parts.low.value, self.parts.high.value) != (look.low, look.high):
            remark = f"The colours go from {look.low:g} to {look.high:g}: the lowest number must be below the highest."
        over = (self._nodes(values), self.result.elements, values.values)
        around = AROUND[self.dark]
        image = paint(
            self.canvas.window,
            picture,
            over,
            ends,
            colours,
            opacity=look.opacity,
            stepped=field.stepped,
            around=around,
        )
        self.canvas.show(image)
        self.canvas.colour(ends, colours, field.label)
        self.parts.low.visible = self.parts.high.visible = look.range == "hand"
        self.parts.symmetric.visible = field.signed and look.range != "hand"
        self.parts.words.text = frame_words(self.result, look.frame, field, values, remark)
        self.marks.place(look.marks, self.result.nodes, over[0])
        if look.directions:
            self.directions.show(over[0], self.fields.read("direction", look.frame).values)
        else:
            self.directions.hide()
        self._read_out()
        self.curves.point(look.frame)
        self.asked.query, self.asked.shown = look.query(), self.asked.asked

    def _redraw(self) -> None:
        """Another part of the image is in view."""
        wanted = self.canvas.wanted
        self.show(window=() if wanted == Canvas.around(self.result.nodes) else wanted)

    def _read(self) -> Values:
        """The field in the frame; read anew where another one is asked for, or the frame was measured since."""
        key = (self.look.field, self.look.frame, self._changes)
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
        if look.range == "hand":
            return look.low, look.high
        if field.ends is not None:
            return field.ends
        if look.range == "test":
            low, high = self._test_range(look.field, self._changes)
        else:
            low, high = robust_range(values) or (0.0, 1.0)
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if self._symmetric else (low, high)

    def _nodes(self, values: Values) -> FloatArray:
        """Where the nodes are drawn."""
        return values.moved if self.look.over == "deformed" else self.result.nodes

    def _hover(self, event: Any) -> None:
        """The pointer is at another place."""
        if event.x is not None and event.y is not None:
            self._pointer = event.x, event.y
            self._read_out()

    def _read_out(self) -> None:
        """The value where the pointer is, of the field and the frame that are shown."""
        words = ""
        if self.values is not None and self._pointer is not None:
            field, nodes = self.fields.all[self.look.field], self._nodes(self.values)
            words = pointed_words(field, self.values, nodes, self.result.elements, *self._pointer)
        self.parts.under.text = words

    def _marked(self) -> None:
        """Marks were set, moved or removed."""
        if self.values is None:
            return
        marks = self.marks.taken(self._nodes(self.values), self.result.nodes)
        if marks is not None:
            self.show(marks=marks)
            self._read_curves()

    def _read_curves(self) -> None:
        self.curves.colours = self.marks.colours
        gauge = shortest_gauge(self.fields.physical.mesh)
        self.curves.read(self.result, self.look.marks, gauge, lambda: self.curves.point(self.look.frame))

    def _save(self) -> None:
        if self.curves.reading:
            self.parts.told.text = "The curves are still being read: save them once they are drawn."
        elif self.curves.histories is None:
            self.parts.told.text = "There is no curve yet: set a mark on the field first."
        else:
            self.asked.csv = as_csv(self.curves.histories)

    def _jump(self, event: Any) -> None:
        """To the frame that was clicked in the time line or among the curves."""
        frame = self.curves.frame(event.x) if event.model is self.curves.plot else event.x
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    def _tick(self) -> None:
        """Look at some frames more for the time line."""
        self.course.advance(self.result)

    def _tell_course(self) -> None:
        self.timeline.draw(self.course)
        self.parts.head.text = self._title()

    def _title(self) -> str:
        return (
            f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {self.course.words(int(self.result.finished.sum()))}"
        )

    def _grow(self) -> None:
        """Take in what a run has added or measured again; who looks at the last frame goes on with it."""
        size = sum(file.stat().st_size for file in self.result.path.glob("solution/*"))
        if size == self._size:
            return
        self._size, new = size, self.result.refresh()
        if np.array_equal(places(new), places(self.result)):
            return
        before, after = np.flatnonzero(self.result.finished), np.flatnonzero(new.finished)
        self.result, self.fields, self._changes = new, replace(self.fields, result=new), self._changes + 1
        self._read_curves()
        follows = not len(before) or self.look.frame == before[-1]
        if follows and self.parts.frame.value != after[-1]:
            self.parts.frame.value = int(after[-1])
        else:
            self.show()
