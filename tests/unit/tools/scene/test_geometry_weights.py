"""Weights of a test's frames from its scene: which light, which state, which pixels, and what is refused."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rgbmidic.errors import ConfigurationError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.settings import TestSettings
from rgbmidic.tools.lab.virtual import State
from rgbmidic.tools.scene.geometry_weights import GeometryWeights
from rgbmidic.tools.scene.scene import read_scene
from rgbmidic.tools.scene.zones import material_points, points_and_normals, predict_zones

SCENE = """
[body]
kind = "sphere"
[surface]
droplet = 0.6
[camera]
shape = [90, 120]
mm_per_pixel = 0.22
kind = "rgb"
"""
STATES = "[[states]]\nangle_deg = 3.0\n[[states]]\nangle_deg = 6.0\n"
LIGHTS = ("red", "green", "blue")
SHAPE = (90, 120)
ONES = np.ones((3, *SHAPE), dtype=np.float32)
IMAGES = IlluminationImages(values=ONES, valid=ONES > 0, names=LIGHTS, full_scale=1.0)


@pytest.fixture
def prepare(tmp_path: Path):
    """Weights from a scene text, settings of ``[weights]`` and what the test is like."""

    def run(scene=SCENE + STATES, *, lights=LIGHTS, shape=SHAPE, frames=3, reference=0, **weights):
        (tmp_path / "scene.toml").write_text(scene)
        document = {
            "frames": {"path": "x", "kind": "monochrome", "reference": reference},
            "region": {"rectangle": [0, 0, 9, 9]},
            "weights": {"method": "geometry", "geometry": "scene.toml", **weights},
        }
        settings = TestSettings.from_mapping(document, tmp_path)
        return GeometryWeights.prepare(settings, lights=lights, shape=shape, frames=frames)

    return run


def test_soft_weights_are_low_where_a_light_reflects_and_the_motion_changes_it(prepare, tmp_path):
    found = prepare()
    weights = found.deformed(IMAGES, 2)
    assert weights.shape == (3, *SHAPE)
    assert weights.dtype == np.float32
    assert weights.min() > 0
    assert weights.max() <= 1
    np.testing.assert_array_equal(found.reference(IMAGES), 1)
    scene = read_scene(tmp_path / "scene.toml").scene
    material = material_points(scene, State(angle_deg=6.0))
    before, after = (predict_zones(scene, State(angle_deg=angle), material=material).fraction for angle in (0.0, 6.0))
    for light in (0, 1):
        changed, calm = abs(after - before)[light] > 0.2, np.maximum(after, before)[light] < 0.02
        assert changed.mean() > 0.05
        assert weights[light][changed].mean() < 0.7 * weights[light][calm].mean()
        # the same state twice: the reflection has not changed, only noise is left
        assert found.deformed(IMAGES, 0)[light][changed].mean() > 1.5 * weights[light][changed].mean()


def test_binary_weights_are_those_of_the_angle_at_every_pixel(prepare, tmp_path):
    weights = prepare(limit_deg=15.0).deformed(IMAGES, 1)
    scene = read_scene(tmp_path / "scene.toml").scene
    deviation = predict_zones(scene, State(angle_deg=3.0)).deviation_deg
    clear = abs(deviation - 15) > 0.3  # the prediction is interpolated between every fourth pixel
    np.testing.assert_array_equal(weights[clear], (deviation > 15)[clear])
    assert set(np.unique(weights)) == {0, 1}


def test_the_reference_excludes_what_any_of_its_frames_excludes(prepare):
    weights = prepare(limit_deg=15.0, reference=[0, 2])
    both = weights.reference(IMAGES)
    np.testing.assert_array_equal(both, np.minimum(weights.deformed(IMAGES, 0), weights.deformed(IMAGES, 2)))


@pytest.mark.parametrize("limit_deg", [None, 15.0])
def test_a_part_of_the_frame_has_the_weights_of_its_place(prepare, limit_deg):
    weights = prepare(**({"limit_deg": limit_deg} if limit_deg else {}))
    rows, columns = slice(32, 80), slice(64, 100)
    part = replace(IMAGES, values=ONES[:, rows, columns], valid=ONES[:, rows, columns] > 0, origin=(64, 32))
    np.testing.assert_array_equal(weights.reference(part), weights.reference(IMAGES)[:, rows, columns])
    np.testing.assert_array_equal(weights.deformed(part, 2), weights.deformed(IMAGES, 2)[:, rows, columns])


@pytest.mark.parametrize("limit_deg", [None, 15.0])
def test_pixels_that_are_not_valid_have_no_weight(prepare, limit_deg):
    weights = prepare(**({"limit_deg": limit_deg} if limit_deg else {}))
    valid = ONES > 0
    valid[1, 20:30] = False
    images = replace(IMAGES, valid=valid)
    for found in (weights.reference(images), weights.deformed(images, 1)):
        np.testing.assert_array_equal(found[1, 20:30], 0)
        assert found[0, 20:30].max() > 0
        assert found.dtype == np.float32


def test_lights_are_found_by_name_and_before_a_monochrome_camera_by_order(prepare):
    plain, turned = prepare(), prepare(lights=("blue", "red", "green"))
    np.testing.assert_array_equal(turned.deformed(IMAGES, 1), plain.deformed(IMAGES, 1)[[2, 0, 1]])
    grey = SCENE.replace('"rgb"', '"monochrome"')
    assert prepare(grey, lights=("light 1", "light 2", "light 3")).order == (0, 1, 2)
    with pytest.raises(ConfigurationError, match="scene's lights are red, green, blue, the test's are amber"):
        prepare(lights=("amber", "green", "blue"))


def test_without_states_every_frame_is_the_body_at_rest_and_the_reflections_count_as_changed(prepare):
    found = prepare(SCENE, frames=17)
    np.testing.assert_array_equal(found.deformed(IMAGES, 3), found.deformed(IMAGES, 16))
    share = predict_zones(found.scene).fraction
    weights = found.deformed(IMAGES, 3)
    assert weights[0][share[0] > 0.3].mean() < 0.7 * weights[0][share[0] < 0.05].mean()


def test_weights_by_geometry_can_be_pickled(prepare):
    weights = prepare()
    unpickled = pickle.loads(pickle.dumps(weights))
    np.testing.assert_array_equal(unpickled.deformed(IMAGES, 1), weights.deformed(IMAGES, 1))


def test_beside_the_body_nothing_is_seen(prepare):
    found = prepare(SCENE.replace('kind = "sphere"', 'kind = "plate"\nwidth = 10.0\nheight = 100.0'), frames=2)
    weights = found.deformed(IMAGES, 1)
    np.testing.assert_array_equal(weights[:, :, :30], 0)
    assert weights[:, :, 45:75].min() > 0


def test_a_height_map_takes_the_place_of_the_body(prepare, tmp_path):
    scene = SCENE.replace('kind = "sphere"', 'kind = "plate"\nwidth = 300.0\nheight = 300.0')
    (tmp_path / "scene.toml").write_text(SCENE)
    sphere = read_scene(tmp_path / "scene.toml").scene
    points, _ = points_and_normals(sphere, material_points(sphere))
    np.save(tmp_path / "heights.npy", sphere.body.front[2] - points[2])
    mapped = prepare(scene, height_map="heights.npy", limit_deg=15.0).deformed(IMAGES, 1)
    modelled = prepare(SCENE, limit_deg=15.0).deformed(IMAGES, 1)
    assert (mapped != modelled).mean() < 0.01
    assert 1 - modelled.mean() > 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape": (90, 121)}, r"camera.shape is \[90, 120\], the frames have \[90, 121\]"),
        ({"frames": 4}, "there are 4 frames and 2 states"),
        ({"geometry": "absent.toml"}, "scene file not found"),
        ({"height_map": "absent.npy", "scene": SCENE}, "height_map not found"),
        ({"height_map": "scene.toml", "scene": SCENE}, "not a readable npy file"),
        ({"height_map": "small.npy", "scene": SCENE}, r"shape \(90, 120\), not \(3, 3\)"),
        ({"height_map": "high.npy", "scene": SCENE}, "below the distance"),
        ({"height_map": "good.npy"}, r"remove the \[\[states\]\]"),
    ],
)
def test_a_scene_of_another_test_is_refused(prepare, tmp_path, changes, message):
    for name, heights in (("small", np.zeros((3, 3))), ("high", np.full(SHAPE, 700.0)), ("good", np.zeros(SHAPE))):
        np.save(tmp_path / f"{name}.npy", heights)
    with pytest.raises(ConfigurationError, match=message):
        prepare(**changes)
