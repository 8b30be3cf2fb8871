"""Rates over uneven times with lost frames: exact for polynomials, honest at onsets, blind to the reference."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.fields import Field, difference_std, frame_covariance, rates, reference_fraction

TIMES = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 30))
FIRST = np.arange(30) == 0
EVEN = np.arange(41.0)
NONE = np.zeros(41, dtype=bool)
NAMES = ("velocity", "acceleration")


def series(values: np.ndarray, std: np.ndarray) -> Field:
    return Field(name="u", values=values, std=std)


def noise(draws: int, references: int) -> np.ndarray:
    """Errors (T, draws) of unit variance in every frame, less the mean of those of the first `references`."""
    own = np.random.default_rng(references).normal(size=(len(TIMES), draws))
    return own - own[:references].mean(axis=0)


def measured(motion: np.ndarray, std: float, draws: int, seed: int) -> tuple[np.ndarray, dict[str, Field]]:
    """Noisy draws (41, draws) of a motion over `EVEN` and their rates, windows of 7 frames."""
    values = motion[:, None] + std * np.random.default_rng(seed).normal(size=(41, draws))
    return values, rates(
        EVEN, series(values, np.full(values.shape, std)), window=6, common_fraction=0.0, references=NONE
    )


@pytest.mark.parametrize("power", [2, 3, 4])
def test_a_polynomial_comes_back_with_gaps_in_some_of_the_series(power):
    x = TIMES / 10
    values = np.stack([0.3 * x**power - 2 * x + 1, 5 - x], axis=1)
    values[[4, 5, 17], 1] = np.nan
    found = rates(TIMES, series(values, np.full_like(values, 1e-4)), window=8, common_fraction=0.5, references=FIRST)
    slope, bend = power * 0.3 * x ** (power - 1) - 2, power * (power - 1) * 0.3 * x ** (power - 2)
    line, still = -np.ones(30), np.zeros(30)
    truth = {"value": (0.3 * x**power - 2 * x + 1, 5 - x), "velocity": (slope, line), "acceleration": (bend, still)}
    for power_of_ten, (name, exact) in enumerate(truth.items()):
        error = found[name].values - np.stack(exact, axis=1) / 10**power_of_ten
        assert (np.abs(error) <= 0.02 * found[name].std + 1e-12).all(), name
    assert (found["velocity"].std[[3, 6], 1] > found["velocity"].std[[3, 6], 0]).all() or power > 2
    assert np.isnan(found["velocity_before"].values).all()


@pytest.mark.parametrize("count", [1, 3])
def test_at_rest_the_stated_uncertainty_holds_the_noise_and_leaves_the_reference_out(count):
    references = np.arange(30) < count
    errors = noise(600, count)
    std = np.where(references, np.sqrt(1 - 1 / count), np.sqrt(1 + 1 / count))
    options = {"window": 7.0, "common_fraction": reference_fraction(count), "references": references}
    drawn = rates(TIMES, series(errors, np.broadcast_to(std[:, None], errors.shape)), **options)
    for name in ("value", *NAMES):
        square = (drawn[name].values / np.maximum(drawn[name].std, 1e-9)) ** 2
        assert 0.8 <= np.sqrt(square.mean()) <= 1.05, name
    if count == 1:  # the reference itself is 0 without error
        assert np.sqrt(np.mean(drawn["value"].values[0] ** 2)) <= 1.1 * np.sqrt(np.mean(drawn["value"].std[0] ** 2))


@pytest.mark.parametrize(
    ("speed", "onset"), [(0.02, 20.0), (0.02, 20.4), (0.1, 20.0), (0.1, 20.4), (1.0, 20.4), (5.0, 20.0)]
)
def test_at_rest_before_an_onset_nothing_moves(speed, onset):
    """A parabola over 7 frames has up to 1,500 times the stated velocity there."""
    _, found = measured(speed * np.maximum(EVEN - onset, 0), 0.01, 60, 7)
    still = onset > EVEN
    for name in NAMES:
        ratio = np.abs(found[name].values / found[name].std)[still]
        assert ratio.max() <= 6
        assert ratio[EVEN[still] < onset - 7].max() <= 4.5  # of 1,600 values; 4 in noise is once in 16,000
    truth = np.where(onset < EVEN, speed, 0)[:, None]
    rms = np.sqrt(np.mean(((found["velocity"].values - truth) / found["velocity"].std) ** 2, axis=1))[onset != EVEN]
    assert np.mean(rms[2:-2] > 1.3) <= 0.1
    assert rms.max() <= 2.6


def test_a_kink_has_the_rates_of_both_sides_and_one_that_reaches_to_either():
    _, found = measured(1.0 * np.maximum(EVEN - 20, 0), 0.01, 60, 2)
    known = np.isfinite(found["velocity_after"].values).any(axis=1)
    assert np.flatnonzero(known).tolist() == [20]
    for side, true in (("before", 0.0), ("after", 1.0)):
        rate, std = found[f"velocity_{side}"].values[20], found[f"velocity_{side}"].std[20]
        assert np.sqrt(np.mean(((rate - true) / std) ** 2)) <= 1.3
        assert np.median(std) < 0.02
        assert (np.abs(found["velocity"].values[20] - true) < 3 * found["velocity"].std[20]).mean() > 0.95


@pytest.mark.parametrize(("reach", "period"), [(10.0, 40.0), (3.0, 60.0)])
def test_in_smooth_motion_the_stated_uncertainty_is_the_error(reach, period):
    w = 2 * np.pi / period
    _, found = measured(reach * np.sin(w * EVEN), 0.01, 60, 4)
    truth = {"velocity": reach * w * np.cos(w * EVEN), "acceleration": -reach * w**2 * np.sin(w * EVEN)}
    for name in NAMES:
        error = found[name].values - truth[name][:, None]
        assert 0.7 <= np.sqrt(np.mean((error / found[name].std)[3:-3] ** 2)) <= 1.2, name


def smooth_step(phase: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A step from 0 to 1 within a phase of 0 to 1, smooth to its second derivative; its integral and derivative."""
    p = np.clip(phase, 0, 1)
    integral = p**4 * (2.5 - 3 * p + p**2) + np.maximum(phase - 1, 0)
    return integral, p**3 * (10 - 15 * p + 6 * p**2), 30 * p**2 * (1 - p) ** 2


