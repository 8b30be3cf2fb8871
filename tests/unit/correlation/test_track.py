"""Starts of a frame: where it is looked for, and what is said when nothing is found."""

from __future__ import annotations

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import Region, Status, Tri3Mesh, correlate
from rgbmidic.correlation import Deformed, Reference, Start, track
from rgbmidic.settings import SolverSettings

SHAPE = (200, 260)


@pytest.fixture(scope="module")
def texture():
    return Texture.random(3)


def states(texture, shift):
    image = np.asarray(texture.image(SHAPE), dtype=np.float32)[None]
    moved = np.asarray(texture.image(SHAPE, Affine(shift=shift)), dtype=np.float32)[None]
    region = Region.from_rectangle((20, 20, 120, 180), SHAPE)
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(image, region, mesh=mesh, prefilter="binomial")
    return reference, Deformed.prepare(moved, prefilter="binomial")


def test_a_jump_is_looked_for_around_the_last_displacement_too(texture):
    reference, deformed = states(texture, (90.0, 0.0))
    options = SolverSettings(search_radius=40)
    last = Start(displacement=np.full((len(reference.mesh.nodes), 2), (60.0, 0.0)))
    found = track(reference, deformed, last, options)
    assert found.status is Status.CONVERGED
    assert np.abs(found.displacement - (90.0, 0.0)).max() < 0.01


def test_a_motion_beyond_the_limits_names_them(texture):
    pair = texture.image(SHAPE), texture.image(SHAPE, Affine(shift=(90.0, 0.0)))
    failed = correlate(*pair, region=(20, 20, 120, 180), search_radius=40)
    assert failed.status is Status.FAILED
    assert "do not match anywhere" in failed.reason
    assert "search_radius = 40 px" in failed.reason
    assert "turns up to about 8 degrees" in failed.reason
