"""The time line: what became of each frame of a result that may still grow, and how many nodes it measures."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, Range1d, Span
from bokeh.plotting import figure

from rgbmidic.errors import ResultError
from rgbmidic.results import Result
from rgbmidic.typing import FloatArray
from rgbmidic.view.canvas import small

__all__ = ["NOW", "Course", "TimeLine", "places"]

_AT_ONCE = 100
"""Frames that are looked at before the page is served again: 10 ms."""
_NOT_YET = -1
_DAMAGED = 3
"""Status of a frame whose record cannot be read."""
_FAULTS = {1: "#e69f00", 2: "#d1495b", _DAMAGED: "#d1495b"}
NOW = {"dimension": "height", "level": "overlay", "line_color": "#8e5bd0", "line_width": 2}
"""How the frame in view is marked: over all else, which is not painted again when it moves."""


def places(result: Result) -> npt.NDArray[np.int64]:
    """Where the records of the frames lie, shape (T, 2): a frame that is measured again has another place."""
    return np.stack([result.table.shard, result.table.start], axis=1)


class Course:
    """The ends of the frames, which `advance` fills a part at a time, so that the page answers in between; pages of the
    same result share one.

    Attributes
    ----------
    status : ndarray, shape (T,), int8
        End of each frame, 3 where it is damaged; -1 where it was not looked at, or is not measured yet.
    share : ndarray, shape (T,)
        Part of the nodes that it measures; NaN where not known.
    changes : int
        Times that `advance` found something new.
    """

    def __init__(self, frames: int) -> None:
        self.status: npt.NDArray[np.int8] = np.full(frames, _NOT_YET, dtype=np.int8)
        self.share: FloatArray = np.full(frames, np.nan)
        self.changes = 0
        self._places = np.zeros((frames, 2), dtype=np.int64)

    @property
    def known(self) -> int:
        """Number of frames that were looked at."""
        return int((self.status != _NOT_YET).sum())

    def advance(self, result: Result) -> None:
        """Look at some frames more, and again at those that were measured again."""
        now = places(result)
        stale = (self.status != _NOT_YET) & (now != self._places).any(axis=1)
        self.status[stale], self.share[stale] = _NOT_YET, np.nan
        frames = np.flatnonzero(result.finished & (self.status == _NOT_YET))[:_AT_ONCE]
        self._places[frames] = now[frames]
        self.changes += bool(stale.any() or len(frames))
        for frame in frames.tolist():
            try:
                values = next(result.table.each(["status", "node_status"], [frame]))
            except ResultError:
                values = {"status": _DAMAGED, "node_status": np.ones(1)}
            self.status[frame], self.share[frame] = values["status"], np.mean(values["node_status"] == 0)

    def words(self, finished: int) -> str:
        """How many frames are `finished`, and how they ended."""
        counts = {
            word: int((self.status == code).sum())
            for code, word in ((1, "not converged"), (2, "failed"), (_DAMAGED, "damaged"))
        }
        told = [f"{finished} of {len(self.status)} frames measured"]
        ends = [] if self.known >= finished else [f"{self.known} looked through"]
        return ", ".join(told + ends + [f"{count} {word}" for word, count in counts.items() if count])


class TimeLine:
    """The plot of a course.

    Parameters
    ----------
    frames
        How many there are.
    now
        The one in view at first.

    Attributes
    ----------
    plot, now
        The plot, and the mark of the frame in view on it.
    """

    def __init__(self, frames: int, now: int) -> None:
        self._drawn = -1
        self._shares, self._faults = (
            ColumnDataSource({"x": [], "y": []}),
            ColumnDataSource({"x": [], "colour": []}, name="faults"),
        )
        self.plot = figure(
            sizing_mode="stretch_both",
            x_range=Range1d(-0.5, max(frames - 0.5, 0.5)),
            y_range=Range1d(0, 105),
            y_axis_label="nodes (%)",
            tools=[],
            toolbar_location=None,
            min_border=2,
        )
        self.plot.yaxis.ticker = [0, 50, 100]
        small(self.plot)
        self.plot.varea("x", 0, "y", source=self._shares, fill_color="#6baed6", fill_alpha=0.6)
        self.plot.segment("x", 0, "x", 100, source=self._faults, line_color="colour", line_width=2)
        self.now = Span(location=now, **NOW)
        self.plot.add_layout(self.now)

    def draw(self, course: Course) -> None:
        """Draw what is known, unless it is drawn."""
        if course.changes == self._drawn:
            return
        self._drawn, known = course.changes, np.flatnonzero(np.isfinite(course.share))
        self._shares.data = {"x": known, "y": 100 * course.share[known]}
        bad = [(frame, colour) for code, colour in _FAULTS.items() for frame in np.flatnonzero(course.status == code)]
        self._faults.data = {"x": [int(frame) for frame, _ in bad], "colour": [colour for _, colour in bad]}
