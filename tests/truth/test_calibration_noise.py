"""Photon transfer on virtual captures with known truth: 2 % from 18 frames, uncertainties that cover."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_scene import BLACK, GAIN, READ, expose, speckle_target, white_target

from rgbmidic_calibration.captures import stack_frames
from rgbmidic_calibration.noise import photon_transfer

COLUMN = np.array([0.6, 1.0, 0.5])
LEVELS = (200, 600, 1200, 1800, 2400, 3000, 3600)
SEEDS = 50
RELATIVE_ERROR = 0.018
"""Of gain and dark noise: .012."""


def measure(seed, shape, target, levels, darks):
    rng = np.random.default_rng(seed)
    picture = target(shape, rng)
    dark = stack_frames([expose(0 * picture, COLUMN, rng) for _ in range(darks)], drifts=False)
    flats = [stack_frames([expose(level * picture, COLUMN, rng) for _ in range(2)]) for level in levels]
    return photon_transfer(dark, flats).camera_noise


@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_two_per_cent_from_eighteen_frames(target):
    for seed in range(3):
        noise = measure(seed, (320, 320), target, LEVELS, darks=4)
        assert np.abs(noise.gain.value / GAIN - 1).max() < RELATIVE_ERROR
        assert np.abs(noise.dark_noise.value / (READ * GAIN) - 1).max() < RELATIVE_ERROR


@pytest.mark.parametrize("target", [white_target, speckle_target])
def test_ninety_five_percent_intervals_cover(target):
    inside = []
    for seed in range(SEEDS):
        noise = measure(seed, (144, 144), target, (600, 1800, 3000), darks=3)
        figures = ((noise.gain, GAIN), (noise.dark_noise, READ * GAIN), (noise.black_level, BLACK))
        inside.append([np.abs(figure.value - truth) < 1.96 * figure.std for figure, truth in figures])
    covered = np.mean(inside, axis=(0, 2))
    assert (covered >= 0.90).all(), covered
    assert covered.mean() <= 0.99
