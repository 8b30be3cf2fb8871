"""Velocity of whole measurements against one noisy reference: as certain as it says, the reference's noise left out."""

from __future__ import annotations

import numpy as np
from textures import Affine, Texture

from rgbmidic import correlate
from rgbmidic.fields import Field, rates, reference_fraction

FRAMES, SHAPE, REGION = 10, (112, 112), (12, 12, 99, 99)
NOISE = 4.0
"""8 % of the contrast."""
RIGHT = (0.7, 1.2)
"""rms(error / stated) over 2 x 36 nodes, as asked for in smooth motion."""
TIMES = np.delete(np.arange(FRAMES + 2), [4, 5]) * 1e-3


def motion(time: float) -> Affine:
    """A shift that is braked and a stretch that grows, both parabolas of the time."""
    return Affine(shift=(300 * time - 1e4 * time**2, 50 * time), gradient=((1 + 300 * time**2, 0), (0, 1 - time)))


def test_velocity_and_acceleration_are_as_far_off_as_they_say():
    random, texture = np.random.default_rng(4), Texture.random(8)
    states = [texture.image(SHAPE, motion(time)) + random.normal(scale=NOISE, size=SHAPE) for time in TIMES]
    solutions = [
        correlate(states[0], state, region=REGION, element_size=17, initial=motion(time).shift)
        for state, time in zip(states[1:], TIMES[1:], strict=True)
    ]
    nodes = solutions[0].nodes
    still = np.zeros((1, *nodes.shape))
    measured = np.concatenate([still, np.stack([one.displacement for one in solutions])])
    std = np.concatenate([still, np.stack([one.displacement_std for one in solutions])])
    options = {"common_fraction": reference_fraction(1), "references": np.arange(FRAMES) == 0}
    found = rates(TIMES, Field(name="u", values=measured, std=std), window=9e-3, **options)
    step = 1e-6
    before, now, after = (
        np.stack([motion(time + shift).displacement(nodes, SHAPE) for time in TIMES]) for shift in (-step, 0, step)
    )
    truth = {"velocity": (after - before) / (2 * step), "acceleration": (after - 2 * now + before) / step**2}
    for name, exact in truth.items():
        ratio = np.sqrt(np.mean(((found[name].values - exact) / found[name].std) ** 2))
        assert RIGHT[0] <= ratio <= RIGHT[1], (name, ratio)
