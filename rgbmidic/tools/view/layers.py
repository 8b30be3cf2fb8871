"""Layers over a field on a canvas: lines, texts that keep apart, and marks of probes, which move with the material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import bokeh.models as bk
import numpy as np
import numpy.typing as npt

from rgbmidic.tools.report.painter import ImageWindow
from rgbmidic.tools.report.style import OKABE_ITO
from rgbmidic.tools.view.canvas import Canvas, columns
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.fields import element_at
from rgbmidic.tools.view.marks import SCALE, Mark, probe_marks
from rgbmidic.typing import FloatArray

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
    **look
        Properties of the points.
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
    step = window.steps[0]
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
    shapes
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
