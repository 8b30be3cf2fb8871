"""The command `rgbmidic-calibrate` as a user meets it: files in, a file out, one clear line on a mistake."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from calibration_scene import MATRICES, captures, speckle_target

from rgbmidic.illumination.calibration import Calibration
from rgbmidic.sequence.writers import write_dng, write_tiff
from rgbmidic_calibration.cli import main

MATRIX = MATRICES[1.5]
STATED = ["--cfa", "RGGB", "--black-level", "64", "--white-level", "4095"]
LIGHTS = [part for name in ("red", "green", "blue") for part in ("--light", f"{name}=light_{name}/*.tif")]


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    lights, dark = captures(MATRIX, np.random.default_rng(1), target=speckle_target, shape=(128, 160), count=2, darks=2)
    for name, frames in {**{f"light_{n}": f for n, f in lights.items()}, "dark": dark}.items():
        (folder / name).mkdir()
        for index, frame in enumerate(frames):
            write_tiff(folder / name / f"{index}.tif", frame)
            write_dng(folder / name / f"{index}.dng", frame)
    return folder


@pytest.fixture
def run(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rgbmidic-calibrate", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        shown = capsys.readouterr()
        return stop.value.code or 0, shown.out, shown.err

    return call


def test_crosstalk_writes_a_file_with_provenance(run, tmp_path):
    out = tmp_path / "calibration.json"
    code, shown, _ = run("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", str(out))
    assert code == 0
    assert "condition number" in shown
    calibration = Calibration.read(out)
    assert calibration.crosstalk.matrix == pytest.approx(MATRIX, abs=2e-3)
    assert (calibration.cfa, calibration.black_level, calibration.white_level) == ("RGGB", 64, 4095)
    origin = json.loads(out.read_text())["provenance"]["crosstalk"]
    assert len(origin["inputs"]) == 8
    assert {len(entry["sha256"]) for entry in origin["inputs"]} == {64}
    assert origin["version"]
    assert origin["date"]


def test_files_that_tell_their_levels_need_no_statement(run, tmp_path):
    lights = [part.replace(".tif", ".dng") for part in LIGHTS]
    code, _, _ = run("crosstalk", "--dark", "dark/*.dng", *lights, "--out", str(tmp_path / "c.json"))
    assert code == 0
    assert Calibration.read(tmp_path / "c.json").cfa == "RGGB"


def test_an_existing_file_is_kept_unless_told_otherwise(run, tmp_path):
    out = tmp_path / "c.json"
    out.write_text("mine")
    arguments = ("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", str(out))
    code, _, error = run(*arguments)
    assert code == 2
    assert "exists already" in error
    assert out.read_text() == "mine"
    assert run(*arguments, "--overwrite")[0] == 0
    assert Calibration.read(out).crosstalk is not None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--light", "red"], "--light takes NAME=FILES"),
        (["--light", "red=light_red/*.tif", "--light", "red=light_blue/*.tif"], "--light red is given twice"),
        (["--light", "red=nothing/*.tif"], "light red: no frames: no file matches: nothing/*.tif"),
        (["--light", "red=light_red/*.tif", "--cfa", "RGBG"], "--cfa must be one of RGGB"),
        (["--light", "red=light_red/*.tif", "--kind", "colour"], "--kind is one of"),
        (["--light", "red=light_red/*.tif", "--shape", "big"], "--shape is ROWSxCOLUMNS"),
        (["--light", "red=light_green/*.tif", *STATED], "seen best by the green channel"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(run, tmp_path, arguments, message):
    code, _, error = run("crosstalk", *arguments, "--out", str(tmp_path / "c.json"))
    assert code == 2
    assert message in error
    assert "Traceback" not in error
    assert len(error.strip().splitlines()) == 1
    assert not any(tmp_path.iterdir())