@pytest.mark.parametrize(
    ("quantity", "frames", "sizes", "limit"),
    [
        ("displacement", 3, (1, 3, 10), 1.25),
        ("displacement", 3, (30,), 1.6),  # 3.4 without what an onset hides next to a cut
        ("displacement", 5, (1, 3, 10, 30), 1.25),
        ("displacement", 10, (1, 3, 10, 30), 1.25),
        ("strain", 3, (10,), 2.0),  # 2.6 without it; less than 10 times its noise, a step is overlooked
        ("strain", 5, (3, 10, 30, 100), 1.25),
        ("strain", 10, (3, 10, 30, 100), 1.25),
    ],
)
def test_while_a_front_passes_its_rate_is_as_far_off_as_stated(quantity, frames, sizes, limit):
    """A front over so many frames: speeds of the displacement (px/frame), steps of the strain, over their noise."""
    onset = 15 + np.random.default_rng(0).uniform(0, 1, 40)
    phase = (EVEN[:, None] - onset) / frames
    integral, step, slope = smooth_step(phase)
    motion, rate = (frames * integral, step) if quantity == "displacement" else (step, slope / frames)
    motion, rate = (np.concatenate([size * part for size in sizes], axis=1) for part in (motion, rate))
    phase = np.tile(phase, len(sizes))
    values = motion + np.random.default_rng(frames).normal(size=motion.shape)
    found = rates(EVEN, series(values, np.ones(values.shape)), window=6, common_fraction=0.0, references=NONE)
    ratio = (found["velocity"].values - rate) / found["velocity"].std
    for state in (phase < 0, phase > 1):
        assert 0.75 <= np.sqrt(np.mean(ratio[3:-3][state[3:-3]] ** 2)) <= 1.1
    assert 0.6 <= np.sqrt(np.mean(ratio[(phase >= 0) & (phase <= 1)] ** 2)) <= limit


def test_noise_at_rest_is_hardly_more_than_that_of_one_parabola():
    values, found = measured(0 * EVEN, 0.01, 300, 5)
    weights = np.linalg.pinv(np.arange(-3.0, 4)[:, None] ** np.arange(3))
    lines = np.lib.stride_tricks.sliding_window_view(values, 7, axis=0)
    for name, row in zip(NAMES, (weights[1], 2 * weights[2]), strict=True):
        assert found[name].values[3:-3].std() <= 1.15 * (lines @ row).std()


