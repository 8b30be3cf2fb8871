"""Triangulation: exact on exact points, as uncertain as stated; the file of two cameras."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from stereo_scene import DISTANCE, FOCAL, pair_of

from rgbmidic import CameraCalibration
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.tools.stereo import CameraPair, triangulate

LENS = (FOCAL, 80.0, 61.0, -0.3, 4.0, 1e-3, -2e-3, 0)
POINTS = np.random.default_rng(0).uniform(-10, 10, (50, 3)) + np.array([0, 0, DISTANCE])


def test_exact_points_come_back():
    pair = pair_of(22.0, LENS)
    seen = triangulate(pair, *pair.project(POINTS), np.diag([1.0, 2.0, 0.5, 3.0])[None].repeat(50, axis=0))
    assert np.abs(seen.points - POINTS).max() < 1e-9
    assert np.abs(seen.residual).max() < 1e-9


def test_errors_are_as_stated():
    """In all components, and their correlation; whatever the covariance of the four coordinates."""
    pair, random = pair_of(22.0, LENS), np.random.default_rng(1)
    root = np.array([[1.0, 0, 0, 0], [0.3, 0.8, 0, 0], [0.2, 0, 1.5, 0], [0, -0.4, 0.3, 0.6]]) * 0.01
    point = np.repeat(POINTS[:1], 4000, axis=0)
    left, right = pair.project(point)
    noise = random.normal(size=(4000, 4)) @ root.T
    seen = triangulate(pair, left + noise[:, :2], right + noise[:, 2:], np.repeat((root @ root.T)[None], 4000, axis=0))
    whitened = np.linalg.solve(np.linalg.cholesky(seen.covariance[0]), (seen.points - point).T)
    assert np.cov(whitened) == pytest.approx(np.eye(3), abs=0.1)
    assert (seen.residual / seen.residual_std).std() == pytest.approx(1, abs=0.05)


def test_the_error_of_the_shape_cancels_in_the_displacement():
    """With the same weights; with others, an epipolar error of the reference would come through."""
    pair = pair_of(22.0, LENS)
    (left, right), moved = pair.project(POINTS), pair.project(POINTS + np.array([0.1, 0.2, 0.3]))
    off = np.array([0.0, 0.4])  # px across the epipolar lines, in both states of the right camera
    spreads = [np.diag(values)[None].repeat(50, axis=0) for values in ([1.0, 1, 4, 4], [1.0, 16, 1, 1])]
    true = np.array([0.1, 0.2, 0.3])
    for spread, same in ((spreads[0], True), (spreads[1], False)):
        weights = np.linalg.inv(spreads[0])
        first = triangulate(pair, left, right + off, spread, weights if same else np.linalg.inv(spread))
        second = triangulate(pair, moved[0], moved[1] + off, spreads[0], weights)
        error = np.abs(second.points - first.points - true).max()
        assert error < 1e-3 if same else error > 1e-2


def test_points_without_data_have_none_and_shapes_are_checked():
    pair = pair_of()
    left, right = pair.project(POINTS)
    left[3] = np.nan
    seen = triangulate(pair, left, right, np.eye(4)[None].repeat(50, axis=0))
    assert np.isnan(seen.points[3]).all()
    assert np.isfinite(np.delete(seen.covariance, 3, axis=0)).all()
    with pytest.raises(InputError, match="covariances"):
        triangulate(pair, left, right, np.eye(4))


def test_the_file_gives_the_pair_back(tmp_path):
    root = np.random.default_rng(2).normal(size=(22, 22))
    pair = pair_of(22.0, LENS, covariance=root @ root.T, details={"views": 3})
    pair.write(tmp_path / "stereo.json")
    read = CameraPair.read(tmp_path / "stereo.json")
    assert CameraPair.is_in(tmp_path / "stereo.json")
    assert (read.parameters == pair.parameters).all()
    assert (read.covariance == pair.covariance).all()
    assert read.details == {"views": 3}
    assert read.baseline == pytest.approx(2 * DISTANCE * np.sin(np.radians(11)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("rgbmidic-stereo", "rgbmidic-camera"), "not a stereo calibration"),
        (lambda text: text.replace('"rotation_rad"', '"rotation"'), "missing key 'rotation_rad'"),
        (lambda text: text.replace('"lens"', '"lenses"'), "no lens"),
        (lambda text: text.replace('"schema_version": 1,\n  "left"', '"schema_version": 2,\n  "left"'), "version 2"),
        (lambda text: json.dumps({**json.loads(text), "translation_mm": [0, 0, 0]}), "baseline"),
        (lambda text: json.dumps({**json.loads(text), "translation_mm": [0, 0]}), "translation"),
        (lambda text: json.dumps({**json.loads(text), "left": [1]}), "damaged"),
        (lambda text: json.dumps({**json.loads(text), "covariance": (-np.eye(22)).tolist()}), "covariance"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, change, message):
    pair_of().write(tmp_path / "stereo.json")
    (tmp_path / "stereo.json").write_text(change((tmp_path / "stereo.json").read_text()))
    with pytest.raises(CalibrationError, match=message):
        CameraPair.read(tmp_path / "stereo.json")


def test_frames_and_lights_of_another_camera_are_refused():
    pair = pair_of()
    with pytest.raises(CalibrationError, match="the right camera was calibrated with frames of 160 x 120 px"):
        pair.check(((120, 160), (240, 160)))
    camera = CameraCalibration(shape=(120, 160), lens=LENS, details={"first_light": "green"})
    with pytest.raises(CalibrationError, match="the left camera is of light green's image"):
        replace(pair, left=camera).check_lights((("red", "green"), ()))


def test_the_calibration_s_part_is_that_of_its_covariance():
    """A baseline with an uncertainty of one in a thousand leaves as much of every length."""
    covariance = np.zeros((22, 22))
    pair = pair_of()
    covariance[19:, 19:] = np.outer(pair.translation, pair.translation) * 1e-6
    pair = replace(pair, covariance=covariance)
    pixels, spread = pair.project(POINTS), np.eye(4)[None].repeat(50, axis=0)

    def log_size(other):
        points = triangulate(other, *pixels, spread).points
        return np.log(np.linalg.norm(points - points.mean(axis=0)))

    (error,) = pair.parameter_errors.T
    stated = log_size(pair.with_parameters(pair.parameters + error)) - log_size(pair)
    assert abs(stated) == pytest.approx(1e-3, rel=2e-3)


def test_slopes_by_the_parameters_are_those_of_the_projection():
    lens = np.array([2000.0, 79.5, 59.5, -0.3, 0.1, 1e-3, -2e-3, 0.0])
    pair = pair_of(lens=lens)
    slopes, values = pair.parameter_slopes(POINTS), pair.parameters
    for number, step in enumerate(1e-5 * np.maximum(np.abs(values), 1)):
        change = np.zeros(22)
        change[number] = step
        ends = [
            np.concatenate(pair.with_parameters(values + sign * change).project(POINTS), axis=1) for sign in (1, -1)
        ]
        assert slopes[..., number] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5, abs=1e-6)
