"""What a page that sets a test up shows of its frames: raw, and as `rgbmidic inspect` separates and judges them.

The controls of the page that sets a test up.

A run that a page has started: the command line's own, in a process beside the server.
"""

from __future__ import annotations

import html
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
import numpy.typing as npt
from bokeh.layouts import column, row
from bokeh.models import Button, Checkbox, Div, RadioButtonGroup, Select, Slider, Spinner, TextInput, Toggle

from rgbmidic.errors import ResultError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.lab.inspection import Inspection, inspect_frame
from rgbmidic.mesh import Region
from rgbmidic.results import Result
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import FloatImage
from rgbmidic.view.draft import Draft
from rgbmidic.view.models import sheet, theme_button
from rgbmidic.view.picture import grey_picture

__all__ = ["RAW", "Footage", "Run", "SetupControls", "inspected", "pictures", "setup_controls", "side_by_side"]

RAW = "raw frame"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Footage:
    """The frames of a test that is being set up.

    Attributes
    ----------
    series
        All frames of the source, whatever part of them is chosen.
    calibration
        As far as it is known.
    shape
        Rows and columns.
    """

    series: FrameSeries
    calibration: Calibration | None
    shape: tuple[int, int]

    @classmethod
    def of(cls, draft: Draft) -> Footage:
        """The frames that a draft names.

        Raises
        ------
        RgbmidicError
            They, or the calibration, cannot be read as the draft says.
        """
        file = draft.section("calibration").get("file")
        calibration = Calibration.read(draft.file.parent / file) if isinstance(file, str) else None
        series = open_series(draft.frames, draft.file.parent, calibration)
        first = series.read(0)[0]
        shape = first.values.shape[-2], first.values.shape[-1]
        if calibration is not None:
            calibration = calibration.cropped(draft.frames.crop_origin, shape)
        return cls(series=series, calibration=calibration, shape=shape)

    def raw(self, index: int) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """A raw frame as a picture (H, W), and where it is saturated; errors as `FrameSeries.read`."""
        frame = self.series.read(index)[0]
        return grey_picture(frame), saturated(frame)


def saturated(frame: Mosaic | ChannelFrame) -> npt.NDArray[np.bool_]:
    """Where a raw frame is saturated in some channel, (H, W)."""
    full = frame.values >= frame.white_level
    return np.asarray(full if full.ndim == 2 else full.any(axis=0))


def inspected(footage: Footage, index: int, region: Region, element_size: float) -> Inspection:
    """What a frame tells before the test; errors as `inspect_frame`."""
    calibration = footage.calibration
    name, frame = footage.series.name(index), footage.series.read(index)
    return inspect_frame(frame, calibration=calibration, region=region, element_size=element_size, name=name)


def pictures(inspection: Inspection, shape: tuple[int, int]) -> dict[str, npt.NDArray[np.uint8]]:
    """The separated lights and their reflection index by their names, each a picture of the whole frame."""
    images = inspection.images
    found = {f"light: {name}": _stretched(values) for name, values in zip(images.names, images.values, strict=True)}
    if inspection.reflection_index is not None:
        for name, index in zip(images.names, inspection.reflection_index, strict=True):
            found[f"reflection index: {name}"] = np.asarray(255 * np.clip(np.nan_to_num(index), 0, 1), dtype=np.uint8)
    return {name: _placed(picture, inspection.origin, shape) for name, picture in found.items()}


def side_by_side(
    inspection: Inspection, named: dict[str, npt.NDArray[np.uint8]], raw: npt.NDArray[np.uint8]
) -> list[dict[str, npt.NDArray[np.uint8]]]:
    """Rows of pictures: the raw frame and the separated lights, their reflection index."""
    lights = len(inspection.images.names)
    pairs = [(RAW, raw), *((name.replace("reflection index", "index"), picture) for name, picture in named.items())]
    return [dict(row) for row in (pairs[: lights + 1], pairs[lights + 1 :]) if row]


def _stretched(values: FloatImage) -> npt.NDArray[np.uint8]:
    low, high = np.nanpercentile(values, [1, 99]) if np.isfinite(values).any() else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(values) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)


