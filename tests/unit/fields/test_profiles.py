"""A field along a line, arrival times of a front or peak, and its speed."""

from __future__ import annotations

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.fields import Displacement, Field, NodalCovariance, ProfileLine, StrainGauges
from rgbmidic.fields.history import rate_correlation
from rgbmidic.fields.profiles import arrival_times, fit_front
from rgbmidic.mesh import Region, Tri3Mesh

MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 10, 490, 90), (100, 500)), 20)
COVARIANCE = NodalCovariance.from_mesh(MESH)
GAUGES = StrainGauges.at_nodes(COVARIANCE)
LINE = ProfileLine(COVARIANCE, GAUGES, 20, 45, 480, 55)
ROOT = np.linalg.cholesky(COVARIANCE.correlation.toarray() + 1e-9 * np.eye(len(MESH.nodes)))
SPEED, LENGTH, FRAMES = 9.0, 160.0, 80
TRUE = SPEED * np.hypot(460, 10) / 460
"""Along the line, which is not quite parallel to x."""


def wave(noise: float, seed: int) -> np.ndarray:
    """u (T, N) of a longitudinal pulse along x, with noise as the solve leaves it and that of a common reference."""
    random = np.random.default_rng(seed)
    behind = (SPEED * np.arange(FRAMES)[:, None] - MESH.nodes[:, 0]) / LENGTH
    pulse = np.where((behind > 0) & (behind < 1), 1.5 * np.sin(np.pi * behind) ** 2, 0.0)
    errors = random.normal(0, noise, (FRAMES + 1, len(MESH.nodes))) @ ROOT.T
    return pulse + errors[1:] - errors[0]


def nodal(values: np.ndarray, std: np.ndarray) -> Field:
    return Field(name="u", dims=("node",), values=values, std=std)


def series(values: np.ndarray, std: np.ndarray) -> Field:
    return Field(name="u", dims=("frame", "position"), values=values, std=std)


def along(field: str, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """The field u or exx and its uncertainty along the line, (T, P)."""
    std, nothing, read = np.full(len(MESH.nodes), noise * np.sqrt(2)), np.zeros(len(MESH.nodes)), []
    for u in wave(noise, seed):
        if field == "u":
            read.append(LINE.read(nodal(u, std)))
        else:
            strain = GAUGES.strain(Displacement.in_plane(u, nothing, std, std), "engineering")
            read.append(LINE.read(strain["exx"], "exx"))
    return np.array([one.values for one in read]), np.array([one.std for one in read])


def test_a_quadratic_field_is_read_exactly() -> None:
    x, y = MESH.nodes.T
    read = LINE.read(nodal(1e-4 * x**2 - 2e-4 * x * y + y, np.full(len(x), 0.01)))
    x, y = LINE.points.T
    np.testing.assert_allclose(read.values, 1e-4 * x**2 - 2e-4 * x * y + y, atol=1e-6)
    assert np.all((read.uncertainty > 0) & (read.uncertainty < 0.012))


def test_the_stated_uncertainty_is_that_of_noise() -> None:
    random = np.random.default_rng(1)
    std = np.full(len(MESH.nodes), 0.01)
    draws = [LINE.read(nodal(ROOT @ random.normal(0, 0.01, len(std)), std)) for _ in range(300)]
    ratio = np.std([draw.values for draw in draws], axis=0) / draws[0].uncertainty
    assert 0.9 < np.sqrt((ratio**2).mean()) < 1.1


def test_a_point_beside_a_missing_node_is_not_measured() -> None:
    values = np.zeros(len(MESH.nodes))
    near = np.hypot(*(MESH.nodes - (250, 50)).T).argmin()
    values[near] = np.nan
    field = LINE.read(nodal(values, np.full(len(values), 0.01)))
    read, std = field.values, field.uncertainty
    away = np.abs(LINE.points[:, 0] - MESH.nodes[near, 0])
    assert np.isnan(read[away < 5]).all()
    assert np.isfinite(read[away > 25]).all()
    np.testing.assert_array_equal(np.isnan(read), np.isnan(std))


@pytest.mark.parametrize(("field", "what"), [("u", "front"), ("exx", "peak")])
def test_the_speed_of_a_pulse_lies_within_its_uncertainty(field: str, what: str) -> None:
    kind, errors, stds = "" if field == "u" else "exx", [], []
    for seed in range(100, 120):
        values, std = along(field, 0.03, seed)
        arrivals = arrival_times(np.arange(FRAMES), series(values, std), feature=what)
        front = fit_front(LINE.positions, arrivals, series(std, std), LINE.correlation(kind), usable=LINE.is_two_sided)
        errors.append(front.speed - TRUE)
        stds.append(front.speed_std)
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(np.square(stds)))
    assert 0.6 < ratio < 1.5  # .84 to 1.17 over 80 draws; 20 of them leave a spread of .16
    assert np.mean(stds) < 0.003 * TRUE


def test_a_wave_that_comes_back_has_a_negative_speed() -> None:
    values, std = along("u", 0.01, 0)
    arrivals = arrival_times(np.arange(FRAMES), series(values[:, ::-1], std))
    assert fit_front(LINE.positions, arrivals, series(std, std), LINE.correlation()).speed == pytest.approx(
        -TRUE, rel=0.01
    )


