"""The TEST.toml that a page sets up: read as far as it goes, changed where the page says so, comments kept.

The region of interest as it is drawn: marks on the image, and the ``[region]`` that they make.

The region of interest as it is drawn on a frame: marks that can be undone, and the lines they make.
"""

from __future__ import annotations

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
from rgbmidic.view.canvas import Canvas

__all__ = ["HOLES", "OUTLINES", "Draft", "Sketch", "arranged", "marks_of", "region_of", "rings"]

_FILES = (
    ("calibration", "file"),
    ("region", "mask"),
    ("weights", "geometry"),
    ("weights", "height_map"),
    ("weights", "images"),
)
"""Keys that name files, beside the frames."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Draft:
    """A test that is being set up.

    Attributes
    ----------
    file
        Where it is, or will be written.
    text
        What it says.
    """

    file: Path
    text: str

    @classmethod
    def of(cls, path: Path) -> Self:
        """Of a TEST.toml, or a new one ``TEST.toml`` here for frames: a movie, a folder or a pattern.

        Raises
        ------
        ConfigurationError
            The file is missing or not TOML, or says nothing of the frames.
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
        """One section; empty where it is not there."""
        found = self.document.get(name, {})
        return found if isinstance(found, dict) else {}

    @property
    def frames(self) -> FrameSettings:
        """The frames; errors as `TestSettings.from_mapping`."""
        if "path" not in self.section("frames"):
            raise ConfigurationError("frames.path is missing")
        return read_section(FrameSettings, "frames", self.section("frames"), self.file.parent)

    @property
    def region(self) -> RegionSettings | None:
        """The region; None where there is none yet."""
        content = self.section("region")
        return read_section(RegionSettings, "region", content, self.file.parent) if content else None

    @property
    def settings(self) -> TestSettings:
        """All of it; errors as `TestSettings.from_mapping`."""
        return TestSettings.from_mapping(self.document, self.file.parent)

    def changed(self, sections: Mapping[str, Mapping[str, Any]]) -> Self:
        """With other values of some keys, None for a key that goes; comments and order stay.

        Raises
        ------
        ConfigurationError
            The file is written in a way in which that cannot be done.
        """
        expected = {name: dict(content) for name, content in self.document.items()}
        document = tomlkit.parse(self.text)
        try:
            for name, content in sections.items():
                section: Any = document.setdefault(name, tomlkit.table())
                for key, value in content.items():
                    _change(section, key, value)
                    _change(expected.setdefault(name, {}), key, value)
        except (TOMLKitError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"{self.file} cannot be changed: {error}") from None
        changed = replace(self, text=tomlkit.dumps(document))
        if changed.document != expected:
            raise ConfigurationError(f"{self.file} cannot be changed without losing something; edit it by hand")
        return changed

    def at(self, file: Path) -> Self:
        """The same in another place.

        Raises
        ------
        ConfigurationError
            It would no longer find what it names relative to where it was, or the name does not end in .toml.
        """
        file = self.file.parent / file
        if file.suffix.lower() != ".toml":
            raise ConfigurationError(f"{file} must end in .toml")
        if file.parent != self.file.parent and any(not Path(text).is_absolute() for text in self._paths()):
            raise ConfigurationError(
                f"{file} must stay in {self.file.parent}: what it names is relative to that folder"
            )
        return replace(self, file=file)

    def _paths(self) -> list[str]:
        named = [self.section(section).get(key, []) for section, key in (("frames", "path"), *_FILES)]
        return [text for one in named for text in ([one] if isinstance(one, str) else one)]

    def write(self) -> None:
        """Write it, once it is a whole test.

        Raises
        ------
        ConfigurationError
            It is not; the message names the key.
        ResultError
            The disk refuses.
        """
        _ = self.settings
        write_complete(self.file, lambda file: file.write(self.text.encode("utf-8")))


def _change(section: Any, key: str, value: Any) -> None:
    if value is None:
        section.pop(key, None)
    elif section.get(key) != value:
        section[key] = value


