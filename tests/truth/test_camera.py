"""What lens and plane change in a result: strain on a tilted specimen through a lens that distorts, in every output."""

from __future__ import annotations

import csv
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
from target_scene import LENS, SHAPE, frame_on_plane, imaged, on_plane, pose, random_views, view_of
from textures import Texture

from rgbmidic import CameraCalibration, measure
from rgbmidic.cli.app import app, command
from rgbmidic.errors import CalibrationError, ConfigurationError, InputError
from rgbmidic.fields import Displacement, Rectification, Units
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.results import FrameRecord, Maps, Origin, Result, ResultStore, export_result
from rgbmidic.results.histories import read_histories
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import FrameSettings, ProbeSettings, RegionSettings, ScaleSettings, TestSettings, read_test
from rgbmidic.tools.report import write_report
from rgbmidic.typing import FloatArray
from rgbmidic_calibration.camera import estimate_lens, estimate_plane

BOX = (60.0, 60.0, 580.0, 420.0)
MESH = Tri3Mesh.from_region(Region.from_rectangle(BOX, SHAPE), 25)
NODES = len(MESH.nodes)
CORNER = 0.01
"""Noise of a corner, px: `find_view` finds them to 0.005 px (tests/unit/calibration/test_camera.py)."""
LEFT = 7e-6
"""Strain that the calibration may leave; issue 25 asks for 1e-5. Found: 4.6e-6 at most, in px 3e-4 to 4e-3."""
STD = (0.01, 0.03)
"""Standard uncertainty of u and v, px."""

Motion = Callable[[FloatArray], FloatArray]


def turned(points: FloatArray) -> FloatArray:
    c, s = np.cos(np.radians(2)), np.sin(np.radians(2))
    return points @ np.array([[c, -s], [s, c]]).T


MOTIONS: dict[str, tuple[Motion, tuple[float, float]]] = {
    "translation": (lambda points: points + np.array([1.0, -0.7]), (0.0, 0.0)),
    "rotation": (turned, (0.0, 0.0)),
    "stretch": (lambda points: points * np.array([1.01, 1.0]), (0.01 + 0.01**2 / 2, 0.0)),
}
"""Motions of points of the plane, mm, with their principal Green-Lagrange strains."""


def lens_of(percent: float) -> FloatArray:
    """A lens that distorts by so much in the corner of the frame."""
    radius = np.hypot(SHAPE[1] / 2, SHAPE[0] / 2) / LENS[0]
    return np.array([*LENS[:3], percent / 100 / radius**2, 0, 0, 0, 0])


def calibrated(where: Any, lens: FloatArray, seed: int, noise: float = CORNER) -> CameraCalibration:
    """Calibration from noisy corners of 20 views and one on the plane."""
    random = np.random.default_rng(seed)
    camera = estimate_lens(random_views(random, 20, lens=lens, noise=noise)).camera
    return estimate_plane(view_of(where, random, lens=lens, noise=noise), camera).camera


def moved(where: Any, lens: FloatArray, motion: Motion) -> FloatArray:
    """Displacement (2, N) of the nodes in px."""
    return (imaged(motion(on_plane(MESH.nodes, where, lens)), where, lens) - MESH.nodes).T


def result_of(path: Path, fields: list[FloatArray], scale: ScaleSettings) -> Result:
    settings = TestSettings(
        frames=FrameSettings(path=("x",), kind="monochrome"), region=RegionSettings(rectangle=BOX), scale=scale
    )
    names = [f"frame {index}" for index in range(len(fields))]
    origin = Origin(
        nodes=MESH.nodes,
        elements=MESH.elements,
        names=names,
        lights=("lamp",),
        settings=settings,
        notes={"frame_shape": SHAPE},
    )
    with ResultStore.create(path, origin) as store:
        for index, (u, v) in enumerate(fields):
            std = {"u_std": np.full(NODES, STD[0]), "v_std": np.full(NODES, STD[1])}
            head = {"number": index, "status": 0, "node_status": np.zeros(NODES)}
            store.write_frame(index, FrameRecord.from_values(nodes=NODES, lights=1, **head, u=u, v=v, **std))
        store.finish()
    return Result.open(path)


