"""A line on the map and the field along it: its panel, read in the background."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import bokeh.models as bk
import numpy as np
import numpy.typing as npt
from bokeh.document import Document

from rgbmidic.errors import ResultError
from rgbmidic.fields import History
from rgbmidic.report import profile_figure
from rgbmidic.report.style import time_axis
from rgbmidic.results import Maps, MapValues
from rgbmidic.results.profiles import Profile
from rgbmidic.view.address import probe_marks, probe_place
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.curves import NOW, band
from rgbmidic.view.models import READ_OUT, Background, labelled, warning
from rgbmidic.view.picture import IMAGE, columns, plain_plot
from rgbmidic.view.shown import ShownFields

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class _Reading:
    """A field along a line in all frames of a result, as far as it is read.

    Parameters
    ----------
    maps, field, place
        The result, the name of the field, and the ends of the line.
    before
        What was read of the result when it was shorter: it is kept unless it may differ.

    Attributes
    ----------
    profile
        A row of each frame of the result.
    written : ndarray, shape (T,), int64
        When each frame was written: one that is measured again is read again.
    read : ndarray, shape (T,), bool
        Frames that are read, or cannot be.
    clock, label
        Time of all frames, and what it is.
    """

    def __init__(self, maps: Maps, field: str, place: Sequence[float], before: _Reading | None) -> None:
        self.maps, self.profile = maps, Profile(maps, field, place, range(len(maps.result)))
        self.written, self.read = maps.result.table.written, np.zeros(len(maps.result), dtype=np.bool_)
        if before and not self.profile.rate_window and (self.written == before.written)[before.read].all():
            self.profile.values[:], self.profile.std[:] = before.profile.values, before.profile.std
            self.read = before.read.copy()
        self.clock, self.label = time_axis(self.profile.times, self.profile.frames)
        self.further()

    @property
    def missing(self) -> npt.NDArray[np.int64]:
        """Indices of the frames that are measured and not read."""
        return np.flatnonzero(self.maps.result.finished & ~self.read)

    def further(self) -> _Reading:
        """Read for a while; a damaged frame stays blank."""
        end = time.monotonic() + VIEWER.slice_s
        for frame in self.missing.tolist():
            with suppress(ResultError):
                self.profile.fill(self.maps, [frame])
            self.read[frame] = True
            if time.monotonic() > end:
                break
        return self


class LinePanel:
    """Field along a line: position against time in colours of the whole test, and the profile in the frame in view.

    The frames are read in slices in another thread, and drawn after each.

    Parameters
    ----------
    document
        Document of the page.
    shown
        What is in view.
    colours
        Colours of the field on the map.
    look
        Options of controls of the page.

    Attributes
    ----------
    choice, names
        Control that chooses the curves over time, or one of the lines; and their names, the first empty.
    told
        How far the frames are read, or what went wrong.
    wave, profile
        The plots.
    """

    def __init__(
        self, document: Document, shown: ShownFields, colours: bk.LinearColorMapper, look: Mapping[str, Any]
    ) -> None:
        self._reading: _Reading | None = None
        self._asked: tuple[Any, ...] = ()
        self._values: MapValues | None = None
        self._look: object = None
        self._shown, self._map_colours, self._reader = shown, colours, Background(document)
        self.names: list[str] = []
        says = labelled("curves over time, or the field along a line")
        self.choice = bk.RadioButtonGroup(labels=[], name="beside_map", visible=False, html_attributes=says, **look)
        self.told = bk.Div(name="told_of_line", html_attributes=READ_OUT, **look)
        self._image = bk.ColumnDataSource(columns(IMAGE), name="wave")
        self._line = bk.ColumnDataSource(columns("x y"), name="profile")
        self._bands = bk.ColumnDataSource(columns("xs ys"), name="profile bands")
        hover = bk.HoverTool(visible=False, tooltips=[("at", "$x, $y"), ("value", "@image")])
        tools = [bk.PanTool(), bk.BoxZoomTool(), bk.ResetTool(), hover]
        self.wave = plain_plot(tools=tools, title="Along the line", toolbar_location="above", name="wave_plot")
        self.wave.toolbar.logo, self.wave.grid.visible = None, False
        nothing = "#00000000"  # what is not measured, or not read yet
        self._colours = bk.LinearColorMapper(palette=colours.palette, nan_color=nothing, name="wave_colours")
        self.wave.image(*IMAGE.split(), source=self._image, color_mapper=self._colours)
        self.wave.add_layout(bk.ColorBar(color_mapper=self._colours, width=10), "right")
        self.now = bk.Span(name="wave_now", **NOW)
        self.wave.add_layout(self.now)
        self.profile, colour = plain_plot(title="Profile", name="profile_plot"), NOW["line_color"]
        self.profile.patches("xs", "ys", source=self._bands, fill_color=colour, fill_alpha=0.25, line_alpha=0)
        drawn = self.profile.line("x", "y", source=self._line, line_color=colour, line_width=1.5)
        self.profile.y_range.renderers = [drawn]
        self.parts = (self.told, self.wave, self.profile)

    def update(self, values: MapValues) -> bool:
        """Show the field, of which the map has `values`, along the line in view; return whether there is one."""
        shown, view = self._shown, self._shown.view
        probes = probe_marks(view.marks).items()
        lines = {name: probe_place(marks, 0) for name, marks in probes if marks[0].kind == "line"}
        self.names, there = ["", *lines], view.line in lines
        self.choice.labels = ["over time", *(f"along {name.replace('_', ' ')}" for name in lines)]
        self.choice.update(visible=bool(lines), active=self.names.index(view.line) if there else 0)
        for part in self.parts:
            part.visible = there
        if not there:
            self._reader.drop()
            self._asked, self._reading, self.told.text = (), None, ""
            return False
        asked = (view.field, lines[view.line], shown.chosen, shown.result)
        look = (view.range, view.low, view.high, view.symmetric, view.palette, view.levels)
        if asked != self._asked:
            before = self._reading if asked[:-1] == self._asked[:-1] else None
            self._asked, self._reading = asked, before
            self.told.text = "reading the frames …"
            self._reader.ask(partial(_Reading, shown.maps, view.field, lines[view.line], before), self._take)
            self._look = None
        if look != self._look:
            self._look = look
            self._draw()
        self.show(values)
        return True

    def _take(self, read: Callable[[], _Reading]) -> None:
        """Draw what was read, and read on."""
        try:
            reading = self._reading = read()
        except Exception as error:  # a line outside the mesh, a field without uncertainty: reported where it would be
            self._reading, self.told.text = None, warning(str(error))
        else:
            missing = len(reading.missing)
            self.told.text = f"{int(reading.read.sum())} frames read, {missing} to go" if missing else ""
            if missing:
                self._reader.ask(reading.further, self._take)
        self._draw()
        self.show(self._values)

    def _draw(self) -> None:
        """Draw position against time: a column for each frame, or less where they are many."""
        if self._reading is None:
            self._image.data = columns(IMAGE)
            return
        profile, clock = self._reading.profile, self._reading.clock
        there = np.flatnonzero(self._reading.maps.result.finished & np.isfinite(clock))
        steps = np.diff(clock[there])
        steps = steps[steps > 0]
        step = float(steps.min()) if len(steps) else 1.0
        count = min(round(float(steps.sum()) / step) + 1, VIEWER.screen_columns)
        grid = np.linspace(clock[there[0]], clock[there[-1]], count)
        nearest = there[np.searchsorted((clock[there][1:] + clock[there][:-1]) / 2, grid)]
        half, apart = float(grid[-1] - grid[0]) / max(count - 1, 1) / 2 or 0.5, float(profile.positions[1])
        image = profile.values[nearest].T.astype(np.float32)
        left, wide = float(grid[0]) - half, float(grid[-1] - grid[0]) + 2 * half
        self._image.data = columns(IMAGE, [(image, left, -apart / 2, wide, apart * len(profile.positions))])
        low, high = self._shown.ends(profile.field.name, along=profile)
        self._colours.update(low=low, high=high)
        if self._colours.palette != self._map_colours.palette:
            self._colours.palette = self._map_colours.palette
        position = f"position ({profile.units.length})"
        self.wave.xaxis.axis_label, self.wave.yaxis.axis_label = self._reading.label, position
        self.profile.xaxis.axis_label, self.profile.yaxis.axis_label = position, profile.field.label
        self.wave.title.text = f"{profile.field.label} along the line"

    def show(self, values: MapValues | None) -> None:
        """Show the profile of the frame in view, of which the map has the values; None: it shows nothing."""
        self._values, frame, self.told.visible = values, self._shown.view.frame, bool(self.told.text)
        if self._reading is None or values is None:
            self._line.data, self._bands.data, self.now.location = columns("x y"), columns("xs ys"), None
            return
        profile = self._reading.profile
        along, std = profile.line.read(values.values, values.std, profile.kind)
        self._line.data = {"x": profile.positions, "y": along}
        curve = History(name=profile.field.name, unit=profile.field.unit, values=along, std=std)
        self._bands.data = dict(zip(("xs", "ys"), band(profile.positions, curve), strict=True))
        at = self._reading.clock[frame]
        self.now.location, self.profile.title.text = float(at) if np.isfinite(at) else None, f"Profile in frame {frame}"

    def figure(self) -> Figure | None:
        """Draw the frames that are read, and the profile of the one in view, for print; None where there are none."""
        reading, frame = self._reading, self._shown.view.frame
        there = [] if reading is None else np.flatnonzero(reading.read & reading.maps.result.finished).tolist()
        if reading is None or not there:
            return None
        profile = Profile(reading.maps, reading.profile.field.name, self._asked[1], there)
        profile.values[:], profile.std[:] = reading.profile.values[there], reading.profile.std[there]
        return profile_figure(profile, shown=[there.index(frame)] if frame in there else ())

    def frame(self, x: float) -> int:
        """Return the index of the frame at a place of the time axis."""
        if self._reading is None or not np.isfinite(self._reading.clock).any():
            return self._shown.view.frame
        return int(np.nanargmin(np.abs(self._reading.clock - x)))
