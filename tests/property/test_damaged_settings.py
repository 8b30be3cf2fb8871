"""Calibration files, TEST.toml and SCENE.toml that are damaged: an error of ours, or an object that works."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbmidic.errors import RgbmidicError
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.images import Registration, frame_geometry
from rgbmidic.illumination.linear import CameraNoise, Quantity
from rgbmidic.settings import TestSettings, read_test
from rgbmidic.tools.scene.scene import read_scene

COPIES = 1000
"""Damaged copies of each file and way of damage."""
STRANGE: list[Any] = [
    None,
    True,
    -1,
    0,
    2,
    1e308,
    -0.5,
    float("nan"),
    float("inf"),
    10**400,
    "",
    "x" * 500,
    "\0",
    "RGGB",
]
STRANGE += [[], [[]], [1, 2], [[1, 2], [3]], {}, [{}], {"a": 1}]
"""Values that a key is given."""
PIECES = [
    b"\0",
    b"[" * 3000,
    b'{"a":' * 3000,
    b"{a=" * 3000,
    b'"',
    b"\n",
    b"=",
    b"1e999",
    b"-",
    b"\xff\xfe",
    b"[[",
    b"]",
]
PIECES += [b"nan", b"9" * 5000, b"#", b",", b"'''", b"\\u0000", b"a.b.c = 1\n"]
"""Bytes that get into a file."""
LIGHTS = ("red", "green", "blue")
SCENES = Path(__file__).resolve().parents[2] / "examples" / "scenes"
TEST = """
[frames]
path = "frames/*.dng"
kind = "bayer"
cfa = "RGGB"
black_level = 64.0
reference = [0, 1]
[calibration]
file = "calibration.json"
[region]
polygon = [[10, 10], [200, 12], [90.5, 180]]
[mesh]
element_size = 25
[illumination]
demosaic = "auto"
normalise = 10.0
[weights]
method = "threshold"
threshold = "auto"
[solver]
rigid = "translation"
[scale]
mm_per_pixel = 0.05
"""


def calibration_text(folder: Path) -> str:
    """A calibration file with every section."""
    shape, numbers = (120, 160), np.random.default_rng(0)
    centre, radius = frame_geometry(shape)
    figures = ("gain", "read_noise", "black_level", "saturation", "linearity_error", "dsnu", "prnu")
    calibration = Calibration(
        crosstalk=Crosstalk(
            matrix=0.9 * np.eye(3) + 0.1,
            lights=LIGHTS,
            covariance=1e-8 * np.eye(9),
            field=CrosstalkField(order=1, coefficients=0.01 * numbers.normal(size=(2, 3, 3)), shape=shape),
        ),
        camera_noise=CameraNoise(
            planes=("R", "G1", "G2", "B"),
            defects=((3, 4, "hot"),),
            **{name: Quantity(numbers.uniform(1, 2, 4), np.full(4, 0.01)) for name in figures},
        ),
        registration=Registration(lights=LIGHTS, parameters=np.zeros((3, 5)), centre=centre, radius=radius),
        cfa="RGGB",
        black_level=64.0,
        white_level=4095.0,
        shape=shape,
        provenance={"crosstalk": {"date": "today"}},
    )
    calibration.write(folder / "sound.json")
    return (folder / "sound.json").read_text(encoding="utf-8")


def cut_up(content: bytes, random: np.random.Generator) -> bytes:
    """Bytes changed, lost, put in or said twice in up to three places."""
    damaged = bytearray(content)
    for _ in range(random.integers(1, 4)):
        at, length = int(random.integers(len(damaged) + 1)), int(random.integers(1, 40))
        match random.integers(5):
            case 0:
                damaged[at : at + 1] = bytes([random.integers(256)])
            case 1:
                del damaged[at : at + length]
            case 2:
                damaged[at:at] = PIECES[random.integers(len(PIECES))]
            case 3:
                damaged[at:at] = damaged[at : at + length]
            case _:
                del damaged[at:]
    return bytes(damaged)


def another_value(document: Any, random: np.random.Generator) -> Any:
    """A document in which one value, wherever it stands, is a strange one or missing."""
    damaged = copy.deepcopy(document)
    place: Any = damaged
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = keys[random.integers(len(keys))]
        if not (isinstance(place[key], dict | list) and place[key] and random.random() < 0.8):
            break
        place = place[key]
    if random.random() < 0.1:
        del place[key]
    else:
        place[key] = copy.deepcopy(STRANGE[random.integers(len(STRANGE))])
    return damaged


def works_as_calibration(path: Path) -> None:
    calibration = Calibration.read(path)
    json.dumps(calibration.to_document(), allow_nan=False)
    points = np.array([[0.0, 0.0], [50.0, 20.0]])
    if calibration.crosstalk is not None:
        assert np.isfinite(calibration.crosstalk.unmixing_at(points)).all()
    if calibration.registration is not None:
        assert np.isfinite(calibration.registration.displacement(points)).all()
    if calibration.noise is not None:
        assert np.isfinite(calibration.noise.variance(np.array([0.0, 1000.0]))).all()


def works_as_test(path: Path) -> None:
    settings = read_test(path)
    assert TestSettings.from_mapping(settings.to_mapping(), settings.base) == settings


def survives(read: Callable[[Path], object], path: Path, content: bytes) -> None:
    path.write_bytes(content)
    said = str(path)
    try:
        read(path)
    except RgbmidicError as error:
        said = str(error)
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}; the file: {content[:3000]!r}") from error
    assert str(path) in said


READERS = {
    "calibration": works_as_calibration,
    "test": works_as_test,
    "sphere": read_scene,
    "plate_in_tension": read_scene,
}


@pytest.mark.parametrize("name", READERS)
def test_a_file_cut_up_is_refused_or_read(name, tmp_path):
    texts = {"calibration": calibration_text(tmp_path), "test": TEST}
    text = texts.get(name) or (SCENES / f"{name}.toml").read_text(encoding="utf-8")
    random = np.random.default_rng(19)
    for _ in range(COPIES):
        survives(READERS[name], tmp_path / name, cut_up(text.encode(), random))


def test_a_calibration_with_a_strange_value_is_refused_or_read(tmp_path):
    document, random = json.loads(calibration_text(tmp_path)), np.random.default_rng(20)
    for _ in range(COPIES):
        content = json.dumps(another_value(document, random)).encode()
        survives(works_as_calibration, tmp_path / "calibration.json", content)


@pytest.mark.parametrize("read", [Calibration.read, read_test, read_scene])
@pytest.mark.parametrize("piece", [b"[", b'{"a":', b"a = [", b"a = {b = ", b"[a.", b"[[a"])
def test_deep_nesting_is_refused(read, piece, tmp_path):
    survives(read, tmp_path / "deep", piece + piece.lstrip(b"a =") * 200_000)
