"""Content of a mesh file, whatever its format: nodes, elements, sets of elements; checked once, here.

A file defines every number once and refers only to what it defines, its nodes lie somewhere, and it is not larger than
what is read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray, IntArray

CORNERS = {"triangle": 3, "quad": 4, "tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
"""Shapes that are read, and their corners, in VTK's order."""
MAX_BYTES = 2**28
"""Largest file, or unpacked content of one: two million nodes and elements in text (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshContent:
    """Content of a mesh file.

    Attributes
    ----------
    points : ndarray, shape (N, 3)
        Nodes, in the file's unit.
    numbers : ndarray, shape (N,), int64
        Their labels.
    blocks
        Shape of cells, one of `CORNERS`; indices (m, corners or more) of their nodes; labels (m,).
    sets
        Labels of elements, by the name of their set.
    fields : mapping of str to ndarray, shape (N, ...)
        Nodal data.
    numbering : str
        Origin of the labels, in words.
    unread : collection of str
        Types of elements that are left out.
    """

    points: FloatArray
    numbers: IntArray
    blocks: Sequence[tuple[str, IntArray, IntArray]]
    sets: Mapping[str, Collection[int]]
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    numbering: str = "labels of the file"
    unread: Collection[str] = ()

    def __post_init__(self) -> None:
        """Check that every node is stated once and lies somewhere, and that elements have nodes that are stated."""
        if mismatched := [
            key for key, x in {"numbers": self.numbers, **self.fields}.items() if len(x) != len(self.points)
        ]:
            raise InputError(f"{mismatched[0]} of nodes are not as many as nodes")
        require_unique("node", self.numbers)
        # single precision is what most formats hold: what is beyond its range has no square in double
        is_far = ~(np.abs(self.points) <= np.finfo(np.float32).max).all(axis=1)
        if is_far.any():
            coordinates = ", ".join(f"{x:g}" for x in self.points[is_far][0])
            raise InputError(f"node {self.numbers[is_far][0]} lies at ({coordinates}): coordinates are finite numbers")
        for shape, nodes, labels in self.blocks:
            if nodes.ndim != 2 or nodes.shape[1] < CORNERS[shape]:
                raise InputError(f"a {shape} has fewer nodes than corners")
            is_invalid = ((nodes < 0) | (nodes >= len(self.points))).any(axis=1)
            if is_invalid.any():
                raise InputError(f"element {labels[is_invalid][0]} has a node that the file does not state")

    @classmethod
    def from_labels(
        cls,
        nodes: Sequence[tuple[int, Sequence[float]]],
        elements: Sequence[tuple[str, int, Sequence[int]]],
        sets: Mapping[str, Collection[int]],
        unread: Collection[str],
    ) -> Self:
        """Return the content of nodes (label, position) and elements (shape, label, labels of the nodes)."""
        large = [label for label in (*(n for n, _ in nodes), *(n for _, n, _ in elements)) if abs(label) >= 2**63]
        if large:
            raise InputError(f"the label {large[0]} is too large")
        require_unique("element", np.array([label for _, label, _ in elements], dtype=np.int64))
        if invalid := [label for label, position in nodes if len(position) != 3]:
            raise InputError(f"node {invalid[0]} has not three coordinates")
        index, cells = {label: i for i, (label, _) in enumerate(nodes)}, dict[str, list[list[int]]]()
        for shape, label, corners in elements:
            if undefined := [node for node in corners if node not in index]:
                raise InputError(f"element {label} has node {undefined[0]}, which the file does not state")
            if len(corners) < CORNERS[shape]:
                raise InputError(f"element {label} has fewer nodes than a {shape} has corners")
            cells.setdefault(shape, []).append([label, *(index[node] for node in corners[: CORNERS[shape]])])
        tables = {shape: np.array(rows) for shape, rows in cells.items()}
        blocks = [(shape, table[:, 1:], table[:, 0]) for shape, table in tables.items()]
        points = np.array([position for _, position in nodes], dtype=np.float64).reshape(-1, 3)
        numbers = np.array([label for label, _ in nodes], dtype=np.int64)
        return cls(points=points, numbers=numbers, blocks=blocks, sets=sets, unread=unread)


def require_unique(noun: str, labels: IntArray) -> None:
    """Refuse labels that occur twice."""
    values, count = np.unique(labels, return_counts=True)
    if (count > 1).any():
        raise InputError(f"{noun} {values[count > 1][0]} is stated {count[count > 1][0]} times")


def parse_whole(text: str) -> int:
    """Return the value of a whole number in a file; anything else is refused."""
    try:
        return int(text.replace("_", "no digit"))
    except ValueError:
        raise InputError(f'"{text[:40]}" stands where a whole number is expected') from None


def parse_real(text: str) -> float:
    """Return the value of a number as Fortran writes it too, with the exponent D or a sign alone; 0 of a blank."""
    try:
        return float(text.replace("_", "no digit") or 0)
    except ValueError:
        pass
    try:
        return float(re.sub(r"(?<=[\d.])(?=[+-])", "E", text.upper().replace("D", "E").replace("_", "no digit")))
    except ValueError:
        raise InputError(f'"{text[:40]}" stands where a number is expected') from None


def limit_size(path: Path) -> Path:
    """Return the path itself, of a regular file that is not larger than what is read."""
    if (size := require_regular_file(path).stat().st_size) > MAX_BYTES:
        raise InputError(f"{path} has {size} bytes; meshes of up to {MAX_BYTES} are read")
    return path


def read_text(path: Path, read_files: set[str]) -> str:
    """Return the text of a file that another may include, and add it to `read_files`, which are not read again."""
    if (real_path := os.path.realpath(path)) in read_files:
        raise InputError(f"{path} is included twice, or includes itself")
    read_files.add(real_path)
    return limit_size(path).read_text(encoding="utf-8-sig", errors="replace")
