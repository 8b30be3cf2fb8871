"""Mesh files that meshio reads, the labels that it leaves out, and limits that it lacks."""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Collection
from contextlib import redirect_stderr
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import InputError, RgbmidicError, import_optional
from rgbmidic.tools.finite_elements.mesh_file import CORNERS, MAX_BYTES, MeshContent, limit_size, require_unique
from rgbmidic.tools.finite_elements.vtu import NUMBERS, entity_labels
from rgbmidic.typing import IntArray

logger = logging.getLogger(__name__)

FORMATS = {".vtk": "vtk", ".xdmf": "xdmf", ".mesh": "medit", ".avs": "avsucd", ".vol": "netgen"}
"""Formats by the files' endings: those of meshio's that were tried with numpy 2 (med and cgns fail, some never end)."""


def read_with_meshio(path: Path, kind: str) -> MeshContent:
    """Read a file of one of meshio's formats, and the labels that it leaves out."""
    try:
        return _read(path, kind)
    except RgbmidicError:
        raise
    except Exception as error:  # text that is no mesh may raise any in meshio's readers
        reason = f"{type(error).__name__} {' '.join(str(error).split())}".strip()
        raise InputError(f"{path} is not a readable mesh: meshio ends with {reason[:120]}") from None


def _read(path: Path, kind: str) -> MeshContent:
    reader = import_optional(f"meshio.{kind}", "fe")
    messages = io.StringIO()
    _check_limits(path, kind)
    with warnings.catch_warnings(), redirect_stderr(messages):
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", "string or file could not be read to its end")
        mesh = reader.read(str(path))
    if messages.getvalue():
        logger.warning("%s: %s", path, " ".join(messages.getvalue().split()))
    points = np.zeros((len(mesh.points), 3))
    points[:, : np.shape(mesh.points)[1]] = mesh.points
    cells = [(re.sub(r"\d+$", "", block.type), np.asarray(block.data)) for block in mesh.cells]
    ends = np.cumsum([len(nodes) for _, nodes in cells])
    numbers, labels, numbering = _labels(path, kind, mesh, len(points), int(ends[-1]) if len(ends) else 0)
    by_block = np.split(labels, ends[:-1])
    sets: dict[str, Collection[int]] = {}
    for name, members in mesh.cell_sets.items():
        member_labels = [
            block_labels[np.isin(np.arange(len(block_labels)), m)]
            for block_labels, m in zip(by_block, members, strict=False)
        ]
        sets[name] = np.concatenate(member_labels)
    for key in {"medit:ref", "cell_tags"} & set(mesh.cell_data):
        values = np.concatenate(mesh.cell_data[key])
        for tag in np.unique(values):
            sets.setdefault(str(int(tag)), labels[values == tag])
    if invalid := [nodes.dtype for _, nodes in cells if nodes.dtype.kind not in "iu"]:
        raise InputError(f"{path}: elements name their nodes by whole numbers, not by {invalid[0]}")
    return MeshContent(
        points=points,
        numbers=numbers,
        blocks=[
            (shape, nodes.astype(np.int64), block_labels)
            for (shape, nodes), block_labels in zip(cells, by_block, strict=True)
            if shape in CORNERS
        ],
        sets=sets,
        fields={key: np.asarray(x, dtype=np.float64) for key, x in mesh.point_data.items() if key not in NUMBERS},
        numbering=numbering,
        unread={f"type {shape}" for shape, _ in cells} - {f"type {shape}" for shape in (*CORNERS, "line", "vertex")},
    )


def _labels(path: Path, kind: str, mesh: Any, nodes: int, cells: int) -> tuple[IntArray, IntArray, str]:
    """Return the labels of points and cells, and where they are from."""
    if kind == "avsucd":
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        rows = [line.split()[0] for line in lines if line.strip() and not line.startswith("#")][1 : 1 + nodes + cells]
        numbers, labels = np.split(np.array(list(map(int, rows)), dtype=np.int64), [nodes])
        require_unique("element", labels)
        return numbers, labels, "labels of the file"
    cell_data = {name: np.concatenate(values) for name, values in mesh.cell_data.items()}
    return entity_labels(mesh.point_data, cell_data, (nodes, cells), 0 if kind in ("vtk", "xdmf") else 1)


def _check_limits(path: Path, kind: str) -> None:
    """Refuse what meshio would read for ever, without a limit, or only in part and without a word."""
    content = limit_size(path).read_bytes()
    if kind in ("medit", "netgen"):
        counts = re.findall(rb"^[ \t]*(\d+)[ \t\r]*$", content, flags=re.MULTILINE)
        if large := [count for count in counts if int(count) > len(content)]:
            raise InputError(f"{path} states {int(large[0])} rows, more than it has bytes")
    if kind == "xdmf":
        from h5py import File

        for item in ElementTree.fromstring(content).iter("DataItem"):
            text = (item.text or "").strip()
            if item.get("Format") == "Binary":
                limit_size(Path(text))
            elif item.get("Format") == "HDF":
                file, _, name = text.partition(":")
                with File(limit_size(path.resolve().parent / file)) as data:
                    if data[name].nbytes > MAX_BYTES:
                        raise InputError(f"{path}: {text} has {data[name].nbytes} bytes; up to {MAX_BYTES} are read")
