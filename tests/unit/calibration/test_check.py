"""`check`: held-back captures pass a good calibration and fail a wrong one; real captures add up."""

from __future__ import annotations

import re

import numpy as np
import pytest
from calibration_scene import BLACK, GAIN, MATRICES, READ, WHITE, captures, expose, registered_pictures, speckle_target
from target_scene import imaged, pose, random_views, view_of

from rgbmidic.cli.command import execute
from rgbmidic.errors import CalibrationError, ConfigurationError
from rgbmidic.frames import read_frame
from rgbmidic.frames.data import Mosaic
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.images import Registration, frame_geometry
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic_calibration.camera import estimate_lens, estimate_plane
from rgbmidic_calibration.captures import block_means, stack_frames
from rgbmidic_calibration.cli import app
from rgbmidic_calibration.options import read_limits
from rgbmidic_calibration.verify import (
    Limits,
    additivity,
    check_distances,
    leakage,
    noise_ratio,
    remaining_registration,
)

MATRIX = MATRICES[1.5]
LIGHTS = ("red", "green", "blue")
SHAPE = (128, 160)


@pytest.fixture(scope="module")
def held_back():
    lights, dark = captures(MATRIX, np.random.default_rng(21), target=speckle_target, shape=SHAPE, count=2, darks=2)
    return {n: [block_means(f) for f in frames] for n, frames in lights.items()}, [block_means(f) for f in dark]


def test_true_matrix_leaves_nothing(held_back):
    checks = leakage(Crosstalk(matrix=MATRIX, lights=LIGHTS), *held_back)
    assert len(checks) == 9  # six of one light in another, three checkerboards
    assert all(abs(check.value) < min(0.3, 5 * check.std) for check in checks)
    assert all(check.passed for check in checks)


def test_wrong_entry_shows_as_leakage(held_back):
    wrong = MATRIX.copy()
    wrong[1, 0] += 0.01
    checks = leakage(Crosstalk(matrix=wrong, lights=LIGHTS), *held_back)
    expected = -np.linalg.solve(wrong, [0, 0.01, 0])
    assert [check.value for check in checks[:2]] == pytest.approx(100 * expected[1:], abs=0.1)
    assert [check.name for check in checks if not check.passed] == ["red left in green"]


def test_greens_taken_as_equal_show_as_a_checkerboard():
    truth = Crosstalk(matrix=MATRIX, lights=LIGHTS, green_difference=[0.02, 0.0, 0.0])
    lights, dark = captures(truth.sites, np.random.default_rng(22), target=speckle_target, shape=SHAPE, count=2)
    reduced = {n: [block_means(f) for f in frames] for n, frames in lights.items()}, [block_means(f) for f in dark]
    assert all(check.passed for check in leakage(truth, *reduced))
    checks = leakage(Crosstalk(matrix=MATRIX, lights=LIGHTS), *reduced)
    (failed,) = [check for check in checks if not check.passed]
    assert failed.name == "checkerboard of red"
    expected = 100 * 0.01 * np.abs(truth.unmixing[:, 1]).max()
    assert failed.value == pytest.approx(expected, abs=4 * failed.std)


def test_swapped_and_unknown_lights(held_back):
    lights, dark = held_back
    swapped = {"red": lights["green"], "green": lights["red"], "blue": lights["blue"]}
    with pytest.raises(CalibrationError, match="light red show most light in green"):
        leakage(Crosstalk(matrix=MATRIX, lights=LIGHTS), swapped, dark)
    with pytest.raises(CalibrationError, match="knows the lights red, green, blue, not violet"):
        leakage(Crosstalk(matrix=MATRIX, lights=LIGHTS), {"violet": lights["red"]}, dark)


def scene_of_three(rng, *, bend=0.0, strengths=(1, 1, 1), level=900, count=2):
    pictures = [level * speckle_target(SHAPE, np.random.default_rng(1)) * (0.8 + 0.2 * i) for i in range(3)]
    lit = [MATRIX[:, i, None, None] * picture for i, picture in enumerate(pictures)]

    def capture(channels):
        return expose(channels - bend * channels**2, np.ones(3), rng)

    singles = {name: stack_frames([capture(lit[i]) for _ in range(count)]) for i, name in enumerate(LIGHTS)}
    total = np.sum([s * image for s, image in zip(strengths, lit, strict=True)], axis=0)
    dark = stack_frames([capture(0 * total) for _ in range(3)], drifts=False)
    return stack_frames([capture(total) for _ in range(count)]), singles, dark


