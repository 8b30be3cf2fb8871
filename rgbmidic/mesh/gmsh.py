"""gmsh's files in text, versions 2 and 4.1, with their tags (meshio keeps none)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rgbmidic.errors import InputError
from rgbmidic.mesh.content import MeshContent, text_of
from rgbmidic.mesh.meshio_formats import read_with_meshio

_SHAPES = {
    **dict.fromkeys((2, 9, 20, 21), "triangle"),
    **dict.fromkeys((3, 10, 16, 36), "quad"),
    **dict.fromkeys((4, 11), "tetra"),
    **dict.fromkeys((5, 12, 17), "hexahedron"),
    **dict.fromkeys((6, 13, 18), "wedge"),
    **dict.fromkeys((7, 14, 19), "pyramid"),
}
"""Shapes of gmsh's numbers of element types, of first to third order (its manual, "Node ordering")."""
_THIN = {1, 8, 15, 26, 27, 28}
"""Lines and points, which files have on every edge and corner."""


def read_gmsh(path: Path) -> MeshContent:
    """Read such a file, and by meshio one in binary."""
    with path.open("rb") as file:
        if not file.read(200).lstrip().startswith(b"$"):
            raise InputError(f"{path} is not a gmsh file: it does not begin with a section such as $MeshFormat")
    lines = iter([line for line in text_of(path, set()).splitlines() if line.strip()])
    version, names = "", dict[tuple[int, int], str]()
    groups = dict[tuple[int, int], list[int]]()  # physical groups of the entities of version 4
    nodes, elements = list[tuple[int, list[float]]](), list[tuple[str, int, list[int]]]()
    sets, unread = dict[str, list[int]](), set[str]()

    def rows(count: str | int) -> list[list[str]]:
        return [next(lines).split() for _ in range(int(count))]

    def add(kind: int, tag: int, corners: list[int], members: Sequence[int]) -> None:
        if (shape := _SHAPES.get(kind)) is not None:
            elements.append((shape, tag, corners))
            for group in members:
                dimension = 2 if shape in ("triangle", "quad") else 3
                sets.setdefault(names.get((dimension, group), str(group)), []).append(tag)
        elif kind not in _THIN:
            unread.add(f"type {kind}")

    for line in lines:
        section = line.strip()
        if section == "$MeshFormat":
            version, is_binary, *_ = next(lines).split()
            if int(is_binary):
                return read_with_meshio(path, "gmsh")
            if version != "4.1" and not version.startswith("2"):
                raise InputError(f"it is of version {version}; of gmsh's text 2 and 4.1 are read")
        elif section == "$PhysicalNames":
            for axis, number, *title in rows(next(lines)):
                names[int(axis), int(number)] = " ".join(title).strip('"')
        elif section == "$Entities":
            for dimension, count in enumerate(next(lines).split()):
                for entity, *about in rows(count):
                    at = 3 if dimension == 0 else 6
                    groups[dimension, int(entity)] = [abs(int(n)) for n in about[at + 1 : at + 1 + int(about[at])]]
        elif section == "$Nodes" and version != "4.1":
            nodes += [(int(label), [float(x) for x in place]) for label, *place in rows(next(lines))]
        elif section == "$Nodes":
            for _ in range(int(next(lines).split()[0])):
                count = next(lines).split()[3]
                labels = [int(label) for (label,) in rows(count)]
                nodes += [(label, [float(x) for x in y[:3]]) for label, y in zip(labels, rows(count), strict=True)]
        elif section == "$Elements" and version != "4.1":
            for row in rows(next(lines)):
                tag, kind, width, *rest = map(int, row)
                add(kind, tag, rest[width:], rest[: min(width, 1)])
        elif section == "$Elements":
            for _ in range(int(next(lines).split()[0])):
                level, tag, kind, many = map(int, next(lines).split())
                members = groups.get((level, tag), ())
                for row in rows(many):
                    tag, *corners = map(int, row)
                    add(kind, tag, corners, members)
        elif section.startswith("$"):  # of no use here
            while not (section := next(lines).strip()).startswith("$End"):
                pass
            continue
        else:
            raise InputError(f'"{section[:40]}" stands in no section')
        if (end := next(lines).strip()) != f"$End{section[1:]}":
            raise InputError(f'after its stated number of rows {section} goes on with "{end[:40]}"')
    return MeshContent.labelled(nodes, elements, sets, unread)
