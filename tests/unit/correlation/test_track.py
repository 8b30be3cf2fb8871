"""Frame after frame: a jump, a specimen that leaves and comes back, and what is said when nothing is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import Region, Status, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference, Start, track
from rgbmidic.settings import SolverSettings
from rgbmidic.weights import Statistics

SHAPE = (200, 320)
OPTIONS = SolverSettings()


@pytest.fixture(scope="module")
def texture():
    return Texture.random(3)


@pytest.fixture(scope="module")
def reference(texture):
    image = np.asarray(texture.image(SHAPE), dtype=np.float32)[None]
    region = Region.from_rectangle((20, 20, 120, 180), SHAPE)
    return Reference.prepare(image, region, mesh=Tri3Mesh.from_region(region, 25), prefilter="binomial")


def moved(texture, motion):
    return Deformed.prepare(np.asarray(texture.image(SHAPE, motion), dtype=np.float32)[None], prefilter="binomial")


def test_a_jump_of_100_px_is_found(texture, reference):
    last = Start(displacement=np.full((len(reference.mesh.nodes), 2), (60.0, 0.0)))
    found = track(reference, moved(texture, Affine(shift=(160.0, 0.0))), last, OPTIONS, Statistics())
    assert found.status is Status.CONVERGED
    assert np.abs(found.displacement - (160.0, 0.0)).max() < 0.01


def test_a_specimen_that_leaves_is_found_again_and_a_restored_start_gives_the_same_bits(texture, reference):
    start, statuses = Start(displacement=None), []
    for shift in (0.0, -110.0, -400.0, 60.0):
        solution = track(reference, moved(texture, Affine(shift=(shift, 0.0))), start, OPTIONS, Statistics())
        restored = replace(start, displacement=None if start.displacement is None else start.displacement.copy())
        start = start.after(reference.mesh, solution.displacement, solution.measured)
        statuses.append(solution.status)
    assert statuses[2] is Status.FAILED
    assert statuses[3] is Status.CONVERGED
    assert np.abs(solution.displacement - (60.0, 0.0)).max() < 0.01
    again = track(reference, moved(texture, Affine(shift=(60.0, 0.0))), restored, OPTIONS, Statistics())
    np.testing.assert_array_equal(again.displacement, solution.displacement)


def test_a_frame_without_a_start_says_how_near_it_came(reference):
    failed = track(reference, moved(Texture.random(4), Affine()), Start(displacement=None), OPTIONS, Statistics())
    assert failed.status is Status.FAILED
    assert "do not match anywhere" in failed.reason
    assert "of 15% needed" in failed.reason
    assert "turns up to about 30 degrees" in failed.reason
