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
from rgbmidic.fields import Field
from rgbmidic.results import Maps
from rgbmidic.results.profiles import Profile
from rgbmidic.tools.report import profile_figure
from rgbmidic.tools.report.style import time_axis
from rgbmidic.tools.view.canvas import IMAGE, columns, plain_plot
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.curves import uncertainty_band
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.marks import probe_marks, probe_position
from rgbmidic.tools.view.time_line import FRAME_MARK_STYLE
from rgbmidic.tools.view.widgets import LIVE_REGION, Background, aria_group, warning

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class _LineReading:
    """A field along a line in all frames of a result, as far as it is read.

    Parameters
    ----------
    maps, field, endpoints
        The result, the name of the field, and the ends of the line.
    previous
        What was read of the result when it was shorter: it is kept unless it may differ.

    Attributes
    ----------
    profile
        A row of each frame of the result.
    write_times : ndarray, shape (T,), int64
        When each frame was written: one that is measured again is read again.
    is_read : ndarray, shape (T,), bool
        Frames that are read, or cannot be.
    clock, label
        Time of all frames, and what it is.
    """

    def __init__(self, maps: Maps, field: str, endpoints: Sequence[float], previous: _LineReading | None) -> None:
        self.maps, self.profile = maps, Profile(maps, field, endpoints, range(len(maps.result)))
        self.write_times, self.is_read = maps.result.table.write_times, np.zeros(len(maps.result), dtype=np.bool_)
        if (
            previous
            and not self.profile.rate_window
            and (self.write_times == previous.write_times)[previous.is_read].all()
        ):
            self.profile.values[:], self.profile.std[:] = previous.profile.values, previous.profile.std
            self.is_read = previous.is_read.copy()
        self.clock, self.label = time_axis(self.profile.times, self.profile.frames)
        self.read_more()

    @property
    def missing(self) -> npt.NDArray[np.int64]:
        """Indices of the frames that are measured and not read."""
        return np.flatnonzero(self.maps.result.finished & ~self.is_read)

    def read_more(self) -> _LineReading:
        """Read for a while; a damaged frame stays blank."""
        deadline = time.monotonic() + VIEWER.slice_s
        for frame in self.missing.tolist():
            with suppress(ResultError):
                self.profile.fill(self.maps, [frame])
            self.is_read[frame] = True
            if time.monotonic() > deadline:
                break
        return self


