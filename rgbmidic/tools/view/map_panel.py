"""Maps of the fields in view: canvases side by side, and the layers over the first."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import MouseMove

from rgbmidic.tools.report.painter import OUTSIDE_GREY, Picture, paint, palette
from rgbmidic.tools.report.style import BAR, OKABE_ITO, add_colour_bar, draw_figure, finish_picture, literal
from rgbmidic.tools.view.canvas import Canvas
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.fields import FieldsInView
from rgbmidic.tools.view.layers import (
    LabelLayer,
    LineLayer,
    MarkLayer,
    arrow_lines,
    contour_lines,
    direction_lines,
    place_texts,
)
from rgbmidic.tools.view.marks import MARKS, SCALE, probe_marks, probe_position
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


class MapPanel:
    """Maps of the fields in view, in the same part of the image.

    Parameters
    ----------
    document
        Document of the visitor.
    fields
        The fields in view.
    dark
        Whether the page is dark.
    redraw, hover
        Called when another part of the image is asked for, and when the pointer moves.

    Attributes
    ----------
    canvas, side_canvases
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
                pixels = paint(large.limited(VIEWER.picture_pixels), picture, overlay, OUTSIDE_GREY[False])
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

        times = fields.maps.physical.seconds
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
            pixels = paint(window.limited(VIEWER.picture_pixels), picture, overlay, OUTSIDE_GREY[self._dark])
            canvas.show_picture(pixels, window)
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
        names = zip(("smallest", "largest"), (OKABE_ITO["sky blue"], OKABE_ITO["orange"]), extremes, strict=False)
        self._extreme_labels.show(
            [
                (*nodes[node].tolist(), f"{name} {field.format(values.values[node], values.uncertainty[node])}", colour)
                for name, colour, node in names
            ],
            other_texts=[(x, y, text) for *_, x, y, text in self.marks.shapes],
        )
        return title
