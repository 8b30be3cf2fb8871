"""The page of a result: a field over the image, frame after frame, with curves of what is marked on it."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial, wraps
from typing import Any

import numpy as np
from bokeh.core.property.descriptors import UnsetValueError
from bokeh.document import Document
from bokeh.events import DocumentReady, MouseMove, RangesUpdate, Tap
from bokeh.layouts import column, row

from rgbmidic.errors import RgbmidicError
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import QUANTITIES, UNKNOWN_TIME, Histories, Result
from rgbmidic.typing import FloatArray
from rgbmidic.view import curves
from rgbmidic.view.address import KINDS, Look, Mark
from rgbmidic.view.course import Course
from rgbmidic.view.fields import Fields, Values, robust_range
from rgbmidic.view.frames import Pictures
from rgbmidic.view.models import Asked, controls, plots, wire
from rgbmidic.view.picture import Window, element_at, paint, palette, palette_name

__all__ = ["ResultPage"]

logger = logging.getLogger(__name__)

_TICK, _IDLE = 200, 1000
"""Ms between two looks at frames not yet in the time line, and at a result that may have grown."""
_MARGIN = 0.06
_SOON = 40
"""Ms that a view which moves waits for its next move."""
_FAILED = 2
_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#0072b2", "#f0e442", "#999999")
"""Okabe and Ito's colours, told apart by everyone."""
_FAULTS = {1: "#e69f00", 2: "#d1495b"}
_HELP = (
    "Click into <b>Point</b>, <b>Gauge</b> (two clicks), <b>Line</b> (two) or <b>Strain</b>, then on the field: its curve "
    "appears below. Drag a mark to move it; Backspace removes a chosen one. Keys: ← → a frame, space plays."
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
        self.window = self._whole()
        self.values: Values | None = None
        self.histories: Histories | None = None
        self._shown, self._colour, self._key = dict[Mark, Mark](), dict[str, str](), ("", -1, False)
        self.asked, self.dark = Asked(name="state", asked=look.frame, shown=look.frame), look.theme == "dark"
        self.parts, self.plots = controls(len(result), dark=self.dark), plots(len(result))
        self._reader, self._reading, self._redraws = ThreadPoolExecutor(1), 0, False
        self._test_range = lru_cache(8)(lambda name, count: self.fields.range_of_test(name))
        self._begin()
        wire(self.asked, self.parts, self.plots)
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p = self.parts
        side = column(
            p.words, p.field, p.over, p.opacity, p.range, row(p.low, p.high), p.symmetric,
            p.under, p.mode, p.curve, row(p.clear, p.csv), p.told, p.theme, sizing_mode="stretch_width",
        )  # fmt: skip
        player = row(p.play, p.step, p.frame, sizing_mode="stretch_width")
        drawn = {"plot": self.plots.field, "course": self.plots.course, "curves": self.plots.curves}
        return {"head": p.head, "side": side, "player": player, **drawn}

    def _whole(self) -> Window:
        """All of the mesh, with a margin."""
        low, high = self.result.nodes.min(axis=0), self.result.nodes.max(axis=0)
        margin = _MARGIN * float((high - low).max())
        edges = self.look.window or (*(low - margin).tolist(), *(high + margin).tolist())
        return Window(left=edges[0], top=edges[1], right=edges[2], bottom=edges[3], width=800, height=600)

    def _begin(self) -> None:
        """Let the controls show what the address asks for."""
        p, look = self.parts, self.look
        p.field.options = [(name, field.label) for name, field in self.fields.all.items()]
        p.field.value, p.opacity.value, p.range.value = look.field, look.opacity, look.range
        p.over.active = ("reference", "deformed").index(look.over)
        p.low.value, p.high.value, p.symmetric.active = look.low, look.high, look.symmetric
        p.frame.value = look.frame
        kinds = [[getattr(mark, name) for mark in look.marks] for name in ("x", "y", "kind")]
        self.plots.marks.data = dict(zip(("x", "y", "kind"), kinds, strict=True))
        p.told.text, p.head.text = _HELP, self._title()
        self._set_ranges()

    def _listen(self) -> None:
        p, plot = self.parts, self.plots
        self.asked.on_change("asked", lambda attr, old, new: self.show(frame=self.asked.asked))
        for name, control in (("field", p.field), ("range", p.range)):
            control.on_change("value", partial(self._chosen, name))
        p.curve.on_change("value", self._curve_chosen)
        p.opacity.on_change("value", partial(self._chosen, "opacity"))
        p.symmetric.on_change("active", partial(self._chosen, "symmetric"))
        p.over.on_change("active", lambda attr, old, new: self.show(over=("reference", "deformed")[p.over.active]))
        for spinner in (p.low, p.high):
            spinner.on_change("value", lambda attr, old, new: self._by_hand())
        plot.marks.on_change("data", lambda attr, old, new: self._marked())
        p.clear.on_click(lambda: plot.marks.update(data={"x": [], "y": [], "kind": []}))
        p.csv.on_click(lambda: self._save())
        plot.field.on_event(RangesUpdate, self._moved)
        plot.field.on_event(MouseMove, self._hover)
        for name in ("inner_width", "inner_height"):
            plot.field.on_change(name, lambda attr, old, new: self._resized())
        for strip in (plot.course, plot.curves):
            strip.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())
        self.document.add_periodic_callback(self._tick, _TICK)
        self.document.add_periodic_callback(self._grow, _IDLE)
        self.document.on_session_destroyed(lambda context: self._reader.shutdown(wait=False, cancel_futures=True))

    def _ready(self) -> None:
        self._resized()
        self._marked()

    def complain(self, text: str) -> None:
        """Tell what went wrong; the page goes on."""
        self.parts.words.text = f'<b style="color:var(--warn)">{html.escape(text)}</b>'
        self.asked.shown = self.asked.asked

    def _chosen(self, name: str, attr: str, old: object, new: Any) -> None:
        self.show(**{name: new})

    def _curve_chosen(self, attr: str, old: object, new: str) -> None:
        self.look = replace(self.look, curve=new)
        self.asked.query = self.look.query()
        self._draw_curves(self.histories)

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
            self.window,
            picture,
            (self._nodes(), self.result.elements, values.values),
            (low, high),
            colours,
            opacity=look.opacity,
            stepped=field.stepped,
            around=30 if self.dark else 235,
        )
        w, plots = self.window, self.plots
        self.parts.low.visible = self.parts.high.visible = look.range == "hand"
        self.parts.symmetric.visible = field.signed and look.range != "hand"
        place = {"x": [w.left], "y": [w.top], "dw": [w.right - w.left], "dh": [w.bottom - w.top]}
        plots.image.data = {"image": [image], **place}
        plots.colours.update(low=low, high=high)
        if plots.colours.palette != list(colours):  # which takes as long to check as a frame to paint
            plots.colours.palette = list(colours)
        plots.field.title.text = field.label
        self.parts.words.text = self._words(remark)
        self._place_marks()
        plots.now[0].location = look.frame
        plots.now[1].location = self._time(look.frame)
        self.asked.query, self.asked.shown = self.look.query(), look.frame

    def _read(self) -> Values:
        """The field in the frame; read anew where another one is asked for, or the frame was measured since."""
        key = (self.look.field, self.look.frame, bool(self.result.finished[self.look.frame]))
        if self.values is None or key != self._key:
            self._key = key
            return self.fields.read(self.look.field, self.look.frame)
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

    def _words(self, remark: str) -> str:
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

    def _set_ranges(self) -> None:
        w, plot = self.window, self.plots.field
        plot.x_range.update(start=w.left, end=w.right)
        plot.y_range.update(start=w.bottom, end=w.top)

    def _resized(self) -> None:
        try:
            width, height = self.plots.field.inner_width, self.plots.field.inner_height
        except UnsetValueError:  # the browser has not told yet
            return
        if min(width, height) > 1 and (width, height) != (self.window.width, self.window.height):
            self._set_window(replace(self.window, width=width, height=height))

    def _moved(self, event: Any) -> None:
        """Another part of the image is in view."""
        (left, right), (top, bottom) = sorted((event.x0, event.x1)), sorted((event.y0, event.y1))
        new = replace(self.window, left=left, top=top, right=right, bottom=bottom)
        if not np.allclose(new.edges, self.window.edges, rtol=0, atol=1e-6 * (right - left)):
            self.look = replace(self.look, window=new.edges)
            self._set_window(new)

    def _set_window(self, window: Window) -> None:
        """Show another window, once for all that comes within a few ms."""
        self.window = window.fitted()
        if not np.allclose(self.window.edges, window.edges):
            self._set_ranges()
        if not self._redraws:
            self._redraws = True
            self.document.add_timeout_callback(self._redraw, _SOON)

    def _redraw(self) -> None:
        self._redraws = False
        self.show()

    def _place_marks(self) -> None:
        """Draw marks where their material is, and join those that belong together."""
        nodes = self._nodes()
        at = [self._carried(mark, self.result.nodes, nodes) for mark in self.look.marks]
        data = {"x": [m.x for m in at], "y": [m.y for m in at], "kind": [m.kind for m in at]}
        self._shown = dict(zip(at, self.look.marks, strict=True))
        if data != {name: list(values) for name, values in self.plots.marks.data.items()}:
            self.plots.marks.data = data
        joined = [
            (kind, number, [m for m in at if m.kind == kind][number * count : (number + 1) * count])
            for kind, count in KINDS.items()
            for number in range(sum(m.kind == kind for m in at) // count)
        ]
        colours = [_COLOURS[place % len(_COLOURS)] for place in range(len(joined))]
        self._colour = {f"{kind}_{number + 1}": colour for (kind, number, _), colour in zip(joined, colours, strict=True)}
        self.plots.joined.data = {
            "xs": [[m.x for m in own] for *_, own in joined],
            "ys": [[m.y for m in own] for *_, own in joined],
            "colour": colours,
            "x": [own[0].x for *_, own in joined],
            "y": [own[0].y for *_, own in joined],
            "text": [name.replace("_", " ") for name in self._colour],
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
        data = self.plots.marks.data
        now = [Mark(k, float(x), float(y)) for x, y, k in zip(data["x"], data["y"], data["kind"], strict=True)]
        if now == list(self._shown) and self.histories is not None:
            return
        nodes = self._nodes()
        marks = tuple(self._shown.get(m) or self._carried(m, nodes, self.result.nodes) for m in now)
        self.show(marks=marks)
        self._read_curves()

    def _read_curves(self) -> None:
        """Read the marks off all frames, beside the page; only the last request counts."""
        self._reading += 1
        if not self.look.marks:
            self._draw_curves(None)
            return
        self.parts.told.text = "reading all frames …"
        task = self._reader.submit(curves.read, self.result, self.look.marks, self._gauge)
        done = partial(self._have_read, self._reading, task)
        task.add_done_callback(lambda _: self.document.add_next_tick_callback(done))

    def _have_read(self, number: int, task: Future[Histories | None]) -> None:
        if number == self._reading:
            try:
                self._draw_curves(task.result())
            except Exception as error:  # a probe outside the region and the like: told where the probes are
                self._draw_curves(None)
                self.parts.told.text = f'<span style="color:var(--warn)">{html.escape(str(error))}</span>'

    def _draw_curves(self, histories: Histories | None) -> None:
        self.histories = histories
        groups = {} if histories is None else curves.groups(histories)
        p, plot = self.parts, self.plots
        p.curve.options = list(groups)
        if groups and p.curve.value not in groups:
            p.curve.value = next((name for name in groups if name == self.look.curve), next(iter(groups)))
        own = groups.get(p.curve.value, [])
        x, axis = (np.zeros(0), "frame") if histories is None else curves.over(histories)
        colours = [self._colour.get("_".join(told.name.split("_")[: 2 + told.name.startswith("strain_")]), "#888888") for told in own]
        bands = [(xs, ys, c) for told, c in zip(own, colours, strict=True) for xs, ys in zip(*curves.band(x, told), strict=True)]
        plot.bands.data = {name: [part[i] for part in bands] for i, name in enumerate(("xs", "ys", "colour"))}
        names = [told.name.replace("_", " ") for told in own]
        plot.lines.data = {"xs": [x] * len(own), "ys": [told.values for told in own], "colour": colours, "name": names}
        plot.curves.xaxis.axis_label, plot.curves.yaxis.axis_label = axis, p.curve.value if own else ""
        plot.curves.legend.visible = bool(own)
        remarks = [] if histories is None else histories.remarks
        p.told.text = "<br>".join(map(html.escape, remarks)) or _HELP
        plot.now[1].location = self._time(self.look.frame)

    def _time(self, frame: int) -> float | None:
        """Where a frame is on the axis of the curves."""
        if self.histories is None:
            return None
        at = int(np.searchsorted(self.histories.frames, frame))
        x = curves.over(self.histories)[0]
        return float(x[at]) if at < len(x) else None

    @property
    def _gauge(self) -> float:
        """Length of strain gauges, px: the shortest."""
        return shortest_gauge(self.fields.physical.mesh)

    def _save(self) -> None:
        if self.histories is None:
            self.parts.told.text = "There is no curve yet: set a mark on the field first."
        else:
            self.asked.csv = curves.as_csv(self.histories)

    def _jump(self, event: Any) -> None:
        """To the frame that was clicked in the time line or among the curves."""
        frame = event.x
        if event.model is self.plots.curves and self.histories is not None:
            frame = self.histories.frames[int(np.abs(curves.over(self.histories)[0] - event.x).argmin())]
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    @_told
    def _tick(self) -> None:
        """Look at some frames more for the time line."""
        if self.course.advance(self.result):
            known = np.flatnonzero(np.isfinite(self.course.share))
            self.plots.shares.data = {"x": known, "y": 100 * self.course.share[known]}
            bad = [(frame, code) for code in _FAULTS for frame in np.flatnonzero(self.course.status == code).tolist()]
            self.plots.faults.data = {
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
