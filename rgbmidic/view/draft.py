"""Draft of a TEST.toml, whose comments are kept, and its region of interest: marks on the image, drawn as lines."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomlkit
from bokeh.document import Document
from bokeh.models import ColumnDataSource
from tomlkit.exceptions import TOMLKitError

from rgbmidic.errors import ConfigurationError
from rgbmidic.results.files import write_complete
from rgbmidic.settings import FrameSettings, RegionSettings, TestSettings, read_section, read_toml
from rgbmidic.view.address import Mark
from rgbmidic.view.canvas import Canvas, columns

__all__ = ["HOLES", "OUTLINES", "Draft", "RegionDrawing", "arranged", "marks_of", "region_of", "rings"]

_FILES = (
    *("frames.path", "calibration.file", "region.mask", "mesh.file", "scale.camera"),
    *("weights.geometry", "weights.height_map", "weights.images"),
)
"""Keys that name files."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """A test that is being set up.

    Attributes
    ----------
    file
        Path of the TEST.toml, which may not exist yet.
    text
        Its content.
    """

    file: Path
    text: str

    @classmethod
    def of(cls, path: Path) -> Self:
        """Read a TEST.toml, or begin one in the working directory for frames.

        Parameters
        ----------
        path
            A TEST.toml, or the frames: a movie, a folder or a pattern.

        Returns
        -------
        Draft
            The draft.

        Raises
        ------
        ConfigurationError
            The file is missing, is not TOML, or does not name the frames.
        """
        if path.suffix.lower() == ".toml":
            read_toml(path, "settings file")
            draft = cls(file=path.resolve(), text=path.read_text(encoding="utf-8-sig"))
            try:
                _ = draft.frames
            except (ConfigurationError, TypeError) as error:
                raise ConfigurationError(f"{path}: {error}") from None
            return draft
        file = Path.cwd() / "TEST.toml"
        return cls(file=file, text="").changed({"frames": {"path": str(path.resolve())}})

    @property
    def document(self) -> dict[str, Any]:
        """The sections with their keys and plain values."""
        return tomllib.loads(self.text)

    def section(self, name: str) -> dict[str, Any]:
        """Return one section; empty where it is not there."""
        found = self.document.get(name, {})
        return found if isinstance(found, dict) else {}

    @property
    def frames(self) -> FrameSettings:
        """The settings of the frames; errors as `TestSettings.from_mapping`."""
        return read_section(FrameSettings, "frames", self.section("frames"), self.file.parent)

    @property
    def region(self) -> RegionSettings | None:
        """The settings of the region; None where there is none yet."""
        content = self.section("region")
        return read_section(RegionSettings, "region", content, self.file.parent) if content else None

    def changed(self, sections: Mapping[str, Mapping[str, Any]]) -> Self:
        """Return the draft with other values of some keys; comments and order stay.

        Parameters
        ----------
        sections
            Values by section and key; None removes a key.

        Returns
        -------
        Draft
            The changed draft.

        Raises
        ------
        ConfigurationError
            The TOML is written in a form that cannot be changed without losing something.
        """
        expected = {name: dict(content) for name, content in self.document.items()}
        document = tomlkit.parse(self.text)
        try:
            for name, content in sections.items():
                section: Any = document.setdefault(name, tomlkit.table())
                for key, value in content.items():
                    for target in (section, expected.setdefault(name, {})):
                        if value is None:
                            target.pop(key, None)
                        elif target.get(key) != value:
                            target[key] = value
        except (TOMLKitError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"{self.file} cannot be changed: {error}") from None
        changed = replace(self, text=tomlkit.dumps(document))
        if changed.document != expected:
            raise ConfigurationError(f"{self.file} cannot be changed without losing something; edit it by hand")
        return changed

    def at(self, file: Path) -> Self:
        """Return the draft at another path.

        Parameters
        ----------
        file
            Path of the TEST.toml, relative to the folder of the present one.

        Returns
        -------
        Draft
            The draft with that path.

        Raises
        ------
        ConfigurationError
            The name does not end in .toml, or files that the draft names by relative paths would not be found.
        """
        file = self.file.parent / file
        if file.suffix.lower() != ".toml":
            raise ConfigurationError(f"{file} must end in .toml")
        stated = [self.section(section).get(key, []) for section, _, key in (name.partition(".") for name in _FILES)]
        named = [text for value in stated for text in ([value] if isinstance(value, str) else value)]
        if file.parent != self.file.parent and any(not Path(text).is_absolute() for text in named):
            raise ConfigurationError(
                f"{file} must stay in {self.file.parent}: what it names is relative to that folder"
            )
        return replace(self, file=file)

    def write(self) -> None:
        """Write the TEST.toml.

        Raises
        ------
        ConfigurationError
            The draft is not a complete test; the message names the key.
        ResultError
            The file cannot be written.
        """
        TestSettings.from_mapping(self.document, self.file.parent)
        write_complete(self.file, lambda file: file.write(self.text.encode("utf-8")))


OUTLINES = {"rectangle": 2, "polygon": 3, "circle": 2}
"""Kinds of an outline and the marks that it takes at least: opposite corners; corners; the centre and a place on it."""
HOLES = {"hole": 3, "round hole": 2}
"""Kinds of a hole and the marks that it takes at least."""
_ROUND = 48
"""Corners of the polygon that stands for a circle: within 1 - cos(pi / 48) = 0.2 % of its radius."""

Ring = list[list[float]]


def arranged(marks: Sequence[Mark], new: str) -> tuple[Mark, ...]:
    """Return the marks after one of the kind `new` was set: there is one outline, of the kind drawn last."""
    if new not in OUTLINES:
        return tuple(marks)
    kept = [mark for mark in marks if mark.kind == new or mark.kind not in OUTLINES]
    of_kind = [mark for mark in kept if mark.kind == new]
    if new != "polygon" and len(of_kind) > OUTLINES[new]:  # a third place begins another one
        kept = [mark for mark in kept if mark.kind != new or mark is of_kind[-1]]
    return tuple(kept)


def region_of(marks: Sequence[Mark]) -> dict[str, Any] | None:
    """Return the keys of ``[region]`` for an outline and its holes; None where no outline is complete."""
    outline = next((kind for kind in OUTLINES if any(mark.kind == kind for mark in marks)), "")
    if not outline or sum(mark.kind == outline for mark in marks) < OUTLINES[outline]:
        return None
    corners, holes = _corners(outline, marks), _holes(marks)
    if outline == "rectangle":
        low, high = map(min, zip(*corners, strict=True)), map(max, zip(*corners, strict=True))
        shape: dict[str, Any] = {"rectangle": [*low, *high]}
    else:
        shape = {"polygon": corners}
    return {**shape, **({"holes": holes} if holes else {})}


def rings(marks: Sequence[Mark]) -> tuple[Ring, list[Ring]]:
    """Return the corners of the outline, as far as it is drawn, and of the complete holes."""
    region = region_of(marks) or {}
    if "rectangle" in region:
        x0, y0, x1, y1 = region["rectangle"]
        return [[x0, y0], [x1, y0], [x1, y1], [x0, y1]], _holes(marks)
    return region.get("polygon") or [[mark.x, mark.y] for mark in marks if mark.kind in OUTLINES], _holes(marks)


def marks_of(region: RegionSettings) -> tuple[Mark, ...]:
    """Return the marks that make a region; none for a mask."""
    if region.rectangle is not None:
        x0, y0, x1, y1 = region.rectangle
        outline = [Mark("rectangle", x0, y0), Mark("rectangle", x1, y1)]
    else:
        outline = [Mark("polygon", x, y) for x, y in region.polygon or ()]
    holes = [Mark(f"hole {number + 1}", x, y) for number, hole in enumerate(region.holes) for x, y in hole]
    return (*outline, *holes)


def _holes(marks: Sequence[Mark]) -> list[Ring]:
    """Return the corners of the complete holes."""
    names = [mark.kind for mark in marks if mark.kind not in OUTLINES]
    complete = [name for name in dict.fromkeys(names) if names.count(name) >= HOLES[name.rpartition(" ")[0]]]
    return [_corners(name, marks) for name in complete]


def _corners(name: str, marks: Sequence[Mark]) -> Ring:
    """Return the corners that the marks of an outline or a hole make, to a tenth of a pixel: a pointer's precision."""
    places = [(mark.x, mark.y) for mark in marks if mark.kind == name]
    if name.startswith(("circle", "round hole")):
        (x, y), on = places[:2]
        radius, angles = math.dist((x, y), on), np.arange(_ROUND) * 2 * np.pi / _ROUND
        places = list(zip(x + radius * np.cos(angles), y + radius * np.sin(angles), strict=True))
    return [[round(float(x), 1), round(float(y), 1)] for x, y in places]


