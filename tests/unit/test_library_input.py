"""What the library refuses: wrong shapes, types and extremes of arguments are one line each, never a foreign error."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from results import make_result, smooth_record

import rgbmidic
from rgbmidic import Calibration, CameraCalibration, FiniteElementMesh, Placement, Region, Tri3Mesh, fields
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.frames import Mosaic, list_frames, write_dng
from rgbmidic.illumination import linearise
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import Quantity
from rgbmidic.settings import ProbeSettings
from rgbmidic.tools.lab.inspection import inspect_frame
from rgbmidic.tools.scene.camera import rotation
from rgbmidic.tools.scene.scene import State
from rgbmidic.tools.scene.spectra import Sensitivities
from rgbmidic.tools.scene.surface import AffineField, MeshField, Surface, height_map
from rgbmidic.typing import as_numbers

STRANGE: list[Any] = [
    "x", b"ab", np.nan, np.inf, -1, 1e300, 10**30, [], [[]], [None, 1], ["a", 1], [np.nan] * 4, [1e300] * 4,
    [0, 0, 10**30, 1], np.zeros(0), np.zeros((3, 0, 2)), np.array(["a", "b"]), np.array([1j, 2]),
    np.full((4, 2), np.nan), np.array([[1, 2], [3, 4]], dtype=object), np.array(5.0), np.zeros((2, 2, 2, 2)),
    [[1e18, 0], [1, 1], [2, 5]], [[-1e300, 0], [1, 1], [2, 5]], [[1, 2, 3, np.inf]] * 3,
    np.zeros((20, 20)),
]  # fmt: skip
"""None of them is right for any of the arguments below."""
REGION = Region.from_rectangle((2, 2, 17, 17), (20, 20))
PLATE: dict[str, Any] = {
    "name": "plate",
    "points": [[0, 0], [1, 0], [1, 1]],
    "elements": [[0, 1, 2]],
    "node_numbers": [1, 2, 3],
    "element_numbers": [1],
}
MESH = Tri3Mesh(nodes=np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]), elements=np.array([[0, 1, 2]], dtype=np.int32))
MOSAIC: dict[str, Any] = {
    "values": np.full((24, 24), 900, dtype=np.uint16),
    "cfa": "RGGB",
    "black_level": 64.0,
    "white_level": 4095.0,
}
CROSSTALK: dict[str, Any] = {"matrix": np.eye(3), "lights": ("red", "green", "blue")}
REGISTRATION: dict[str, Any] = {"lights": ("a", "b"), "parameters": np.zeros((2, 5)), "centre": (1, 1), "radius": 10.0}
FIELD: dict[str, Any] = {"nodes": MESH.nodes, "elements": MESH.elements, "displacement": np.zeros((3, 2))}
RATES = np.zeros(8), np.ones(8)
MESH = Tri3Mesh(nodes=np.array([[0.0, 0.0], [9.0, 0.0], [9.0, 9.0]]), elements=np.array([[0, 1, 2]], dtype=np.int32))
CROSSTALK: dict[str, Any] = {"matrix": np.eye(3), "lights": ("red", "green", "blue")}
REGISTRATION: dict[str, Any] = {"lights": ("a", "b"), "parameters": np.zeros((2, 5)), "centre": (1, 1), "radius": 10.0}
FIELD: dict[str, Any] = {"nodes": MESH.nodes, "elements": MESH.elements, "displacement": np.zeros((3, 2))}
MOSAIC: dict[str, Any] = {"cfa": "RGGB", "black_level": 64.0, "white_level": 4095.0}
MOSAIC["values"] = np.full((24, 24), 900, dtype=np.uint16)
RATES = np.zeros(8), np.ones(8)
RATED = fields.Field(name="u", values=RATES[0], std=RATES[1])
TEXTURE = np.random.default_rng(0).uniform(100, 200, (20, 20))


def correlated(**given: Any) -> object:
    return rgbmidic.correlate(TEXTURE, TEXTURE, **{"element_size": 8, **given})


def measured(state: Any, **given: Any) -> object:
    return next(rgbmidic.measure_sequence([state], **{"element_size": 8, **given}))


ARGUMENTS: dict[str, Callable[[Any], object]] = {
    "rectangle": lambda value: Region.from_rectangle(value, (20, 20)),
    "shape of a rectangle": lambda value: Region.from_rectangle((1, 1, 5, 5), value),
    "polygon": lambda value: Region.from_polygon(value, (20, 20)),
    "shape of a polygon": lambda value: Region.from_polygon([[1, 1], [5, 1], [1, 5]], value),
    "shape of a mask": lambda value: Region.from_mask(REGION.mask, value),
    "hole": lambda value: REGION.without([value]),
    "element size": lambda value: Tri3Mesh.from_region(REGION, value),
    "crack": lambda value: Tri3Mesh.from_region(REGION, 8, [value]),
    "nodes": lambda value: Tri3Mesh(nodes=value, elements=[[0, 1, 2]]),
    "elements": lambda value: Tri3Mesh(nodes=PLATE["points"], elements=value),
    **{key: lambda value, key=key: FiniteElementMesh(**PLATE | {key: value}) for key in PLATE if key != "name"},
    "pairs of points": Placement.fit,
    **{
        key: lambda value, key=key: CameraCalibration(shape=(20, 20), **{key: value})
        for key in ("lens", "homography", "covariance")
    },
    "reference": lambda value: rgbmidic.correlate(value, TEXTURE),
    **{
        key: lambda value, key=key: correlated(**{key: value}) for key in ("weights", "initial", "brightness", "region")
    },
    "state": lambda value: measured(value),
    "region of states": lambda value: measured(TEXTURE, region=value),
}
MORE_ARGUMENTS: dict[str, Callable[[Any], object]] = {
    **{
        f"{key} of a mosaic": lambda value, key=key: linearise(Mosaic(**MOSAIC | {key: value}))
        for key in ("values", "cfa", "black_level", "white_level")
    },
    **{
        f"{key} of a crosstalk": lambda value, key=key: Crosstalk(**CROSSTALK | {key: value})
        for key in ("matrix", "lights", "covariance", "green_difference", "light_levels")
    },
    **{
        f"{key} of a registration": lambda value, key=key: Registration(**REGISTRATION | {key: value})
        for key in ("parameters", "centre", "radius")
    },
    "values of a quantity": lambda value: Quantity(value, np.ones(7)),
    "matrices of a field": lambda value: CrosstalkField(order=1, coefficients=value, shape=(20, 20)),
    "kind": lambda value: Calibration(kind=value),
    "pixel field": lambda value: fields.at_nodes(value, np.array([[1.0, 1.0]])),
    "nodal field": lambda value: fields.at_pixels(MESH, value, (20, 20)),
    "truth": lambda value: fields.field_rms(MESH, np.zeros((3, 2)), value),
    "border": lambda value: fields.field_rms(MESH, np.zeros((3, 2)), np.zeros((2, 20, 20)), border=value),
    "sigma": lambda value: fields.high_pass(TEXTURE, value),
    "times": lambda value: fields.rates(value, RATED, window=3, common_fraction=0.5, references=[True] * 8),
    "window": lambda value: fields.rates(range(8), RATED, window=value, common_fraction=0.5, references=[True] * 8),
    "uncertainty": lambda value: fields.frame_covariance(value, 0.5, [True] + 6 * [False]),
    "common fraction": lambda value: fields.frame_covariance(RATES[1], value, [True] * 8),
    "number of reference frames": fields.reference_fraction,
    "gradient": lambda value: fields.strain_of_gradient(value, np.zeros((3, 4, 4))),
    "axis": lambda value: rotation(1.0, value),
    "displacement gradient": lambda value: AffineField(gradient=value),
    "displacement of a mesh": lambda value: MeshField(**FIELD | {"displacement": value}),
    "translation": lambda value: State(translation=value),
    "size of a map": lambda value: height_map(Surface(), size=value, pitch=0.1),
    "wavelengths": lambda value: Sensitivities(wavelengths=value, values=np.ones((3, 7))),
    "white balance": lambda value: write_dng("/dev/null/x", Mosaic(**MOSAIC), white_balance=value),
    **{"file": lambda value: write_dng(value, Mosaic(**MOSAIC)), "mesh": rgbmidic.read_mesh},
}
"""Of which some of the strange values are right."""


@pytest.mark.parametrize("name", ARGUMENTS)
@pytest.mark.filterwarnings("ignore")
def test_strange_arguments_are_refused_in_one_line(name: str) -> None:
    refused = 0
    for value in STRANGE:
        with suppress(RgbmidicError):
            ARGUMENTS[name](value)
            continue
        refused += 1
    assert refused >= len(STRANGE) - 4


@pytest.mark.parametrize("name", MORE_ARGUMENTS)
@pytest.mark.filterwarnings("ignore")
def test_strange_arguments_are_taken_or_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for value in [*STRANGE, None, {}, {"a": 1}, True, 0, "\0", "y" * 300]:
        with suppress(RgbmidicError):
            MORE_ARGUMENTS[name](value)


@pytest.mark.parametrize("path", ["\0", b"x", None, 7])
def test_what_is_no_name_of_a_file_is_refused(path: Any) -> None:
    readers = (rgbmidic.read_mesh, rgbmidic.read_test, rgbmidic.read_frame, Calibration.read, CameraCalibration.read)
    for use in (
        lambda one: write_dng(one, Mosaic(**MOSAIC)), lambda one: list_frames("*", one), rgbmidic.Result.open, *readers,
    ):  # fmt: skip
        with pytest.raises(RgbmidicError):
            use(path)


@pytest.mark.parametrize("other", [*STRANGE[:12], object(), Crosstalk])
@pytest.mark.filterwarnings("ignore")
def test_an_object_of_another_class_is_refused(tmp_path: Path, other: Any) -> None:
    for use in (
        lambda: rgbmidic.export_result(other, "npz", tmp_path / "x"),
        lambda: Calibration(crosstalk=other),
        lambda: Calibration(camera_noise=other),
        lambda: rgbmidic.read_histories(other, ProbeSettings()),
        lambda: inspect_frame(other),
    ):
        with pytest.raises(RgbmidicError):
            use()


def test_grey_levels_that_no_camera_has_are_refused() -> None:
    for value in (-1, 7e4, np.nan):
        with pytest.raises(InputError, match="grey levels are whole numbers from 0 to 65535"):
            Mosaic(**MOSAIC | {"values": np.full((24, 24), value)})


@pytest.mark.parametrize("lights", [("red", "red"), ("", "red"), (" ", "red"), (1, 2)])
def test_lights_need_names_of_their_own(lights: tuple[Any, Any]) -> None:
    with pytest.raises(RgbmidicError, match=r"each light needs a name, different from the others'|must be a text"):
        Crosstalk(matrix=np.eye(3)[:, :2], lights=lights)
    with pytest.raises(RgbmidicError, match=r"each light needs a name|must be a text"):
        Registration(lights=lights, parameters=np.zeros((2, 5)), centre=(1, 1), radius=10.0)
    document = Calibration(crosstalk=Crosstalk(matrix=np.eye(3)[:, :2], lights=("red", "blue"))).to_document()
    document["crosstalk"]["lights"] = list(lights)
    with pytest.raises(RgbmidicError):
        Calibration.from_document(document)


@pytest.mark.parametrize("kind", ["points", "lines", "circles", "regions", "gauges", "strain_gauges"])
def test_probes_far_away_are_refused_at_once(tmp_path: Path, kind: str) -> None:
    result = make_result(tmp_path / "out", record=smooth_record)
    for far in (1e5, 1e18, 1e300):
        numbers = {"points": 2, "circles": 3, "strain_gauges": 3}.get(kind, 4)
        place = (*(50.0, 40.0, 60.0, 50.0)[: numbers - 1], far)
        with pytest.raises(InputError, match="outside the region that was measured"):
            rgbmidic.read_histories(result, ProbeSettings(**{kind: (place,)}))


def test_a_reference_without_light_is_no_division_by_zero() -> None:
    for dark in (np.zeros((20, 20)), -TEXTURE):
        with pytest.raises(RgbmidicError):
            list(rgbmidic.measure_sequence([TEXTURE], reference=dark, element_size=8))


def test_numbers_are_taken_as_they_are_or_refused() -> None:
    assert as_numbers([[1, 2.0]], "x", (None, 2), dtype=np.int32).tolist() == [[1, 2]]
    for value in ([1.5], [2**40], [np.nan], ["1"], [True, None], [1 + 0j], [[1]]):
        with pytest.raises(InputError, match="a whole number is needed; given is"):
            as_numbers(value, "a whole number is needed", (1,), dtype=np.int32)
