"""Maps of the fields in view: canvases side by side, and the layers over the first.

Layers are lines, texts that keep apart, and marks of probes, which move with the material.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import bokeh.models as bk
import numpy as np
import numpy.typing as npt
from bokeh.document import Document
from bokeh.events import MouseMove

from rgbmidic.report.style import BAR, OKABE_ITO, add_colour_bar, draw_figure, finish_picture, literal
from rgbmidic.results import frame_times
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import MARKS, SCALE, Mark, probe_marks, probe_place
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.picture import AROUND, Canvas, Picture, Window, columns, element_at, paint, palette
from rgbmidic.view.shown import ShownFields

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_ENDS, _LABEL = "x0 y0 x1 y1", "x y text colour side along down"
LETTERS = {
    "text_color": "#ffffff",
    "text_align": "side",
    "x_offset": "along",
    "y_offset": "down",
    "background_fill_color": "#15181c",
    "background_fill_alpha": 0.75,
    "text_font_size": "12px",
    "padding": 2,
}
"""Look of a text over the image, where `beside` places it."""
_AWAY, _LETTER, _LINE = 8, 7, 20
"""Pixels of the screen: from a place to its text; width of a letter and height of a line of 12 px."""


class LineLayer:
    """Lines on a canvas, light with a dark edge.

    Parameters
    ----------
    canvas
        Plot on which they are drawn.
    name
        Name of their data.
    width
        Of the light part, in pixels of the screen.

    Attributes
    ----------
    lines : ndarray, shape (M, 4)
        The lines that are shown.
    """

    def __init__(self, canvas: Canvas, name: str, width: float = 1.4) -> None:
        self.lines, self._drawn = np.zeros((0, 4)), bk.ColumnDataSource(columns(_ENDS), name=name)
        for colour, wide in (("#15181c", width + 1.6), ("#ffffff", width)):
            canvas.plot.segment(*_ENDS.split(), source=self._drawn, line_color=colour, line_width=wide)

    def show(self, lines: FloatArray | None = None) -> None:
        """Show lines (M, 4) from x0, y0 to x1, y1; None: none."""
        if lines is not None or len(self.lines):
            self.lines = np.zeros((0, 4)) if lines is None else lines
            self._drawn.data = dict(zip(_ENDS.split(), self.lines.T, strict=True))


class LabelLayer:
    """Points with a text on a canvas.

    Parameters
    ----------
    canvas
        Plot on which they are drawn.
    name
        Name of their data.
    """

    def __init__(self, canvas: Canvas, name: str, **look: Any) -> None:
        self._canvas, self._points = canvas, bk.ColumnDataSource(columns(_LABEL), name=name)
        canvas.plot.scatter("x", "y", source=self._points, line_color="#15181c", fill_color="colour", **look)
        canvas.plot.text("x", "y", "text", source=self._points, **LETTERS)

    def show(
        self, points: Sequence[tuple[float, float, str, str]] = (), others: Sequence[tuple[float, float, str]] = ()
    ) -> None:
        """Show points with their texts and colours, the texts clear of `others` that `beside` has placed."""
        if points or len(self._points.data["x"]):
            placed = beside([*others, *(one[:3] for one in points)], self._canvas.window)[len(others) :]
            self._points.data = columns(_LABEL, [(*one, *place) for one, place in zip(points, placed, strict=True)])


def beside(texts: Sequence[tuple[float, float, str]], window: Window) -> list[tuple[str, int, int]]:
    """Return alignment and offsets of texts at (x, y) that end within a window and do not lie on each other."""
    step = (window.right - window.left) / window.width  # px of the image to one of the screen
    placed, taken = [], list[tuple[float, float, float]]()
    for x, y, text in texts:
        left, wide, top = (x - window.left) / step + _AWAY, _LETTER * len(text), (y - window.top) / step
        turned = left + wide > window.width
        left, low = left - (wide + 2 * _AWAY if turned else 0), top
        while any(abs(low - other) < _LINE and left < end and begin < left + wide for begin, end, other in taken):
            low += _LINE
        taken.append((left, left + wide, low))
        placed.append(("right" if turned else "left", -_AWAY if turned else _AWAY, round(low - top)))
    return placed


def _thinned(window: Window, nodes: FloatArray, known: Any) -> tuple[npt.NDArray[np.int64], float]:
    """Thin out the nodes (N, 2) that are known, evenly over the view; return their indices, and their distance."""
    cell = max(window.right - window.left, window.bottom - window.top) / VIEWER.lines_across
    kept = np.flatnonzero(known & np.isfinite(nodes).all(axis=1))
    places = np.floor(nodes[kept] / cell).astype(int)
    return kept[np.unique(places, axis=0, return_index=True)[1]], cell


def direction_lines(window: Window, nodes: FloatArray, degrees: FloatArray) -> FloatArray:
    """Lines (M, 4) along directions (N,), in degrees from x towards y, at nodes (N, 2), evenly thinned out."""
    thinned, cell = _thinned(window, nodes, np.isfinite(degrees))
    angle = np.radians(degrees[thinned])
    half = 0.4 * cell * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([nodes[thinned] - half, nodes[thinned] + half], axis=1)


def arrow_lines(window: Window, nodes: FloatArray, moved: FloatArray, longer: float) -> tuple[FloatArray, float]:
    """Lines (M, 4) of arrows along displacements (N, 2) at nodes (N, 2), thinned out, and how much longer they are.

    With `longer` 0 the longest reaches to the next arrow.
    """
    thinned, cell = _thinned(window, nodes, np.isfinite(moved).all(axis=1))
    start, along = nodes[thinned], moved[thinned]
    reach = np.hypot(*along.T).max(initial=0)
    longer = longer or (0.9 * cell / reach if reach > 0 else 1.0)
    end = start + longer * along
    parts = [np.concatenate([start, end], axis=1)]
    for turn in (2.6, -2.6):  # rad from the arrow to the sides of its point
        c, s = 0.3 * np.cos(turn), 0.3 * np.sin(turn)
        parts.append(np.concatenate([end, end + longer * along @ np.array([[c, s], [-s, c]])], axis=1))
    return np.concatenate(parts), float(longer)


def contour_lines(
    nodes: FloatArray, elements: npt.NDArray[np.int32], values: FloatArray, levels: Sequence[float]
) -> FloatArray:
    """Lines (M, 4) on which a field, linear in each element, has one of the levels; none beside nodes without data."""
    whole = elements[np.isfinite(values[elements] + nodes[elements].sum(axis=2)).all(axis=1)]
    lines = []
    for level in levels:
        above = values[whole] > level
        crossed = above.any(axis=1) & ~above.all(axis=1)
        cut, side = whole[crossed], above[crossed]
        # the corner that is alone on its side: from it, the line cuts both edges
        alone = np.where(side.sum(axis=1) == 1, side.argmax(axis=1), side.argmin(axis=1))
        a, *others = np.take_along_axis(cut, (alone[:, None] + np.arange(3)) % 3, axis=1).T
        parts = [((level - values[a]) / (values[b] - values[a]))[:, None] for b in others]
        ends = [nodes[a] + part * (nodes[b] - nodes[a]) for part, b in zip(parts, others, strict=True)]
        lines.append(np.concatenate(ends, axis=1))
    return np.concatenate(lines) if lines else np.zeros((0, 4))


_COLOURS = tuple(OKABE_ITO.values())
_PROBE = "xs ys colour x y text side along down"

_TURN = np.linspace(0, 2 * np.pi, 49)


def _outline(ends: Sequence[Mark], gauge: float) -> tuple[list[float], list[float]]:
    """Return the x and y of the lines that show a probe."""
    xs, ys = [mark.x for mark in ends], [mark.y for mark in ends]
    if ends[0].kind == "region":
        return [xs[0], xs[1], xs[1], xs[0], xs[0]], [ys[0], ys[0], ys[1], ys[1], ys[0]]
    if ends[0].kind in ("circle", "strain_gauge"):
        radius = gauge / 2 if len(ends) == 1 else float(np.hypot(xs[1] - xs[0], ys[1] - ys[0]))
        return (xs[0] + radius * np.cos(_TURN)).tolist(), (ys[0] + radius * np.sin(_TURN)).tolist()
    return xs, ys


class MarkLayer:
    """Marks of probes on a canvas, which move with the material.

    Parameters
    ----------
    canvas
        Plot on which they are set and drawn.
    elements : ndarray, shape (E, 3)
        Elements of the mesh that carries them.

    Attributes
    ----------
    colours
        Colour of each probe that the marks make, by its name.
    drawn
        Line (xs, ys), colour, and place (x, y) and text of each probe.
    """

    def __init__(self, canvas: Canvas, elements: npt.NDArray[np.int32]) -> None:
        self.colours, self.drawn = dict[str, str](), list[tuple[Any, ...]]()
        self._canvas, self._elements, self._shown = canvas, elements, dict[object, tuple[Mark, Mark]]()
        self._placed: object = None
        self._joined = bk.ColumnDataSource(columns(_PROBE), name="probes")
        canvas.plot.multi_line("xs", "ys", source=self._joined, line_color="colour", line_width=3)
        canvas.plot.text("x", "y", "text", source=self._joined, border_line_color="colour", **LETTERS)

    def place(
        self, marks: Sequence[Mark], reference: FloatArray, nodes: FloatArray, values: Mapping[str, str], gauge: float
    ) -> None:
        """Draw marks, which lie on the `reference` (N, 2) of the nodes, where the nodes (N, 2) carry them.

        Each probe shows its value of `values`; strain gauges are circles of the length `gauge` (px).
        """
        at = [self._carried(mark, reference, nodes) for mark in marks]
        self._shown = {mark.key: (mark, own) for mark, own in zip(at, marks, strict=True)}
        self._canvas.place(at)
        placed = (at, dict(values), gauge, self._canvas.window)
        if placed == self._placed:
            return
        self._placed = placed
        ends = [mark for mark in at if mark.kind == SCALE]
        probes = {**probe_marks(at), **({SCALE: ends} if len(ends) > 1 else {})}
        self.colours = {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(probes)}
        lines = [_outline(ends, gauge) for ends in probes.values()]
        texts = [
            (ends[0].x, ends[0].y, f"{name.replace('_', ' ')}{values.get(name, '')}") for name, ends in probes.items()
        ]
        sides = beside(texts, self._canvas.window)
        self.drawn = [(*line, self.colours[name], *text) for line, name, text in zip(lines, probes, texts, strict=True)]
        self._joined.data = columns(_PROBE, [(*one, *side) for one, side in zip(self.drawn, sides, strict=True)])

    def taken(self, nodes: FloatArray, reference: FloatArray) -> tuple[Mark, ...] | None:
        """Return the marks, set over nodes (N, 2), on the `reference` (N, 2); None where none has changed."""
        now = self._canvas.set
        if now == [mark for mark, _ in self._shown.values()]:
            return None
        marks = []
        for mark in now:
            shown, own = self._shown.get(mark.key, (None, mark))
            marks.append(own if mark == shown else self._carried(mark, nodes, reference))
        return tuple(marks)

    def _carried(self, mark: Mark, before: FloatArray, after: FloatArray) -> Mark:
        """Carry a mark from the nodes `before` to those `after`; outside the mesh or without data it stays."""
        found = None if before is after else element_at(before, self._elements, mark.x, mark.y)
        if found is None:
            return mark
        x, y = found[1] @ after[found[0]]
        return replace(mark, x=float(x), y=float(y)) if np.isfinite(x + y) else mark


class MapPanel:
    """Maps of the fields in view, in the same part of the image.

    Parameters
    ----------
    document
        Document of the visitor.
    shown
        The fields in view.
    dark
        Whether the page is dark.
    redraw, hover
        Called when another part of the image is asked for, and when the pointer moves.

    Attributes
    ----------
    canvas, beside
        Canvas of the first field, on which marks are set, and those of the others.
    marks
        Marks of probes.
    column
        All canvases.
    """

    def __init__(
        self,
        document: Document,
        shown: ShownFields,
        redraw: Callable[[], None],
        hover: Callable[[Any], None],
        dark: bool,
    ) -> None:
        self._document, self._shown, self._dark = document, shown, dark
        self._redraw, self._hover = redraw, hover
        result = shown.result
        self.canvas = canvas = Canvas(document, MARKS, shown.view.window or Canvas.around(result.nodes), redraw)
        canvas.plot.on_event(MouseMove, hover)
        self.beside, self._count = list[Canvas](), 1
        self._directions, self._contours = LineLayer(canvas, "direction lines"), LineLayer(canvas, "contour lines", 0.8)
        self._arrows, self._blank = LineLayer(canvas, "arrows"), LabelLayer(canvas, "blank nodes", size=5)
        self.marks, self._ends = MarkLayer(canvas, result.elements), LabelLayer(canvas, "extreme nodes", size=9)
        self.column = bk.Column(children=[canvas.plot], sizing_mode="stretch_both")

    def clear(self) -> None:
        """Show nothing."""
        for canvas in (self.canvas, *self.beside):
            canvas.clear()
        for layer in (self._directions, self._contours, self._arrows, self._ends, self._blank):
            layer.show()

    def figure(self) -> Figure:
        """Draw the maps for print: light, with the frame, its time and how the fields are derived in the title."""
        from matplotlib.collections import LineCollection
        from matplotlib.colors import ListedColormap, Normalize

        shown, view, window = self._shown, self._shown.view, self.canvas.window
        (picture, _), (unit, factor), names = shown.picture, shown.maps.physical.axes, shown.names
        height = round(VIEWER.print_columns * window.height / window.width)
        large = replace(window, width=VIEWER.print_columns, height=height)
        layers = [layer.lines for layer in (self._directions, self._contours, self._arrows)]

        def draw(axes: list[Axes]) -> None:
            for axis, name in zip(axes, names, strict=True):
                over, field = shown.overlay(name), shown.maps.all[name]
                pixels = paint(large, picture, over, AROUND[False])
                edges = (window.left, window.right, window.bottom, window.top)
                axis.imshow(pixels.view(np.uint8).reshape(*pixels.shape, 4), extent=edges)
                limits = edges[:2], (window.top, window.bottom)
                finish_picture(axis, *limits, first=axis is axes[0], unit=unit, factor=factor)
                axis.set_title(literal(field.label))
                add_colour_bar(axis, Normalize(*over.ends), ListedColormap(over.colours), names=field.codes)
            for lines in layers:
                for colour, width in (("#15181c", 1.4), ("#ffffff", 0.7)):
                    segments = LineCollection(list(lines.reshape(-1, 2, 2)), colors=colour, linewidths=width)
                    axes[0].add_collection(segments)
            point = 0.55  # points to a pixel of the screen: letters of 5.5 points
            wide = 72 * axes[0].get_position().width * cast("Figure", axes[0].figure).get_figwidth() / point
            drawn = self.marks.drawn
            sides = beside([(x, y, text) for *_, x, y, text in drawn], replace(window, width=round(wide)))
            for (xs, ys, colour, x, y, text), (side, along, down) in zip(drawn, sides, strict=True):
                axes[0].plot(xs, ys, color=colour, marker="o" if len(xs) == 1 else "")
                look: dict[str, Any] = {"color": "w", "size": 10 * point, "ha": side, "va": "bottom"}
                look["bbox"] = {"facecolor": "#15181c", "edgecolor": colour, "alpha": 0.75, "pad": 1}
                shift = along * point, -down * point
                axes[0].annotate(literal(text), (x, y), shift, textcoords="offset points", **look)

        times = frame_times(shown.result, shown.maps.physical.scale)
        title = shown.title(math.nan if times is None else float(times[view.frame]))
        how = dict.fromkeys(shown.maps.how(name) for name in names)
        aspect, title = window.height / window.width, f"{title}\n{'; '.join(filter(None, how))}".strip()
        figure = draw_figure(draw, count=len(names), aspect=aspect, beside=BAR, title=title)
        figure.texts[0].set(fontsize=8, parse_math=False)  # two lines have room
        return figure

    def draw(self, picture: Picture) -> str:
        """Draw the fields over an image; returns what is to be said of the arrows."""
        shown, names, window = self._shown, self._shown.names, self.canvas.window
        self._arrange(len(names))
        for canvas, name in zip((self.canvas, *self.beside), names, strict=False):
            field, over = shown.maps.all[name], shown.overlay(name)
            canvas.show(paint(window, picture, over, AROUND[self._dark]), window)
            canvas.colour(over.ends, over.colours, field.label, field.codes)
            canvas.number(*shown.maps.physical.axes)
        return self._draw_layers(shown.nodes)

    def _arrange(self, count: int) -> None:
        """Show so many canvases: side by side, two in a row, or one below the other where the field is wide.

        They take the place of the curves too where there are none.
        """
        alone = count > 1 and not self._shown.view.marks
        self.column.css_classes = [*(["several"] if count > 1 else []), *(["alone"] if alone else [])]
        if count == self._count:
            return
        self._count = count
        while len(self.beside) < count - 1:
            self.beside.append(Canvas(self._document, (), self.canvas.wanted, self._redraw, like=self.canvas))
            self.beside[-1].plot.on_event(MouseMove, self._hover)
            self.beside[-1].plot.name = f"plot_{len(self.beside) + 1}"
        plots = [canvas.plot for canvas in (self.canvas, *self.beside)][:count]
        wide = count == 2 and np.ptp(self._shown.result.nodes[:, 0]) > np.ptp(self._shown.result.nodes[:, 1])
        across = 1 if wide or count == 1 else 2
        rows = [bk.Row(children=plots[at : at + across], sizing_mode="stretch_both") for at in range(0, count, across)]
        if count % across:  # a plot of another shape would distort what all show of the image
            rows[-1].children = [*rows[-1].children, bk.Spacer(sizing_mode="stretch_both")]
        self.column.children = rows if count > 1 else plots

    def _draw_layers(self, nodes: FloatArray) -> str:
        """Draw what lies over the first field: lines, arrows, extremes, nodes without data, marks."""
        shown, view, window = self._shown, self._shown.view, self.canvas.window
        field, values = shown.maps.all[view.field], shown.values(view.field)
        direction = shown.values("direction").values if view.directions else None
        self._directions.show(None if direction is None else direction_lines(window, nodes, direction))
        levels = np.linspace(*shown.ends(view.field), min(view.levels, VIEWER.contour_steps) + 1)[1:-1]
        over = shown.overlay(view.field) if view.contours and not field.stepped else None
        contours = None if over is None else contour_lines(over.nodes, over.elements, over.values, levels.tolist())
        self._contours.show(contours)
        arrows, title = None, "times their length (0: as there is room)"
        if view.vectors:
            moved = shown.displacement[:2].T
            if shown.maps.physical.rectified.camera is not None:  # that is on the plane, the arrows are on the image
                first = shown.result.nodes if view.since < 0 else shown.maps.read("u", view.since).moved
                moved = values.moved - first
            arrows, longer = arrow_lines(window, nodes, moved, view.longer)
            title = f"{title}: {longer:.3g}"
        self._arrows.show(arrows)
        missing = np.flatnonzero(values.status) if view.blank else ()
        colours = palette("codes")
        self._blank.show([(*shown.result.nodes[node].tolist(), "", colours[values.status[node]]) for node in missing])
        probes = probe_marks(view.marks).items()
        gauge = shown.gauge
        texts = {name: shown.probe_text(marks[0].kind, probe_place(marks, gauge)) for name, marks in probes}
        texts[SCALE] = f": {view.distance:g} mm" if view.distance else ""
        self.marks.place(view.marks, shown.result.nodes, nodes, texts, gauge)
        ends = shown.extremes if view.extremes else ()
        names = zip(("smallest", "largest"), ("#56b4e9", "#e69f00"), ends, strict=False)
        self._ends.show(
            [
                (*nodes[node].tolist(), f"{name} {field.text(values.values[node], values.std[node])}", colour)
                for name, colour, node in names
            ],
            others=[(x, y, text) for *_, x, y, text in self.marks.drawn],
        )
        return title
