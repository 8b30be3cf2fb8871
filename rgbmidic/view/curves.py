"""Curves over time, as `rgbmidic history` reads probes at marks; a field along a line; the time line of the frames."""

from __future__ import annotations

import html
import io
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import bokeh.models as bk
import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic.errors import ResultError, RgbmidicError
from rgbmidic.report.style import OKABE_ITO, time_axis, time_unit
from rgbmidic.results import Channels, Histories, HistoryColumn, Maps, MapValues, Result, probes_of
from rgbmidic.results.histories import Profile, frames_alone, history_csv, read_histories, with_channels
from rgbmidic.settings import ChannelSettings, ProbeSettings, ScaleSettings
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic.view.address import KINDS, Mark, probe_marks, probe_place
from rgbmidic.view.canvas import columns, plain_plot
from rgbmidic.view.picture import Background, warning


def probes(marks: Sequence[Mark], gauge: float, stated: ProbeSettings, measure: Any = None) -> ProbeSettings:
    """Return the probes that marks make, each kind in the order set; a last mark without its pair waits for it.

    Strain gauges have the length `gauge` (px); window and, unless it is chosen, strain measure are those `stated`.
    """
    places: dict[str, Any] = {f"{kind}s": () for kind in KINDS}
    names = []
    for name, pair in probe_marks(marks).items():
        places[f"{pair[0].kind}s"] += (probe_place(pair, gauge),)
        if name == pair[0].name:
            names.append((f"{pair[0].kind}_{len(places[f'{pair[0].kind}s'])}", name))
    return ProbeSettings(measure=measure or stated.measure, window=stated.window, names=tuple(names), **places)


def marks_of(stated: ProbeSettings) -> tuple[Mark, ...]:
    """Return the marks of the probes stated, of those kinds that can be set with the pointer."""
    marks, names = [], dict(stated.names)
    for numbered, (kind, place) in zip(stated.numbered, stated.places, strict=True):
        if kind not in KINDS:
            continue
        x, y, *end = place
        marks.append(Mark(kind, x, y, names.get(numbered, "")))
        if KINDS[kind] > 1:
            marks.append(Mark(kind, x + end[0], y) if kind == "circle" else Mark(kind, end[0], end[1]))
    return tuple(marks)


def read(
    result: Result,
    marks: Sequence[Mark],
    gauge: float,
    measure: str | None = None,
    scale: ScaleSettings | None = None,
) -> Histories | None:
    """Read the probes that marks make off a result, as `read_histories`; None where they make none."""
    made = probes(marks, gauge, probes_of(result), measure)
    return read_histories(result, made, scale=scale) if made.places else None


def groups(histories: Histories, names: Iterable[str]) -> dict[str, list[HistoryColumn]]:
    """Group the same quantity of the probes of some names, by its name and unit; channels are alone."""
    found: dict[str, list[HistoryColumn]] = {}
    for quantity in histories.quantities:
        if quantity.name.endswith(("_before", "_after")):  # single frames, no curve
            continue
        name = quantity.name.removeprefix(f"{_probe(quantity, names)}_")
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


def _probe(quantity: HistoryColumn, names: Iterable[str]) -> str:
    """Return the name of the probe, of some names, that a quantity is of; empty: it is a channel."""
    return max((name for name in names if quantity.name.startswith(f"{name}_")), key=len, default="")


