"""What is doubtful about the frames of a test is a warning, what contradicts the settings an error, before a solve."""

from __future__ import annotations

import logging
import re
import warnings

import numpy as np
import pytest
import small_tests
from results import analysis_rows
from scipy.ndimage import gaussian_filter, shift
from small_tests import colour_test

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.frames import read_frame
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.pipeline import Plan, measure, measure_sequence
from rgbmidic.settings import TestSettings
from rgbmidic.tools.lab.virtual import record

SIDE, NOISE = 96, 12.0
PATTERN = gaussian_filter(np.random.default_rng(0).normal(size=(SIDE, SIDE)), 1.5)
SPECKLE = 1000 + 300 * PATTERN / PATTERN.std()


def frame(index: int, *, exposure: float = 1.0) -> np.ndarray:
    moved = shift(SPECKLE, (0.2 * index, -0.3 * index), mode="nearest") * exposure
    noise = np.random.default_rng(index).normal(scale=NOISE, size=SPECKLE.shape)
    return np.clip(np.round(moved + noise), 0, 4095).astype(np.uint16)


def settings(**sections: dict[str, object]) -> TestSettings:
    frames = {"path": [], "kind": "monochrome", "white_level": 4095} | sections.pop("frames", {})
    document = {"frames": frames, "region": {"rectangle": [10, 10, 85, 85]}, "mesh": {"element_size": 25}}
    return TestSettings.from_mapping(document | sections)


@pytest.fixture
def told(caplog):
    """What is warned of."""
    caplog.set_level(logging.WARNING, logger="rgbmidic")
    return lambda: "\n".join(record.getMessage() for record in caplog.records)


def test_good_frames_are_not_warned_of(tmp_path, told):
    measure(settings(), tmp_path / "out", source=[frame(index) for index in range(4)])
    assert told() == ""


def test_an_overexposed_frame_is_warned_of(tmp_path, told):
    frames = [frame(0), frame(1), frame(2, exposure=3.8)]
    assert 0.2 < (frames[2] == 4095).mean() < 0.5
    measure(settings(), tmp_path / "out", source=frames)
    assert "frame 2: more than 10% of the samples in the region are saturated, 0% in the reference" in told()
    assert "frame 1" not in told()


def test_an_overexposed_reference_is_warned_of_once(tmp_path, told):
    measure(settings(), tmp_path / "out", source=[frame(index, exposure=3.8) for index in range(3)])
    assert told().count("saturated") == 1
    assert "in the region of the reference (frame 0) are saturated" in told()


def test_a_frame_that_repeats_the_one_before_is_warned_of(tmp_path, told):
    measure(settings(), tmp_path / "out", source=[frame(0), frame(1), frame(1), frame(2)])
    assert told().startswith("frames that repeat the one before, bit for bit")
    assert "2 (frame 2);" in told()


@pytest.mark.parametrize("frames", [{}, {"reference": "0:2"}, {"first": 2}])
def test_a_frame_that_is_the_reference_is_warned_of(tmp_path, told, frames):
    source = [frame(0), frame(1), frame(2), frame(0), frame(3)]
    measure(settings(frames=frames), tmp_path / "out", source=source)
    line = told().splitlines()[-1]  # frames 0 and 1 as reference move against each other, of which another line warns
    assert line.startswith("frames are the reference, bit for bit, which camera noise makes impossible")
    assert f"not measured: {3 - frames.get('first', 0)} (frame 3);" in line
    assert told().count("bit for bit") == 1


def test_frames_that_are_all_the_same_are_warned_of(tmp_path, told):
    measure(settings(), tmp_path / "out", source=[frame(0)] * 3)
    assert told().startswith("all frames repeat the one before, bit for bit")


def test_a_run_in_parts_warns_of_a_repeated_frame(tmp_path, told):
    for part in (range(2), range(2, 4)):
        measure(settings(), tmp_path / "out", source=[frame(0), frame(1), frame(2), frame(2)], frames=part)
    assert told().count("bit for bit") == 1


def test_a_state_that_repeats_the_one_before_is_warned_of(told):
    list(measure_sequence([frame(0), frame(1), frame(1)], settings()))
    assert told() == "state 2 repeats the one before, bit for bit"


def test_a_state_that_is_the_reference_is_warned_of(told):
    list(measure_sequence([frame(0), frame(1), frame(0), frame(2)], settings()))
    assert told() == "state 2 is the reference, bit for bit: its displacement of 0 is not measured"


