"""The main job end to end on tiny virtual tests: every kind of frame, and everything that can go wrong with them."""

from __future__ import annotations

import json
import logging
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
import tifffile
from small_tests import REGION, SHAPE, colour_test, grey_frame, toml

from rgbmidic import Calibration, NodeStatus, Result, Status, measure, read_frame, read_test
from rgbmidic.correlation import TrackingState
from rgbmidic.correlation import reference_update as reference_update
from rgbmidic.errors import (
    CalibrationError,
    ConfigurationError,
    FrameError,
    InputError,
    RegionError,
    ResultError,
    RgbmidicError,
)
from rgbmidic.frames import FrameSeries, file_hash
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination import demosaicing as reflection_aware
from rgbmidic.illumination import separation
from rgbmidic.pipeline import Plan, measure_frame

BAYER_RMS = 0.015
"""px: Malvar demosaicing and the noise of a 12-bit camera on a plate without reflections."""
COLOUR_RMS = 0.008
"""px: three samples per pixel, no demosaicing."""
GREY_RMS = 0.01
"""px: one monochrome light, noise of 8 in a contrast of 500 grey levels."""


@pytest.fixture(scope="module")
def bayer(tmp_path_factory):
    return colour_test(tmp_path_factory.mktemp("bayer") / "test")


@pytest.fixture(scope="module")
def bayer_result(bayer, tmp_path_factory):
    return measure(bayer.settings(), tmp_path_factory.mktemp("bayer_result") / "result")


@pytest.fixture
def copy(bayer, tmp_path):
    """The Bayer test, free to be damaged: the function gives the path of frame `index` in the copy."""
    shutil.copytree(bayer.folder, tmp_path / "test")
    return lambda name: tmp_path / "test" / name


def settings_of(folder, frames, calibration="", **sections):
    (folder / "TEST.toml").write_text(toml(frames, calibration))
    settings = read_test(folder / "TEST.toml")
    if not sections:
        return settings
    return type(settings).from_mapping({**settings.to_mapping(), **sections}, folder)


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


def test_raw_bayer_frames_give_the_true_displacement(bayer, bayer_result):
    assert (bayer_result.status == Status.CONVERGED).all()
    assert (bayer_result.node_status == NodeStatus.MEASURED).all()
    assert bayer_result.lights == ("red", "green", "blue")
    assert bayer_result.names == ("frame_0.dng", "frame_1.dng", "frame_2.dng")
    np.testing.assert_array_equal(bayer_result.nodes.min(axis=0), REGION[:2])
    np.testing.assert_array_equal(bayer_result.nodes.max(axis=0), REGION[2:])
    error = bayer.error(bayer_result.nodes, bayer_result.u, bayer_result.v)
    assert rms(error[0]) < 1e-3
    assert rms(error) < BAYER_RMS
    assert (bayer_result.weight_fraction > 0).all()


def test_the_result_tells_where_it_comes_from(bayer, bayer_result):
    assert bayer_result.inputs == {str(path): file_hash(path) for path in bayer.frames}
    told = bayer_result.provenance
    assert told["calibration"]["sha256"] == file_hash(bayer.folder / "calibration.json")
    assert told["settings"]["mesh"]["element_size"] == 25
    assert told["finished"] >= told["created"]
    assert bayer_result.frame(1).weights_thumbnail.shape[0] == 3
    again = Result.open(bayer_result.path)
    np.testing.assert_array_equal(again.u, bayer_result.u)


def test_each_frame_tells_brightness_and_reflections(bayer_result):
    np.testing.assert_allclose(bayer_result.brightness[0], [[1, 0]] * 3, atol=1e-6)
    np.testing.assert_allclose(bayer_result.brightness[..., 0], 1, atol=0.05)
    index = bayer_result.frame(1).reflection_thumbnail
    assert index.shape[0] == 3
    assert index.mean() < 0.2 * 255  # a mat scene


def test_every_frame_is_told_as_it_finishes(bayer, tmp_path):
    told = []
    measure(bayer.settings(), tmp_path / "result", progress=lambda *state: told.append(state))
    assert [state[:2] for state in told] == [(1, 3), (2, 3), (3, 3)]
    assert all("converged" in line for _, _, line in told)


