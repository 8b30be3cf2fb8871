"""Abaqus' input files, with the labels of nodes and elements (meshio keeps neither, nor more than one ``*NODE``)."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from rgbmidic.errors import InputError
from rgbmidic.tools.finite_elements.mesh_file import CORNERS, MeshContent, parse_real, parse_whole, read_text

logger = logging.getLogger(__name__)

_ELEMENT = re.compile(
    r"(?:(CPS|CPE|CPEG|CAX|CGAX|S|STRI|M3D|R3D|SFM3D|DC2D|DCAX|DS|AC2D|ACAX)|C3D|DC3D|AC3D|SC)(\d+)", re.IGNORECASE
)
"""Elements that have faces: planar ones or solids; others (beams, springs, cohesive ones) are not read."""
_PLANAR = {"3": "triangle", "6": "triangle", "65": "triangle", "4": "quad", "8": "quad", "9": "quad"}
_SOLIDS = {
    **{"4": "tetra", "10": "tetra", "5": "pyramid", "13": "pyramid", "6": "wedge", "15": "wedge"},
    **dict.fromkeys(("8", "20", "27"), "hexahedron"),
}
"""Shapes by the number in an element's name, which is that of its nodes (STRI65: six, with five unknowns)."""
_GENERATED = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"}

_Rows = list[list[str]]


class _Options(dict[str, str]):
    """Options of a keyword, which refuses to be asked for one that is not there."""

    def __init__(self, keyword: str, entries: Iterable[str]) -> None:
        pairs = (entry.partition("=") for entry in entries)
        super().__init__({key.strip().upper(): value.strip() for key, _, value in pairs})
        self._keyword = keyword

    def __missing__(self, key: str) -> str:
        raise InputError(f"*{self._keyword} has no {key}")


def read_abaqus(path: Path) -> MeshContent:
    """Read nodes, elements and element sets of an input file, of its one part that has elements, or without parts."""
    contents_by_part = dict[str, tuple[list[tuple[int, list[float]]], list[tuple[str, int, list[int]]]]]()
    unread, part_name, instances = set[str](), "", dict[str, str]()
    set_cards = list[tuple[str, dict[str, str], _Rows]]()
    for keyword, options, rows in _cards(path, set()):
        nodes, elements = contents_by_part.setdefault(part_name, ([], []))
        if keyword in _GENERATED or (keyword == "NODE" and options.get("SYSTEM", "R").upper() != "R"):
            raise InputError(
                f"{path}: *{keyword} is not read: write nodes and elements out, in rectangular coordinates"
            )
        if keyword in ("PART", "END PART"):
            part_name = options.get("NAME", "").upper()
        elif keyword == "INSTANCE":
            instances[options.get("NAME", "").upper()] = options.get("PART", "").upper()
            if any(parse_real(x) for row in rows for x in row):
                logger.warning(
                    "%s: rotation and translation of an *INSTANCE is not applied: nodes lie as in their part", path
                )
        elif keyword == "NODE":
            nodes += [(parse_whole(n), [parse_real(x) for x in (*position, "", "", "")[:3]]) for n, *position in rows]
        elif keyword == "ELEMENT":
            shape, cells = _elements(options["TYPE"], rows)
            if shape is None:
                unread.add(f"type {options['TYPE'].upper()}")
            else:
                elements += [(shape, label, corners) for label, *corners in cells]
            if "ELSET" in options:
                set_cards.append((part_name, {"ELSET": options["ELSET"]}, [[str(label)] for label, *_ in cells]))
        elif keyword == "ELSET":
            set_cards.append((part_name, options, rows))
    parts_with_elements = {name: content for name, content in contents_by_part.items() if content[1]}
    if len(parts_with_elements) > 1:
        raise InputError(
            f"{path} has parts that number their nodes alike ({', '.join(parts_with_elements)}): write one of them"
        )
    if not parts_with_elements:
        raise InputError(f"{path} has no elements that are read: plane ones, shells, membranes or solids")
    ((part_name, (nodes, elements)),) = parts_with_elements.items()
    if len(names := [name for name, instance_part in instances.items() if instance_part == part_name]) > 1:
        raise InputError(f"{path} has the part {part_name} {len(names)} times ({', '.join(names)}): write one of them")
    labels = {label for _, label, _ in elements}
    sets = _Sets(labels)
    for scope, options, rows in set_cards:
        if scope in (part_name, "") and instances.get(options.get("INSTANCE", "").upper(), part_name) == part_name:
            sets.add(scope, options, rows)
    return MeshContent.from_labels(nodes, elements, sets.by_name(), unread)


