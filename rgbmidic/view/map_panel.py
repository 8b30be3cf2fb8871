"""Maps of the fields in view: canvases side by side, and what is drawn over the first."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import bokeh.models as bk
import numpy as np
from bokeh.document import Document
from bokeh.events import MouseMove

from rgbmidic.report.style import BAR, add_colour_bar, draw_figure, finish_picture, literal
from rgbmidic.results import frame_times
from rgbmidic.typing import FloatArray
from rgbmidic.view.address import MARKS, SCALE, probe_marks, probe_place
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.constants import VIEWER
from rgbmidic.view.layers import LabelLayer, LineLayer, MarkLayer, arrow_lines, beside, contour_lines, direction_lines
from rgbmidic.view.picture import AROUND, Picture, paint, palette
from rgbmidic.view.shown import ShownFields

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        self.beside: list[Canvas] = []
        self._directions, self._contours = LineLayer(canvas, "direction lines"), LineLayer(canvas, "contour lines", 0.8)
        self._arrows, self._blank = LineLayer(canvas, "arrows"), LabelLayer(canvas, "blank nodes", size=5)
        self.marks, self._ends = MarkLayer(canvas, result.elements), LabelLayer(canvas, "extreme nodes", size=9)
        self.column = bk.Column(children=[canvas.plot], sizing_mode="stretch_both")

    def clear(self) -> None:
        """Show nothing."""
        for canvas in (self.canvas, *self.beside):
            canvas.clear()
        for layer in (self._directions, self._contours, self._arrows):
            layer.show(None)
        self._ends.show()
        self._blank.show()

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
        names, nodes = self._shown.names, self._shown.nodes
        self._arrange(len(names))
        for canvas, name in zip((self.canvas, *self.beside), names, strict=False):
            self._paint(canvas, name, picture)
        return self._draw_layers(nodes)

    def _arrange(self, count: int) -> None:
        """Show so many canvases: side by side, two in a row, or one below the other where the field is wide.

        They take the place of the curves too where there are none.
        """
        alone = count > 1 and not self._shown.view.marks
        self.column.css_classes = [*(["several"] if count > 1 else []), *(["alone"] if alone else [])]
        if count == sum(canvas.plot.visible for canvas in (self.canvas, *self.beside)):
            return
        while len(self.beside) < count - 1:
            self.beside.append(Canvas(self._document, (), self.canvas.wanted, self._redraw, like=self.canvas))
            self.beside[-1].plot.on_event(MouseMove, self._hover)
            self.beside[-1].plot.name = f"plot_{len(self.beside) + 1}"
        for place, canvas in enumerate(self.beside):
            canvas.plot.visible = place < count - 1
        plots = [canvas.plot for canvas in (self.canvas, *self.beside)][:count]
        wide = count == 2 and np.ptp(self._shown.result.nodes[:, 0]) > np.ptp(self._shown.result.nodes[:, 1])
        across = 1 if wide or count == 1 else 2
        rows = [bk.Row(children=plots[at : at + across], sizing_mode="stretch_both") for at in range(0, count, across)]
        if count % across:  # a plot of another shape would distort what all show of the image
            rows[-1].children = [*rows[-1].children, bk.Spacer(sizing_mode="stretch_both")]
        self.column.children = rows if count > 1 else plots

    def _paint(self, canvas: Canvas, name: str, picture: Picture) -> None:
        field, over = self._shown.maps.all[name], self._shown.overlay(name)
        canvas.show(paint(self.canvas.window, picture, over, AROUND[self._dark]), self.canvas.window)
        canvas.colour(over.ends, over.colours, field.label, field.codes)
        canvas.number(*self._shown.maps.physical.axes)

    def _draw_layers(self, nodes: FloatArray) -> str:
        """Draw what lies over the first field: lines, arrows, extremes, nodes without data, marks."""
        shown, view, window = self._shown, self._shown.view, self.canvas.window
        field, values, elements = shown.maps.all[view.field], shown.values(view.field), shown.result.elements
        direction = shown.values("direction").values if view.directions else None
        self._directions.show(None if direction is None else direction_lines(window, nodes, direction))
        levels = np.linspace(*shown.ends(view.field), min(view.levels, VIEWER.contour_steps) + 1)[1:-1]
        smooth = view.contours and not field.stepped
        self._contours.show(contour_lines(nodes, elements, values.values, levels.tolist()) if smooth else None)
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