def test_noise_alone_and_uniform_motion_have_no_front() -> None:
    random = np.random.default_rng(0)
    noise, std = random.normal(0, 1, (FRAMES, len(LINE.points))), np.ones((FRAMES, len(LINE.points)))
    arrivals = arrival_times(np.arange(FRAMES), series(noise, std))
    with pytest.raises(InputError, match="no front: something arrives at 0 of"):
        fit_front(LINE.positions, arrivals, series(std, std), LINE.correlation())
    together = noise + 40 * (np.arange(FRAMES) > 30)[:, None] * np.exp(-np.arange(FRAMES) / 60)[:, None]
    arrivals = arrival_times(np.arange(FRAMES), series(together, std))
    with pytest.raises(InputError, match="no front travels along the line"):
        fit_front(LINE.positions, arrivals, series(std, std), LINE.correlation())


POSITIONS, CLOCK = np.arange(0.0, 200, 10), np.arange(60.0)
BEHIND = CLOCK[:, None] - 5 - POSITIONS / 8
"""Frames since a front that travels at 8 px a frame has come to each position."""


def test_a_front_that_still_rises_at_the_end_is_taken_at_a_value_only() -> None:
    """A ramp of -.001 a frame, as a strain: half of what the frames hold of it is no front."""
    random, std = np.random.default_rng(5), np.full(BEHIND.shape, 2e-4)
    values = -0.001 * np.maximum(BEHIND, 0) + random.normal(0, 2e-4, BEHIND.shape)
    cut = arrival_times(CLOCK, series(values, std), common_fraction=0.0)
    assert cut.cut.all()
    assert np.isnan(cut.times.values).all()
    with pytest.raises(InputError, match="at 20 positions the field still rises in the last of them"):
        fit_front(POSITIONS, cut, series(std, std), np.eye(20), common_fraction=0.0)
    found = arrival_times(CLOCK, series(values, std), level=-0.005, common_fraction=0.0)
    front = fit_front(POSITIONS, found, series(std, std), np.eye(20), common_fraction=0.0)
    assert not found.cut.any()
    assert abs(front.speed - 8) < 3 * front.speed_std < 0.2
    assert front.start == pytest.approx(10, abs=0.3)
    assert np.isnan(arrival_times(CLOCK, series(values, std), level=0.005).times.values).all()


def test_a_plateau_up_to_the_last_frame_is_a_peak() -> None:
    random, std = np.random.default_rng(6), np.full(BEHIND.shape, 2e-4)
    values = 0.01 * np.clip(BEHIND / 6, 0, 1) + random.normal(0, 2e-4, BEHIND.shape)
    for level in ("50%", 0.005):
        found = arrival_times(CLOCK, series(values, std), level=level, common_fraction=0.0)
        assert np.isfinite(found.times.values).all()
        assert not found.cut.any()
        front = fit_front(POSITIONS, found, series(std, std), np.eye(20), common_fraction=0.0)
        assert abs(front.speed - 8) < 3 * front.speed_std < 0.2


@pytest.mark.parametrize("level", ["0%", "100%", 0.0, "nan", "half", "%"])
def test_a_level_is_a_value_or_part_of_the_peak(level: float | str) -> None:
    with pytest.raises(InputError, match=r"a value of the field other than 0, such as -0.005, or between 0% and 100%"):
        arrival_times(CLOCK, series(BEHIND, np.ones(BEHIND.shape)), level=level)


def test_arrival_times_state_their_noise_and_skip_missing_frames() -> None:
    random, times = np.random.default_rng(2), np.delete(np.arange(60.0), [20, 27])
    pulse = np.exp(-(((times - 30.3) / 6) ** 2))[:, None]
    std = np.full((len(times), 400), 0.03)
    values = pulse + random.normal(0, 0.03, std.shape)
    values[15, :200] = np.nan
    for what in ("front", "peak"):
        found = arrival_times(times, series(values, std), feature=what, common_fraction=0.0)
        assert 0.85 < found.times.values.std() / np.median(found.times.uncertainty) < 1.15
        if what == "peak":
            assert found.times.values.mean() == pytest.approx(30.3, abs=0.1)


def test_an_abrupt_front_is_uncertain_by_the_interval_of_the_frames() -> None:
    step = np.repeat((np.arange(40) > 20)[:, None] * 1.0, 5, axis=1)
    falling = series(step * (1 - 0.001 * np.arange(40))[:, None], np.full(step.shape, 1e-4))
    found = arrival_times(np.arange(40), falling)
    assert found.abrupt
    np.testing.assert_allclose(found.times.uncertainty, 1 / np.sqrt(12), rtol=0.01)


def test_the_correlation_of_rates_between_frames_is_that_of_slopes_in_noise() -> None:
    times = np.arange(21.0)
    fit = np.zeros((21, 21))
    for t in range(3, 18):
        window = np.arange(t - 3, t + 4)
        fit[t, window] = (window - t) / 28
    inner = slice(3, 18)
    covariance = (fit @ fit.T)[inner, inner]
    np.testing.assert_allclose(rate_correlation(times, 6.0)[inner, inner], covariance * 28, atol=1e-12)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ((20, 50, 20, 50), "two different points"),
        ((20, 50, 20, 5000), "half or more of the line"),
        ((20, 50, 1e18, 50), "half or more of the line"),
    ],
)
def test_a_line_that_is_none_is_refused(line: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        ProfileLine(COVARIANCE, GAUGES, *line)
