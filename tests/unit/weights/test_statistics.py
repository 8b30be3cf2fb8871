"""Weights by statistics: lights that err together count as one, errors that cancel in the mean cost nothing."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rgbmidic import Tri3Mesh, correlate, measure_sequence
from rgbmidic.correlation import Precision
from rgbmidic.correlation.reference import Reference
from rgbmidic.mesh import Region
from rgbmidic.weights import MaskWeights, Statistics
from rgbmidic.weights.light_weights import _best_fractions

SIDE = 160
REGION = (15, 15, SIDE - 16, SIDE - 16)


def speckle(seed):
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(SIDE, SIDE)), 1.5)
    return 1000 + 250 * field / field.std()


def white(seed, sigma):
    return np.random.default_rng(seed).normal(0, sigma, (SIDE, SIDE))


def measured(first, second):
    return correlate(np.stack(first), np.stack(second), region=REGION, initial=(0, 0), prefilter="binomial")


class OneLight:
    """A method of one's own: the second light counts nothing."""

    def precision(self, residual):
        factor = np.ones_like(residual.weights)
        factor[1] = 0
        return Precision(factor=factor, loss_curvature=np.ones_like(factor[0]))


class Nothing:
    """A method that learns nothing."""

    def precision(self, residual):
        return None


class MasksOfOneLight(OneLight, MaskWeights):
    """The same beside masks."""


def three_noisy_lights():
    a = speckle(1)
    return [[a + white(3 * state + light, 20) for light in range(3)] for state in range(2)]


def test_a_method_of_ones_own_takes_the_place_of_the_statistics():
    options = {"region": REGION, "initial": (0, 0), "prefilter": "binomial"}
    states = [np.stack(state) for state in three_noisy_lights()]
    found = correlate(*states, statistics=OneLight(), **options)
    np.testing.assert_allclose(found.weight_fraction, [0.5, 0, 0.5])
    nothing, plain = (correlate(*states, statistics=choice, **options) for choice in (Nothing(), False))
    np.testing.assert_allclose(nothing.displacement, plain.displacement, atol=1e-4)
    default, named = (correlate(*states, statistics=choice, **options) for choice in (True, Statistics()))
    np.testing.assert_array_equal(default.displacement, named.displacement)


@pytest.mark.parametrize("statistics", [True, False])
def test_weights_that_learn_are_asked_for_their_precision(statistics):
    states = [np.stack(state) for state in three_noisy_lights()]
    weights = MasksOfOneLight(np.ones((3, SIDE, SIDE)))
    _, last = measure_sequence(states, region=REGION, statistics=statistics, weights=weights)
    np.testing.assert_allclose(last.weight_fraction, [0.5, 0, 0.5])


@pytest.mark.parametrize("lights", [1, 2, 3, 5])
def test_the_best_fractions_are_the_inverse_covariance_times_one(lights):
    random = np.random.default_rng(lights)
    residuals = random.normal(size=(6, 7, lights, 40)) + random.normal(size=(6, 7, 1, 40))
    covariance = residuals @ residuals.swapaxes(2, 3)
    bounded = covariance.copy()
    own = np.broadcast_to(np.eye(lights, dtype=bool), covariance.shape)
    bounded[~own] *= 1 - Statistics().independent_fraction
    wanted = np.linalg.solve(bounded, np.ones((lights, 1)))[..., 0]
    found = _best_fractions(
        np.moveaxis(covariance, (2, 3), (0, 1)).astype(np.float32), np.float32(1e-3), Statistics().independent_fraction
    )
    np.testing.assert_allclose(np.moveaxis(found, 0, 2), wanted, rtol=1e-3, atol=1e-6)


def test_two_copies_of_a_light_count_nearly_as_one():
    a, noise = speckle(1), [white(n, 30) for n in range(10, 14)]  # not that of the speckle
    once = [a + noise[0], a + noise[0], a + noise[1]]
    then = [a + noise[2], a + noise[2], a + noise[3]]
    share = measured(once, then).weight_fraction
    np.testing.assert_allclose(share, [0.25, 0.25, 0.5], atol=0.03)


def test_errors_that_cancel_in_the_mean_of_the_lights_cost_nothing():
    a, noise, error = speckle(1), [white(n, 5) for n in range(4)], white(9, 100)
    clean = measured([a + noise[0], a + noise[1]], [a + noise[2], a + noise[3]])
    opposed = measured([a + noise[0], a + noise[1]], [a + noise[2] + error, a + noise[3] - error])
    assert opposed.displacement.std() < 1.3 * clean.displacement.std()


def test_a_light_that_errs_alone_counts_little():
    a, noise = speckle(1), [white(n, 10) for n in range(6)]
    once = [a + n for n in noise[:3]]
    then = [a + noise[3], a + noise[4] + white(9, 150), a + noise[5]]
    share = measured(once, then).weight_fraction
    assert share[1] < 0.1
    assert share[0] == pytest.approx(share[2], rel=0.15)


