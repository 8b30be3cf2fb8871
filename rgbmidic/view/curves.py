"""Curves over time, read off marks as `rgbmidic history` reads probes, and the time line of the frames."""

from __future__ import annotations

import html
import io
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import bokeh.models as bk
import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic.errors import ResultError
from rgbmidic.report.style import OKABE_ITO, time_axis
from rgbmidic.results import Histories, HistoryColumn, Result, probes_of
from rgbmidic.results.histories import history_csv, read_histories
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, Mark, probe_marks, probe_place
from rgbmidic.view.canvas import columns, plain_plot
from rgbmidic.view.fields import Background

__all__ = ["CurvePanel", "Progress", "TimeLine", "as_csv", "band", "groups", "places", "probes", "read"]


def probes(marks: Sequence[Mark], gauge: float, stated: ProbeSettings, measure: Any = None) -> ProbeSettings:
    """Return the probes that marks make, each kind in the order set; a last mark without its pair waits for it.

    Strain gauges have the length `gauge` (px); window and, unless it is chosen, strain measure are those `stated`.
    """
    places: dict[str, Any] = {f"{kind}s": () for kind in KINDS}
    for pair in probe_marks(marks).values():
        places[f"{pair[0].kind}s"] += (probe_place(pair, gauge),)
    return ProbeSettings(measure=measure or stated.measure, window=stated.window, **places)


def read(result: Result, marks: Sequence[Mark], gauge: float, measure: str | None = None) -> Histories | None:
    """Read the probes that marks make off a result, as `read_histories`; None where they make none."""
    made = probes(marks, gauge, probes_of(result), measure)
    return read_histories(result, made) if made.places else None


def groups(histories: Histories) -> dict[str, list[HistoryColumn]]:
    """Group the same quantity of all probes, by its name and unit."""
    found: dict[str, list[HistoryColumn]] = {}
    for quantity in histories.quantities:
        if quantity.name.endswith(("_before", "_after")):  # single frames, no curve
            continue
        name = quantity.name.removeprefix(f"{_probe(quantity.name)}_")
        found.setdefault(f"{name} ({quantity.unit})" if quantity.unit else name, []).append(quantity)
    return found


def band(x: FloatArray, quantity: HistoryColumn) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outline two standard uncertainties on both sides, for each stretch of frames without a gap: their x and y."""
    if quantity.std is None:
        return [], []
    known = np.isfinite(quantity.values) & np.isfinite(quantity.std)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    xs, ys = [], []
    for start, stop in edges.reshape(-1, 2):
        middle, reach = quantity.values[start:stop], 2 * quantity.std[start:stop]
        xs.append(np.concatenate([x[start:stop], x[start:stop][::-1]]))
        ys.append(np.concatenate([middle - reach, (middle + reach)[::-1]]))
    return xs, ys


def as_csv(histories: Histories) -> str:
    """Return the text of the file that `rgbmidic history` writes."""
    file = io.BytesIO()
    history_csv(histories, file)
    return file.getvalue().decode("utf-8")


def _probe(name: str) -> str:
    """Return ``"point_1"`` of ``"point_1_u"``, ``"strain_gauge_2"`` of ``"strain_gauge_2_e1"``."""
    parts = name.split("_")
    return "_".join(parts[: next(place for place, part in enumerate(parts) if part.isdecimal()) + 1])


_LINES, _BANDS = "xs ys colour name", "xs ys colour"
_AT_ONCE = 100
"""Frames that are read before the page is served again. Measured: 10 ms."""
_NOT_YET, _DAMAGED = -1, 3
"""Status of a frame that was not read yet, and of one whose record cannot be read, beside those of the field table."""
_FAULTS = {1: OKABE_ITO["orange"], 2: "#d1495b", _DAMAGED: "#d1495b"}
NOW = {"dimension": "height", "level": "overlay", "line_color": "#8e5bd0", "line_width": 2}
"""Mark of the frame in view: over all else, which is not painted again when it moves."""


def places(result: Result) -> npt.NDArray[np.int64]:
    """Return the places of the frames' records, shape (T, 2): a frame that is measured again has another place."""
    return np.stack([result.table.places[name] for name in ("shard", "start")], axis=1)


