"""Frames that a high-speed camera cropped, measured with the calibration of its whole sensor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_tests import colour_test
from textures import Texture

from rgbmidic import Calibration, Status, correlate, measure, read_frame, read_test
from rgbmidic.errors import CalibrationError, FrameError
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.images import write_tiff
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration
from rgbmidic.pipeline import Plan
from rgbmidic.tools.lab.inspection import inspect_files

LIGHTS = ("red", "green", "blue")
WHOLE, CROP, CORNER = (600, 800), (150, 170), (630, 450)
PARAMETERS = np.array([[0.0] * 5, [0.05, -0.05, 2e-4, 5e-4, 2e-4], [0.0, 0.1, 0.0, -6e-4, 1e-4]])
ALIGNED = 0.005
"""px: what may be left between the lights once they are aligned."""


def corner_frame(registration):
    """What a 3-CCD camera shows at the corner of its sensor, every light where the registration says."""
    y, x = np.mgrid[: CROP[0], : CROP[1]].reshape(2, -1) + np.array(CORNER[::-1], dtype=float)[:, None]
    points, texture, lights = np.stack([x, y], axis=1), Texture.random(0), []
    for light in range(3):
        source = points
        for _ in range(20):  # a light shows at x + rho(x) what the first shows at x: invert by fixed point
            source = points - registration.displacement(source)[light]
        lights.append(10 * texture.at(*source.T).reshape(CROP))
    return ChannelFrame(values=np.rint(lights).astype(np.uint16), black_level=np.zeros(3), white_level=4095)


@pytest.fixture
def settings(tmp_path):
    registration = replace(Registration.identity(LIGHTS, WHOLE), parameters=PARAMETERS)
    Calibration(crosstalk=Crosstalk.identity(LIGHTS), registration=registration, shape=WHOLE, white_level=4095.0).write(
        tmp_path / "calibration.json"
    )
    frame = corner_frame(registration)
    for index in range(2):
        write_tiff(tmp_path / f"frame_{index}.tif", frame)

    def stated(text):
        (tmp_path / "TEST.toml").write_text(
            f'[frames]\npath = "*.tif"\nkind = "rgb"\n{text}\n[region]\nrectangle = [15, 15, 155, 135]\n'
            '[calibration]\nfile = "calibration.json"\n'
        )
        return read_test(tmp_path / "TEST.toml")

    return stated


def apart(settings):
    """Largest mean distance in px of the second and third light from the first, and largest rms."""
    reference = Plan.from_settings(settings).reference
    images = [reference.pixels.scatter(values, np.nan) for values in reference.values]
    fields = [correlate(images[0], images[j], region=(20, 20, 150, 130), initial=(0, 0)) for j in (1, 2)]
    return max(float(np.sqrt(np.nanmean(field.displacement**2))) for field in fields)


def test_the_lights_of_a_corner_are_brought_together(settings):
    assert apart(settings(f"crop_origin = {list(CORNER)}")) < ALIGNED
    assert apart(settings("crop_origin = [0, 0]")) > 20 * ALIGNED


def test_a_crop_that_is_not_stated_stops_the_job_before_anything_is_written(settings, tmp_path):
    message = r"the calibration was made with frames of 800 x 600 px .* 170 x 150 px.*frames\.crop_origin"
    with pytest.raises(CalibrationError, match=message):
        measure(settings(""), tmp_path / "result")
    assert not (tmp_path / "result").exists()
    with pytest.raises(CalibrationError, match=message):
        inspect_files([tmp_path / "frame_0.tif"], test=settings(""))
    with pytest.raises(CalibrationError, match=r"crop_origin = \[640, 450\] reach beyond the calibrated frame"):
        measure(settings("crop_origin = [640, 450]"), tmp_path / "result")


def test_an_odd_crop_shifts_the_pattern_of_the_calibration(tmp_path):
    test = colour_test(tmp_path / "whole", suffix=".tif")
    whole = measure(test.settings(), tmp_path / "of_whole")
    for file in test.frames:
        frame = read_frame(file, cfa="RGGB", black_level=64, white_level=4095)
        write_tiff(file, replace(frame, values=frame.values[3:, 5:]))
    rectangle = [11, 13, 123, 125]
    cropped = measure(
        test.settings(frames={"crop_origin": [5, 3]}, region={"rectangle": rectangle}), tmp_path / "of_crop"
    )
    assert (cropped.status == Status.CONVERGED).all()
    np.testing.assert_allclose(cropped.nodes, whole.nodes - (5.0, 3.0))
    inner = (np.abs(whole.nodes - 72) < 40).all(axis=1)
    np.testing.assert_allclose(cropped.u[:, inner], whole.u[:, inner], atol=5e-3)
    right = Plan.from_settings(test.settings(frames={"crop_origin": [5, 3]}, region={"rectangle": rectangle}))
    assert right.series.read(0)[0].cfa == "BGGR"
    for stated in ({}, {"cfa": "BGGR"}, {"cfa": "RGGB", "crop_origin": [5, 3]}):
        with pytest.raises(FrameError, match=r"frames\.crop_origin"):
            Plan.from_settings(test.settings(frames=stated, region={"rectangle": rectangle}))
