"""The panel of a result's page that shows curves over time, read off all frames beside the page."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxZoomTool,
    ColumnDataSource,
    Div,
    HoverTool,
    PanTool,
    ResetTool,
    Select,
    Span,
    WheelZoomTool,
)
from bokeh.plotting import figure

from rgbmidic.results import Histories, Result
from rgbmidic.view import curves
from rgbmidic.view.address import Mark
from rgbmidic.view.canvas import small
from rgbmidic.view.timeline import NOW

__all__ = ["CurvePanel"]

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