def test_a_threshold_that_excludes_nothing_is_warned_of(told):
    frames = [frame(0), frame(1)]
    Plan.from_settings(settings(weights={"method": "threshold"}), source=frames)
    assert (
        "weights.threshold = 0.667 excludes nothing in the reference: no light, blurred over 10 px, exceeds" in told()
    )


def test_a_threshold_that_excludes_something_is_not(told):
    spot = 3000 * np.exp(-(np.hypot(*(np.mgrid[:SIDE, :SIDE] - 40)) ** 2) / 200)
    lit = np.clip(frame(0) + spot, 0, 4095).astype(np.uint16)
    Plan.from_settings(settings(weights={"method": "threshold", "threshold": 0.5}), source=[lit, lit])
    assert "excludes" not in told()


@pytest.mark.parametrize(
    ("stated", "named"),
    [
        ({"kind": "bayer", "cfa": "RGGB"}, "frames.kind and frames.cfa and calibration.file are stated"),
        ({"kind": "rgb"}, "frames.kind and calibration.file are stated"),
        ({}, "calibration.file is stated"),
    ],
)
def test_floats_are_not_the_raw_frames_that_are_stated(stated, named, tmp_path):
    given = settings(frames=stated, calibration={"file": str(colour_test(tmp_path / "c").folder / "calibration.json")})
    with pytest.raises(ConfigurationError, match=rf"float32: arrays of floats are images of the lights, and {named}"):
        measure(given, tmp_path / "out", source=[frame(index).astype(np.float32) for index in range(2)])


def test_samples_in_the_upper_bits_are_named(tmp_path):
    frames = [16 * frame(index) for index in range(2)]
    with pytest.raises(FrameError, match=r"the reference \(frame 0\): .* all multiples of 16, .* should it be 65520\?"):
        measure(settings(), tmp_path / "out", source=frames)


def test_samples_far_above_the_white_level_are_named(told):
    swapped = [frame(index).byteswap() for index in range(2)]
    with pytest.raises(FrameError, match="no light sees the region in the reference"):
        Plan.from_settings(settings(), source=swapped)
    assert "far above white_level 4095" in told()
    assert "is the order of the bytes (frames.dtype) right?" in told()


@pytest.mark.parametrize("place", [0, 1])
def test_a_frame_of_hardly_a_sample_that_is_not_saturated_is_not_separated(place, tmp_path):
    """The texture cannot be learnt from it."""
    test = colour_test(tmp_path / "test")
    frames = [read_frame(file).values for file in test.frames]
    frames[place] = np.where(np.random.default_rng(0).random(frames[0].shape) < 0.99, 5001, frames[place])
    stated = test.settings(frames={"path": [], "cfa": "RGGB"})
    words = "no light sees the region.*: .*99% of the samples in the region are saturated"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if place == 0:
            with pytest.raises(FrameError, match=words):
                measure(stated, tmp_path / "out", source=frames)
        else:
            assert re.match(words, measure(stated, tmp_path / "out", source=frames).frame(1).reason)


def test_a_reference_with_one_lamp_on_is_named_as_that(tmp_path, told):
    scene = small_tests._scene("bayer")
    lit = small_tests._rendered((0.0, 0.0)).copy()
    lit[1:] = 0
    values = [record(lit, scene.camera, scene.lights, seed=seed).values for seed in range(2)]
    test = colour_test(tmp_path / "test")
    Plan.from_settings(test.settings(frames={"path": [], "cfa": "RGGB"}, mesh={"element_size": 8.0}), source=values)
    assert "the reference (frame 0) shows no light of " in told()
    assert "too small" not in told()


@pytest.mark.parametrize(("brightness", "described"), [("auto", "auto"), (12.0, "12"), ("none", "none")])
def test_the_correction_of_the_grey_levels_is_in_the_provenance(brightness, described, tmp_path):
    stated = settings(mesh={"element_size": 12}, solver={"brightness": brightness})
    result = measure(stated, tmp_path / "out", source=[frame(0), frame(1)])
    corrected = result.provenance["grey_levels"]
    assert corrected["brightness"] == brightness
    assert (corrected["gain_window"] is None) == (brightness == "none")
    assert described in analysis_rows(result)["grey-level correction"]


def test_the_calibration_is_read_once(tmp_path, monkeypatch):
    test, times = colour_test(tmp_path / "test"), []
    read = Calibration.read
    monkeypatch.setattr(Calibration, "read", lambda file: times.append(file) or read(file))
    result = measure(test.settings(), tmp_path / "out")
    assert len(times) == 1
    assert result.provenance["calibration_figures"] == read(times[0]).figures()
    assert result.frame(1).machine == result.provenance["machine"]
    assert result.provenance["readers"] == ["rawpy"]
