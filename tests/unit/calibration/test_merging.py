"""One file out of several; a picture of it; damaged files refused."""

from __future__ import annotations

import json

import numpy as np
import pytest

from rgbmidic.errors import CalibrationError, ConfigurationError, InputError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import CameraNoise, Quantity
from rgbmidic_calibration.jobs import merge_files
from rgbmidic_calibration.pictures import draw_calibration

LIGHTS = ("red", "green", "blue")
CAMERA = {"cfa": "RGGB", "black_level": 64.0, "white_level": 4095.0, "shape": (100, 120)}


def crosstalk(entry=0.1):
    field = CrosstalkField(order=1, coefficients=np.full((2, 3, 3), 0.01), shape=(100, 120))
    return Crosstalk(
        matrix=np.eye(3) + entry * (1 - np.eye(3)), lights=LIGHTS, covariance=1e-8 * np.eye(9), field=field
    )


def camera_noise():
    four = Quantity(np.full(4, 4.0), np.full(4, 0.1))
    names = ("gain", "read_noise", "black_level", "saturation", "linearity_error", "dsnu")
    figures = dict.fromkeys(names, four)
    return CameraNoise(
        planes=("R", "G1", "G2", "B"), prnu=Quantity([np.nan] * 4, [np.nan] * 4), defects=((3, 4, "hot"),), **figures
    )


def registration(lights=LIGHTS):
    parameters = np.array([[0] * 5, [0.1, -0.2, 1e-4, 2e-4, 3e-5], [0.3, 0, 0, 1e-4, 0]])
    return Registration(lights=lights, parameters=parameters, centre=(59.5, 49.5), radius=78.1)


@pytest.fixture
def files(tmp_path):
    sections = {"crosstalk": crosstalk(), "camera_noise": camera_noise(), "registration": registration()}
    for name, section in sections.items():
        uneven = {"crosstalk": 0.01, "camera_noise": 0.02}.get(name)
        Calibration(**{name: section}, **CAMERA, unevenness=uneven, provenance={name: {"date": "today"}}).write(
            tmp_path / f"{name}.json"
        )
    return [tmp_path / f"{name}.json" for name in sections]


def test_merged_file_has_every_section(files, tmp_path):
    merge_files(files).write(tmp_path / "all.json")
    merged = Calibration.read(tmp_path / "all.json")
    assert merged.crosstalk.matrix == pytest.approx(crosstalk().matrix)
    assert merged.crosstalk.field.coefficients.shape == (2, 3, 3)
    assert merged.camera_noise.defects == ((3, 4, "hot"),)
    assert merged.noise.gain == 4.0
    assert merged.unevenness == 0.02
    assert merged.registration.parameters == pytest.approx(registration().parameters)
    assert set(merged.provenance) == {"crosstalk", "camera_noise", "registration"}
    assert (merged.cfa, merged.shape) == ("RGGB", (100, 120))


def test_contradicting_files_are_refused(files, tmp_path):
    other = tmp_path / "other.json"
    Calibration(crosstalk=crosstalk(0.2), **CAMERA).write(other)
    with pytest.raises(CalibrationError, match=r"other.json differ in crosstalk"):
        merge_files([*files, other])
    Calibration(**{**CAMERA, "cfa": "BGGR"}).write(other)
    with pytest.raises(CalibrationError, match="differ in cfa"):
        merge_files([*files, other])
    Calibration(registration=registration(("blue", "green", "red")), **CAMERA).write(other)
    with pytest.raises(CalibrationError, match="of different lights"):
        merge_files([files[0], other])
    with pytest.raises(ConfigurationError, match="at least two"):
        merge_files(files[:1])


def test_the_same_file_twice_is_no_contradiction(files):
    assert merge_files([files[1], files[1]]).noise.gain == 4.0


def test_picture_of_every_section(files, tmp_path):
    draw_calibration(merge_files(files), tmp_path / "all.png")
    assert (tmp_path / "all.png").stat().st_size > 10_000
    with pytest.raises(InputError, match="cannot be written"):
        draw_calibration(merge_files(files), tmp_path / "all.unknown")
    with pytest.raises(CalibrationError, match="nothing to draw"):
        draw_calibration(Calibration(), tmp_path / "none.png")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(schema_version=0), "schema version 0"),
        (lambda d: d.pop("schema"), "is not a calibration file"),
        (lambda d: d["crosstalk"].pop("matrix"), "crosstalk.matrix is missing"),
        (lambda d: d["crosstalk"].update(matrix=[[1, 0], [0]]), "damaged"),
        (lambda d: d["crosstalk"].update(covariance=[[1]]), "covariance of the crosstalk matrix must be 9 x 9"),
        (lambda d: d["crosstalk"]["field"].update(order=3), "order 3 needs 9"),
        (lambda d: d["crosstalk"].update(matrix=[[1, 1, 1]] * 3), "cannot be inverted"),
        (lambda d: d["noise"].update(gain=-1), "noise.gain must be above 0, not -1"),
        (lambda d: d["noise"]["planes"].pop("dsnu"), "planes.dsnu is missing"),
        (lambda d: d["noise"]["planes"]["gain"].update(value=[1, 2]), "a figure per plane"),
        (lambda d: d["registration"].update(parameters=[[1, 2]]), "5 finite parameters"),
        (lambda d: d["registration"].update(radius=0), "radius of a registration must be positive, in px, not 0"),
        (lambda d: d["camera"].update(cfa="XYZ"), "camera.cfa"),
        (lambda d: d["camera"].update(black_level="64"), "camera.black_level must be a number"),
        (lambda d: d.update(camera=[]), "damaged"),
    ],
)
def test_damaged_file_is_refused_with_the_reason(files, tmp_path, damage, message):
    document = merge_files(files).to_document()
    damage(document)
    (tmp_path / "bad.json").write_text(json.dumps(document))
    with pytest.raises(CalibrationError, match=message) as caught:
        Calibration.read(tmp_path / "bad.json")
    assert "bad.json" in str(caught.value)


def test_cut_off_file_is_refused(files, tmp_path):
    text = files[0].read_text()
    (tmp_path / "cut.json").write_text(text[: len(text) // 2])
    with pytest.raises(CalibrationError, match=r"cut.json is not a readable calibration file"):
        Calibration.read(tmp_path / "cut.json")
    with pytest.raises(CalibrationError, match="not found"):
        Calibration.read(tmp_path / "absent.json")


def test_a_calibration_that_cannot_be_written_leaves_nothing(files, tmp_path):
    (tmp_path / "taken").mkdir()
    with pytest.raises(CalibrationError, match="taken cannot be written"):
        merge_files(files).write(tmp_path / "taken")
    assert not list(tmp_path.glob("*.part"))
