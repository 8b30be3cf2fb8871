"""Pictures of one frame side by side: raw, its separated lights, their reflection index."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
import numpy.typing as npt
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure

__all__ = ["Tiles"]

_WIDE = 260
"""Columns of a small picture."""
_STEP, _GAP = 1.06, 0.2
"""From one to the next, and the room for a name over each, in widths of one."""
_COLUMNS = ("image", "x", "y", "dw", "name")


class Tiles:
    """The plot of the pictures; hidden until there are some."""

    def __init__(self) -> None:
        self._shown = ColumnDataSource({name: [] for name in _COLUMNS}, name="tiles")
        self.plot = figure(
            sizing_mode="scale_width",
            x_range=Range1d(0, 1),
            y_range=Range1d(1, 0),
            tools=[],
            toolbar_location=None,
            min_border=0,
            visible=False,
            background_fill_color=None,
            border_fill_color=None,
            outline_line_color=None,
        )
        self.plot.axis.visible = self.plot.grid.visible = False
        greys = [f"#{level:02x}{level:02x}{level:02x}" for level in range(256)]
        self._drawn = self.plot.image("image", "x", "y", "dw", 1, source=self._shown, palette=greys)
        self._drawn.glyph.color_mapper.update(low=0, high=255)
        letters = {"text_font_size": "11px", "text_color": "#808890", "text_baseline": "bottom", "y_offset": -1}
        self.plot.text("x", "y", "name", source=self._shown, **letters)

    def show(self, rows: Sequence[Mapping[str, npt.NDArray[np.uint8]]]) -> None:
        """Show rows of pictures (H, W) of one size by their names, the ends of the rows one below the other."""
        height, width = next(iter(rows[0].values())).shape
        tall = height / width
        across = max(map(len, rows))
        places = [
            (name, picture, x, y)
            for y, row in enumerate(rows)
            for x, (name, picture) in enumerate(row.items(), start=across - len(row))
        ]
        size = (_WIDE, max(1, round(_WIDE * tall)))
        self._drawn.glyph.dh = tall
        self._shown.data = {
            "image": [cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for _, picture, *_ in places],
            "x": [x * _STEP for *_, x, _ in places],
            "y": [y * (tall + _GAP) + _GAP for *_, y in places],
            "dw": [1.0] * len(places),
            "name": [name for name, *_ in places],
        }
        down = len(rows) * (tall + _GAP)
        self.plot.x_range.end, self.plot.y_range.start = across * _STEP, down
        self.plot.update(visible=True, aspect_ratio=across * _STEP / down)