def difference(checks):
    """Mean, scatter, what noise explains of it, and offset of the difference, as the first check states them."""
    return [float(number) for number in re.findall(r"[-+]?\d+\.\d+", checks[0].text)]


def test_sum_of_lights_adds_up():
    checks = additivity(*scene_of_three(np.random.default_rng(2)))
    mean, spread, noise, _ = difference(checks)
    assert mean == pytest.approx(0, abs=0.3)
    assert spread == pytest.approx(noise, rel=0.1)
    assert all(item.passed for item in checks)


def test_noise_of_the_sum_from_the_noise_model():
    scene = scene_of_three(np.random.default_rng(3), count=1)
    _, spread, noise, _ = difference(additivity(*scene, noise=NoiseModel(gain=GAIN, read_noise=READ)))
    assert spread == pytest.approx(noise, rel=0.05)


def test_changed_lamp_is_named():
    checks = additivity(*scene_of_three(np.random.default_rng(4), strengths=(1, 1.1, 1)))
    failed = [item.name for item in checks if not item.passed]
    assert failed == ["strength of green in red+green+blue"]
    assert checks[2].value == pytest.approx(10, abs=1)


def test_bent_camera_does_not_add_up():
    checks = additivity(*scene_of_three(np.random.default_rng(5), bend=2e-4))
    assert not all(item.passed for item in checks)


def test_offset_is_told_from_light():
    together, singles, _ = scene_of_three(np.random.default_rng(6))
    lifted = {n: stack_frames([lift(s) for s in two_frames(stack)]) for n, stack in singles.items()}
    checks = additivity(stack_frames([lift(f) for f in two_frames(together)]), lifted)
    assert difference(checks)[-1] == pytest.approx(2 * BLACK, abs=1)  # three black levels in the sum, one in the other
    assert all(abs(change.value) < 1 for change in checks[1:])


def two_frames(stack):
    values = np.empty(stack.camera.shape, np.uint16)
    for (row, column), mean in zip(stack.camera.origins, stack.mean, strict=True):
        values[row::2, column::2] = np.rint(mean + BLACK)
    return [values]


def lift(values):
    return Mosaic(values=values, cfa="RGGB", black_level=2 * BLACK, white_level=WHITE)


def test_noise_against_prediction():
    stack = scene_of_three(np.random.default_rng(7))[0]
    ratio, std = noise_ratio(stack, NoiseModel(gain=GAIN, read_noise=np.sqrt(READ**2 + 1 / 12)))
    assert ratio == pytest.approx(1, abs=4 * std)
    assert noise_ratio(stack, NoiseModel(gain=2 * GAIN, read_noise=READ))[0] > 1.2
    with pytest.raises(CalibrationError, match="at least two"):
        noise_ratio(scene_of_three(np.random.default_rng(7), count=1)[0], NoiseModel(gain=GAIN, read_noise=READ))


def test_registration_left():
    shape = (200, 200)
    centre, radius = frame_geometry(shape)
    parameters = np.array([[0] * 5, [0.2, -0.1, 0, 5e-4, 0], [-0.3, 0.1, 1e-4, -8e-4, 2e-4]])
    truth = Registration(lights=LIGHTS, parameters=parameters, centre=centre, radius=radius)
    rng = np.random.default_rng(8)
    stacks = {
        name: stack_frames([expose(3000 * picture, MATRIX[:, i], rng) for _ in range(2)])
        for i, (name, picture) in enumerate(zip(LIGHTS, registered_pictures(truth, shape, 3), strict=True))
    }
    assert all(check.value < 0.02 + 3 * check.std for check in remaining_registration(truth, stacks))
    none = Registration.identity(LIGHTS, shape)
    assert [check.value > 0.1 for check in remaining_registration(none, stacks)] == [True, True]
    two = remaining_registration(truth, {"green": stacks["green"], "blue": stacks["blue"]})
    assert [check.name for check in two] == ["registration of blue"]
    assert two[0].value < 0.05


