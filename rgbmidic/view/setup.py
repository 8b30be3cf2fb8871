"""Page that sets a test up: frames, region with holes, mesh and expected uncertainty, TEST.toml, the run."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.events import DocumentReady
from bokeh.layouts import column
from bokeh.models import ColumnDataSource

from rgbmidic.lab.inspection import Inspection
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.plan import finite_elements_of, read_region
from rgbmidic.report.style import colour_range
from rgbmidic.results.files import write_complete
from rgbmidic.settings import ELEMENT_SIZE, RegionSettings, TestSettings, read_section
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.draft import SHAPES, Confirmation, Draft, check_complete, marks_of, region_of, region_section
from rgbmidic.view.models import Background, SharedState, every, guarded, script, warning
from rgbmidic.view.picture import AROUND, Canvas, Overlay, paint, palette
from rgbmidic.view.setup_panel import RAW, DraftFrames, RegionDrawing, Run, SetupControls, overview, pictures

_EXPECTED = "expected uncertainty"
_GLARE = np.uint32(0xFF2030FF)
_HELP = (
    "1. Choose a shape and click on the frame: Rectangle (two opposite corners), Polygon, Circle (centre, then "
    "a place on it); holes and lamp masks (polygons where a light does not count) likewise, Next begins another. Marks "
    "can be dragged; Backspace removes a chosen one; Ctrl-Z undoes.<br>2. Choose the element size.<br>"
    "3. <b>Inspect</b> shows what uncertainty to expect.<br>4. Write the file, and run it."
)


class SetupPage:
    """Page that one visitor has opened to set a test up.

    Parameters
    ----------
    document
        Document of the visitor.
    draft
        The test as far as it is known.
    runs
        Runs that pages have started, the last of which is reported; this page adds its own, so that they are served.
    dark
        Whether the page is dark.
    """

    def __init__(self, document: Document, draft: Draft, runs: list[Run], *, dark: bool) -> None:
        self.document, self.draft, self.dark, self.runs = document, draft, dark, runs
        self.source = DraftFrames(draft)
        self.pictures: dict[str, Any] = {}
        self._expected: Overlay | None = None
        self._inspected, self._opened = 0, draft
        reference, out = draft.frames.reference[0], runs[-1].out if runs else draft.file.parent / "result"
        self.state = SharedState(name="state", asked=reference, shown=reference)
        self.parts = SetupControls(draft, len(self.source.series) - 1, out, dark=dark)
        self._reader = Background(document)
        rows, columns = self.source.shape
        self.canvas = Canvas(document, tuple(SHAPES), (-0.5, -0.5, columns - 0.5, rows - 0.5), self.show)
        self._edges, thin = ColumnDataSource({"xs": [], "ys": []}), {"line_width": 0.7, "line_alpha": 0.7}
        self.canvas.plot.multi_line("xs", "ys", source=self._edges, line_color="#ffd166", **thin)
        self.drawing = RegionDrawing(document, self.canvas, marks_of(draft), self._remesh)
        self.confirmation = Confirmation()
        self._offer_lights()
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        p = self.parts
        beside = column(p.message, p.file, p.write, p.out, p.go, p.ran, p.tiles, sizing_mode="stretch_width")
        return {"head": p.head, "side": p.side, "plot": self.canvas.plot, "curves": beside, "player": p.player}

    def _listen(self) -> None:
        p, tools = self.parts, list(self.canvas.tools)
        for model, key in ((self.state, "asked"), (p.picture, "value"), (p.glare, "active")):
            model.on_change(key, lambda attr, old, new: self.show())
        p.size.on_change("value", lambda attr, old, new: self._remesh())
        p.light.on_change("value", lambda attr, old, new: self._choose_light())
        p.calibration.on_change("value", lambda attr, old, new: self._guarded(self._reopen))
        for button, act in (
            (p.undo, partial(self.drawing.go, back=True)), (p.redo, partial(self.drawing.go, back=False)),
            (p.next, self.drawing.next_hole), (p.clear, partial(self.drawing.keep, ())),
            (p.inspect, self._inspect), (p.write, self._write), (p.go, self._run),
        ):  # fmt: skip
            button.on_click(partial(self._guarded, act))
        p.ask(self.state)
        p.mode.js_on_change("active", script("choose", group=p.mode, tools=tools[:4], other=p.hole))
        p.hole.js_on_change("active", script("choose", group=p.hole, tools=tools[4:], other=p.mode))
        self.document.on_event(DocumentReady, lambda event: self._ready())
        every(VIEWER.run_ms, self.document, self._tick, self._complain)

    def _ready(self) -> None:
        self.canvas.resize()
        self.show()
        self.drawing.draw()

    def _complain(self, text: str) -> None:
        self.parts.message.text = warning(text)

    def _guarded(self, act: Callable[[], object]) -> None:
        guarded(act, self._complain)

    def show(self) -> None:
        """Draw the picture."""
        self._guarded(self._draw)
        self.state.shown = self.state.asked

    def _draw(self) -> None:
        index = min(self.state.asked, len(self.source.series) - 1)
        name = html.escape(self.source.series.name(index))
        self.parts.description.text = f"Frame {index} of 0 to {len(self.source.series) - 1}: {name}"
        raw, full = self.source.raw(index)
        chosen = self.parts.picture.value
        picture = self.pictures.get(chosen, raw)
        over, window = self._expected if chosen == _EXPECTED else None, self.canvas.window
        image = paint(window, picture, over, AROUND[self.dark])
        if self.parts.glare.active:
            saturated = paint(window, full.astype(np.uint8) * 255, around=0)
            image = np.where((saturated & 0xFF) > 64, _GLARE, image)
        self.canvas.show(image)
        title = f"{chosen} (px)" if over else chosen
        if chosen != RAW and index != self._inspected:  # what was inspected stays while other frames are looked at
            title += f", of frame {self._inspected}: {self.source.series.name(self._inspected)}"
        self.canvas.colour(over.ends if over else (0.0, 1.0), palette("plasma"), title)
        self.canvas.bar.visible = over is not None

    def _remesh(self) -> None:
        """Draw the mesh of the region; drop the inspection, of another region, element size or calibration."""
        self._reader.drop()
        if self._expected is not None:
            self._expected, self.pictures = None, {}
            self.parts.tiles.text = ""
            self.parts.picture.value, self.parts.picture.options = RAW, [RAW]
        self._edges.data = {"xs": [], "ys": []}
        self._guarded(self._make_mesh)

    def _make_mesh(self) -> None:
        if (made := self._meshed()) is None:
            self.parts.message.text = _HELP
            return
        mesh = made[0]
        self.parts.message.text = f"{len(mesh.nodes)} nodes, {len(mesh.elements)} elements.<br>{_HELP}"
        if len(mesh.elements) <= VIEWER.mesh_edges:
            corners = mesh.nodes[mesh.elements][:, [0, 1, 2, 0]]
            self._edges.data = {"xs": list(corners[..., 0]), "ys": list(corners[..., 1])}

    def _meshed(self) -> tuple[Tri3Mesh, Region, float] | None:
        """Make the mesh and region of the run, with the element size: ``mesh.file``, which what is drawn restricts.

        None where there is neither a file nor a region with an element size.
        """
        content, size = region_of(self.drawing.marks), self.parts.size.value
        if self.draft.section("mesh").get("file"):
            document = {**self.draft.document, "region": content or self.draft.section("region")}
            settings = TestSettings.from_mapping(document, self.draft.file.parent)
            _, _, mesh, region = finite_elements_of(settings, self.source.shape)
            return mesh, region, mesh.size
        if content is None or not size:
            return None
        region = read_region(read_section(RegionSettings, "region", content), self.source.shape)
        return Tri3Mesh.from_region(region, float(size)), region, float(size)

    def _inspect(self) -> None:
        """Inspect the frame in view as `rgbmidic inspect` does, in another thread."""
        self.drawing.settle()  # else it drops the inspection
        if (made := self._meshed()) is None:
            self.parts.message.text = "Draw the region and state the size of the elements first."
            return
        self.parts.message.text = "inspecting …"
        index = int(self.parts.frame.value)
        work = partial(self.source.inspected, index, *made[1:])
        self._reader.ask(work, lambda found: self._guarded(partial(self._have, found, index)))

    def _have(self, inspected: Callable[[], Inspection], index: int) -> None:
        found, self._inspected = inspected(), index
        self.pictures = pictures(found, self.source.shape)
        self.parts.tiles.text = overview(found, self.pictures, self.source.raw(index)[0])
        self.parts.picture.options = [RAW, *self.pictures, _EXPECTED]
        known = found.prediction.std[np.isfinite(found.prediction.std)]
        mesh: dict[str, Any] = {"nodes": found.mesh.nodes, "elements": found.mesh.elements}
        look: dict[str, Any] = {"ends": colour_range(known) if known.size else (0.0, 1.0), "opacity": 0.8}
        self._expected = Overlay(**mesh, values=found.prediction.std, colours=palette("plasma"), **look)
        expected = f"median uncertainty to expect {np.median(known):.2g} px" if known.size else "no node is measured"
        lines = [f"<b>{html.escape(found.name)}</b>: {expected}"]
        self.parts.message.text = "<br>".join(lines + [f"• {html.escape(finding.text)}" for finding in found.findings])
        if self.parts.picture.value == _EXPECTED:
            self.show()
        else:  # which shows it
            self.parts.picture.value = _EXPECTED

    def _changed(self) -> Draft:
        """Return the draft with the values of all controls."""
        p, end = self.parts, len(self.source.series) - 1
        frames: dict[str, Any] = {"first": int(p.first.value) or None}
        frames["last"] = None if int(p.last.value) == end else int(p.last.value)
        if int(p.reference.value) != self.draft.frames.reference[0]:
            frames["reference"] = [int(p.reference.value)]
        changes: dict[str, dict[str, Any]] = {"frames": frames}
        mesh, size = self.draft.section("mesh"), float(p.size.value)
        if not mesh.get("file") and not (mesh.get("element_size") == "auto" and size == ELEMENT_SIZE):
            changes["mesh"] = {"element_size": size}
        if p.calibration.value:
            changes["calibration"] = {"file": p.calibration.value}
        if region := region_section(self.draft, self.drawing.marks):
            changes["region"] = region
        return self.draft.changed(changes)

    def _reopen(self) -> None:
        """Take the values of the controls, once the frames can be read with them."""
        draft = self._changed()
        other = draft.section("calibration") != self.draft.section("calibration")
        self.draft, self.source = draft, DraftFrames(draft)
        if other:
            self._offer_lights()
            self._remesh()
        self.show()

    def _offer_lights(self) -> None:
        """Offer the lights for masks."""
        self.parts.light.options = list(self.source.lights)
        self.parts.light.value = next(iter(self.source.lights), "")
        self._choose_light()

    def _choose_light(self) -> None:
        """Let masks that are drawn from now on be of the light chosen, each of its own."""
        self.drawing.light = self.parts.light.value
        self.drawing.next_hole()

    def _write(self) -> bool:
        """Write TEST.toml and the masks of the lights, unless files other than what was opened must be confirmed."""
        self.drawing.settle()  # else it takes the place of what is reported here
        check_complete(self.drawing.marks)
        self._reopen()
        draft = self.draft.at(Path(self.parts.file.value))
        draft, pictures = draft.with_masks(self.drawing.marks, self.source.lights, self.source.shape)
        draft.check()
        same = draft.file == self._opened.file
        files = [*pictures, *([] if same and self._opened.is_file else [draft.file])]
        what = f"it{', which has another content than this page read' * same}" if files == [draft.file] else "them"
        if asked := self.confirmation.question(files, what):
            self.parts.message.text = warning(asked)
            return False
        for file, content in pictures.items():
            write_complete(file, methodcaller("write", content))
        draft.write()
        self.draft = self._opened = draft
        written, region = html.escape(", ".join(map(str, (draft.file, *pictures)))), draft.section("region")
        held = [f"a {key}" for key in ("rectangle", "polygon", "mask") if key in region]
        held += [f"{len(region['holes'])} holes"] if "holes" in region else []
        told = f", with {' and '.join(held)} as its region" if held else ""
        self.parts.message.text = f"{written} {'are' if pictures else 'is'} written{told}."
        return True

    def _run(self) -> None:
        if self.runs and self.runs[-1].going:
            self.parts.message.text = "The run still goes on."
        elif self._write():
            self.runs.append(Run(self.draft.file, Path(self.parts.out.value)))

    def _tick(self) -> None:
        if self.runs:
            self.parts.ran.text = self.runs[-1].text()