def largest_error(result: Result, exact: tuple[float, float], scale: ScaleSettings | None = None) -> float:
    values = ResultInUnits.from_result(result, scale).frame(0)
    return float(max(np.nanmax(np.abs(values[name] - true)) for name, true in zip(("e1", "e2"), exact, strict=True)))


@pytest.mark.parametrize(("percent", "tilt"), [(0.0, 0.0), (2.0, 0.0), (0.0, 2.0), (2.0, 5.0), (-2.0, 5.0)])
def test_strain_on_the_plane_is_right_where_in_pixels_it_is_not(tmp_path: Path, percent: float, tilt: float) -> None:
    where, lens = pose(0.8 * tilt, 0.6 * tilt), lens_of(percent)
    calibrated(where, lens, seed=int(10 * tilt + percent) + 2).write(tmp_path / "camera.json")
    before, after = [], []
    for name, (motion, exact) in MOTIONS.items():
        result = result_of(
            tmp_path / name, [moved(where, lens, motion)], ScaleSettings(camera=tmp_path / "camera.json")
        )
        before.append(largest_error(result, exact, ScaleSettings(mm_per_pixel=0.1)))
        after.append(largest_error(result, exact))
    assert max(after) < LEFT, after
    assert not (percent or tilt) or max(before) > 3e-4, before


def test_stated_uncertainty_is_that_of_noise_and_of_the_calibration(tmp_path: Path) -> None:
    where, lens = pose(4, 3, turn=20), lens_of(-2)
    field = moved(where, lens, MOTIONS["translation"][0])
    random, one = np.random.default_rng(0), np.ones(NODES)
    rectified = Rectification.of(MESH, Units(), calibrated(where, lens, seed=0))
    draws = [
        rectified.displacement(
            Displacement.in_plane(*(field + np.array(STD)[:, None] * random.normal(size=field.shape)))
        ).values
        for _ in range(200)
    ]
    stated = rectified.displacement(Displacement.in_plane(*field, STD[0] * one, STD[1] * one)).std
    ratio = np.std(draws, axis=0) / stated
    assert np.abs(ratio.mean(axis=1) - 1).max() < 0.02
    field[:, 7] = np.nan  # a node without data
    missing = rectified.displacement(Displacement.in_plane(*field, one, one))
    np.testing.assert_array_equal(~missing.is_measured, np.arange(NODES) == 7)
    field = moved(where, lens, MOTIONS["translation"][0])
    # the camera's own: calibrations that differ by the noise of their corners alone
    found = [Rectification.of(MESH, Units(), calibrated(where, lens, seed)) for seed in range(8)]
    exact = MOTIONS["translation"][0](np.zeros((1, 2)))[0]
    axes = turn_of(where, lens)
    errors = [
        (one.units.mm_per_pixel or 0) * one.displacement(Displacement.in_plane(*field)).values.T - exact @ axes.T
        for one in found
    ]
    actual = np.sqrt(np.mean(np.sum(np.square(errors), axis=2)))
    claimed = np.mean([one.units.mm_per_pixel_std / (one.units.mm_per_pixel or 1) for one in found])
    assert actual / (claimed * np.hypot(*exact)) == pytest.approx(1, abs=0.3)


