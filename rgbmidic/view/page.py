"""Page of a result: a field over the image, frame by frame, with the curves of the probes that are marked on it."""

from __future__ import annotations

import html
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady, MouseMove, Pan, PanEnd, PanStart, Tap

from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.fields import MEASURES
from rgbmidic.fields.strain import shortest_gauge
from rgbmidic.results import MapField, Maps, MapValues, Result, channels_of, probes_of
from rgbmidic.results.physical import scale_of
from rgbmidic.settings import PROBE_NAME, ProbeSettings, ScaleSettings, read_section
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import (
    BESIDE,
    MARKS,
    OVER,
    SCALE,
    UNCERTAINTY,
    Mark,
    Steps,
    ViewState,
    probe_marks,
    probe_place,
)
from rgbmidic.view.canvas import Canvas, LabelLayer, LineLayer, arrow_lines, contour_lines, direction_lines
from rgbmidic.view.curves import CurvePanel, Progress, TimeLine, as_csv, marks_of, probes
from rgbmidic.view.draft import Confirmation, Draft, channel_section, probe_section, scale_section
from rgbmidic.view.line_panel import LinePanel
from rgbmidic.view.models import CONTROLS, WRITTEN, MarkLayer, ResultControls, SharedState, script
from rgbmidic.view.picture import (
    AROUND,
    Overlay,
    Picture,
    Pictures,
    every,
    extremes,
    frame_text,
    guarded,
    paint,
    palette,
    palette_name,
    pointer_text,
    probe_text,
    range_of_test,
    robust_range,
    warning,
)
from rgbmidic.view.setup_panel import Movie