def test_what_a_passing_reflection_adds_is_correlated_from_frame_to_frame():
    """Eight frames with six times the noise, whose excess has a correlation of .7: 1.4 without regard to it."""
    random, passing = np.random.default_rng(3), (EVEN > 16) & (EVEN < 25)
    excess, draws = np.zeros((41, 300)), random.normal(size=(41, 300))
    for i in np.flatnonzero(passing):
        excess[i] = 0.7 * excess[i - 1] + (draws[i] if i == 17 else np.sqrt(1 - 0.49) * draws[i])
    values = random.normal(size=(41, 300)) + np.sqrt(35) * excess
    std = np.where(passing, 6.0, 1.0)[:, None] * np.ones(300)
    found = rates(EVEN, series(values, std), window=6, common_fraction=0.0, references=NONE)
    ratio = found["velocity"].values / found["velocity"].std
    for state, (low, high) in ((passing, (0.8, 1.2)), (~passing, (0.8, 1.1))):
        assert low <= np.sqrt(np.mean(ratio[3:-3][state[3:-3]] ** 2)) <= high


def test_lost_frames_at_an_onset_make_no_motion_before_it():
    motion = 0.5 * np.maximum(EVEN - 20, 0)
    values = motion[:, None] + 0.01 * np.random.default_rng(8).normal(size=(41, 60))
    values[[6, 17, 18, 22, 23, 30]] = np.nan
    found = rates(EVEN, series(values, np.full(values.shape, 0.01)), window=6, common_fraction=0.0, references=NONE)
    assert np.isfinite(found["velocity"].values).all()
    assert np.abs(found["velocity"].values / found["velocity"].std)[:17].max() <= 6
    error = (found["velocity"].values - np.where(EVEN > 20, 0.5, 0.0)[:, None]) / found["velocity"].std
    assert np.sqrt(np.mean(error[EVEN != 20] ** 2)) <= 1.2


def test_rates_follow_the_units_and_forget_a_uniform_motion():
    motion = np.where(EVEN > 20, 0.1 * (EVEN - 20) ** 2, 0)
    values, found = measured(motion, 0.01, 3, 6)
    moved = 3 * values + (5 + 0.7 * EVEN)[:, None]
    other = rates(
        EVEN / 1e5 + 7, series(moved, np.full(values.shape, 0.03)), window=6e-5, common_fraction=0.0, references=NONE
    )
    np.testing.assert_allclose(other["velocity"].values, (3 * found["velocity"].values + 0.7) * 1e5, rtol=1e-6, atol=1)
    np.testing.assert_allclose(other["velocity"].std, 3e5 * found["velocity"].std, rtol=1e-5)
    np.testing.assert_allclose(other["acceleration"].values, 3e10 * found["acceleration"].values, rtol=1e-4, atol=1e5)


def test_the_mean_over_pieces_is_that_of_the_naive_sum_over_all_cuts():
    times, random = TIMES[:11], np.random.default_rng(1)
    for speed in (0.0, 4.0, 8.0):
        values = speed * np.maximum(np.arange(11) - 5.4, 0) + random.normal(size=11)
        found = rates(
            times, series(values, np.ones(11)), window=3.5, common_fraction=0.0, references=np.zeros(11, dtype=bool)
        )
        expected = np.array([naive_rate(times, values, place, 3.5 * 1.01) for place in range(11)])
        np.testing.assert_allclose(found["velocity"].values, expected[:, 0], atol=2e-3)
        np.testing.assert_allclose(found["velocity"].std, expected[:, 1], rtol=1e-2)


