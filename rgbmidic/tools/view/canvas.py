"""Plot of a part of the image: field, colour bar, marks, and the tools to move it and to set marks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import bokeh.models as bk
import numpy as np
from bokeh.core.property.descriptors import UnsetValueError
from bokeh.document import Document
from bokeh.events import RangesUpdate
from bokeh.plotting import figure

from rgbmidic.tools.report.painter import ImageWindow
from rgbmidic.tools.report.style import view_limits
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.marks import Mark
from rgbmidic.typing import AnyArray, FloatArray

IMAGE = "image x y dw dh"
"""Columns of the data of a picture on a plot."""


def plain_plot(**options: Any) -> Any:
    """Make a plot that fills its place, with the text size of the page and no tools; `options` of bokeh's `figure`."""
    defaults = {"sizing_mode": "stretch_both", "min_border": 4, "tools": [], "toolbar_location": None}
    plot = figure(**{**defaults, **options})
    for axis in plot.axis:
        axis.update(major_label_text_font_size="12px", axis_label_text_font_size="12px")
    return plot


def columns(names: str, rows: Iterable[Sequence[Any]] = ()) -> dict[str, list[Any]]:
    """Return the columns of a data source, by their names with spaces between them, from rows of values."""
    values = [list(column) for column in zip(*rows, strict=True)]
    return dict(zip(names.split(), values or [[] for _ in names.split()], strict=True))