_TICK, _IDLE = 200, 1000
"""Ms between two parts of the time line; between two checks whether a result has grown, and pictures of that."""
_SETTLED = 2_000_000_000
"""Ns after which a folder that is changed has another date, whatever the disk's clock ticks in."""
_CONTOURS = 10
"""Steps between contour lines at most. Chosen; more cover the field."""
_CURVES = {entry for entry, section, *_ in CONTROLS if section == "Channels"} | {"along"}
"""Entries of the view that the curves alone depend on."""
_HELP = (
    "Choose a probe, click on the field (Gauge, Line, Box, Circle: twice). Drag marks; Backspace removes one. "
    "Keys: ← → a frame, space plays, 1 to 7 sections, Ctrl-Z undoes, Ctrl-Y redoes."
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
        self._read = lru_cache(4)(lambda name, frame, changes, chosen: self.fields.read(name, frame))
        self._moved = lru_cache(2)(lambda frame, changes, chosen: self.fields.displacement(frame))
        self._test_range = lru_cache(8)(lambda name, changes, chosen: range_of_test(self.fields, name))
        self._changes = self._grown = 0
        self._scale_read: ScaleSettings | None = None
        self._chosen: tuple[Any, ...] = ()
        self.state, self.dark = SharedState(name="state", asked=view.frame, shown=view.frame), view.theme == "dark"
        self._base = Path(result.provenance.get("base", result.path.parent))
        self.view = view = view.with_channels(channels_of(result))
        self._scale: ScaleSettings | None = None
        self.steps, self.confirmation = Steps(view.marks), Confirmation()
        self.parts = p = ResultControls(len(result) - 1, view.frame, dark=self.dark)
        self.canvas = Canvas(document, MARKS, view.window or Canvas.around(result.nodes), self._redraw)
        self.beside: list[Canvas] = []
        self.directions, self.contours = (
            LineLayer(self.canvas, "direction lines"),
            LineLayer(self.canvas, "contour lines", 0.8),
        )
        self.arrows, self.blank = LineLayer(self.canvas, "arrows"), LabelLayer(self.canvas, "blank nodes", size=5)
        self.marks, self.ends = (
            MarkLayer(self.canvas, result.elements),
            LabelLayer(self.canvas, "extreme nodes", size=9),
        )
        self.timeline = TimeLine(len(result), view.frame)
        texts: dict[str, Any] = {"message": p.message, "told": p.told, "hint": _HELP}
        self.curves = CurvePanel(document, chosen=view.curve, select=p.curve, **texts)
        self.line = LinePanel(document, self.canvas.colours, p.wide)
        panels = [self.line.choice, self.curves.plot, *self.line.parts]
        self.panel = bk.Column(children=panels, sizing_mode="stretch_both")
        self.movie: Movie | None = None
        self.maps = bk.Column(children=[self.canvas.plot], sizing_mode="stretch_both")
        self._begin()
        p.wire(self.state, self.canvas.tools, self.timeline.now, self.curves.plot)
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p = self.parts
        drawn = {"maps": self.maps, "timeline": self.timeline.plot, "curves": self.panel}
        return {"head": p.head, "under": p.under, "side": p.side, "player": p.player, **drawn}

    def _begin(self) -> None:
        """Set the controls to the view, and let them change it."""
        p, view = self.parts, self.view
        self._offer_fields()
        self._offer()
        p.file.value = "TEST.toml"
        p.of["since"].high = len(self.result) - 1
        p.over.active = OVER.index(view.over)
        p.message.text, p.head.text = _HELP, self._title()
        for entry, _, kind, *_ in CONTROLS:
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
        for field in self.fields.all.values():
            groups.setdefault(field.group, []).append((field.name, field.label))
        of = self.parts.of
        of["field"].options = groups
        for name in BESIDE:
            of[name].options = {"": [("", "nothing"), (UNCERTAINTY, "its uncertainty")], **groups}

    def _offer(self) -> None:
        """Offer channels, curves and probes as they are now, and the controls of the chosen clock."""
        p, view, curves = self.parts, self.view, self.curves
        names = [] if curves.channels is None else list(curves.channels.values)
        quantities = [] if curves.histories is None else [one.name for one in curves.histories.quantities]
        read = [name for name in quantities if name not in names]
        for entry, first, known in (
            ("trigger", "choose", names), ("align", "choose", names), ("force", "the only one in N or kN", names),
            ("beside", "none", names), ("align_to", "choose", read), ("along", "time", quantities),
        ):  # fmt: skip
            stated = getattr(view, entry)
            p.of[entry].options = [("", first), *dict.fromkeys([*known, *([stated] if stated else [])])]
        p.of["trigger"].visible = view.clock == "trigger"
        p.of["align"].visible = p.of["align_to"].visible = view.clock == "correlation"
        p.of["offset"].visible = view.clock == "offset"
        p.probe.options = list(probe_marks(view.marks))
        if p.probe.value not in p.probe.options:
            p.probe.value = next(iter(p.probe.options), "")
        self._show_name()

    def _show_name(self) -> None:
        marks = probe_marks(self.view.marks).get(self.parts.probe.value)
        self.parts.name.value = marks[0].name if marks else ""

    def _rename(self, name: str) -> None:
        """Give the chosen probe a name; empty: its kind and number."""
        p, (name, marks) = self.parts, (name.strip(), self.view.marks)
        found = probe_marks(marks).get(p.probe.value)
        if found is None or name == found[0].name:
            return
        if name and (not PROBE_NAME.fullmatch(name) or any(mark.name == name for mark in marks)):
            p.message.text = warning(
                f'a name has letters, digits, spaces, "." and "-", and no other probe has it; not "{name}"'
            )
            self._show_name()
            return
        self._take_marks(tuple(replace(mark, name=name) if mark is found[0] else mark for mark in marks))
        p.probe.value = name or next(key for key, own in probe_marks(self.view.marks).items() if own[1:] == found[1:])

    def _set(self, entry: str, attribute: str, old: Any, new: Any) -> None:
        """Take the value of a control into the view; a range by hand starts from that in view."""
        of = self.parts.of
        if new is None:  # a number that was deleted
            return
        if entry in ("low", "high"):
            low, high = of["low"].value, of["high"].value
            self.show(**({"low": low, "high": high} if None not in (low, high) and low < high else {}))
        elif entry == "range" and new == "hand":
            self.view = replace(self.view, range="hand")
            of["low"].value, of["high"].value = (
                float(end) for end in (self.canvas.colours.low, self.canvas.colours.high)
            )
            self._set("low", "value", None, 0)
        else:
            self.show(**{entry: new})
            if entry in ("gauge", "measure", "distance", "distance_std", "camera") and self.view.marks:
                self._read_curves()
            if entry in _CURVES:
                self._state()

    def _listen(self) -> None:
        p = self.parts
        self.canvas.marks.on_change("data", lambda attr, old, new: self._marked())
        p.lock.on_click(lambda: p.of["range"].update(value="hand"))
        p.clear.on_click(lambda: self._take_marks(()))
        for button, back in ((p.undo, True), (p.redo, False)):
            button.on_click(partial(self._undo, back=back))
        p.probe.on_change("value", lambda attr, old, new: self._show_name())
        p.name.on_change("value", lambda attr, old, new: self._rename(new))
        for button, act in ((p.write, self._write), (p.take, self._take_probes)):
            button.on_click(partial(guarded, act, lambda text: p.written.update(text=warning(text))))
        p.drag.js_on_change("active", script("hold", toggle=p.drag, pan=self.curves.pan))
        for event in (PanStart, Pan, PanEnd):
            self.curves.plot.on_event(event, self._drag)
        p.csv.on_click(self._save)
        self.canvas.plot.on_event(MouseMove, self._hover)
        self.line.choice.on_change("active", lambda attr, old, new: self._choose_line(new))
        p.movie.on_change("active", lambda attr, old, new: guarded(self._film, self._stop_film))
        for plot in (self.timeline.plot, self.curves.plot, self.line.wave):
            plot.on_event(Tap, self._jump)
        self.document.on_event(DocumentReady, lambda event: self._ready())

    def _ready(self) -> None:
        self.canvas.resize()
        self.show()
        if self.view.marks or self.view.channels:
            self._read_curves()
        every(_TICK, self.document, lambda: self.progress.advance(self.result), self.complain)
        for act in (self._grow, self._draw_progress, self._tell_film):
            every(_IDLE, self.document, act, self.complain)

    def complain(self, text: str) -> None:
        """Report an error; the page goes on."""
        self.parts.description.text = warning(text)
        self.state.shown = self.state.asked

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
        for canvas in (self.canvas, *self.beside):
            canvas.clear()
        for layer in (self.directions, self.contours, self.arrows):
            layer.show(None)
        self.ends.show()
        self.blank.show()
        self._read_out()
        self.curves.point(self.view.frame)
        self.line.show(self.view.frame, None)
        self.state.query = self.view.query()
        self.complain(text)

    def _draw(self) -> None:
        view = self.view
        self._choose()
        field = self.fields.all[view.field]
        values = self.values = self._values(view.field)
        picture, remark = self.pictures.frame(view.frame) if view.over == "deformed" else (self.pictures.reference, "")
        low, high = (self.parts.of[name] for name in ("low", "high"))
        if view.range == "hand" and (low.value, high.value) != (view.low, view.high):
            remark = f"The colours go from {view.low:g} to {view.high:g}: the lowest number must be below the highest."
        nodes, names = self._nodes(values), [view.field, *self._others]
        self._arrange(len(names))
        for canvas, name in zip((self.canvas, *self.beside), names, strict=False):
            self._paint(canvas, name, nodes, picture)
        low.visible = high.visible = view.range == "hand"
        self.parts.of["symmetric"].visible = field.signed and view.range != "hand"
        self.parts.description.text = frame_text(self.fields, view.frame, field, values, remark)
        self._draw_layers(field, values, nodes)
        self._read_out()
        self.curves.point(view.frame)
        self._show_line()
        self.state.query, self.state.shown = view.query(), self.state.asked

    def _choose(self) -> None:
        """Derive fields as the view has it."""
        view = self.view
        try:
            scale = view.scale_settings(self._base, scale_of(self.result))
            if scale != self._scale:
                self.fields, self._scale = Maps.of(self.result, scale), scale
                self._offer_fields()
            told = f"{scale.mm_per_pixel:.6g} ± {scale.mm_per_pixel_std:.2g} mm/px" if scale and not view.camera else ""
            self.parts.scaled.text = told
        except RgbmidicError as error:
            self.parts.scaled.text = warning(str(error))
        chosen = (view.gauge, view.measure, view.since, view.rigid, view.rate_window, self._scale)
        if chosen != self._chosen:
            self.fields = self.fields.chosen(
                gauge=view.gauge or None,
                measure=view.measure,
                since=None if view.since < 0 else view.since,
                rigid_removed=view.rigid,
                window=view.rate_window or None,
            )
            self._chosen = chosen

    def _values(self, name: str) -> MapValues:
        read: MapValues = self._read(name, self.view.frame, self._changes, self._chosen)
        return read

    @property
    def _displacement(self) -> FloatArray:
        """u, v and their uncertainties (4, N) in the frame in view, px."""
        moved: FloatArray = self._moved(self.view.frame, self._changes, self._chosen)
        return moved

    @property
    def _others(self) -> list[str]:
        """Names of the fields beside the first."""
        asked = [getattr(self.view, entry) for entry in BESIDE]
        named = [f"{self.view.field}_std" if name == UNCERTAINTY else name for name in asked]
        return [name for name in named if name in self.fields.all]

    def _arrange(self, count: int) -> None:
        """Show so many canvases: side by side, two in a row, or one below the other where the field is wide.

        They take the place of the curves too where there are none.
        """
        alone = count > 1 and not self.view.marks
        self.maps.css_classes = [*(["several"] if count > 1 else []), *(["alone"] if alone else [])]
        if count == sum(canvas.plot.visible for canvas in (self.canvas, *self.beside)):
            return
        while len(self.beside) < count - 1:
            self.beside.append(Canvas(self.document, (), self.canvas.wanted, self._redraw, like=self.canvas))
            self.beside[-1].plot.on_event(MouseMove, self._hover)
            self.beside[-1].plot.name = f"plot_{len(self.beside) + 1}"
        for place, canvas in enumerate(self.beside):
            canvas.plot.visible = place < count - 1
        plots = [canvas.plot for canvas in (self.canvas, *self.beside)][:count]
        wide = count == 2 and np.ptp(self.result.nodes[:, 0]) > np.ptp(self.result.nodes[:, 1])
        across = 1 if wide or count == 1 else 2
        rows = [bk.Row(children=plots[at : at + across], sizing_mode="stretch_both") for at in range(0, count, across)]
        if count % across:  # a plot of another shape would distort what all show of the image
            rows[-1].children = [*rows[-1].children, bk.Spacer(sizing_mode="stretch_both")]
        self.maps.children = rows if count > 1 else plots

    def _paint(self, canvas: Canvas, name: str, nodes: FloatArray, picture: Picture) -> None:
        """Paint a field on a canvas; palette, range by hand and number of colours are those of the first."""
        view, field, values = self.view, self.fields.all[name], self._values(name)
        first = canvas is self.canvas
        suits = palette_name(field.kind, symmetric=view.symmetric and field.signed)
        colours = palette((first and not field.codes and view.palette) or suits, view.levels)
        over = Overlay(
            nodes=nodes,
            elements=self.result.elements,
            values=values.values,
            ends=self._ends(name, values, by_hand=first),
            colours=colours,
            opacity=view.opacity,
            stepped=field.stepped,
            beyond=np.abs(values.values) - 2 * values.std if view.hatched else None,
        )
        canvas.show(paint(self.canvas.window, picture, over, AROUND[self.dark]), self.canvas.window)
        canvas.colour(over.ends, colours, field.label, field.codes)

    def _draw_layers(self, field: MapField, values: MapValues, nodes: FloatArray) -> None:
        """Draw what lies over the first field: lines, arrows, extremes, nodes without data, marks."""
        view, window, elements = self.view, self.canvas.window, self.result.elements
        direction = self._values("direction").values if view.directions else None
        self.directions.show(None if direction is None else direction_lines(window, nodes, direction))
        levels = np.linspace(*self._ends(view.field, values), min(view.levels, _CONTOURS) + 1)[1:-1]
        smooth = view.contours and not field.stepped
        self.contours.show(contour_lines(nodes, elements, values.values, levels.tolist()) if smooth else None)
        arrows, title = None, "times their length (0: as there is room)"
        if view.vectors:
            moved = self.fields.displacement(view.frame)[:2].T
            if self.fields.physical.rectified.camera is not None:  # that is on the plane, the arrows are on the image
                first = self.result.nodes if view.since < 0 else self.fields.read("u", view.since).moved
                moved = values.moved - first
            arrows, longer = arrow_lines(window, nodes, moved, view.longer)
            title = f"{title}: {longer:.3g}"
        self.arrows.show(arrows)
        self.parts.of["longer"].title = title
        ends = extremes(field, values) if view.extremes else ()
        names = zip(("smallest", "largest"), ("#56b4e9", "#e69f00"), ends, strict=False)
        self.ends.show(
            [
                (*nodes[node].tolist(), f"{name} {field.text(values.values[node], values.std[node])}", colour)
                for name, colour, node in names
            ]
        )
        missing = np.flatnonzero(values.status) if view.blank else ()
        colours = palette("codes")
        self.blank.show([(*self.result.nodes[node].tolist(), "", colours[values.status[node]]) for node in missing])
        probes = probe_marks(view.marks).items()
        gauge = self._gauge
        shown = self.fields, field, values, self._displacement, view.frame
        texts = {name: probe_text(*shown, marks[0].kind, probe_place(marks, gauge)) for name, marks in probes}
        texts[SCALE] = f": {view.distance:g} mm" if view.distance else ""
        self.marks.place(view.marks, self.result.nodes, nodes, texts, gauge)

    @property
    def _gauge(self) -> float:
        """Length of the virtual strain gauges, px."""
        return self.view.gauge or shortest_gauge(self.fields.physical.mesh)

    def _redraw(self) -> None:
        """Draw another part of the image."""
        wanted = self.canvas.wanted
        self.show(window=() if wanted == Canvas.around(self.result.nodes) else wanted)

    def _ends(self, name: str, values: MapValues, *, by_hand: bool = True) -> tuple[float, float]:
        """Return the values of the first and the last colour."""
        view, field = self.view, self.fields.all[name]
        if view.range == "hand" and by_hand:
            return view.low, view.high
        if field.ends is not None:
            return field.ends
        if view.range == "test":
            low, high = self._test_range(name, self._changes, self._chosen)
        else:
            low, high = robust_range(values) or (0.0, 1.0)
        even = view.symmetric and field.signed
        return (-max(abs(low), abs(high)), max(abs(low), abs(high))) if even else (low, high)

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
            place = self._displacement, self._nodes(self.values), *self._pointer
            told = dict.fromkeys(
                pointer_text(self.fields, self.fields.all[name], self._values(name), *place)
                for name in (self.view.field, *self._others)
            )
            x, y = self._pointer
            text = " &nbsp; ".join([f"x {x:.1f}, y {y:.1f} px:", *told])
        self.parts.under.text = text

    def _marked(self) -> None:
        """Take marks that were set, moved or removed."""
        if self.values is None:
            return
        marks = self.marks.taken(self._nodes(self.values), self.result.nodes)
        if marks is not None:
            ends = [mark for mark in marks if mark.kind == SCALE]  # a third place begins another one
            dropped = ends[:2] if len(ends) > 2 else []
            self._take_marks(tuple(mark for mark in marks if mark not in dropped))

    def _take_marks(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step that can be undone."""
        self.steps.keep(marks)
        self._show_marks()

    def _undo(self, *, back: bool) -> None:
        self.steps.go(back=back)
        self._show_marks()

    def _show_marks(self) -> None:
        before, marks = self.view.marks, self.steps.now
        self.show(marks=marks)
        if probe_marks(before) != probe_marks(marks) or self._scale != self._scale_read:
            self._read_curves()
        self._offer()

    def _read_curves(self) -> None:
        view, curves = self.view, self.curves
        curves.colours, self._scale_read = self.marks.colours, self._scale
        curves.along, curves.beside, curves.stated = view.along, view.beside, view.channel_settings(self._base)
        measure = view.measure if view.measure != MEASURES[0] else None

        def shown() -> None:
            self._offer()
            curves.point(self.view.frame)

        curves.read(self.result, view.marks, self._gauge, shown, measure=measure, scale=self._scale)

    def _state(self) -> None:
        """Take what is stated of the channels, and what is drawn of them."""
        view, curves = self.view, self.curves
        if (curves.histories is None) == bool(view.channels):
            self._read_curves()
            return
        stated = view.channel_settings(self._base)
        curves.along, curves.beside = view.along, view.beside
        if stated != curves.stated:
            curves.stated = stated
            curves.combine()
        self._offer()
        curves.draw()
        curves.point(view.frame)

    def _drag(self, event: Any) -> None:
        """Move the channels along the time with the pointer; their offset is stated where it lets go."""
        if not self.parts.drag.active or event.x is None:
            return
        if isinstance(event, PanStart):
            self.curves.grab(event.x)
        offset = self.curves.drag(event.x)
        if offset is None:
            return
        self.parts.drag.label = f"Offset {offset:.6g} s"
        if isinstance(event, PanEnd):
            self.parts.of["clock"].value, self.parts.of["offset"].value = "offset", float(f"{offset:.9g}")

    def _write(self) -> None:
        """Write the chosen sections into a TEST.toml, which must be confirmed where it exists."""
        p, view = self.parts, self.view
        draft = Draft.of_result(self.result, Path(p.file.value))
        measure = view.measure if view.measure != MEASURES[0] else None
        made = probes(view.marks, self._gauge, probes_of(self.result), measure)
        ready: dict[str, Callable[[], dict[str, Any]]] = {
            "probes": lambda: probe_section(draft, made),
            "channels": lambda: channel_section(draft, view.channel_settings(self._base)),
            "scale": lambda: scale_section(draft, self._scale),
        }
        names = [WRITTEN[at] for at in sorted(p.what.active)]
        if not names:
            raise InputError(f"choose what is written: {', '.join(WRITTEN)}")
        draft = draft.changed({name: ready[name]() for name in names})
        draft.check()
        sections = " and ".join(f"[{name}]" for name in names)
        if asked := self.confirmation.question([draft.file], f"{sections} in it"):
            p.written.text = warning(asked)
            return
        draft.write()
        p.written.text = html.escape(f"{sections} of {draft.file} {'is' if len(names) == 1 else 'are'} written.")

    def _take_probes(self) -> None:
        """Set the marks of the probes that a TEST.toml states."""
        draft = Draft.of_result(self.result, Path(self.parts.file.value))
        stated = read_section(ProbeSettings, "probes", draft.section("probes"))
        lengths = {length for *_, length in stated.strain_gauges}
        if len(lengths) > 1:
            raise InputError(f"the strain gauges of {draft.file} have different lengths; the page has one for all")
        if lengths:
            self.parts.of["gauge"].value = lengths.pop()
        scale = [mark for mark in self.view.marks if mark.kind == SCALE]
        self._take_marks((*marks_of(stated), *scale))
        self.parts.written.text = f"{len(stated.places)} probes are read from {html.escape(str(draft.file))}."

    @property
    def _lines(self) -> dict[str, tuple[float, ...]]:
        """Ends of the lines that are marked, by their names."""
        probes = probe_marks(self.view.marks).items()
        return {name: probe_place(marks, 0) for name, marks in probes if marks[0].kind == "line"}

    def _choose_line(self, active: int) -> None:
        name = ["", *self._lines][active]
        if name != self.view.line:
            self.show(line=name)

    def _show_line(self) -> None:
        """Show the field along the chosen line in place of the curves."""
        lines, name = self._lines, self.view.line
        shown = self.line.offer(list(lines), name)
        self.curves.plot.visible = not shown
        if shown:
            self.line.ask(self.fields, self.view.field, lines[name], self._chosen, self._changes)
            self.line.show(self.view.frame, self.values)

    def _film(self) -> None:
        """Write a movie of what is in view, or stop the one that is being written."""
        if not self.parts.movie.active:
            if self.movie is not None and self.movie.going:
                self._stop_film(f"{self.movie.out.name} was stopped; no file is left")
            return
        view, names = self.view, [self.view.field, *self._others]
        limits: dict[str, tuple[float, float]] = {}
        for name in names:
            first = name == view.field
            if view.range == "test" or (view.range == "hand" and first):
                limits[name] = self._ends(name, self._values(name), by_hand=first)
        self.movie = Movie.start(
            self.fields, names, limits=limits, opacity=view.opacity, raw=view.over == "deformed",
            colours=view.palette if len(names) == 1 else "",
        )  # fmt: skip
        self._tell_film()

    def _tell_film(self) -> None:
        if self.movie is None:
            return
        text, going = self.movie.summary(), self.movie.going
        self.parts.said.text, self.parts.said.visible = text, True
        self.parts.movie.label = "■ Movie" if going else "Movie"
        if not going:
            self.movie, self.parts.movie.active = None, False

    def _stop_film(self, text: str) -> None:
        if self.movie is not None:
            self.movie.stop()
        self.movie, self.parts.movie.label, self.parts.movie.active = None, "Movie", False
        self.parts.said.text, self.parts.said.visible = warning(text), True

    def _save(self) -> None:
        if self.curves.reading:
            self.parts.message.text = "The curves are still being read: save them once they are drawn."
        elif self.curves.histories is None or not self.curves.histories.quantities:
            self.parts.message.text = "There is no curve yet: set a mark on the field first."
        else:
            self.state.csv = as_csv(self.curves.histories)

    def _jump(self, event: Any) -> None:
        """Go to the frame that was clicked in the time line or among the curves."""
        if event.x is None:
            return
        clocks = {self.curves.plot: self.curves.frame, self.line.wave: self.line.frame}
        frame = clocks[event.model](event.x) if event.model in clocks else event.x
        self.parts.frame.value = min(max(round(float(frame)), 0), len(self.result) - 1)

    def _draw_progress(self) -> None:
        self.timeline.draw(self.progress)
        self.parts.head.text = self._title()

    def _title(self) -> str:
        summary = self.progress.summary(int(self.result.finished.sum()))
        return f"<b>{html.escape(str(self.result.path))}</b> &nbsp; {summary}"

    def _grow(self) -> None:
        """Take in frames that a run has added or measured again; a view of the last frame follows it."""
        grown = (self.result.path / "solution").stat().st_mtime_ns
        if grown == self._grown and time.time_ns() > grown + _SETTLED:
            return
        self._grown, new = grown, self.result.refresh()
        if np.array_equal(new.table.written, self.result.table.written):
            return
        before, after = np.flatnonzero(self.result.finished), np.flatnonzero(new.finished)
        self.result, self.fields, self._changes = new, replace(self.fields, result=new), self._changes + 1
        self._read_curves()
        follows = not len(before) or self.view.frame == before[-1]
        if follows and self.parts.frame.value != after[-1]:
            self.parts.frame.value = int(after[-1])
        else:
            self.show()
