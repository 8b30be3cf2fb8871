"""VTK's unstructured grids in XML (``.vtu``): in text, in base64 or raw, packed or not; and labels that VTK files keep.

The layout is that of "VTK XML Formats" (docs.vtk.org). meshio's reader takes a node -1 for the last, only the last of
several pieces, and unpacks without a limit.
"""

from __future__ import annotations

import lzma
import zlib
from base64 import b64decode
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.tools.finite_elements.mesh_file import CORNERS, MAX_BYTES, MeshContent, limit_size, parse_whole
from rgbmidic.typing import AnyArray, IntArray

NUMBERS = ("GlobalNodeId", "node_number", "node_id", "NodeId", "GlobalElementId", "element_number", "element_id")
"""Names under which VTK files keep labels: ParaView's of both, this package's own, and those of converters."""
_SHAPES = {
    **dict.fromkeys((5, 22, 34), "triangle"),
    **dict.fromkeys((9, 23, 28, 30), "quad"),
    **{10: "tetra", 24: "tetra", 14: "pyramid", 27: "pyramid"},
    **dict.fromkeys((13, 26, 31, 32), "wedge"),
    **dict.fromkeys((12, 25, 29, 33), "hexahedron"),
}
"""Shapes of VTK's numbers of cell types (vtkCellType.h), linear and quadratic: their corners come first."""
_THIN = {1, 2, 3, 4, 21, 35}
"""Points and lines."""
_UNPACK: Mapping[str, Any] = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": partial(lzma.LZMADecompressor, memlimit=MAX_BYTES),
}


def read_vtu(path: Path) -> MeshContent:
    """Read the one piece of a file."""
    head, mark, tail = limit_size(path).read_bytes().partition(b"<AppendedData")
    encoding, _, appended = tail.partition(b"_")
    try:
        root = ElementTree.fromstring(head + b"</VTKFile>" if mark else head)
    except ElementTree.ParseError as error:
        raise InputError(f"it is no XML: {error}") from None
    arrays = _Arrays(root, appended, b"raw" in encoding)
    if len(pieces := root.findall("UnstructuredGrid/Piece")) != 1:
        raise InputError(f"it has {len(pieces)} pieces of an unstructured grid: write it as one")
    data: list[dict[str, AnyArray]] = [
        {item.get("Name", ""): arrays.read(item) for item in pieces[0].iterfind(f"{section}/DataArray")}
        for section in ("Points", "PointData", "Cells", "CellData")
    ]
    if len(data[0]) != 1 or not {"types", "offsets", "connectivity"} <= data[2].keys():
        raise InputError("it needs one array of points, and types, offsets and connectivity of cells")
    (points,), point_data, cells, cell_data = data[0].values(), *data[1:]
    types, ends, nodes = (cells[name].ravel() for name in ("types", "offsets", "connectivity"))
    n_points, n_cells = (parse_whole(pieces[0].get(f"NumberOf{name}", "")) for name in ("Points", "Cells"))
    if points.shape != (n_points, 3) or not len(types) == len(ends) == n_cells:
        raise InputError("its points and cells are not those that it announces")
    if not {ends.dtype.kind, nodes.dtype.kind} <= {"i", "u"}:
        raise InputError("its cells name their nodes by real numbers")
    width = np.diff(ends.astype(np.int64), prepend=0)
    if (width < 0).any() or width.sum() != len(nodes):
        raise InputError("the offsets of its cells are not those of its connectivity")
    numbers, labels, numbering = entity_labels(point_data, cell_data, (n_points, n_cells), 0)
    blocks, unread = [], set[str]()
    for kind in dict.fromkeys(types.tolist()):
        cell_indices = np.flatnonzero(types == kind)
        if (shape := _SHAPES.get(kind)) is None:
            unread |= set() if kind in _THIN else {f"type {kind}"}
            continue
        if (width[cell_indices] < CORNERS[shape]).any():
            raise InputError(f"a {shape} has fewer nodes than corners")
        first = (ends[cell_indices].astype(np.int64) - width[cell_indices])[:, None]
        blocks.append((shape, nodes[first + np.arange(CORNERS[shape])].astype(np.int64), labels[cell_indices]))
    return MeshContent(
        points=points.astype(np.float64),
        numbers=numbers,
        blocks=blocks,
        sets={},
        fields={key: x.astype(np.float64) for key, x in point_data.items() if key not in NUMBERS},
        numbering=numbering,
        unread=unread,
    )


