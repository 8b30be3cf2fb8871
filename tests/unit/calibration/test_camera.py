"""Lens and plane from photographs of a target: truths of a virtual camera, and refusals."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from real_files import RealData
from scipy.spatial import cKDTree
from scipy.special import erf
from target_scene import LENS, SHAPE, TARGET, frame_on_plane, imaged, on_plane, photo, pose, random_views, view_of

from rgbmidic.cli import command
from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.fields.plane import CameraCalibration, distorted, undistorted
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration, TargetLights
from rgbmidic.illumination.images import Registration, frame_geometry
from rgbmidic.settings import FrameSettings
from rgbmidic.text import format_with_std
from rgbmidic_calibration.camera import estimate_lens, estimate_plane
from rgbmidic_calibration.cli import app
from rgbmidic_calibration.jobs import calibrate_camera
from rgbmidic_calibration.target import Target, View, find_view, photograph, refine_corners


def frame_of(image):
    values = np.clip(np.round(image), 0, 255).astype(np.uint16)[None]
    return ChannelFrame(values=values, black_level=0.0, white_level=255.0)


@pytest.mark.parametrize(
    "lens",
    [
        LENS,
        np.array([2400.0, 327, 232, 0, 0, 0, 0, 0]),
        np.array([2400.0, 327, 232, -0.5, 12.0, 2e-3, -1e-3, 0]),
        np.array([12000.0, 327, 232, -12.0, 0, 0, 0, 0]),
    ],
    ids=["one term", "no distortion", "two radial and tangential", "long lens"],
)
def test_parameters_are_within_their_stated_uncertainty(lens: np.ndarray) -> None:
    random = np.random.default_rng(3)
    off = []
    for _ in range(20):
        camera = estimate_lens(random_views(random, 8, lens=lens)).camera
        std = np.sqrt(np.diag(camera.covariance))
        off.append(((camera.lens - lens)[:3] / std[:3]).tolist())
        target_pose = pose(1.5, 0.7, 3.0, far=lens[0] / LENS[0])
        plane = estimate_plane(view_of(target_pose, random, lens=lens), camera).camera
        corners = np.array([[30.0, 40], [600, 50], [300, 440]])
        true, points_mm = on_plane(corners, target_pose, lens), plane.to_mm(corners)
        slopes = plane.sensitivity(corners)
        for a, b in itertools.combinations(range(3), 2):
            length = np.linalg.norm(points_mm[b] - points_mm[a])
            slope = (points_mm[b] - points_mm[a]) / length @ (slopes[b] - slopes[a])
            error = length - np.linalg.norm(true[b] - true[a])
            off.append([error / np.sqrt(slope @ plane.correlation @ slope)])
        tilt, tilt_std = plane.tilt_deg
        off.append([(tilt - np.degrees(np.arccos(target_pose[0][2, 2]))) / tilt_std])
    figures = np.concatenate([np.ravel(part) for part in off])
    assert 0.90 <= (np.abs(figures) < 1.96).mean() <= 0.99
    assert 0.75 <= np.sqrt((figures**2).mean()) <= 1.15


def test_the_test_takes_up_the_terms_there_are() -> None:
    random = np.random.default_rng(5)
    straight = [tuple(estimate_lens(random_views(random, lens=np.r_[LENS[:3], np.zeros(5)])).camera.lens[3:] != 0)]
    assert straight.count((False,) * 5) >= 1
    curved = estimate_lens(random_views(random, lens=np.r_[LENS[:3], -0.5, 0, 3e-3, -2e-3, 0])).camera.lens
    assert curved[3] != 0
    assert curved[5] != 0
    assert curved[6] != 0


def test_corners_of_a_photograph_are_found_to_a_two_hundredth_of_a_pixel() -> None:
    target_pose = pose(8, -5, 3)
    view = find_view(frame_of(photo(target_pose, np.random.default_rng(1))), TARGET, "photo")
    true = imaged(view.points - TARGET.points.mean(axis=0), target_pose)
    if np.abs(true - view.pixels).max() > 5:  # the board may be found turned by 180 degrees
        true = true[::-1]
    assert np.sqrt(((view.pixels - true) ** 2).mean()) < 0.006


def test_corners_that_opencv_finds_a_pixel_off_are_mended() -> None:
    """As in OpenCV's own pictures, in which some are (benchmarks/camera.py)."""
    target_pose = pose(8, -5, 3)
    true = imaged(TARGET.points - TARGET.points.mean(axis=0), target_pose)
    view = refine_corners(photo(target_pose).astype(np.float32), TARGET.points, true + np.array([1.1, -1.3]), 4.0)
    assert np.abs(view - true).max() < 0.02


