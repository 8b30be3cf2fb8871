"""What raw samples tell of frames that cannot be measured: no texture, dark, saturated, levels in the wrong bits."""

from __future__ import annotations

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from small_tests import SHAPE, colour_test, grey_frame, toml
from textures import Texture

from rgbmidic import Status, measure, read_frame, read_test
from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.images import local_mean
from rgbmidic.pipeline.frame_quality import check_texture, exposure_fault, neighbour_correlation

INSIDE = np.zeros(SHAPE, dtype=bool)
INSIDE[16:129, 16:129] = True
GREY = 'path = "*.tif"\nkind = "monochrome"\nblack_level = 64\nwhite_level = 4095\n'


def noise(seed=0, sigma=20.0, mean=2000.0):
    return mean + np.random.default_rng(seed).normal(scale=sigma, size=SHAPE)


def mosaic(values):
    return Mosaic(
        values=np.rint(values).astype(np.uint16), cfa="RGGB", black_level=np.full((2, 2), 64), white_level=4095
    )


def channels(*values):
    return ChannelFrame(
        values=np.rint(values).astype(np.uint16), black_level=np.full(len(values), 64), white_level=4095
    )


def shading():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 1 + 0.3 * np.cos(x / 200) * np.cos(y / 200)


@pytest.mark.parametrize(
    "frame",
    [
        mosaic(noise()),
        mosaic(noise() * shading()),
        channels(noise()),
        channels(noise() * shading()),
        channels(noise(1), noise(2), noise(3)),
        channels(np.full(SHAPE, 2000.0)),
        mosaic(np.full(SHAPE, 2000.0)),
    ],
)
def test_noise_with_or_without_shading_does_not_correlate(frame):
    assert abs(neighbour_correlation(frame, INSIDE)) < 0.03
    with pytest.raises(FrameError, match=r"reference \(f0\) correlate by -?0\.0.*no texture above the noise"):
        check_texture((frame,), INSIDE, "f0")


def test_texture_correlates_however_it_is_sampled():
    texture = 10 * Texture.random(0).image(SHAPE) + 64
    others = [10 * Texture.random(seed).image(SHAPE) + 64 for seed in (1, 2)]
    for frame in (mosaic(texture), channels(texture), channels(texture, *others)):
        assert neighbour_correlation(frame, INSIDE) > 0.5
        check_texture((frame,), INSIDE, "f0")
    # noise of the same variance halves it
    contrast = float((texture - local_mean(texture.astype(np.float32), 5.0)).std())
    alone, noisy = (neighbour_correlation(channels(texture + n * noise(0, contrast, 0)), INSIDE) for n in (0, 1))
    assert noisy == pytest.approx(alone / 2, rel=0.05)


def test_a_small_region_of_a_large_frame_counts_alone():
    values = np.full((2000, 2000), 2000.0)
    values[901:942, 701:741] += 0.04 * Texture.random(0).image((41, 40))  # a standard deviation of 2 grey levels
    inside = np.zeros(values.shape, dtype=bool)
    inside[901:942, 701:741] = True
    for frame in (mosaic(values), channels(values)):
        assert neighbour_correlation(frame, inside) > 0.5


def test_what_lies_outside_the_region_or_is_saturated_does_not_count():
    values = noise()
    values[:, 129:] = 10 * Texture.random(0).image(SHAPE)[:, 129:] + 64
    values[40:60, 40:60] = 4095
    assert abs(neighbour_correlation(channels(values), INSIDE)) < 0.03


def test_little_texture_is_a_warning(caplog):
    texture = 10 * Texture.random(0).image(SHAPE)
    faint = channels(0.4 * (texture - texture.mean()) + noise(0, float(texture.std())))
    with caplog.at_level(logging.WARNING, logger="rgbmidic.pipeline"):
        check_texture((channels(texture),), INSIDE, "f0")
        assert not caplog.records
        check_texture((channels(texture), faint), INSIDE, "f0 + f1")
    (line,) = caplog.messages
    assert "its contrast is hardly above the noise" in line


@pytest.mark.parametrize("kind", ["bayer", "monochrome"])
def test_a_reference_of_noise_stops_the_job_before_the_first_frame(tmp_path, kind):
    if kind == "bayer":
        test = colour_test(tmp_path)
        write_dng(test.frames[0], mosaic(noise()))
        settings = test.settings()
    else:
        for index in range(2):
            write_tiff(tmp_path / f"{index}.tif", channels(noise(index)))
        (tmp_path / "TEST.toml").write_text(toml(GREY))
        settings = read_test(tmp_path / "TEST.toml")
    with pytest.raises(FrameError, match="no texture above the noise"):
        measure(settings, tmp_path / "result")
    assert not (tmp_path / "result").exists()


