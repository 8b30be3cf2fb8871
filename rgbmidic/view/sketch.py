"""The region of interest as it is drawn on a frame: marks that can be undone, and the lines they make."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from bokeh.document import Document
from bokeh.models import ColumnDataSource

from rgbmidic.view.address import Mark
from rgbmidic.view.canvas import Canvas
from rgbmidic.view.outline import HOLES, arranged, region_of, rings

__all__ = ["Sketch"]

_SOON = 60
"""Ms that a mark which moves waits for its next move."""
_KEPT = 100
"""Steps that can be undone."""


class Sketch:
    """The marks of the region on a canvas.

    Parameters
    ----------
    document
        Of the page.
    canvas
        Where they are set and drawn.
    marks
        The first.
    changed
        Called when they have changed.
    """

    def __init__(
        self, document: Document, canvas: Canvas, marks: tuple[Mark, ...], changed: Callable[[], None]
    ) -> None:
        self._document, self._canvas, self._changed = document, canvas, changed
        self._history, self._hole, self._moved, self._coming = [marks], 1, False, False
        self._rings = ColumnDataSource({"xs": [], "ys": [], "colour": []}, name="rings")
        canvas.plot.multi_line("xs", "ys", source=self._rings, line_color="colour", line_width=2.5)
        canvas.marks.on_change("data", lambda attr, old, new: self._marked())

    @property
    def region(self) -> dict[str, Any] | None:
        """What ``[region]`` says of it; None where no outline is complete."""
        return region_of(self._history[-1])

    def undo(self) -> None:
        """As it was before the last step."""
        if len(self._history) > 1:
            self._history.pop()
        self.draw()

    def clear(self) -> None:
        """Without any mark."""
        self._keep(())

    def next_hole(self) -> None:
        """The marks of a hole that come now belong to another one."""
        holes = [mark.kind for mark in self._history[-1] if mark.kind.startswith("hole ")]
        self._hole = max((int(kind.rpartition(" ")[2]) for kind in holes), default=0) + 1

    def draw(self) -> None:
        """Draw it."""
        self._coming = False
        self._canvas.place(self._history[-1])
        outline, holes = rings(self._history[-1])
        closed = [[*ring, *ring[:1]] for ring in (outline, *holes)]
        self._rings.data = {
            "xs": [[x for x, _ in ring] for ring in closed],
            "ys": [[y for _, y in ring] for ring in closed],
            "colour": ["#56b4e9", *["#e69f00"] * len(holes)],
        }
        self._changed()

    def _marked(self) -> None:
        """Marks were set, moved or removed on the plot."""
        now, before = tuple(self._canvas.set), self._history[-1]
        if now != before:
            new = next((mark.kind for mark in now if mark not in before), "")
            self._keep(arranged(_numbered(now, self._hole), new), moved=len(now) == len(before))

    def _keep(self, marks: tuple[Mark, ...], *, moved: bool = False) -> None:
        """Let these be the marks; a mark that is dragged comes many times, and is undone at once."""
        before = self._history[:-1] if moved and self._moved else self._history
        self._history, self._moved = [*before[-_KEPT:], marks], moved
        if not self._coming:
            self._coming = True
            self._document.add_timeout_callback(self.draw, _SOON)


def _numbered(marks: Sequence[Mark], hole: int) -> tuple[Mark, ...]:
    """New marks of holes with the number of theirs: a polygon's is `hole`, a round one is complete with two marks."""
    done: list[Mark] = []
    for mark in marks:
        number = hole
        if mark.kind == "round hole":
            number = 1 + sum(one.kind.startswith("round hole ") for one in done) // HOLES["round hole"]
        done.append(Mark(f"{mark.kind} {number}", mark.x, mark.y) if mark.kind in HOLES else mark)
    return tuple(done)
