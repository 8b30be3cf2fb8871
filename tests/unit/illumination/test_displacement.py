"""Displacement of the lights' textures against each other: found from a mosaic, with its uncertainty, and harmless."""

import colour_scenes as scenes
import numpy as np
import pytest
from scipy.ndimage import shift

from rgbmidic._kernels.texture import displacement_scores
from rgbmidic.illumination.colour_factors import upsample, upsample_rows
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.displacement import LightDisplacement, consensus_weights
from rgbmidic.illumination.separation import separate

SHAPE = (192, 192)
MEAN = np.array([1500, 2000, 1100])[:, None, None]
INSIDE = np.s_[:, 24:-24, 24:-24]
LOW, HIGH = 0.85, 1.25
"""Displacement over its standard uncertainty (1.10)."""
AT_REST = 0.003
"""px, mean displacement of lights at one place, of 12 draws (.0008)."""
BY_CHANCE = 0.1
"""Part of the variance that chance makes which the separation takes for glints (.033)."""


def lights_displaced(by, **options):
    """Lights of one speckle (3, H, W), each displaced by its own (x, y) px."""
    albedo = scenes.speckle(SHAPE, **options)
    return MEAN * np.stack([shift(albedo, (y, x), order=5, mode="mirror") for x, y in by])


@pytest.mark.parametrize("by", [[(0, 0), (0.15, 0), (0, 0)], [(0.05, -0.1), (0, 0.1), (-0.05, 0)]])
def test_displacement_is_found_through_crosstalk_noise_and_mosaic(by):
    found = separate(scenes.mosaic_of(lights_displaced(by)), scenes.CROSSTALK).displacement
    expected = np.array(by) - np.mean(by, axis=0)
    np.testing.assert_allclose(found.values.mean(axis=(2, 3)), expected, atol=0.02)
    assert np.median(found.std) < 0.02


def test_uncertainty_is_that_of_the_draws():
    """Of textures at one place: their displacement over its standard uncertainty, 12 speckles and noises."""
    ratios, means, taken = [], [], []
    for seed in range(12):
        mosaic = scenes.mosaic_of(lights_displaced([(0, 0)] * 3, seed=seed), seed=seed)
        found = separate(mosaic, scenes.CROSSTALK).displacement
        ratios.append(found.values / found.std[:, None])
        means.append(found.values.mean(axis=(2, 3)))
        taken.append((found.significant**2).mean() / (found.values**2).mean())
    assert LOW < np.sqrt(np.mean(np.square(ratios))) < HIGH
    assert np.abs(np.mean(means, axis=0)).max() < AT_REST
    assert np.mean(taken) < BY_CHANCE


def test_what_most_of_a_frame_shows_is_taken_and_what_chance_shows_is_not():
    random = np.random.default_rng(0)
    std, glints = np.full((3, 30, 30), 0.01), random.normal(0, 0.05, (3, 2, 30, 30))
    noise = random.normal(0, 0.01, glints.shape)
    taken = LightDisplacement(values=glints + noise, std=std).significant
    assert ((taken - glints) ** 2).mean() < (noise**2).mean()  # better than what was measured
    np.testing.assert_allclose(taken, glints, atol=0.06)
    assert (LightDisplacement(values=noise, std=std).significant ** 2).mean() < 0.1 * (noise**2).mean()


def test_displaced_lights_do_not_pull_the_others():
    """The green light lies .2 px to the right: where red's and blue's images lie then, and what their noise is."""
    lights = lights_displaced([(0, 0), (0.2, 0), (0, 0)])
    found = separate(scenes.mosaic_of(lights), scenes.CROSSTALK).values
    slope = np.gradient(lights, axis=2)
    moved = -((found - lights) * slope)[INSIDE].sum(axis=(1, 2)) / (slope**2)[INSIDE].sum(axis=(1, 2))
    assert np.abs(moved).max() < 0.015  # .07 where all lights count as one texture


def test_a_light_counts_by_its_precision_and_by_those_that_agree():
    place = np.array([[0.0, 0.0], [0.15, 0.0], [0.0, 0.01]])[:, :, None, None]
    chance, even = np.full((3, 1, 1), 1e-6), np.ones((3, 1, 1))
    weights, agree = (part[..., 0, 0] for part in consensus_weights(place, chance, even))
    np.testing.assert_allclose(weights.sum(), 1)
    assert weights[1] < 0.04
    assert agree > 0.85
    # by chance as far apart: all count alike
    weights, _ = consensus_weights(place, np.full((3, 1, 1), 0.02), even)
    np.testing.assert_allclose(weights.ravel(), 1 / 3)
    # of two nobody knows which is right
    weights, agree = consensus_weights(place[:2], chance[:2], np.array([3.0, 1.0])[:, None, None])
    np.testing.assert_allclose(weights.ravel(), [0.75, 0.25])
    assert agree.item() < 0.05


def test_a_single_light_is_displaced_against_nothing():
    one = Crosstalk(matrix=scenes.A[:, [1]], lights=("green",))
    light = np.array([0, 2000, 0])[:, None, None] * scenes.speckle(SHAPE)
    found = separate(scenes.mosaic_of(light), one).displacement
    assert not found.values.any()
    assert not found.lateral(np.ones(found.std.shape[1:], dtype=bool)).any()


def test_scores_are_those_written_out():
    rng, half = np.random.default_rng(4), 4
    planes = rng.normal(size=(3, 11, 18)).astype(np.float32)
    planes[1, 5, 7] = np.nan
    slope = rng.uniform(1, 2, (3, 3, 5)).astype(np.float32)
    sums = np.empty((3, 3, 3, 5), dtype=np.float32)
    displacement_scores(planes, upsample_rows(slope, half, 18), half, sums)
    texture = planes / upsample(slope, half, (11, 18))
    expected = np.zeros_like(sums)
    for light, i, j in np.ndindex(3, 9, 16):
        others = np.delete(texture, light, axis=0).mean(axis=0)
        r = texture[light, i + 1, j + 1] - others[i + 1, j + 1]
        gx, gy = (others[i + 1, j + 2] - others[i + 1, j]) / 2, (others[i + 2, j + 1] - others[i, j + 1]) / 2
        if np.isfinite(r + gx + gy):
            expected[light, :, (i + 1) // half, (j + 1) // half] += -r * gx, -r * gy, (gx * gx + gy * gy) / 2
    np.testing.assert_allclose(sums, expected, rtol=1e-4, atol=1e-4)
