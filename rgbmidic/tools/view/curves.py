"""Curves over time, as `rgbmidic history` reads probes at marks."""

from __future__ import annotations

import html
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import Pan, PanEnd, PanStart

from rgbmidic.errors import RgbmidicError
from rgbmidic.fields import Field
from rgbmidic.results import Channels, Histories, Result
from rgbmidic.results.histories import empty_histories, read_histories, with_channels
from rgbmidic.settings import ProbeSettings, ScaleSettings
from rgbmidic.tools.report import history_figure
from rgbmidic.tools.report.style import OKABE_ITO, time_axis, time_unit
from rgbmidic.tools.view.canvas import columns, plain_plot
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.controls import ResultControls
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.marks import Mark, probe_marks, settings_of_marks
from rgbmidic.tools.view.time_line import FRAME_MARK_STYLE
from rgbmidic.tools.view.widgets import Background, warning
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def group_quantities(histories: Histories, names: Iterable[str]) -> dict[str, list[Field]]:
    """Group the same quantity of the probes of some names, by its name and unit; channels are alone."""
    by_label: dict[str, list[Field]] = {}
    for quantity in histories.quantities:
        if quantity.name.endswith(("_before", "_after")):  # single frames, no curve
            continue
        name = quantity.name.removeprefix(f"{_probe(quantity, names)}_")
        by_label.setdefault(f"{name} ({quantity.unit})" if quantity.unit else name, []).append(quantity)
    return by_label


def uncertainty_band(x: FloatArray, quantity: Field) -> tuple[list[FloatArray], list[FloatArray]]:
    """Outline two standard uncertainties on both sides, for each stretch of frames without a gap: their x and y."""
    if quantity.std is None:
        return [], []
    finite = np.isfinite(quantity.values) & np.isfinite(quantity.std)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], finite, [False]]).astype(int)))
    xs, ys = [], []
    for start, stop in edges.reshape(-1, 2):
        middle, reach = quantity.values[start:stop], 2 * quantity.std[start:stop]
        xs.append(np.concatenate([x[start:stop], x[start:stop][::-1]]))
        ys.append(np.concatenate([middle - reach, (middle + reach)[::-1]]))
    return xs, ys


def _read_probes(
    result: Result, marks: Sequence[Mark], gauge: float, measure: str | None, scale: ScaleSettings | None
) -> Histories:
    """Read the probes that marks make off a result, as `read_histories`, which refuses some of them."""
    return read_histories(result, settings_of_marks(marks, gauge, result.section(ProbeSettings), measure), scale=scale)


def _probe(quantity: Field, names: Iterable[str]) -> str:
    """Return the name of the probe, of some names, that a quantity is of; empty: it is a channel."""
    return max((name for name in names if quantity.name.startswith(f"{name}_")), key=len, default="")


_LINES, _BANDS = "xs ys colour name", "xs ys colour"
_CHANNEL_COLOUR = OKABE_ITO["vermillion"]
"""Colour of a channel beside the curves."""
_HINT = (
    "Choose a probe, click on the field (Gauge, Line, Box, Circle: twice). Drag marks; Backspace removes one. "
    "Keys: ← → a frame, space plays, 1 to 7 sections, Ctrl-Z undoes, Ctrl-Y redoes."
)


