"""The crops of real files in tests/data: few bytes, a licence each, and nothing but what the full files hold."""

import importlib.util
import shutil
from pathlib import Path

import pytest
from real_files import CROPS, real_folder

MOST = 6e6
"""bytes of all crops: what a clone should not exceed."""
GIVEN_ON = ("BSD-3-Clause", "MIT", "Apache-2.0", "BSL-1.0", "MPL-2.0", "free to use")
"""Licences that allow it."""


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_crops_are_few_and_say_where_they_come_from() -> None:
    folders = [folder for folder in CROPS.iterdir() if folder.is_dir() and folder.name != "__pycache__"]
    assert len(folders) > 10
    assert sum(len(content) for folder in folders for content in files(folder).values()) < MOST
    for folder in folders:
        assert any(licence in (folder / "SOURCE.txt").read_text() for licence in GIVEN_ON), folder.name
    assert all(f"=== {licence}" in (CROPS / "LICENCES.txt").read_text() for licence in GIVEN_ON[:5])


def test_crops_are_what_the_script_cuts_out_of_the_full_files(tmp_path: Path) -> None:
    full = real_folder("cine_mono_set").parent
    if full == CROPS or not (full / "independent_scenes").is_dir():
        pytest.skip("no shared data: the full files are not here")
    for name in ("make.py", "crops.toml"):
        shutil.copy(CROPS / name, tmp_path)
    spec = importlib.util.spec_from_file_location("make", tmp_path / "make.py")
    assert spec is not None
    make = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(make)  # type: ignore[union-attr]
    make.main(full)
    for folder in (folder for folder in tmp_path.iterdir() if folder.is_dir() and folder.name != "__pycache__"):
        made, kept = files(folder), files(CROPS / folder.name)
        assert made.keys() == kept.keys()
        as_stored = [name for name in made if not name.endswith((".tif", ".tiff", ".npz"))]  # not what zlib packs
        assert all(made[name] == kept[name] for name in as_stored), folder.name
