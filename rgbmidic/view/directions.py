"""Principal directions of the strain, as short lines on the field."""

from __future__ import annotations

import numpy as np
from bokeh.models import ColumnDataSource

from rgbmidic.typing import FloatArray
from rgbmidic.view.canvas import Canvas

__all__ = ["DirectionLayer"]

_ACROSS = 24
"""Lines across the view: enough to follow the directions, few enough to tell them apart."""
_COLUMNS = ("x0", "y0", "x1", "y1")


class DirectionLayer:
    """Lines along the larger principal strain on a canvas."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas, self._lines = canvas, ColumnDataSource({name: [] for name in _COLUMNS}, name="directions")
        for colour, width in (("#15181c", 3.0), ("#ffffff", 1.4)):
            canvas.plot.segment(*_COLUMNS, source=self._lines, line_color=colour, line_width=width)

    def hide(self) -> None:
        """Show none."""
        if len(self._lines.data["x0"]):
            self._lines.data = {name: [] for name in _COLUMNS}

    def show(self, nodes: FloatArray, degrees: FloatArray) -> None:
        """Show the directions (N,), in degrees from x towards y, of nodes at (N, 2), evenly thinned out."""
        window = self._canvas.window
        cell = max(window.right - window.left, window.bottom - window.top) / _ACROSS
        known = np.flatnonzero(np.isfinite(degrees) & np.isfinite(nodes).all(axis=1))
        places = np.floor(nodes[known] / cell).astype(int)
        kept = known[np.unique(places, axis=0, return_index=True)[1]]
        angle = np.radians(degrees[kept])
        half = 0.4 * cell * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        ends = np.concatenate([nodes[kept] - half, nodes[kept] + half], axis=1)
        self._lines.data = dict(zip(_COLUMNS, ends.T, strict=True))
