"""The region of interest as it is drawn: marks on the image, and the ``[region]`` that they make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rgbmidic.settings import RegionSettings
from rgbmidic.view.address import Mark

__all__ = ["HOLES", "OUTLINES", "arranged", "marks_of", "region_of", "rings"]

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