def discs(where, target, radius, random):
    """Photograph of a grid of circles with blurred edges."""
    places = frame_on_plane(where) + target.points.mean(axis=0)
    away = cKDTree(target.points).query(places)[0].reshape(SHAPE)
    slope = np.hypot(*np.gradient(away))
    image = 120 + 85 * erf((away - radius) / np.maximum(slope, 1e-3) / 1.3)
    return image + random.normal(0, 1, SHAPE)


@pytest.mark.parametrize(("text", "radius"), [("circles:9x7:5mm", 1.7), ("acircles:4x9:4mm", 2.2)])
def test_the_middle_of_a_tilted_circle_is_not_that_of_its_image(text: str, radius: float) -> None:
    target_pose, target, camera = pose(30, 0, 3, far=1.1), Target.parse(text), CameraCalibration(shape=SHAPE, lens=LENS)
    found = find_view(frame_of(discs(target_pose, target, radius, np.random.default_rng(0))), target, "photo")
    assert found.radius == pytest.approx(radius, rel=0.06)
    true = imaged(found.points - target.points.mean(axis=0), target_pose)
    true = true[::-1] if np.abs(found.pixels - true).max() > 5 else true
    assert np.abs((found.pixels - true).mean(axis=0)).max() > 0.04  # found 0.048 and 0.08
    ends = np.array([[320.0, 80], [320, 400]])
    length = np.linalg.norm(np.diff(on_plane(ends, target_pose), axis=0))
    off = []
    for view in (replace(found, radius=0.0), found):
        points_mm = estimate_plane(view, camera).camera.to_mm(ends)
        off.append(abs(np.linalg.norm(np.diff(points_mm, axis=0)) / length - 1))
    assert off[1] < 2e-5 < 4e-5 < off[0], off


def test_a_lens_from_circles_is_as_right_as_from_corners() -> None:
    """Centroids of finely sampled discs, in place of the polygon that the correction has."""
    random, radius = np.random.default_rng(1), 1.8
    r, angle = np.sqrt((np.arange(20) + 0.5) / 20), np.arange(40) * np.pi / 20
    disc = radius * np.stack([np.outer(r, np.cos(angle)).ravel(), np.outer(r, np.sin(angle)).ravel()], axis=1)
    views = []
    for view in random_views(random, 8, noise=0):
        homography = cv2.findHomography(view.points, undistorted(LENS, view.pixels))[0]

        def seen(places, homography=homography):
            values = np.c_[places, np.ones(len(places))] @ homography.T
            return distorted(LENS, values[:, :2] / values[:, 2:])

        centroids = []
        for point in view.points:
            area = [seen(point + disc + step) - seen(point + disc - step) for step in 0.01 * np.eye(2)]
            weight = area[0][:, 0] * area[1][:, 1] - area[0][:, 1] * area[1][:, 0]
            centroids.append(np.average(seen(point + disc), axis=0, weights=weight))
        views.append(replace(view, pixels=np.array(centroids) + random.normal(0, 1e-4, view.pixels.shape)))
    plain, corrected = (
        estimate_lens([replace(view, radius=value) for view in views]).camera for value in (0.0, radius)
    )
    assert abs(corrected.lens[0] / LENS[0] - 1) < 1e-5 < abs(plain.lens[0] / LENS[0] - 1)  # found 3e-6 and 3e-5
    assert abs(corrected.lens[3] / LENS[3] - 1) < 2e-4