FAULTS = {
    "zero": (lambda values: 0 * values, "100% of the samples in the region are dark.* the largest is 0"),
    "black": (lambda values: 0 * values + 64, "100% of the samples in the region are dark"),
    "dark": (lambda values: 64 + (values - 64) // 200, "dark: within 1% of the dynamic range from the black level 64"),
    "saturated": (
        lambda values: 0 * values + 4095,
        r"100% of the samples in the region are saturated \(white_level 4095",
    ),
    "shifted": (lambda values: 16 * values, "all multiples of 16, .*white_level is 4095: should it be 65520"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", ["bayer", "monochrome"])
@pytest.mark.parametrize("index", [0, 1])
def test_a_frame_exposed_wrongly_says_how(tmp_path, fault, kind, index):
    change, message = FAULTS[fault]
    if kind == "bayer":
        test = colour_test(tmp_path, suffix=".tif")
        settings, file = test.settings(), test.frames[index]
        frame = read_frame(file, cfa="RGGB", black_level=64, white_level=4095)
    else:
        for number in range(2):
            write_tiff(tmp_path / f"{number}.tif", grey_frame(0, (0.3 * number, 0.0), noise_seed=number))
        (tmp_path / "TEST.toml").write_text(toml(GREY))
        settings, file = read_test(tmp_path / "TEST.toml"), tmp_path / f"{index}.tif"
        frame = read_frame(file, kind="monochrome", black_level=64, white_level=4095)
    write_tiff(file, replace(frame, values=change(frame.values)))
    if index == 0:
        with pytest.raises(FrameError, match=message):
            measure(settings, tmp_path / "result")
        return
    result = measure(settings, tmp_path / "result")
    assert result.status[:2].tolist() == [Status.CONVERGED, Status.FAILED]
    assert np.char.count(result.reasons[1], "\n") == 0

    assert re.search(message, result.reasons[1])


def test_a_good_frame_has_no_fault_and_each_light_is_told():
    good, dark = grey_frame(0, (0.0, 0.0)), channels(np.full(SHAPE, 70.0))
    assert exposure_fault((good,), INSIDE) is None
    assert exposure_fault((good, dark), INSIDE).startswith("light 2: 100% of the samples in the region are dark")


def too_fine_a_mesh(folder, sigma, size):
    """Frames of speckle of 5.7 px, contrast 500 DN and noise of `sigma`, with elements of `size`."""
    for index in range(2):
        write_tiff(folder / f"{index}.tif", grey_frame(1, (0.6 * index, 0.2 * index), noise_seed=index, sigma=sigma))
    (folder / "TEST.toml").write_text(toml(GREY) + f"[mesh]\nelement_size = {size}\n", encoding="utf-8")
    return read_test(folder / "TEST.toml")


@pytest.mark.parametrize("sigma", [160.0, 200.0])
def test_a_frame_that_does_not_converge_says_that_its_elements_are_too_small(tmp_path, sigma, caplog):
    with caplog.at_level(logging.WARNING):
        result = measure(too_fine_a_mesh(tmp_path, sigma, 5), tmp_path / "out")
    cause = "elements of 5 px are too small for speckles of 5.[5-9] px: .* set mesh.element_size to 12 or more"
    assert result.status[1] != Status.CONVERGED
    assert re.search(cause, result.reasons[1])
    assert "no start found" not in result.reasons[1]
    start, frame, *more = (record.message for record in caplog.records)
    assert re.match(cause, start)
    assert re.search(cause, frame)
    assert not more


def test_elements_that_hold_enough_speckles_are_not_told(tmp_path, caplog):
    with caplog.at_level(logging.WARNING):
        result = measure(too_fine_a_mesh(tmp_path, 120.0, 12), tmp_path / "out")
    assert result.status[1] == Status.CONVERGED
    assert result.reasons == ("", "")
    assert not caplog.records


def test_the_reason_names_the_node_that_still_moves(tmp_path):
    """In px of the whole frame, of which the region is a corner."""
    for index in range(2):
        write_tiff(tmp_path / f"{index}.tif", grey_frame(1, (0.6 * index, 0.0), noise_seed=index, shape=(800, 900)))
    text = f"[frames]\n{GREY}[region]\nrectangle = [790, 690, 850, 750]\n[solver]\nmax_iterations = 1\n"
    (tmp_path / "TEST.toml").write_text(text, encoding="utf-8")
    result = measure(read_test(tmp_path / "TEST.toml"), tmp_path / "out")
    assert result.status[1] == Status.NOT_CONVERGED
    x, y, motion = map(float, re.search(r"x (\d+), y (\d+): by ([\d.]+) px", result.reasons[1]).groups())
    assert np.hypot(*(result.nodes - [x, y]).T).min() < 1
    assert motion == pytest.approx(next(result.iterate("history", [1]))[-1], rel=0.01)
    assert "solver.max_iterations is 1: allow more" in result.reasons[1]


def test_a_light_that_fails_is_told_as_the_cause(tmp_path):
    for index, light in enumerate((1.0, 0.02)):
        frame = grey_frame(1, (0.3, 0.0), noise_seed=index, sigma=0.0)
        dim = 64 + light * (frame.values - 64.0) + 400 * index  # stray light keeps it from being dark
        noisy = dim + np.random.default_rng(index).normal(scale=60.0, size=dim.shape)
        write_tiff(tmp_path / f"{index}.tif", replace(frame, values=np.rint(noisy).clip(0, 4095).astype(np.uint16)))
    (tmp_path / "TEST.toml").write_text(toml(GREY), encoding="utf-8")
    result = measure(read_test(tmp_path / "TEST.toml"), tmp_path / "out")
    assert result.status[1] != Status.CONVERGED
    assert re.search("light shows the speckle with 1?[0-9]% of its contrast", result.reasons[1])
