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

from rgbmidic.results import frame_times
from rgbmidic.tools.report.style import BAR, OKABE_ITO, add_colour_bar, draw_figure, finish_picture, literal
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.picture import OUTSIDE_GREY, Canvas, ImageWindow, Picture, columns, element_at, paint, palette
from rgbmidic.tools.view.url_state import MARKS, SCALE, Mark, probe_marks, probe_position
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SEGMENT, _LABEL = "x0 y0 x1 y1", "x y text colour side along down"
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
"""Look of a text over the image, where `place_texts` places it."""
_TEXT_OFFSET, _LETTER, _LINE = 8, 7, 20
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
        self.lines, self._source = np.zeros((0, 4)), bk.ColumnDataSource(columns(_SEGMENT), name=name)
        for colour, stroke in (("#15181c", width + 1.6), ("#ffffff", width)):
            canvas.plot.segment(*_SEGMENT.split(), source=self._source, line_color=colour, line_width=stroke)

    def show(self, lines: FloatArray | None = None) -> None:
        """Show lines (M, 4) from x0, y0 to x1, y1; None: none."""
        if lines is not None or len(self.lines):
            self.lines = np.zeros((0, 4)) if lines is None else lines
            self._source.data = dict(zip(_SEGMENT.split(), self.lines.T, strict=True))


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
        self, points: Sequence[tuple[float, float, str, str]] = (), other_texts: Sequence[tuple[float, float, str]] = ()
    ) -> None:
        """Show points with their texts and colours, the texts clear of `other_texts` that `place_texts` has placed."""
        if points or len(self._points.data["x"]):
            placements = place_texts([*other_texts, *(point[:3] for point in points)], self._canvas.window)[
                len(other_texts) :
            ]
            self._points.data = columns(
                _LABEL, [(*point, *placement) for point, placement in zip(points, placements, strict=True)]
            )


def place_texts(texts: Sequence[tuple[float, float, str]], window: ImageWindow) -> list[tuple[str, int, int]]:
    """Return alignment and offsets of texts at (x, y) that end within a window and do not lie on each other."""
    step = (window.x_max - window.x_min) / window.width  # px of the image to one of the screen
    placements, boxes = [], list[tuple[float, float, float]]()
    for x, y, text in texts:
        x_start, length, y_text = (
            (x - window.x_min) / step + _TEXT_OFFSET,
            _LETTER * len(text),
            (y - window.y_min) / step,
        )
        is_flipped = x_start + length > window.width
        x_start, y_free = x_start - (length + 2 * _TEXT_OFFSET if is_flipped else 0), y_text
        while any(
            abs(y_free - box_y) < _LINE and x_start < box_end and box_start < x_start + length
            for box_start, box_end, box_y in boxes
        ):
            y_free += _LINE
        boxes.append((x_start, x_start + length, y_free))
        placements.append(
            ("right" if is_flipped else "left", -_TEXT_OFFSET if is_flipped else _TEXT_OFFSET, round(y_free - y_text))
        )
    return placements


def _thin_out(window: ImageWindow, nodes: FloatArray, has_value: Any) -> tuple[npt.NDArray[np.int64], float]:
    """Thin out the nodes (N, 2) that are known, evenly over the view; return their indices, and their distance."""
    cell = max(window.x_max - window.x_min, window.y_max - window.y_min) / VIEWER.lines_across
    indices = np.flatnonzero(has_value & np.isfinite(nodes).all(axis=1))
    cells = np.floor(nodes[indices] / cell).astype(int)
    return indices[np.unique(cells, axis=0, return_index=True)[1]], cell


def direction_lines(window: ImageWindow, nodes: FloatArray, degrees: FloatArray) -> FloatArray:
    """Return lines (M, 4) along directions (N,), in degrees from x towards y, at nodes (N, 2), evenly thinned out."""
    indices, cell = _thin_out(window, nodes, np.isfinite(degrees))
    angle = np.radians(degrees[indices])
    half_line = 0.4 * cell * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([nodes[indices] - half_line, nodes[indices] + half_line], axis=1)


