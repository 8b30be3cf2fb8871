"""Lights that see a point elsewhere than the first: the solve reads each where its registration says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import Region, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference, TrackingState
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import find_initial_guess
from rgbmidic.illumination.images import Registration
from rgbmidic.settings import SolverSettings

SHAPE = (240, 300)
REGION = Region.from_rectangle((70, 50, 220, 190), SHAPE)
LIGHTS = ("red", "green", "blue")
OFF = np.array([[0.0] * 5, [0.6, -0.4, 1e-3, 3e-3, 1e-3], [-1.3, 0.7, -1e-3, -4e-3, -1e-3]])
MOTION = Affine.strain_and_rotation(0.004, 3.0, (14.3, -9.6))
ERROR = 2.4e-4
"""px (rms), without noise: 2.0e-4 measured; 1.8e-4 with images warped to the first light's pixels, 9e-3 without either.
With noise of a tenth and a third of the contrast, the two differ by a thousandth."""


def registered(parameters=OFF, origin=(0, 0)):
    return replace(Registration.identity(LIGHTS, SHAPE), parameters=parameters).cropped(origin)


def images(registration, motion=None, seed=5):
    """What the lights show of a texture after a motion, (3, H, W)."""
    texture, y, x = Texture.random(seed, waves=80), *np.mgrid[: SHAPE[0], : SHAPE[1]].reshape(2, -1).astype(float)
    motion, points, middle = motion or Affine(), np.stack([x, y], axis=1), (np.array(SHAPE[::-1]) - 1) / 2
    lights = []
    for light in range(3):
        first = points
        for _ in range(8):  # the light shows at x + rho(x) what the first shows at x
            first = points - registration.displacement(first)[light]
        back = (first - middle - motion.shift) @ np.linalg.inv(np.array(motion.gradient)).T + middle
        lights.append(texture.at(*back.T).reshape(SHAPE))
    return np.asarray(lights, dtype=np.float32)


def prepared(stack, registration, **given):
    mesh = Tri3Mesh.from_region(REGION, 20)
    return Reference.prepare(stack, REGION, mesh=mesh, prefilter="binomial", registration=registration, **given)


def solved(first, second, registration, **place):
    """Solution with equal weights from the exact displacement."""
    deformed = Deformed.prepare(second, prefilter="binomial", **place)
    start = MOTION.displacement(Tri3Mesh.from_region(REGION, 20).nodes, SHAPE)
    return solve(prepared(first, registration), deformed, start, SolverSettings(), None)


def error(solution, motion=MOTION):
    return float(np.sqrt(np.mean((solution.displacement - motion.displacement(solution.nodes, SHAPE)) ** 2)))


@pytest.fixture(scope="module")
def pair():
    return [images(registered(), motion) for motion in (None, MOTION)]


def test_a_light_is_read_where_it_lies_however_far_the_points_move(pair):
    assert error(solved(*pair, registered())) < ERROR
    assert error(solved(*pair, None)) > 10 * ERROR


def test_images_that_begin_elsewhere_are_read_at_the_same_place_of_the_frame(pair):
    part = np.ascontiguousarray(pair[1][:, 16:, 32:])
    moved, whole = solved(pair[0], part, registered(), origin=(32, 16)), solved(*pair, registered())
    np.testing.assert_allclose(moved.displacement, whole.displacement, atol=2e-5)


def test_grey_levels_gradients_and_weights_are_those_of_the_same_point(pair):
    plain, off = prepared(images(registered(0 * OFF)), None), prepared(pair[0], registered())
    contrast = plain.values.std()
    for name in ("values", "gradient"):
        assert np.abs(getattr(off, name) - getattr(plain, name)).max() < 0.05 * contrast
    holed = pair[0].copy()
    holed[2, 120, 150] = np.nan
    weight = prepared(holed, registered()).pixel_weights
    x, y = off.pixels.columns, off.pixels.rows
    there = np.stack([x, y], axis=1) + registered().displacement(np.stack([x, y], axis=1))[2] - (150, 120)
    near = np.abs(there).max(axis=1)
    assert not weight[2, near <= 2].any()
    assert weight[2, near > 3.5].all()
    assert weight[:2].all()


def test_lights_far_apart_are_searched_together():
    """At a turn pictures of lights 10 px apart, one over the other, no longer match (confidence 0)."""
    far, turned = OFF + np.outer([0, 9, -8], [1, -0.8, 0, 0, 0]), Affine.strain_and_rotation(0.004, 15.0, (14.3, -9.6))
    first, second = (images(registered(far), motion) for motion in (None, turned))
    found = find_initial_guess(prepared(first, registered(far)), Deformed.prepare(second, prefilter="binomial"))
    assert found.confidence > 0.95


def test_a_reference_update_reads_the_lights_where_they_lie(pair):
    first, second = pair
    options, none = SolverSettings(), ReferenceUpdate.none(prepared(first, registered()))
    start = TrackingState(displacement=MOTION.displacement(none.first.mesh.nodes, SHAPE))
    before = none.track(Deformed.prepare(second, prefilter="binomial"), start, options, None)
    later = none.updated(before, second, np.ones_like(second))
    moved = Affine(gradient=MOTION.gradient, shift=(MOTION.shift[0] + 0.5, MOTION.shift[1] + 20.4))
    third = Deformed.prepare(images(registered(), moved), prefilter="binomial")
    start = TrackingState(displacement=moved.displacement(none.first.mesh.nodes, SHAPE))
    assert error(later.track(third, start, options, None), moved) < 2 * ERROR
