"""Parts of the page that sets a test up: frames, raw and inspected, controls, the run."""

from __future__ import annotations

import base64
import html
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from bokeh.layouts import column

from rgbmidic.errors import ResultError
from rgbmidic.frames.series import open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.mesh import Region
from rgbmidic.results import Result
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.tools.lab.inspection import Inspection, inspect_frame
from rgbmidic.tools.report.page import render
from rgbmidic.tools.report.painter import Picture
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.picture import grey_picture, stretch_to_uint8
from rgbmidic.tools.view.test_file_editor import Draft
from rgbmidic.tools.view.widgets import NOTE, Control, Controls, button, check, choice, count, group, text

RAW = "raw frame"


class DraftFrames:
    """The frames of a test that is being set up.

    Parameters
    ----------
    draft
        The test as far as it is known.

    Attributes
    ----------
    series
        All frames of the source, whatever part of them is chosen.
    calibration
        Calibration of the lights; None where none is stated.
    shape
        Rows and columns of a frame.

    Raises
    ------
    RgbmidicError
        The frames or the calibration cannot be read as the draft states.
    """

    def __init__(self, draft: Draft) -> None:
        file = draft.section("calibration").get("file")
        calibration = Calibration.read(draft.file.parent / file) if isinstance(file, str) else None
        self.series = open_series(draft.frames, draft.file.parent, calibration)
        height, width = self.series.read(0)[0].values.shape[-2:]
        self.shape = height, width
        self.calibration = calibration and calibration.cropped(draft.frames.crop_origin, self.shape)

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights as the calibration has them, else as the run names those of monochrome frames."""
        calibration = self.calibration or Calibration()
        for section in (calibration.crosstalk, calibration.registration):
            if section is not None:
                return tuple(section.lights)
        count = max(self.series.n_lights, len(self.series.lights))
        return ("light",) if count == 1 else tuple(f"light {number + 1}" for number in range(count))

    def read_picture(self, index: int) -> tuple[Picture, npt.NDArray[np.bool_]]:
        """Read a raw frame as a picture (H, W), and where a channel is saturated (H, W)."""
        frame = self.series.read(index)[0]
        saturated = frame.values >= frame.white_level
        return grey_picture(frame), np.asarray(saturated if saturated.ndim == 2 else saturated.any(axis=0))

    def inspect(self, index: int, region: Region, element_size: float) -> Inspection:
        """Inspect a frame before the test, as `inspect_frame` does."""
        options: dict[str, Any] = {"region": region, "element_size": element_size, "name": self.series.name(index)}
        return inspect_frame(self.series.read(index), calibration=self.calibration, **options)


def pictures(inspection: Inspection, shape: tuple[int, int]) -> dict[str, Picture]:
    """Return the separated lights and their reflection index by their names, each a picture of the whole frame."""
    images, (column, row) = inspection.images, map(int, inspection.origin)
    images_by_name = {
        f"light: {name}": stretch_to_uint8(values) for name, values in zip(images.names, images.values, strict=True)
    }
    if inspection.reflection_index is not None:
        for name, index in zip(images.names, inspection.reflection_index, strict=True):
            images_by_name[f"reflection index: {name}"] = np.asarray(
                255 * np.clip(np.nan_to_num(index), 0, 1), dtype=np.uint8
            )
    height, width = images.values.shape[1:]
    padding = (row, shape[0] - row - height), (column, shape[1] - column - width)
    return {name: np.pad(image, padding) for name, image in images_by_name.items()}


def overview(inspection: Inspection, pictures_by_name: Mapping[str, Picture], raw: Picture) -> str:
    """Return small pictures in rows, as HTML: the raw frame and the separated lights, their reflection index."""
    tiles = []
    for name, picture in ((RAW, raw), *pictures_by_name.items()):
        height, width = picture.shape
        size = (VIEWER.tile_columns, max(1, round(VIEWER.tile_columns * height / width)))
        png = cv2.imencode(".png", cv2.resize(picture, size, interpolation=cv2.INTER_AREA))[1]
        tiles.append((name.replace("reflection index", "index"), base64.b64encode(png.tobytes()).decode()))
    return render("tiles.html", Path(__file__).parent, across=1 + len(inspection.images.names), tiles=tiles)


_LEFT: Sequence[Mapping[str, Control]] = (
    {"picture": choice("Picture", [RAW])}, {"glare": check("mark saturated samples", active=True)},
    {"mode": group("shape that a click begins", ["Move", "Rectangle", "Polygon", "Circle"])},
    {"hole": group("what is left out", ["Hole", "Round hole", "Lamp mask"], active=None)},
    {"undo": button("Undo"), "redo": button("Redo"), "next": button("Next"), "clear": button("Clear")},
    {"light": choice("Masks are of"), "size": count("Element size (px)", low=4)},
    {"reference": count("Reference", low=0), "first": count("First", low=0), "last": count("Last", low=0)},
    {"calibration": text("Calibration file")}, {"inspect": button("Inspect")},
)  # fmt: skip
_RIGHT: Sequence[Mapping[str, Control]] = (
    {"message": NOTE}, {"file": text("Write to")}, {"write": button("Write TEST.toml")}, {"out": text("Result folder")},
    {"run": button("Run", button_type="primary")}, {"ran": NOTE}, {"tiles": NOTE},
)  # fmt: skip
"""Controls left and right of the frame, in rows."""


class SetupControls(Controls):
    """Controls of the page that sets a test up.

    Parameters
    ----------
    draft
        The test as far as it is known.
    last_index
        Index of the last frame of the source.
    out
        Folder of the result.
    dark
        Whether the page is dark.

    Attributes
    ----------
    left, right
        The columns beside the frame.
    """

    def __init__(self, draft: Draft, last_index: int, out: Path, *, dark: bool) -> None:
        frames, size = draft.frames, draft.section("mesh").get("element_size", "auto")
        super().__init__([*_LEFT, *_RIGHT], last_index, frames.reference[0], dark=dark)
        self.head.text = f"<b>{html.escape(str(draft.file))}</b> &nbsp; a test to set up"
        final_frame = last_index if frames.last is None else frames.last
        for name, value in {
            "size": ELEMENT_SIZE if size == "auto" else size, "reference": frames.reference[0],
            "first": frames.first, "last": final_frame, "file": str(draft.file), "out": str(out),
            "calibration": str(draft.section("calibration").get("file", "")),
        }.items():  # fmt: skip
            self[name].value = value
        for name in ("reference", "first", "last"):
            self[name].high = last_index
        if (n_frames := len(frames.reference)) > 1:  # the control has the first of them; another value is one frame

            def update_title(_name: str, _old: object, number: float) -> None:
                is_stated = number == frames.reference[0]
                self["reference"].title = f"Reference, {n_frames} from" if is_stated else "Reference"

            self["reference"].on_change("value", update_title)
            update_title("value", None, frames.reference[0])
        flat = {"sizing_mode": "stretch_width"}
        self.left = column(self.description, *self.lines(_LEFT), self.theme, **flat)
        self.right = column(*self.lines(_RIGHT), **flat)


class Run:
    """``rgbmidic run TEST.toml --out DIR``, going on or at its end; it checks its input and reports errors itself.

    Parameters
    ----------
    test
        The TEST.toml.
    out
        Folder of the result.
    """

    def __init__(self, test: Path, out: Path) -> None:
        self.out, self._output = out, tempfile.TemporaryFile()  # noqa: SIM115 it lives as long as the run
        command = [sys.executable, "-P", "-m", "rgbmidic.cli.app", "run", str(test), "--out", str(out), "--no-figures"]
        output = self._output
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)

    @property
    def is_running(self) -> bool:
        """True while the run goes on."""
        return self._process.poll() is None

    def text(self) -> str:
        """Return how many frames are measured, with a link to them, or how the run ended, as HTML."""
        is_running, progress, link = self.is_running, "preparing the reference", ""
        with suppress(ResultError):
            result = Result.open(self.out, partial=True, check=False)
            progress = f"{int(result.finished.sum())} of {len(result)} frames measured"
            link = '<br><a id="result" href="result">look at the result as it grows</a>'
        if is_running or not self._process.returncode:
            return f"{'running' if is_running else 'ended'}: {progress}{link}"
        self._output.seek(0)
        lines = [line for line in self._output.read().decode("utf-8", "replace").splitlines() if line.strip()]
        errors = [line for line in lines if line.startswith("error: ")]
        return html.escape(f"failed: {[*errors, *lines[-1:], 'it printed nothing'][0]}") + link
