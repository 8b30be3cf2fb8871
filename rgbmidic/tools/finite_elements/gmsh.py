"""gmsh's files of versions 2 and 4.1, in text and binary, with their tags and nodal data (meshio keeps no tags)."""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.tools.finite_elements.mesh_file import MeshContent, limit_size, parse_real, parse_whole

logger = logging.getLogger(__name__)

_NODES = {
    **{"triangle": {2: 3, 9: 6, 20: 9, 21: 10, 22: 12, 23: 15, 24: 15, 25: 21}},
    **{"quad": {3: 4, 10: 9, 16: 8, 36: 16, 37: 25, 38: 36, 39: 12, 40: 16, 41: 20}},
    **{"tetra": {4: 4, 11: 10, 29: 20, 30: 35, 31: 56, 32: 22, 33: 28}},
    **{"hexahedron": {5: 8, 12: 27, 17: 20, 92: 64, 93: 125}},
    **{"wedge": {6: 6, 13: 18, 18: 15, 90: 40, 91: 75}},
    **{"pyramid": {7: 5, 14: 14, 19: 13}},
    **{"": {1: 2, 8: 3, 26: 4, 27: 5, 28: 6, 15: 1}},
}
"""Number of nodes of gmsh's numbers of element types, by shape; "" are lines and points (its GmshDefines.h)."""
_TYPES = {kind: (shape, count) for shape, kinds in _NODES.items() for kind, count in kinds.items()}
_WORD = re.compile(rb'\s*("[^"\n]*"|\S+)[ \t]*\r?\n?')
_HEADER = re.compile(rb"\$MeshFormat\s+(\S+)\s+([01])\s+8[ \t]*\r?\n")
_NUMBERS = {"i": parse_whole, "q": parse_whole, "d": parse_real}


def read_gmsh(path: Path) -> MeshContent:
    """Read nodes, elements, physical groups and nodal data of such a file."""
    content = limit_size(path).read_bytes().removeprefix(b"\xef\xbb\xbf")
    if not content.lstrip().startswith(b"$"):
        raise InputError(f"{path} is not a gmsh file: it does not begin with a section such as $MeshFormat")
    if (header := _HEADER.search(content)) is None:
        raise InputError(f"{path} has no $MeshFormat with a version, 0 or 1, and 8 as size of its numbers")
    if (version := header[1].decode(errors="replace")) != "4.1" and not version.startswith("2"):
        raise InputError(f"it is of version {version}; of gmsh's 2 and 4.1 are read")
    source: _Source = (_Binary if header[2] == b"1" else _Text)(content[header.end() :])
    mesh = _Mesh(is_old=version != "4.1")
    section: str | None = "$MeshFormat"
    while section is not None:
        if section == "$MeshFormat":
            pass
        elif (reader := _SECTIONS.get(section)) is not None:
            reader(mesh, source)
        elif section.startswith("$"):  # of no use here
            source.skip(f"$End{section[1:]}")
        else:
            raise InputError(f'"{section[:40]}" stands in no section')
        if (end := _read_word(source)) != f"$End{section[1:]}":
            raise InputError(f'after its stated number of rows {section} goes on with "{end[:40]}"')
        section = source.word()
    return mesh.content()


class _Source(Protocol):
    """The words and rows of numbers of a file."""

    is_binary: bool

    def word(self) -> str | None:
        """Return the next word or quoted name, None at the end."""

    def rows(self, layout: str, count: int = 1) -> Sequence[Sequence[Any]]:
        """Return rows of numbers, whose kinds are i (int), q (size_t) and d (double)."""

    def skip(self, end: str) -> None:
        """Go to the next word that ends a section."""