def test_a_mosaic_shows_the_target_without_a_lattice_nor_a_shift() -> None:
    image = photo(pose(0, 0, 3), blur=1.5)
    rows, columns = np.indices(SHAPE)
    gains = np.where((rows % 2 == 0) & (columns % 2 == 0), 0.5, np.where((rows + columns) % 2 == 1, 1.0, 0.3))
    mosaic = Mosaic(
        values=np.round(image * gains * 100).astype(np.uint16), cfa="RGGB", black_level=0.0, white_level=30000.0
    )
    mean, clipped = photograph(mosaic)
    assert not clipped.any()
    plain = cv2.sepFilter2D(image, -1, np.array([0.25, 0.5, 0.25]), np.array([0.25, 0.5, 0.25]))
    assert np.corrcoef(mean[5:-5, 5:-5].ravel(), plain[5:-5, 5:-5].ravel())[0, 1] > 0.999
    view = find_view(mosaic, TARGET, "mosaic")
    true = imaged(view.points - TARGET.points.mean(axis=0), pose(0, 0, 3))
    off = np.minimum(np.abs(true - view.pixels).max(), np.abs(true[::-1] - view.pixels).max())
    assert off < 0.05


def test_axes_of_the_plane_are_those_of_the_image() -> None:
    random = np.random.default_rng(2)
    plain = np.r_[LENS[:3], np.zeros(5)]
    for turn in (0, 40, 180):
        camera = estimate_plane(view_of(pose(2, 1, turn), random, lens=plain), CameraCalibration(shape=SHAPE)).camera
        assert np.abs(camera.to_mm(np.zeros((1, 2)))).max() < 0.01
        slope = camera.jacobian(camera.centre[None])[0]
        assert abs(slope[1, 0]) < 1e-4 * slope[0, 0]
        assert slope[0, 0] > 0
        assert slope[1, 1] > 0
        assert np.isnan(camera.tilt_deg).all()


def test_four_corners_of_the_specimen_make_a_plane() -> None:
    corners = "100,80:540,90:530,400:110,390"
    result = calibrate_camera(FrameSettings(path=("x",), shape=SHAPE), None, plane=(corners, "44x31mm", 0.5))
    points_mm = result.camera.to_mm(np.array([[100.0, 80], [540, 90], [530, 400], [110, 390]]))
    sides = np.linalg.norm(np.roll(points_mm, -1, axis=0) - points_mm, axis=1)
    assert sides == pytest.approx([44, 31, 44, 31], abs=1e-6)
    scale, std = result.camera.scale(result.camera.centre)
    assert scale == pytest.approx(0.1, rel=0.03)
    assert 1e-4 < std / scale < 5e-3


def test_a_plane_under_another_light_is_that_of_the_first_light_s_image() -> None:
    """The scale is that of red's image, the registration's error part of its uncertainty."""
    random, lights = np.random.default_rng(9), ("red", "green")
    parameters = np.array([[0.0] * 5, [2.0, -1.0, 5e-4, -0.006, 5e-4]])
    covariance = np.zeros((2, 5, 5))
    covariance[1, 3, 3] = 2e-4**2
    centre, radius = frame_geometry(SHAPE)
    registration = Registration(
        lights=lights, parameters=parameters, centre=centre, radius=radius, covariance=covariance
    )
    green = TargetLights(names=("green",), calibration=Calibration(registration=registration, shape=SHAPE))
    red_view = view_of(pose(2, 1), random)
    seen = replace(red_view, pixels=red_view.pixels + registration.displacement(red_view.pixels, 1))
    pixels, factor = green.on_first_light(seen.pixels, SHAPE)
    assert pixels == pytest.approx(red_view.pixels, abs=1e-9)
    lens = CameraCalibration(shape=SHAPE, lens=LENS)
    true = estimate_plane(red_view, lens).camera
    result = estimate_plane(replace(seen, pixels=pixels, factor=factor), lens).camera
    scale, std = true.scale(true.centre)
    assert result.scale(result.centre)[0] == pytest.approx(scale, rel=1e-7)
    assert result.scale(result.centre)[1] == pytest.approx(np.hypot(std, 2e-4 * scale), rel=0.02)
    assert estimate_plane(seen, lens).camera.scale(true.centre)[0] / scale == pytest.approx(1.006, abs=3e-4)


