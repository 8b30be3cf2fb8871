"""Where the real files of the tests lie: the full ones where this machine has them, else their crops in tests/data."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest

RealData = Callable[..., Path]
"""Type of the fixture `real_data`: from the name of a folder, and of a file it must hold, to the folder."""

CROPS = Path(__file__).parent / "data"


def real_folder(name: str, file: str = "") -> Path:
    """The folder `name` of RGBMIDIC_SHARED_DATA (else ../shared/data), or of tests/data.

    A test is skipped whose folder, or `file` of it, is in neither.
    """
    full = full_folder(name)
    for folder in (full, CROPS / name):
        if folder.is_dir() and (folder / file).exists():
            return folder
    pytest.skip(f"no shared data at {full / file}; its licence or size keeps it out of tests/data")


def full_folder(name: str) -> Path:
    """Where the full files of a folder lie, if they are on this machine."""
    stated = os.environ.get("RGBMIDIC_SHARED_DATA")
    return (Path(stated) if stated else Path(__file__).resolve().parents[2] / "shared" / "data") / name


def corner(folder: Path) -> tuple[int, int]:
    """Left and top of a folder's images in the full ones, px."""
    left, top = _cut(folder).get("window", (0, 0))[:2]
    return left, top


def count(folder: Path, full: int) -> int:
    """Frames of a folder's movies, whose full ones have `full`."""
    return int(_cut(folder).get("frames", full))


def _cut(folder: Path) -> dict:
    return tomllib.loads((CROPS / "crops.toml").read_text())[folder.name] if folder.parent == CROPS else {}
