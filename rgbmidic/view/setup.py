"""The page that sets a test up: frames, region with holes, mesh and uncertainty to expect, TEST.toml, the run."""

from __future__ import annotations

import html
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.layouts import column, row
from bokeh.models import (
    Button,
    Checkbox,
    ColumnDataSource,
    CustomJS,
    Div,
    RadioButtonGroup,
    Select,
    Slider,
    Spinner,
    TextInput,
    Toggle,
)

from rgbmidic.errors import RgbmidicError
from rgbmidic.lab.inspection import Inspection
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.plan import read_region
from rgbmidic.report.style import colour_range
from rgbmidic.settings import ELEMENT_SIZE, RegionSettings, read_section
from rgbmidic.view.address import Mark
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.draft import Draft
from rgbmidic.view.models import PUMP_EVERY, TOOL, Asked, sheet
from rgbmidic.view.outline import HOLES, OUTLINES, arranged, marks_of, region_of, rings
from rgbmidic.view.picture import paint, palette
from rgbmidic.view.runner import Run
from rgbmidic.view.setup_frames import RAW, Footage, inspected, pictures

__all__ = ["SetupPage"]

logger = logging.getLogger(__name__)

_SHAPES = (*OUTLINES, *HOLES)
_MOST_EDGES = 20_000
"""Elements whose edges are drawn: more are a grey surface."""
_TICK, _SOON = 500, 60
"""Ms between two looks at the run, and that a mark which moves waits for its next move."""
_EXPECTED = "expected uncertainty"
_TOOL = f"if (cb_obj.active === null) return; {TOOL}; other.active = null"
_HELP = (
    "1. Choose a shape and click on the frame: Rectangle (two opposite corners), Polygon, Circle (centre, then "
    "a place on it); holes likewise. Marks can be dragged; Backspace removes a chosen one.<br>2. Choose the element "
    "size.<br>3. <b>Inspect</b> tells what uncertainty to expect.<br>4. Write the file, and run it."
)


