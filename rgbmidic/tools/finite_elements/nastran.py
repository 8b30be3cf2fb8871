"""Nastran's bulk data, in fixed and free fields, with its labels and included files.

meshio drops ``INCLUDE``, elements in large fields and coordinate systems without a word.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from rgbmidic.errors import InputError
from rgbmidic.tools.finite_elements.mesh_file import CORNERS, MeshContent, parse_real, parse_whole, read_text

_SHAPES = {
    **dict.fromkeys(("CTRIA3", "CTRIAR", "CTRIA6", "CPLSTN3", "CPLSTN6", "CPLSTS3", "CPLSTS6"), "triangle"),
    **dict.fromkeys(("CQUAD4", "CQUADR", "CQUAD8", "CQUAD", "CSHEAR"), "quad"),
    **dict.fromkeys(("CPLSTN4", "CPLSTN8", "CPLSTS4", "CPLSTS8"), "quad"),
    **{"CTETRA": "tetra", "CPYRAM": "pyramid", "CPYRA": "pyramid", "CPENTA": "wedge", "CHEXA": "hexahedron"},
}
"""Elements that have faces, whose corners are the first nodes (MSC Nastran, Quick Reference Guide)."""


def read_nastran(path: Path) -> MeshContent:
    """Read nodes and elements; the elements of a property are a set."""
    nodes, elements = list[tuple[int, list[float]]](), list[tuple[str, int, list[int]]]()
    sets, unread = dict[str, list[int]](), set[str]()
    for name, fields in _cards(path):
        if name in ("GRID", "GRDSET"):
            label, system, *position = (*fields, "", "", "", "")[:5]
            if system not in ("", "0"):
                raise InputError(f"{name} {label} has the coordinate system {system}: write nodes in the basic one")
            if name == "GRID":
                nodes.append((parse_whole(label), [parse_real(x) for x in position]))
        elif (shape := _SHAPES.get(name)) is not None:
            label, property_, *corners = fields
            element_nodes, number = [parse_whole(node) for node in corners[: CORNERS[shape]]], parse_whole(label)
            elements.append((shape, number, element_nodes))
            sets.setdefault(property_ or label, []).append(number)
        elif name.startswith("C") and not name.startswith("CORD"):
            unread.add(name)
    return MeshContent.from_labels(nodes, elements, sets, unread)


def _cards(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the name and fields of every entry of the bulk data, without marks of continuation."""
    name, fields = "", list[str]()
    lines = [*_lines(path, set())]
    begin = next((i for i, line in enumerate(lines, 1) if re.match(r"\s*BEGIN\s+BULK", line, re.IGNORECASE)), 0)
    for line in lines[begin:]:  # gmsh and others write the entries alone
        card_name, values = _fields(line)
        if not card_name:
            fields += values
            continue
        if name:
            yield name, fields
        if card_name in ("ENDDATA", "END BULK"):
            return
        name, fields = card_name, values
    raise EOFError("it ends without ENDDATA")


def _fields(line: str) -> tuple[str, list[str]]:
    """Return the name of an entry, empty of one that goes on, and its eight fields, or four large ones."""
    card_name = (line.split(",")[0] if "," in line else line[:8]).strip().upper()
    number, width = (4, 16) if "*" in card_name else (8, 8)
    entries = line.split(",")[1:] if "," in line else [line[i : i + width] for i in range(8, 72, width)]
    name = "" if card_name.startswith(("+", "*")) else card_name.rstrip("*").rstrip()
    return name, [entry.strip() for entry in (*entries, *[""] * number)[:number]]


def _lines(path: Path, read_files: set[str]) -> Iterator[str]:
    """Yield the lines without blank ones and comments, with those of files that are included."""
    for line in read_text(path, read_files).splitlines():
        line = line.partition("$")[0].expandtabs(8).rstrip()
        if line.lstrip()[:7].upper() == "INCLUDE":
            yield from _lines(path.parent / line.lstrip()[7:].strip(" '\""), read_files)
        elif line:
            yield line
