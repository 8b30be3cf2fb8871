"""Page of a result: a field over the image, frame by frame, with the curves of the probes that are marked on it."""

from __future__ import annotations

import html
import io
import time
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, Tap

from rgbmidic.errors import RgbmidicError
from rgbmidic.results import Result
from rgbmidic.results.histories import history_csv
from rgbmidic.settings import ChannelSettings, ProbeSettings
from rgbmidic.text import format_with_std
from rgbmidic.tools.report.style import data_url
from rgbmidic.tools.view.canvas import Canvas
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.controls import BACKGROUNDS, CONTROLS, ResultControls
from rgbmidic.tools.view.curves import CurvePanel
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.line_panel import LinePanel
from rgbmidic.tools.view.map_panel import MapPanel
from rgbmidic.tools.view.marks import SCALE, Mark, UndoHistory
from rgbmidic.tools.view.panels import FileButtons, MovieButton, ProbeNames
from rgbmidic.tools.view.time_line import FrameProgress, TimeLine
from rgbmidic.tools.view.url_state import EXTRA_FIELDS, UNCERTAINTY, ViewState
from rgbmidic.tools.view.widgets import SharedState, call_periodically, run_guarded, script, warning

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

    def __init__(self, document: Document, result: Result, view: ViewState, progress: FrameProgress) -> None:
        self.document, self.progress = document, progress
        self.fields = FieldsInView(result, view.with_channels(result.section(ChannelSettings)))
        self.fields.view = view = self.fields.view.with_probes(result.section(ProbeSettings), self.fields.gauge)
        self._has_view = False
        self._pointer: tuple[float, float] | None = None
        self._grown = 0
        self.state, dark = (
            SharedState(name="state", requested_frame=view.frame, displayed_frame=view.frame),
            view.theme == "dark",
        )
        self.steps = UndoHistory(view.marks)
        self.controls = controls = ResultControls(len(result) - 1, view.frame, dark=dark)
        self.maps = MapPanel(document, self.fields, self._redraw, self._hover, dark=dark)
        self.names, self.film = ProbeNames(controls, self.fields, self._take_marks), MovieButton(controls, self.fields)
        self.file, self.timeline = FileButtons(controls, self.fields), TimeLine(len(result), view.frame)
        self.curves = CurvePanel(document, self.fields, controls)
        self.line = LinePanel(document, self.fields, self.maps.canvas.colours, controls.wide)
        panels = [self.line.choice, self.curves.plot, *self.line.models]
        self.panel = bk.Column(children=panels, sizing_mode="stretch_both")
        self._initialise_controls()
        controls.wire(self.state, self.maps.canvas.tools, self.timeline.frame_mark)
        self._listen()

    @property
    def view(self) -> ViewState:
        """The present view."""
        return self.fields.view

    @property
    def result(self) -> Result:
        """The result with the frames that there are."""
        return self.fields.result

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        controls = self.controls
        plots = {"maps": self.maps.column, "timeline": self.timeline.plot, "curves": self.panel}
        return {
            "head": controls.head,
            "under": controls.pointer_label,
            "side": controls.side,
            "player": controls.player,
            **plots,
        }

    def _initialise_controls(self) -> None:
        """Set the controls to the view, and let them change it."""
        controls, view = self.controls, self.view
        self._offer_fields()
        self.curves.offer_choices()
        self.names.offer_probes()
        controls["since"].high = len(self.result) - 1
        controls["over"].active = BACKGROUNDS.index(view.over)
        self._draw_progress()
        for entry in (entry.name for entry in fields(view) if entry.name in CONTROLS and entry.name != "over"):
            key = "active" if isinstance(controls[entry], bk.Checkbox) else "value"
            controls[entry].update(**{key: getattr(view, entry)})
            controls[entry].on_change(key, partial(self._set, entry))
        for model, key, change in (
            (self.state, "requested_frame", lambda frame: {"frame": min(frame, len(self.result) - 1)}),
            (controls["over"], "active", lambda index: {"over": BACKGROUNDS[index]}),
        ):
            model.on_change(key, lambda attr, old, new, change=change: self.update_view(**change(new)))

    def _offer_fields(self) -> None:
        """Offer the fields, in the units that they have."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for field in self.fields.maps.quantities.values():
            groups.setdefault(field.group, []).append((field.name, field.label))
        controls = self.controls
        controls["field"].options = groups
        for name in EXTRA_FIELDS:
            controls[name].options = {"": [("", "nothing"), (UNCERTAINTY, "its uncertainty")], **groups}

    def _set(self, entry: str, attribute: str, old: Any, new: Any) -> None:
        """Take the value of a control into the view; a range by hand starts from that in view."""
        low, high = (self.controls[name] for name in ("low", "high"))
        if new is None:  # a number that was deleted
            return
        if entry == "range" and new == "hand":
            mapper = self.maps.canvas.colours
            self.fields.view = replace(self.view, range="hand")
            low.value, high.value = float(mapper.low), float(mapper.high)
        if entry in ("low", "high", "range") and self.controls["range"].value == "hand":
            is_range = None not in (low.value, high.value) and low.value < high.value
            self.update_view(range="hand", **({"low": low.value, "high": high.value} if is_range else {}))
        else:
            self.update_view(**{entry: new})

    def _listen(self) -> None:
        controls = self.controls
        self.maps.canvas.marks.on_change("data", lambda attr, old, new: self._receive_marks())
        for button, action in (
            (controls["write"], self.file.write), (controls["csv"], self._save),
            (controls["load_probes"], lambda: self._take_marks(self.file.read_probes())),
            (controls["lock"], lambda: controls["range"].update(value="hand")),
            (controls["clear"], lambda: self._take_marks(())),
            (controls["undo"], lambda: self.update_view(marks=self.steps.step(back=True))),
            (controls["redo"], lambda: self.update_view(marks=self.steps.step(back=False))),
        ):  # fmt: skip
            button.on_click(
                partial(run_guarded, action, lambda text: controls["save_status"].update(text=warning(text)))
            )
        for button, action in ((controls["print"], self._print_maps), (controls["png"], self._print_curves)):
            button.on_click(partial(run_guarded, action, self.report_error))
        controls["drag"].js_on_change("active", script("hold", toggle=controls["drag"], pan=self.curves.pan))
        controls.movie.on_change("active", lambda attr, old, new: run_guarded(self.film.press, self.film.stop))
        self.line.choice.on_change("active", lambda attr, old, new: self._choose_line(self.line.names[new]))
        for plot in (self.timeline.plot, self.curves.plot, self.line.wave):
            plot.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._start())

    def _start(self) -> None:
        self.maps.canvas.resize()
        self.update_view()
        call_periodically(
            VIEWER.progress_ms, self.document, lambda: self.progress.advance(self.result), self.report_error
        )
        call_periodically(VIEWER.ahead_ms, self.document, self.fields.read_ahead, self.report_error)
        for action in (self._grow, self._draw_progress, self.film.poll):
            call_periodically(VIEWER.idle_ms, self.document, action, self.report_error)

    def report_error(self, text: str) -> None:
        """Report an error; the page goes on."""
        self.controls.description.text = warning(text)
        self.state.displayed_frame = self.state.requested_frame

    def update_view(self, **changes: Any) -> None:
        """Draw the page with other values of some entries of the view."""
        self.fields.view = replace(self.view, **changes)
        self.document.hold("combine")
        try:
            run_guarded(self._draw, self._blank)
            self.curves.update(self.maps.marks.colours)
            self.names.offer_probes()
        finally:
            self.document.unhold()

    def _blank(self, text: str) -> None:
        """Show an error and nothing of the view that cannot be drawn, nor of the one before it."""
        self._has_view = False
        self.maps.clear()
        self._read_out()
        self.line.show_profile(None)
        self.state.query = self.view.query()
        self.report_error(text)

    def _draw(self) -> None:
        view, fields, controls = self.view, self.fields, self.controls
        self._choose()
        field, values = fields.maps.quantities[view.field], fields.values(view.field)
        picture, remark = fields.picture
        self._has_view = True
        if view.range == "hand" and (controls["low"].value, controls["high"].value) != (view.low, view.high):
            remark = f"The colours go from {view.low:g} to {view.high:g}: the lowest number must be below the highest."
        controls["longer"].title = self.maps.draw(picture)
        controls["low"].visible = controls["high"].visible = view.range == "hand"
        controls["symmetric"].visible = field.is_signed and view.range != "hand"
        self.controls.description.text = fields.description(remark)
        self._read_out()
        self.curves.plot.visible = not self.line.update(values)
        self.state.query, self.state.displayed_frame = view.query(), self.state.requested_frame

    def _choose(self) -> None:
        """Derive fields as the view has it."""
        try:
            if self.fields.rescale():
                self._offer_fields()
            scale, scale_text = self.fields.scale, ""
            if scale and not self.view.camera and scale.mm_per_pixel is not None:
                scale_text = format_with_std(scale.mm_per_pixel, scale.mm_per_pixel_std, "mm/px")
            self.controls["scale_label"].text = scale_text
        except RgbmidicError as error:
            self.controls["scale_label"].text = warning(str(error))
        self.fields.derive_fields()

    def _redraw(self) -> None:
        """Draw another part of the image."""
        edges = self.maps.canvas.requested_edges
        self.update_view(window=() if edges == Canvas.edges_around(self.result.nodes) else edges)

    def _hover(self, event: Any) -> None:
        if event.x is not None and event.y is not None:
            self._pointer = event.x, event.y
            self._read_out()

    def _read_out(self) -> None:
        """Show the value under the pointer, of the field and the frame in view."""
        text = self.fields.pointer_text(*self._pointer) if self._has_view and self._pointer is not None else ""
        self.controls.pointer_label.text = text

    def _receive_marks(self) -> None:
        """Take marks that were set, moved or removed."""
        if not self._has_view:
            return
        marks = self.maps.marks.read_marks(self.fields.nodes, self.result.nodes)
        if marks is not None:
            scale_marks = [mark for mark in marks if mark.kind == SCALE]  # a third place begins another one
            dropped = scale_marks[:2] if len(scale_marks) > 2 else []
            self._take_marks(tuple(mark for mark in marks if mark not in dropped))

    def _take_marks(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step that can be undone."""
        self.steps.record(marks)
        self.update_view(marks=marks)

    def _choose_line(self, name: str) -> None:
        if name != self.view.line:
            self.update_view(line=name)

    def _save(self) -> None:
        if self.curves.reading:
            self.controls.message.text = "The curves are still being read: save them once they are drawn."
        elif self.curves.histories is None or not self.curves.histories.quantities:
            self.controls.message.text = "There is no curve yet: set a mark on the field first."
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
            self.controls.message.text = "There is no curve yet, or its frames are still being read."
            return
        source = data_url(figure, dpi=round(VIEWER.print_columns / figure.get_figwidth()))
        self.state.png = f"{source} {name}.png"

    def _jump(self, event: Any) -> None:
        """Go to the frame that was clicked in the time line or among the curves."""
        if event.x is None:
            return
        clocks = {self.curves.plot: self.curves.frame_at, self.line.wave: self.line.frame_at}
        frame = clocks[event.model](event.x) if event.model in clocks else event.x
        self.controls.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    def _draw_progress(self) -> None:
        self.timeline.draw(self.progress)
        summary = self.progress.summary(int(self.result.finished.sum()))
        self.controls.head.text = f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {summary}"

    def _grow(self) -> None:
        """Take in frames that a run has added or measured again; a view of the last frame follows it."""
        grown = (self.result.path / "solution").stat().st_mtime_ns
        if grown == self._grown and time.time_ns() > grown + VIEWER.settled_ns:
            return
        self._grown, refreshed = grown, self.result.refresh()
        if np.array_equal(refreshed.table.write_times, self.result.table.write_times):
            return
        finished_before, finished_after = np.flatnonzero(self.result.finished), np.flatnonzero(refreshed.finished)
        self.fields.grow(refreshed)
        follows_last = not len(finished_before) or self.view.frame == finished_before[-1]
        if follows_last and self.controls.frame.value != finished_after[-1]:
            self.controls.frame.value = int(finished_after[-1])
        else:
            self.update_view()
