"""Photon transfer: gain, read noise, fixed pattern and defects of a virtual camera, and mistakes that must not pass."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_scene import BLACK, GAIN, READ, WHITE, expose, speckle_target, white_target

from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic_calibration.captures import stack_frames
from rgbmidic_calibration.noise import photon_transfer

COLUMN = np.array([0.6, 1.0, 0.5])
LEVELS = (200, 700, 1300, 1900, 2500, 3100)
SHAPE = (192, 192)


def dark_frames(rng, count=4, shape=SHAPE, **camera):
    return [expose(np.zeros(shape), COLUMN, rng, **camera) for _ in range(count)]


def flat_frames(picture, level, rng, count=2, **camera):
    return [expose(level * picture, COLUMN, rng, **camera) for _ in range(count)]


def measure(target, rng, *, exposures=LEVELS, times=False, **camera):
    picture = target(SHAPE, rng)
    dark = stack_frames(dark_frames(rng, **camera), drifts=False)
    flats = [
        stack_frames(flat_frames(picture, level, rng, **camera), exposure=level if times else None)
        for level in exposures
    ]
    return photon_transfer(dark, flats)


@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_gain_and_read_noise_on_plain_and_speckled_targets(target):
    noise = measure(target, np.random.default_rng(1)).camera_noise
    assert noise.planes == ("R", "G1", "G2", "B")
    assert noise.gain.value == pytest.approx(GAIN, rel=0.03)
    assert noise.dark_noise.value == pytest.approx(READ * GAIN, rel=0.03)
    assert noise.black_level.value == pytest.approx(BLACK, abs=0.1)
    assert noise.saturation.value == pytest.approx(WHITE - BLACK, abs=1)
    assert noise.full_well.value == pytest.approx((WHITE - BLACK) * GAIN, rel=0.03)


def test_three_chip_and_monochrome_cameras():
    rng = np.random.default_rng(2)
    picture = white_target((128, 128), rng)
    rgb = {level: [expose(level * picture, COLUMN, rng, kind="rgb") for _ in range(2)] for level in (0, 500, 2500)}
    grey = {level: [one_channel(frame) for frame in frames] for level, frames in rgb.items()}
    for frames, planes in ((rgb, ("R", "G", "B")), (grey, ("M",))):
        dark = stack_frames(frames[0], drifts=False)
        noise = photon_transfer(dark, [stack_frames(frames[500]), stack_frames(frames[2500])]).camera_noise
        assert noise.planes == planes
        assert noise.gain.value == pytest.approx(GAIN, rel=0.06)


def one_channel(frame):
    return ChannelFrame(values=frame.values[1:2], black_level=BLACK, white_level=WHITE)


def test_fixed_pattern_is_separated_from_temporal_noise():
    rng = np.random.default_rng(3)
    response = 1 + 0.012 * rng.standard_normal(SHAPE)
    offset = 2.0 * rng.standard_normal(SHAPE)
    picture = white_target(SHAPE, rng)
    dark = stack_frames([expose(np.zeros(SHAPE), COLUMN, rng, offset=offset) for _ in range(8)], drifts=False)
    flats = [
        stack_frames([expose(level * picture * response, COLUMN, rng, offset=offset) for _ in range(6)])
        for level in (600, 2400)
    ]
    noise = photon_transfer(dark, flats).camera_noise
    assert noise.dsnu.value == pytest.approx(2.0, rel=0.05)
    assert noise.prnu.value == pytest.approx(1.2, rel=0.05)
    assert (np.abs(noise.prnu.value - 1.2) < 4 * noise.prnu.std).all()
    assert noise.gain.value == pytest.approx(GAIN, rel=0.03)


def test_without_fixed_pattern_none_is_claimed():
    noise = measure(white_target, np.random.default_rng(4)).camera_noise
    for pattern in (noise.dsnu, noise.prnu):  # the root of a variance within 4 standard errors (2 value std) of 0
        assert (pattern.value < 8 * pattern.std).all()
    assert noise.defects == ()


def test_hot_and_dead_pixels_are_found_where_they_are():
    rng = np.random.default_rng(5)
    picture = white_target(SHAPE, rng)
    response = np.ones(SHAPE)
    response[50, 71] = 0.1
    frames = {level: [] for level in (0, 1000, 2400)}
    for level, into in frames.items():
        for _ in range(3):
            values = expose(level * picture * response, COLUMN, rng).values.copy()
            values[31, 20] = min(values[31, 20] + 400, int(WHITE))
            into.append(Mosaic(values=values, cfa="RGGB", black_level=BLACK, white_level=WHITE))
    dark = stack_frames(frames[0], drifts=False)
    noise = photon_transfer(dark, [stack_frames(frames[1000]), stack_frames(frames[2400])]).camera_noise
    assert noise.defects == ((31, 20, "hot"), (50, 71, "dead"))


def test_linearity_needs_exposure_times_and_sees_a_bent_camera():
    rng = np.random.default_rng(6)
    assert np.isnan(measure(white_target, rng).camera_noise.linearity_error.value).all()
    straight = measure(white_target, rng, times=True)
    assert (straight.camera_noise.linearity_error.value < 0.05).all()
    assert not any("linearity" in text for text in straight.warnings)
    assert "three exposure times" in " ".join(measure(white_target, rng, exposures=LEVELS[:2], times=True).warnings)
    picture = white_target(SHAPE, rng)
    dark = stack_frames(dark_frames(rng), drifts=False)
    times = LEVELS[1:]
    flats = [stack_frames(flat_frames(picture, x - 2e-5 * x**2, rng), exposure=x) for x in times]
    result = photon_transfer(dark, flats)
    bent = result.camera_noise.linearity_error.value[1]
    means = np.array([flat.strength[:, 1].mean() for flat in flats])
    line = np.polyfit(times, means, 1, w=1 / means)
    assert bent == pytest.approx(100 * np.abs(means / np.polyval(line, times) - 1).mean(), rel=0.02)
    assert bent > 0.5
    assert "the linearity error is" in " ".join(result.warnings)


def test_a_drifting_lamp_does_not_count_as_noise():
    rng = np.random.default_rng(7)
    picture = speckle_target(SHAPE, rng)
    dark = stack_frames(dark_frames(rng), drifts=False)
    flats = [
        stack_frames([expose(level * picture * strength, COLUMN, rng) for strength in (1, 1.04, 0.97)])
        for level in (800, 2000, 3000)
    ]
    result = photon_transfer(dark, flats)
    assert result.camera_noise.gain.value == pytest.approx(GAIN, rel=0.03)
    assert any("strength differs" in text for text in result.warnings)


def test_sensor_that_saturates_before_the_white_level_is_noticed():
    rng = np.random.default_rng(8)
    full_well = 2600
    picture = white_target(SHAPE, rng) / 0.8

    def limited(level):
        electrons = rng.poisson(np.maximum(level * picture, 0) * GAIN).clip(max=full_well * GAIN)
        values = np.rint((electrons + rng.normal(0, READ * GAIN, SHAPE)) / GAIN + BLACK).clip(0, WHITE)
        return Mosaic(values=values.astype(np.uint16), cfa="RGGB", black_level=BLACK, white_level=WHITE)

    dark = stack_frames(dark_frames(rng), drifts=False)
    flats = [stack_frames([limited(level) for _ in range(2)]) for level in (500, 1000, 1500, 2000, 4000)]
    result = photon_transfer(dark, flats)
    assert any("variance breaks down" in text for text in result.warnings)
    assert result.camera_noise.saturation.value == pytest.approx(full_well, rel=0.1)


def test_black_level_cut_off_is_reported():
    result = measure(white_target, np.random.default_rng(9), black=4.0)
    assert any("cut off" in text for text in result.warnings)


def test_mistakes_are_errors():
    rng = np.random.default_rng(10)
    picture = white_target(SHAPE, rng)
    dark = stack_frames(dark_frames(rng), drifts=False)
    flat = stack_frames(flat_frames(picture, 2000, rng))
    with pytest.raises(CalibrationError, match="at least two frames"):
        photon_transfer(dark, [stack_frames(flat_frames(picture, 2000, rng, count=1))])
    with pytest.raises(CalibrationError, match="no flat exposure"):
        photon_transfer(dark, [])
    with pytest.raises(CalibrationError, match="was a lamp on"):
        photon_transfer(stack_frames(flat_frames(picture, 2000, rng), drifts=False), [flat])
    with pytest.raises(CalibrationError, match="strengths differ by"):
        photon_transfer(dark, [stack_frames([expose(x * picture, COLUMN, rng) for x in (1000, 2000)])])
    with pytest.raises(CalibrationError, match="saturated or nearly so"):
        photon_transfer(dark, [stack_frames(flat_frames(picture * 0 + 1, 20000, rng))])
    with pytest.raises(CalibrationError, match="192 x 96 px"):
        photon_transfer(dark, [stack_frames(flat_frames(picture[:96], 2000, rng))])
    turned = Mosaic(values=without_shot_noise(picture).values, cfa="BGGR", black_level=BLACK, white_level=WHITE)
    with pytest.raises(CalibrationError, match="all must come from the same camera"):
        stack_frames([without_shot_noise(picture), turned])
    with pytest.raises(CalibrationError, match="variance does not grow"):
        photon_transfer(dark, [stack_frames([without_shot_noise(picture) for _ in range(2)])])


def without_shot_noise(picture):
    values = np.rint(2000 * picture + BLACK).astype(np.uint16)
    return Mosaic(values=values, cfa="RGGB", black_level=BLACK, white_level=WHITE)


def test_file_keeps_the_figures(tmp_path):
    noise = measure(speckle_target, np.random.default_rng(11)).camera_noise
    Calibration(camera_noise=noise).write(tmp_path / "n.json")
    reread = Calibration.read(tmp_path / "n.json")
    assert reread.camera_noise.gain.value == pytest.approx(noise.gain.value)
    assert np.isnan(reread.camera_noise.prnu.value).all()
    assert reread.noise == noise.model
