"""Crosstalk from single-light captures: the matrix, its uncertainty, and mistakes that must not pass."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from calibration_scene import BLACK, MATRICES, WHITE, captures, expose, speckle_target, white_target

from rgbmidic.errors import CalibrationError
from rgbmidic.frames import read_frame
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.settings import BAYER_PATTERNS
from rgbmidic_calibration.captures import block_means
from rgbmidic_calibration.crosstalk import estimate_crosstalk

MATRIX = MATRICES[1.5]


def reduce(frames):
    return [block_means(frame) for frame in frames]


def estimate(lights, dark=(), **options):
    return estimate_crosstalk({name: reduce(frames) for name, frames in lights.items()}, reduce(dark), **options)


@pytest.fixture(scope="module")
def scene():
    return captures(MATRIX, np.random.default_rng(7), target=speckle_target, shape=(160, 192), count=2, darks=2)


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_planes_of_a_smooth_picture_have_the_same_block_mean(cfa):
    y, x = np.mgrid[0:101, 0:120]
    picture = (1000 + 10 * x + 4 * y + 0.05 * x * y).astype(np.uint16)
    exact = 1000 + 10 * x + 4 * y + 0.05 * x * y
    means = block_means(Mosaic(values=picture, cfa=cfa, black_level=0, white_level=65535))
    centres = means.centres
    expected = 1000 + 10 * centres[..., 0] + 4 * centres[..., 1] + 0.05 * centres[..., 0] * centres[..., 1]
    assert means.planes.shape[1:] == expected.shape
    rounding = np.abs(exact - picture).max()
    assert np.abs(means.planes - expected).max() < rounding


def test_block_is_saturated_when_a_single_sample_of_it_is():
    values = np.full((64, 64), 100, dtype=np.uint16)
    values[30, 40] = 4095
    marked = block_means(Mosaic(values=values, cfa="RGGB", black_level=0, white_level=4095)).saturated
    assert marked.sum() == 1
    assert marked[(30 - 2) // 16, (40 - 2) // 16]


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_matrix_is_found_on_white_and_speckled_targets(cfa, target):
    lights, dark = captures(MATRIX, np.random.default_rng(3), target=target, cfa=cfa)
    result = estimate(lights, dark)
    assert np.linalg.norm(result.crosstalk.matrix - MATRIX) < 0.002 * np.linalg.norm(MATRIX)
    assert result.warnings == ()
    assert (result.crosstalk.matrix.max(axis=0) == 1).all()


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_difference_of_the_greens_is_found_within_its_uncertainty(cfa):
    truth = Crosstalk(matrix=MATRIX, lights=("red", "green", "blue"), green_difference=[0.03, 0.0, -0.02])
    lights, dark = captures(truth.sites, np.random.default_rng(8), target=speckle_target, cfa=cfa, shape=(160, 192))
    result = estimate(lights, dark).crosstalk
    error = np.abs(result.green_difference - truth.green_difference)
    assert (error < 4 * result.green_difference_std).all()  # of twelve normal numbers none in a thousand runs
    assert (result.green_difference_std < 0.0022).all()  # .0015, of the texture
    assert np.abs(result.sites - truth.sites).max() < 0.002


def test_difference_of_the_greens_that_varies_over_the_field_is_reported():
    rng = np.random.default_rng(6)
    picture = 2000 * speckle_target((160, 192), rng)
    slope = 0.05 * np.linspace(-1, 1, 192) * np.array([0, 1, -1, 0])[:, None, None]
    sites = (np.insert(MATRIX[:, 0], 1, MATRIX[1, 0])[:, None, None] + slope) * picture
    lights = {"red": [expose(sites, np.ones(4), rng) for _ in range(2)]}
    result = estimate(lights, [expose(0 * picture, np.ones(3), rng) for _ in range(2)])
    (said,) = [text for text in result.warnings if "greens" in text]
    rms = 100 * 0.05 / np.sqrt(3) * np.abs(result.crosstalk.unmixing[:, 1]).max()  # half of their difference
    assert float(re.search(r"of ([\d.]+) %", said)[1]) == pytest.approx(rms, rel=0.1)
    assert result.crosstalk.field is None


def test_real_sensor_has_two_greens(real_data):
    """Of its four sites: the greens in rows with blue, which come first in GBRG, see more red and less blue."""
    folder = real_data("real_disks_three_bands")
    files = {"red": "650nm_250ms", "green": "550nm_25ms", "blue": "450nm_50ms"}
    lights = {name: [read_frame(folder / f"disks_{file}.tif", cfa="GBRG")] for name, file in files.items()}
    result = estimate(lights, [read_frame(folder / f"dark_250ms_{index}.tif", cfa="GBRG") for index in (0, 1)])
    first, second = result.crosstalk.sites[[2, 1]]
    ratio = first / second
    std = result.crosstalk.green_difference_std / second
    for light, name in enumerate(files):
        planes = lights[name][0].values.astype(float)
        exact = planes[0::2, 0::2].mean() / planes[1::2, 1::2].mean()
        assert ratio[light] == pytest.approx(exact, abs=0.003 + 3 * std[light])
    assert ratio == pytest.approx([1.157, 1.001, 0.949], abs=0.003)


def test_matrix_of_a_three_chip_camera():
    rng = np.random.default_rng(5)
    picture = 2000 * speckle_target((128, 128), rng)
    lights = {n: [expose(picture, MATRIX[:, i], rng, kind="rgb")] for i, n in enumerate(("red", "green", "blue"))}
    dark = [expose(0 * picture, MATRIX[:, 0], rng, kind="rgb") for _ in range(2)]
    result = estimate(lights, dark).crosstalk
    assert np.abs(result.matrix - MATRIX).max() < 5 * result.std.max() < 0.002
    assert result.green_difference is None


def test_two_lights_and_other_names():
    lights, dark = captures(MATRIX[:, [0, 2]], np.random.default_rng(5), shape=(128, 128))
    result = estimate({"far red": lights["red"], "ultraviolet": lights["green"]}, dark)
    assert result.crosstalk.lights == ("far red", "ultraviolet")
    assert result.crosstalk.matrix == pytest.approx(MATRIX[:, [0, 2]], abs=1e-3)
    assert "green" in result.warnings[0]


def test_noise_does_not_attenuate_the_ratio():
    rng = np.random.default_rng(11)
    picture = np.full((256, 256), 40.0)
    lights = {"red": [expose(picture, MATRIX[:, 0], rng, read=30.0) for _ in range(8)]}
    dark = [expose(0 * picture, MATRIX[:, 0], rng, read=30.0) for _ in range(8)]
    result = estimate(lights, dark, allow=["weak"]).crosstalk
    assert np.abs(result.matrix - MATRIX[:, :1]).max() < 4 * result.std.max() < 0.02
    first = block_means(lights["red"][0]).channels
    slope = np.polyfit(first[0].ravel(), first[1].ravel(), 1)[0]
    assert abs(slope - MATRIX[1, 0]) > 0.05


def test_saturated_blocks_are_left_out(scene):
    lights, dark = scene
    rng = np.random.default_rng(2)
    picture = 3000 * speckle_target((160, 192), rng) / 0.8
    picture[:60, :80] *= 2.2
    result = estimate({**lights, "red": [expose(picture, MATRIX[:, 0], rng) for _ in range(4)]}, dark)
    assert result.lights[0].weights.mean() + result.lights[0].rejected_fraction < 0.9
    assert np.abs(result.crosstalk.matrix - MATRIX).max() < 1.5e-3


def test_coloured_spots_on_the_target_are_rejected():
    rng = np.random.default_rng(4)
    picture = 2000 * white_target((256, 256), rng)
    channels = MATRIX[:, 0, None, None] * picture
    channels[1, 40:80, 100:140] *= 2.5
    lights = {"red": [expose(channels, np.ones(3), rng) for _ in range(2)]}
    result = estimate(lights, [expose(0 * picture, MATRIX[:, 0], rng) for _ in range(2)])
    assert result.lights[0].rejected_fraction > 0.02
    assert np.abs(result.crosstalk.matrix - MATRIX[:, :1]).max() < 2e-4


def test_without_dark_frames_the_black_level_is_used_and_said(scene):
    lights, _ = scene
    result = estimate(lights)
    assert "no dark frames" in result.warnings[0]
    assert result.crosstalk.std[1, 0] > 2e-4
    assert np.abs(result.crosstalk.matrix - MATRIX).max() < 2e-3


def test_ambient_light_is_taken_out_by_the_dark_frames():
    rng = np.random.default_rng(9)
    lights, _ = captures(MATRIX, rng, shape=(160, 160), black=100.0)
    as_stated = {n: [relevel(f, 64.0) for f in fs] for n, fs in lights.items()}
    dark = [relevel(expose(np.zeros((160, 160)), MATRIX[:, 0], rng, black=100.0), 64.0) for _ in range(4)]
    result = estimate(as_stated, dark)
    assert np.abs(result.crosstalk.matrix - MATRIX).max() < 5e-4
    assert "ambient" in result.warnings[0]


def relevel(frame, black):
    return Mosaic(values=frame.values, cfa=frame.cfa, black_level=black, white_level=frame.white_level)


def swap(lights, first, second):
    return {**lights, first: lights[second], second: lights[first]}


def wrong_cfa(frames, cfa):
    return [Mosaic(values=f.values, cfa=cfa, black_level=BLACK, white_level=WHITE) for f in frames]


def test_swapped_lights_are_an_error(scene):
    lights, dark = scene
    with pytest.raises(CalibrationError, match="light red is seen best by the green channel"):
        estimate(swap(lights, "red", "green"), dark)
    assert estimate(swap(lights, "red", "green"), dark, allow=["name"]).crosstalk.matrix[1, 0] == 1


@pytest.mark.parametrize("cfa", ["GRBG", "GBRG", "BGGR"])
def test_wrong_pattern_is_an_error(scene, cfa):
    lights, dark = scene
    with pytest.raises(CalibrationError, match="colour filter array"):
        estimate({n: wrong_cfa(f, cfa) for n, f in lights.items()}, wrong_cfa(dark, cfa))


def test_one_light_twice_is_an_error(scene):
    lights, dark = scene
    with pytest.raises(CalibrationError, match="both seen best by the red channel"):
        estimate({"one": lights["red"], "two": lights["red"]}, dark)


def test_lit_dark_frames_are_an_error(scene):
    lights, _ = scene
    with pytest.raises(CalibrationError, match="dark frames are not dark"):
        estimate(lights, lights["red"])


def test_one_lit_dark_frame_is_an_error(scene):
    lights, dark = scene
    with pytest.raises(CalibrationError, match="capture 3 of the dark frames"):
        estimate(lights, [*dark, lights["red"][0]])


def test_lamp_that_was_off_is_an_error(scene):
    lights, dark = scene
    with pytest.raises(CalibrationError, match=r"light green gives .* was the lamp on"):
        estimate({**lights, "green": dark}, dark)


def test_saturated_captures_are_an_error(scene):
    lights, dark = scene
    white = Mosaic(values=np.full((160, 192), WHITE), cfa="RGGB", black_level=BLACK, white_level=WHITE)
    with pytest.raises(CalibrationError, match="light blue: 100 % of the blocks hold saturated samples"):
        estimate({**lights, "blue": [white]}, dark)


def test_clipping_below_the_stated_white_level_is_an_error():
    rng = np.random.default_rng(1)
    frame = expose(np.full((160, 192), 6000.0), MATRIX[:, 0], rng)
    stated = Mosaic(values=frame.values, cfa="RGGB", black_level=BLACK, white_level=5000)
    with pytest.raises(CalibrationError, match="pile up at 4095"):
        estimate({"red": [stated]})


def test_captures_of_different_sizes_are_an_error(scene):
    lights, dark = scene
    small = [Mosaic(values=f.values[:128], cfa=f.cfa, black_level=BLACK, white_level=WHITE) for f in lights["blue"]]
    means = {name: reduce(frames) for name, frames in lights.items()}
    means["blue"] = [block_means(frame, name=f"b{index}.tif") for index, frame in enumerate(small)]
    with pytest.raises(CalibrationError, match=r"capture 1 of light blue \(b0.tif\) is 192 x 128 px"):
        estimate_crosstalk(means, reduce(dark))


def test_a_file_of_another_light_among_the_captures_is_an_error(scene):
    lights, dark = scene
    mixed = [*lights["red"], lights["green"][0]]
    with pytest.raises(CalibrationError, match="capture 3 of light red has another colour"):
        estimate({**lights, "red": mixed}, dark)


def test_a_blurred_capture_is_reported(scene):
    from scipy import ndimage

    rng = np.random.default_rng(7)
    picture = 2000 * speckle_target((160, 192), rng)
    blurred = ndimage.gaussian_filter(picture, 3)
    frames = [expose(p, MATRIX[:, 0], rng) for p in (picture, picture, blurred)]
    result = estimate({"red": frames}, scene[1])
    assert any("capture 3 of light red is less sharp" in text for text in result.warnings)
    assert np.abs(result.crosstalk.matrix - MATRIX[:, :1]).max() < 1e-3


def test_monochrome_and_unknown_checks_are_errors(scene):
    lights, dark = scene
    with pytest.raises(CalibrationError, match="no colour channels"):
        block_means(ChannelFrame(values=np.zeros((1, 99, 99), np.uint16), black_level=0, white_level=255))
    with pytest.raises(CalibrationError, match="unknown check nonsense"):
        estimate(lights, dark, allow=["nonsense"])


def test_drifting_colour_is_covered_by_the_uncertainty():
    rng = np.random.default_rng(8)
    picture = 2000 * white_target((128, 128), rng)
    greens = MATRIX[1, 0] + rng.normal(0, 0.003, 4)
    frames = [expose(picture, (MATRIX[0, 0], green, MATRIX[2, 0]), rng) for green in greens]
    result = estimate({"red": frames}, [expose(0 * picture, MATRIX[:, 0], rng) for _ in range(3)])
    assert any("colour drifts" in text for text in result.warnings)
    assert 5e-4 < result.crosstalk.std[1, 0] < 5e-3


def test_file_keeps_matrix_and_covariance(scene, tmp_path):
    lights, dark = scene
    result = estimate(lights, dark).crosstalk
    Calibration(crosstalk=result).write(tmp_path / "c.json")
    reread = Calibration.read(tmp_path / "c.json").crosstalk
    assert (reread.matrix == result.matrix).all()
    assert (reread.covariance == result.covariance).all()
    assert reread.std == pytest.approx(result.std)
    assert (reread.sites == result.sites).all()
    assert (reread.green_difference_std == result.green_difference_std).all()


def test_file_of_three_rows_is_one_of_equal_greens(tmp_path):
    Calibration(crosstalk=Crosstalk(matrix=MATRIX, lights=("r", "g", "b"))).write(tmp_path / "c.json")
    document = json.loads((tmp_path / "c.json").read_text())
    for key in ("green_difference", "green_difference_std"):
        document["crosstalk"].pop(key, None)
    (tmp_path / "c.json").write_text(json.dumps(document))
    read = Calibration.read(tmp_path / "c.json")
    assert (read.crosstalk.sites == MATRIX[[0, 1, 1, 2]]).all()
    for wrong, reason in (
        ({"green_difference": [0.1, 0.2]}, "one finite number per light"),
        ({"green_difference_std": [0.1, 0.2, 0.1]}, "belongs to a green_difference"),
        ({"green_difference": [0.1, 0.2, 0], "green_difference_std": [-1, 0, 0]}, "not negative"),
    ):
        changed = {**document, "crosstalk": {**document["crosstalk"], **wrong}}
        (tmp_path / "c.json").write_text(json.dumps(changed))
        with pytest.raises(CalibrationError, match=f"c.json is damaged: .*{reason}"):
            Calibration.read(tmp_path / "c.json")


def varying_capture(picture, rng):
    """Red light whose green entry grows from .14 at the centre to .154 half way to the corners, and leans in x."""
    y, x = np.mgrid[-1 : 1 : picture.shape[0] * 1j, -1 : 1 : picture.shape[1] * 1j]
    green = 0.14 + 0.014 * (x**2 + y**2) + 0.004 * x
    channels = np.stack([picture, green * picture, 0.03 * picture])
    return expose(channels, np.ones(3), rng), green


@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_matrix_that_varies_over_the_field_is_found_where_the_data_ask_for_it(target):
    rng = np.random.default_rng(12)
    picture = 2500 * target((320, 320), rng)
    frames = [varying_capture(picture, rng)[0] for _ in range(4)]
    truth = varying_capture(picture, rng)[1]
    result = estimate({"red": frames}, [expose(0 * picture, MATRIX[:, 0], rng) for _ in range(4)]).crosstalk
    assert result.field.order == 2
    points = np.stack(np.meshgrid(np.arange(0, 320, 20), np.arange(0, 320, 20)), axis=-1)
    assert np.abs(result.at(points)[..., 1, 0] - truth[::20, ::20]).max() < 2e-3
    assert result.matrix[1, 0] == pytest.approx(truth.mean(), abs=3e-4)


def test_constant_matrix_gets_no_field(scene):
    lights, dark = scene
    result = estimate(lights, dark)
    assert result.crosstalk.field is None
    assert all(variation.p_value > 1e-4 for variation in result.variations)
    forced = estimate(lights, dark, order=2).crosstalk
    assert np.abs(forced.field.coefficients / np.where(forced.field.std > 0, forced.field.std, np.inf)).max() < 5


def test_dark_frames_of_other_settings_are_reported_on_a_textured_target(scene):
    lights, _ = scene
    rng = np.random.default_rng(6)
    dark = [expose(np.zeros((160, 192)), MATRIX[:, 0], rng, black=BLACK + 15) for _ in range(2)]
    dark = [relevel(frame, BLACK) for frame in dark]
    result = estimate(lights, dark)
    assert any("where the light is absent" in text for text in result.warnings)


def test_field_survives_the_file(tmp_path):
    rng = np.random.default_rng(12)
    picture = 2500 * white_target((160, 160), rng)
    result = estimate({"red": [varying_capture(picture, rng)[0] for _ in range(2)]}, order=1).crosstalk
    Calibration(crosstalk=result).write(tmp_path / "c.json")
    reread = Calibration.read(tmp_path / "c.json").crosstalk
    assert (reread.at([[0, 0], [3, 99]]) == result.at([[0, 0], [3, 99]])).all()