def naive_rate(times: np.ndarray, values: np.ndarray, place: int, reach: float) -> tuple[float, float]:
    """Velocity at one frame and its uncertainty, over every way to cut the series and every degree of each piece.

    Next to a cut the uncertainty holds the rate of an onset: what is hidden in the noise of the last value of a piece
    and grows by a power of the time to what the next value departs from the tangent by.
    """
    cuts = [
        (0, *inner, len(times))
        for number in range(len(times) // 3)
        for inner in combinations(range(3, len(times) - 2), number)
    ]
    cuts = [edges for edges in cuts if min(np.diff(edges)) >= 3]
    terms = []
    for edges in cuts:
        pieces = list(pairwise(edges))
        odds = [{d: evidence(times[a:b], values[a:b], d) for d in (2, 3, 4) if b - a > d} for a, b in pieces]
        own = next(i for i, (a, b) in enumerate(pieces) if a <= place < b)
        others = np.prod([sum(parts.values()) for i, parts in enumerate(odds) if i != own])
        terms += [(*pieces[own], d, others * chance) for d, chance in odds[own].items()]
    total, found = sum(term[3] for term in terms), []
    for a, b, d, chance in terms:
        long, now = reach * (d + 1) / 3, times[place]
        low = times[a] if times[b - 1] - times[a] <= long else np.clip(now - long / 2, times[a], times[b - 1] - long)
        used = np.flatnonzero((times >= low - 1e-12) & (times <= low + long + 1e-12) & (times >= times[a]))
        used = used[used < b]
        if len(used) <= d or not times[used[0]] <= now <= times[used[-1]] or chance / total < 1e-9:
            continue
        line, value_line = np.zeros(len(times)), np.zeros(len(times))
        value_line[used], line[used] = np.linalg.pinv((times[used] - now)[:, None] ** np.arange(d + 1.0))[:2]
        onset = 0.0
        for end, next_one in ((a, a - 1), (b - 1, b)):
            if place == end and 0 <= next_one < len(times):
                step = times[next_one] - now
                tangent = value_line + step * line
                excess = (values[next_one] - tangent @ values) ** 2 / (tangent @ tangent + 1) - 1
                onset += (np.log2(1 + np.sqrt(max(excess, 0))) / step) ** 2
        found.append((chance / np.linalg.norm(line), line @ values, line, onset))
    weight, rate, line, onset = (np.array(part) for part in zip(*found, strict=True))
    weight /= weight.sum()
    mean = weight @ rate
    return mean, np.sqrt(((weight @ line) ** 2).sum() + weight @ ((rate - mean) ** 2 + onset))


def evidence(times: np.ndarray, values: np.ndarray, degree: int) -> float:
    """Penalised likelihood of a piece."""
    rest = values - np.polynomial.Polynomial.fit(times, values, degree)(times)
    return float(np.exp(-0.5 * ((rest**2).sum() / 1.2**2 + 3.5 * (degree + 3))))


def test_what_frames_share_of_the_reference_cancels_in_a_difference():
    errors = noise(50_000, 1)
    std = np.sqrt(2.0)
    assert difference_std(std, std, reference_fraction(1)) == pytest.approx((errors[7] - errors[20]).std(), rel=0.02)
    covariance = frame_covariance(np.array([0, std, std]), 0.5, [True, False, False])
    np.testing.assert_allclose(covariance, np.cov(errors[[0, 7, 20]]), atol=0.03)


def test_a_frame_that_is_less_certain_keeps_its_excess_to_itself():
    """One with half the information: the covariance with the best estimate is the best one's variance."""
    random = np.random.default_rng(0)
    reference, first, second = (random.normal(size=(50_000, 2)) for _ in range(3))
    whole = first.mean(axis=1) - reference.mean(axis=1)
    half = second[:, 0] - reference[:, 0]
    assert difference_std(1.0, np.sqrt(2), 0.5) == pytest.approx((whole - half).std(), rel=0.02)


def test_nothing_is_told_where_too_little_is_known():
    values = np.ones((30, 1))
    values[10:24] = np.nan
    found = rates(TIMES, series(values, np.ones_like(values)), window=6, common_fraction=0.5, references=FIRST)
    assert np.isnan(found["velocity"].values[14:20]).all()
    assert np.isfinite(found["velocity"].values[:9]).all()
    assert np.isnan(found["value"].values[-6:]).sum() == np.isnan(found["velocity"].std[-6:]).sum()


@pytest.mark.parametrize(
    ("times", "window", "words"),
    [
        (TIMES[::-1], 8, "rise"),
        (TIMES, 2, r"a window of 2 holds no more than 3 frames; a polynomial of degree 2 needs 4 or more"),
        (TIMES[:5], 8, "a time for each frame"),
    ],
)
def test_wrong_input_is_one_clear_line(times, window, words):
    with pytest.raises(InputError, match=words):
        rates(times, series(np.zeros(30), np.ones(30)), window=window, common_fraction=0.5, references=FIRST)
