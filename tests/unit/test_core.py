"""The core stands without the tools on it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from rgbmidic.errors import ConfigurationError
from rgbmidic.extensions import LIGHT_WEIGHTS, MESH_SOURCES, PROBES, load_extension

CORE = ("frames", "mesh", "illumination", "weights", "correlation", "fields", "results", "pipeline", "settings")
TOOLS = {
    *("typer", "rich", "bokeh", "matplotlib"),
    *(f"rgbmidic.tools.{room}" for room in ("scene", "lab", "report", "view", "finite_elements", "stereo")),
}
SLOW = {"scipy.signal", "scipy.stats", "scipy.optimize", "numba", "llvmlite"}
"""Packages that would double the time until a command begins; a kernel imports numba with its first call."""
LACKS = {
    "rgbmidic": {"typer", "rich", "matplotlib", "colour"},
    ", ".join(f"rgbmidic.{room}" for room in CORE): TOOLS | SLOW,
    "rgbmidic.tools.scene.kernels": {"numba", "llvmlite"},
    "rgbmidic.tools.report": {"matplotlib", "numba"},
    "rgbmidic.cli.app, rgbmidic.pipeline.run": {"bokeh", "tornado"},
}
"""What is not imported with a part, nor with those before it."""


def test_no_part_imports_what_only_another_needs() -> None:
    steps = [f"import {part}; print(*{lacks!r} & sys.modules.keys(), sep=', ')" for part, lacks in LACKS.items()]
    code = "\n".join(["import sys", *steps])
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert dict(zip(LACKS, done.stdout.split("\n"), strict=False)) == dict.fromkeys(LACKS, "")


def test_what_a_tool_adds_is_found_and_what_is_missing_is_named() -> None:
    assert callable(load_extension(LIGHT_WEIGHTS, "geometry", "weights.method"))
    assert callable(load_extension(MESH_SOURCES, "finite_elements", "mesh.file").place)
    assert callable(load_extension(PROBES, "tip", "probes.tips"))
    with pytest.raises(
        ConfigurationError, match=r'mesh.file needs the tool that adds "finite_elements"; there are none'
    ):
        load_extension({}, "finite_elements", "mesh.file")


ROOT = Path(__file__).resolve().parents[2]


def test_opencv_opens_no_file_by_its_name() -> None:
    """On Windows it opens none whose name is not ASCII, and `imwrite` reports nothing."""
    opens = re.compile(r"cv2\.(imread|imwrite|imcount|haveImage|VideoCapture|VideoWriter|FileStorage)")
    files = [
        file
        for folder in ("rgbmidic", "calibration", "examples", "benchmarks")
        for file in (ROOT / folder).rglob("*.py")
    ]
    assert len(files) > 150
    assert not [str(file) for file in files if opens.search(file.read_text(encoding="utf-8"))]