DAMAGE = {
    "header only": lambda content: content[:300],
    "truncated": lambda content: content[: len(content) * 2 // 3],
    "last row lost": lambda content: content[:-250],
    "empty": lambda content: b"",
    "text": lambda content: b"not a frame " * 500,
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_frame_is_recorded_and_the_rest_goes_on(bayer, bayer_result, copy, tmp_path, damage):
    damaged = copy("frames/frame_1.dng")
    damaged.write_bytes(DAMAGE[damage](damaged.read_bytes()))
    result = measure(read_test(copy("TEST.toml")), tmp_path / "result")
    assert result.status.tolist() == [Status.CONVERGED, Status.FAILED, Status.CONVERGED]
    assert "frame_1.dng" in result.reasons[1]
    assert np.isnan(result.u[1]).all()
    assert (result.node_status[1] != NodeStatus.MEASURED).all()
    assert rms(bayer.error(result.nodes, result.u, result.v)[2]) < BAYER_RMS
    np.testing.assert_allclose(result.u[2], bayer_result.u[2], atol=5e-3)


def test_a_wholly_saturated_frame_is_recorded_and_the_rest_goes_on(bayer, copy, tmp_path):
    frame = read_frame(copy("frames/frame_1.dng"))
    write_dng(copy("frames/frame_1.dng"), replace(frame, values=np.full(SHAPE, 4095, dtype=np.uint16)))
    result = measure(read_test(copy("TEST.toml")), tmp_path / "result")
    assert result.status.tolist() == [Status.CONVERGED, Status.FAILED, Status.CONVERGED]
    assert "no light sees" in result.reasons[1]
    assert np.isnan(result.v[1]).all()
    np.testing.assert_array_equal(result.weight_fraction[1], 0)


def test_a_saturated_spot_is_left_out_and_the_rest_measured(bayer, copy, tmp_path):
    frame = read_frame(copy("frames/frame_2.dng"))
    frame.values[50:100, 50:100] = 4095
    write_dng(copy("frames/frame_2.dng"), frame)
    result = measure(read_test(copy("TEST.toml")), tmp_path / "result")
    assert result.status[2] == Status.CONVERGED
    measured = result.node_status[2] == NodeStatus.MEASURED
    middle = (np.abs(result.nodes - 74) < 12).all(axis=1)
    assert middle.any()
    assert not measured[middle].any()
    assert np.isnan(result.u[2][~measured]).all()
    assert measured.mean() > 0.6
    assert rms(bayer.error(result.nodes, result.u, result.v)[2][measured]) < 2 * BAYER_RMS
    here = replace(bayer, folder=copy("TEST.toml").parent)
    filled = measure(here.settings(solver={"fill": 100}), tmp_path / "filled")
    assert (filled.node_status[2][~measured] == NodeStatus.FILLED).all()
    error = bayer.error(filled.nodes, filled.u, filled.v)[2]
    assert np.abs(error[~measured]).max() < 0.1
    assert filled.u_std[2][~measured].min() > np.median(filled.u_std[2][measured])
    np.testing.assert_array_equal(filled.u[2][measured], result.u[2][measured])


@pytest.mark.parametrize(
    ("sections", "error", "message"),
    [
        ({"frames": {"cfa": "BGGR"}}, FrameError, "cfa is stated as BGGR.*frame_0.dng states RGGB"),
        ({"frames": {"black_level": 80.0}}, FrameError, "black_level is stated as 80"),
        ({"frames": {"white_level": 4000.0}}, FrameError, "white_level is stated as 4000"),
        ({"frames": {"kind": "rgb"}}, FrameError, "kind is stated as rgb"),
        ({"frames": {"path": ["frames/*.png"]}}, FrameError, r"no file matches: frames/\*\.png"),
        ({"frames": {"reference": [7]}}, FrameError, "names frame 7, but there are 3"),
        ({"calibration": {"file": None}}, ConfigurationError, "calibration.file is missing"),
        ({"calibration": {"file": "absent.json"}}, CalibrationError, "not found: .*absent.json"),
        ({"region": {"rectangle": [500, 500, 600, 600]}}, RegionError, "does not overlap the image of 144 x 144 px"),
        ({"region": {"rectangle": [20, 20, 22, 22]}}, RegionError, "too small"),
        ({"region": {"rectangle": None, "mask": "absent.png"}}, FrameError, "not found: .*absent.png"),
        ({"illumination": {"demosaic": "magic"}}, RgbmidicError, "magic"),
        ({"mesh": {"element_size": 2.0}}, InputError, "at least 4 px"),
    ],
)
def test_wrong_settings_stop_before_anything_is_written(bayer, tmp_path, sections, error, message):
    with pytest.raises(error, match=message):
        measure(bayer.settings(**sections), tmp_path / "result")
    assert not (tmp_path / "result").exists()


def test_a_calibration_without_crosstalk_is_refused(copy, tmp_path):
    Calibration(cfa="RGGB").write(copy("calibration.json"))
    with pytest.raises(ConfigurationError, match="has no crosstalk"):
        measure(read_test(copy("TEST.toml")), tmp_path / "result")


def test_a_damaged_reference_stops_the_job(copy, tmp_path):
    frame = copy("frames/frame_0.dng")
    frame.write_bytes(frame.read_bytes()[:9000])
    with pytest.raises(FrameError, match=r"frame_0\.dng"):
        measure(read_test(copy("TEST.toml")), tmp_path / "result")
    assert not (tmp_path / "result").exists()


def test_frames_of_different_sizes_are_refused(tmp_path):
    for index, shape in enumerate([(144, 144), (144, 150)]):
        write_tiff(tmp_path / f"{index}.tif", grey_frame(0, (0, 0), shape=shape))
    with pytest.raises(FrameError, match=r"one size: .*1\.tif"):
        measure(settings_of(tmp_path, 'path = "*.tif"\nkind = "monochrome"'), tmp_path / "result")


def test_an_existing_result_is_not_overwritten_unless_asked(bayer, bayer_result, tmp_path):
    folder = tmp_path / "result"
    shutil.copytree(bayer_result.path, folder)
    (folder / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(ResultError, match="already holds a result"):
        measure(bayer.settings(), folder)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    replaced = measure(bayer.settings(mesh={"element_size": 50.0}), folder, overwrite=True)
    assert len(replaced.nodes) < len(bayer_result.nodes)
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_folder_in_use_is_refused_and_free_after_an_interruption(bayer, tmp_path):
    folder = tmp_path / "result"

    def second_run_then_stop(done, total, line):
        with pytest.raises(ResultError, match="in use by"):
            measure(bayer.settings(), folder, overwrite=True)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure(bayer.settings(), folder, progress=second_run_then_stop)
    assert Result.open(folder, partial=True).finished.tolist() == [True, False, False]
    assert len(measure(bayer.settings(), folder, overwrite=True)) == 3


def test_tiff_frames_take_pattern_and_levels_from_the_calibration(bayer_result, tmp_path):
    test = colour_test(tmp_path / "test", suffix=".tif")
    result = measure(test.settings(), tmp_path / "result")
    np.testing.assert_array_equal(result.u, bayer_result.u)
    np.testing.assert_array_equal(result.v, bayer_result.v)


def test_tiff_frames_without_any_pattern_are_refused(tmp_path):
    test = colour_test(tmp_path / "test", suffix=".tif")
    document = json.loads((test.folder / "calibration.json").read_text())
    del document["camera"]
    (test.folder / "calibration.json").write_text(json.dumps(document))
    with pytest.raises(FrameError, match=r"frame_0\.tif does not state its colour filter array"):
        measure(test.settings(), tmp_path / "result")


def test_three_channel_frames_need_no_demosaicing(tmp_path):
    test = colour_test(tmp_path / "test", kind="rgb", suffix=".tif")
    result = measure(test.settings(), tmp_path / "result")
    assert (result.status == Status.CONVERGED).all()
    assert result.lights == ("red", "green", "blue")
    assert rms(test.error(result.nodes, result.u, result.v)) < COLOUR_RMS


MOTIONS = [(0.0, 0.0), (0.4, -0.2), (1.6, 0.7)]
STATED = 'kind = "monochrome"\nblack_level = 64\nwhite_level = 4095\n'


def write_series(folder, texture, motions=MOTIONS, **noise):
    folder.mkdir()
    for index, shift in enumerate(motions):
        write_tiff(folder / f"frame_{index}.tif", grey_frame(texture, shift, noise_seed=index, **noise))


def test_one_monochrome_light_needs_no_calibration(tmp_path):
    write_series(tmp_path / "grey", 0)
    result = measure(settings_of(tmp_path, f'path = "grey"\n{STATED}'), tmp_path / "result")
    assert (result.status == Status.CONVERGED).all()
    assert len(result.lights) == 1
    np.testing.assert_allclose(result.u.mean(axis=1), [u for u, _ in MOTIONS], atol=3e-3)
    np.testing.assert_allclose(result.v.mean(axis=1), [v for _, v in MOTIONS], atol=3e-3)
    assert rms(result.u - np.array(MOTIONS)[:, :1]) < GREY_RMS


def test_lights_fired_in_succession_are_solved_together(tmp_path):
    write_series(tmp_path / "left", 0)
    write_series(tmp_path / "right", 1, [(0.0, 0.0), *((u + 0.5, v - 0.25) for u, v in MOTIONS[1:])])
    paths = f'path = ["left", "right/*.tif"]\n{STATED}'
    result = measure(settings_of(tmp_path, paths, solver={"rigid": "translation"}), tmp_path / "result")
    assert (result.status == Status.CONVERGED).all()
    assert len(result.lights) == 2
    assert result.names[1] == "frame_1.tif + frame_1.tif"
    assert rms(result.u - np.array(MOTIONS)[:, :1]) < GREY_RMS
    np.testing.assert_allclose(result.frame(2).rigid[1], (0.5, -0.25), atol=3e-3)
    assert len(result.inputs) == 6


def test_lights_in_turn_in_one_stack_give_what_two_series_give(tmp_path):
    write_series(tmp_path / "left", 0)
    write_series(tmp_path / "right", 1)
    names = [f"{light}/frame_{number}.tif" for number in range(3) for light in ("left", "right")]
    frames = [read_frame(tmp_path / name, kind="monochrome").values[0] for name in names]
    np.save(tmp_path / "stack.npy", np.stack(frames))
    two = measure(settings_of(tmp_path, f'path = ["left", "right"]\n{STATED}'), tmp_path / "two")
    one = measure(settings_of(tmp_path, f'path = "stack.npy"\nlights = 2\n{STATED}'), tmp_path / "one")
    assert (one.status == Status.CONVERGED).all()
    assert one.names[1] == "stack.npy frame 2 + stack.npy frame 3"
    for quantity in ("u", "v", "residual", "status"):
        np.testing.assert_array_equal(getattr(one, quantity), getattr(two, quantity))


def test_lights_in_succession_must_have_equally_many_frames(tmp_path):
    write_series(tmp_path / "left", 0)
    write_series(tmp_path / "right", 1, MOTIONS[:2])
    with pytest.raises(FrameError, match="equal numbers of frames; given are left: 3, right: 2"):
        measure(settings_of(tmp_path, f'path = ["left", "right"]\n{STATED}'), tmp_path / "result")


def test_averaged_reference_frames_lower_the_noise(tmp_path):
    write_series(tmp_path / "grey", 0, [(0.0, 0.0), (0.0, 0.0), (0.4, -0.2)], sigma=60.0)
    residual = [
        measure(
            settings_of(tmp_path, f'path = "grey"\n{STATED}reference = {reference}\n', weights={"method": "none"}),
            tmp_path / f"result_{len(reference)}",
        ).residual[2, 0]
        for reference in ([0], [0, 1])
    ]
    # sigma^2 (1 + 1/n) instead of 2 sigma^2
    assert residual[1] / residual[0] == pytest.approx(np.sqrt(0.75), rel=0.03)


def test_the_last_frame_is_the_start_of_the_next(tmp_path):
    motions = [(5.0 * i, -4.0 * i) for i in range(6)]
    write_series(tmp_path / "grey", 0, motions)
    text = f'path = "grey"\n{STATED}'
    settings = settings_of(tmp_path, text, region={"rectangle": [20, 45, 100, 125]})
    result = measure(settings, tmp_path / "result")
    assert (result.status == Status.CONVERGED).all()
    np.testing.assert_allclose(result.u[5], 25, atol=0.05)
    np.testing.assert_allclose(result.v[5], -20, atol=0.05)


def test_a_region_may_be_a_polygon_or_a_mask_image(tmp_path):
    write_series(tmp_path / "grey", 0)
    mask = np.zeros(SHAPE, dtype=np.uint8)
    mask[20:120, 30:90] = 255
    mask[50:80, 50:70] = 0
    tifffile.imwrite(tmp_path / "mask.tif", mask)
    text = f'path = "grey"\n{STATED}'
    for number, region in enumerate([{"polygon": [[20, 20], [120, 30], [70, 120]]}, {"mask": "mask.tif"}]):
        settings = settings_of(tmp_path, text, region=region, mesh={"element_size": 12})
        result = measure(settings, tmp_path / f"result_{number}")
        assert (result.status == Status.CONVERGED).all()
        assert rms(result.u[2] - MOTIONS[2][0]) < 3 * GREY_RMS
    inside = (result.nodes > (52, 52)).all(axis=1) & (result.nodes < (67, 77)).all(axis=1)
    assert not inside.any()


def test_a_mask_of_another_size_is_refused_by_name(tmp_path):
    write_series(tmp_path / "grey", 0, MOTIONS[:1])
    tifffile.imwrite(tmp_path / "mask.tif", np.ones((20, 30), dtype=np.uint8))
    with pytest.raises(RegionError, match=r"mask\.tif.*30, 20.*144, 144"):
        measure(settings_of(tmp_path, f'path = "grey"\n{STATED}', region={"mask": "mask.tif"}), tmp_path / "result")


def test_a_reference_that_no_light_sees_is_one_error(bayer, tmp_path):
    settings = bayer.settings()
    blind = {**settings.to_mapping(), "weights": {"method": "threshold", "threshold": 1e-6}}
    with pytest.raises(FrameError, match="no light sees the region in the reference"):
        measure(type(settings).from_mapping(blind, settings.base), tmp_path / "result")
    assert not (tmp_path / "result").exists()


def test_a_frame_measured_with_a_plan_from_another_process_gives_the_same_bits(bayer, bayer_result):
    plan = Plan.from_settings(bayer.settings())
    again = pickle.loads(pickle.dumps(plan))
    start = TrackingState(displacement=None)
    record, twin = (measure_frame(one, 1, start) for one in (plan, again))
    np.testing.assert_equal(record.values, twin.values)
    # nothing but the start ties a frame to the one before it
    at_rest = measure_frame(plan, 0, start)
    rest = start.extrapolate(
        plan.reference.mesh, np.stack([at_rest.u, at_rest.v], axis=1), at_rest.node_status == NodeStatus.MEASURED
    )
    np.testing.assert_equal(measure_frame(plan, 1, rest).values, bayer_result.frame(1).values)


def test_the_reference_is_read_linearised_and_modelled_once(bayer, monkeypatch):
    counts = dict.fromkeys(("read", "linearise", "gather_moments"), 0)

    def counted(place, name):
        original = getattr(place, name)

        def call(*arguments, **options):
            counts[name] += 1
            return original(*arguments, **options)

        monkeypatch.setattr(place, name, call)

    counted(FrameSeries, "read")
    counted(separation, "linearise")
    counted(reflection_aware, "gather_moments")
    plan = Plan.from_settings(bayer.settings())
    assert counts == {"read": 1, "linearise": 1, "gather_moments": 1}
    assert plan.separation.texture is plan.images.texture is not None


def test_an_unexpected_error_in_one_frame_is_recorded_and_the_rest_goes_on(bayer, tmp_path, monkeypatch, caplog):
    original = reference_update.track

    def faulty(reference, deformed, start, *arguments, **options):
        if faulty.calls.pop():
            raise TypeError("a fault of ours")
        return original(reference, deformed, start, *arguments, **options)

    faulty.calls = [False, True, False]
    monkeypatch.setattr(reference_update, "track", faulty)
    with caplog.at_level(logging.ERROR, logger="rgbmidic.pipeline"):
        result = measure(bayer.settings(), tmp_path / "result")
    assert result.status.tolist() == [Status.CONVERGED, Status.FAILED, Status.CONVERGED]
    assert result.reasons[1] == "unexpected error: TypeError: a fault of ours"
    assert np.isnan(result.u[1]).all()
    (told,) = caplog.records
    assert "frame_1.dng" in told.getMessage()
    assert told.exc_info[0] is TypeError


def test_an_interruption_ends_the_run(bayer, tmp_path, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(reference_update, "track", interrupted)
    with pytest.raises(KeyboardInterrupt):
        measure(bayer.settings(), tmp_path / "result")


def test_a_missing_frame_leaves_a_gap_in_the_numbers(copy):
    moved = copy("frames")
    last = sorted(moved.iterdir())[-1]
    last.rename(last.with_name(last.name.replace(last.stem[-1], str(int(last.stem[-1]) + 1))))
    settings = read_test(copy("TEST.toml"))
    result = measure(settings, copy("result"))
    assert result.number.tolist() == [*range(len(result) - 1), len(result)]