def turn_of(where: Any, lens: FloatArray) -> FloatArray:
    """Rotation (2, 2) from the target's axes to those of the plane, by the image's in the middle of the frame."""
    centre = np.array([[(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2]])
    along = on_plane(centre + np.array([0.5, 0]), where, lens) - on_plane(centre - np.array([0.5, 0]), where, lens)
    c, s = (along / np.linalg.norm(along))[0]
    return np.array([[c, s], [-s, c]])


@pytest.fixture
def stretched(tmp_path: Path) -> tuple[Result, Path]:
    """A translation, then a stretch, on a tilted plane; and the camera's file."""
    where, lens = pose(4, 3), lens_of(2)
    calibrated(where, lens, seed=1).write(tmp_path / "camera.json")
    fields = [moved(where, lens, MOTIONS[name][0]) for name in ("translation", "stretch")]
    return result_of(tmp_path / "result", fields, ScaleSettings(camera=tmp_path / "camera.json")), tmp_path


@pytest.mark.usefixtures("blank_pictures")
def test_every_output_has_the_same_millimetres(stretched: tuple[Result, Path]) -> None:
    result, folder = stretched
    camera = CameraCalibration.read(folder / "camera.json")
    (folder / "camera.json").unlink()  # what it held is kept with the result
    node = int(np.argmin(np.hypot(*(MESH.nodes - [400, 300]).T)))
    place = MESH.nodes[node]
    ends = (*MESH.nodes[node], *MESH.nodes[0])
    physical = ResultInUnits.from_result(result)
    values = physical.frame(1)
    u, v = (float(values[name][node]) for name in "uv")
    now = place + np.array([result.u[1][node], result.v[1][node]])
    np.testing.assert_allclose([u, v], (camera.to_mm(now[None]) - camera.to_mm(place[None]))[0], atol=1e-6)
    probes = ProbeSettings(points=(tuple(place),), gauges=(ends,), strain_gauges=((*place, 80.0),))
    found = read_histories(result, probes)
    assert found["point_1_u_mm"].values[1] == pytest.approx(u, abs=1e-6)
    assert found["point_1_v_mm"].values[1] == pytest.approx(v, abs=1e-6)
    length = np.hypot(*np.diff(camera.to_mm(np.reshape(ends, (2, 2))), axis=0)[0])
    extension = found["gauge_1_extension_mm"].values[1]
    assert extension / length == pytest.approx(found["gauge_1_strain"].values[1], rel=1e-9)
    assert found["strain_gauge_1_e1"].values == pytest.approx([0, 0.01005], abs=LEFT)
    assert any("camera.json" in remark and camera.summary() in remark for remark in found.remarks)

    export_result(result, "csv", folder / "out.csv")
    with (folder / "out.csv").open(encoding="utf-8") as file:
        row = [line for line in csv.DictReader(file) if line["frame"] == "1"][node]
    assert [float(row[name]) for name in ("u_mm", "v_mm")] == pytest.approx([u, v], abs=1e-6)
    assert [float(row[name]) for name in ("x_image_px", "y_image_px")] == pytest.approx(place)
    assert [float(row[name]) for name in ("x_mm", "y_mm")] == pytest.approx(camera.to_mm(place[None])[0])
    export_result(result, "hdf5", folder / "out.h5")
    with h5py.File(folder / "out.h5") as file:
        assert file["u"][1][node] == pytest.approx(u, abs=1e-6)
        assert file["x"][node] == pytest.approx(camera.to_mm(place[None])[0, 0])
        assert file["x_image"][node] == pytest.approx(place[0])
        np.testing.assert_allclose(file["VTKHDF/Points"][:, 0], camera.to_mm(MESH.nodes)[:, 0])
        assert camera.summary() in file.attrs["camera"]
        assert float(np.sum(file["area"])) == pytest.approx(physical.length**2 * physical.mesh.areas.sum())
    data = result.to_xarray()
    assert float(data.u[1, node]) == pytest.approx(u, abs=1e-6)
    assert float(data.x[node]) == pytest.approx(camera.to_mm(place[None])[0, 0])
    np.testing.assert_allclose(data.strain[1, :, 0], values["exx"], rtol=1e-5)
    assert data.u.units == "mm"
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(data)).strain, data.strain)
    viewed = Maps.from_result(result)
    assert viewed.read("u", 1).values[node] == pytest.approx(u, abs=1e-6)
    np.testing.assert_allclose(viewed.read("exx", 1).values, values["exx"])
    np.testing.assert_allclose(viewed.deformed_nodes(1)[node], now)
    write_report(result, folder / "report.html")
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "lens and plane" in text
    assert camera.summary() in text


