"""The command `rgbmidic-calibrate` as a user meets it: files in, a file out, one clear line on a mistake."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest
from calibration_scene import MATRICES, captures, expose, speckle_target, white_target
from tifffile import imread, imwrite

from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.calibration import Calibration
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
    rng = np.random.default_rng(2)
    picture = white_target((128, 160), rng)
    for level in (1000, 1700, 2800):
        (folder / f"flat_{level}").mkdir()
        for index in range(2):
            write_tiff(folder / f"flat_{level}" / f"{index}.tif", expose(level * picture, MATRIX[:, 1] + 0.4, rng))
    return folder


@pytest.fixture
def run(bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rgbmidic-calibrate", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        output = capsys.readouterr()
        return stop.value.code or 0, output.out, output.err

    return call


def test_crosstalk_writes_a_file_with_provenance(run, tmp_path):
    out = tmp_path / "calibration.json"
    code, output, _ = run("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", str(out))
    assert code == 0
    assert "condition number" in output
    calibration = Calibration.read(out)
    assert calibration.crosstalk.matrix == pytest.approx(MATRIX, abs=2e-3)
    assert (calibration.cfa, calibration.black_level, calibration.white_level) == ("RGGB", 64, 4095)
    assert abs(calibration.unevenness) < 0.01  # the captures use all grey levels
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


def test_levels_that_nobody_states_are_not_held_against_a_test(run, tmp_path):
    for options, levels in [(["--cfa", "RGGB"], (None, None)), (STATED[:4], (64, None))]:
        out = tmp_path / f"{len(options)}.json"
        assert run("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *options, "--out", str(out))[0] == 0
        reread = Calibration.read(out)
        assert (reread.kind, reread.black_level, reread.white_level) == ("bayer", *levels)


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
        (["--light", "red=light_red/*.tif", "--kind", "colour"], "--kind must be one of"),
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


@pytest.mark.usefixtures("blank_pictures")
def test_noise_then_merge_then_show(run, tmp_path):
    noise, matrix, merged = (str(tmp_path / f"{name}.json") for name in ("noise", "matrix", "merged"))
    code, output, _ = run("noise", "--dark", "dark/*.tif", "--flat", "flat_*/*.tif", *STATED, "--out", noise)
    assert code == 0
    assert "gain 1/K" in output
    assert Calibration.read(noise).noise.gain == pytest.approx(4, rel=0.05)
    assert run("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", matrix)[0] == 0
    code, output, _ = run("merge", noise, matrix, "--out", merged)
    assert code == 0
    assert "sections: crosstalk, noise" in output
    code, output, _ = run("show", merged, "--picture", str(tmp_path / "p.png"))
    assert code == 0
    assert "condition number" in output
    assert "dark noise, e-" in output
    assert (tmp_path / "p.png").is_file()
    assert run("show", merged, "--picture", str(tmp_path / "p.png"))[0] == 2


def test_noise_with_exposure_times(run, tmp_path):
    flats = [part for level in (1000, 1700, 2800) for part in ("--flat", f"{level}=flat_{level}")]
    out = str(tmp_path / "n.json")
    code, _, error = run("noise", "--dark", "dark/*.tif", *flats, *STATED, "--out", out)
    assert code == 0, error
    assert np.isfinite(Calibration.read(out).camera_noise.linearity_error.value).all()
    code, _, error = run("noise", "--dark", "dark/*.tif", "--flat", "long=flat_1000", *STATED, "--out", out + "2")
    assert code == 2
    assert "TIME=FILES" in error


def test_show_of_a_file_that_is_none(run, tmp_path):
    (tmp_path / "x.json").write_text("{}")
    code, _, error = run("show", str(tmp_path / "x.json"))
    assert code == 2
    assert "is not a calibration file" in error


def test_registration_of_speckled_captures(run, tmp_path):
    out = str(tmp_path / "r.json")
    code, output, error = run("registration", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", out)
    assert code == 0, error
    assert "Registration against red" in output
    reread = Calibration.read(out).registration
    assert np.abs(reread.parameters[:, :2]).max() < 0.05  # the bench's captures are registered
    code, _, error = run("registration", *LIGHTS, *STATED, "--out", out + "2", "--region", "here")
    assert code == 2
    assert "--region is X0,Y0,X1,Y1 in px" in error


def test_check_passes_on_held_back_captures_and_fails_on_a_wrong_matrix(run, bench, tmp_path):
    lights, dark = captures(
        MATRIX, np.random.default_rng(77), target=speckle_target, shape=(128, 160), count=2, darks=2
    )
    for name, frames in {**lights, "dark": dark}.items():
        (tmp_path / name).mkdir()
        for index, frame in enumerate(frames):
            write_tiff(tmp_path / name / f"{index}.tif", frame)
    good, bad = str(tmp_path / "good.json"), str(tmp_path / "bad.json")
    assert run("crosstalk", "--dark", "dark/*.tif", *LIGHTS, *STATED, "--out", good)[0] == 0
    held_back = ["--dark", str(tmp_path / "dark")]
    held_back += [part for name in lights for part in ("--light", f"{name}={tmp_path / name}")]
    code, output, error = run("check", good, *held_back)
    assert code == 0, error + output
    assert "PASSED" in output
    assert "noise was not checked" in output
    code, output, _ = run("check", good, "--dark", "dark/*.tif", *LIGHTS)
    assert "made the calibration" in " ".join(output.split())
    document = json.loads((tmp_path / "good.json").read_text())
    document["crosstalk"]["matrix"][1][0] += 0.02
    (tmp_path / "bad.json").write_text(json.dumps(document))
    code, output, _ = run("check", bad, *held_back)
    assert code == 1
    assert "FAILED" in output
    assert run("check", bad, *held_back, "--limit", "leakage=5")[0] == 0
    assert run("check", good, *held_back, "--together", "red+violet=dark")[0] == 2


@pytest.mark.usefixtures("blank_pictures")
def test_design_lists_the_best_set(run, tmp_path):
    rows = [f"{nm},{int(nm >= 600)},{int(500 <= nm < 600)},{int(nm < 500)}" for nm in range(400, 700, 10)]
    (tmp_path / "camera.csv").write_text("\n".join(["nm,R,G,B", *rows]))
    lamps = ["--light", "red=640:18", "--light", "green=540:30", "--light", "blue=460:20", "--light", "amber=600:18"]
    picture = str(tmp_path / "d.png")
    code, output, error = run("design", "--camera", str(tmp_path / "camera.csv"), *lamps, "--picture", picture)
    assert code == 0, error
    assert "red, green, blue" in output
    assert output.index("red, green, blue") < output.index("amber")
    assert (tmp_path / "d.png").is_file()
    code, output, error = run("design", "--camera", "Nikon 5100 (NPL)", *lamps[:2], *lamps[6:])
    assert code == 0, error
    costs = next(line for line in output.splitlines() if "noise amplification" in line)
    assert re.findall(r"\d+\.\d\d", costs) == ["5.79", "5.62"]
    code, _, error = run("design", "--camera", "no.json", *lamps)
    assert code == 2
    assert "not found" in error


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["crosstalk"], "Missing option '--light'"),
        (["crosstalks"], "No such command"),
        (["crosstalk", *LIGHTS, "--shape", "512"], "--shape is ROWSxCOLUMNS, such as 512x768, not '512'"),
    ],
)
def test_a_wrong_use_is_one_line_as_of_the_other_command(run, arguments, said):
    code, _, error = run(*arguments)
    assert (code, error.count("\n")) == (2, 1)
    assert error.startswith("error: ")
    assert said in error


def test_without_arguments_it_shows_its_help(run):
    code, output, _ = run()
    assert code == 0
    assert "crosstalk" in output


def test_a_camera_s_own_gain_on_blue_is_stated(run, bench, tmp_path):
    for source in sorted(bench.glob("light_*/*.tif")):
        values = imread(source)
        values[1::2, 1::2] = np.rint((values[1::2, 1::2] - 64.0) * 1.3 + 64)
        (tmp_path / source.parent.name).mkdir(exist_ok=True)
        imwrite(tmp_path / source.parent.name / source.name, values)
    lights = [part.replace("=light", f"={tmp_path}/light") for part in LIGHTS]
    code, _, error = run("crosstalk", "--dark", "dark/*.tif", *lights, *STATED, "--out", str(tmp_path / "own.json"))
    assert code == 0, error
    assert Calibration.read(tmp_path / "own.json").unevenness > 0.1