def arrow_lines(
    window: ImageWindow, nodes: FloatArray, displacement: FloatArray, factor: float
) -> tuple[FloatArray, float]:
    """Return lines (M, 4) of arrows along displacements (N, 2) at nodes (N, 2), thinned out, and their magnification.

    With `factor` 0 the longest reaches to the next arrow.
    """
    indices, cell = _thin_out(window, nodes, np.isfinite(displacement).all(axis=1))
    start, vector = nodes[indices], displacement[indices]
    reach = np.hypot(*vector.T).max(initial=0)
    factor = factor or (0.9 * cell / reach if reach > 0 else 1.0)
    tip = start + factor * vector
    segments = [np.concatenate([start, tip], axis=1)]
    for turn in (2.6, -2.6):  # rad from the arrow to the sides of its point
        cosine, sine = 0.3 * np.cos(turn), 0.3 * np.sin(turn)
        segments.append(
            np.concatenate([tip, tip + factor * vector @ np.array([[cosine, sine], [-sine, cosine]])], axis=1)
        )
    return np.concatenate(segments), float(factor)


def contour_lines(
    nodes: FloatArray, elements: npt.NDArray[np.int32], values: FloatArray, levels: Sequence[float]
) -> FloatArray:
    """Return lines (M, 4) on which a field, linear in each element, has one of the levels; none beside blank nodes."""
    complete = elements[np.isfinite(values[elements] + nodes[elements].sum(axis=2)).all(axis=1)]
    lines = []
    for level in levels:
        is_above = values[complete] > level
        is_crossed = is_above.any(axis=1) & ~is_above.all(axis=1)
        corners, corner_above = complete[is_crossed], is_above[is_crossed]
        # the corner that is alone on its side: from it, the line cuts both edges
        single_corner = np.where(
            corner_above.sum(axis=1) == 1, corner_above.argmax(axis=1), corner_above.argmin(axis=1)
        )
        apex, *far_corners = np.take_along_axis(corners, (single_corner[:, None] + np.arange(3)) % 3, axis=1).T
        fractions = [((level - values[apex]) / (values[corner] - values[apex]))[:, None] for corner in far_corners]
        points = [
            nodes[apex] + fraction * (nodes[corner] - nodes[apex])
            for fraction, corner in zip(fractions, far_corners, strict=True)
        ]
        lines.append(np.concatenate(points, axis=1))
    return np.concatenate(lines) if lines else np.zeros((0, 4))


_COLOURS = tuple(OKABE_ITO.values())
_PROBE = "xs ys colour x y text side along down"

_TURN = np.linspace(0, 2 * np.pi, 49)