def test_another_camera_takes_its_place_and_contradictions_are_refused(
    stretched: tuple[Result, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    result, folder = stretched
    camera = CameraCalibration.read(folder / "camera.json")
    double = np.diag([2.0, 2, 1]) @ camera.homography
    replace(camera, homography=double).write(folder / "double.json")
    again = ResultInUnits.from_result(result, ScaleSettings(camera=folder / "double.json")).frame(1)["u"]
    np.testing.assert_allclose(again, 2 * ResultInUnits.from_result(result).frame(1)["u"], rtol=1e-6)
    replace(camera, homography=None, covariance=np.zeros((16, 16))).write(folder / "lens.json")
    with pytest.raises(InputError, match=r"lens\.json holds no plane"):
        ResultInUnits.from_result(result, ScaleSettings(camera=folder / "lens.json"))
    replace(camera, shape=(480, 600)).write(folder / "other.json")
    with pytest.raises(CalibrationError, match=r"other\.json \(scale\.camera\) .* 600 x 480 px, .* 640 x 480 px"):
        read_histories(result, ProbeSettings(points=((300, 200),)), scale=ScaleSettings(camera=folder / "other.json"))
    with pytest.raises(CalibrationError, match=r"not found: .*none\.json"):
        result.to_xarray(ScaleSettings(camera=folder / "none.json"))
    replace(camera, lens=camera.lens * [1, 1, 1, -40, 1, 1, 1, 1]).write(folder / "bent.json")
    with pytest.raises(InputError, match=r"bent\.json does not image all of the mesh"):
        ResultInUnits.from_result(result, ScaleSettings(camera=folder / "bent.json"))
    with pytest.raises(ConfigurationError, match=r"scale\.camera .* scale\.mm_per_pixel"):
        ScaleSettings(camera=folder / "camera.json", mm_per_pixel=0.1)
    test = folder / "TEST.toml"
    test.write_text('[frames]\npath = "x"\n[region]\nrectangle = [1, 1, 9, 9]\n[scale]\ncamera = "other.json"\n')
    assert read_test(test).scale.camera == folder / "other.json"
    out = folder / "never.csv"
    assert (
        command.execute(app, ["export", str(result.path), "--to", "csv", "--out", str(out), "--test", str(test)]) == 2
    )
    assert "other.json (scale.camera)" in capsys.readouterr().err
    assert not out.exists()


def test_speckle_on_a_tilted_specimen_is_measured_without_its_false_strain(tmp_path: Path) -> None:
    """Images through lens and plane, from the pixel to the strain."""
    where, lens, texture = pose(4, 3), lens_of(2), Texture.random(1, waves=60)
    places = frame_on_plane(where, lens)
    motion = np.array([1.0, -0.7])
    for index, points in enumerate((places, places - motion)):
        image = texture.at(*(points.T * LENS[0] / where[1][2])).reshape(SHAPE)
        cv2.imwrite(str(tmp_path / f"f{index}.png"), np.round(image / 2).clip(0, 255).astype(np.uint8))
    calibrated(where, lens, seed=2).write(tmp_path / "camera.json")
    document: dict[str, Any] = {
        "frames": {"path": "f*.png", "kind": "monochrome", "white_level": 255, "black_level": 0},
        "region": {"rectangle": [100, 80, 540, 400]},
        "mesh": {"element_size": 40.0},
        "scale": {"camera": "camera.json"},
    }
    result = measure(TestSettings.from_mapping(document, tmp_path), tmp_path / "result")
    index = len(result) - 1
    plane = ResultInUnits.from_result(result).frame(index)
    plain = ResultInUnits.from_result(result, ScaleSettings(mm_per_pixel=0.1)).frame(index)
    assert np.nanmean(np.hypot(plane["u"], plane["v"])) == pytest.approx(np.hypot(*motion), rel=1e-4)
    mean = {name: float(np.sqrt(np.nanmean(values["e1"] ** 2))) for name, values in (("plane", plane), ("px", plain))}
    assert mean["px"] > 1e-3
    assert mean["plane"] < 6e-5  # found 3.7e-5, noise of rounding to 8 bit
    other = replace(CameraCalibration.read(tmp_path / "camera.json"), shape=(480, 600))
    other.write(tmp_path / "camera.json")
    with pytest.raises(CalibrationError, match=r"camera\.json \(scale\.camera\)"):
        measure(TestSettings.from_mapping(document, tmp_path), tmp_path / "refused")
    assert not (tmp_path / "refused").exists()
