"""Page of a result: a field over the image, frame by frame, with the curves of the probes that are marked on it."""

from __future__ import annotations

import html
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, MouseMove, Tap
from bokeh.layouts import column, row

from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import Maps, MapValues, Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, OVER, ViewState
from rgbmidic.view.canvas import Canvas, DirectionLayer
from rgbmidic.view.curves import CurvePanel, Progress, TimeLine, as_csv, places
from rgbmidic.view.fields import (
    Pictures,
    every,
    frame_text,
    guarded,
    pointer_text,
    range_of_test,
    robust_range,
    warning,
)
from rgbmidic.view.models import MarkLayer, ResultControls, SharedState
from rgbmidic.view.picture import AROUND, Overlay, paint, palette, palette_name

__all__ = ["ResultPage"]

_TICK, _IDLE = 200, 1000
"""Ms between two parts of the time line; between two checks whether a result has grown, and pictures of that."""
_HELP = (
    "Choose <b>Point</b>, <b>Gauge</b> (two clicks), <b>Line</b> (two) or <b>Strain</b>, then click on the field: its "
    "curve appears beside it. Drag a mark to move it; Backspace removes a chosen one. Keys: ← → a frame, space plays."
)


class ResultPage:
    """Page of a result that one visitor has opened.

    Parameters
    ----------
    document
        Document of the visitor.
    result
        The result when the page was opened.
    view
        View that the address asks for.
    progress
        Status of the frames, which other pages of the result may have filled.
    """

    def __init__(self, document: Document, result: Result, view: ViewState, progress: Progress) -> None:
        self.document, self.result, self.view = document, result, view
        self.fields, self.pictures, self.progress = Maps.of(result), Pictures(result=result), progress
        self.values: MapValues | None = None
        self._pointer: tuple[float, float] | None = None
        self._read = lru_cache(1)(lambda name, frame, changes: self.fields.read(name, frame))
        self._test_range = lru_cache(8)(lambda name, changes: range_of_test(self.fields, name))
        self._changes = self._size = 0
        self.state, self.dark = SharedState(name="state", asked=view.frame, shown=view.frame), view.theme == "dark"
        self.parts = p = ResultControls(len(result) - 1, view.frame, dark=self.dark)
        self.canvas = Canvas(document, list(KINDS), view.window or Canvas.around(result.nodes), self._redraw)
        self.directions, self.marks = DirectionLayer(self.canvas), MarkLayer(self.canvas, result.elements)
        self.timeline = TimeLine(len(result), view.frame)
        self.curves = CurvePanel(document, chosen=view.curve, select=p.curve, message=p.message, hint=_HELP)
        self._begin()
        p.wire(self.state, self.canvas.tools, self.timeline.now, self.curves.plot)
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p, wide = self.parts, partial(row, sizing_mode="stretch_width")
        side = column(
            p.description, p.field, p.over, p.opacity, p.range, wide(p.low, p.high), p.symmetric, p.directions,
            p.mode, p.curve, wide(p.clear, p.csv, p.png), p.message, p.theme, sizing_mode="stretch_width",
        )  # fmt: skip
        drawn = {"plot": self.canvas.plot, "timeline": self.timeline.plot, "curves": self.curves.plot}
        return {"head": p.head, "under": p.under, "side": side, "player": p.player, **drawn}

    def _begin(self) -> None:
        """Set the controls to the view, and let them change it."""
        p, view = self.parts, self.view
        p.field.options = [(name, field.label) for name, field in self.fields.all.items()]
        p.over.active = OVER.index(view.over)
        p.low.value, p.high.value = view.low, view.high
        p.message.text, p.head.text = _HELP, self._title()
        for model, key, entry in (
            (p.field, "value", "field"), (p.opacity, "value", "opacity"), (p.range, "value", "range"),
            (p.symmetric, "active", "symmetric"), (p.directions, "active", "directions"),
        ):  # fmt: skip
            model.update(**{key: getattr(view, entry)})
            model.on_change(key, lambda attr, old, new, entry=entry: self.show(**{entry: new}))
        for model, key, change in (
            (self.state, "asked", lambda frame: {"frame": min(frame, len(self.result) - 1)}),
            (p.over, "active", lambda place: {"over": OVER[place]}),
            (p.curve, "value", lambda name: {"curve": name}),
            (p.low, "value", lambda low: self._by_hand()),
            (p.high, "value", lambda high: self._by_hand()),
        ):
            model.on_change(key, lambda attr, old, new, change=change: self.show(**change(new)))

    def _listen(self) -> None:
        p = self.parts
        self.canvas.marks.on_change("data", lambda attr, old, new: self._marked())
        p.clear.on_click(lambda: self.canvas.place([]))
        p.csv.on_click(self._save)
        self.canvas.plot.on_event(MouseMove, self._hover)
        for plot in (self.timeline.plot, self.curves.plot):
            plot.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())

    def _ready(self) -> None:
        self.canvas.resize()
        self.show()
        if self.view.marks:
            self._read_curves()
        every(_TICK, self.document, lambda: self.progress.advance(self.result), self.complain)
        for act in (self._grow, self._draw_progress):
            every(_IDLE, self.document, act, self.complain)

    def complain(self, text: str) -> None:
        """Report an error; the page goes on."""
        self.parts.description.text = warning(text)
        self.state.shown = self.state.asked

    def _by_hand(self) -> dict[str, float]:
        low, high = self.parts.low.value, self.parts.high.value
        return {"low": float(low), "high": float(high)} if None not in (low, high) and low < high else {}

    def show(self, **changes: Any) -> None:
        """Draw the page with other values of some entries of the view."""
        self.view = replace(self.view, **changes)
        self.document.hold("combine")
        try:
            guarded(self._draw, self._blank)
        finally:
            self.document.unhold()

    def _blank(self, text: str) -> None:
        """Show an error and nothing of the view that cannot be drawn, nor of the one before it."""
        self.values = None
        self.canvas.clear()
        self.directions.hide()
        self._read_out()
        self.curves.point(self.view.frame)
        self.state.query = self.view.query()
        self.complain(text)

    def _draw(self) -> None:
        view, field = self.view, self.fields.all[self.view.field]
        values = self.values = self._read(view.field, view.frame, self._changes)
        picture, remark = self.pictures.frame(view.frame) if view.over == "deformed" else (self.pictures.reference, "")
        if view.range == "hand" and (self.parts.low.value, self.parts.high.value) != (view.low, view.high):
            remark = f"The colours go from {view.low:g} to {view.high:g}: the lowest number must be below the highest."
        nodes, colours = self._nodes(values), palette(palette_name(field.kind, symmetric=self._symmetric))
        over = Overlay(
            nodes=nodes,
            elements=self.result.elements,
            values=values.values,
            ends=self._ends(values),
            colours=colours,
            opacity=view.opacity,
            stepped=field.stepped,
        )
        self.canvas.show(paint(self.canvas.window, picture, over, AROUND[self.dark]))
        self.canvas.colour(over.ends, colours, field.label)
        self.parts.low.visible = self.parts.high.visible = view.range == "hand"
        self.parts.symmetric.visible = field.signed and view.range != "hand"
        self.parts.description.text = frame_text(self.result, view.frame, field, values, remark)
        self.marks.place(view.marks, self.result.nodes, nodes)
        if view.directions:
            self.directions.show(nodes, self.fields.read("direction", view.frame).values)
        else:
            self.directions.hide()
        self._read_out()
        self.curves.point(view.frame)
        self.state.query, self.state.shown = view.query(), self.state.asked

    def _redraw(self) -> None:
        """Draw another part of the image."""
        wanted = self.canvas.wanted
        self.show(window=() if wanted == Canvas.around(self.result.nodes) else wanted)

    @property
    def _symmetric(self) -> bool:
        return self.view.symmetric and self.fields.all[self.view.field].signed

    def _ends(self, values: MapValues) -> tuple[float, float]:
        """Return the values of the first and the last colour."""
        view, field = self.view, self.fields.all[self.view.field]
        if view.range == "hand":
            return view.low, view.high
        if field.ends is not None:
            return field.ends
        if view.range == "test":
            low, high = self._test_range(view.field, self._changes)
        else:
            low, high = robust_range(values) or (0.0, 1.0)
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if self._symmetric else (low, high)

    def _nodes(self, values: MapValues) -> FloatArray:
        """Return the places (N, 2) at which the nodes are drawn."""
        return values.moved if self.view.over == "deformed" else self.result.nodes

    def _hover(self, event: Any) -> None:
        if event.x is not None and event.y is not None:
            self._pointer = event.x, event.y
            self._read_out()

    def _read_out(self) -> None:
        """Show the value under the pointer, of the field and the frame in view."""
        text = ""
        if self.values is not None and self._pointer is not None:
            field, nodes = self.fields.all[self.view.field], self._nodes(self.values)
            text = pointer_text(field, self.values, nodes, self.result.elements, *self._pointer)
        self.parts.under.text = text

    def _marked(self) -> None:
        """Take marks that were set, moved or removed."""
        if self.values is None:
            return
        marks = self.marks.taken(self._nodes(self.values), self.result.nodes)
        if marks is not None:
            self.show(marks=marks)
            self._read_curves()

    def _read_curves(self) -> None:
        self.curves.colours = self.marks.colours
        gauge = shortest_gauge(self.fields.physical.mesh)
        self.curves.read(self.result, self.view.marks, gauge, lambda: self.curves.point(self.view.frame))

    def _save(self) -> None:
        if self.curves.reading:
            self.parts.message.text = "The curves are still being read: save them once they are drawn."
        elif self.curves.histories is None:
            self.parts.message.text = "There is no curve yet: set a mark on the field first."
        else:
            self.state.csv = as_csv(self.curves.histories)

    def _jump(self, event: Any) -> None:
        """Go to the frame that was clicked in the time line or among the curves."""
        frame = self.curves.frame(event.x) if event.model is self.curves.plot else event.x
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    def _draw_progress(self) -> None:
        self.timeline.draw(self.progress)
        self.parts.head.text = self._title()

    def _title(self) -> str:
        summary = self.progress.summary(int(self.result.finished.sum()))
        return f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {summary}"

    def _grow(self) -> None:
        """Take in frames that a run has added or measured again; a view of the last frame follows it."""
        size = sum(file.stat().st_size for file in self.result.path.glob("solution/*"))
        if size == self._size:
            return
        self._size, new = size, self.result.refresh()
        if np.array_equal(places(new), places(self.result)):
            return
        before, after = np.flatnonzero(self.result.finished), np.flatnonzero(new.finished)
        self.result, self.fields, self._changes = new, replace(self.fields, result=new), self._changes + 1
        self._read_curves()
        follows = not len(before) or self.view.frame == before[-1]
        if follows and self.parts.frame.value != after[-1]:
            self.parts.frame.value = int(after[-1])
        else:
            self.show()