class CurvePanel:
    """Plot of the curves of all probes, of channels beside them, and the remarks on them.

    Parameters
    ----------
    document
        Document of the page.
    fields
        What is in view, with its probes and channels.
    controls
        Controls of the page: the choice of curves and channels, and the texts on them.

    Attributes
    ----------
    histories
        Histories of the probes that were read last, with the channels.
    channels
        The channels by the clock of the frames; None: there are none.
    reading
        Whether the probes are being read anew; the histories are those of before until then.
    """

    def __init__(self, document: Document, fields: FieldsInView, controls: ResultControls) -> None:
        self.histories: Histories | None = None
        self.channels: Channels | None = None
        self.reading = False
        self._colours: Mapping[str, str] = {}
        self._probed: Histories | None = None
        self._grabbed: tuple[float, Channels] | None = None
        self._request: object = None
        self._drawn_state: object = None
        self._fields, self._controls, self._reader = fields, controls, Background(document)
        self._lines = bk.ColumnDataSource(columns(_LINES), name="lines")
        self._bands = bk.ColumnDataSource(columns(_BANDS), name="bands")
        self._recorded = bk.ColumnDataSource(columns("xs ys"), name="recorded")
        self._make_plot()
        for event in (PanStart, PanEnd, Pan):
            self.plot.on_event(event, self._drag)
        controls.message.text = _HINT
        controls["curve"].on_change("value", lambda attr, old, new: self.draw())

    def _make_plot(self) -> None:
        wheel, hover, self.pan = bk.WheelZoomTool(visible=False), bk.HoverTool(visible=False), bk.PanTool()
        tools = [self.pan, wheel, bk.BoxZoomTool(), bk.ResetTool(), hover]
        self.plot = plot = plain_plot(tools=tools, title="Curves", toolbar_location="above", name="curves_plot")
        plot.toolbar.update(logo=None, active_scroll=wheel, active_drag=self.pan)
        plot.patches("xs", "ys", source=self._bands, fill_color="colour", fill_alpha=0.25, line_alpha=0)
        style = {"line_color": "colour", "line_width": 1.5, "legend_field": "name"}
        curve_lines = plot.multi_line("xs", "ys", source=self._lines, **style)
        plot.x_range.renderers = plot.y_range.renderers = [curve_lines]  # the values rule, not the widest band
        self._range = bk.Range1d(0, 1)
        plot.extra_y_ranges = {"channel": self._range}
        look: dict[str, Any] = {"line_color": _CHANNEL_COLOUR, "line_dash": "dashed", "y_range_name": "channel"}
        channel_line = plot.multi_line("xs", "ys", source=self._recorded, line_width=1.5, **look)
        texts: dict[str, Any] = dict.fromkeys(("major_label_text_font_size", "axis_label_text_font_size"), "12px")
        self._axis = bk.LinearAxis(
            y_range_name="channel", visible=False, axis_label_text_color=_CHANNEL_COLOUR, **texts
        )
        plot.add_layout(self._axis, "right")
        self._curves, self._all_renderers = [curve_lines], [curve_lines, channel_line]
        hover.update(renderers=[curve_lines], tooltips=[("", "@name"), ("at", "$snap_x"), ("value", "$snap_y")])
        plot.legend.update(visible=False, label_text_font_size="11px", ncols=2)
        plot.add_layout(plot.legend[0], "below")
        self.frame_mark = bk.Span(**FRAME_MARK_STYLE)
        plot.add_layout(self.frame_mark)

    def update(self, colours: Mapping[str, str]) -> None:
        """Show the curves of the probes and channels in view, with the probes' colours by their names.

        Probes that have changed, or are of more frames, are read in another thread; only the last request counts.
        """
        fields, view = self._fields, self._fields.view
        marks = probe_marks(view.marks)
        channels_only = not marks and fields.channels.file is not None
        request = (marks, fields.gauge, view.measure, fields.scale, fields.result, channels_only)
        if request != self._request:
            self._request, self._colours, self.reading = request, colours, bool(marks)
            if marks:
                self._controls.message.text = "reading all frames …"
                work = partial(_read_probes, fields.result, view.marks, fields.gauge, fields.measure, fields.scale)
                self._reader.submit(work, self._receive)
            else:
                self._reader.cancel()
                self._receive(lambda: empty_histories(fields.result.in_units()) if channels_only else None)
        elif self._drawn_state != (fields.channels, view.along, view.beside):
            self._combine()
            self.draw()
        self.offer_choices()
        self.mark_frame(view.frame)

    def offer_choices(self) -> None:
        """Offer channels and curves as they are now."""
        controls, view = self._controls, self._fields.view
        names = [] if self.channels is None else list(self.channels.values)
        quantities = [] if self.histories is None else [quantity.name for quantity in self.histories.quantities]
        probe_quantities = [name for name in quantities if name not in names]
        for entry, blank_label, choices in (
            ("trigger", "choose", names), ("align", "choose", names), ("force", "in N or kN", names),
            ("beside", "none", names), ("align_to", "choose", probe_quantities), ("along", "time", quantities),
        ):  # fmt: skip
            selected = getattr(view, entry)
            controls[entry].options = [
                ("", blank_label),
                *dict.fromkeys([*choices, *([selected] if selected else [])]),
            ]
        clock_entries = {"trigger": "trigger", "align": "correlation", "align_to": "correlation", "offset": "offset"}
        for entry, clock in clock_entries.items():
            controls[entry].visible = view.clock == clock

    def _receive(self, read_result: Callable[[], Histories | None]) -> None:
        self.reading = False
        previous_probes = (
            set() if self._probed is None else {_probe(quantity, self._colours) for quantity in self._probed.quantities}
        )
        try:
            self._probed = read_result()
            remarks = () if self._probed is None else self._probed.remarks
            self._controls.message.text = "<br>".join(map(html.escape, remarks)) or _HINT
        except Exception as error:  # a probe outside the region and the like: reported where the probes are
            self._probed = None
            self._controls.message.text = warning(str(error))
        by_label = self._combine()
        # the chosen quantity stays unless a new probe does not have it
        new_labels = [
            name
            for name, quantities in by_label.items()
            if any(_probe(quantity, self._colours) not in previous_probes for quantity in quantities)
        ]
        candidates, current = new_labels or list(by_label), self._fields.view.curve
        self._controls["curve"].value = current if current in candidates or not candidates else candidates[0]
        self.draw()
        self.offer_choices()
        self.mark_frame(self._fields.view.frame)

    def _combine(self) -> dict[str, list[Field]]:
        """Add the channels as they are stated to the probes; what is wrong with them is reported. Return the groups."""
        settings, view, text = self._fields.channels, self._fields.view, ""
        self.histories, self.channels, self._drawn_state = self._probed, None, (settings, view.along, view.beside)
        if self._probed is not None and settings.file is not None:
            try:
                self.channels = Channels.read(settings.file, settings.offset, settings.trigger)
                self.histories = with_channels(self._probed, settings)
                self.channels = self.histories.channels
                text = "<br>".join(map(html.escape, self.histories.remarks[len(self._probed.remarks) :]))
            except RgbmidicError as error:
                text = warning(str(error))
        self._controls["channel_status"].text = text
        by_label = {} if self.histories is None else group_quantities(self.histories, self._colours)
        self._controls["curve"].options = list(by_label)
        return by_label

    def draw(self) -> None:
        """Draw the chosen curve of all probes."""
        label, (x, axis), bands, lines = self._controls["curve"].value, self._x, [], []
        by_label = {} if self.histories is None else group_quantities(self.histories, self._colours)
        for quantity in by_label.get(label, []):
            colour = self._colours.get(_probe(quantity, self._colours), OKABE_ITO["grey"])
            if not self._x_quantity:
                bands += [(xs, ys, colour) for xs, ys in zip(*uncertainty_band(x, quantity), strict=True)]
            lines.append((x, quantity.values, colour, quantity.name.replace("_", " ")))
        self._bands.data, self._lines.data = columns(_BANDS, bands), columns(_LINES, lines)
        has_histories = self.histories is not None
        self.plot.xaxis.axis_label, self.plot.yaxis[0].axis_label = (axis, label) if has_histories else (None, None)
        self.plot.legend.visible = has_histories
        self._draw_channel(self.channels)

    def figure(self) -> Figure | None:
        """Draw the chosen curve of all probes for print; None where there is none."""
        label = self._controls["curve"].value
        if (
            self.reading
            or self.histories is None
            or label not in (by_label := group_quantities(self.histories, self._colours))
        ):
            return None
        return history_figure(self.histories, [(label, by_label[label])])

    def _draw_channel(self, channels: Channels | None) -> None:
        """Draw the channel beside the curves as it was recorded, around the frames or, off them, all of it."""
        rows, times, name = [], None if self.histories is None else self.histories.times, self._fields.view.beside
        self.plot.x_range.renderers = self._curves
        if channels is not None and name in channels.values and times is not None and not self._x_quantity:
            start, end = np.nanmin(times), np.nanmax(times)
            bounds = np.searchsorted(channels.times, [2 * start - end, 2 * end - start])
            visible = slice(*bounds) if bounds[0] < bounds[1] else slice(None)
            x, y = _decimate(time_unit(times)[0] * channels.times[visible], channels.values[name][visible])
            rows = [(x, y)]
            low, high = np.nanmin(y), np.nanmax(y)
            margin = 0.1 * (high - low or 1.0)  # as of Bokeh's own ranges
            self._range.update(start=low - margin, end=high + margin)
            if bounds[0] == bounds[1] or not self._lines.data["xs"]:
                self.plot.x_range.renderers = self._all_renderers
        self._recorded.data = columns("xs ys", rows)
        self._axis.update(visible=bool(rows), axis_label=name)

    def _drag(self, event: Any) -> None:
        """Move the channels along the time with the pointer; their offset is stated where it lets go."""
        controls, times = self._controls, None if self.histories is None else self.histories.times
        if not controls["drag"].active or event.x is None:
            return
        if isinstance(event, PanStart):
            self._grabbed = None if self.channels is None or self._x_quantity else (event.x, self.channels)
        if self._grabbed is None or times is None:
            return
        grab_x, channels = self._grabbed
        shifted = channels.with_offset((event.x - grab_x) / time_unit(times)[0])
        self._draw_channel(shifted)
        controls["drag"].label = f"Offset {shifted.offset:.6g} s"
        if isinstance(event, PanEnd):
            controls["clock"].value, controls["offset"].value = (
                "offset",
                float(f"{shifted.offset:.9g}"),
            )

    def mark_frame(self, frame: int) -> None:
        """Mark a frame, where the curves hold it."""
        positions = [] if self.histories is None else self._x[0][self.histories.frames == frame]
        self.frame_mark.location = float(positions[0]) if len(positions) and np.isfinite(positions[0]) else None

    def frame_at(self, x: float) -> int:
        """Return the index of the frame at a place of the axis."""
        if self.histories is None or not np.isfinite(self._x[0]).any():
            return self._fields.view.frame
        return int(self.histories.frames[np.nanargmin(np.abs(self._x[0] - x))])

    @property
    def _x_quantity(self) -> Field | None:
        """The quantity along x; None: the time."""
        quantities = () if self.histories is None else self.histories.quantities
        return next((quantity for quantity in quantities if quantity.name == self._fields.view.along), None)

    @property
    def _x(self) -> tuple[FloatArray, str]:
        """Places of the frames along x, and what they are."""
        if self.histories is None:
            return np.zeros(0), ""
        if (x_quantity := self._x_quantity) is not None:
            return (
                x_quantity.values,
                f"{x_quantity.name.replace('_', ' ')} ({x_quantity.unit})" if x_quantity.unit else x_quantity.name,
            )
        return time_axis(self.histories.times, self.histories.frames)


def _decimate(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Thin a curve out to the smallest and the largest value of each stretch of what a screen shows."""
    step = -(-len(y) // VIEWER.screen_columns)
    if step < 3:
        return x, y
    rows = y[: len(y) // step * step].reshape(-1, step)
    first_index = step * np.arange(len(rows))
    indices = np.unique([first_index + rows.argmin(axis=1), first_index + rows.argmax(axis=1)])
    return x[indices], y[indices]