class SetupPage:
    """One opened page.

    Parameters
    ----------
    document
        Of the visitor.
    draft
        The test as far as it is known.
    runs
        The runs that pages have started, the last of which is told; this one's come to it, so that they can be served.
    dark
        Whether the page is dark.
    """

    def __init__(self, document: Document, draft: Draft, runs: list[Run], *, dark: bool) -> None:
        self.document, self.draft, self.dark, self.runs = document, draft, dark, runs
        self.footage = Footage.of(draft)
        rows, columns = self.footage.shape
        self.canvas = Canvas(document, _SHAPES, (-0.5, -0.5, columns - 0.5, rows - 0.5), self.show)
        self.pictures: dict[str, Any] = {}
        self.inspection: Inspection | None = None
        self._history: list[tuple[Mark, ...]] = [self._first_marks()]
        self._reader, self._hole, self._moved, self._coming = ThreadPoolExecutor(1), 1, False, False
        self._edges = ColumnDataSource({"xs": [], "ys": []})
        self._rings = ColumnDataSource({"xs": [], "ys": [], "colour": []}, name="rings")
        self._build()
        self._listen()

    def _first_marks(self) -> tuple[Mark, ...]:
        region = self.draft.region
        return () if region is None else marks_of(region)

    def _build(self) -> None:
        plot, frames, last = self.canvas.plot, self.draft.frames, len(self.footage.series) - 1
        plot.multi_line("xs", "ys", source=self._edges, line_color="#ffd166", line_width=0.7, line_alpha=0.7)
        plot.multi_line("xs", "ys", source=self._rings, line_color="colour", line_width=2.5)
        self.asked = Asked(name="state", asked=frames.reference[0], shown=frames.reference[0])
        wide: dict[str, Any] = {"stylesheets": [sheet(dark=self.dark)], "sizing_mode": "stretch_width"}
        third: dict[str, Any] = {"stylesheets": wide["stylesheets"], "width": 74}
        self.head, self.words, self.told = Div(**wide), Div(name="words", **wide), Div(name="told", text=_HELP, **wide)
        self.picture = Select(title="Picture", name="picture", options=[RAW], value=RAW, **wide)
        self.glare = Checkbox(label="mark saturated samples", active=True, stylesheets=wide["stylesheets"])
        labels = ["Move", "Rectangle", "Polygon", "Circle"]
        self.mode = RadioButtonGroup(labels=labels, active=0, name="mode", **wide)
        self.hole = RadioButtonGroup(labels=["Hole", "Round hole"], active=None, name="hole", **wide)
        self.undo, self.next, self.clear = (
            Button(label=label, name=label.lower(), **third) for label in ("Undo", "Next hole", "Clear")
        )
        self.size = Spinner(title="Element size (px)", name="size", low=4, value=self._size, step=1, **wide)
        reference = frames.reference[0]
        numbers = (("Reference", reference), ("First", frames.first), ("Last", frames.last if frames.last else last))
        self.reference, self.first, self.last = (
            Spinner(title=title, name=title.lower(), low=0, high=last, value=value, step=1, **third)
            for title, value in numbers
        )
        self.inspect = Button(label="Inspect", name="inspect", **wide)
        calibration = self.draft.section("calibration").get("file", "")
        self.calibration = TextInput(title="Calibration file", name="calibration", value=str(calibration), **wide)
        self.file = TextInput(title="Write to", name="file", value=str(self.draft.file), **wide)
        out = self.runs[-1].out if self.runs else self.draft.file.parent / "result"
        self.write = Button(label="Write TEST.toml", name="write", **wide)
        self.out = TextInput(title="Result folder", name="out", value=str(out), **wide)
        self.go = Button(label="Run", name="run", button_type="primary", **wide)
        self.ran = Div(name="ran", **wide)
        self.frame = Slider(
            title="Frame", name="frame", start=0, end=max(last, 1), step=1, value=reference, disabled=last < 1, **wide
        )
        self.step = Spinner(name="step", low=1, high=max(last, 1), value=1, width=70, stylesheets=wide["stylesheets"])
        self.play = Toggle(label="▶ Play", name="play", width=90, stylesheets=wide["stylesheets"])

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        buttons, numbers = row(self.undo, self.next, self.clear), row(self.reference, self.first, self.last)
        parts = (self.words, self.picture, self.glare, self.mode, self.hole, buttons, self.size, numbers)
        side = column(*parts, self.calibration, self.inspect, sizing_mode="stretch_width")
        beside = column(self.told, self.file, self.write, self.out, self.go, self.ran, sizing_mode="stretch_width")
        player = row(self.play, self.step, self.frame, sizing_mode="stretch_width")
        return {"head": self.head, "side": side, "plot": self.canvas.plot, "curves": beside, "player": player}

    @property
    def _size(self) -> float:
        size = self.draft.section("mesh").get("element_size", ELEMENT_SIZE)
        return float(size) if isinstance(size, int | float) else ELEMENT_SIZE

    def _listen(self) -> None:
        self.asked.on_change("asked", lambda attr, old, new: self.show())
        for control, key in ((self.picture, "value"), (self.glare, "active")):
            control.on_change(key, lambda attr, old, new: self.show())
        self.canvas.marks.on_change("data", lambda attr, old, new: self._marked())
        self.size.on_change("value", lambda attr, old, new: self._remesh())
        self.undo.on_click(self._undo)
        self.next.on_click(self._next_hole)
        self.clear.on_click(lambda: self._keep(()))
        self.inspect.on_click(self._inspect)
        self.calibration.on_change("value", lambda attr, old, new: self._guarded(self._reopen))
        self.write.on_click(lambda: self._guarded(self._write))
        self.go.on_click(lambda: self._guarded(self._run))
        models = {"state": self.asked, "slider": self.frame, "play": self.play, "step": self.step}
        pump = CustomJS(args=models, code=PUMP_EVERY)
        self.frame.js_on_change("value", pump)
        self.play.js_on_change("active", pump)
        self.asked.js_on_change("shown", pump)
        tools = list(self.canvas.tools)
        self.mode.js_on_change("active", CustomJS(args={"tools": tools[:4], "other": self.hole}, code=_TOOL))
        self.hole.js_on_change("active", CustomJS(args={"tools": tools[4:], "other": self.mode}, code=_TOOL))
        self.document.on_event(DocumentReady, lambda event: self._ready())
        self.document.add_periodic_callback(self._tick, _TICK)
        self.document.on_session_destroyed(lambda context: self._reader.shutdown(wait=False, cancel_futures=True))

    def _ready(self) -> None:
        self.canvas.resize()
        self._remesh()

    def _guarded(self, act: Callable[[], None]) -> None:
        """Do something; what is wrong with it is told in one line."""
        try:
            act()
        except Exception as error:  # the last resort of a page: it goes on, and says what happened
            known = isinstance(error, RgbmidicError | OSError)
            if not known:
                logger.exception("the page failed")
            text = html.escape(str(error) if known else f"{type(error).__name__}: {error}")
            self.told.text = f'<b style="color:var(--warn)">{text}</b>'

    def show(self) -> None:
        """Draw the picture with what is marked."""
        self._guarded(self._draw)
        self.asked.shown = self.asked.asked

    def _draw(self) -> None:
        index = min(self.asked.asked, len(self.footage.series) - 1)
        name = html.escape(self.footage.series.name(index))
        self.words.text = f"Frame {index} of {len(self.footage.series) - 1}: {name}"
        raw, full = self.footage.raw(index)
        picture = self.pictures.get(self.picture.value, raw)
        field, ends = None, (0.0, 1.0)
        if self.picture.value == _EXPECTED and self.inspection is not None:
            ends = colour_range(self.inspection.std[np.isfinite(self.inspection.std)])
            field = (self.inspection.nodes, self.inspection.elements, self.inspection.std)
        colours = palette("plasma")
        title = f"{_EXPECTED} (px)" if field else self.picture.value
        around = 30 if self.dark else 235
        image = paint(self.canvas.window, picture, field, ends, colours, opacity=0.8, around=around)
        if self.glare.active:
            over = paint(self.canvas.window, full.astype(np.uint8) * 255, None, ends, colours, opacity=0, around=0)
            image = np.where((over & 0xFF) > 64, np.uint32(0xFF2030FF), image)
        self.canvas.show(image)
        self.canvas.colour(ends, colours, title)
        self.canvas.bar.visible = field is not None

    @property
    def marks(self) -> tuple[Mark, ...]:
        """The marks of the region."""
        return self._history[-1]

    def _marked(self) -> None:
        """Marks were set, moved or removed on the plot."""
        now = tuple(self.canvas.set)
        if now == self.marks:
            return
        new = next((mark.kind for mark in now if mark not in self.marks), "")
        self._keep(arranged(_numbered(now, self._hole), new), moved=len(now) == len(self.marks))

    def _keep(self, marks: tuple[Mark, ...], *, moved: bool = False) -> None:
        """Let these be the marks; a mark that is dragged comes many times, and is undone at once."""
        before = self._history[:-1] if moved and self._moved else self._history
        self._history, self._moved = [*before[-99:], marks], moved
        if not self._coming:
            self._coming = True
            self.document.add_timeout_callback(self._remesh, _SOON)

    def _undo(self) -> None:
        if len(self._history) > 1:
            self._history.pop()
        self._remesh()

    def _next_hole(self) -> None:
        """The marks of a hole that come now belong to another one."""
        numbers = [int(mark.kind.rpartition(" ")[2]) for mark in self.marks if mark.kind.startswith("hole ")]
        self._hole = max(numbers, default=0) + 1

    def _remesh(self) -> None:
        """Draw outline, holes and the mesh that they get."""
        self._coming = False
        self.canvas.place(self.marks)
        outline, holes = rings(self.marks)
        closed = [[*ring, *ring[:1]] for ring in (outline, *holes)]
        self._rings.data = {
            "xs": [[p[0] for p in ring] for ring in closed],
            "ys": [[p[1] for p in ring] for ring in closed],
            "colour": ["#56b4e9", *["#e69f00"] * len(holes)],
        }
        self._edges.data = {"xs": [], "ys": []}
        self._guarded(self._make_mesh)
        self.show()

    def _make_mesh(self) -> None:
        content = region_of(self.marks)
        if content is None or not self.size.value:
            self.told.text = _HELP
            return
        mesh = Tri3Mesh.from_region(self._region(content), float(self.size.value))
        self.told.text = f"{len(mesh.nodes)} nodes, {len(mesh.elements)} elements.<br>{_HELP}"
        if len(mesh.elements) <= _MOST_EDGES:
            corners = mesh.nodes[mesh.elements][:, [0, 1, 2, 0]]
            self._edges.data = {"xs": list(corners[..., 0]), "ys": list(corners[..., 1])}

    def _region(self, content: dict[str, Any]) -> Region:
        return read_region(read_section(RegionSettings, "region", content), self.footage.shape)

    def _inspect(self) -> None:
        """Look at the frame in view as `rgbmidic inspect` does, beside the page."""
        content = region_of(self.marks)
        if content is None:
            self.told.text = "Draw the region first."
            return
        self.told.text = "inspecting …"
        index, size = int(self.frame.value), float(self.size.value)
        task = self._reader.submit(lambda: inspected(self.footage, index, self._region(content), size))
        have = partial(self._guarded, partial(self._have, task))
        task.add_done_callback(lambda _: self.document.add_next_tick_callback(have))

    def _have(self, task: Future[Inspection]) -> None:
        self.inspection = task.result()
        self.pictures = pictures(self.inspection, self.footage.shape)
        self.picture.options = [RAW, *self.pictures, _EXPECTED]
        known = self.inspection.std[np.isfinite(self.inspection.std)]
        lines = [f"<b>{html.escape(self.inspection.name)}</b>: "]
        lines[0] += (
            f"median uncertainty to expect {np.median(known):.2g} px" if known.size else "no node can be measured"
        )
        lines += [f"• {html.escape(finding.text)}" for finding in self.inspection.findings]
        self.told.text = "<br>".join(lines)
        if self.picture.value == _EXPECTED:
            self.show()
        else:
            self.picture.value = _EXPECTED

    def _changed(self) -> Draft:
        """The draft with all that the page says."""
        content = region_of(self.marks)
        region = {key: (content or {}).get(key) for key in ("rectangle", "polygon", "holes")}
        last = int(self.last.value)
        frames: dict[str, Any] = {"first": int(self.first.value) or None}
        frames["last"] = None if last == len(self.footage.series) - 1 else last
        if int(self.reference.value) != self.draft.frames.reference[0]:
            frames["reference"] = [int(self.reference.value)]
        changes: dict[str, dict[str, Any]] = {"frames": frames, "mesh": {"element_size": float(self.size.value)}}
        if self.calibration.value:
            changes["calibration"] = {"file": self.calibration.value}
        if content is not None:
            changes["region"] = {"mask": None, **region}
        return self.draft.changed(changes)

    def _reopen(self) -> None:
        self.draft = self._changed()
        self.footage = Footage.of(self.draft)
        self.show()

    def _write(self) -> None:
        self.draft = self._changed().at(Path(self.file.value))
        self.draft.write()
        self.told.text = f"{html.escape(str(self.draft.file))} is written."

    def _run(self) -> None:
        if self.runs and self.runs[-1].going:
            self.told.text = "The run still goes on."
            return
        self._write()
        self.runs.append(Run.start(self.draft.file, Path(self.out.value)))

    def _tick(self) -> None:
        if self.runs:
            run = self.runs[-1]
            link = '<br><a id="result" href="result">look at the result as it grows</a>' if run.begun else ""
            self.ran.text = html.escape(run.words()) + link


def _numbered(marks: Sequence[Mark], hole: int) -> tuple[Mark, ...]:
    """New marks of holes with the number of theirs: a polygon's is `hole`, a round one is complete with two marks."""
    done: list[Mark] = []
    for mark in marks:
        number = hole
        if mark.kind == "round hole":
            number = 1 + sum(one.kind.startswith("round hole ") for one in done) // HOLES["round hole"]
        done.append(Mark(f"{mark.kind} {number}", mark.x, mark.y) if mark.kind in HOLES else mark)
    return tuple(done)
