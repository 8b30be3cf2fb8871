"""Crosstalk on virtual captures with known truth: the stated uncertainty covers, four captures give 0.2 %."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_scene import MATRICES, captures, speckle_target, white_target

from rgbmidic_calibration.captures import block_means
from rgbmidic_calibration.crosstalk import estimate_crosstalk

SEEDS = 50
RELATIVE_ERROR = 0.00039
"""Of the matrix, in its norm: .00026."""


def estimate(matrix, seed, **scene):
    lights, dark = captures(matrix, np.random.default_rng(seed), **scene)
    reduced = {name: [block_means(frame) for frame in frames] for name, frames in lights.items()}
    return estimate_crosstalk(reduced, [block_means(frame) for frame in dark])


@pytest.mark.parametrize(
    ("condition", "target"),
    [(1.5, white_target), (3.0, speckle_target), (6.0, speckle_target)],
)
def test_ninety_five_percent_intervals_cover(condition, target):
    matrix = MATRICES[condition]
    free = matrix < 1
    inside, equal = [], []  # entries of the matrix, and the difference of greens that are the same
    for seed in range(SEEDS):
        found = estimate(matrix, seed, shape=(144, 144), count=2, darks=2, target=target).crosstalk
        inside.append(np.abs(found.matrix - matrix)[free] < 1.96 * found.std[free])
        equal.append(np.abs(found.green_difference) < 1.96 * found.green_difference_std)
    assert 0.90 <= np.mean(inside) <= 0.99
    assert np.mean(equal) >= 0.86  # .93 of 1200, from 16 clusters of blocks each; of 150 they scatter by .02


def test_a_constant_matrix_is_rarely_taken_for_a_varying_one():
    scene = {"shape": (224, 224), "count": 1, "darks": 1, "target": speckle_target}
    orders = [estimate(MATRICES[6.0], seed, **scene).crosstalk.field for seed in range(30)]
    assert sum(field is not None for field in orders) <= 1


@pytest.mark.parametrize("condition", MATRICES)
@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_four_captures_per_light_give_two_parts_in_a_thousand(condition, target):
    matrix = MATRICES[condition]
    for seed in range(2):
        found = estimate(matrix, seed, shape=(256, 256), target=target).crosstalk.matrix
        assert np.linalg.norm(found - matrix) < RELATIVE_ERROR * np.linalg.norm(matrix)
