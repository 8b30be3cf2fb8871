"""The time line of the frames of a result: their status, and how many of their nodes are measured."""

from __future__ import annotations

import bokeh.models as bk
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError
from rgbmidic.results import Result
from rgbmidic.tools.report.style import OKABE_ITO
from rgbmidic.tools.view.canvas import columns, plain_plot
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.typing import FloatArray

_NOT_YET, _DAMAGED = -1, 3
"""Status of a frame that was not read yet, and of one whose record cannot be read, beside those of the field table."""
_FAULTS = {1: OKABE_ITO["orange"], 2: "#d1495b", _DAMAGED: "#d1495b"}
FRAME_MARK_STYLE = {"dimension": "height", "level": "overlay", "line_color": "#8e5bd0", "line_width": 2}
"""Mark of the frame in view: over all else, which is not painted again when it moves."""


class FrameProgress:
    """Status of the frames of a result that may still grow; pages of one result share it.

    `advance` reads a part of the frames at a time, so that the page is served in between.

    Parameters
    ----------
    frames
        Number of frames.

    Attributes
    ----------
    status : ndarray, shape (T,), int8
        Status of each frame, 3 where it is damaged; -1 where it was not read, or is not measured yet.
    fraction : ndarray, shape (T,)
        Fraction of the nodes that are measured; NaN where not known.
    changes : int
        Times that `advance` found something new.
    """

    def __init__(self, frames: int) -> None:
        self.status: npt.NDArray[np.int8] = np.full(frames, _NOT_YET, dtype=np.int8)
        self.fraction: FloatArray = np.full(frames, np.nan)
        self.changes = 0
        self._write_times = np.zeros(frames, dtype=np.int64)

    @property
    def n_frames_read(self) -> int:
        """Number of frames that were read."""
        return int((self.status != _NOT_YET).sum())

    def advance(self, result: Result) -> None:
        """Read some frames more, and again those that were measured again."""
        write_times = result.table.write_times
        is_stale = (self.status != _NOT_YET) & (write_times != self._write_times)
        self.status[is_stale], self.fraction[is_stale] = _NOT_YET, np.nan
        frames = np.flatnonzero(result.finished & (self.status == _NOT_YET))[: VIEWER.frames_at_once]
        self._write_times[frames] = write_times[frames]
        self.changes += bool(is_stale.any() or len(frames))
        for frame in frames.tolist():
            try:
                values = result.table.read(frame, ["status", "node_status"])
            except ResultError:
                values = {"status": _DAMAGED, "node_status": np.ones(1)}
            self.status[frame], self.fraction[frame] = values["status"], np.mean(values["node_status"] == 0)

    def summary(self, finished: int) -> str:
        """State how many frames are `finished`, and how they ended."""
        texts = [f"{finished} of {len(self.status)} frames measured"]
        texts += [] if self.n_frames_read >= finished else [f"{self.n_frames_read} looked through"]
        for code, outcome in ((1, "not converged"), (2, "failed"), (_DAMAGED, "damaged")):
            if count := int((self.status == code).sum()):
                texts.append(f"{count} {outcome}")
        return ", ".join(texts)


class TimeLine:
    """Plot of the status of the frames and of the nodes that they measure.

    Parameters
    ----------
    frames
        Number of frames.
    frame
        Index of the frame in view at first.

    Attributes
    ----------
    plot, frame_mark
        The plot, and the mark of the frame in view on it.
    """

    def __init__(self, frames: int, frame: int) -> None:
        self._drawn_changes = -1
        self._fractions = bk.ColumnDataSource(columns("x y"))
        self._faults = bk.ColumnDataSource(columns("x colour"), name="faults")
        ranges = {"x_range": bk.Range1d(-0.5, max(frames - 0.5, 0.5)), "y_range": bk.Range1d(0, 105)}
        self.plot = plain_plot(x_axis_label="frame", y_axis_label="nodes (%)", min_border=2, **ranges)
        self.plot.yaxis.ticker, self.plot.xaxis.ticker = [0, 50, 100], bk.BasicTicker(min_interval=1)
        self.plot.yaxis.axis_label_text_font_size = "10px"
        self.plot.varea("x", 0, "y", source=self._fractions, fill_color="#6baed6", fill_alpha=0.6)
        self.plot.segment("x", 0, "x", 100, source=self._faults, line_color="colour", line_width=2)
        self.frame_mark = bk.Span(location=frame, **FRAME_MARK_STYLE)
        self.plot.add_layout(self.frame_mark)

    def draw(self, progress: FrameProgress) -> None:
        """Draw the status of the frames, unless it has not changed."""
        if progress.changes == self._drawn_changes:
            return
        self._drawn_changes, finite_frames = progress.changes, np.flatnonzero(np.isfinite(progress.fraction))
        self._fractions.data = {"x": finite_frames, "y": 100 * progress.fraction[finite_frames]}
        faults = [
            (frame, colour) for code, colour in _FAULTS.items() for frame in np.flatnonzero(progress.status == code)
        ]
        self._faults.data = columns("x colour", [(int(frame), colour) for frame, colour in faults])
