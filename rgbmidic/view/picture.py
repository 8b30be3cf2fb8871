"""Picture of a field on the screen: window of the image, images, colours and their range, the plot that shows it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import bokeh.models as bk
import cv2
import numpy as np
import numpy.typing as npt
from bokeh.core.property.descriptors import UnsetValueError
from bokeh.document import Document
from bokeh.events import RangesUpdate
from bokeh.plotting import figure

from rgbmidic._kernels.picture import paint_field
from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.report.style import STATUS_COLOURS, colour_range, ordinary_values, resampled, view_limits
from rgbmidic.results import MapValues, Profile, Result
from rgbmidic.settings import TestSettings
from rgbmidic.typing import AnyArray, FloatArray
from rgbmidic.view.address import Mark
from rgbmidic.view.constants import VIEWER

Picture = npt.NDArray[np.uint8]
"""A grey picture (H, W)."""

AROUND = {False: 235, True: 30}
"""Grey level outside the image, by whether the page is dark."""
_SIDES, _APART = ("#010203", "#ffffff"), 8
"""Colours of what lies below and above 0, of which the first is no grey, and pixels from one hatch to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The part of the image that the screen shows.

    Attributes
    ----------
    left, top, right, bottom
        Edges in px of the image, where the centre of the first pixel is (0, 0).
    width, height
        Pixels of the screen.
    """

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return self.left, self.top, self.right, self.bottom

    def fitted(self) -> Window:
        """Widen the window to as many screen pixels per px in both directions, about the same centre."""
        step = max((self.right - self.left) / self.width, (self.bottom - self.top) / self.height)
        x, y = (self.left + self.right) / 2, (self.top + self.bottom) / 2
        half_x, half_y = step * self.width / 2, step * self.height / 2
        return replace(self, left=x - half_x, top=y - half_y, right=x + half_x, bottom=y + half_y)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        shrink = max(1.0, (self.width * self.height / VIEWER.picture_pixels) ** 0.5)
        return max(int(self.height / shrink), 2), max(int(self.width / shrink), 2)

    @property
    def steps(self) -> tuple[float, float]:
        """Px of the image to a pixel of the picture, along x and y."""
        rows, columns = self.size
        return (self.right - self.left) / columns, (self.bottom - self.top) / rows

    def place(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row of points (N, 2) in the picture."""
        across, down = self.steps
        return (points[:, 0] - self.left) / across - 0.5, (points[:, 1] - self.top) / down - 0.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Overlay:
    """A nodal field as it is painted over an image.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2)
        Places of the nodes in px.
    elements : ndarray, shape (E, 3)
        Nodes of the triangles.
    values : ndarray, shape (N,)
        Values at the nodes; triangles with a NaN are not painted.
    ends
        Values of the first and the last colour.
    colours
        As ``"#rrggbb"``.
    opacity
        Opacity of the field, from 0 to 1.
    stepped
        Whether values between those of two nodes mean nothing.
    beyond : ndarray, shape (N,), or None
        What is hatched where it is below 0; None: nothing.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    values: FloatArray
    ends: tuple[float, float]
    colours: tuple[str, ...]
    opacity: float = 1.0
    stepped: bool = False
    beyond: FloatArray | None = None


def paint(window: Window, picture: AnyArray, over: Overlay | None = None, around: int = 40) -> npt.NDArray[np.uint32]:
    """Paint a grey picture, and a field over it, as the window shows them.

    Parameters
    ----------
    window
        Part of the image and size of the screen.
    picture : ndarray, shape (H, W), uint8
        The image.
    over
        The field; None: the picture alone.
    around
        Grey level outside the image.

    Returns
    -------
    ndarray, shape (rows, columns), uint32
        Red, green, blue, 255, the lowest byte first; the first row is the top.
    """
    first = (window.left + window.steps[0] / 2, window.top + window.steps[1] / 2)
    grey = resampled(picture, window.steps, first, window.size, around, nearest=min(window.steps) <= 0.5)
    if over is None:
        return grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    out = np.empty(grey.shape, dtype=np.uint32)
    (x, y), grey_part = window.place(over.nodes), round(256 * (1 - over.opacity))
    packed = _packed(over.colours, grey_part)
    paint_field(out, grey, x, y, over.elements, over.values, *map(float, over.ends), packed, grey_part, over.stepped)
    if over.beyond is not None:
        below, lines = np.empty_like(out), sum(np.indices(out.shape)) % _APART < 2
        reach = float(np.nanmax(np.abs(over.beyond), initial=0)) or 1.0
        paint_field(below, grey, x, y, over.elements, over.beyond, -reach, reach, _packed(_SIDES, 0), 0, False)
        out[lines & (below == _packed(_SIDES, 0)[0])] = 0xFF000000
    return out


@cache
def _packed(colours: tuple[str, ...], grey_part: int) -> npt.NDArray[np.uint32]:
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in colours], dtype=np.uint32)
    red, green, blue = (rgb * (256 - grey_part) >> 8).T
    return np.asarray(red | green << 8 | blue << 16 | 0xFF000000, dtype=np.uint32)


@cache
def palette(name: str, levels: int = 256) -> tuple[str, ...]:
    """Return so many colours of a palette, up to 256 as a screen has levels, as ``"#rrggbb"``."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    places = np.linspace(0, 1, min(max(levels, 2), 256))
    return STATUS_COLOURS if name == "codes" else tuple(map(to_hex, colormaps[name](places)))


