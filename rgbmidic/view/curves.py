"""Curves over time: the marks that were set on the field, read off as `rgbmidic history` reads probes.

The time line: what became of each frame of a result that may still grow, and how many nodes it measures.

The panel of a result's page that shows curves over time, read off all frames beside the page.
"""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from bokeh.document import Document
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    Div,
    HoverTool,
    PanTool,
    Range1d,
    ResetTool,
    Select,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure

from rgbmidic.errors import ResultError
from rgbmidic.report.style import time_unit
from rgbmidic.results import Histories, HistoryColumn, Result, probes_of
from rgbmidic.results.histories import history_csv, read_histories
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import FloatArray
from rgbmidic.view import curves
from rgbmidic.view.address import KINDS, Mark
from rgbmidic.view.canvas import small

__all__ = ["NOW", "Course", "CurvePanel", "TimeLine", "as_csv", "band", "groups", "over", "places", "probes", "read"]


def probes(marks: Sequence[Mark], gauge: float, stated: ProbeSettings) -> ProbeSettings:
    """The probes that marks make: each kind in the order set; strain gauges of length `gauge`, px; a last one without
    its pair waits for it. Strain measure and window are those `stated`."""
    places: dict[str, list[tuple[float, ...]]] = {}
    for kind, count in KINDS.items():
        own = [(mark.x, mark.y) for mark in marks if mark.kind == kind]
        whole = [tuple(np.ravel(own[i : i + count]).tolist()) for i in range(0, len(own) - count + 1, count)]
        places[f"{kind}s"] = [(*place, gauge) for place in whole] if kind == "strain_gauge" else whole
    made: dict[str, Any] = {key: tuple(value) for key, value in places.items()}
    return ProbeSettings(measure=stated.measure, window=stated.window, **made)


def read(result: Result, marks: Sequence[Mark], gauge: float) -> Histories | None:
    """What the marks read off a result over its frames; None where they make no probe. Errors as `read_histories`."""
    made = probes(marks, gauge, probes_of(result))
    return read_histories(result, made) if made.places else None


def groups(histories: Histories) -> dict[str, list[HistoryColumn]]:
    """What can be shown together: the same quantity of all probes, by its name and unit."""
    found: dict[str, list[HistoryColumn]] = {}
    for told in histories.quantities:
        if told.name.endswith(("_before", "_after")):  # single frames, no curve
            continue
        kind = next(kind for kind in sorted(KINDS, key=len, reverse=True) if told.name.startswith(f"{kind}_"))
        name = told.name.removeprefix(f"{kind}_").partition("_")[2]
        found.setdefault(f"{name} ({told.unit})" if told.unit else name, []).append(told)
    return found


def over(histories: Histories) -> tuple[FloatArray, str]:
    """What the curves go over, and its name: the time, or frames where none is known."""
    if histories.times is None:
        return histories.frames.astype(np.float64), "frame"
    factor, unit = time_unit(histories.times)
    return factor * histories.times, f"time ({unit})"


