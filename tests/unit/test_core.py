"""The core stands without the tools on it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

CORE = ("frames", "mesh", "illumination", "weights", "correlation", "fields", "results", "pipeline", "settings")
TOOLS = (
    "typer",
    "rich",
    "bokeh",
    "matplotlib",
    *(f"rgbmidic.{room}" for room in ("scene", "lab", "report", "view", "tools")),
)


SLOW = ("scipy.signal", "scipy.stats", "scipy.optimize", "numba")
"""Packages that would double the time until a command begins."""


def test_the_core_is_imported_without_tools_and_slow_packages() -> None:
    rooms = ", ".join(f"rgbmidic.{room}" for room in CORE)
    code = f"import sys, {rooms}\nprint(*sorted(set({TOOLS + SLOW!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stdout.split()


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