def grey_picture(frame: Mosaic | ChannelFrame) -> Picture:
    """Return a raw frame as one stretched picture: the mean of its channels, or of the cell around each sample."""
    if isinstance(frame, Mosaic):
        return stretched(cv2.blur(frame.values.astype(np.float32), (2, 2)))
    return stretched(frame.values.mean(axis=0, dtype=np.float32))


@dataclass(frozen=True, kw_only=True, eq=False)
class RawPictures:
    """Pictures of the raw frames of a result, read where they still exist; picklable until the first is read.

    Attributes
    ----------
    result
        The result.
    """

    result: Result

    @cached_property
    def _series(self) -> FrameSeries:
        provenance = self.result.provenance
        if "settings" not in provenance:
            raise FrameError(
                f"{self.result.path} does not state where its raw frames are: it was not measured from files"
            )
        settings = TestSettings.from_mapping(provenance["settings"], provenance["base"])
        return open_series(settings.frames, settings.base)

    def __call__(self, index: int) -> Picture:
        """Read the frame of an index in the result; errors as those of the frames' reader."""
        return grey_picture(self._series.read(self._series.selected[index])[0])


def reference_picture(result: Result) -> Picture:
    """Return the mean of the lights' reference images that a result keeps, grey where none was kept."""
    images, (left, top) = result.reference, result.reference_origin
    columns, rows = np.ceil(result.nodes.max(axis=0) + 1).astype(int)
    picture = np.full(result.frame_shape or (rows, columns), 60, dtype=np.uint8)
    if images is not None:
        picture[top : top + images.shape[1], left : left + images.shape[2]] = images.mean(axis=0)
    return picture


def stretched(image: AnyArray) -> Picture:
    """Stretch an image (H, W) between its 1 % and 99 % quantiles, of every fourth pixel, to 0 to 255; NaN is 0."""
    finite = image[::4, ::4][np.isfinite(image[::4, ::4])]
    low, high = np.percentile(finite, [1, 99]) if finite.size else (0.0, 1.0)
    return np.asarray(np.clip(255 * (np.nan_to_num(image) - low) / max(high - low, 1e-6), 0, 255), dtype=np.uint8)


def element_at(
    nodes: FloatArray, elements: npt.NDArray[np.int32], x: float, y: float
) -> tuple[npt.NDArray[np.int32], FloatArray] | None:
    """Return the nodes (3,) of the element that holds a point, and their shape functions (3,); None outside."""
    xs, ys = (nodes[elements] - (x, y)).transpose(2, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        areas = np.roll(xs, -1, axis=1) * np.roll(ys, 1, axis=1) - np.roll(xs, 1, axis=1) * np.roll(ys, -1, axis=1)
        shape = areas / areas.sum(axis=1, keepdims=True)  # of the triangles between the place and the opposite sides
        inside = np.flatnonzero(shape.min(axis=1) >= -1e-9)
    return (elements[inside[0]], shape[inside[0]]) if len(inside) else None


def robust_range(read: MapValues | Profile) -> tuple[float, float] | None:
    """Return the colour range of what was read without doubtful nodes and outliers; None where nothing is measured."""
    ordinary = ordinary_values(read.values, read.std)
    return colour_range(ordinary) if ordinary.size else None


IMAGE = "image x y dw dh"
"""Columns of the data of a picture on a plot."""


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
        self.plot: Any
        left, top, right, bottom = self.wanted = tuple(map(float, edges))
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
        self._image = bk.ColumnDataSource(columns(IMAGE), name=names[0])
        self.plot.image_rgba(*IMAGE.split(), source=self._image)
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
        self.plot.on_event(RangesUpdate, (like or self)._moved)
        if like:
            self.plot.toolbar_location = None
            return
        self.plot.name = "plot"
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
        self._image.data = columns(IMAGE, [(image, w.left, w.top, w.right - w.left, w.bottom - w.top)])

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
        self._image.data = columns(IMAGE)
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