def band(x: FloatArray, told: HistoryColumn) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outlines of two standard uncertainties on both sides, one for each stretch of frames without a gap."""
    if told.std is None:
        return [], []
    known = np.isfinite(told.values) & np.isfinite(told.std)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    xs, ys = [], []
    for start, stop in edges.reshape(-1, 2):
        middle, reach = told.values[start:stop], 2 * told.std[start:stop]
        xs.append(np.concatenate([x[start:stop], x[start:stop][::-1]]))
        ys.append(np.concatenate([middle - reach, (middle + reach)[::-1]]))
    return xs, ys


def as_csv(histories: Histories) -> str:
    """The file that `rgbmidic history` writes."""
    file = io.BytesIO()
    history_csv(histories, file)
    return file.getvalue().decode("utf-8")


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


_PLAIN = "#888888"


class CurvePanel:
    """The plot of the curves, which one is shown, and what is to say about them.

    Parameters
    ----------
    document
        Of the page.
    chosen
        Name of the curve that is shown first.
    select, told
        Where the curve is chosen, and where remarks go.
    hint
        What is said while there is nothing to say.

    Attributes
    ----------
    histories
        What was read off last.
    reading
        Whether they are being read anew: they are those of before until then.
    """

    def __init__(self, document: Document, *, chosen: str, select: Select, told: Div, hint: str) -> None:
        self.histories: Histories | None = None
        self.reading = False
        self.colours: Mapping[str, str] = {}
        self._document, self._select, self._told, self._hint, self._chosen = document, select, told, hint, chosen
        self._reader, self._number, self._task = ThreadPoolExecutor(1), 0, Future[Histories | None]()
        self.plot, self._lines, self._bands = _plot()
        self.now = Span(**NOW)
        self.plot.add_layout(self.now)
        select.on_change("value", lambda attr, old, new: self.draw())
        document.on_session_destroyed(lambda context: self._reader.shutdown(wait=False, cancel_futures=True))

    def read(self, result: Result, marks: Sequence[Mark], gauge: float, shown: Callable[[], None]) -> None:
        """Read marks off all frames beside the page, then call `shown`; only the last request counts."""
        self._number += 1
        self._task.cancel()
        self.reading = bool(marks)
        if not marks:
            self._have(self._number, None, shown)
            return
        self._told.text = "reading all frames …"
        self._task = self._reader.submit(curves.read, result, tuple(marks), gauge)
        done = partial(self._have, self._number, self._task, shown)
        self._task.add_done_callback(lambda _: self._document.add_next_tick_callback(done))

    def _have(self, number: int, task: Future[Histories | None] | None, shown: Callable[[], None]) -> None:
        if number != self._number:
            return
        self.reading = False
        before = self._probes
        try:
            self.histories = None if task is None else task.result()
            remarks = () if self.histories is None else self.histories.remarks
            self._told.text = "<br>".join(map(html.escape, remarks)) or self._hint
        except Exception as error:  # a probe outside the region and the like: told where the probes are
            self.histories = None
            self._told.text = f'<span style="color:var(--warn)">{html.escape(str(error))}</span>'
        groups = {} if self.histories is None else curves.groups(self.histories)
        self._select.options = list(groups)
        # the chosen quantity stays unless a new probe does not tell it
        wanted = [name for name, own in groups.items() if {_probe(told.name) for told in own} - before] or list(groups)
        current = self._select.value or self._chosen
        self._select.value = current if current in wanted or not wanted else wanted[0]
        self.draw()
        shown()

    @property
    def _probes(self) -> set[str]:
        """Names of what is read off."""
        return set() if self.histories is None else {_probe(told.name) for told in self.histories.quantities}

    def draw(self) -> None:
        """Draw the chosen curve of all probes."""
        if self.histories is None:
            self._bands.data, self._lines.data = _columns([], "xs ys colour"), _columns([], "xs ys colour name")
            self.plot.legend.visible = False
            self.plot.xaxis.axis_label = self.plot.yaxis.axis_label = None
            return
        own = curves.groups(self.histories).get(self._select.value, [])
        x, axis = curves.over(self.histories)
        colours = [self.colours.get(_probe(told.name), _PLAIN) for told in own]
        bands = [
            (xs, ys, colour)
            for told, colour in zip(own, colours, strict=True)
            for xs, ys in zip(*curves.band(x, told), strict=True)
        ]
        lines = [(x, told.values, c, told.name.replace("_", " ")) for told, c in zip(own, colours, strict=True)]
        self._bands.data, self._lines.data = _columns(bands, "xs ys colour"), _columns(lines, "xs ys colour name")
        self.plot.xaxis.axis_label, self.plot.yaxis.axis_label = axis, self._select.value
        self.plot.legend.visible = True

    def point(self, frame: int) -> None:
        """Point at a frame, where the curves hold it."""
        self.now.location = None
        if self.histories is not None and len(at := np.flatnonzero(self.histories.frames == frame)):
            self.now.location = float(curves.over(self.histories)[0][at[0]])

    def frame(self, x: float) -> int:
        """The frame at a place of the axis."""
        if self.histories is None:
            return 0
        return int(self.histories.frames[int(np.abs(curves.over(self.histories)[0] - x).argmin())])


def _columns(rows: Sequence[Sequence[Any]], names: str) -> dict[str, list[Any]]:
    return {name: [row[place] for row in rows] for place, name in enumerate(names.split())}


def _probe(name: str) -> str:
    """``"point_1"`` of ``"point_1_u"``, ``"strain_gauge_2"`` of ``"strain_gauge_2_e1"``."""
    parts = name.split("_")
    return "_".join(parts[: next(place for place, part in enumerate(parts) if part.isdecimal()) + 1])


def _plot() -> tuple[Any, ColumnDataSource, ColumnDataSource]:
    wheel, hover = WheelZoomTool(visible=False), HoverTool(visible=False)
    plot = figure(
        sizing_mode="stretch_both",
        min_border=4,
        tools=[PanTool(), wheel, BoxZoomTool(), ResetTool(), hover],
        title="Curves",
        toolbar_location="above",
    )
    plot.toolbar.logo, plot.toolbar.active_scroll = None, wheel
    small(plot)
    lines = ColumnDataSource(_columns([], "xs ys colour name"), name="lines")
    bands = ColumnDataSource(_columns([], "xs ys colour"), name="bands")
    plot.patches("xs", "ys", source=bands, fill_color="colour", fill_alpha=0.25, line_alpha=0)
    drawn = plot.multi_line("xs", "ys", source=lines, line_color="colour", line_width=1.5, legend_field="name")
    plot.x_range.renderers = plot.y_range.renderers = [drawn]  # the values rule, not the widest band
    hover.renderers, hover.tooltips = [drawn], [("", "@name"), ("at", "$snap_x"), ("value", "$snap_y")]
    plot.legend.visible, plot.legend.label_text_font_size, plot.legend.ncols = False, "11px", 2
    plot.add_layout(plot.legend[0], "below")
    return plot, lines, bands