OUTLINES = {"rectangle": 2, "polygon": 3, "circle": 2}
"""Kinds of an outline and the marks that it takes at least: opposite corners; corners; the centre and a place on it."""
HOLES = {"hole": 3, "round hole": 2}
_ROUND = 48
"""Corners of the polygon that stands for a circle: within .2 % of its radius, half a pixel of one of 230 px."""

Ring = list[list[float]]


def arranged(marks: Sequence[Mark], new: str) -> tuple[Mark, ...]:
    """The marks after one of the kind `new` was set: there is one outline, of the kind that was drawn last."""
    if new not in OUTLINES:
        return tuple(marks)
    kept = [mark for mark in marks if mark.kind == new or mark.kind not in OUTLINES]
    own = [mark for mark in kept if mark.kind == new]
    if new != "polygon" and len(own) > OUTLINES[new]:  # a third place begins another one
        kept = [mark for mark in kept if mark.kind != new or mark is own[-1]]
    return tuple(kept)


def region_of(marks: Sequence[Mark]) -> dict[str, Any] | None:
    """What ``[region]`` says of an outline and its holes, in plain values; None where no outline is complete."""
    outline = next((kind for kind in OUTLINES if any(mark.kind == kind for mark in marks)), "")
    own = [(mark.x, mark.y) for mark in marks if mark.kind == outline]
    if not outline or len(own) < OUTLINES[outline]:
        return None
    holes = [ring for ring, _ in _holes(marks)]
    if outline == "rectangle":
        (x0, y0), (x1, y1) = own
        shape: dict[str, Any] = {"rectangle": _rounded([min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1)])}
    else:
        shape = {"polygon": [_rounded(p) for p in (own if outline == "polygon" else _circle(*own))]}
    return {**shape, **({"holes": holes} if holes else {})}


def rings(marks: Sequence[Mark]) -> tuple[Ring, list[Ring]]:
    """The outline and the holes, each as a closed line to draw; what is not complete yet as far as it goes."""
    region = region_of(marks) or {}
    if "rectangle" in region:
        x0, y0, x1, y1 = region["rectangle"]
        outline = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]]
    else:
        outline = region.get("polygon") or [[mark.x, mark.y] for mark in marks if mark.kind in OUTLINES]
    return outline, [ring for ring, _ in _holes(marks)]


def marks_of(region: RegionSettings) -> tuple[Mark, ...]:
    """The marks that make a region; none for a mask."""
    if region.rectangle is not None:
        x0, y0, x1, y1 = region.rectangle
        outline = [Mark("rectangle", x0, y0), Mark("rectangle", x1, y1)]
    else:
        outline = [Mark("polygon", x, y) for x, y in region.polygon or ()]
    holes = [Mark(f"hole {number + 1}", x, y) for number, hole in enumerate(region.holes) for x, y in hole]
    return (*outline, *holes)


def _holes(marks: Sequence[Mark]) -> list[tuple[Ring, str]]:
    """The complete holes with their names, such as ``"hole 2"`` and ``"round hole 1"``."""
    names = dict.fromkeys(mark.kind for mark in marks if mark.kind not in OUTLINES)
    found = []
    for name in names:
        kind, own = name.rpartition(" ")[0], [(mark.x, mark.y) for mark in marks if mark.kind == name]
        if len(own) >= HOLES[kind]:
            corners = own if kind == "hole" else _circle(*own[:2])
            found.append(([_rounded(corner) for corner in corners], name))
    return found


def _circle(centre: tuple[float, float], on: tuple[float, float]) -> list[tuple[float, float]]:
    radius = np.hypot(on[0] - centre[0], on[1] - centre[1])
    angles = np.arange(_ROUND) * 2 * np.pi / _ROUND
    return [(centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a)) for a in angles.tolist()]


def _rounded(numbers: Sequence[float]) -> list[float]:
    """To a tenth of a pixel, which no outline needs more of."""
    return [round(float(number), 1) for number in numbers]


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