def test_the_command_carries_the_scale_between_the_lights(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    centre, radius = frame_geometry((480, 640))
    parameters = np.array([[0.0] * 5, [0, 0, 0, -0.006, 0]])
    registration = Registration(
        lights=("red", "green"), parameters=parameters, centre=centre, radius=radius, covariance=np.zeros((2, 5, 5))
    )
    Calibration(registration=registration, shape=(480, 640)).write(tmp_path / "calibration.json")
    options = ["camera", "--shape", "480x640", "--corners", "100,80:540,80:540,400:100,400", "--size", "44x32mm"]
    cameras = []
    for light in ("red", "green", None):
        out = tmp_path / f"{light}.json"
        stated = ["--light", light, "--calibration", str(tmp_path / "calibration.json")] if light else []
        assert command.execute(app, [*options, *stated, "--out", str(out)]) == 0
        cameras.append(CameraCalibration.read(out))
    red, green, unknown = (camera.scale(camera.centre)[0] for camera in cameras)
    assert (red, green) == pytest.approx((0.1, 0.0994), rel=1e-6)
    assert unknown == red
    assert "of light red's image" in cameras[1].summary()
    cameras[1].check_light(registration)
    cameras[2].check_light(None)
    assert not caplog.messages
    cameras[2].check_light(registration)
    assert "lengths in mm are 0.6 % off" in caplog.messages[-1]
    cameras[1].check_light(None)
    assert "without a registration" in caplog.messages[-1]
    with pytest.raises(CalibrationError, match="of light red's image, the test measures in px of that of light blue"):
        cameras[1].check_light(replace(registration, lights=("blue", "green")))
    again = [*options, "--lens", str(tmp_path / "green.json"), "--out", str(tmp_path / "again.json")]
    assert command.execute(app, again) == 2


@pytest.mark.parametrize(
    ("corners", "size"),
    [
        ("1,2:3,4", "44x31mm"),
        ("100,80:540,90:530,400:110,390", "44x31"),
        ("100,80:110,390:530,400:540,90", "44x31mm"),
        ("100,80:5400,90:530,400:110,390", "44x31mm"),
    ],
)
def test_corners_that_are_no_rectangle_are_refused(corners: str, size: str) -> None:
    with pytest.raises(ConfigurationError, match="corners"):
        calibrate_camera(FrameSettings(path=("x",), shape=SHAPE), None, plane=(corners, size, 0.5))


@pytest.mark.parametrize(
    "text", ["board:9x6:2mm", "chessboard:9x6", "chessboard:1x6:2mm", "charuco:8x6:10mm", "charuco:8x6:10mm:12mm",
             "chessboard:9x6:2mm:1mm", "charuco:8x6:10mm:7mm:DICT_X", "chessboard:9x6:2.5.1mm"]
)  # fmt: skip
def test_targets_that_cannot_be_are_refused(text: str) -> None:
    with pytest.raises(ConfigurationError, match="target"):
        Target.parse(text)


@pytest.mark.parametrize("text", ["charuco:9x7:6mm:4.5mm", "circles:9x7:5mm", "acircles:4x9:4mm"])
def test_other_targets_are_found(text: str) -> None:
    target = Target.parse(text)
    scale = 10.0
    if target.kind == "charuco":
        image = target._board().generateImage((560, 440), marginSize=10) * 0.8 + 10.0
        there = None
    else:
        image = np.full(SHAPE, 220.0)
        there = target.points * scale + (60, 60)
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        for point in there:
            away = np.hypot(x - point[0], y - point[1])
            image -= 180 * np.clip((0.27 * target.spacing * scale - away) + 0.5, 0, 1)
    view = find_view(frame_of(cv2.GaussianBlur(image, (0, 0), 0.7)), target, "photo")
    assert len(view.points) == len(target.points)
    if there is not None:
        order = view.pixels if np.abs(view.pixels - there).max() < 5 else view.pixels[::-1]
        assert np.abs(order - there).max() < 0.1
    fit = estimate_plane(view, CameraCalibration(shape=view.shape))
    assert fit.camera.details["plane"]["rms_px"] < 0.05


def written(folder: Path, name: str, image: np.ndarray) -> Path:
    path = folder / name
    cv2.imwrite(str(path), np.clip(np.round(image), 0, 255).astype(np.uint8))
    return path


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"blur": 12.0}, "wide|not found"),
        ({"level": 330.0}, "saturated|not found"),
        ({"target": Target.parse("chessboard:5x4:8mm")}, "not found"),
    ],
)
def test_photographs_that_say_nothing_are_refused(change: dict[str, object], reason: str) -> None:
    with pytest.raises(CalibrationError, match=rf"shot: .*({reason})"):
        find_view(frame_of(photo(pose(3, 2), **change)), TARGET, "shot")  # type: ignore[arg-type]