class _Text:
    is_binary = False

    def __init__(self, content: bytes) -> None:
        text = content.decode("utf-8", errors="replace")
        self._words, self._index = re.findall(r'"[^"\n]*"|\S+', text), 0

    def word(self) -> str | None:
        self._index += 1
        return self._words[self._index - 1] if self._index <= len(self._words) else None

    def rows(self, layout: str, count: int = 1) -> list[list[Any]]:
        kinds, begin, width = [_NUMBERS[kind] for kind in layout], self._index, len(layout)
        self._index += _require_count(count) * width
        if self._index > len(self._words):
            raise EOFError
        numbers = range(begin, self._index, width)
        return [[kind(x) for kind, x in zip(kinds, self._words[i : i + width], strict=True)] for i in numbers]

    def skip(self, end: str) -> None:
        self._index = self._words.index(end, self._index) if end in self._words[self._index :] else len(self._words)


class _Binary:
    is_binary = True

    def __init__(self, content: bytes) -> None:
        """Begin with the number one, which shows the order of bytes."""
        self._content, self._offset, self._order = content, 4, "<" if content[:1] == b"\1" else ">"

    def word(self) -> str | None:
        if (match := _WORD.match(self._content, self._offset)) is None:
            return None
        self._offset = match.end()
        return match[1].decode("utf-8", errors="replace")

    def rows(self, layout: str, count: int = 1) -> list[tuple[Any, ...]]:
        row = struct.Struct(self._order + layout)
        begin, self._offset = self._offset, self._offset + _require_count(count) * row.size
        if self._offset > len(self._content):
            raise EOFError
        return [*row.iter_unpack(self._content[begin : self._offset])]

    def skip(self, end: str) -> None:
        self._offset = max(self._content.find(end.encode(), self._offset), 0) or len(self._content)


