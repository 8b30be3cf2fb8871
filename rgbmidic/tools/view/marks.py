"""Marks on the image: places of probes that the pointer sets, the steps back, and the probes that they make."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from rgbmidic.settings import ProbeSettings
from rgbmidic.tools.view.constants import VIEWER

KINDS = {"point": 1, "gauge": 2, "line": 2, "strain_gauge": 1, "region": 2, "circle": 2}
"""Probes that can be set with the pointer, and how many places each takes."""
SCALE = "scale"
MARKS = (*KINDS, SCALE)
"""Kinds of marks: those of probes, and two points of a known distance."""


@dataclass(frozen=True, slots=True)
class Mark:
    """A place on the reference that belongs to a probe.

    Attributes
    ----------
    kind
        One of `MARKS`; those that take two places take marks of their kind in pairs.
    x, y
        Place in px on the reference.
    name
        Name of the probe of which it is the first mark; empty: its kind and number.
    key
        The same for a mark that is moved or renamed, however many have its values.
    """

    kind: str
    x: float
    y: float
    name: str = ""
    key: object = field(default_factory=object, compare=False, repr=False, kw_only=True)


class UndoHistory:
    """Marks, which can be undone and done again; the moves of a mark that is dragged are one step.

    Parameters
    ----------
    marks
        Marks at first.

    Attributes
    ----------
    marks
        The marks.
    """

    def __init__(self, marks: tuple[Mark, ...]) -> None:
        self.marks, self._past, self._future, self._moved_mark = marks, list[Any](), list[Any](), -1

    def record(self, marks: tuple[Mark, ...]) -> None:
        """Take marks as a step."""
        changed_indices = [
            index for index, states in enumerate(zip(self.marks, marks, strict=False)) if states[0] != states[1]
        ]
        is_single_change = len(marks) == len(self.marks) and len(changed_indices) == 1
        moved_index = (
            changed_indices[0]
            if is_single_change
            and replace(marks[changed_indices[0]], x=0, y=0) == replace(self.marks[changed_indices[0]], x=0, y=0)
            else -1
        )
        if moved_index < 0 or moved_index != self._moved_mark:
            self._past = [*self._past[-VIEWER.undo_steps :], self.marks]
        self.marks, self._future, self._moved_mark = marks, [], moved_index

    def step(self, *, back: bool) -> tuple[Mark, ...]:
        """Return to the marks before the last step, or do again the one that was undone last."""
        source, target = (self._past, self._future) if back else (self._future, self._past)
        if source:
            target.append(self.marks)
            self.marks, self._moved_mark = source.pop(), -1
        return self.marks


def probe_marks(marks: Sequence[Mark]) -> dict[str, list[Mark]]:
    """Return the marks of each complete probe by its name, else kind and number: those of a kind in the order set."""
    marks_by_name: dict[str, list[Mark]] = {}
    for kind, count in KINDS.items():
        of_kind = [mark for mark in marks if mark.kind == kind]
        for number in range(len(of_kind) // count):
            name = of_kind[number * count].name
            has_default_name = not name or name in marks_by_name
            marks_by_name[f"{kind}_{number + 1}" if has_default_name else name] = of_kind[
                number * count : (number + 1) * count
            ]
    return marks_by_name


def probe_position(marks: Sequence[Mark], gauge: float) -> tuple[float, ...]:
    """Return the numbers that place the probe of some marks, as ``[probes]`` has them; strain gauges of a length."""
    coordinates = [coordinate for mark in marks for coordinate in (mark.x, mark.y)]
    if marks[0].kind == "strain_gauge":
        return (*coordinates, gauge)
    if marks[0].kind == "circle":
        return (*coordinates[:2], math.dist(coordinates[:2], coordinates[2:]))
    return tuple(coordinates)


def settings_of_marks(
    marks: Sequence[Mark], gauge: float, defaults: ProbeSettings, measure: Any = None
) -> ProbeSettings:
    """Return the probes that marks make, each kind in the order set; a last mark without its pair waits for it.

    Strain gauges have the length `gauge` (px); window and, unless it is chosen, strain measure are those `defaults`.
    """
    positions: dict[str, Any] = {f"{kind}s": () for kind in KINDS}
    names = []
    for name, group in probe_marks(marks).items():
        positions[f"{group[0].kind}s"] += (probe_position(group, gauge),)
        if name == group[0].name:
            names.append((f"{group[0].kind}_{len(positions[f'{group[0].kind}s'])}", name))
    return ProbeSettings(measure=measure or defaults.measure, window=defaults.window, names=tuple(names), **positions)


def marks_of_probes(settings: ProbeSettings) -> tuple[Mark, ...]:
    """Return the marks of the probes stated, of those kinds that can be set with the pointer."""
    marks, names = [], dict(settings.names)
    for default_name, (kind, position) in zip(settings.labels, settings.kind_coordinates, strict=True):
        if kind not in KINDS:
            continue
        x, y, *second_point = position
        marks.append(Mark(kind, x, y, names.get(default_name, "")))
        if KINDS[kind] > 1:
            marks.append(
                Mark(kind, x + second_point[0], y) if kind == "circle" else Mark(kind, second_point[0], second_point[1])
            )
    return tuple(marks)


def common_gauge(settings: ProbeSettings) -> float | None:
    """Return the length of the strain gauges stated, 0 without any; None where they differ: a page has one for all."""
    lengths = {length for *_, length in settings.strain_gauges} or {0.0}
    return lengths.pop() if len(lengths) == 1 else None
