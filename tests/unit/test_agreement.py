"""What is stated twice must agree: the table of docs/reference/test-file.md, row by row and pair by pair."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_tests import SHAPE, SmallTest, colour_test, grey_frame

from rgbmidic import Calibration, CameraCalibration, Status, correlate, measure, read_frame, read_test
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import CalibrationError, FrameError
from rgbmidic.frames import open_series
from rgbmidic.frames.data import Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.frames.metadata import StoredFrame, raw_frame
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.pipeline import Plan
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.lab.inspection import inspect_files, state_frames
from rgbmidic_calibration import cli as calibrate

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "test-file.md"
LIGHTS = ("red", "green", "blue")
TABLE = PAGE.read_text(encoding="utf-8").partition("## What is stated twice")[2]
ROWS = {row[1]: row[2].split("; ") for row in re.finditer(r"^\| ([\w ]+) \| ([^|]+) \| error", TABLE, re.M)}
"""Who states what, by the table."""
CAMERA = {
    "kind": ("kind", "bayer", "rgb"),
    "Bayer pattern": ("cfa", "RGGB", "GRBG"),
    "black level": ("black_level", 64, 300),
    "white level": ("white_level", 4095, 65535),
    "frame size": ("shape", SHAPE, (100, 120)),
    "sample type": ("dtype", "uint16", "uint8"),
}
"""Rows of what `FrameSettings` has a field for: its name and two values, the first that of a DNG file."""


@dataclass
class Said:
    """A test on disk in which some say something, and nobody else anything that is not needed."""

    folder: Path
    dng: bool = False
    frames: dict[str, Any] = field(default_factory=dict)
    options: list[str] = field(default_factory=list)
    calibration: dict[str, Any] = field(default_factory=dict)

    def say(self, who: str, key: str, value: Any) -> None:
        """Have somebody say that `key` is `value`; a file's values are those of every DNG."""
        if who == "the file":
            self.dng = True
        elif who == "the calibration":
            self.calibration[key] = value
        elif who.startswith("`--"):
            text = "x".join(map(str, value)) if isinstance(value, tuple) else str(value)
            self.options += [who.strip("`"), text]
        else:
            assert who == f"`frames.{key}`"
            self.frames[key] = value

    def arguments(self, out: Path) -> list[str]:
        """Write it all, and give the command that reads it."""
        mosaic = Mosaic(
            values=np.random.default_rng(0).integers(500, 900, SHAPE), cfa="RGGB", black_level=64, white_level=4095
        )
        (write_dng if self.dng else write_tiff)(self.folder / ("frame.dng" if self.dng else "frame.tif"), mosaic)
        shape = self.calibration.get("shape")
        parts = {"crosstalk": Crosstalk.identity(LIGHTS), **self.calibration}
        if shape:  # what depends on the place
            parameters = [[0.0] * 5, [0, 0, 1e-3, 0, 0], [0.0] * 5]
            parts["registration"] = replace(Registration.identity(LIGHTS, shape), parameters=np.array(parameters))
        Calibration(**parts).write(self.folder / "calibration.json")
        keys = {"path": "frame.*", **({} if self.dng else {"cfa": "RGGB"}), **self.frames}
        text = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
        test = self.folder / "TEST.toml"
        test.write_text(
            f'[frames]\n{text}[calibration]\nfile = "calibration.json"\n[region]\nrectangle = [16, 16, 128, 128]\n'
        )
        if self.options:
            frame = next(self.folder.glob("frame.*"))
            return ["inspect", str(frame), "--test", str(test), "--out", str(out), *self.options]
        return ["run", str(test), "--out", str(out), "--no-figures"]


Case = Callable[[Path, Path], tuple[list[str], Sequence[str]]]
"""Given a folder and one for the result: the arguments of the command, and the words that its error names."""