@pytest.fixture(scope="module")
def prepared():
    def prepare(*lights, **options):
        region = Region.from_rectangle(REGION, (SIDE, SIDE))
        images = np.stack(lights).astype(np.float32)
        return Reference.prepare(images, region, mesh=Tri3Mesh.from_region(region, 25), **options)

    return prepare


def test_the_gradient_of_one_light_is_its_own(prepared):
    reference = prepared(speckle(1), brightness="none")  # else what may be a gain is taken out
    rows, columns = reference.pixels.rows, reference.pixels.columns
    image = reference.images[0] * reference.inverse_level.mean()
    slope = (np.roll(image, -1, axis=1) - np.roll(image, 1, axis=1)) / 2
    assert np.corrcoef(reference.gradient[0][0], slope[rows, columns])[0, 1] > 0.99
    assert reference.gradient[0][0].std() == pytest.approx(slope.std(), rel=0.15)


def test_lights_share_a_gradient_in_proportion_to_their_contrast(prepared):
    a = speckle(1)
    x = prepared(a + white(1, 5), 500 + 0.5 * a + white(2, 5), a + white(3, 5)).gradient[0]
    assert np.corrcoef(x[0], x[1])[0, 1] > 0.99
    assert x[1].std() / x[0].std() == pytest.approx(0.5, rel=0.1)


def slope_along_x(reference, image):
    rows, columns = reference.pixels.rows, reference.pixels.columns
    return ((np.roll(image, -1, axis=1) - np.roll(image, 1, axis=1)) / 2)[rows, columns]


def test_what_a_light_alone_shows_is_not_in_the_gradient_it_is_matched_with_where_it_is_displaced(prepared):
    a, alone = speckle(1), [speckle(seed) - 1000 for seed in (5, 6, 7)]
    reference = prepared(*(a + 0.4 * one for one in alone))
    displaced = reference.texture.matched(reference.pixels, np.zeros((3, 1, 1)))[0]
    for light, one in enumerate(alone):
        gradient = displaced[light]
        assert np.corrcoef(gradient, reference.gradient[0][light])[0, 1] < 0.999
        assert np.corrcoef(gradient, slope_along_x(reference, a))[0, 1] > 0.9
        assert abs(np.corrcoef(gradient, slope_along_x(reference, one))[0, 1]) < 0.08
        beyond = (reference.texture.images - reference.gradient)[0, light]
        assert np.corrcoef(beyond, slope_along_x(reference, one))[0, 1] > 0.7


def test_of_two_lights_each_keeps_its_own_gradient_in_the_mean(prepared):
    """The other may be the one that reflects: alone it would leave nothing to match with."""
    a = speckle(1)
    reference = prepared(a + white(1, 5), a + white(2, 150))
    assert np.corrcoef(reference.gradient[0][0], slope_along_x(reference, a + white(1, 5)))[0, 1] > 0.6
    assert np.corrcoef(reference.gradient[0][0], reference.gradient[0][1])[0, 1] > 0.99


def test_lights_that_share_no_texture_keep_their_own(prepared):
    reference = prepared(*(speckle(seed) for seed in (1, 2, 3)))
    for light, image in enumerate(reference.images):
        assert np.corrcoef(reference.gradient[0][light], slope_along_x(reference, image))[0, 1] > 0.5


def test_where_one_light_alone_is_known_it_keeps_its_own_gradient(prepared):
    a = speckle(1)
    others = [a + white(n, 5) for n in (2, 3)]
    for other in others:
        other[:, :70] = np.nan
    reference = prepared(a + white(1, 5), *others)
    left = reference.pixels.columns < 50
    slope = slope_along_x(reference, a)[left]
    assert np.corrcoef(reference.gradient[0][0][left], slope)[0, 1] > 0.95


def test_the_uncertainty_holds_what_a_light_alone_still_pulls():
    """A pattern that stands still in one of three lights while the texture moves by half a pixel."""
    a, still = speckle(1), 0.5 * (speckle(4) - 1000)
    moved = np.real(np.fft.ifft2(np.fft.fft2(a) * np.exp(-2j * np.pi * 0.5 * np.fft.fftfreq(SIDE))))
    noise = [white(n, 10) for n in range(6)]
    clean, pulled = (
        measured(
            [a + noise[0] + more, a + noise[1], a + noise[2]],
            [moved + noise[3] + more, moved + noise[4], moved + noise[5]],
        )
        for more in (0 * still, still)
    )
    error = pulled.displacement - (0.5, 0)
    assert np.abs(error / pulled.displacement_std).max() < 4
    assert np.sqrt(np.mean((error / pulled.displacement_std) ** 2)) < 1.2
    along, across = np.sqrt(np.mean(error**2, axis=0))
    assert along < 1.2 * across  # 1.5 times with the mean gradient of all lights
    usual, stated = (np.median(one.displacement_std, axis=0) for one in (clean, pulled))
    assert stated[0] > usual[0]
