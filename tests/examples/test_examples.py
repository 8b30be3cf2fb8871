"""Every example runs, and the number it ends in keeps its limit."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
LIMITS = {
    "bayer_pair.py": ("rms error", 0.015),
    "camera_library.py": ("error", 1.0),
    "demosaicing.py": ("ratio", 1.0),
    "live_loop.py": ("ratio", 0.15),
    "nodemaps.py": ("largest error", 20.0),
    "own_masks.py": ("ratio", 0.1),
    "own_separation.py": ("rms error", 0.03),
    "plain_dic.py": ("rms error", 0.002),
    "postprocessing.py": ("largest error", 20.0),
    "two_lights.py": ("ratio", 0.4),
}
"""What the last line says, and the largest number it may end in."""


def test_every_example_has_its_limit():
    assert {path.name for path in EXAMPLES.glob("*.py")} == set(LIMITS)


@pytest.mark.parametrize("name", LIMITS)
def test_the_last_number_keeps_its_limit(name, capsys):
    if name == "postprocessing.py":
        pytest.importorskip("xarray")
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    what, limit = LIMITS[name]
    label, _, rest = capsys.readouterr().out.strip().splitlines()[-1].partition(": ")
    assert label == what
    assert 0 < float(rest.split()[0]) <= limit