_SOON = 60
"""Ms in which the moves of a mark are collected: a mesh of some 1,000 elements is made in that time."""
_KEPT = 100
"""Steps that can be undone: more than a hand takes back one by one, at some hundred bytes each."""


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
    changed
        Called when they have changed.
    """

    def __init__(
        self, document: Document, canvas: Canvas, marks: tuple[Mark, ...], changed: Callable[[], None]
    ) -> None:
        self._document, self._canvas, self._changed = document, canvas, changed
        self._history, self._hole, self._moved, self._coming = [marks], 1, False, False
        self._rings = ColumnDataSource(columns("xs ys colour"), name="rings")
        canvas.plot.multi_line("xs", "ys", source=self._rings, line_color="colour", line_width=2.5)
        canvas.marks.on_change("data", lambda attr, old, new: self._marked())

    @property
    def region(self) -> dict[str, Any] | None:
        """Keys of ``[region]``; None where no outline is complete."""
        return region_of(self._history[-1])

    def undo(self) -> None:
        """Return to the marks before the last step."""
        if len(self._history) > 1:
            self._history.pop()
        self.draw()

    def clear(self) -> None:
        """Remove all marks."""
        self._keep(())

    def next_hole(self) -> None:
        """Let the marks of a hole that are set from now on belong to another one."""
        holes = [mark.kind for mark in self._history[-1] if mark.kind.startswith("hole ")]
        self._hole = max((int(kind.rpartition(" ")[2]) for kind in holes), default=0) + 1

    def draw(self) -> None:
        """Draw the marks and the lines."""
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
        """Take the marks as they are on the plot; a new mark of a hole gets the number of its hole.

        A polygon's number is that of the present hole; a round hole is complete with two marks.
        """
        before, now = self._history[-1], list[Mark]()
        for mark in self._canvas.set:
            number = self._hole
            if mark.kind == "round hole":
                number = 1 + sum(other.kind.startswith("round hole ") for other in now) // HOLES["round hole"]
            now.append(Mark(f"{mark.kind} {number}", mark.x, mark.y) if mark.kind in HOLES else mark)
        if tuple(self._canvas.set) != before:
            new = next((mark.kind for mark in self._canvas.set if mark not in before), "")
            self._keep(arranged(now, new), moved=len(now) == len(before))

    def _keep(self, marks: tuple[Mark, ...], *, moved: bool = False) -> None:
        """Set the marks; the moves of a mark that is dragged are one step."""
        before = self._history[:-1] if moved and self._moved else self._history
        self._history, self._moved = [*before[-_KEPT:], marks], moved
        if not self._coming:
            self._coming = True
            self._document.add_timeout_callback(self.draw, _SOON)