def test_limits_from_options():
    assert read_limits(["leakage=1", "registration=0.1"]) == Limits(leakage=1, registration=0.1)
    for text in ("leakage", "leakage=-1", "colour=1", "leakage=x"):
        with pytest.raises(ConfigurationError, match="--limit takes NAME=VALUE"):
            read_limits([text])


@pytest.mark.parametrize(
    ("together", "single", "mean", "spread"), [("03", ("01", "02"), 0.17, 0.86), ("07", ("01", "02", "04"), 0.33, 1.05)]
)
def test_coin_captures_add_up(real_data, together, single, mean, spread):
    """Real single-light captures and their sums: 8 bit, dim (10 to 17 DN), one frame each, no dark frames."""
    folder = real_data("multilight_raw_coin_italy")

    def stack(number):
        frame = read_frame(folder / f"I_{number}.png", kind="bayer", cfa="RGGB", black_level=0, white_level=255)
        middle = Mosaic(values=frame.values[600:2200, 1000:2600], cfa="RGGB", black_level=0, white_level=255)
        return stack_frames([middle])

    checks = additivity(stack(together), {number: stack(number) for number in single})
    left, *changes = checks
    assert abs(difference(checks)[0]) < 2.5 * mean
    assert difference(checks)[1] < 2 * spread
    assert left.value < 3
    assert all(abs(change.value) < 5 for change in changes)


@pytest.fixture(scope="module")
def camera():
    random = np.random.default_rng(4)
    lens = estimate_lens(random_views(random))
    return estimate_plane(view_of(pose(4.0, -3.0), random), lens.camera).camera


def ends(length: float) -> np.ndarray:
    """Places in px of two points of the plane so many mm apart."""
    return imaged(np.array([[-0.5, 0.2], [0.5, 0.2]]) * [length, 10], pose(4.0, -3.0))


def test_a_distance_on_the_plane_is_compared_with_the_true_one(camera):
    good, wrong = check_distances(camera, [(ends(30.0), 30.0), (ends(30.0), 30.3)])
    assert abs(good.value) < 0.05
    assert good.passed
    assert wrong.value == pytest.approx(-1.0, abs=0.05)
    assert not wrong.passed
    for place, length in (((-1, 5, 300, 5), 20.0), ((10, 5, 300, 5), 0.0), ((10, 5, 3000, 5), 20.0)):
        with pytest.raises(CalibrationError, match="ends in the frame of 640 x 480 px"):
            check_distances(camera, [(place, length)])


def test_the_stated_uncertainty_of_a_distance_is_the_scatter_of_its_ends(camera):
    random, exact = np.random.default_rng(0), ends(30.0)
    (check,) = check_distances(camera, [(exact, 30.0)], corner_std=0.5)
    points_mm = camera.to_mm((exact + random.normal(0, 0.5, (2000, 2, 2))).reshape(-1, 2)).reshape(-1, 2, 2)
    scatter = 100 * np.linalg.norm(points_mm[:, 1] - points_mm[:, 0], axis=1).std() / 30.0
    assert scatter == pytest.approx(check.std, rel=4 / np.sqrt(2 * 2000) + 0.02)  # 2 %: lens and plane


def test_the_command_checks_a_camera_by_distances(camera, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    camera.write("camera.json")
    place = "{:.2f},{:.2f}:{:.2f},{:.2f}".format(*ends(30.0).ravel())
    for options, status, text in (
        (["--distance", f"{place}=30"], 0, "PASSED"),
        (["--distance", f"{place}=30", "--distance", f"{place}=30.5mm"], 1, "FAILED: 1 of 2 figures"),
        (["--distance", f"{place}=30.5", "--limit", "distance=3"], 0, "PASSED"),
        ([], 2, "state a known distance, --distance X0,Y0:X1,Y1=MM"),
        (["--distance", "1,2:3,4"], 2, "--distance is X0,Y0:X1,Y1=MM, such as 120,85:840,85=25, not '1,2:3,4'"),
    ):
        assert execute(app, ["check", "camera.json", *options]) == status
        output = capsys.readouterr()
        assert text in output.out + output.err
    assert execute(app, ["check", "other.json", "--distance", f"{place}=30"]) == 2
    assert "--distance is for a camera file" in capsys.readouterr().err
