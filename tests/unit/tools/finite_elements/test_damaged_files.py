"""Mesh files mutated at random: a sound mesh, or one line of ours that names the file.

``RGBMIDIC_MUTATIONS=500`` mutates the file of each format as often.
"""

from __future__ import annotations

import os
import re
import signal
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mutations import mutated

from rgbmidic import read_mesh
from rgbmidic.errors import InputError

meshio = pytest.importorskip("meshio")

COPIES = int(os.environ.get("RGBMIDIC_MUTATIONS", "60"))
NUMBERS = [b"nan", b"inf", b"-1", b"0", b"7", b"99", b"1e308", b"-0.5", b"1e999", b"9" * 30, b"9" * 5000, b"x", b"1_0"]
"""What a number in a text becomes."""
POINTS = np.array([[x, y, 0.0] for y in (0, 10, 20) for x in (0, 10, 20)])
CELLS = [("quad", [[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6]]), ("triangle", [[4, 5, 8], [4, 8, 7]])]
QUADS = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]])
AREA = 400.0
FORMATS: dict[str, dict[str, Any]] = {
    "a.inp": {},
    "text.msh": {"file_format": "gmsh22", "binary": False},
    "text_4.msh": {"file_format": "gmsh", "binary": False},
    "a.msh": {"file_format": "gmsh22"},
    "a_4.msh": {"file_format": "gmsh"},
    "a.bdf": {},
    "free.bdf": {},
    "text.vtu": {"binary": False},
    "plain.vtu": {"compression": None},
    "a.vtu": {},
    "lzma.vtu": {"compression": "lzma", "header_type": "UInt64"},
    "text.vtk": {"binary": False},
    "a.vtk": {},
    "old.vtk": {"file_format": "vtk42"},
    "text.xdmf": {"data_format": "XML"},
    "binary.xdmf": {"data_format": "Binary"},
    "a.xdmf": {},
    "a.h5": {},
    "a.mesh": {},
    "a.avs": {},
    "a.vol": {},
}


def write(folder: Path, name: str) -> Path:
    """A file of the mesh, and its path: of the format HDF the .xdmf is read."""
    path = folder / name.replace(".h5", ".xdmf")
    if name == "free.bdf":  # meshio fails to write it
        rows = [f"GRID,{n},,{x},{y}" for n, (x, y, _) in enumerate(POINTS, start=1)]
        rows += [f"CQUAD4,{n},1,{','.join(map(str, nodes + 1))}" for n, nodes in enumerate(QUADS, start=1)]
        path.write_text("\n".join(["BEGIN BULK", *rows, "ENDDATA\n"]))
        return path
    cells = [("quad", QUADS)] if "_4" in name else CELLS  # of gmsh's version 4 meshio writes one type
    data = {"point_data": {"U": POINTS * 1e-3}} if path.suffix in (".vtu", ".vtk", ".xdmf", ".avs") else {}
    meshio.write(path, meshio.Mesh(POINTS, cells, **data), **FORMATS[name])
    return path


def another_number(content: bytes, random: np.random.Generator) -> bytes:
    """A copy in which one number, whatever it means, is a strange one."""
    places = [found.span() for found in re.finditer(rb"(?<![\w.])[-+]?\d[\d.]*(?:[eE][-+]?\d+)?", content)]
    if not places:
        return content
    begin, end = places[random.integers(len(places))]
    return content[:begin] + NUMBERS[random.integers(len(NUMBERS))] + content[end:]


@pytest.mark.parametrize("name", FORMATS)
def test_a_mutated_mesh_is_sound_or_refused_in_one_line(
    tmp_path: Path, name: str, alarm: None, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the format Binary names its files as seen from here
    path, random, ends = write(tmp_path, name), np.random.default_rng(31), dict[str, str]()
    assert read_mesh(path).areas.sum() == pytest.approx(AREA)
    content = (tmp_path / name).read_bytes()
    capfd.readouterr()
    for number in range(COPIES):
        (tmp_path / name).write_bytes((mutated, another_number)[number % 2](content, random))
        signal.alarm(20)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                mesh = read_mesh(path)
        except InputError as error:
            ends["refused"] = message = str(error)
        except Exception as error:
            raise AssertionError(f"mutation {number}: {type(error).__name__}: {error}") from error
        else:
            ends["read"] = message = f"{path}"
            assert (mesh.areas > 0).all(), number
            assert len(np.unique(mesh.node_numbers)) == len(mesh.points), number
            assert mesh.overlap() is None, number
        assert str(path) in message, number
        assert len(message) < 700, number
    assert len(ends) == 2
    assert capfd.readouterr().err == ""