class _Sets:
    """Element sets of a part and of the assembly, whose names may be written in upper or lower case."""

    def __init__(self, labels: set[int]) -> None:
        self._labels, self._members = labels, dict[tuple[str, str], set[int]]()
        self._spelling = dict[str, str]()

    def add(self, scope: str, options: dict[str, str], rows: _Rows) -> None:
        """Add the rows of an ``*ELSET`` of a part, or of the assembly ("")."""
        name = self._spelling.setdefault(options["ELSET"].upper(), options["ELSET"])
        members = self._members.setdefault((scope, name.upper()), set())
        for row in rows:
            if "GENERATE" in options:
                numbers = [parse_whole(text) for text in filter(None, row)]
                if not 2 <= len(numbers) <= 3 or min(numbers) < 1:
                    raise InputError(f"the set {name} is generated by first, last and step, from 1 on, not {numbers}")
                span = range(numbers[0], numbers[1] + 1, *numbers[2:])
                members.update(
                    self._labels.intersection(span)
                    if len(span) < len(self._labels)
                    else filter(span.__contains__, self._labels)
                )
                continue
            for member in filter(None, row):
                if not member.isdigit() and (scope, member.upper()) not in self._members:
                    raise InputError(f"the set {name} has {member}, a set that is not stated before")
                members.update([int(member)] if member.isdigit() else self._members[scope, member.upper()])

    def by_name(self) -> dict[str, list[int]]:
        """Labels by the name of their set, with that of the part where part and assembly have sets of one name."""
        names = [name for _, name in self._members]
        return {
            f"{scope or 'ASSEMBLY'}.{self._spelling[name]}" if names.count(name) > 1 else self._spelling[name]: [
                *members
            ]
            for (scope, name), members in self._members.items()
        }


def _elements(name: str, rows: _Rows) -> tuple[str | None, list[list[int]]]:
    """Return the shape of a type of elements, None of one that is not read, and the label and corners of each."""
    planar, size = match.groups() if (match := _ELEMENT.match(name)) else (None, "")
    if (shape := (_PLANAR if planar else _SOLIDS).get(size)) is None:
        return None, []
    width = 1 + (6 if size == "65" else int(size))
    numbers = [parse_whole(number) for row in rows for number in filter(None, row)]
    if len(numbers) % width:
        raise InputError(f"elements of type {name} have {width - 1} nodes")
    return shape, [numbers[i : i + 1 + CORNERS[shape]] for i in range(0, len(numbers), width)]


def _cards(path: Path, read_files: set[str]) -> Iterator[tuple[str, dict[str, str], _Rows]]:
    """Yield the keyword, options and rows of data of every card, in their order, with files that are included."""
    keyword, options, rows = "", _Options("", ()), _Rows()
    for line in (*_lines(path, read_files), "*"):
        entries = [entry.strip() for entry in line.split(",")]
        if not line.startswith("*"):
            rows.append(entries)
            continue
        if keyword == "INCLUDE":
            yield from _cards(path.parent / options["INPUT"], read_files)
        elif keyword:
            yield keyword, options, rows
        elif rows:
            raise InputError(f'{path} begins with "{rows[0][0][:40]}", which is no keyword')
        keyword = entries[0][1:].upper()
        options = _Options(keyword, entries[1:])
        if invalid := [key for key in options if key and not key[0].isalpha()]:
            raise InputError(
                f'the line of *{keyword} ends with a comma and goes on with "{invalid[0][:40]}", no option'
            )
        rows = []
        if keyword in ("NODE", "ELEMENT") and "INPUT" in options:
            rows = [[x.strip() for x in row.split(",")] for row in _lines(path.parent / options["INPUT"], read_files)]


def _lines(path: Path, read_files: set[str]) -> list[str]:
    """Return the lines of a file without blank ones and comments; a keyword's goes on after a comma at its end."""
    lines = list[str]()
    for line in map(str.strip, read_text(path, read_files).splitlines()):
        if not line or line.startswith("**"):
            continue
        if lines and lines[-1].startswith("*") and lines[-1].endswith(",") and not line.startswith("*"):
            lines[-1] += line
        else:
            lines.append(line)
    return lines
