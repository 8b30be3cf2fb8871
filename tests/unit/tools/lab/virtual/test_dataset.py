"""SCENE.toml to a folder that readers and settings accept; bad files are named errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rgbmidic.errors import ConfigurationError, InputError, ResultError
from rgbmidic.frames import read_frame
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.settings import read_test
from rgbmidic.tools.lab.virtual import AffineField, MeshField, Polarisers, Sphere, record, render, truth
from rgbmidic.tools.lab.virtual.dataset import write_dataset, write_stereo_dataset
from rgbmidic.tools.lab.virtual.view_point import ViewPoint
from rgbmidic.tools.scene.scene import read_scene
from rgbmidic.tools.scene.zones import material_points, points_and_normals
from rgbmidic.tools.stereo import CameraPair

EXAMPLES = Path(__file__).parents[5] / "examples" / "scenes"

SMALL = """
[camera]
shape = [60, 64]
samples = 3
{camera}
[[states]]
angle_deg = 0.5
[output]
calibration_frames = 2
{output}
"""


def scene_file(folder, text):
    path = folder / "scene.toml"
    path.write_text(text)
    return path


def test_bayer_data_set_as_dng(tmp_path):
    seen = []
    path = scene_file(tmp_path, SMALL.format(camera='cfa = "GBRG"', output="noise_free = true"))
    test = write_dataset(path, tmp_path / "out", lambda done, total, line: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    settings = read_test(test)
    assert settings.frames.kind == "bayer"
    experiment = read_scene(path)
    frame = read_frame(tmp_path / "out/frames/frame_0001.dng")
    assert (frame.cfa, frame.white_level) == ("GBRG", 4095)
    images = render(experiment.scene, experiment.states[0])
    with np.load(tmp_path / "out/noise_free/frame_0001.npz") as file:
        assert np.array_equal(file["images"], images)
    signal = record(images, experiment.scene.camera, experiment.scene.lights, seed=99).values
    difference = frame.values.astype(float) - signal
    assert 0 < difference.std() < 60
    assert abs(difference.mean()) < 3
    with np.load(tmp_path / "out/truth.npz") as file:
        assert file["displacement"].shape == (2, 2, 60, 64)
        assert np.allclose(file["displacement"][1], truth(experiment.scene, experiment.states[0]), atol=1e-6)
        assert np.abs(file["displacement"][0]).max() < 1e-9
    assert len(list((tmp_path / "out/light_green").glob("*.dng"))) == 2
    assert len(list((tmp_path / "out/dark").glob("*.dng"))) == 2
    matrix = Calibration.read(tmp_path / "out/calibration.json").crosstalk.matrix
    assert np.allclose(matrix, experiment.scene.camera.mixing(experiment.scene.lights))


def test_same_scene_gives_the_same_bytes(tmp_path):
    path = scene_file(tmp_path, SMALL.format(camera="", output='format = "tiff"'))
    for name in ("a", "b"):
        write_dataset(path, tmp_path / name)
    files = sorted(file.relative_to(tmp_path / "a") for file in (tmp_path / "a").rglob("*.tif"))
    assert len(files) == 2 + 4 * 2 + 6 * 2 + 5 * 2
    assert all((tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes() for file in files)


def test_monochrome_camera_gets_a_series_per_light(tmp_path):
    path = scene_file(tmp_path, SMALL.format(camera='kind = "monochrome"', output=""))
    settings = read_test(write_dataset(path, tmp_path / "out"))
    assert len(settings.frames.path) == 3
    assert (tmp_path / "out/frames_blue/frame_0001.tif").exists()


@pytest.mark.parametrize("name", ["sphere", "plate_in_tension", "rolling_cylinder"])
def test_example_scenes_read(name):
    experiment = read_scene(EXAMPLES / f"{name}.toml")
    assert experiment.states
    assert np.isfinite(truth(experiment.scene, experiment.states[-1])).any()


def test_reference_values_stand_in_for_what_is_left_out(tmp_path):
    scene = read_scene(scene_file(tmp_path, "")).scene
    assert scene.body == Sphere()
    assert [light.name for light in scene.lights] == ["red", "green", "blue"]
    assert scene.camera.crosstalk is not None
    assert scene.camera.crosstalk[1, 2] == 0.16


def test_polarisers_are_there_where_their_section_is(tmp_path):
    bare, empty, stated = (
        read_scene(scene_file(tmp_path, text)).scene
        for text in ("", "[polarisers]", "[polarisers]\nextinction = 1e-4\ntransmission = 0.15\ndepolarised = 0.0")
    )
    for scene, polarisers in (
        (empty, Polarisers()),
        (stated, Polarisers(extinction=1e-4, transmission=0.15, depolarised=0.0)),
    ):
        expected = bare.polarised(polarisers)
        assert (scene.lights, scene.surface) == (expected.lights, expected.surface)
    assert stated.lights[1].power == pytest.approx(0.15 * bare.lights[1].power)


def test_plate_takes_a_gradient_or_a_mesh_file(tmp_path):
    nodes = np.array([[-9.0, -9.0], [9.0, -9.0], [9.0, 9.0], [-9.0, 9.0]])
    np.savez(tmp_path / "field.npz", nodes=nodes, elements=[[0, 1, 2], [0, 2, 3]], displacement=0.01 * nodes)
    text = """
    body.kind = "plate"
    [[states]]
    displacement_gradient = [[0.01, 0.0], [0.0, 0.01]]
    [[states]]
    displacement_file = "field.npz"
    """
    a, b = read_scene(scene_file(tmp_path, text)).states
    assert isinstance(a.displacement, AffineField)
    assert isinstance(b.displacement, MeshField)
    x = np.array([1.0, -3.0]), np.array([2.0, 0.5])
    assert np.allclose(a.displacement(*x), b.displacement(*x))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[camra]\nbits = 12", 'unknown section "camra" in the file (did you mean "camera"?)'),
        ("[camera]\nbit = 12", 'unknown key "bit" in [camera] (did you mean "bits"?)'),
        ('[camera]\nbits = "12"', "camera.bits must be a whole number"),
        ("[camera]\ncrosstalk = [[1.0, 0.1]]", "crosstalk of a bayer camera under 3 lights"),
        ('[body]\nkind = "cube"', "body.kind must be one of"),
        ("[surface]\ncoverage = 1.5", "surface.coverage must be at most 0.95, not 1.5"),
        ("[surface]\nseed = -1", "surface.seed must be at least 0, not -1"),
        ("[surface]\nsoftness = 0.5", "softness must be at most the droplet's diameter"),
        ("[camera]\nblack_level = 4095", "black_level must be below saturation at 4095"),
        ("[body]\ncentre = [0, 0, 41]", "a body lies in front of the camera"),
        ("[surface.white]\nshine = 2.0", 'unknown key "shine" in [surface.white]'),
        ('[[lights]]\nname = "red"', "lights.red.position is missing"),
        ("[states]\nangle_deg = 1.0", "[[states]]"),
        ("[[states]]\ndisplacement_offset = [1.0, 0.0]", "for a plate only"),
        ('body.kind = "plate"\n[[states]]\ndisplacement_file = "absent.npz"', "absent.npz"),
        ('[camera]\nsensitivities = "absent.json"', "absent.json"),
        ("[polarisers]\nextinction = 1.5", "polarisers.extinction must be at most 1, not 1.5"),
        ("[polarisers]\ntransmission = 0.0", "polarisers.transmission must be above 0, not 0"),
        ("[polarisers]\ntransmitted = 0.2", 'unknown key "transmitted" in [polarisers]'),
        ("[[polarisers]]\nextinction = 0.1", "polarisers"),
        ("[output]\nregion = [1, 2]", "output.region must be 4 values"),
        ("not toml", "not a readable scene file"),
    ],
)
def test_bad_scene_files_are_named_errors(tmp_path, text, named):
    path = scene_file(tmp_path, text)
    with pytest.raises(ConfigurationError) as caught:
        read_scene(path)
    assert named in str(caught.value)
    assert str(path) in str(caught.value)


def test_nothing_is_overwritten(tmp_path):
    path = scene_file(tmp_path, SMALL.format(camera="", output=""))
    with pytest.raises(ResultError, match="not empty"):
        write_dataset(path, tmp_path)
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(ConfigurationError, match="not found"):
        write_dataset(tmp_path / "absent.toml", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_two_cameras_see_one_test(tmp_path):
    """The true points project onto the left pixels, and the true motion onto the motion that either camera sees."""
    second = "\n[camera.second]\nangle_deg = 20\nazimuth_deg = 70\nroll_deg = 9\nshape = [50, 70]\nfocal_px = 8000"
    text = SMALL.format(camera="", output="").replace("samples = 3", f"samples = 1{second}")
    path = scene_file(tmp_path, text.replace("calibration_frames = 2", "calibration_frames = 1"))
    left, right = write_stereo_dataset(path, tmp_path / "out")
    assert read_test(right).region.rectangle == (0, 0, 69, 49)
    pair = CameraPair.read(tmp_path / "out/stereo.json")
    assert pair.angle_deg == pytest.approx(20)
    assert (pair.right.shape, pair.right.lens[0]) == ((50, 70), 8000)
    with np.load(tmp_path / "out/truth.npz") as file, np.load(left.parent / "truth.npz") as of_left:
        points, moved, seen = file["points"], file["displacement"][1], of_left["displacement"][1]
    rest, deformed = (pair.project(array.reshape(3, -1).T.astype(float)) for array in (points, points + moved))
    assert rest[0] == pytest.approx(np.indices((60, 64))[::-1].reshape(2, -1).T, abs=1e-2)
    assert deformed[0] - rest[0] == pytest.approx(seen.reshape(2, -1).T, abs=2e-2)
    experiment = read_scene(path)
    view = ViewPoint.both(experiment.scene, experiment.second)[1]
    of_right, body = view.scene(experiment.scene), experiment.scene.body
    material = material_points(of_right, view.state(body), tuple(rest[1].T))
    before, after = (
        points_and_normals(of_right, material, view.state(body, s))[0].T for s in (None, experiment.states[0])
    )
    turn, shift = pair.poses[1]
    assert before == pytest.approx(points.reshape(3, -1).T @ turn.T + shift, abs=1e-3)
    assert after - before == pytest.approx(moved.reshape(3, -1).T @ turn.T, abs=1e-3)
    with pytest.raises(InputError, match=r"angle_deg is 20, stated beside it are 30 degrees .*: state one of them"):
        write_stereo_dataset(path, tmp_path / "none", 30.0)
    with pytest.raises(InputError, match="not 0"):
        replace(experiment.second, angle_deg=0.0)
    assert not (tmp_path / "none").exists()