_LINES, _BANDS = "xs ys colour name", "xs ys colour"
_BESIDE, _MARGIN = OKABE_ITO["vermillion"], 0.1
"""Colour of a channel beside the curves; room above and below it, as Bokeh's own ranges have."""
_STRETCHES = 1500
"""Stretches of a channel that are drawn: as many as a wide screen has columns for them."""
_AT_ONCE = 100
"""Frames that are read before the page is served again. Measured: 10 ms."""
_NOT_YET, _DAMAGED = -1, 3
"""Status of a frame that was not read yet, and of one whose record cannot be read, beside those of the field table."""
_FAULTS = {1: OKABE_ITO["orange"], 2: "#d1495b", _DAMAGED: "#d1495b"}
NOW = {"dimension": "height", "level": "overlay", "line_color": "#8e5bd0", "line_width": 2}
"""Mark of the frame in view: over all else, which is not painted again when it moves."""


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
        self._written = np.zeros(frames, dtype=np.int64)

    @property
    def known(self) -> int:
        """Number of frames that were read."""
        return int((self.status != _NOT_YET).sum())

    def advance(self, result: Result) -> None:
        """Read some frames more, and again those that were measured again."""
        now = result.table.written
        stale = (self.status != _NOT_YET) & (now != self._written)
        self.status[stale], self.fraction[stale] = _NOT_YET, np.nan
        frames = np.flatnonzero(result.finished & (self.status == _NOT_YET))[:_AT_ONCE]
        self._written[frames] = now[frames]
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
    """Plot of the curves of all probes, of channels beside them, and the remarks on them.

    Parameters
    ----------
    document
        Document of the page.
    chosen
        Name of the curve that is shown first.
    select, message, told
        Control by which the curve is chosen, and the texts for remarks on the probes and on the channels.
    hint
        Text where there is no remark.

    Attributes
    ----------
    histories
        Histories of the probes that were read last, with the channels.
    channels
        The channels by the clock of the frames; None: there are none.
    reading
        Whether the probes are being read anew; the histories are those of before until then.
    stated, along, beside
        What is known of the channels; name of the quantity along x, empty: the time; and of the channel drawn beside.
    """

    def __init__(
        self, document: Document, *, chosen: str, select: bk.Select, message: bk.Div, told: bk.Div, hint: str
    ) -> None:
        self.histories: Histories | None = None
        self.channels: Channels | None = None
        self.reading = False
        self.colours: Mapping[str, str] = {}
        self.stated, self.along, self.beside = ChannelSettings(), "", ""
        self._probed: Histories | None = None
        self._grabbed: tuple[float, Channels] | None = None
        self._select, self._message, self._told, self._hint, self._chosen = select, message, told, hint, chosen
        self._reader = Background(document)
        self._lines = bk.ColumnDataSource(columns(_LINES), name="lines")
        self._bands = bk.ColumnDataSource(columns(_BANDS), name="bands")
        self._recorded = bk.ColumnDataSource(columns("xs ys"), name="recorded")
        self.plot, self.now = self._new_plot(), bk.Span(**NOW)
        self.plot.add_layout(self.now)
        select.on_change("value", lambda attr, old, new: self.draw())

    def _new_plot(self) -> Any:
        wheel, hover = bk.WheelZoomTool(visible=False), bk.HoverTool(visible=False)
        self.pan = bk.PanTool()
        tools = [self.pan, wheel, bk.BoxZoomTool(), bk.ResetTool(), hover]
        plot = plain_plot(tools=tools, title="Curves", toolbar_location="above", name="curves_plot")
        plot.toolbar.logo, plot.toolbar.active_scroll, plot.toolbar.active_drag = None, wheel, self.pan
        plot.patches("xs", "ys", source=self._bands, fill_color="colour", fill_alpha=0.25, line_alpha=0)
        style = {"line_color": "colour", "line_width": 1.5, "legend_field": "name"}
        drawn = plot.multi_line("xs", "ys", source=self._lines, **style)
        plot.x_range.renderers = plot.y_range.renderers = [drawn]  # the values rule, not the widest band
        self._range = bk.Range1d(0, 1)
        plot.extra_y_ranges = {"channel": self._range}
        look: dict[str, Any] = {"line_color": _BESIDE, "line_dash": "dashed", "y_range_name": "channel"}
        beside = plot.multi_line("xs", "ys", source=self._recorded, line_width=1.5, **look)
        texts: dict[str, Any] = dict.fromkeys(("major_label_text_font_size", "axis_label_text_font_size"), "12px")
        self._axis = bk.LinearAxis(y_range_name="channel", visible=False, axis_label_text_color=_BESIDE, **texts)
        plot.add_layout(self._axis, "right")
        self._curves, self._all = [drawn], [drawn, beside]
        hover.renderers, hover.tooltips = [drawn], [("", "@name"), ("at", "$snap_x"), ("value", "$snap_y")]
        plot.legend.visible, plot.legend.label_text_font_size, plot.legend.ncols = False, "11px", 2
        plot.add_layout(plot.legend[0], "below")
        return plot

    def read(
        self, result: Result, marks: Sequence[Mark], gauge: float, shown: Callable[[], None], **chosen: Any
    ) -> None:
        """Read the probes off all frames in another thread, then call `shown`; only the last request counts."""
        self.reading = bool(probe_marks(marks))
        if self.reading:
            self._message.text = "reading all frames …"
            work = partial(read, result, tuple(marks), gauge, **chosen)
            self._reader.ask(work, partial(self._have, shown))
        else:
            self._reader.drop()
            self._have(shown, lambda: None if self.stated.file is None else frames_alone(result))

    def _have(self, shown: Callable[[], None], read: Callable[[], Histories | None]) -> None:
        self.reading = False
        before = set() if self._probed is None else {_probe(each, self.colours) for each in self._probed.quantities}
        try:
            self._probed = read()
            remarks = () if self._probed is None else self._probed.remarks
            self._message.text = "<br>".join(map(html.escape, remarks)) or self._hint
        except Exception as error:  # a probe outside the region and the like: reported where the probes are
            self._probed = None
            self._message.text = warning(str(error))
        self.combine()
        found = {} if self.histories is None else groups(self.histories, self.colours)
        self._select.options = list(found)
        # the chosen quantity stays unless a new probe does not have it
        new = [name for name, own in found.items() if any(_probe(one, self.colours) not in before for one in own)]
        wanted = new or list(found)
        current = self._select.value or self._chosen
        self._select.value = current if current in wanted or not wanted else wanted[0]
        self.draw()
        shown()

    def combine(self) -> None:
        """Add the channels to the probes, as they are stated now; what is wrong with them is reported."""
        self.histories, self.channels, text, stated = self._probed, None, "", self.stated
        if self._probed is not None and stated.file is not None:
            try:
                self.channels = Channels.read(stated.file, stated.offset, stated.trigger)
                self.histories = with_channels(self._probed, stated)
                self.channels = self.histories.channels
                text = "<br>".join(map(html.escape, self.histories.remarks[len(self._probed.remarks) :]))
            except RgbmidicError as error:
                text = warning(str(error))
        self._told.text = text
        self._select.options = [] if self.histories is None else list(groups(self.histories, self.colours))

    def draw(self) -> None:
        """Draw the chosen curve of all probes."""
        if self.histories is None:
            self._bands.data, self._lines.data = columns(_BANDS), columns(_LINES)
            self._recorded.data, self._axis.visible = columns("xs ys"), False
            self.plot.legend.visible = False
            self.plot.xaxis.axis_label = self.plot.yaxis.axis_label = None
            return
        quantities = groups(self.histories, self.colours).get(self._select.value, [])
        (x, axis), bands, lines = self._x, [], []
        for quantity in quantities:
            colour = self.colours.get(_probe(quantity, self.colours), OKABE_ITO["grey"])
            if not self._over:
                bands += [(xs, ys, colour) for xs, ys in zip(*band(x, quantity), strict=True)]
            lines.append((x, quantity.values, colour, quantity.name.replace("_", " ")))
        self._bands.data, self._lines.data = columns(_BANDS, bands), columns(_LINES, lines)
        self.plot.xaxis.axis_label, self.plot.yaxis[0].axis_label = axis, self._select.value
        self.plot.legend.visible = True
        self._draw_beside(self.channels)

    def _draw_beside(self, channels: Channels | None) -> None:
        """Draw the channel beside the curves as it was recorded, around the frames or, off them, all of it."""
        rows, times = [], None if self.histories is None else self.histories.times
        self.plot.x_range.renderers = self._curves
        if channels is not None and self.beside in channels.values and times is not None and not self._over:
            first, last = np.nanmin(times), np.nanmax(times)
            ends = np.searchsorted(channels.times, [2 * first - last, 2 * last - first])
            part = slice(*ends) if ends[0] < ends[1] else slice(None)
            x, y = _thinned(time_unit(times)[0] * channels.times[part], channels.values[self.beside][part])
            rows = [(x, y)]
            low, high = np.nanmin(y), np.nanmax(y)
            margin = (high - low or 1.0) * _MARGIN
            self._range.update(start=low - margin, end=high + margin)
            if ends[0] == ends[1] or not self._lines.data["xs"]:
                self.plot.x_range.renderers = self._all
        self._recorded.data = columns("xs ys", rows)
        self._axis.update(visible=bool(rows), axis_label=self.beside)

    def grab(self, x: float) -> None:
        """Take hold of the channels at a place of the axis."""
        self._grabbed = None if self.channels is None or self._over else (x, self.channels)

    def drag(self, x: float) -> float | None:
        """Draw the channels so far along the time; return their offset in s, None where they were not taken hold of."""
        if self._grabbed is None or self.histories is None or self.histories.times is None:
            return None
        start, channels = self._grabbed
        moved = channels.shifted((x - start) / time_unit(self.histories.times)[0])
        self._draw_beside(moved)
        return moved.offset

    def point(self, frame: int) -> None:
        """Mark a frame, where the curves hold it."""
        self.now.location = None
        if self.histories is not None and len(at := np.flatnonzero(self.histories.frames == frame)):
            place = float(self._x[0][at[0]])
            self.now.location = place if np.isfinite(place) else None

    def frame(self, x: float) -> int:
        """Return the index of the frame at a place of the axis."""
        if self.histories is None or not np.isfinite(self._x[0]).any():
            return 0
        return int(self.histories.frames[np.nanargmin(np.abs(self._x[0] - x))])

    @property
    def _over(self) -> HistoryColumn | None:
        """The quantity along x; None: the time."""
        quantities = () if self.histories is None else self.histories.quantities
        return next((one for one in quantities if one.name == self.along), None)

    @property
    def _x(self) -> tuple[FloatArray, str]:
        """Places of the frames along x, and what they are."""
        if self.histories is None:
            return np.zeros(0), ""
        if (over := self._over) is not None:
            return over.values, f"{over.name.replace('_', ' ')} ({over.unit})" if over.unit else over.name
        return time_axis(self.histories.times, self.histories.frames)