class Progress:
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
        self._places = np.zeros((frames, 2), dtype=np.int64)

    @property
    def known(self) -> int:
        """Number of frames that were read."""
        return int((self.status != _NOT_YET).sum())

    def advance(self, result: Result) -> None:
        """Read some frames more, and again those that were measured again."""
        now = places(result)
        stale = (self.status != _NOT_YET) & (now != self._places).any(axis=1)
        self.status[stale], self.fraction[stale] = _NOT_YET, np.nan
        frames = np.flatnonzero(result.finished & (self.status == _NOT_YET))[:_AT_ONCE]
        self._places[frames] = now[frames]
        self.changes += bool(stale.any() or len(frames))
        for frame in frames.tolist():
            try:
                values = next(result.table.each(["status", "node_status"], [frame]))
            except ResultError:
                values = {"status": _DAMAGED, "node_status": np.ones(1)}
            self.status[frame], self.fraction[frame] = values["status"], np.mean(values["node_status"] == 0)

    def summary(self, finished: int) -> str:
        """State how many frames are `finished`, and how they ended."""
        texts = [f"{finished} of {len(self.status)} frames measured"]
        texts += [] if self.known >= finished else [f"{self.known} looked through"]
        for code, ended in ((1, "not converged"), (2, "failed"), (_DAMAGED, "damaged")):
            if count := int((self.status == code).sum()):
                texts.append(f"{count} {ended}")
        return ", ".join(texts)


class TimeLine:
    """Plot of the status of the frames and of the nodes that they measure.

    Parameters
    ----------
    frames
        Number of frames.
    now
        Index of the frame in view at first.

    Attributes
    ----------
    plot, now
        The plot, and the mark of the frame in view on it.
    """

    def __init__(self, frames: int, now: int) -> None:
        self._drawn = -1
        self._fractions = bk.ColumnDataSource(columns("x y"))
        self._faults = bk.ColumnDataSource(columns("x colour"), name="faults")
        ranges = {"x_range": bk.Range1d(-0.5, max(frames - 0.5, 0.5)), "y_range": bk.Range1d(0, 105)}
        self.plot = plain_plot(y_axis_label="nodes (%)", min_border=2, **ranges)
        self.plot.yaxis.ticker = [0, 50, 100]
        self.plot.varea("x", 0, "y", source=self._fractions, fill_color="#6baed6", fill_alpha=0.6)
        self.plot.segment("x", 0, "x", 100, source=self._faults, line_color="colour", line_width=2)
        self.now = bk.Span(location=now, **NOW)
        self.plot.add_layout(self.now)

    def draw(self, progress: Progress) -> None:
        """Draw the status of the frames, unless it has not changed."""
        if progress.changes == self._drawn:
            return
        self._drawn, known = progress.changes, np.flatnonzero(np.isfinite(progress.fraction))
        self._fractions.data = {"x": known, "y": 100 * progress.fraction[known]}
        bad = [(at, colour) for code, colour in _FAULTS.items() for at in np.flatnonzero(progress.status == code)]
        self._faults.data = columns("x colour", [(int(at), colour) for at, colour in bad])