class Canvas:
    """Plot of a window of the image: field, colour bar, marks, and the tools to move it and to set marks.

    The browser sets marks while the server is busy, so that what either of them sends may cross what the other sent.
    Each state of the marks that the server sends has a number, the name of a column that the browser sends back; what
    the browser sends is the difference from that state, which is merged.

    Parameters
    ----------
    document
        Document of the page.
    kinds
        Kinds of the marks that can be set, with a tool each.
    edges
        Edges (left, top, right, bottom) of the view at first, px.
    redraw
        Called when another part, or another size, is in view.
    neighbour
        Canvas beside it, whose part of the image it shows too.

    Attributes
    ----------
    plot, marks, tools
        The plot, the marks on it, and its tools: to move it, then one for each of `kinds`.
    current_marks
        The marks as they were placed, with what was set, moved and removed on the plot since.
    window
        The part of the image in view.
    requested_edges
        Edges that were asked for, before the plot's shape adds to them.
    """

    def __init__(
        self,
        document: Document,
        kinds: Sequence[str],
        edges: Sequence[float],
        redraw: Callable[[], None],
        neighbour: Canvas | None = None,
    ) -> None:
        self.plot: Any
        x_min, y_min, x_max, y_max = self.requested_edges = tuple(map(float, edges))
        self.window = ImageWindow(
            x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max, width=800, height=600
        ).fit_aspect()
        self._document, self._redraw, self._redraw_pending = document, redraw, False
        self.plot = plain_plot(
            x_range=neighbour.plot.x_range if neighbour else bk.Range1d(self.window.x_min, self.window.x_max),
            y_range=neighbour.plot.y_range if neighbour else bk.Range1d(self.window.y_max, self.window.y_min),
            **{"title": " ", "min_border_right": VIEWER.bar_width, "toolbar_location": "above"},
        )
        self.plot.grid.visible = False
        self._numbered: tuple[str, float] | None = None
        self.number_axes("px", 1.0)
        names = ("image", "colours", "marks") if neighbour is None else (None,) * 3
        self._image = bk.ColumnDataSource(columns(IMAGE), name=names[0])
        self.plot.image_rgba(*IMAGE.split(), source=self._image)
        self.colours = bk.LinearColorMapper(palette=["#000000"], low=0, high=1, name=names[1])
        numbers = bk.BasicTickFormatter(power_limit_low=-6)  # else each number has a power of ten of its own
        look = {"width": 14, "major_label_text_font_size": "12px", "formatter": numbers}
        self.bar = bk.ColorBar(color_mapper=self.colours, visible=False, ticker=bk.BasicTicker(), **look)
        self.plot.add_layout(self.bar, "right")
        self.marks = bk.ColumnDataSource(columns("x y kind name 0"), name=names[2])
        self._states, self.current_marks = {0: list[Mark]()}, list[Mark]()
        self.marks.on_change("data", lambda attr, old, new: self._merge_marks())
        dot = {"size": 9, "fill_color": "white", "line_color": "black", "line_width": 1.5}
        dots = self.plot.scatter("x", "y", source=self.marks, level="overlay", **dot)
        pan, wheel = bk.PanTool(), bk.WheelZoomTool(zoom_on_axis=False)
        tool_options = {"renderers": [dots], "visible": False}
        draw = [bk.PointDrawTool(default_overrides={"kind": kind, "name": ""}, **tool_options) for kind in kinds]
        self.tools = (pan, *draw)
        box, reset, save = bk.BoxZoomTool(match_aspect=True), bk.ResetTool(), bk.SaveTool(filename="field")
        self.plot.add_tools(pan, wheel, box, reset, save, *draw)
        self.plot.toolbar.active_drag, self.plot.toolbar.active_scroll, self.plot.toolbar.logo = pan, wheel, None
        self.plot.on_event(RangesUpdate, (neighbour or self)._receive_ranges)
        if neighbour:
            self.plot.toolbar_location = None
            return
        self.plot.name = "plot"
        for name in ("inner_width", "inner_height"):
            self.plot.on_change(name, lambda attr, old, new: self.resize())

    @staticmethod
    def edges_around(points: FloatArray) -> tuple[float, ...]:
        """Return the edges (left, top, right, bottom) of a view of points (N, 2) with a margin."""
        low, high = view_limits(points)
        return (*low.tolist(), *high.tolist())

    def show_picture(self, image: AnyArray, window: ImageWindow | None = None) -> None:
        """Show a picture (rows, columns), uint32, of the window, or of that of the canvas beside it."""
        view = window or self.window
        self._image.data = columns(
            IMAGE, [(image, view.x_min, view.y_min, view.x_max - view.x_min, view.y_max - view.y_min)]
        )

    def number_axes(self, unit: str, factor: float) -> None:
        """Number the axes in a unit of which a px has `factor`, at round numbers."""
        if self._numbered == (unit, factor):  # as in nearly every frame
            return
        self._numbered = unit, factor
        steps = [step / factor for step in (1, 2, 5)]
        mantissas = sorted(step / 10 ** math.floor(math.log10(step)) for step in steps)
        text = bk.CustomJSTickFormatter(args={"factor": factor}, code="return `${+(factor * tick).toPrecision(6)}`")
        for name, (axis,) in zip("xy", (self.plot.xaxis, self.plot.yaxis), strict=True):
            axis.update(axis_label=f"{name} ({unit})", ticker=bk.AdaptiveTicker(mantissas=mantissas), formatter=text)

    def clear(self) -> None:
        """Show neither picture nor colour bar."""
        self._image.data = columns(IMAGE)
        self.plot.title.text, self.bar.visible = " ", False

    def set_colour_bar(
        self, limits: tuple[float, float], colours: Sequence[str], title: str, codes: Sequence[str] = ()
    ) -> None:
        """Set the colour bar: values of its ends, colours and title; names of `codes` as numbers."""
        self.plot.title.text, self.bar.visible = title, True
        names = dict(enumerate(codes))
        if self.bar.major_label_overrides != names:
            size = "10px" if codes else "12px"  # the plot keeps its size
            self.bar.update(major_label_overrides=names, major_label_text_font_size=size)
            self.bar.ticker.min_interval = int(bool(codes))  # the page does not see another ticker
        self.colours.update(low=limits[0], high=limits[1])
        if self.colours.palette != list(colours):  # which takes as long to check as a frame to paint
            self.colours.palette = list(colours)

    def place_marks(self, marks: Sequence[Mark]) -> None:
        """Place marks on the plot, unless they are there."""
        self.current_marks, last_state = list(marks), max(self._states)
        if self._states[last_state] != self.current_marks:
            self._states[last_state + 1] = self.current_marks
            self._states = dict(list(self._states.items())[-VIEWER.mark_states :])
            rows = [(mark.x, mark.y, mark.kind, mark.name, 0) for mark in marks]
            self.marks.data = columns(f"x y kind name {last_state + 1}", rows)

    def _merge_marks(self) -> None:
        """Take what the browser has set, moved or removed since the state that it had."""
        data = self.marks.data
        state = max((int(key) for key in data if key.isdigit()), default=max(self._states))
        rows = zip(*(data[key] for key in ("kind", "x", "y", "name")), strict=True)
        present = [Mark(str(kind), float(x), float(y), str(name)) for kind, x, y, name in rows]
        previous = remaining = self._states[state]
        if len(present) < len(previous):  # some were removed, the others are in their order
            remaining = []
            for mark in previous:
                if present[len(remaining) : len(remaining) + 1] == [mark]:
                    remaining.append(mark)
        present = [replace(mark, key=match.key) for mark, match in zip(present, remaining, strict=False)] + present[
            len(remaining) :
        ]
        self._states[state] = present
        old_marks, new_marks = ({mark.key: mark for mark in marks} for marks in (previous, present))
        moved_marks = {key: mark for key, mark in new_marks.items() if mark != old_marks.get(key, mark)}
        self.current_marks = [
            replace(mark, x=moved_marks[mark.key].x, y=moved_marks[mark.key].y) if mark.key in moved_marks else mark
            for mark in self.current_marks
            if mark.key in new_marks or mark.key not in old_marks
        ] + [mark for key, mark in new_marks.items() if key not in old_marks]

    def resize(self) -> None:
        """Take the size that the browser reports."""
        try:
            width, height = self.plot.inner_width, self.plot.inner_height
        except UnsetValueError:  # it has not reported yet
            return
        if min(width, height) > 1 and (width, height) != (self.window.width, self.window.height):
            edges = dict(zip(("x_min", "y_min", "x_max", "y_max"), self.requested_edges, strict=True))
            self._set_window(replace(self.window, **edges, width=width, height=height))

    def _receive_ranges(self, event: Any) -> None:
        (x_min, x_max), (y_min, y_max) = sorted((event.x0, event.x1)), sorted((event.y0, event.y1))
        window = replace(self.window, x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max)
        if not np.allclose(window.edges, self.window.edges, rtol=0, atol=1e-6 * (x_max - x_min)):
            self.requested_edges = window.edges
            self._set_window(window)

    def _set_window(self, window: ImageWindow) -> None:
        """Show another window, once for all moves within a few ms."""
        self.window = window.fit_aspect()
        if not np.allclose(self.window.edges, window.edges):
            self.plot.x_range.update(start=self.window.x_min, end=self.window.x_max)
            self.plot.y_range.update(start=self.window.y_max, end=self.window.y_min)

        def redraw_once() -> None:
            self._redraw_pending = False
            self._redraw()

        if not self._redraw_pending:
            self._redraw_pending = True
            self._document.add_timeout_callback(redraw_once, VIEWER.view_ms)
