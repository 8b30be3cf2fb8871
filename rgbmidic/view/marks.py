"""The marks that are set on a field: they move with the material, and those of one probe are joined."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource

from rgbmidic.typing import FloatArray
from rgbmidic.view.address import KINDS, Mark
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.picture import element_at

__all__ = ["MarkLayer"]

_COLOURS = ("#e69f00", "#56b4e9", "#009e73", "#cc79a7", "#d55e00", "#0072b2", "#f0e442", "#999999")
"""Okabe and Ito's colours, told apart by everyone."""
_LETTERS = {
    "x_offset": 8,
    "y_offset": -4,
    "background_fill_color": "#15181c",
    "background_fill_alpha": 0.75,
    "text_font_size": "12px",
    "padding": 2,
}


class MarkLayer:
    """The marks on a canvas.

    Parameters
    ----------
    canvas
        Where they are set and drawn.
    elements : ndarray, shape (E, 3)
        Of the mesh that carries them.

    Attributes
    ----------
    colours
        Of each probe that the marks make, by its name.
    """

    def __init__(self, canvas: Canvas, elements: npt.NDArray[np.int32]) -> None:
        self.colours: dict[str, str] = {}
        self._canvas, self._elements, self._shown = canvas, elements, dict[Mark, Mark]()
        self._joined = ColumnDataSource({name: [] for name in ("xs", "ys", "colour", "x", "y", "text")})
        canvas.plot.multi_line("xs", "ys", source=self._joined, line_color="colour", line_width=3)
        canvas.plot.text("x", "y", "text", source=self._joined, text_color="colour", **_LETTERS)

    def place(self, marks: Sequence[Mark], reference: FloatArray, nodes: FloatArray) -> None:
        """Draw marks of the reference where their material is when the nodes (N, 2) are where they are now."""
        at = [self._carried(mark, reference, nodes) for mark in marks]
        shown = dict(zip(at, marks, strict=True))
        if shown == self._shown:
            return
        self._shown = shown
        self._canvas.place(at)
        probes = _probes(at)
        self.colours = {name: _COLOURS[place % len(_COLOURS)] for place, name in enumerate(probes)}
        self._joined.data = {
            "xs": [[mark.x for mark in own] for own in probes.values()],
            "ys": [[mark.y for mark in own] for own in probes.values()],
            "colour": list(self.colours.values()),
            "x": [own[0].x for own in probes.values()],
            "y": [own[0].y for own in probes.values()],
            "text": [name.replace("_", " ") for name in probes],
        }

    def taken(self, nodes: FloatArray, reference: FloatArray) -> tuple[Mark, ...] | None:
        """The marks as they were set over nodes that are there now, on the reference; None: none was set or moved."""
        now = self._canvas.set
        if now == list(self._shown):
            return None
        return tuple(self._shown.get(mark) or self._carried(mark, nodes, reference) for mark in now)

    def _carried(self, mark: Mark, before: FloatArray, after: FloatArray) -> Mark:
        """A mark where its place in the mesh `before` is in the mesh `after`; as it is where that is nowhere."""
        found = None if before is after else element_at(before, self._elements, mark.x, mark.y)
        if found is None:
            return mark
        x, y = found[1] @ after[found[0]]
        return Mark(mark.kind, float(x), float(y)) if np.isfinite(x + y) else mark


def _probes(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """The marks of each whole probe, by its name."""
    found: dict[str, list[Mark]] = {}
    for kind, count in KINDS.items():
        own = [mark for mark in marks if mark.kind == kind]
        found |= {f"{kind}_{n + 1}": own[n * count : (n + 1) * count] for n in range(len(own) // count)}
    return found