def _about_the_camera(row: str, first: str, second: str) -> Case:
    def case(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
        key, value, other = CAMERA[row]
        said = Said(folder)
        said.say(first, key, value)
        said.say(second, key, other)
        return said.arguments(out), [_in_an_error(value), _in_an_error(other)]

    return case


def _in_an_error(value: Any) -> str:
    """A size as rows and columns, or as width x height of a calibration."""
    if isinstance(value, tuple):
        return rf"\({value[0]}, {value[1]}\)|{value[1]} x {value[0]} px|{value[1]} px|{list(value)}"
    return str(value)


def _colour(folder: Path) -> SmallTest:
    return colour_test(folder / "test", [(0.0, 0.0), (0.3, 0.1)])


def _changed(test: SmallTest, sections: str, out: Path) -> list[str]:
    file = test.folder / "TEST.toml"
    file.write_text(file.read_text() + sections)
    return ["run", str(file), "--out", str(out), "--no-figures"]


def _lights_in_succession(count: int, stated: str, calibrated: int) -> Case:
    def case(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
        for index in range(6):
            write_tiff(folder / f"frame_{index}.tif", grey_frame(index, (0, 0)))
        names = LIGHTS[:calibrated]
        Calibration(registration=Registration.identity(names, SHAPE)).write(folder / "calibration.json")
        (folder / "TEST.toml").write_text(
            f'[frames]\nkind = "monochrome"\n{stated}\n[calibration]\nfile = "calibration.json"\n'
            "[region]\nrectangle = [16, 16, 128, 128]\n"
        )
        return ["run", str(folder / "TEST.toml"), "--out", str(out)], [str(count), str(calibrated)]

    return case


def _lights_of_another_scene(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    lights = [f'[[lights]]\nname = "{name}"\nposition = [0, {y}, 900]\n' for y, name in enumerate("xyz")]
    (test.folder / "scene.toml").write_text(f"[camera]\nshape = {list(SHAPE)}\n" + "".join(lights))
    geometry = '[weights]\nmethod = "geometry"\ngeometry = "scene.toml"\n'
    return _changed(test, geometry, out), ["x, y, z", "red, green, blue"]


def _scene_of_another_size(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    (test.folder / "scene.toml").write_text("[camera]\nshape = [100, 120]\n")
    geometry = '[weights]\nmethod = "geometry"\ngeometry = "scene.toml"\n'
    return _changed(test, geometry, out), [r"\[100, 120\]", r"\[144, 144\]"]


def _mask_of_another_size(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    write_tiff(test.folder / "mask.tif", grey_frame(0, (0, 0), shape=(100, 120)))
    file = test.folder / "TEST.toml"
    file.write_text(re.sub("rectangle = .*", 'mask = "mask.tif"', file.read_text()))
    return _changed(test, "", out), [r"\(120, 100\)", r"\(144, 144\)"]


def _camera_of_another_size(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    CameraCalibration(shape=(100, 120), homography=np.diag([0.1, 0.1, 1])).write(test.folder / "camera.json")
    return _changed(test, '[scale]\ncamera = "camera.json"\n', out), [r"scale\.camera", "120 x 100 px", "144 x 144 px"]


def _camera_of_another_light(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    file = test.folder / "calibration.json"
    replace(Calibration.read(file), registration=Registration.identity(LIGHTS, SHAPE)).write(file)
    camera = CameraCalibration(shape=SHAPE, homography=np.diag([0.1, 0.1, 1]), details={"first_light": "green"})
    camera.write(test.folder / "camera.json")
    words = [r"scale\.camera", "light green", "light red, the first of calibration.file"]
    return _changed(test, '[scale]\ncamera = "camera.json"\n', out), words


def _two_scales(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    scale = '[scale]\ncamera = "camera.json"\nmm_per_pixel = 0.1\n'
    return _changed(_colour(folder), scale, out), [r"scale\.camera", r"scale\.mm_per_pixel"]


def _two_meshes(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    mesh = '[mesh]\nfile = "specimen.inp"\npoints = [[0, 0, 10, 10], [9, 0, 90, 10]]\nelement_size = 20\n'
    return _changed(_colour(folder), mesh, out), [r"mesh\.file", r"mesh\.element_size"]


def _another_test_than_the_result(folder: Path, out: Path) -> tuple[list[str], Sequence[str]]:
    test = _colour(folder)
    arguments = _changed(test, "", out)
    assert execute(cli.app, arguments) == 0
    return [*_changed(test, "[solver]\ntolerance = 0.25\n", out), "--resume"], [r"solver\.tolerance", "0.001", "0.25"]


CASES: Mapping[tuple[str, str, str], Case] = {
    (row, *pair): _about_the_camera(row, *pair) for row in CAMERA for pair in combinations(ROWS[row], 2)
} | {
    ("number of lights", "`frames.path`", "`frames.lights`"): _lights_in_succession(
        2, 'path = ["frame_[0-2].tif", "frame_[3-5].tif"]\nlights = 3', 3
    ),
    ("number of lights", "`frames.path`", "the calibration"): _lights_in_succession(
        2, 'path = ["frame_[0-2].tif", "frame_[3-5].tif"]', 3
    ),
    ("number of lights", "`frames.lights`", "the calibration"): _lights_in_succession(
        3, 'path = "frame_*.tif"\nlights = 3', 2
    ),
    ("names of the lights", "the calibration", "SCENE.toml"): _lights_of_another_scene,
    ("size of the mask", "the file", "`region.mask`"): _mask_of_another_size,
    ("size of the scene", "the file", "SCENE.toml"): _scene_of_another_size,
    ("size of lens and plane", "the file", "`scale.camera`"): _camera_of_another_size,
    ("first light", "the calibration", "`scale.camera`"): _camera_of_another_light,
    ("scale", "`scale.mm_per_pixel`", "`scale.camera`"): _two_scales,
    ("the mesh", "`mesh.file`", "`mesh.element_size`"): _two_meshes,
    ("the test", "the result", "`run --resume`"): _another_test_than_the_result,
}


def test_every_pair_of_the_table_is_walked_through() -> None:
    pairs = {(row, *pair) for row, sayers in ROWS.items() for pair in combinations(sayers, 2)}
    assert pairs == set(CASES)
    assert len(ROWS) == 16


@pytest.mark.parametrize("pair", CASES, ids=lambda pair: "-".join(pair).replace("`", ""))
def test_two_that_differ_are_one_line_that_names_both(
    pair: tuple[str, str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments, words = CASES[pair](tmp_path, out)
    before = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    capsys.readouterr()
    status = execute(cli.app, arguments)
    error = capsys.readouterr().err
    assert status == 2, error
    (line,) = (line for line in error.splitlines() if line.startswith("error"))
    for word in words:
        assert re.search(word, line), (word, line)
    assert {file: file.read_bytes() for file in out.rglob("*") if file.is_file()} == before
    assert out.exists() == bool(before)


@pytest.mark.parametrize("row", CAMERA)
@pytest.mark.parametrize("dng", [False, True])
def test_what_is_said_alike_is_no_contradiction(row: str, dng: bool, tmp_path: Path) -> None:
    key, value, _ = CAMERA[row]
    said = Said(tmp_path, dng=dng)
    for who in ROWS[row]:
        if who != "the file":
            said.say(who, key, value)
    said.arguments(tmp_path / "out")
    test = read_test(tmp_path / "TEST.toml")
    assert test.calibration.file is not None
    calibration = Calibration.read(test.calibration.file)
    stated = state_frames(test, **{key: f"{value}".lower() if key == "cfa" else value})
    (frame,) = open_series(stated, tmp_path, calibration).read(0)
    assert isinstance(frame, Mosaic)
    assert frame.cfa == "RGGB"


@pytest.mark.parametrize(
    ("told", "known", "agree"), [([64] * 4, 65, True), ([64] * 4, 62.9, False), ([60, 64, 64, 68], 64, True)]
)
def test_black_levels_differ_where_rounding_cannot_tell(told: list[float], known: float, agree: bool) -> None:
    black = np.array(told, dtype=float).reshape(2, 2)
    stored = StoredFrame(values=np.full((4, 4), 500, np.uint16), kind="bayer", cfa="RGGB", black_level=black)
    stated, camera = FrameSettings(path=("f",)), Calibration(cfa="RGGB", black_level=known)
    if agree:
        frame = raw_frame(stored, stated, Path("f.dng"), camera)
        np.testing.assert_array_equal(frame.black_level, black)  # the file's own are taken
    else:
        with pytest.raises(FrameError, match=rf"f\.dng states black_level 64, but the calibration states {known}"):
            raw_frame(stored, stated, Path("f.dng"), camera)


@pytest.mark.parametrize(
    ("parts", "kinds"),
    [
        ({}, ("bayer", "rgb", "monochrome")),
        ({"crosstalk": Crosstalk.identity(LIGHTS)}, ("bayer", "rgb")),
        ({"crosstalk": Crosstalk.identity(LIGHTS), "kind": "rgb"}, ("rgb",)),
        ({"crosstalk": Crosstalk.identity(("lamp",))}, ("monochrome",)),
        ({"cfa": "GRBG"}, ("bayer",)),
    ],
)
def test_a_calibration_is_of_the_kinds_that_its_content_leaves(
    parts: dict[str, Any], kinds: tuple[str, ...], tmp_path: Path
) -> None:
    made = Calibration(**parts)
    made.write(tmp_path / "c.json")
    assert made.kinds == Calibration.read(tmp_path / "c.json").kinds == kinds
    with pytest.raises(CalibrationError, match="two kinds"):
        replace(made, cfa="RGGB", kind="monochrome")


def test_a_later_frame_that_contradicts_the_calibration_fails_alone(tmp_path: Path) -> None:
    test = _colour(tmp_path)
    frame = read_frame(test.frames[1])
    assert isinstance(frame, Mosaic)
    write_dng(test.frames[1], replace(frame, white_level=3000))
    found = measure(test.settings(), tmp_path / "out")
    assert found.status.tolist() == [Status.CONVERGED, Status.FAILED]
    assert re.search(
        r"frame_1\.dng states white_level 3000, but .*calibration\.json states 4095", found.frame(1).reason
    )


def test_a_check_of_a_calibration_holds_captures_and_options_against_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    test = _colour(tmp_path)
    arguments = ["check", str(test.folder / "calibration.json"), "--light", f"red={test.frames[0]}"]
    frame = read_frame(test.frames[0])
    assert isinstance(frame, Mosaic)
    write_dng(test.frames[0], replace(frame, black_level=np.full((2, 2), 300.0)))
    for options, words in (
        ([], "states black_level 300.* states 64"),
        (["--black-level", "64"], "stated as 64.*states 300"),
    ):
        assert execute(calibrate.app, [*arguments, *options]) == 2
        assert re.search(words, capsys.readouterr().err)


def test_lights_in_succession_take_their_names_and_places_from_the_registration(tmp_path: Path) -> None:
    for index in range(2):
        write_tiff(tmp_path / f"{'ab'[index]}.tif", grey_frame(0, (0.5 * index, 0)))
    parameters = np.array([[0.0] * 5, [0.5, 0, 0, 0, 0]])
    registration = replace(Registration.identity(("near", "far"), SHAPE), parameters=parameters)
    Calibration(registration=registration).write(tmp_path / "c.json")
    (tmp_path / "TEST.toml").write_text(
        '[frames]\npath = ["a.tif", "b.tif"]\nkind = "monochrome"\n[calibration]\nfile = "c.json"\n'
        "[region]\nrectangle = [16, 16, 128, 128]\n"
    )
    settings = read_test(tmp_path / "TEST.toml")
    plan = Plan.from_settings(settings)
    assert plan.images.names == ("near", "far")
    inspection = inspect_files([tmp_path / "a.tif", tmp_path / "b.tif"], test=settings)
    assert tuple(light.name for light in inspection.lights) == ("near", "far")
    shown = [plan.reference.pixels.scatter(values, np.nan) for values in plan.reference.values]
    apart = correlate(*shown, region=(20, 20, 124, 124)).displacement
    assert np.sqrt((apart**2).mean()) < 0.02  # .5 px as they were recorded