def warnings_of(views: list[View]) -> list[str]:
    return estimate_lens(views).camera.details["warnings"]


def test_too_few_parallel_and_bent_views_are_refused() -> None:
    random = np.random.default_rng(0)
    with pytest.raises(CalibrationError, match=r"5 photographs .* found in 4; shot 3: not found"):
        estimate_lens(random_views(random, 4), ["shot 3: not found"])
    with pytest.raises(CalibrationError, match="parallel"):
        estimate_lens(random_views(random, 8, tilt=1.0))
    views = random_views(random, 8)
    assert not any("half the views" in word for word in warnings_of(views))
    moved = replace(views[3], pixels=views[3].pixels + random.normal(0, 0.2, (63, 2)), name="moved")
    (warning,) = (word for word in warnings_of([*views[:3], moved, *views[4:]]) if "half the" in word)
    assert warning.startswith("moved: ")
    bent = random_views(random, 8)
    bent[2] = View(
        name="bent", points=bent[2].points, pixels=bent[2].pixels + random.normal(0, 4, (63, 2)), shape=SHAPE
    )
    with pytest.raises(CalibrationError, match="most in bent"):
        estimate_lens(bent)
    with pytest.raises(CalibrationError, match="640 x 480 px, the lens was calibrated with 600 x 480"):
        estimate_plane(bent[0], CameraCalibration(shape=(480, 600)))


def test_photographs_of_one_plane_show_one_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, shift in enumerate(((0, 0), (0.2, 0))):
        written(tmp_path, f"plane{number}.png", photo(pose(2.0, shift=shift)))
    out = tmp_path / "camera.json"
    options = ["camera", "--target", "chessboard:9x7:5mm", "--kind", "monochrome", "--out", str(out)]
    assert command.execute(app, [*options, "--plane", str(tmp_path / "plane*.png")]) == 2
    assert re.search(r"plane0\.png to plane1\.png the target moved by up to 2\.\d+ px", capsys.readouterr().err)
    assert not out.exists()