def entity_labels(
    point_data: Mapping[str, Any], cell_data: Mapping[str, Any], counts: tuple[int, int], first: int
) -> tuple[IntArray, IntArray, str]:
    """Return the labels of points and cells among their data, else counted from `first`, and where they are from."""
    numbers, labels = (np.arange(first, first + count) for count in counts)
    numbering = f"counted from {first} in the order of the file, which has no labels that can be read"
    for name in NUMBERS:
        if name in point_data:
            numbers, numbering = _as_labels(name, point_data[name], counts[0]), f'point data "{name}"'
        if name in cell_data:
            labels = _as_labels(name, cell_data[name], counts[1])
    return numbers, labels, numbering


def _as_labels(name: str, values: Any, count: int) -> IntArray:
    """Return the labels, of which some converters make real numbers."""
    numbers = np.asarray(values, dtype=np.float64).ravel()
    if len(numbers) != count or not (np.abs(numbers) < 2**53).all() or (numbers % 1 != 0).any():
        raise InputError(f'the numbers "{name}" are not {count} whole ones')
    return numbers.astype(np.int64)


class _Arrays:
    """Reads the arrays of a file, as its root element states and with what is appended to it."""

    def __init__(self, root: ElementTree.Element, appended: bytes, raw: bool) -> None:
        self._order: Literal["<", ">"] = ">" if root.get("byte_order") == "BigEndian" else "<"
        self._header = np.dtype(root.get("header_type", "UInt32").lower()).newbyteorder(self._order)
        self._packing, self._appended, self._raw = root.get("compressor"), appended, raw
        if self._packing not in (None, *_UNPACK):
            raise InputError(f"it is packed by {self._packing}; {' and '.join(_UNPACK)} are read")

    def read(self, item: ElementTree.Element) -> AnyArray:
        """Return the values of an array, (n,) or (n, components)."""
        try:
            return self._values(item)
        except (ValueError, TypeError, OverflowError, zlib.error, lzma.LZMAError) as error:
            raise InputError(f'its array "{item.get("Name", "")}" is not what it announces: {error}') from None

    def _values(self, item: ElementTree.Element) -> AnyArray:
        kind = np.dtype(item.get("type", "").lower()).newbyteorder(self._order)
        form, text = item.get("format", "ascii"), (item.text or "").strip()
        if form == "ascii":
            values = np.array(text.split(), dtype=kind)
        elif form == "binary":
            values = np.frombuffer(self._bytes(text.encode(), raw=False), kind)
        else:
            values = np.frombuffer(self._bytes(self._appended[int(item.get("offset", "")) :], raw=self._raw), kind)
        width = int(item.get("NumberOfComponents") or 1)
        return values if width == 1 else values.reshape(-1, width)

    def _bytes(self, stream: bytes, raw: bool) -> bytes:
        """Content at the beginning of a stream, which is preceded by its size, or by the sizes of its packed blocks."""

        def take(offset: int, size: int) -> tuple[bytes, int]:
            end = offset + (size if raw else -(-size // 3) * 4)
            content = stream[offset:end] if raw else b64decode(stream[offset:end])[:size]
            if len(content) < size:
                raise EOFError
            return content, end

        header_size = self._header.itemsize
        first, offset = take(0, header_size)
        count = int(np.frombuffer(first, self._header)[0])
        if self._packing is None:  # in base64 the size is a stream of its own, or of one with the content
            return (
                take(offset, count)[0]
                if raw or stream[offset - 1 : offset] == b"="
                else take(0, header_size + count)[0][header_size:]
            )
        sizes, offset = take(0, header_size * (3 + count))
        _, largest, _, *lengths = np.frombuffer(sizes, self._header).tolist()
        if count * largest > MAX_BYTES:
            raise InputError(f"an array has {count * largest} bytes; up to {MAX_BYTES} are read")
        packed, _ = take(offset, sum(lengths))
        blocks, start = [], 0
        for length in lengths:
            unpacking = _UNPACK[self._packing]()
            blocks.append(unpacking.decompress(packed[start : start + length], largest + 1))
            start += length
            if not unpacking.eof or len(blocks[-1]) > largest:
                raise InputError("a packed block is cut, or larger than it states")
        return b"".join(blocks)