@dataclass(slots=True)
class _Mesh:
    """Content of the sections of a file that are read so far."""

    is_old: bool = False
    names: dict[tuple[int, int], str] = field(default_factory=dict)
    groups: dict[tuple[int, int], list[int]] = field(default_factory=dict)
    nodes: list[tuple[int, Sequence[float]]] = field(default_factory=list)
    elements: list[tuple[str, int, Sequence[int]]] = field(default_factory=list)
    sets: dict[str, list[int]] = field(default_factory=dict)
    data: dict[str, dict[int, Sequence[float]]] = field(default_factory=dict)

    def content(self) -> MeshContent:
        """Return it with checks; a node without data has NaN."""
        content = MeshContent.from_labels(self.nodes, self.elements, self.sets, ())
        fields = {}
        for name, values in self.data.items():
            empty = [np.nan] * len(next(iter(values.values()), [0.0]))
            table = np.array([values.get(node, empty) for node, _ in self.nodes], dtype=np.float64)
            fields[name] = table[:, 0] if len(empty) == 1 else table
        return replace(content, fields=fields)

    def add(self, shape: str, tag: int, corners: Sequence[int], groups: Sequence[int]) -> None:
        """Add an element and its physical groups."""
        if shape:
            self.elements.append((shape, tag, corners))
            dimension = 2 if shape in ("triangle", "quad") else 3
            for group in groups:
                self.sets.setdefault(self.names.get((dimension, group), str(group)), []).append(tag)

    def read_names(self, source: _Source) -> None:
        """Read ``$PhysicalNames``, which are text in every file."""
        for _ in range(_read_int(source)):
            dimension, number = _read_int(source), _read_int(source)
            self.names[dimension, number] = _read_word(source).strip('"')

    def read_entities(self, source: _Source) -> None:
        """Read the physical groups of the entities of version 4."""
        for dimension, count in enumerate(source.rows("qqqq")[0]):
            for _ in range(count):
                entity = source.rows("i" + "d" * (3 if dimension == 0 else 6))[0][0]
                self.groups[dimension, entity] = [abs(group) for (group,) in source.rows("i", _read_size(source))]
                if dimension:
                    source.rows("i", _read_size(source))

    def read_nodes(self, source: _Source) -> None:
        """Read ``$Nodes``; those of curves and surfaces may have parameters."""
        if self.is_old:
            self.nodes += [(label, position) for label, *position in source.rows("iddd", _read_int(source))]
            return
        for _ in range(source.rows("qqqq")[0][0]):
            dimension, _, is_parametric = source.rows("iii")[0]
            if not (0 <= is_parametric * dimension <= 3):
                raise InputError(f"nodes on an entity of {dimension} dimensions: 0 to 3 are possible")
            labels = [label for (label,) in source.rows("q", _read_size(source))]
            positions = source.rows("ddd" + "d" * (is_parametric * dimension), len(labels))
            self.nodes += [(label, position[:3]) for label, position in zip(labels, positions, strict=True)]

    def read_parametric_nodes(self, source: _Source) -> None:
        """Read ``$ParametricNodes`` of version 2: each with dimension and number of its entity, and parameters."""
        for _ in range(_read_int(source)):
            ((label, *position, dimension, _),) = source.rows("idddii")
            source.rows("d", dimension % 3)  # in a volume none are written
            self.nodes.append((label, position))

    def read_elements(self, source: _Source) -> None:
        """Read ``$Elements``: rows of text or blocks of version 2, blocks of entities of version 4."""
        if not self.is_old:
            for _ in range(source.rows("qqqq")[0][0]):
                level, entity, kind = source.rows("iii")[0]
                shape, width = _element_type(kind)
                for tag, *corners in source.rows("q" * (1 + width), _read_size(source)):
                    self.add(shape, tag, corners, self.groups.get((level, entity), ()))
            return
        n_remaining = _read_int(source)
        while n_remaining > 0:
            tag, kind, n_tags = source.rows("iii")[0]
            kind, count = (tag, kind) if source.is_binary else (kind, 1)
            shape, width = _element_type(kind)
            step = source.is_binary + n_tags + width
            numbers = [x for (x,) in source.rows("i", count * step)]
            for row in (numbers[i : i + step] for i in range(0, len(numbers), step)):
                self.add(shape, row.pop(0) if source.is_binary else tag, row[n_tags:], row[: min(n_tags, 1)])
            n_remaining -= count

    def read_nodal_data(self, source: _Source) -> None:
        """Read ``$NodeData``, whose head is text in every file."""
        name, *_ = [_read_word(source).strip('"') for _ in range(_read_int(source))]
        for _ in range(_read_int(source)):
            _read_word(source)
        _, width, count, *_ = [_read_int(source) for _ in range(_read_int(source))]
        if width not in (1, 3, 9):
            raise InputError(f"nodal data have 1, 3 or 9 components, not {width}")
        if name in self.data:
            logger.warning('of the nodal data "%s", stated more than once, the last are read', name)
        self.data[name] = {label: values for label, *values in source.rows("i" + "d" * width, count)}


_SECTIONS = {
    "$PhysicalNames": _Mesh.read_names,
    "$Entities": _Mesh.read_entities,
    "$Nodes": _Mesh.read_nodes,
    "$ParametricNodes": _Mesh.read_parametric_nodes,
    "$Elements": _Mesh.read_elements,
    "$NodeData": _Mesh.read_nodal_data,
}


def _read_word(source: _Source) -> str:
    """Return the next word of a section."""
    if (word := source.word()) is None:
        raise EOFError
    return word


def _read_int(source: _Source) -> int:
    """Return the next word, a whole number."""
    return parse_whole(_read_word(source))


def _read_size(source: _Source) -> int:
    """Return the next size."""
    return int(source.rows("q")[0][0])


def _require_count(count: int) -> int:
    """Refuse a count that is none."""
    if count < 0:
        raise InputError(f"it states {count} rows")
    return count


def _element_type(kind: int) -> tuple[str, int]:
    """Return the shape and number of nodes of an element type."""
    if kind not in _TYPES:
        raise InputError(f"its elements of type {kind} are not read; those of types {', '.join(map(str, _TYPES))} are")
    return _TYPES[kind]