class CurvePanel:
    """Plot of the curves of all probes, and the remarks on them.

    Parameters
    ----------
    document
        Document of the page.
    chosen
        Name of the curve that is shown first.
    select, message
        Control by which the curve is chosen, and the text for remarks.
    hint
        Text where there is no remark.

    Attributes
    ----------
    histories
        Histories of the probes that were read last.
    reading
        Whether they are being read anew; the histories are those of before until then.
    """

    def __init__(self, document: Document, *, chosen: str, select: bk.Select, message: bk.Div, hint: str) -> None:
        self.histories: Histories | None = None
        self.reading = False
        self.colours: Mapping[str, str] = {}
        self._select, self._message, self._hint, self._chosen = select, message, hint, chosen
        self._reader = Background(document)
        self._lines = bk.ColumnDataSource(columns(_LINES), name="lines")
        self._bands = bk.ColumnDataSource(columns(_BANDS), name="bands")
        self.plot, self.now = self._new_plot(), bk.Span(**NOW)
        self.plot.add_layout(self.now)
        select.on_change("value", lambda attr, old, new: self.draw())

    def _new_plot(self) -> Any:
        wheel, hover = bk.WheelZoomTool(visible=False), bk.HoverTool(visible=False)
        tools = [bk.PanTool(), wheel, bk.BoxZoomTool(), bk.ResetTool(), hover]
        plot = plain_plot(tools=tools, title="Curves", toolbar_location="above")
        plot.toolbar.logo, plot.toolbar.active_scroll = None, wheel
        plot.patches("xs", "ys", source=self._bands, fill_color="colour", fill_alpha=0.25, line_alpha=0)
        style = {"line_color": "colour", "line_width": 1.5, "legend_field": "name"}
        drawn = plot.multi_line("xs", "ys", source=self._lines, **style)
        plot.x_range.renderers = plot.y_range.renderers = [drawn]  # the values rule, not the widest band
        hover.renderers, hover.tooltips = [drawn], [("", "@name"), ("at", "$snap_x"), ("value", "$snap_y")]
        plot.legend.visible, plot.legend.label_text_font_size, plot.legend.ncols = False, "11px", 2
        plot.add_layout(plot.legend[0], "below")
        return plot

    def read(
        self, result: Result, marks: Sequence[Mark], gauge: float, measure: str | None, shown: Callable[[], None]
    ) -> None:
        """Read the probes off all frames in another thread, then call `shown`; only the last request counts."""
        self.reading = bool(marks)
        if marks:
            self._message.text = "reading all frames …"
            self._reader.ask(partial(read, result, tuple(marks), gauge, measure), partial(self._have, shown))
        else:
            self._reader.drop()
            self._have(shown, lambda: None)

    def _have(self, shown: Callable[[], None], read: Callable[[], Histories | None]) -> None:
        self.reading = False
        before = set() if self.histories is None else {_probe(each.name) for each in self.histories.quantities}
        try:
            self.histories = read()
            remarks = () if self.histories is None else self.histories.remarks
            self._message.text = "<br>".join(map(html.escape, remarks)) or self._hint
        except Exception as error:  # a probe outside the region and the like: reported where the probes are
            self.histories = None
            self._message.text = f'<span style="color:var(--warn)">{html.escape(str(error))}</span>'
        found = {} if self.histories is None else groups(self.histories)
        self._select.options = list(found)
        # the chosen quantity stays unless a new probe does not have it
        new = [name for name, curves in found.items() if any(_probe(curve.name) not in before for curve in curves)]
        wanted = new or list(found)
        current = self._select.value or self._chosen
        self._select.value = current if current in wanted or not wanted else wanted[0]
        self.draw()
        shown()

    def draw(self) -> None:
        """Draw the chosen curve of all probes."""
        if self.histories is None:
            self._bands.data, self._lines.data = columns(_BANDS), columns(_LINES)
            self.plot.legend.visible = False
            self.plot.xaxis.axis_label = self.plot.yaxis.axis_label = None
            return
        quantities = groups(self.histories).get(self._select.value, [])
        x, axis = time_axis(self.histories.times, self.histories.frames)
        bands, lines = [], []
        for quantity in quantities:
            colour = self.colours.get(_probe(quantity.name), OKABE_ITO["grey"])
            bands += [(xs, ys, colour) for xs, ys in zip(*band(x, quantity), strict=True)]
            lines.append((x, quantity.values, colour, quantity.name.replace("_", " ")))
        self._bands.data, self._lines.data = columns(_BANDS, bands), columns(_LINES, lines)
        self.plot.xaxis.axis_label, self.plot.yaxis.axis_label = axis, self._select.value
        self.plot.legend.visible = True

    def point(self, frame: int) -> None:
        """Mark a frame, where the curves hold it."""
        self.now.location = None
        if self.histories is not None and len(at := np.flatnonzero(self.histories.frames == frame)):
            self.now.location = float(self._times[at[0]])

    def frame(self, x: float) -> int:
        """Return the index of the frame at a place of the axis."""
        return 0 if self.histories is None else int(self.histories.frames[np.abs(self._times - x).argmin()])

    @property
    def _times(self) -> FloatArray:
        return np.zeros(0) if self.histories is None else time_axis(self.histories.times, self.histories.frames)[0]