@pytest.mark.usefixtures("small_pictures")
def test_the_command_writes_what_the_library_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(4)
    tilts = ((20, 0), (-20, 5), (5, 22), (0, -22), (15, 15), (-14, -16))
    for number, tilt in enumerate(tilts):
        written(tmp_path, f"view{number}.png", photo(pose(*tilt, turn=4.0 * number, far=1.15), random))
    written(tmp_path, "plane.png", photo(pose(2.0), random))
    out = tmp_path / "camera.json"
    options = ["camera", "--target", "chessboard:9x7:5mm", "--kind", "monochrome", "--out", str(out)]
    picture = tmp_path / "camera.png"
    views, plane = str(tmp_path / "view*.png"), str(tmp_path / "plane.png")
    assert command.execute(app, [*options, "--views", views, "--plane", plane, "--picture", str(picture)]) == 0
    assert picture.stat().st_size > 10_000
    read = CameraCalibration.read(out)
    assert read.lens is not None
    std = np.sqrt(np.diag(read.covariance))
    assert (np.abs(read.lens - LENS)[:4] < 4 * std[:4]).all()
    tilt, tilt_std = read.tilt_deg
    assert tilt == pytest.approx(2.0, abs=4 * tilt_std + 0.005)
    assert f"tilt {format_with_std(tilt, tilt_std)}" in " ".join(capsys.readouterr().out.split())
    width = cv2.imread(str(picture)).shape[1]
    picture.unlink()
    assert command.execute(app, ["show", str(out), "--picture", str(picture)]) == 0
    assert cv2.imread(str(picture)).shape[1] == pytest.approx(2 / 3 * width, abs=2)  # a file has no residuals to show
    output = " ".join(capsys.readouterr().out.split())
    assert "6 views" in output
    assert f"tilt {format_with_std(tilt, tilt_std)}" in output
    # the lens of this file with another photograph of the plane
    again = tmp_path / "again.json"
    assert command.execute(app, [*options[:-1], str(again), "--lens", str(out), "--plane", plane]) == 0
    assert CameraCalibration.read(again).homography == pytest.approx(read.homography)
    before = out.read_text()
    for wrong, reason in (
        ((), "exists already"),
        (("--overwrite",), "nothing to calibrate"),
        (("--overwrite", "--views", views, "--lens", str(out)), "state one of them"),
        (("--overwrite", "--plane", str(tmp_path / "no.png")), "no.png"),
        (("--overwrite", "--corners", "1,1:2,1:2,2:1,2"), "belong together"),
    ):
        assert command.execute(app, [*options, *wrong]) == 2
        assert reason in capsys.readouterr().err
    assert out.read_text() == before


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text.replace("rgbmidic-camera", "other"), "schema"),
        (lambda text: text.replace('"schema_version": 1', '"schema_version": 9'), "version 9"),
        (lambda text: text[:-30], "not a readable"),
        (lambda text: text.replace('"covariance"', '"cov"'), "covariance"),
        (lambda text: text.replace('"shape"', '"size"'), "shape"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, change, reason: str) -> None:
    path = tmp_path / "camera.json"
    CameraCalibration(shape=SHAPE, lens=LENS).write(path)
    assert CameraCalibration.read(path).lens == pytest.approx(LENS)
    path.write_text(change(path.read_text()))
    with pytest.raises(CalibrationError, match=reason) as caught:
        CameraCalibration.read(path)
    assert str(path) in str(caught.value)


def test_the_pictures_of_opencv(real_data: RealData) -> None:
    """13 real photographs of a chessboard (benchmarks/camera.py), read as OpenCV decodes them."""
    folder = real_data("opencv_chessboard")
    target = Target.parse("chessboard:9x6:25mm")
    views = [
        find_view(frame_of(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)), target, path.name)
        for path in sorted(folder.glob("left*.jpg"))
    ]
    assert len(views) == 13
    result = estimate_lens(views).camera
    residual = result.details["lens"]["rms_px"]
    assert residual < 0.12  # found 0.112; OpenCV's left_intrinsics.yml has 0.278
    points = [np.c_[view.points, np.zeros(len(view.points))].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    rms, matrix, terms, _, _, std, *_ = cv2.calibrateCameraExtended(
        points, pixels, SHAPE[::-1], np.eye(3), None, flags=flags
    )
    assert residual == pytest.approx(rms / np.sqrt(2), rel=1e-3)
    np.testing.assert_allclose(result.lens[:3], [matrix[0, 0], *matrix[:2, 2]], atol=0.02)
    np.testing.assert_allclose(result.lens[3:7], terms.ravel()[:4], atol=2e-4)
    ours = np.sqrt(np.diag(result.covariance))[1:7]
    np.testing.assert_allclose(ours, std.ravel()[2:8], rtol=0.02)
    # what OpenCV publishes of them
    np.testing.assert_allclose(result.lens[:3], [535.916, 342.283, 235.571], atol=2)