def _placed(picture: npt.NDArray[np.uint8], origin: tuple[int, int], shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    whole = np.zeros(shape, dtype=np.uint8)
    x, y = (int(value) for value in origin)
    whole[y : y + picture.shape[0], x : x + picture.shape[1]] = picture
    return whole


@dataclass(frozen=True, slots=True, kw_only=True)
class SetupControls:
    """What is set beside the frame, and the words."""

    head: Div
    words: Div
    picture: Select
    glare: Checkbox
    mode: RadioButtonGroup
    hole: RadioButtonGroup
    undo: Button
    next: Button
    clear: Button
    size: Spinner
    reference: Spinner
    first: Spinner
    last: Spinner
    calibration: TextInput
    inspect: Button
    theme: Button
    told: Div
    file: TextInput
    write: Button
    out: TextInput
    go: Button
    ran: Div
    frame: Slider
    step: Spinner
    play: Toggle

    @property
    def side(self) -> Any:
        """The column left of the frame."""
        wide = partial(row, sizing_mode="stretch_width")
        buttons, numbers = wide(self.undo, self.next, self.clear), wide(self.reference, self.first, self.last)
        parts = (self.words, self.picture, self.glare, self.mode, self.hole, buttons, self.size, numbers)
        return column(*parts, self.calibration, self.inspect, self.theme, sizing_mode="stretch_width")

    @property
    def player(self) -> Any:
        """The row under the frame."""
        return row(self.play, self.step, self.frame, sizing_mode="stretch_width")


def setup_controls(draft: Draft, last: int, out: Path, *, dark: bool) -> SetupControls:
    """The controls as a draft of frames 0 to `last` says, whose result goes to `out`."""
    sheets, frames = [sheet(dark=dark)], draft.frames
    wide: dict[str, Any] = {"stylesheets": sheets, "sizing_mode": "stretch_width"}
    number: dict[str, Any] = {"low": 0, "high": last, "step": 1, **wide}
    reference, end, most = frames.reference[0], last if frames.last is None else frames.last, max(last, 1)
    size = draft.section("mesh").get("element_size", ELEMENT_SIZE)
    calibration = str(draft.section("calibration").get("file", ""))
    return SetupControls(
        head=Div(text=f"<b>{html.escape(str(draft.file))}</b> &nbsp; a test to set up", **wide),
        words=Div(name="words", **wide),
        picture=Select(title="Picture", name="picture", options=[RAW], value=RAW, **wide),
        glare=Checkbox(label="mark saturated samples", active=True, stylesheets=sheets),
        mode=RadioButtonGroup(labels=["Move", "Rectangle", "Polygon", "Circle"], active=0, name="mode", **wide),
        hole=RadioButtonGroup(labels=["Hole", "Round hole"], active=None, name="hole", **wide),
        undo=Button(label="Undo", **wide),
        next=Button(label="Next hole", **wide),
        clear=Button(label="Clear", **wide),
        size=Spinner(title="Element size (px)", name="size", low=4, value=size, step=1, **wide),
        reference=Spinner(title="Reference", name="reference", value=reference, **number),
        first=Spinner(title="First", name="first", value=frames.first, **number),
        last=Spinner(title="Last", name="last", value=end, **number),
        calibration=TextInput(title="Calibration file", name="calibration", value=calibration, **wide),
        inspect=Button(label="Inspect", **wide),
        theme=theme_button(dark=dark, **wide),
        told=Div(name="told", **wide),
        file=TextInput(title="Write to", name="file", value=str(draft.file), **wide),
        write=Button(label="Write TEST.toml", **wide),
        out=TextInput(title="Result folder", name="out", value=str(out), **wide),
        go=Button(label="Run", button_type="primary", **wide),
        ran=Div(name="ran", **wide),
        frame=Slider(title="Frame", name="frame", start=0, end=most, value=reference, disabled=last < 1, **wide),
        step=Spinner(name="step", low=1, high=most, value=1, width=70, stylesheets=sheets),
        play=Toggle(label="▶ Play", name="play", width=90, stylesheets=sheets),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """``rgbmidic run TEST.toml --out DIR``, going on or at its end.

    Attributes
    ----------
    out
        The result's folder.
    process
        The command.
    said
        What it writes for people.
    """

    out: Path
    process: subprocess.Popen[bytes]
    said: IO[bytes]

    @classmethod
    def start(cls, test: Path, out: Path) -> Self:
        """Start it; whatever is wrong with its input it says itself."""
        said = tempfile.TemporaryFile()  # noqa: SIM115 it lives as long as the run
        command = [sys.executable, "-m", "rgbmidic.cli", "run", str(test), "--out", str(out), "--no-figures"]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)
        return cls(out=out, process=process, said=said)

    @property
    def going(self) -> bool:
        """Whether it goes on."""
        return self.process.poll() is None

    def words(self) -> str:
        """How far it has come, or how it ended."""
        try:
            result = Result.open(self.out, partial=True, check=False)
            far = f"{int(result.finished.sum())} of {len(result)} frames measured"
        except ResultError:
            far = "preparing the reference"
        if self.going:
            return f"running: {far}"
        return f"ended: {far}" if not self.process.returncode else f"failed: {self._last_line()}"

    @property
    def begun(self) -> bool:
        """Whether there is a result to look at."""
        try:
            Result.open(self.out, partial=True, check=False)
        except ResultError:
            return False
        return True

    def _last_line(self) -> str:
        self.said.seek(0)
        lines = [line for line in self.said.read().decode("utf-8", "replace").splitlines() if line.strip()]
        return next((line for line in lines if line.startswith("error: ")), lines[-1] if lines else "no word of it")
