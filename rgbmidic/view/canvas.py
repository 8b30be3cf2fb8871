"""Plot of the image window with its field and marks."""

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

from rgbmidic.report.style import view_limits
from rgbmidic.typing import AnyArray, FloatArray
from rgbmidic.view.address import Mark
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.picture import Window

_IMAGE = "image x y dw dh"


def plain_plot(**options: Any) -> Any:
    """Plot as large as its place, with the text size of the page and no tools; `options` of bokeh's `figure` count."""
    plain = {"sizing_mode": "stretch_both", "min_border": 4, "tools": [], "toolbar_location": None}
    plot = figure(**{**plain, **options})
    for axis in plot.axis:
        axis.update(major_label_text_font_size="12px", axis_label_text_font_size="12px")
    return plot


def columns(names: str, rows: Iterable[Sequence[Any]] = ()) -> dict[str, list[Any]]:
    """Columns of a data source, by their names with spaces between them, from rows of values."""
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
    like
        Canvas beside it, whose part of the image it shows too.

    Attributes
    ----------
    plot, marks, tools
        The plot, the marks on it, and its tools: to move it, then one for each of `kinds`.
    set
        The marks as they were placed, with what was set, moved and removed on the plot since.
    window
        The part of the image in view.
    wanted
        Edges that were asked for, before the plot's shape adds to them.
    """

    def __init__(
        self,
        document: Document,
        kinds: Sequence[str],
        edges: Sequence[float],
        redraw: Callable[[], None],
        like: Canvas | None = None,
    ) -> None:
        left, top, right, bottom = self.wanted = tuple(map(float, edges))
        self.plot: Any
        self.window = Window(left=left, top=top, right=right, bottom=bottom, width=800, height=600).fitted()
        self._document, self._redraw, self._coming = document, redraw, False
        self.plot = plain_plot(
            x_range=like.plot.x_range if like else bk.Range1d(self.window.left, self.window.right),
            y_range=like.plot.y_range if like else bk.Range1d(self.window.bottom, self.window.top),
            **{"title": " ", "min_border_right": VIEWER.bar_width, "toolbar_location": "above"},
        )
        self.plot.grid.visible = False
        self._numbered: tuple[str, float] | None = None
        self.number("px", 1.0)
        names = ("image", "colours", "marks") if like is None else (None,) * 3
        self._image = bk.ColumnDataSource(columns(_IMAGE), name=names[0])
        self.plot.image_rgba(*_IMAGE.split(), source=self._image)
        self.colours = bk.LinearColorMapper(palette=["#000000"], low=0, high=1, name=names[1])
        numbers = bk.BasicTickFormatter(power_limit_low=-6)  # else each number has a power of ten of its own
        look = {"width": 14, "major_label_text_font_size": "12px", "formatter": numbers}
        self.bar = bk.ColorBar(color_mapper=self.colours, visible=False, ticker=bk.BasicTicker(), **look)
        self.plot.add_layout(self.bar, "right")
        self.marks = bk.ColumnDataSource(columns("x y kind name 0"), name=names[2])
        self._states, self.set = {0: list[Mark]()}, list[Mark]()
        self.marks.on_change("data", lambda attr, old, new: self._merge())
        dot = {"size": 9, "fill_color": "white", "line_color": "black", "line_width": 1.5}
        dots = self.plot.scatter("x", "y", source=self.marks, level="overlay", **dot)
        pan, wheel = bk.PanTool(), bk.WheelZoomTool(zoom_on_axis=False)
        hidden = {"renderers": [dots], "visible": False}
        draw = [bk.PointDrawTool(default_overrides={"kind": kind, "name": ""}, **hidden) for kind in kinds]
        self.tools = (pan, *draw)
        box, reset, save = bk.BoxZoomTool(match_aspect=True), bk.ResetTool(), bk.SaveTool(filename="field")
        self.plot.add_tools(pan, wheel, box, reset, save, *draw)
        self.plot.toolbar.active_drag, self.plot.toolbar.active_scroll, self.plot.toolbar.logo = pan, wheel, None
        if like:
            self.plot.toolbar_location = None
            self.plot.on_event(RangesUpdate, like._moved)
            return
        self.plot.name = "plot"
        self.plot.on_event(RangesUpdate, self._moved)
        for name in ("inner_width", "inner_height"):
            self.plot.on_change(name, lambda attr, old, new: self.resize())

    @staticmethod
    def around(points: FloatArray) -> tuple[float, ...]:
        """Return the edges (left, top, right, bottom) of a view of points (N, 2) with a margin."""
        low, high = view_limits(points)
        return (*low.tolist(), *high.tolist())

    def show(self, image: AnyArray, window: Window | None = None) -> None:
        """Show a picture (rows, columns), uint32, of the window, or of that of the canvas beside it."""
        w = window or self.window
        self._image.data = columns(_IMAGE, [(image, w.left, w.top, w.right - w.left, w.bottom - w.top)])

    def number(self, unit: str, factor: float) -> None:
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
        self._image.data = columns(_IMAGE)
        self.plot.title.text, self.bar.visible = " ", False

    def colour(self, ends: tuple[float, float], colours: Sequence[str], title: str, codes: Sequence[str] = ()) -> None:
        """Set the colour bar: values of its ends, colours and title; names of `codes` as numbers."""
        self.plot.title.text, self.bar.visible = title, True
        names = dict(enumerate(codes))
        if self.bar.major_label_overrides != names:
            size = "10px" if codes else "12px"  # the plot keeps its size
            self.bar.update(major_label_overrides=names, major_label_text_font_size=size)
            self.bar.ticker.min_interval = int(bool(codes))  # the page does not see another ticker
        self.colours.update(low=ends[0], high=ends[1])
        if self.colours.palette != list(colours):  # which takes as long to check as a frame to paint
            self.colours.palette = list(colours)

    def place(self, marks: Sequence[Mark]) -> None:
        """Place marks on the plot, unless they are there."""
        self.set, last = list(marks), max(self._states)
        if self._states[last] != self.set:
            self._states[last + 1] = self.set
            self._states = dict(list(self._states.items())[-VIEWER.mark_states :])
            rows = [(mark.x, mark.y, mark.kind, mark.name, 0) for mark in marks]
            self.marks.data = columns(f"x y kind name {last + 1}", rows)

    def _merge(self) -> None:
        """Take what the browser has set, moved or removed since the state that it had."""
        data = self.marks.data
        state = max((int(key) for key in data if key.isdigit()), default=max(self._states))
        rows = zip(*(data[key] for key in ("kind", "x", "y", "name")), strict=True)
        now = [Mark(str(kind), float(x), float(y), str(name)) for kind, x, y, name in rows]
        before = kept = self._states[state]
        if len(now) < len(before):  # some were removed, the others are in their order
            kept = []
            for mark in before:
                if now[len(kept) : len(kept) + 1] == [mark]:
                    kept.append(mark)
        now = [replace(mark, key=same.key) for mark, same in zip(now, kept, strict=False)] + now[len(kept) :]
        self._states[state] = now
        old, new = ({mark.key: mark for mark in marks} for marks in (before, now))
        moved = {key: mark for key, mark in new.items() if mark != old.get(key, mark)}
        self.set = [
            replace(mark, x=moved[mark.key].x, y=moved[mark.key].y) if mark.key in moved else mark
            for mark in self.set
            if mark.key in new or mark.key not in old
        ] + [mark for key, mark in new.items() if key not in old]

    def resize(self) -> None:
        """Take the size that the browser reports."""
        try:
            width, height = self.plot.inner_width, self.plot.inner_height
        except UnsetValueError:  # it has not reported yet
            return
        if min(width, height) > 1 and (width, height) != (self.window.width, self.window.height):
            edges = dict(zip(("left", "top", "right", "bottom"), self.wanted, strict=True))
            self._set(replace(self.window, **edges, width=width, height=height))

    def _moved(self, event: Any) -> None:
        (left, right), (top, bottom) = sorted((event.x0, event.x1)), sorted((event.y0, event.y1))
        new = replace(self.window, left=left, top=top, right=right, bottom=bottom)
        if not np.allclose(new.edges, self.window.edges, rtol=0, atol=1e-6 * (right - left)):
            self.wanted = new.edges
            self._set(new)

    def _set(self, window: Window) -> None:
        """Show another window, once for all moves within a few ms."""
        self.window = window.fitted()
        if not np.allclose(self.window.edges, window.edges):
            self.plot.x_range.update(start=self.window.left, end=self.window.right)
            self.plot.y_range.update(start=self.window.bottom, end=self.window.top)

        def come() -> None:
            self._coming = False
            self._redraw()

        if not self._coming:
            self._coming = True
            self._document.add_timeout_callback(come, VIEWER.view_ms)
