"""Frames that are what was calibrated pass, and those that are not are refused, doubted or cannot be told."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from colour_scenes import CROSSTALK, NOISE, A, sparkle, speckle
from small_tests import colour_test

from rgbmidic.errors import ConfigurationError, FrameError
from rgbmidic.frames import open_series
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.frames.images import write_dng
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import QUANTISATION, NoiseModel
from rgbmidic.illumination.plane_samples import unevenness
from rgbmidic.pipeline import measure
from rgbmidic.tools.preparation.frame_check import check_state, contradictions

BLACK, WHITE, SHAPE = 64, 4095, (288, 288)
CALIBRATION = Calibration(crosstalk=CROSSTALK, noise=NOISE, unevenness=0.0)
INSIDE = np.ones(SHAPE, dtype=bool)


def lights(diameter=6.0, powers=(1.0, 1.0, 1.0), glare=0.0):
    """Lights (3, H, W) in DN on speckle of sharp discs; `glare` of the green one."""
    images = 1500 * speckle(SHAPE, diameter=diameter, seed=1) * np.reshape(powers, (3, 1, 1))
    images[1] += sparkle(SHAPE, glare, 5)
    return images


def recorded(images, *, matrix=A, noise=NOISE, cfa="RGGB", black=BLACK, change=None, seed=0):
    """A raw mosaic, said to be RGGB with the calibrated levels; `change` acts on its whole samples above black."""
    channels = np.tensordot(matrix, images, axes=1)
    values = np.empty(SHAPE)
    for (row, column), channel in np.ndenumerate(cfa_channels(cfa)):
        values[row::2, column::2] = channels[channel, row::2, column::2]
    values += np.random.default_rng(seed).normal(size=SHAPE) * np.sqrt(noise.variance(values))
    values = np.clip(np.rint(values), -BLACK, WHITE - BLACK)
    stored = np.clip(np.rint(change(values) if change else values) + black, 0, WHITE).astype(np.uint16)
    return Mosaic(values=stored, cfa="RGGB", black_level=np.array(BLACK), white_level=WHITE)


def found(frame, calibration=CALIBRATION, repeat=None):
    """The checks that find something, with whether they are certain."""
    return {one.name: not one.passed for one in contradictions(frame, calibration, INSIDE, repeat)}


def camera(**factors):
    return replace(NOISE, **{name: getattr(NOISE, name) * factor for name, factor in factors.items()})


@pytest.mark.parametrize("diameter", [2.5, 4.2, 8.0])
@pytest.mark.parametrize("power", [0.1, 1.0, 2.5])
@pytest.mark.parametrize("glare", [0.0, 1200.0])
def test_good_frames_pass(diameter, power, glare):
    images = power * lights(diameter, glare=glare)
    frame, repeat = (recorded(images, seed=seed) for seed in (0, 1))
    for calibration in (CALIBRATION, Calibration(crosstalk=CROSSTALK), Calibration(noise=NOISE), Calibration()):
        assert found(frame, calibration) == {}
        assert found(frame, calibration, repeat) == {}


def test_samples_in_the_high_bits_pass():
    low = NoiseModel(gain=1500.0, read_noise=0.3)  # about one grey level, rounding included
    frame, repeat = (recorded(lights(8.0), noise=low, seed=seed) for seed in (0, 1))
    high = [
        replace(one, values=16 * one.values, black_level=16 * one.black_level, white_level=65520)
        for one in (frame, repeat)
    ]
    noise = NoiseModel(gain=low.gain / 16, read_noise=16 * np.hypot(low.read_noise, QUANTISATION**0.5))
    assert found(high[0], replace(CALIBRATION, noise=noise)) == {}
    assert found(high[0], replace(CALIBRATION, noise=noise), high[1]) == {}


def test_a_camera_with_a_table_of_its_own_passes():
    """Steps of about the noise: differences take few values, and their count tells nothing of it."""
    noise = camera(gain=6)
    pair = [recorded(lights(8.0), noise=noise, change=TABLES["8-bit root"], seed=seed) for seed in (0, 1)]
    assert found(pair[0], replace(CALIBRATION, noise=noise, unevenness=2.0), pair[1]) == {}


def test_less_noise_than_calibrated_is_certain_in_one_frame_and_more_is_doubtful_in_two():
    images = lights(8.0)
    quieter, louder = camera(gain=4, read_noise=0.5), camera(gain=0.5, read_noise=2)
    assert found(recorded(images, noise=quieter)) == {"noise": True}
    assert found(recorded(images, noise=louder)) == {}  # one frame cannot tell noise from texture
    pair = [recorded(images, noise=louder, seed=seed) for seed in (0, 1)]
    assert found(pair[0], repeat=pair[1]) == {"noise": False}
    small = [recorded(lights(2.5, glare=1200.0), noise=camera(gain=2), seed=seed) for seed in (0, 1)]
    assert found(small[0]) == {}
    assert found(small[0], repeat=small[1]) == {"noise": True}
    assert found(small[0], repeat=small[0]) == {}  # the same frame, stored twice
    moved = recorded(np.roll(lights(2.5, glare=1200.0), 1, axis=2), noise=camera(gain=2), seed=2)
    assert found(small[0], repeat=moved).get("noise") is not True


@pytest.mark.parametrize(("powers", "greens", "name"), [((1.0, 1.0, 0.5), 0.0, ""), ((1.0, 1.0, 1.0), 0.02, "greens")])
@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_a_window_moved_by_a_row_and_a_column_is_found_by_lamps_or_greens_that_differ(powers, greens, name, cfa):
    """What is stored at a site of red is then of blue, and the greens are exchanged, too."""
    images, sites = lights(powers=powers), np.repeat(A, [1, 2, 1], axis=0)
    sites[1:3, 0] += [greens / 2, -greens / 2]
    levels = images.mean(axis=(1, 2))
    crosstalk = replace(CROSSTALK, light_levels=levels * [1.1, 1, 1], green_difference=np.array([greens, 0, 0]))
    calibration = Calibration(crosstalk=crosstalk, noise=NOISE, cfa=cfa)
    for moved in (0, 1):
        cell = np.roll(cfa_channels(cfa), (moved, moved), axis=(0, 1))
        cell = cell + (cell == 2) + ((cell == 1) & (cell == 2).any(axis=1, keepdims=True))
        y, x = np.indices(SHAPE)
        values = np.tensordot(sites, images, axes=1)[cell[y % 2, x % 2], y, x]
        values += np.random.default_rng(0).normal(size=SHAPE) * np.sqrt(NOISE.variance(values))
        stored = np.rint(values + BLACK).clip(0, WHITE).astype(np.uint16)
        frame = Mosaic(values=stored, cfa=cfa, black_level=np.array(BLACK), white_level=WHITE)
        checks = [one for one in contradictions(frame, calibration, INSIDE) if "exchanged" in one.text]
        assert [one.name for one in checks] == [name] * moved
        assert all(one.passed == (name == "") for one in checks)
        assert found(frame, replace(calibration, crosstalk=CROSSTALK)) == {}  # an older file cannot tell


def red(factor):
    def change(values):
        out = values.copy()
        out[::2, ::2] *= factor
        return out

    return change


RANGE = WHITE - BLACK
TABLES = {
    "white balance 1.05": red(1.05),
    "white balance .8": red(0.8),
    "white balance 2": red(2.0),
    "gamma": lambda values: RANGE * (np.maximum(values, 0) / RANGE) ** (1 / 1.2),
    "8-bit root": lambda values: (np.rint(255 * np.sqrt(np.maximum(values, 0) / RANGE)) / 255) ** 2 * RANGE,
}


@pytest.mark.parametrize("change", TABLES.values(), ids=TABLES)
def test_grey_levels_missing_or_doubled(change):
    frame = recorded(lights(), change=change)
    assert found(frame)["levels"] is True
    assert found(frame, Calibration(crosstalk=CROSSTALK, unevenness=0.0))["levels"] is True
    assert "levels" not in found(frame, Calibration(noise=NOISE))  # a file that does not say
    assert "levels" not in found(frame, replace(CALIBRATION, unevenness=0.5))  # the camera's own table


def test_unevenness_of_a_histogram():
    rng = np.random.default_rng(1)
    even = np.rint(rng.normal(1000, 60, 200_000)).astype(np.uint16)
    assert abs(unevenness(even)) < 0.003
    assert unevenness(even // 2 * 2) == pytest.approx(2, abs=0.3)
    assert unevenness(even + (even - 700) // 20) == pytest.approx(0.05, abs=0.01)
    assert unevenness(even // 2 * 2, step=2) < 0.003
    assert np.isnan(unevenness(even[:500]))


@pytest.mark.parametrize("cfa", ["GRBG", "GBRG"])
def test_a_wrong_phase_shows_in_the_greens(cfa):
    images = lights(4.2, powers=(1.0, 0.9, 0.6))
    assert found(recorded(images)) == {}
    assert found(recorded(images, cfa=cfa))["greens"] is True


def test_lights_that_another_crosstalk_makes_negative_or_mirrored():
    images = lights(4.2, powers=(0.15, 1.0, 1.0))
    much = Crosstalk(matrix=np.array([[1, 0.5, 0.3], [0.14, 1, 0.16], [0.03, 0.12, 1]]), lights=CROSSTALK.lights)
    assert found(recorded(images)) == {}
    (one,) = contradictions(recorded(images), replace(CALIBRATION, crosstalk=much), INSIDE)
    assert (one.name, one.passed) == ("lights", False)
    assert "light red is negative on 100% of the region" in one.text
    images[0] += 700  # of a plain light: red is positive, with the texture upside down
    (one,) = contradictions(recorded(images), replace(CALIBRATION, crosstalk=much), INSIDE)
    assert "light red is mirrored (dark for bright) on 100% of the region" in one.text


def test_samples_interpolated_from_a_mosaic():
    images = lights(4.2)
    colours = cv2.cvtColor(recorded(images).values, cv2.COLOR_BayerRGGB2RGB)
    three = ChannelFrame(values=np.moveaxis(colours, -1, 0), black_level=np.array(BLACK), white_level=WHITE)
    assert found(three, Calibration())["demosaiced"] is True
    resampled = np.empty(SHAPE, dtype=np.uint16)
    for (row, column), channel in np.ndenumerate(cfa_channels("GRBG")):
        resampled[row::2, column::2] = colours[row::2, column::2, channel]
    assert found(Mosaic(values=resampled, cfa="GRBG", black_level=BLACK, white_level=WHITE))["demosaiced"] is True
    channels = np.tensordot(A, images, axes=1)
    channels += np.random.default_rng(1).normal(size=channels.shape) * np.sqrt(NOISE.variance(channels))
    sensors = replace(three, values=np.rint(channels + BLACK).astype(np.uint16))
    assert found(sensors) == {}


@pytest.mark.parametrize("width", [2.4, 4.0])
def test_streaks_of_a_reflection_in_one_light_pass(width):
    """Twice and more as fine along one axis as along the other: refused as interpolated by second differences."""
    streaks = cv2.GaussianBlur(np.random.default_rng(0).normal(size=SHAPE), (0, 0), width, sigmaY=1.2)
    images = lights(4.2)
    images[0] += 1000 * np.maximum(streaks / streaks.std(), 0)
    assert found(recorded(images)) == {}


def test_what_is_accepted_is_told_and_what_is_unknown_refused():
    frame = recorded(lights(), change=red(1.2))
    with pytest.raises(FrameError, match=r"shot\.dng is not what was calibrated.*calibration\.accept = \[\"levels\"\]"):
        check_state([frame], CALIBRATION, INSIDE, "shot.dng")
    (told,) = check_state([frame], CALIBRATION, INSIDE, "shot.dng", accept=["levels"])
    assert (told.name, told.passed) == ("levels", False)
    with pytest.raises(ConfigurationError, match="accept takes noise, levels"):
        check_state([frame], CALIBRATION, INSIDE, "shot.dng", accept=["level"])


def test_a_run_refuses_such_a_reference_unless_it_is_accepted(tmp_path, caplog):
    test = colour_test(tmp_path / "test", [(0.0, 0.0), (0.3, 0.1)])
    settings = test.settings()
    frame = open_series(settings.frames, settings.base).read(0)[0]
    values = frame.values.astype(float)
    values[::2, ::2] = np.minimum((values[::2, ::2] - 64) * 1.3 + 64, 4095)
    write_dng(test.frames[0], replace(frame, values=np.rint(values).astype(np.uint16)))
    calibration = replace(Calibration.read(test.folder / "calibration.json"), unevenness=0.001)
    calibration.write(test.folder / "calibration.json")
    with pytest.raises(FrameError, match=r"frame_0\.dng is not what was calibrated: grey levels of R"):
        measure(settings, tmp_path / "result")
    assert not (tmp_path / "result").exists()
    measure(test.settings(calibration={"accept": ["levels"]}), tmp_path / "result")
    with pytest.raises(ConfigurationError, match=r"calibration\.accept.*must be one of \"noise\", \"levels\""):
        test.settings(calibration={"accept": ["level"]})
