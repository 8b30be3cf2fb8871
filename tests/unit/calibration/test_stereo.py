"""Two cameras from simultaneous views of a target: truths of virtual cameras, both verdicts, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from target_scene import DISTANCE, LENS, SHAPE, TARGET, imaged, pose

from rgbmidic import CameraCalibration
from rgbmidic.cli import command
from rgbmidic.errors import CalibrationError
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.images import write_tiff
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.stereo import CameraPair, triangulate
from rgbmidic_calibration import jobs
from rgbmidic_calibration.captures import CaptureFiles
from rgbmidic_calibration.cli import app
from rgbmidic_calibration.stereo import ViewPair, estimate_stereo, verdicts
from rgbmidic_calibration.target import View

RIGHT_LENS = np.array([2380.0, 315.0, 245.0, -0.4, 0, 0, 0, 0])
TURN = cv2.Rodrigues(np.radians([0.5, -22.0, 0.3]))[0]
SHIFT = np.array([0, 0, DISTANCE]) - TURN @ [0, 0, DISTANCE] + [1.0, -0.5, 2.0]
TRUE = CameraPair(
    left=CameraCalibration(shape=SHAPE, lens=LENS),
    right=CameraCalibration(shape=SHAPE, lens=RIGHT_LENS),
    rotation=np.ravel(cv2.Rodrigues(TURN)[0]),
    translation=SHIFT,
)


def view_pair(where, random, noise=0.03, name="view"):
    points = TARGET.points - TARGET.points.mean(axis=0)
    both = (where, LENS), ((TURN @ where[0], TURN @ where[1] + SHIFT), RIGHT_LENS)
    views = [
        View(
            name=f"{side} {name}",
            points=TARGET.points,
            shape=SHAPE,
            pixels=pixels + random.normal(0, noise, pixels.shape),
        )
        for side, pixels in zip(("left", "right"), (imaged(points, *seen) for seen in both), strict=True)
    ]
    return ViewPair(left=views[0], right=views[1])


def view_pairs(random, count=8, **noise):
    pairs = []
    while len(pairs) < count:
        turn = pose(*random.uniform(-25, 25, 2), random.uniform(-20, 20))[0]
        middle = cv2.Rodrigues(np.radians([0.0, 11.0, 0.0]))[0]  # between both cameras
        pair = view_pair((middle @ turn, np.array([*random.uniform(-6, 6, 2), 1.25 * DISTANCE])), random, **noise)
        inside = [
            (v.pixels > 2).all() and (v.pixels < np.array(SHAPE[::-1]) - 3).all() for v in (pair.left, pair.right)
        ]
        if all(inside):
            pairs.append(replace(pair, left=replace(pair.left, name=f"view {len(pairs)}")))
    return pairs


def test_pose_and_lengths_are_within_their_stated_uncertainty():
    random, off = np.random.default_rng(4), []
    for _ in range(5):
        pair = estimate_stereo(view_pairs(random)).pair
        std = np.sqrt(np.diag(pair.covariance))
        active = std > 0
        assert active.sum() >= 14
        difference, inverse = (
            (pair.parameters - TRUE.parameters)[active],
            np.linalg.inv(pair.covariance[active][:, active]),
        )
        off.append(difference @ inverse @ difference / active.sum())
        # of a surface: what the correlated errors leave of its lengths
        seen = TRUE.project(np.c_[random.uniform(-15, 15, (30, 2)), np.full(30, DISTANCE)])

        def log_length(other, seen=seen):
            points = triangulate(other, *seen, np.eye(4)[None].repeat(30, axis=0)).points
            return np.log(np.linalg.norm(points - points.mean(axis=0)))

        error = log_length(pair) - log_length(TRUE)
        steps = (pair.with_parameters(pair.parameters + step) for step in pair.parameter_errors.T)
        stated = np.linalg.norm([log_length(other) - log_length(pair) for other in steps])
        assert stated < 3e-4
        off.append((error / stated) ** 2)
    assert 0.5 < np.mean(off) < 1.7


def test_the_details_state_residuals_and_views_held_out():
    estimate = estimate_stereo(view_pairs(np.random.default_rng(5), 8))
    details = estimate.pair.details
    assert details["rms_px"]["left"] == pytest.approx(0.03, rel=0.2)
    assert len(details["held_out"]["views"]) == 2
    assert details["held_out"]["epipolar_px"] == pytest.approx(0.03 * np.sqrt(2), rel=0.5)
    assert abs(details["held_out"]["relative_length_error"]) < 1e-3
    assert len(estimate.residuals) == 8
    covariance = estimate.pair.covariance  # in px, rad and mm: of unlike size, and yet symmetric
    assert (covariance == covariance.T).all()


def test_boards_numbered_from_opposite_ends_are_numbered_alike():
    pairs = view_pairs(np.random.default_rng(6), 6)
    mixed = [pair.renumbered if number % 2 else pair for number, pair in enumerate(pairs)]
    first, second = estimate_stereo(pairs).pair, estimate_stereo(mixed).pair
    assert second.parameters == pytest.approx(first.parameters, rel=1e-6, abs=1e-6)


def test_only_a_length_shows_a_focal_length_that_is_off():
    """The epipolar residual does not: both verdicts are needed."""
    random = np.random.default_rng(7)
    views = [view_pair(pose(*tilt, far=1.25), random, noise=0.0) for tilt in ((10, 5), (-8, 12), (4, -15))]
    for scale, off in ((1.0, 0.0), (1.001, 1e-3)):
        values = TRUE.parameters
        values[[0, 8]] *= scale
        found = verdicts(TRUE.with_parameters(values), views)
        assert found["epipolar_px"] < 0.01
        assert abs(found["relative_length_error"]) == pytest.approx(off, abs=6e-4)


def test_views_of_different_times_are_refused():
    pairs = view_pairs(np.random.default_rng(8), 6)
    swapped = [replace(pair, right=pairs[(number + 1) % 6].right) for number, pair in enumerate(pairs)]
    with pytest.raises(CalibrationError, match="degrees off where the other views have them"):
        estimate_stereo(swapped)


def test_too_few_views_and_points_are_refused():
    pairs = view_pairs(np.random.default_rng(9), 3)
    with pytest.raises(CalibrationError, match=r"5 simultaneous views .* in 3; blurred"):
        estimate_stereo(pairs, ["blurred"])
    view = pairs[0].left
    few = replace(view, points=view.points[:5], pixels=view.pixels[:5])
    with pytest.raises(CalibrationError, match="show 5 common points, 6 are needed"):
        ViewPair.of(few, view)


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    """Files of eight simultaneous photographs a camera, and of two more to check with; the target is found by name."""
    random, found = np.random.default_rng(10), {}
    frame = ChannelFrame(values=np.full((1, *SHAPE), 900, np.uint16), black_level=np.array(0.0), white_level=4095)
    for number, pair in enumerate(view_pairs(random, 10)):
        for side in ("left", "right"):
            path = tmp_path / ("check" if number > 7 else "views") / f"{side}_{number}.tif"
            path.parent.mkdir(exist_ok=True)
            write_tiff(path, frame)
            found[path.name] = getattr(pair, side)
    monkeypatch.setattr(jobs, "find_view", lambda frame, target, name: replace(found[Path(name).name], name=name))
    monkeypatch.chdir(tmp_path)
    return tmp_path


FRAMES = ("--kind", "monochrome", "--black-level", "0", "--white-level", "4095", "--target", "chessboard:9x7:5mm")


def options(folder, **changes):
    sides = {f"--{side}": f"{folder}/{side}_*.tif" for side in ("left", "right")} | changes
    return [item for pair in sides.items() for item in pair] + list(FRAMES)


def test_the_command_calibrates_checks_and_shows(photographs, capsys):
    assert command.execute(app, ["stereo", *options("views")]) == 0
    pair = CameraPair.read("stereo.json")
    assert pair.baseline == pytest.approx(TRUE.baseline, abs=0.1)
    assert len(pair.details["provenance"]["inputs"]) == 16
    assert "views held out: epipolar residual 0.0" in capsys.readouterr().out.replace("\n", " ")
    assert command.execute(app, ["show", "stereo.json"]) == 0
    assert command.execute(app, ["check", "stereo.json", *options("check")]) == 0
    assert "PASSED" in capsys.readouterr().out
    values = pair.parameters
    values[[0, 8]] *= 1.002
    pair.with_parameters(values).write("off.json")
    assert command.execute(app, ["check", "off.json", *options("check")]) == 1
    out = capsys.readouterr().out
    assert "FAILED: 1 of 2" in out  # the length; the epipolar residual passes
    span = np.linalg.norm(np.ptp(TARGET.points, axis=0))
    assert command.execute(app, ["check", "stereo.json", *options("check"), "--distance", f"{1.002 * span}mm"]) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["stereo", *options("views", **{"--right": "views/right_[0-5].tif"})], "has 8 photographs, the right 6"),
        (["stereo", *options("views", **{"--right": "none/*.tif"})], "right: "),
        (["stereo", *options("views", **{"--right": "views/left_*.tif"})], "both cameras stand at one place"),
        (["stereo", *options("check")], "5 simultaneous views of the target at least"),
        (["stereo", *options("views"), "--left-calibration", "a.json"], "belong together"),
        (["stereo", *options("views"), "--out", "stereo.json"], "exists already"),
        (["check", "stereo.json"], "--left, --right and --target"),
        (["check", "stereo.json", *options("check"), "--distance", "1,2:3,4=5"], "one number in mm"),
        (["check", "stereo.json", *options("check"), "--distance", "5"], "within a tenth"),
        (["check", "views/left_0.tif", *options("check")], "for a file of two cameras"),
    ],
)
def test_what_is_stated_wrongly_is_one_line(photographs, capsys, arguments, message):
    TRUE.write("stereo.json")
    if "--out" not in arguments and arguments[0] == "stereo":
        arguments = [*arguments, "--out", "other.json"]
    assert command.execute(app, arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_photographs_with_times_are_paired_by_them(photographs, monkeypatch):
    stated = FrameSettings(path=("x",), kind="monochrome", black_level=0, white_level=4095)
    files = [CaptureFiles.find(side, f"views/{side}_*.tif", stated) for side in ("left", "right")]
    late = {"left": 0, "right": 2}

    def time(series, index):
        name = series.lights[0][index].path.name
        return 1_000_000_000 * (index + late[name.split("_")[0]])

    monkeypatch.setattr(type(files[0].series), "time_ns", time)
    pairs, reasons = jobs.find_view_pairs((files[0], files[1]), TARGET)
    assert [pair.right.name for pair in pairs] == [files[1].series.name(index) for index in range(6)]
    assert [pair.left.name for pair in pairs] == [files[0].series.name(index) for index in range(2, 8)]
    assert reasons == ("2 photographs of the left camera have none of the right one taken at the same time",)
    late["right"] = 50
    with pytest.raises(CalibrationError, match="the nearest are 43 s apart"):
        jobs.find_view_pairs((files[0], files[1]), TARGET)
