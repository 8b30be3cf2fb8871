"""Weights by geometry and by the automatic threshold in the main job, end to end on tiny virtual tests."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from rgbmidic import Result, Status, measure, read_test
from rgbmidic.errors import ConfigurationError
from rgbmidic.settings import TestSettings
from rgbmidic.tools.lab.virtual.dataset import write_dataset
from rgbmidic.weights.threshold import FALLBACK

SCENE = """
[body]
kind = "sphere"
[surface]
droplet = 0.5
dome = 0.01
seed = 3
[surface.white]
spacing = 0.1
[surface.black]
spacing = 0.1
[[lights]]
name = "red"
position = [-190.0, -12.0, 90.0]
[[lights]]
name = "green"
position = [200.0, 15.0, 90.0]
[[lights]]
name = "blue"
position = [10.0, -420.0, 200.0]
[camera]
shape = [208, 208]
mm_per_pixel = 0.12
kind = "rgb"
exposure = 0.45
samples = 5
[[states]]
angle_deg = 1.0
[[states]]
angle_deg = 2.0
[output]
element_size = 20.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("sphere")
    (out / "scene.toml").write_text(SCENE)
    write_dataset(out / "scene.toml", out / "test")
    return out / "test"


def run(folder, out, **weights) -> Result:
    document = read_test(folder / "test.toml").to_mapping()
    document["weights"] = weights
    return measure(TestSettings.from_mapping(document, folder), out)


def error(folder, result: Result) -> float:
    """Root mean square error of v at the nodes of the last frame, px; u has the curvature of the field in it."""
    with np.load(folder / "truth.npz") as archive:
        exact = archive["displacement"][-1]
    x, y = np.round(result.nodes).astype(int).T
    return float(np.sqrt(np.nanmean((result.v[-1] - exact[1, y, x]) ** 2)))


def test_weights_by_geometry_find_their_scene_and_beat_no_weights(folder, tmp_path):
    plain = run(folder, tmp_path / "none", method="none")
    soft = run(folder, tmp_path / "soft", method="geometry", geometry="scene.toml")
    binary = run(folder, tmp_path / "binary", method="geometry", geometry="scene.toml", limit_deg=15.0)
    for result in (plain, soft, binary):
        assert (result.status == Status.CONVERGED).all()
    assert error(folder, soft) < 0.9 * error(folder, plain)
    # blue's reflection lies outside the field
    assert binary.weight_fraction[-1].argmax() == 2
    assert soft.provenance["settings"]["weights"]["geometry"].endswith("scene.toml")


def test_a_scene_of_another_camera_stops_the_job_before_anything_is_written(folder, tmp_path):
    (tmp_path / "other.toml").write_text(SCENE.replace("208, 208", "208, 210"))
    with pytest.raises(ConfigurationError, match=r"other\.toml: camera\.shape"):
        run(folder, tmp_path / "result", method="geometry", geometry=str(tmp_path / "other.toml"))
    assert not (tmp_path / "result").exists()


def test_where_nothing_is_disturbed_the_automatic_threshold_is_the_paper_s_and_says_so(folder, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, logger="rgbmidic.pipeline"):
        result = run(folder, tmp_path / "auto", method="threshold", threshold="auto")
    assert result.provenance["weights_threshold"] == pytest.approx(FALLBACK)
    assert "no disturbed zone" in caplog.text
    fixed = run(folder, tmp_path / "fixed", method="threshold")
    np.testing.assert_array_equal(result.u, fixed.u)


def test_a_test_without_a_deformed_frame_takes_the_paper_s_threshold(folder, tmp_path, caplog):
    document = read_test(folder / "test.toml").to_mapping()
    document["frames"]["reference"] = [0, 1, 2]
    document["weights"] = {"method": "threshold", "threshold": "auto"}
    result = measure(TestSettings.from_mapping(document, folder), tmp_path / "result")
    assert "no deformed frame" in caplog.text
    assert result.provenance["weights_threshold"] == pytest.approx(FALLBACK)
