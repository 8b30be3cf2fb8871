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
from rgbmidic.results import Field, Result
from rgbmidic.settings import TestSettings
from rgbmidic.tools.report.style import STATUS_COLOURS, colour_range, ordinary_values, resample, view_limits
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.url_state import Mark
from rgbmidic.typing import AnyArray, FloatArray

Picture = npt.NDArray[np.uint8]
"""A grey picture (H, W)."""

OUTSIDE_GREY = {False: 235, True: 30}
"""Grey level outside the image, by whether the page is dark."""
_HATCH_COLOURS, _HATCH_SPACING = ("#010203", "#ffffff"), 8
"""Colours of what lies below and above 0, of which the first is no grey, and pixels from one hatch to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageWindow:
    """The part of the image that the screen shows.

    Attributes
    ----------
    x_min, y_min, x_max, y_max
        Edges in px of the image, where the centre of the first pixel is (0, 0).
    width, height
        Pixels of the screen.
    """

    x_min: float
    y_min: float
    x_max: float
    y_max: float
    width: int
    height: int

    @property
    def edges(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom."""
        return self.x_min, self.y_min, self.x_max, self.y_max

    def fit_aspect(self) -> ImageWindow:
        """Widen the window to as many screen pixels per px in both directions, about the same centre."""
        step = max((self.x_max - self.x_min) / self.width, (self.y_max - self.y_min) / self.height)
        x, y = (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2
        half_x, half_y = step * self.width / 2, step * self.height / 2
        return replace(self, x_min=x - half_x, y_min=y - half_y, x_max=x + half_x, y_max=y + half_y)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the picture."""
        shrink = max(1.0, (self.width * self.height / VIEWER.picture_pixels) ** 0.5)
        return max(int(self.height / shrink), 2), max(int(self.width / shrink), 2)

    @property
    def steps(self) -> tuple[float, float]:
        """Px of the image to a pixel of the picture, along x and y."""
        rows, columns = self.size
        return (self.x_max - self.x_min) / columns, (self.y_max - self.y_min) / rows

    def to_picture(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return column and row of points (N, 2) in the picture."""
        x_step, y_step = self.steps
        return (points[:, 0] - self.x_min) / x_step - 0.5, (points[:, 1] - self.y_min) / y_step - 0.5


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
    colour_range
        Values of the first and the last colour.
    colours
        As ``"#rrggbb"``.
    opacity
        Opacity of the field, from 0 to 1.
    stepped
        Whether values between those of two nodes mean nothing.
    hatch_margin : ndarray, shape (N,), or None
        What is hatched where it is below 0; None: nothing.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int32]
    values: FloatArray
    colour_range: tuple[float, float]
    colours: tuple[str, ...]
    opacity: float = 1.0
    stepped: bool = False
    hatch_margin: FloatArray | None = None


def paint(
    window: ImageWindow, picture: AnyArray, overlay: Overlay | None = None, outside_grey: int = 40
) -> npt.NDArray[np.uint32]:
    """Paint a grey picture, and a field over it, as the window shows them.

    Parameters
    ----------
    window
        Part of the image and size of the screen.
    picture : ndarray, shape (H, W), uint8
        The image.
    overlay
        The field; None: the picture alone.
    outside_grey
        Grey level outside the image.

    Returns
    -------
    ndarray, shape (rows, columns), uint32
        Red, green, blue, 255, the lowest byte first; the first row is the top.
    """
    origin = (window.x_min + window.steps[0] / 2, window.y_min + window.steps[1] / 2)
    grey = resample(picture, window.steps, origin, window.size, outside_grey, nearest=min(window.steps) <= 0.5)
    if overlay is None:
        return grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    out = np.empty(grey.shape, dtype=np.uint32)
    (x, y), grey_part = window.to_picture(overlay.nodes), round(256 * (1 - overlay.opacity))
    packed = _packed(overlay.colours, grey_part)
    paint_field(
        out,
        grey,
        x,
        y,
        overlay.elements,
        overlay.values,
        *map(float, overlay.colour_range),
        packed,
        grey_part,
        overlay.stepped,
    )
    if overlay.hatch_margin is not None:
        hatched, lines = np.empty_like(out), sum(np.indices(out.shape)) % _HATCH_SPACING < 2
        reach = float(np.nanmax(np.abs(overlay.hatch_margin), initial=0)) or 1.0
        paint_field(
            hatched,
            grey,
            x,
            y,
            overlay.elements,
            overlay.hatch_margin,
            -reach,
            reach,
            _packed(_HATCH_COLOURS, 0),
            0,
            False,
        )
        out[lines & (hatched == _packed(_HATCH_COLOURS, 0)[0])] = 0xFF000000
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

    positions = np.linspace(0, 1, min(max(levels, 2), 256))
    return STATUS_COLOURS if name == "codes" else tuple(map(to_hex, colormaps[name](positions)))


def grey_picture(frame: Mosaic | ChannelFrame) -> Picture:
    """Return a raw frame as one stretched picture: the mean of its channels, or of the cell around each sample."""
    if isinstance(frame, Mosaic):
        return stretch_to_uint8(cv2.blur(frame.values.astype(np.float32), (2, 2)))
    return stretch_to_uint8(frame.values.mean(axis=0, dtype=np.float32))


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
    images, (column, row) = result.reference, result.reference_origin
    columns, rows = np.ceil(result.nodes.max(axis=0) + 1).astype(int)
    picture = np.full(result.frame_shape or (rows, columns), 60, dtype=np.uint8)
    if images is not None:
        picture[row : row + images.shape[1], column : column + images.shape[2]] = images.mean(axis=0)
    return picture


def stretch_to_uint8(image: AnyArray) -> Picture:
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
        containing = np.flatnonzero(shape.min(axis=1) >= -1e-9)
    return (elements[containing[0]], shape[containing[0]]) if len(containing) else None


def robust_range(field_values: Field) -> tuple[float, float] | None:
    """Return the colour range of what was read without doubtful nodes and outliers; None where nothing is measured."""
    colour_values = ordinary_values(field_values.values, field_values.uncertainty)
    return colour_range(colour_values) if colour_values.size else None


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
            edges = dict(zip(("left", "top", "right", "bottom"), self.requested_edges, strict=True))
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
