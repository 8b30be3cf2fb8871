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
from bokeh.models import ColumnDataSource

from rgbmidic.disk import write_complete
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.plan import place_mesh, read_region
from rgbmidic.settings import ELEMENT_SIZE, RegionSettings, TestSettings, read_section
from rgbmidic.tools.lab.inspection import Inspection
from rgbmidic.tools.report.painter import OUTSIDE_GREY, Overlay, paint, palette
from rgbmidic.tools.report.style import colour_range
from rgbmidic.tools.view.canvas import Canvas
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.drawing import (
    SHAPES,
    RegionDrawing,
    check_complete,
    marks_of_region,
    region_of,
    region_section,
)
from rgbmidic.tools.view.setup_panel import RAW, DraftFrames, Run, SetupControls, overview, pictures
from rgbmidic.tools.view.test_file_editor import Confirmation, Draft
from rgbmidic.tools.view.widgets import Background, SharedState, call_periodically, run_guarded, script, warning

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
        self._inspected, self._stored_draft = 0, draft
        reference, out = draft.frames.reference[0], runs[-1].out if runs else draft.file.parent / "result"
        self.state = SharedState(name="state", requested_frame=reference, displayed_frame=reference)
        self.controls = SetupControls(draft, len(self.source.series) - 1, out, dark=dark)
        self._reader = Background(document)
        rows, columns = self.source.shape
        self.canvas = Canvas(document, tuple(SHAPES), (-0.5, -0.5, columns - 0.5, rows - 0.5), self.update_picture)
        self._edges, thin = ColumnDataSource({"xs": [], "ys": []}), {"line_width": 0.7, "line_alpha": 0.7}
        self.canvas.plot.multi_line("xs", "ys", source=self._edges, line_color="#ffd166", **thin)
        marks = marks_of_region(draft.section("region"), draft.file.parent)
        self.drawing = RegionDrawing(document, self.canvas, marks, self._remesh)
        self.confirmation = Confirmation()
        self._offer_lights()
        self._listen()

    @property
    def roots(self) -> dict[str, Any]:
        """The parts of the page by the names that its template gives their places."""
        controls = self.controls
        return {
            "head": controls.head,
            "side": controls.left,
            "plot": self.canvas.plot,
            "curves": controls.right,
            "player": controls.player,
        }

    def _listen(self) -> None:
        controls, tools = self.controls, list(self.canvas.tools)
        for model, key in (
            (self.state, "requested_frame"),
            (controls["picture"], "value"),
            (controls["glare"], "active"),
        ):
            model.on_change(key, lambda attr, old, new: self.update_picture())
        controls["size"].on_change("value", lambda attr, old, new: self._remesh())
        controls["light"].on_change("value", lambda attr, old, new: self._choose_light())
        controls["calibration"].on_change("value", lambda attr, old, new: self._run_guarded(self._reopen))
        for button, action in (
            (controls["undo"], partial(self.drawing.step, back=True)),
            (controls["redo"], partial(self.drawing.step, back=False)),
            (controls["next"], self.drawing.next_hole), (controls["clear"], partial(self.drawing.take_marks, ())),
            (controls["inspect"], self._inspect), (controls["write"], self._write), (controls["run"], self._run),
        ):  # fmt: skip
            button.on_click(partial(self._run_guarded, action))
        controls.request_frames(self.state)
        controls["mode"].js_on_change(
            "active", script("choose", group=controls["mode"], tools=tools[:4], other=controls["hole"])
        )
        controls["hole"].js_on_change(
            "active", script("choose", group=controls["hole"], tools=tools[4:], other=controls["mode"])
        )
        self.document.on_event(DocumentReady, lambda event: self._start())
        call_periodically(VIEWER.run_ms, self.document, self._tick, self._report)

    def _start(self) -> None:
        self.canvas.resize()
        self.update_picture()
        self.drawing.draw()

    def _report(self, text: str) -> None:
        self.controls.message.text = warning(text)

    def _run_guarded(self, action: Callable[[], object]) -> None:
        run_guarded(action, self._report)

    def update_picture(self) -> None:
        """Draw the picture."""
        self._run_guarded(self._draw)
        self.state.displayed_frame = self.state.requested_frame

    def _draw(self) -> None:
        index = min(self.state.requested_frame, len(self.source.series) - 1)
        name = html.escape(self.source.series.name(index))
        self.controls.description.text = f"Frame {index} of 0 to {len(self.source.series) - 1}: {name}"
        raw, is_saturated = self.source.read_picture(index)
        picture_name = self.controls["picture"].value
        picture = self.pictures.get(picture_name, raw)
        overlay, window = (
            self._expected if picture_name == _EXPECTED else None,
            self.canvas.window.limited(VIEWER.picture_pixels),
        )
        image = paint(window, picture, overlay, OUTSIDE_GREY[self.dark])
        if self.controls["glare"].active:
            saturated = paint(window, is_saturated.astype(np.uint8) * 255, outside_grey=0)
            image = np.where((saturated & 0xFF) > 64, _GLARE, image)
        self.canvas.show_picture(image)
        title = f"{picture_name} (px)" if overlay else picture_name
        if (
            picture_name != RAW and index != self._inspected
        ):  # what was inspected stays while other frames are looked at
            title += f", of frame {self._inspected}: {self.source.series.name(self._inspected)}"
        self.canvas.set_colour_bar(overlay.colour_range if overlay else (0.0, 1.0), palette("plasma"), title)
        self.canvas.bar.visible = overlay is not None

    def _remesh(self) -> None:
        """Draw the mesh of the region; drop the inspection, of another region, element size or calibration."""
        self._reader.cancel()
        if self._expected is not None:
            self._expected, self.pictures = None, {}
            self.controls["tiles"].text = ""
            self.controls["picture"].value, self.controls["picture"].options = RAW, [RAW]
        self._edges.data = {"xs": [], "ys": []}
        self._run_guarded(self._make_mesh)

    def _make_mesh(self) -> None:
        if (built := self._build_mesh()) is None:
            self.controls.message.text = _HELP
            return
        mesh = built[0]
        self.controls.message.text = f"{len(mesh.nodes)} nodes, {len(mesh.elements)} elements.<br>{_HELP}"
        if len(mesh.elements) <= VIEWER.mesh_edges:
            corners = mesh.nodes[mesh.elements][:, [0, 1, 2, 0]]
            self._edges.data = {"xs": list(corners[..., 0]), "ys": list(corners[..., 1])}

    def _build_mesh(self) -> tuple[Tri3Mesh, Region, float] | None:
        """Make the mesh and region of the run, with the element size: ``mesh.file``, which what is drawn restricts.

        None where there is neither a file nor a region with an element size.
        """
        content, size = region_of(self.drawing.marks), self.controls["size"].value
        if self.draft.section("mesh").get("file"):
            document = {**self.draft.document, "region": content or self.draft.section("region")}
            settings = TestSettings.from_mapping(document, self.draft.file.parent)
            mesh, region, _ = place_mesh(settings, self.source.shape)
            return mesh, region, mesh.size
        if content is None or not size:
            return None
        region = read_region(read_section(RegionSettings, "region", content), self.source.shape)
        return Tri3Mesh.from_region(region, float(size)), region, float(size)

    def _inspect(self) -> None:
        """Inspect the frame in view as `rgbmidic inspect` does, in another thread."""
        self.drawing.settle()  # else it drops the inspection
        if (built := self._build_mesh()) is None:
            self.controls.message.text = "Draw the region and state the size of the elements first."
            return
        self.controls.message.text = "inspecting …"
        index = int(self.controls.frame.value)
        work = partial(self.source.inspect, index, *built[1:])
        self._reader.submit(
            work, lambda read_inspection: self._run_guarded(partial(self._receive, read_inspection, index))
        )

    def _receive(self, read_inspection: Callable[[], Inspection], index: int) -> None:
        inspection, self._inspected = read_inspection(), index
        self.pictures = pictures(inspection, self.source.shape)
        self.controls["tiles"].text = overview(inspection, self.pictures, self.source.read_picture(index)[0])
        self.controls["picture"].options = [RAW, *self.pictures, _EXPECTED]
        finite = inspection.prediction.std[np.isfinite(inspection.prediction.std)]
        mesh: dict[str, Any] = {"nodes": inspection.mesh.nodes, "elements": inspection.mesh.elements}
        look: dict[str, Any] = {"colour_range": colour_range(finite) if finite.size else (0.0, 1.0), "opacity": 0.8}
        self._expected = Overlay(**mesh, values=inspection.prediction.std, colours=palette("plasma"), **look)
        expected = f"median uncertainty to expect {np.median(finite):.2g} px" if finite.size else "no node is measured"
        lines = [f"<b>{html.escape(inspection.name)}</b>: {expected}"]
        self.controls.message.text = "<br>".join(
            lines + [f"• {html.escape(finding.text)}" for finding in inspection.findings]
        )
        if self.controls["picture"].value == _EXPECTED:
            self.update_picture()
        else:  # which shows it
            self.controls["picture"].value = _EXPECTED

    def _edited_draft(self) -> Draft:
        """Return the draft with the values of all controls."""
        controls, last_frame = self.controls, len(self.source.series) - 1
        frames: dict[str, Any] = {"first": int(controls["first"].value) or None}
        frames["last"] = None if int(controls["last"].value) == last_frame else int(controls["last"].value)
        if int(controls["reference"].value) != self.draft.frames.reference[0]:
            frames["reference"] = [int(controls["reference"].value)]
        changes: dict[str, dict[str, Any]] = {"frames": frames}
        mesh, size = self.draft.section("mesh"), float(controls["size"].value)
        if not mesh.get("file") and not (mesh.get("element_size") == "auto" and size == ELEMENT_SIZE):
            changes["mesh"] = {"element_size": size}
        if controls["calibration"].value:
            changes["calibration"] = {"file": controls["calibration"].value}
        if region := region_section(self.draft.section("region"), self.drawing.marks):
            changes["region"] = region
        return self.draft.with_values(changes)

    def _reopen(self) -> None:
        """Take the values of the controls, once the frames can be read with them."""
        draft = self._edited_draft()
        is_recalibrated = draft.section("calibration") != self.draft.section("calibration")
        self.draft, self.source = draft, DraftFrames(draft)
        if is_recalibrated:
            self._offer_lights()
            self._remesh()
        self.update_picture()

    def _offer_lights(self) -> None:
        """Offer the lights for masks."""
        self.controls["light"].options = list(self.source.lights)
        self.controls["light"].value = next(iter(self.source.lights), "")
        self._choose_light()

    def _choose_light(self) -> None:
        """Let masks that are drawn from now on be of the light chosen, each of its own."""
        self.drawing.light = self.controls["light"].value
        self.drawing.next_hole()

    def _write(self) -> bool:
        """Write TEST.toml and the masks of the lights, unless files other than what was opened must be confirmed."""
        self.drawing.settle()  # else it takes the place of what is reported here
        check_complete(self.drawing.marks)
        self._reopen()
        draft = self.draft.with_path(Path(self.controls["file"].value))
        draft, pictures = draft.with_masks(self.drawing.marks, self.source.lights, self.source.shape)
        draft.check()
        is_same_file = draft.file == self._stored_draft.file
        files = [*pictures, *([] if is_same_file and self._stored_draft.is_file else [draft.file])]
        subject = (
            f"it{', which has another content than this page read' * is_same_file}" if files == [draft.file] else "them"
        )
        if question := self.confirmation.question(files, subject):
            self.controls.message.text = warning(question)
            return False
        for file, content in pictures.items():
            write_complete(file, methodcaller("write", content))
        draft.write()
        self.draft = self._stored_draft = draft
        file_names, region = html.escape(", ".join(map(str, (draft.file, *pictures)))), draft.section("region")
        region_parts = [f"a {key}" for key in ("rectangle", "polygon", "mask") if key in region]
        region_parts += [f"{len(region['holes'])} holes"] if "holes" in region else []
        region_note = f", with {' and '.join(region_parts)} as its region" if region_parts else ""
        self.controls.message.text = f"{file_names} {'are' if pictures else 'is'} written{region_note}."
        return True

    def _run(self) -> None:
        if self.runs and self.runs[-1].is_running:
            self.controls.message.text = "The run still goes on."
        elif self._write():
            self.runs.append(Run(self.draft.file, Path(self.controls["out"].value)))

    def _tick(self) -> None:
        if self.runs:
            self.controls["ran"].text = self.runs[-1].text()