def _thinned(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Thin a curve out to the smallest and the largest value of each stretch of what a screen shows."""
    step = -(-len(y) // _STRETCHES)
    if step < 3:
        return x, y
    rows = y[: len(y) // step * step].reshape(-1, step)
    start = step * np.arange(len(rows))
    at = np.unique([start + rows.argmin(axis=1), start + rows.argmax(axis=1)])
    return x[at], y[at]


_SLICE = 0.25
"""Seconds for which frames are read along a line before they are drawn, or before another line has its turn."""
_ACROSS = 1500
"""Columns of a position-time picture at most: its place on a screen of 3840 has as many."""
_IMAGE = "image x y dw dh"


@dataclass(frozen=True, kw_only=True, eq=False)
class _Reading:
    """A field along a line in all frames of a result, as far as it is read.

    Attributes
    ----------
    maps, profile
        The result, and a row of each of its frames.
    written : ndarray, shape (T,), int64
        When each frame was written: one that is measured again is read again.
    read : ndarray, shape (T,), bool
        Frames that are read, or cannot be.
    """

    maps: Maps
    profile: Profile
    written: npt.NDArray[np.int64]
    read: BoolArray

    @classmethod
    def begin(cls, maps: Maps, field: str, place: Sequence[float], before: _Reading | None) -> _Reading:
        """Lay the line; what was read `before`, of the result when it was shorter, is kept unless it may differ."""
        profile = Profile.along(maps, field, place, range(len(maps.result)))
        now, read = maps.result.table.written, np.zeros(len(maps.result), dtype=np.bool_)
        if before is not None and not profile.rate_window and (now == before.written)[before.read].all():
            profile.values[:], profile.std[:], read = before.profile.values, before.profile.std, before.read.copy()
        return cls(maps=maps, profile=profile, written=now, read=read).further()

    @property
    def missing(self) -> npt.NDArray[np.int64]:
        """Indices of the frames that are measured and not read."""
        return np.flatnonzero(self.maps.result.finished & ~self.read)

    def further(self) -> _Reading:
        """Read for a while; a damaged frame stays blank."""
        end = time.monotonic() + _SLICE
        for frame in self.missing.tolist():
            with suppress(ResultError):
                self.profile.fill(self.maps, [frame])
            self.read[frame] = True
            if time.monotonic() > end:
                break
        return self


class LinePanel:
    """Field along a line: position against time in its colours, and the profile in the frame in view.

    The frames are read in slices in another thread, and drawn after each.

    Parameters
    ----------
    document
        Document of the page.
    colours
        Colours of the field on the map.
    look
        Options of controls of the page.

    Attributes
    ----------
    choice
        Control that chooses the curves over time, or one of the lines.
    told
        How far the frames are read, or what went wrong.
    wave, profile
        The plots.
    """

    def __init__(self, document: Document, colours: bk.LinearColorMapper, look: Mapping[str, Any]) -> None:
        self._reading: _Reading | None = None
        self._asked: tuple[Any, ...] = ()
        self._reader = Background(document)
        self._view: tuple[int, MapValues | None] = (0, None)
        self.choice = bk.RadioButtonGroup(labels=[], name="beside_map", visible=False, **look)
        self.choice.html_attributes = {"role": "group", "aria-label": "curves over time, or the field along a line"}
        self.told = bk.Div(name="told_of_line", **look)
        self.told.html_attributes = {"aria-live": "polite"}
        self._image = bk.ColumnDataSource(columns(_IMAGE), name="wave")
        self._line = bk.ColumnDataSource(columns("x y"), name="profile")
        self._bands = bk.ColumnDataSource(columns("xs ys"), name="profile bands")
        hover = bk.HoverTool(visible=False, tooltips=[("at", "$x, $y"), ("value", "@image")])
        tools = [bk.PanTool(), bk.BoxZoomTool(), bk.ResetTool(), hover]
        self.wave = plain_plot(tools=tools, title="Along the line", toolbar_location="above", name="wave_plot")
        self.wave.toolbar.logo, self.wave.grid.visible = None, False
        colours.nan_color = "#00000000"  # what is not measured, or not read yet
        self.wave.image(*_IMAGE.split(), source=self._image, color_mapper=colours)
        self.now = bk.Span(name="wave_now", **NOW)
        self.wave.add_layout(self.now)
        self.profile = plain_plot(title="Profile", name="profile_plot")
        self.profile.patches(
            "xs", "ys", source=self._bands, fill_color=NOW["line_color"], fill_alpha=0.25, line_alpha=0
        )
        drawn = self.profile.line("x", "y", source=self._line, line_color=NOW["line_color"], line_width=1.5)
        self.profile.y_range.renderers = [drawn]
        self.parts = (self.told, self.wave, self.profile)
        self._show(shown=False)

    def _show(self, *, shown: bool) -> None:
        for part in self.parts:
            part.visible = shown
        self.told.visible = shown and bool(self.told.text)

    def offer(self, lines: Sequence[str], chosen: str) -> bool:
        """Offer lines by their names; return whether the chosen one is among them, and thus shown."""
        self.choice.labels = ["over time", *(f"along {name.replace('_', ' ')}" for name in lines)]
        self.choice.visible = bool(lines)
        self.choice.active = lines.index(chosen) + 1 if chosen in lines else 0
        self._show(shown=chosen in lines)
        if chosen not in lines:
            self._reader.drop()
            self._asked, self._reading = (), None
        return chosen in lines

    def ask(self, maps: Maps, field: str, place: Sequence[float], key: tuple[Any, ...], changes: int) -> None:
        """Read a field along a line; `key` states how it is derived, `changes` how often the result has grown."""
        asked = (field, tuple(place), key, changes)
        if asked == self._asked:
            return
        before = self._reading if asked[:-1] == self._asked[:-1] else None
        self._asked, self._reading = asked, before
        if before is None:
            self._draw()
        self._tell("reading the frames …")
        self._reader.ask(partial(_Reading.begin, maps, field, place, before), self._take)

    def _tell(self, text: str) -> None:
        self.told.text, self.told.visible = text, bool(text)

    def _take(self, read: Callable[[], _Reading]) -> None:
        """Draw what was read, and read on."""
        try:
            reading = self._reading = read()
        except Exception as error:  # a line outside the mesh, a field without uncertainty: reported where it would be
            self._reading = None
            self._tell(warning(str(error)))
        else:
            missing = len(reading.missing)
            self._tell(f"{int(reading.read.sum())} frames read, {missing} to go" if missing else "")
            if missing:
                self._reader.ask(reading.further, self._take)
        self._draw()
        self.show(*self._view)

    @property
    def _clock(self) -> tuple[FloatArray, str]:
        """Time of all frames, and its label."""
        profile = self._reading.profile if self._reading else None
        return (np.zeros(0), "") if profile is None else time_axis(profile.times, profile.frames)

    def _draw(self) -> None:
        """Draw position against time: a column for each frame, or less where they are many."""
        if self._reading is None:
            self._image.data = columns(_IMAGE)
            return
        profile, (clock, label) = self._reading.profile, self._clock
        there = np.flatnonzero(self._reading.maps.result.finished & np.isfinite(clock))
        steps = np.diff(clock[there])
        steps = steps[steps > 0]
        step = float(steps.min()) if len(steps) else 1.0
        count = min(round(float(steps.sum()) / step) + 1, _ACROSS)
        grid = np.linspace(clock[there[0]], clock[there[-1]], count)
        nearest = there[np.searchsorted((clock[there][1:] + clock[there][:-1]) / 2, grid)]
        half, apart = float(grid[-1] - grid[0]) / max(count - 1, 1) / 2 or 0.5, float(profile.positions[1])
        image = profile.values[nearest].T.astype(np.float32)
        left, wide = float(grid[0]) - half, float(grid[-1] - grid[0]) + 2 * half
        self._image.data = columns(_IMAGE, [(image, left, -apart / 2, wide, apart * len(profile.positions))])
        position = f"position ({profile.units.length})"
        self.wave.xaxis.axis_label, self.wave.yaxis.axis_label = label, position
        self.profile.xaxis.axis_label, self.profile.yaxis.axis_label = position, profile.field.label
        self.wave.title.text = f"{profile.field.label} along the line"

    def show(self, frame: int, values: MapValues | None) -> None:
        """Show the profile of a frame, of which the map has the values."""
        self._view = (frame, values)
        if self._reading is None or values is None:
            self._line.data, self._bands.data, self.now.location = columns("x y"), columns("xs ys"), None
            return
        profile = self._reading.profile
        along, std = profile.line.read(values.values, values.std, profile.kind)
        self._line.data = {"x": profile.positions, "y": along}
        curve = HistoryColumn(name=profile.field.name, unit=profile.field.unit, values=along, std=std)
        self._bands.data = dict(zip(("xs", "ys"), band(profile.positions, curve), strict=True))
        at = self._clock[0][frame]
        self.now.location, self.profile.title.text = float(at) if np.isfinite(at) else None, f"Profile in frame {frame}"

    def frame(self, x: float) -> int:
        """Return the index of the frame at a place of the time axis."""
        clock = self._clock[0]
        return int(np.nanargmin(np.abs(clock - x))) if np.isfinite(clock).any() else self._view[0]