def _outline(marks: Sequence[Mark], gauge: float) -> tuple[list[float], list[float]]:
    """Return the x and y of the lines that show a probe."""
    xs, ys = [mark.x for mark in marks], [mark.y for mark in marks]
    if marks[0].kind == "region":
        return [xs[0], xs[1], xs[1], xs[0], xs[0]], [ys[0], ys[0], ys[1], ys[1], ys[0]]
    if marks[0].kind in ("circle", "strain_gauge"):
        radius = gauge / 2 if len(marks) == 1 else float(np.hypot(xs[1] - xs[0], ys[1] - ys[0]))
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
        self.colours, self.shapes = dict[str, str](), list[tuple[Any, ...]]()
        self._canvas, self._elements, self._placed_marks = canvas, elements, dict[object, tuple[Mark, Mark]]()
        self._placed: object = None
        self._source = bk.ColumnDataSource(columns(_PROBE), name="probes")
        canvas.plot.multi_line("xs", "ys", source=self._source, line_color="colour", line_width=3)
        canvas.plot.text("x", "y", "text", source=self._source, border_line_color="colour", **LETTERS)

    def draw_marks(
        self, marks: Sequence[Mark], reference: FloatArray, nodes: FloatArray, values: Mapping[str, str], gauge: float
    ) -> None:
        """Draw marks, which lie on the `reference` (N, 2) of the nodes, where the nodes (N, 2) carry them.

        Each probe shows its value of `values`; strain gauges are circles of the length `gauge` (px).
        """
        moved_marks = [self._carry(mark, reference, nodes) for mark in marks]
        self._placed_marks = {mark.key: (mark, original) for mark, original in zip(moved_marks, marks, strict=True)}
        self._canvas.place_marks(moved_marks)
        placed = (moved_marks, dict(values), gauge, self._canvas.window)
        if placed == self._placed:
            return
        self._placed = placed
        group = [mark for mark in moved_marks if mark.kind == SCALE]
        probes = {**probe_marks(moved_marks), **({SCALE: group} if len(group) > 1 else {})}
        self.colours = {name: _COLOURS[index % len(_COLOURS)] for index, name in enumerate(probes)}
        lines = [_outline(group, gauge) for group in probes.values()]
        texts = [
            (group[0].x, group[0].y, f"{name.replace('_', ' ')}{values.get(name, '')}")
            for name, group in probes.items()
        ]
        placements = place_texts(texts, self._canvas.window)
        self.shapes = [
            (*line, self.colours[name], *text) for line, name, text in zip(lines, probes, texts, strict=True)
        ]
        self._source.data = columns(
            _PROBE, [(*shape, *placement) for shape, placement in zip(self.shapes, placements, strict=True)]
        )

    def read_marks(self, nodes: FloatArray, reference: FloatArray) -> tuple[Mark, ...] | None:
        """Return the marks, set over nodes (N, 2), on the `reference` (N, 2); None where none has changed."""
        marks_on_plot = self._canvas.current_marks
        if marks_on_plot == [mark for mark, _ in self._placed_marks.values()]:
            return None
        marks = []
        for mark in marks_on_plot:
            displayed, original = self._placed_marks.get(mark.key, (None, mark))
            marks.append(original if mark == displayed else self._carry(mark, nodes, reference))
        return tuple(marks)

    def _carry(self, mark: Mark, nodes_before: FloatArray, nodes_after: FloatArray) -> Mark:
        """Carry a mark from `nodes_before` to `nodes_after`; outside the mesh or without data it stays."""
        element = None if nodes_before is nodes_after else element_at(nodes_before, self._elements, mark.x, mark.y)
        if element is None:
            return mark
        x, y = element[1] @ nodes_after[element[0]]
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
    canvas, place_texts
        Canvas of the first field, on which marks are set, and those of the others.
    marks
        Marks of probes.
    column
        All canvases.
    """

    def __init__(
        self,
        document: Document,
        fields: FieldsInView,
        redraw: Callable[[], None],
        hover: Callable[[Any], None],
        dark: bool,
    ) -> None:
        self._document, self._fields, self._dark = document, fields, dark
        self._redraw, self._hover = redraw, hover
        result = fields.result
        self.canvas = canvas = Canvas(document, MARKS, fields.view.window or Canvas.edges_around(result.nodes), redraw)
        canvas.plot.on_event(MouseMove, hover)
        self.side_canvases, self._count = list[Canvas](), 1
        self._directions, self._contours = LineLayer(canvas, "direction lines"), LineLayer(canvas, "contour lines", 0.8)
        self._arrows, self._blank = LineLayer(canvas, "arrows"), LabelLayer(canvas, "blank nodes", size=5)
        self.marks, self._extreme_labels = (
            MarkLayer(canvas, result.elements),
            LabelLayer(canvas, "extreme nodes", size=9),
        )
        self.column = bk.Column(children=[canvas.plot], sizing_mode="stretch_both")

    def clear(self) -> None:
        """Show nothing."""
        for canvas in (self.canvas, *self.side_canvases):
            canvas.clear()
        for layer in (self._directions, self._contours, self._arrows, self._extreme_labels, self._blank):
            layer.show()

    def figure(self) -> Figure:
        """Draw the maps for print: light, with the frame, its time and how the fields are derived in the title."""
        from matplotlib.collections import LineCollection
        from matplotlib.colors import ListedColormap, Normalize

        fields, view, window = self._fields, self._fields.view, self.canvas.window
        (picture, _), (unit, factor), names = fields.picture, fields.maps.physical.axes, fields.names
        height = round(VIEWER.print_columns * window.height / window.width)
        large = replace(window, width=VIEWER.print_columns, height=height)
        layers = [layer.lines for layer in (self._directions, self._contours, self._arrows)]

        def draw(axes: list[Axes]) -> None:
            for axis, name in zip(axes, names, strict=True):
                overlay, field = fields.overlay(name), fields.maps.quantities[name]
                pixels = paint(large, picture, overlay, OUTSIDE_GREY[False])
                edges = (window.x_min, window.x_max, window.y_max, window.y_min)
                axis.imshow(pixels.view(np.uint8).reshape(*pixels.shape, 4), extent=edges)
                limits = edges[:2], (window.y_min, window.y_max)
                finish_picture(axis, *limits, has_y_label=axis is axes[0], unit=unit, factor=factor)
                axis.set_title(literal(field.label))
                add_colour_bar(
                    axis, Normalize(*overlay.colour_range), ListedColormap(overlay.colours), names=field.codes
                )
            for lines in layers:
                for colour, width in (("#15181c", 1.4), ("#ffffff", 0.7)):
                    segments = LineCollection(list(lines.reshape(-1, 2, 2)), colors=colour, linewidths=width)
                    axes[0].add_collection(segments)
            point = 0.55  # points to a pixel of the screen: letters of 5.5 points
            screen_width = 72 * axes[0].get_position().width * cast("Figure", axes[0].figure).get_figwidth() / point
            shapes = self.marks.shapes
            placements = place_texts(
                [(x, y, text) for *_, x, y, text in shapes], replace(window, width=round(screen_width))
            )
            for (xs, ys, colour, x, y, text), (alignment, x_offset, y_offset) in zip(shapes, placements, strict=True):
                axes[0].plot(xs, ys, color=colour, marker="o" if len(xs) == 1 else "")
                look: dict[str, Any] = {"color": "w", "size": 10 * point, "ha": alignment, "va": "bottom"}
                look["bbox"] = {"facecolor": "#15181c", "edgecolor": colour, "alpha": 0.75, "pad": 1}
                shift = x_offset * point, -y_offset * point
                axes[0].annotate(literal(text), (x, y), shift, textcoords="offset points", **look)

        times = frame_times(fields.result, fields.maps.physical.scale)
        title = fields.title(math.nan if times is None else float(times[view.frame]))
        note = dict.fromkeys(fields.maps.processing_note(name) for name in names)
        aspect, title = window.height / window.width, f"{title}\n{'; '.join(filter(None, note))}".strip()
        figure = draw_figure(draw, count=len(names), aspect=aspect, right_room=BAR, title=title)
        figure.texts[0].set(fontsize=8, parse_math=False)  # two lines have room
        return figure

    def draw(self, picture: Picture) -> str:
        """Draw the fields over an image; returns what is to be said of the arrows."""
        fields, names, window = self._fields, self._fields.names, self.canvas.window
        self._arrange(len(names))
        for canvas, name in zip((self.canvas, *self.side_canvases), names, strict=False):
            field, overlay = fields.maps.quantities[name], fields.overlay(name)
            canvas.show_picture(paint(window, picture, overlay, OUTSIDE_GREY[self._dark]), window)
            canvas.set_colour_bar(overlay.colour_range, overlay.colours, field.label, field.codes)
            canvas.number_axes(*fields.maps.physical.axes)
        return self._draw_layers(fields.nodes)

    def _arrange(self, count: int) -> None:
        """Show so many canvases: side by side, two in a row, or one below the other where the field is wide.

        They take the place of the curves too where there are none.
        """
        fills_page = count > 1 and not self._fields.view.marks
        self.column.css_classes = [*(["several"] if count > 1 else []), *(["alone"] if fills_page else [])]
        if count == self._count:
            return
        self._count = count
        while len(self.side_canvases) < count - 1:
            self.side_canvases.append(
                Canvas(self._document, (), self.canvas.requested_edges, self._redraw, neighbour=self.canvas)
            )
            self.side_canvases[-1].plot.on_event(MouseMove, self._hover)
            self.side_canvases[-1].plot.name = f"plot_{len(self.side_canvases) + 1}"
        plots = [canvas.plot for canvas in (self.canvas, *self.side_canvases)][:count]
        wide = count == 2 and np.ptp(self._fields.result.nodes[:, 0]) > np.ptp(self._fields.result.nodes[:, 1])
        per_row = 1 if wide or count == 1 else 2
        rows = [
            bk.Row(children=plots[start : start + per_row], sizing_mode="stretch_both")
            for start in range(0, count, per_row)
        ]
        if count % per_row:  # a plot of another shape would distort what all show of the image
            rows[-1].children = [*rows[-1].children, bk.Spacer(sizing_mode="stretch_both")]
        self.column.children = rows if count > 1 else plots

    def _draw_layers(self, nodes: FloatArray) -> str:
        """Draw what lies over the first field: lines, arrows, extremes, nodes without data, marks."""
        fields, view, window = self._fields, self._fields.view, self.canvas.window
        field, values = fields.maps.quantities[view.field], fields.values(view.field)
        direction = fields.values("direction").values if view.directions else None
        self._directions.show(None if direction is None else direction_lines(window, nodes, direction))
        levels = np.linspace(*fields.colour_range(view.field), min(view.levels, VIEWER.contour_steps) + 1)[1:-1]
        overlay = fields.overlay(view.field) if view.contours and not field.stepped else None
        contours = (
            None if overlay is None else contour_lines(overlay.nodes, overlay.elements, overlay.values, levels.tolist())
        )
        self._contours.show(contours)
        arrows, title = None, "times their length (0: as there is room)"
        if view.vectors:
            displacement = fields.displacement.values.T
            if fields.maps.physical.rectified.camera is not None:  # that is on the plane, the arrows are on the image
                origin = fields.result.nodes if view.since < 0 else fields.maps.deformed_nodes(view.since)
                displacement = fields.deformed_nodes - origin
            arrows, longer = arrow_lines(window, nodes, displacement, view.longer)
            title = f"{title}: {longer:.3g}"
        self._arrows.show(arrows)
        status = fields.node_status
        missing = np.flatnonzero(status) if view.blank else ()
        colours = palette("codes")
        self._blank.show([(*fields.result.nodes[node].tolist(), "", colours[status[node]]) for node in missing])
        probes = probe_marks(view.marks).items()
        gauge = fields.gauge
        texts = {name: fields.probe_text(marks[0].kind, probe_position(marks, gauge)) for name, marks in probes}
        texts[SCALE] = f": {view.distance:g} mm" if view.distance else ""
        self.marks.draw_marks(view.marks, fields.result.nodes, nodes, texts, gauge)
        extremes = fields.extremes if view.extremes else ()
        names = zip(("smallest", "largest"), ("#56b4e9", "#e69f00"), extremes, strict=False)
        self._extreme_labels.show(
            [
                (*nodes[node].tolist(), f"{name} {field.format(values.values[node], values.uncertainty[node])}", colour)
                for name, colour, node in names
            ],
            other_texts=[(x, y, text) for *_, x, y, text in self.marks.shapes],
        )
        return title