class LinePanel:
    """Field along a line: position against time in colours of the whole test, and the profile in the frame in view.

    The frames are read in slices in another thread, and drawn after each.

    Parameters
    ----------
    document
        Document of the page.
    fields
        What is in view.
    colours
        Colours of the field on the map.
    look
        Options of controls of the page.

    Attributes
    ----------
    choice, names
        Control that chooses the curves over time, or one of the lines; and their names, the first empty.
    status
        How far the frames are read, or what went wrong.
    wave, profile
        The plots.
    """

    def __init__(
        self, document: Document, fields: FieldsInView, colours: bk.LinearColorMapper, look: Mapping[str, Any]
    ) -> None:
        self._reading: _LineReading | None = None
        self._request: tuple[Any, ...] = ()
        self._values: Field | None = None
        self._look: object = None
        self._fields, self._map_colours, self._reader = fields, colours, Background(document)
        self.names: list[str] = []
        description = aria_group("curves over time, or the field along a line")
        self.choice = bk.RadioButtonGroup(
            labels=[], name="beside_map", visible=False, html_attributes=description, **look
        )
        self.status = bk.Div(name="line_status", html_attributes=LIVE_REGION, **look)
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
        self.frame_mark = bk.Span(name="wave_frame_mark", **FRAME_MARK_STYLE)
        self.wave.add_layout(self.frame_mark)
        self.profile, colour = plain_plot(title="Profile", name="profile_plot"), FRAME_MARK_STYLE["line_color"]
        self.profile.patches("xs", "ys", source=self._bands, fill_color=colour, fill_alpha=0.25, line_alpha=0)
        profile_line = self.profile.line("x", "y", source=self._line, line_color=colour, line_width=1.5)
        self.profile.y_range.renderers = [profile_line]
        self.models = (self.status, self.wave, self.profile)

    def update(self, values: Field) -> bool:
        """Show the field, of which the map has `values`, along the line in view; return whether there is one."""
        fields, view = self._fields, self._fields.view
        probes = probe_marks(view.marks).items()
        lines = {name: probe_position(marks, 0) for name, marks in probes if marks[0].kind == "line"}
        self.names, has_line = ["", *lines], view.line in lines
        self.choice.labels = ["over time", *(f"along {name.replace('_', ' ')}" for name in lines)]
        self.choice.update(visible=bool(lines), active=self.names.index(view.line) if has_line else 0)
        for model in self.models:
            model.visible = has_line
        if not has_line:
            self._reader.cancel()
            self._request, self._reading, self.status.text = (), None, ""
            return False
        request = (view.field, lines[view.line], fields.derivation, fields.result)
        look = (view.range, view.low, view.high, view.symmetric, view.palette, view.levels)
        if request != self._request:
            previous = self._reading if request[:-1] == self._request[:-1] else None
            self._request, self._reading = request, previous
            self.status.text = "reading the frames …"
            self._reader.submit(
                partial(_LineReading, fields.maps, view.field, lines[view.line], previous), self._receive
            )
            self._look = None
        if look != self._look:
            self._look = look
            self._draw()
        self.show_profile(values)
        return True

    def _receive(self, read_result: Callable[[], _LineReading]) -> None:
        """Draw what was read, and read on."""
        try:
            reading = self._reading = read_result()
        except Exception as error:  # a line outside the mesh, a field without uncertainty: reported where it would be
            self._reading, self.status.text = None, warning(str(error))
        else:
            missing = len(reading.missing)
            self.status.text = f"{int(reading.is_read.sum())} frames read, {missing} to go" if missing else ""
            if missing:
                self._reader.submit(reading.read_more, self._receive)
        self._draw()
        self.show_profile(self._values)

    def _draw(self) -> None:
        """Draw position against time: a column for each frame, or less where they are many."""
        if self._reading is None:
            self._image.data = columns(IMAGE)
            return
        profile, clock = self._reading.profile, self._reading.clock
        measured_frames = np.flatnonzero(self._reading.maps.result.finished & np.isfinite(clock))
        steps = np.diff(clock[measured_frames])
        steps = steps[steps > 0]
        step = float(steps.min()) if len(steps) else 1.0
        count = min(round(float(steps.sum()) / step) + 1, VIEWER.screen_columns)
        grid = np.linspace(clock[measured_frames[0]], clock[measured_frames[-1]], count)
        nearest = measured_frames[np.searchsorted((clock[measured_frames][1:] + clock[measured_frames][:-1]) / 2, grid)]
        half_column, spacing = float(grid[-1] - grid[0]) / max(count - 1, 1) / 2 or 0.5, float(profile.positions[1])
        image = profile.values[nearest].T.astype(np.float32)
        x_start, width = float(grid[0]) - half_column, float(grid[-1] - grid[0]) + 2 * half_column
        self._image.data = columns(IMAGE, [(image, x_start, -spacing / 2, width, spacing * len(profile.positions))])
        low, high = self._fields.colour_range(profile.field.name, profile=profile)
        self._colours.update(low=low, high=high)
        if self._colours.palette != self._map_colours.palette:
            self._colours.palette = self._map_colours.palette
        position = f"position ({profile.units.length})"
        self.wave.xaxis.axis_label, self.wave.yaxis.axis_label = self._reading.label, position
        self.profile.xaxis.axis_label, self.profile.yaxis.axis_label = position, profile.field.label
        self.wave.title.text = f"{profile.field.label} along the line"

    def show_profile(self, values: Field | None) -> None:
        """Show the profile of the frame in view, of which the map has the values; None: it shows nothing."""
        self._values, frame, self.status.visible = values, self._fields.view.frame, bool(self.status.text)
        if self._reading is None or values is None:
            self._line.data, self._bands.data, self.frame_mark.location = columns("x y"), columns("xs ys"), None
            return
        profile = self._reading.profile
        curve = profile.line.read(values, profile.covariance_key)
        self._line.data = {"x": profile.positions, "y": curve.values}
        self._bands.data = dict(zip(("xs", "ys"), uncertainty_band(profile.positions, curve), strict=True))
        time = self._reading.clock[frame]
        self.frame_mark.location, self.profile.title.text = (
            float(time) if np.isfinite(time) else None,
            f"Profile in frame {frame}",
        )

    def figure(self) -> Figure | None:
        """Draw the frames that are read, and the profile of the one in view, for print; None where there are none."""
        reading, frame = self._reading, self._fields.view.frame
        frames = [] if reading is None else np.flatnonzero(reading.is_read & reading.maps.result.finished).tolist()
        if reading is None or not frames:
            return None
        profile = Profile(reading.maps, reading.profile.field.name, self._request[1], frames)
        profile.values[:], profile.std[:] = reading.profile.values[frames], reading.profile.std[frames]
        return profile_figure(profile, curve_rows=[frames.index(frame)] if frame in frames else ())

    def frame_at(self, x: float) -> int:
        """Return the index of the frame at a place of the time axis."""
        if self._reading is None or not np.isfinite(self._reading.clock).any():
            return self._fields.view.frame
        return int(np.nanargmin(np.abs(self._reading.clock - x)))
