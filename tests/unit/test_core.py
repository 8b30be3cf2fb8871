"""The core stands without the tools on it."""

from __future__ import annotations

import subprocess
import sys

CORE = ("frames", "mesh", "illumination", "weights", "correlation", "fields", "results", "pipeline", "settings")
TOOLS = ("typer", "rich", "bokeh", "matplotlib", *(f"rgbmidic.{room}" for room in ("scene", "lab", "report", "view")))


SLOW = ("scipy.signal", "scipy.stats", "scipy.optimize", "numba")
"""Packages that would double the time until a command begins."""


def test_the_core_is_imported_without_tools_and_slow_packages() -> None:
    rooms = ", ".join(f"rgbmidic.{room}" for room in CORE)
    code = f"import sys, {rooms}\nprint(*sorted(set({TOOLS + SLOW!r}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stdout.split()
