"""Bias of a light that is displaced against the others: taken off where others agree, else stated."""

import colour_scenes as scenes
import numpy as np
import pytest
from scipy.ndimage import shift

from rgbmidic import correlate

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


def test_of_two_lights_that_disagree_nobody_knows_which_is_right():
    """Half their distance is uncertain, in the direction in which they differ and in its strain."""
    together, apart = measured([0, 0]), measured([0, 0.1])
    np.testing.assert_allclose(np.median(apart.displacement_std[:, 0]), 0.05, rtol=0.15)
    assert np.median(apart.displacement_std[:, 1]) < 1.5 * np.median(together.displacement_std[:, 1])
    assert np.nanmedian(apart.strain_std[:, 0]) > 1.5 * np.nanmedian(together.strain_std[:, 0])


def test_one_light_has_no_other_to_differ_from():
    found = measured([0])
    ratio = (found.displacement - (MOTION, 0)) / found.displacement_std
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3
