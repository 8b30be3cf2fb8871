"""The region of a test as it is drawn: outline, holes and masks of the lights, from marks on a canvas."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bokeh.models as bk
import numpy as np
from bokeh.document import Document

from rgbmidic.errors import ConfigurationError
from rgbmidic.settings import RegionSettings, read_section
from rgbmidic.tools.report.style import OKABE_ITO
from rgbmidic.tools.view.canvas import Canvas, columns
from rgbmidic.tools.view.constants import VIEWER
from rgbmidic.tools.view.marks import Mark, UndoHistory

OUTLINES = {"rectangle": 2, "polygon": 3, "circle": 2}
"""Kinds of an outline and the marks that it takes at least: opposite corners; corners; the centre and a place on it."""
HOLES = {"hole": 3, "round hole": 2}
"""Kinds of a hole, whose marks have its number too, and the marks that it takes at least."""
MASK = "mask"
"""Kind of a polygon in which a light does not count; its marks have its number and the light too."""
SHAPES = {**OUTLINES, **HOLES, MASK: 3}
"""All kinds of shapes and the marks that they take at least."""

Ring = list[list[float]]


def keep_one_outline(marks: Sequence[Mark], new_kind: str) -> tuple[Mark, ...]:
    """Return the marks after one of the kind `new_kind` was set: there is one outline, of the kind drawn last."""
    if new_kind not in OUTLINES:
        return tuple(marks)
    remaining = [mark for mark in marks if mark.kind == new_kind or mark.kind not in OUTLINES]
    of_kind = [mark for mark in remaining if mark.kind == new_kind]
    if new_kind != "polygon" and len(of_kind) > OUTLINES[new_kind]:  # a third place begins another one
        remaining = [mark for mark in remaining if mark.kind != new_kind or mark is of_kind[-1]]
    return tuple(remaining)


def region_section(stored: Mapping[str, Any], marks: Sequence[Mark]) -> dict[str, Any]:
    """Return the keys of ``[region]`` for what is drawn; without an outline a mask that is `stored` stays."""
    drawn = _drawn_keys(marks)
    keys = {"mask": None if drawn.keys() - {"holes"} else stored.get("mask"), "holes": None, **drawn}
    return {"rectangle": None, "polygon": None, **keys} if stored or any(keys.values()) else {}


def _shape(mark: str) -> str:
    """Return the kind of shape that a kind of marks makes: they may have its number, and a light."""
    return next(shape for shape in SHAPES if mark.startswith(shape))


def _complete_shapes(marks: Sequence[Mark], shapes: Iterable[str]) -> dict[str, Ring]:
    """Return the corners of the complete shapes of some kinds, by the kind of their marks.

    They are rounded to a tenth of a pixel: a pointer's precision.
    """
    corners_by_kind = {}
    for kind in dict.fromkeys(mark.kind for mark in marks):
        points = [(mark.x, mark.y) for mark in marks if mark.kind == kind]
        if _shape(kind) in shapes and len(points) >= SHAPES[_shape(kind)]:
            if _shape(kind) in ("circle", "round hole"):
                (x, y), rim_point = points[:2]
                radius, corners = math.dist((x, y), rim_point), VIEWER.circle_corners
                angles = np.arange(corners) * 2 * np.pi / corners
                points = list(zip(x + radius * np.cos(angles), y + radius * np.sin(angles), strict=True))
            corners_by_kind[kind] = [[round(float(x), 1), round(float(y), 1)] for x, y in points]
    return corners_by_kind


def _drawn_keys(marks: Sequence[Mark]) -> dict[str, Any]:
    """Return the keys of ``[region]`` for the first outline that is complete, and for the holes that are."""
    keys = dict[str, Any]()
    for kind, corners in list(_complete_shapes(marks, OUTLINES).items())[:1]:
        low, high = map(min, zip(*corners, strict=True)), map(max, zip(*corners, strict=True))
        keys |= {"rectangle": [*low, *high]} if kind == "rectangle" else {"polygon": corners}
    if holes := [*_complete_shapes(marks, HOLES).values()]:
        keys["holes"] = holes
    return keys


def region_of(marks: Sequence[Mark]) -> dict[str, Any] | None:
    """Return the keys of ``[region]`` for an outline and its holes; None where no outline is complete."""
    keys = _drawn_keys(marks)
    return keys if keys.keys() - {"holes"} else None


def check_complete(marks: Sequence[Mark]) -> None:
    """Check that no outline, hole or mask lacks marks.

    Raises
    ------
    ConfigurationError
        One does: it would be left out.
    """
    for kind, count in Counter(mark.kind for mark in marks).items():
        if count < (min_count := SHAPES[_shape(kind)]):
            raise ConfigurationError(f"the {kind} needs {min_count} marks or more and has {count}: finish or remove it")


def rings(marks: Sequence[Mark]) -> tuple[Ring, list[Ring]]:
    """Return the corners of the outline, as far as it is drawn, and of the complete holes."""
    keys = _drawn_keys(marks)
    outline = keys.get("polygon") or [[mark.x, mark.y] for mark in marks if mark.kind in OUTLINES]
    if "rectangle" in keys:
        x0, y0, x1, y1 = keys["rectangle"]
        outline = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    return outline, keys.get("holes", [])


def marks_of_region(section: Mapping[str, Any], base: Path) -> tuple[Mark, ...]:
    """Return the marks that make the region of a section ``[region]``, relative to a folder; none for a mask."""
    if not section:
        return ()
    region = read_section(RegionSettings, "region", section, base)
    if region.rectangle is not None:
        x0, y0, x1, y1 = region.rectangle
        outline = [Mark("rectangle", x0, y0), Mark("rectangle", x1, y1)]
    else:
        outline = [Mark("polygon", x, y) for x, y in region.polygon or ()]
    holes = [Mark(f"hole {number + 1}", x, y) for number, hole in enumerate(region.holes) for x, y in hole]
    return (*outline, *holes)


def masks_of(marks: Sequence[Mark]) -> dict[str, list[Ring]]:
    """Return the corners of the complete masks of each light that has some."""
    by_light: dict[str, list[Ring]] = {}
    for kind, ring in _complete_shapes(marks, [MASK]).items():
        by_light.setdefault(kind.split(" ", 2)[2], []).append(ring)
    return by_light


_COLOURS = list(OKABE_ITO.values())
"""Of the masks; the first two are those of holes and outline."""


class RegionDrawing:
    """Marks of the region on a canvas, which can be undone, and the lines that they make.

    Parameters
    ----------
    document
        Document of the page.
    canvas
        Plot on which they are set and drawn.
    marks
        Marks at first.
    on_change
        Called when they have changed.

    Attributes
    ----------
    light
        Name of the light of which masks are drawn from now on.
    """

    def __init__(
        self, document: Document, canvas: Canvas, marks: tuple[Mark, ...], on_change: Callable[[], None]
    ) -> None:
        self._document, self._canvas, self._on_change = document, canvas, on_change
        self.light = ""
        self._steps, self._hole, self._redraw_pending = UndoHistory(marks), 1, False
        self._rings = bk.ColumnDataSource(columns("xs ys colour"), name="rings")
        canvas.plot.multi_line("xs", "ys", source=self._rings, line_color="colour", line_width=2.5)
        canvas.place_marks(marks)
        canvas.marks.on_change("data", lambda attr, old, new: self._receive_marks())

    @property
    def marks(self) -> tuple[Mark, ...]:
        """The marks."""
        return self._steps.marks

    def step(self, *, back: bool) -> None:
        """Return to the marks before the last step, or do it again."""
        self._canvas.place_marks(self._steps.step(back=back))
        self.draw()

    def next_hole(self) -> None:
        """Let the marks of a hole or a mask that are set from now on belong to another one."""
        numbers = [mark.kind.split(" ")[1] for mark in self.marks if mark.kind.startswith(("hole ", MASK))]
        self._hole = max(map(int, numbers), default=0) + 1

    def settle(self) -> None:
        """Draw the lines of marks that were set just now."""
        if self._redraw_pending:
            self.draw()

    def draw(self) -> None:
        """Draw the lines."""
        self._redraw_pending = False
        outline, holes = rings(self.marks)
        coloured_rings = [(outline, _COLOURS[1]), *((hole, _COLOURS[0]) for hole in holes)]
        for index, light_rings in enumerate(masks_of(self.marks).values()):
            coloured_rings += [(ring, _COLOURS[2 + index % (len(_COLOURS) - 2)]) for ring in light_rings]
        closed_rings = [([*ring, *ring[:1]], colour) for ring, colour in coloured_rings]
        rows = [([x for x, _ in ring], [y for _, y in ring], colour) for ring, colour in closed_rings]
        self._rings.data = columns("xs ys colour", rows)
        self._on_change()

    def _receive_marks(self) -> None:
        """Take the marks as they are on the plot; a new mark of a hole gets the number of its hole.

        A polygon's number is that of the present hole; a round hole is complete with two marks.
        """
        previous_keys, marks = {mark.key for mark in self.marks}, list[Mark]()
        for mark in self._canvas.current_marks:
            kind, number = mark.kind, self._hole
            if kind == "round hole":
                number = 1 + sum(earlier.kind.startswith("round hole ") for earlier in marks) // HOLES["round hole"]
            kind = f"{MASK} {number} {self.light}" if kind == MASK else f"{kind} {number}" if kind in HOLES else kind
            marks.append(replace(mark, kind=kind))
        if tuple(marks) != self.marks:
            self.take_marks(
                keep_one_outline(marks, next((mark.kind for mark in marks if mark.key not in previous_keys), ""))
            )

    def take_marks(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step that can be undone, and draw their lines."""
        self._steps.record(marks)
        self._canvas.place_marks(marks)
        if not self._redraw_pending:
            self._redraw_pending = True
            self._document.add_timeout_callback(self.settle, VIEWER.mark_ms)
