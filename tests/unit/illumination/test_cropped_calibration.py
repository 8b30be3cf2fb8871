"""A calibration on frames that the camera cropped: everything stays at its place on the sensor, or is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField
from rgbmidic.illumination.images import Registration

WHOLE, CROP, ORIGIN = (300, 401), (90, 121), (273, 35)
LIGHTS = ("red", "green", "blue")
PARAMETERS = np.array([[0.0] * 5, [0.3, -0.2, 1e-3, 2e-3, -5e-4], [-0.1, 0.2, 0.0, -1e-3, 1e-3]])
POINTS = np.random.default_rng(0).uniform(0, 89, (50, 2))


def registration(parameters=PARAMETERS):
    return replace(Registration.identity(LIGHTS, WHOLE), parameters=parameters)


def crosstalk(order=3):
    terms = (order + 1) * (order + 2) // 2 - 1
    coefficients = np.random.default_rng(order).normal(0, 0.02, (terms, 3, 3))
    field = CrosstalkField(order=order, coefficients=coefficients, shape=WHOLE)
    return Crosstalk(matrix=np.eye(3) + 0.1, lights=LIGHTS, field=field)


def calibration(**changes):
    parts = {"crosstalk": crosstalk(), "registration": registration(), "cfa": "RGGB", "shape": WHOLE, **changes}
    return Calibration(**parts)


def test_a_registration_keeps_its_place_on_the_sensor():
    found = calibration().cropped(ORIGIN, CROP).registration.displacement(POINTS)
    np.testing.assert_allclose(found, registration().displacement(POINTS + ORIGIN), atol=1e-12)
    middle = registration().displacement(POINTS + np.array(WHOLE[::-1]) / 2 - np.array(CROP[::-1]) / 2)
    assert np.abs(found - middle).max() > 0.1  # what it would be about the wrong centre


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_crosstalk_field_keeps_its_place_on_the_sensor(order):
    found = calibration(crosstalk=crosstalk(order)).cropped(ORIGIN, CROP).crosstalk
    assert found.field.shape == CROP
    np.testing.assert_allclose(found.at(POINTS), crosstalk(order).at(POINTS + ORIGIN), atol=1e-10)
    y, x = np.mgrid[: CROP[0], : CROP[1]]
    np.testing.assert_allclose(found.matrix, found.at(np.stack([x, y], -1)).mean(axis=(0, 1)), atol=2e-3)


@pytest.mark.parametrize("origin", [(0, 0), (1, 0), (0, 1), (7, 3)])
def test_the_pattern_is_that_of_the_first_pixel_of_the_crop(origin):
    pattern = np.tile(cfa_channels("GRBG"), (8, 8))
    found = calibration(cfa="GRBG").cropped(origin, CROP).cfa
    np.testing.assert_array_equal(cfa_channels(found), pattern[origin[1] : origin[1] + 2, origin[0] : origin[0] + 2])


def test_a_crop_of_a_crop_is_a_crop():
    twice = calibration().cropped((200, 30), (150, 201)).cropped((73, 5), CROP)
    once = calibration().cropped(ORIGIN, CROP)
    np.testing.assert_allclose(twice.crosstalk.at(POINTS), once.crosstalk.at(POINTS), atol=1e-10)
    assert twice.registration.centre == once.registration.centre
    assert (twice.cfa, twice.shape) == (once.cfa, once.shape)


def test_whole_frames_need_no_statement():
    whole = calibration()
    assert whole.cropped(None, WHOLE) is whole


SHIFTS = np.where(np.arange(5) < 2, PARAMETERS, 0)
UNIFORM = replace(crosstalk(), field=None)


@pytest.mark.parametrize("parameters", [0 * PARAMETERS, SHIFTS])
def test_what_is_the_same_everywhere_holds_for_frames_of_any_size(parameters):
    plain = calibration(crosstalk=UNIFORM, registration=registration(parameters))
    assert plain.cropped(None, CROP) is plain
    assert calibration(crosstalk=UNIFORM, registration=None).cropped(None, (4000, 6000)).shape == WHOLE


@pytest.mark.parametrize(
    "changes",
    [{}, {"registration": None}, {"crosstalk": UNIFORM}, {"shape": None}, {"shape": None, "crosstalk": UNIFORM}],
)
def test_frames_of_another_size_must_say_where_they_lie(changes):
    with pytest.raises(CalibrationError, match=r"401 x 300 px .* 121 x 90 px.*frames\.crop_origin = \[x, y\]"):
        calibration(**changes).cropped(None, CROP)


@pytest.mark.parametrize("origin", [(281, 35), (273, 211)])
def test_a_crop_beyond_the_calibrated_frame_is_refused(origin):
    with pytest.raises(CalibrationError, match=r"121 x 90 px .*crop_origin.*beyond the calibrated frame of 401 x 300"):
        calibration().cropped(origin, CROP)
