"""Page of a result: a field over the image, frame by frame, with the curves of the probes that are marked on it."""

from __future__ import annotations

import html
import io
import time
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, Tap

from rgbmidic.errors import RgbmidicError
from rgbmidic.report.style import embedded
from rgbmidic.results import Result
from rgbmidic.results.histories import history_csv
from rgbmidic.settings import ChannelSettings, ProbeSettings
from rgbmidic.text import format_with_std
from rgbmidic.view.address import BESIDE, OVER, SCALE, UNCERTAINTY, Mark, Steps, ViewState
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.curves import CurvePanel, Progress, TimeLine
from rgbmidic.view.line_panel import LinePanel
from rgbmidic.view.map_panel import MapPanel
from rgbmidic.view.models import ResultControls, SharedState, every, guarded, script, warning
from rgbmidic.view.picture import Canvas
from rgbmidic.view.sections import FileButtons, FilmButton, ProbeNames
from rgbmidic.view.shown import ShownFields

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
        self.document, self.progress = document, progress
        self.shown = ShownFields(result, view.with_channels(result.section(ChannelSettings)))
        self.shown.view = view = self.shown.view.with_probes(result.section(ProbeSettings), self.shown.gauge)
        self._told = False
        self._pointer: tuple[float, float] | None = None
        self._grown = 0
        self.state, dark = SharedState(name="state", asked=view.frame, shown=view.frame), view.theme == "dark"
        self.steps = Steps(view.marks)
        self.parts = p = ResultControls(len(result) - 1, view.frame, dark=dark)
        self.maps = MapPanel(document, self.shown, self._redraw, self._hover, dark=dark)
        self.names, self.film = ProbeNames(p, self.shown, self._take_marks), FilmButton(p, self.shown)
        self.file, self.timeline = FileButtons(p, self.shown), TimeLine(len(result), view.frame)
        self.curves = CurvePanel(document, self.shown, p)
        self.line = LinePanel(document, self.shown, self.maps.canvas.colours, p.wide)
        panels = [self.line.choice, self.curves.plot, *self.line.parts]
        self.panel = bk.Column(children=panels, sizing_mode="stretch_both")
        self._begin()
        p.wire(self.state, self.maps.canvas.tools, self.timeline.now)
        self._listen()

    @property
    def view(self) -> ViewState:
        """What is looked at."""
        return self.shown.view

    @property
    def result(self) -> Result:
        """The result with the frames that there are."""
        return self.shown.result

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p = self.parts
        drawn = {"maps": self.maps.column, "timeline": self.timeline.plot, "curves": self.panel}
        return {"head": p.head, "under": p.under, "side": p.side, "player": p.player, **drawn}

    def _begin(self) -> None:
        """Set the controls to the view, and let them change it."""
        p, view = self.parts, self.view
        self._offer_fields()
        self.curves.offer()
        self.names.offer()
        p.of["since"].high = len(self.result) - 1
        p.over.active = OVER.index(view.over)
        self._draw_progress()
        for entry, (kind, *_) in view.controls().items():
            key = "active" if kind is bk.Checkbox else "value"
            p.of[entry].update(**{key: getattr(view, entry)})
            p.of[entry].on_change(key, partial(self._set, entry))
        for model, key, change in (
            (self.state, "asked", lambda frame: {"frame": min(frame, len(self.result) - 1)}),
            (p.over, "active", lambda place: {"over": OVER[place]}),
            (p.curve, "value", lambda name: {"curve": name}),
        ):
            model.on_change(key, lambda attr, old, new, change=change: self.show(**change(new)))

    def _offer_fields(self) -> None:
        """Offer the fields, in the units that they have."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for field in self.shown.maps.all.values():
            groups.setdefault(field.group, []).append((field.name, field.label))
        of = self.parts.of
        of["field"].options = groups
        for name in BESIDE:
            of[name].options = {"": [("", "nothing"), (UNCERTAINTY, "its uncertainty")], **groups}

    def _set(self, entry: str, attribute: str, old: Any, new: Any) -> None:
        """Take the value of a control into the view; a range by hand starts from that in view."""
        low, high = (self.parts.of[name] for name in ("low", "high"))
        if new is None:  # a number that was deleted
            return
        if entry == "range" and new == "hand":
            mapper = self.maps.canvas.colours
            self.shown.view = replace(self.view, range="hand")
            low.value, high.value = float(mapper.low), float(mapper.high)
        if entry in ("low", "high", "range") and self.parts.of["range"].value == "hand":
            whole = None not in (low.value, high.value) and low.value < high.value
            self.show(range="hand", **({"low": low.value, "high": high.value} if whole else {}))
        else:
            self.show(**{entry: new})

    def _listen(self) -> None:
        p = self.parts
        self.maps.canvas.marks.on_change("data", lambda attr, old, new: self._marked())
        for button, act in (
            (p.write, self.file.write), (p.take, lambda: self._take_marks(self.file.probes())), (p.csv, self._save),
            (p.lock, lambda: p.of["range"].update(value="hand")), (p.clear, lambda: self._take_marks(())),
            (p.undo, lambda: self.show(marks=self.steps.go(back=True))),
            (p.redo, lambda: self.show(marks=self.steps.go(back=False))),
        ):  # fmt: skip
            button.on_click(partial(guarded, act, lambda text: p.written.update(text=warning(text))))
        for button, act in ((p.print, self._print_maps), (p.png, self._print_curves)):
            button.on_click(partial(guarded, act, self.complain))
        p.drag.js_on_change("active", script("hold", toggle=p.drag, pan=self.curves.pan))
        p.movie.on_change("active", lambda attr, old, new: guarded(self.film.press, self.film.stop))
        self.line.choice.on_change("active", lambda attr, old, new: self._choose_line(self.line.names[new]))
        for plot in (self.timeline.plot, self.curves.plot, self.line.wave):
            plot.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())

    def _ready(self) -> None:
        self.maps.canvas.resize()
        self.show()
        every(VIEWER.progress_ms, self.document, lambda: self.progress.advance(self.result), self.complain)
        every(VIEWER.ahead_ms, self.document, self.shown.read_ahead, self.complain)
        for act in (self._grow, self._draw_progress, self.film.tell):
            every(VIEWER.idle_ms, self.document, act, self.complain)

    def complain(self, text: str) -> None:
        """Report an error; the page goes on."""
        self.parts.description.text = warning(text)
        self.state.shown = self.state.asked

    def show(self, **changes: Any) -> None:
        """Draw the page with other values of some entries of the view."""
        self.shown.view = replace(self.view, **changes)
        self.document.hold("combine")
        try:
            guarded(self._draw, self._blank)
            self.curves.update(self.maps.marks.colours)
            self.names.offer()
        finally:
            self.document.unhold()

    def _blank(self, text: str) -> None:
        """Show an error and nothing of the view that cannot be drawn, nor of the one before it."""
        self._told = False
        self.maps.clear()
        self._read_out()
        self.line.show(None)
        self.state.query = self.view.query()
        self.complain(text)

    def _draw(self) -> None:
        view, shown, of = self.view, self.shown, self.parts.of
        self._choose()
        field, values = shown.maps.all[view.field], shown.values(view.field)
        picture, remark = shown.picture
        self._told = True
        if view.range == "hand" and (of["low"].value, of["high"].value) != (view.low, view.high):
            remark = f"The colours go from {view.low:g} to {view.high:g}: the lowest number must be below the highest."
        of["longer"].title = self.maps.draw(picture)
        of["low"].visible = of["high"].visible = view.range == "hand"
        of["symmetric"].visible = field.signed and view.range != "hand"
        self.parts.description.text = shown.text(remark)
        self._read_out()
        self.curves.plot.visible = not self.line.update(values)
        self.state.query, self.state.shown = view.query(), self.state.asked

    def _choose(self) -> None:
        """Derive fields as the view has it."""
        try:
            if self.shown.rescale():
                self._offer_fields()
            scale, told = self.shown.scale, ""
            if scale and not self.view.camera and scale.mm_per_pixel is not None:
                told = format_with_std(scale.mm_per_pixel, scale.mm_per_pixel_std, "mm/px")
            self.parts.scaled.text = told
        except RgbmidicError as error:
            self.parts.scaled.text = warning(str(error))
        self.shown.choose()

    def _redraw(self) -> None:
        """Draw another part of the image."""
        wanted = self.maps.canvas.wanted
        self.show(window=() if wanted == Canvas.around(self.result.nodes) else wanted)

    def _hover(self, event: Any) -> None:
        if event.x is not None and event.y is not None:
            self._pointer = event.x, event.y
            self._read_out()

    def _read_out(self) -> None:
        """Show the value under the pointer, of the field and the frame in view."""
        text = self.shown.text_at(*self._pointer) if self._told and self._pointer is not None else ""
        self.parts.under.text = text

    def _marked(self) -> None:
        """Take marks that were set, moved or removed."""
        if not self._told:
            return
        marks = self.maps.marks.taken(self.shown.nodes, self.result.nodes)
        if marks is not None:
            ends = [mark for mark in marks if mark.kind == SCALE]  # a third place begins another one
            dropped = ends[:2] if len(ends) > 2 else []
            self._take_marks(tuple(mark for mark in marks if mark not in dropped))

    def _take_marks(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step that can be undone."""
        self.steps.keep(marks)
        self.show(marks=marks)

    def _choose_line(self, name: str) -> None:
        if name != self.view.line:
            self.show(line=name)

    def _save(self) -> None:
        if self.curves.reading:
            self.parts.message.text = "The curves are still being read: save them once they are drawn."
        elif self.curves.histories is None or not self.curves.histories.quantities:
            self.parts.message.text = "There is no curve yet: set a mark on the field first."
        else:
            history_csv(self.curves.histories, file := io.BytesIO())
            self.state.csv = file.getvalue().decode("utf-8")

    def _print_maps(self) -> None:
        self._print(f"{self.view.field}_{self.view.frame:06}", self.maps.figure())

    def _print_curves(self) -> None:
        """Send the curves in view, over the time or along a line."""
        name, panel = ("profile", self.line) if self.line.wave.visible else ("history", self.curves)
        self._print(name, panel.figure())

    def _print(self, name: str, figure: Figure | None) -> None:
        """Send a picture for print, light whatever the page is, as a data URL, a space and the file name."""
        if figure is None:
            self.parts.message.text = "There is no curve yet, or its frames are still being read."
            return
        source = embedded(figure, dpi=round(VIEWER.print_columns / figure.get_figwidth()))
        self.state.png = f"{source} {name}.png"

    def _jump(self, event: Any) -> None:
        """Go to the frame that was clicked in the time line or among the curves."""
        if event.x is None:
            return
        clocks = {self.curves.plot: self.curves.frame, self.line.wave: self.line.frame}
        frame = clocks[event.model](event.x) if event.model in clocks else event.x
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    def _draw_progress(self) -> None:
        self.timeline.draw(self.progress)
        summary = self.progress.summary(int(self.result.finished.sum()))
        self.parts.head.text = f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {summary}"

    def _grow(self) -> None:
        """Take in frames that a run has added or measured again; a view of the last frame follows it."""
        grown = (self.result.path / "solution").stat().st_mtime_ns
        if grown == self._grown and time.time_ns() > grown + VIEWER.settled_ns:
            return
        self._grown, new = grown, self.result.refresh()
        if np.array_equal(new.table.written, self.result.table.written):
            return
        before, after = np.flatnonzero(self.result.finished), np.flatnonzero(new.finished)
        self.shown.grow(new)
        follows = not len(before) or self.view.frame == before[-1]
        if follows and self.parts.frame.value != after[-1]:
            self.parts.frame.value = int(after[-1])
        else:
            self.show()
