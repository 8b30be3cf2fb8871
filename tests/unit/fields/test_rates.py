"""Rates over uneven times with lost frames: exact for polynomials, as uncertain as draws, blind to the reference."""

from __future__ import annotations

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.fields import difference_std, frame_covariance, rates, reference_share

TIMES = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 30))
FIRST = np.arange(30) == 0


def noise(draws: int, references: int) -> np.ndarray:
    """Errors (T, draws) of unit variance in every frame, less the mean of those of the first `references`."""
    own = np.random.default_rng(references).normal(size=(len(TIMES), draws))
    return own - own[:references].mean(axis=0)


def test_a_polynomial_of_the_degree_comes_back_with_gaps_in_some_of_the_series():
    values = np.stack([0.3 * TIMES**2 - 2 * TIMES + 1, 5 - TIMES], axis=1)
    values[[4, 5, 17], 1] = np.nan
    found = rates(TIMES, values, np.ones_like(values), window=8, share=0.5, references=FIRST)
    np.testing.assert_allclose(found.value, np.stack([0.3 * TIMES**2 - 2 * TIMES + 1, 5 - TIMES], axis=1))
    np.testing.assert_allclose(found.velocity, np.stack([0.6 * TIMES - 2, -np.ones(30)], axis=1))
    np.testing.assert_allclose(found.acceleration, [[0.6, 0]] * 30, atol=1e-9)
    assert (found.velocity_std[[4, 5, 17], 1] > found.velocity_std[[4, 5, 17], 0]).all()


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("degree", [2, 3])
def test_stated_uncertainty_is_that_of_draws_the_reference_included(count, degree):
    references = np.arange(30) < count
    errors = noise(4000, count)
    std = np.where(references, np.sqrt(1 - 1 / count), np.sqrt(1 + 1 / count))
    options = {"window": 7.0, "share": reference_share(count), "references": references, "degree": degree}
    stated = rates(TIMES, np.zeros(30), std, **options)
    drawn = rates(TIMES, errors, np.broadcast_to(std[:, None], errors.shape), **options)
    for name in ("value", "velocity", "acceleration"):
        observed = getattr(drawn, name).std(axis=1)
        np.testing.assert_allclose(observed, getattr(stated, f"{name}_std"), rtol=0.06, err_msg=name, atol=1e-3)


def test_what_frames_share_of_the_reference_cancels_in_a_difference():
    errors = noise(50_000, 1)
    std = np.sqrt(2.0)
    assert difference_std(std, std, reference_share(1)) == pytest.approx((errors[7] - errors[20]).std(), rel=0.02)
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
    found = rates(TIMES, values, np.ones_like(values), window=6, share=0.5, references=FIRST)
    assert np.isnan(found.velocity[14:20]).all()
    assert np.isfinite(found.velocity[:9]).all()
    assert np.isnan(found.value[-6:]).sum() == np.isnan(found.velocity_std[-6:]).sum()


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
        rates(times, np.zeros(30), np.ones(30), window=window, share=0.5, references=FIRST)
