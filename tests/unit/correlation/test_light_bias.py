"""Bias of a light that is displaced against the others: taken off where others agree, else stated."""

import colour_scenes as scenes
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, shift
from textures import Texture

from rgbmidic import Region, Tri3Mesh, correlate
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.light_bias import with_consistent_gradient
from rgbmidic.correlation.residual import Residual
from rgbmidic.illumination.displacement import consensus_weights

SHAPE = (192, 192)
ALBEDO = scenes.speckle(SHAPE, blur=0.9).astype(np.float64)
MOTION = 0.3


def measured(displaced, seed=1):
    """Solution for lights of one speckle that moves by .3 px, each displaced along x besides by so much, with noise."""
    rng = np.random.default_rng(seed)

    def seen(by):
        image = shift(ALBEDO, (0, by), order=5, mode="mirror")
        return 1000 * image + rng.normal(scale=10, size=SHAPE)

    reference = np.stack([seen(0) for _ in displaced])
    return correlate(reference, np.stack([seen(MOTION + by) for by in displaced]), region=(16, 16, 175, 175))


def test_the_light_that_is_displaced_does_not_pull():
    found = measured([0, 0.15, 0])
    error = found.displacement - (MOTION, 0)
    # a third of .15 px is .05 px
    assert np.sqrt(np.mean(error**2)) < 0.01
    assert 0.4 < np.sqrt(np.mean((error / found.displacement_std) ** 2)) < 1.5


@pytest.mark.parametrize("number", [2, 3])
def test_lights_that_agree_are_left_as_they_are(number):
    found = measured([0] * number)
    ratio = (found.displacement - (MOTION, 0)) / found.displacement_std
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3
    assert np.median(found.displacement_std) < 0.006
    assert not found.disagreement


def test_of_two_lights_that_disagree_nobody_knows_which_is_right():
    """Half their distance is uncertain, most of it in the direction in which they differ, and in its strain."""
    together, apart = measured([0, 0]), measured([0, 0.1])
    for right in (0, 0.1):
        ratio = (apart.displacement - (MOTION + right, 0)) / apart.displacement_std
        assert abs(np.sqrt(np.mean(ratio**2)) - 1) < 0.15
    u_std, v_std = np.median(apart.displacement_std, axis=0)
    assert u_std > 1.5 * v_std
    assert np.nanmedian(apart.strain_std[:, 0]) > 1.5 * np.nanmedian(together.strain_std[:, 0])


def test_of_three_lights_of_which_none_agree_the_biases_cancel_in_part():
    """Half of what independent biases would give, a quarter of it across."""
    displaced = np.array([0, 0.2, -0.2])
    found = measured(displaced)
    weights = np.median(found.light_fraction, axis=0)
    independent = 3 / 2 * (weights**2 @ (displaced - weights @ displaced) ** 2)
    stated = np.median(found.displacement_std, axis=0)
    np.testing.assert_allclose(stated, np.sqrt(independent / 2 * np.array([0.75, 0.25])), rtol=0.15)


def test_no_lights_agree_more_than_wholly():
    """Rounding must not leave a negative part of them that does not agree, whose root is no number."""
    precision = np.random.default_rng(0).uniform(size=(3, 50, 50))
    agreement = consensus_weights(np.zeros((3, 2, 50, 50)), np.zeros((3, 50, 50)), precision)[1]
    assert agreement.max() == 1
    assert agreement.min() > 1 - 1e-12


def test_one_light_has_no_other_to_differ_from():
    found = measured([0])
    ratio = (found.displacement - (MOTION, 0)) / found.displacement_std
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3


@pytest.mark.parametrize(("lights", "by", "error"), [(3, 0.25, 0.022), (3, 1.0, 0.09), (4, 0.5, 0.027)])
def test_a_light_that_is_displaced_within_a_disc_is_stated(lights, by, error):
    """Smoothly, over 35 px. Errors without the local window .036, .210, .052 px, 3.4, 5.5 and 7.5 times the stated."""
    y, x = np.indices(SHAPE).astype(float)
    disc = np.exp(-((np.hypot(x - 96, y - 90) / 35) ** 4))
    rng = np.random.default_rng(2)

    def seen(displacement):
        image = map_coordinates(ALBEDO, [y, x - displacement], order=5, mode="mirror")
        return 1000 * image + rng.normal(scale=10, size=SHAPE)

    reference = np.stack([seen(0) for _ in range(lights)])
    deformed = np.stack([seen(MOTION + (by * disc if light == 0 else 0)) for light in range(lights)])
    found = correlate(reference, deformed, region=(16, 16, 175, 175), element_size=20)
    inside = np.hypot(*(found.nodes - (96, 90)).T) < 35
    beyond = found.displacement[inside] - (MOTION, 0)
    assert np.sqrt(np.mean(beyond**2)) < error
    assert 0.6 < np.sqrt(np.mean((beyond / found.displacement_std[inside]) ** 2)) < 1.5
    assert ("different displacements" in found.disagreement) == (by == 1.0)


@pytest.mark.parametrize("moves", [True, False])
def test_a_light_keeps_its_own_gradient_as_far_as_it_moves_with_the_texture(moves):
    texture, alone = Texture.random(1), [Texture.random(seed, contrast=20) for seed in (5, 6, 7)]
    y, x = np.indices(SHAPE).astype(float)
    f, g = (
        np.stack([texture.at(x - u, y) + one.at(x - u * moves, y) for one in alone]).astype(np.float32)
        for u in (0.0, MOTION)
    )
    region = Region.from_rectangle((16, 16, 175, 175), SHAPE)
    mesh = Tri3Mesh.from_region(region, 20)
    reference = Reference.prepare(f, region, mesh=mesh, prefilter="binomial")
    motion = np.tile([MOTION, 0.0], (len(mesh.nodes), 1))
    residual = Residual.at(reference, Deformed.prepare(g, prefilter="binomial"), [motion] * 3)
    found = with_consistent_gradient(residual, residual.weights)
    others = reference.texture.matched(reference.pixels, np.zeros((3, 1, 1)))[0]

    def with_images(gradient):
        return np.mean([np.corrcoef(*pair)[0, 1] for pair in zip(gradient, reference.texture.images[0], strict=True)])

    fraction = (with_images(found.gradient[0]) - with_images(others)) / (
        with_images(reference.gradient[0]) - with_images(others)
    )
    assert fraction > 0.95 if moves else fraction < 0.3


def test_what_lights_show_alone_is_no_uncertainty_where_it_moves_along():
    """Their gradients differ by chance then; stated as a pull of its own the errors were .81 of what was stated."""
    texture, alone = Texture.random(1), [Texture.random(seed, contrast=40) for seed in (5, 6, 7)]
    y, x = np.indices(SHAPE).astype(float)
    plain = [np.stack([texture.at(x - u, y) + one.at(x - u, y) for one in alone]) for u in (0, MOTION)]
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found = correlate(*(one + rng.normal(0, 5, one.shape) for one in plain), region=(16, 16, 175, 175))
        ratios.append((found.displacement - (MOTION, 0)) / found.displacement_std)
    assert 0.86 < np.sqrt(np.mean(np.square(ratios))) < 1.15
