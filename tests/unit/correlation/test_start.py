"""The search for a start: what motions it finds, how sure it is, and that nothing but the images decides it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import Region, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import Search, find_initial_guess
from rgbmidic.settings import SolverSettings
from rgbmidic.weights import Statistics

SHAPE = (260, 320)
RECTANGLE = (80, 60, 240, 200)
WITHIN = 1.5
"""Farthest (px) of a node from the truth: Gauss-Newton converges from there on speckles of 3.5 px and more."""
MOTIONS = {
    "small": Affine(shift=(1.3, -2.2)),
    "half the region": Affine(shift=(-75.0, 50.0)),
    "turn": Affine.strain_and_rotation(0.0, 30.0, (10.0, 5.0)),
    "turn back": Affine.strain_and_rotation(0.0, -30.0),
    "tension": Affine(gradient=((1.2, 0.0), (0.0, 0.94))),
    "compression": Affine(gradient=((0.8, 0.0), (0.0, 1.1))),
    "turn and stretch": Affine.strain_and_rotation(0.1, 20.0, (-20.0, 10.0)),
}


def prepared(first, second, first_weights=None, second_weights=None):
    images, moved = (np.asarray(np.reshape(each, (-1, *SHAPE)), dtype=np.float32) for each in (first, second))
    region = Region.from_rectangle(RECTANGLE, SHAPE)
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(images, region, first_weights, mesh=mesh, prefilter="binomial")
    return reference, Deformed.prepare(moved, second_weights, prefilter="binomial")


def lattice(seed, step=7.0):
    """Spots of 4 px on a jittered lattice: no content coarser than its step."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*(np.arange(-150.0, 500.0, step),) * 2), axis=-1).reshape(-1, 2)
    centres = grid + random.uniform(-0.25, 0.25, grid.shape) * step

    def image(motion):
        canvas = np.full(tuple(4 * n for n in SHAPE), 200, dtype=np.uint8)
        for x, y in np.round((centres + motion.displacement(centres, SHAPE)) * 64).astype(int):
            cv2.circle(canvas, (int(x), int(y)), 8 * 16, 40, -1, cv2.LINE_8, 4)
        return cv2.resize(canvas, SHAPE[::-1], interpolation=cv2.INTER_AREA)

    return image


def largest_error(reference, found, motion):
    nodes = reference.mesh.nodes
    return np.linalg.norm(found.displacement - motion.displacement(nodes, SHAPE), axis=1).max()


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("speckle", [3.0, 7.0])
def test_motions_are_found_on_speckles_of_any_size(name, speckle):
    texture, motion = Texture.random(1, speckle), MOTIONS[name]
    reference, deformed = prepared(texture.image(SHAPE), texture.image(SHAPE, motion))
    found = find_initial_guess(reference, deformed)
    assert found.confidence > 0.8
    assert largest_error(reference, found, motion) < WITHIN


@pytest.mark.parametrize("name", ["half the region", "turn", "compression"])
def test_a_lattice_without_coarse_content_is_found(name):
    image, motion = lattice(2), MOTIONS[name]
    reference, deformed = prepared(image(Affine()), image(motion))
    found = find_initial_guess(reference, deformed)
    assert found.confidence > 0.8
    assert largest_error(reference, found, motion) < WITHIN


def test_three_lights_with_reflections_that_stay_behind_are_found():
    texture, motion, random = Texture.random(3, 4.0), MOTIONS["turn and stretch"], np.random.default_rng(3)
    stacks, weights = [], []
    for image in (texture.image(SHAPE), texture.image(SHAPE, motion)):
        lights, used = np.stack([level * image for level in (0.7, 1.0, 1.3)]), np.ones((3, *SHAPE), dtype=np.float32)
        for light, left in enumerate((80, 130, 180)):
            lights[light, :, left : left + 50] += 400 + 100 * random.normal(size=(SHAPE[0], 50))
            used[light, :, left : left + 40] = 0  # the rim of the reflection is not recognised
        stacks.append(lights)
        weights.append(used)
    reference, deformed = prepared(*stacks, *weights)
    found = find_initial_guess(reference, deformed)
    assert largest_error(reference, found, motion) < 2 * WITHIN


def test_two_bodies_may_move_apart():
    texture, motions = Texture.random(4, 4.0), (Affine(shift=(-30.0, 8.0)), Affine(shift=(25.0, -10.0)))
    moved, middle = np.full(SHAPE, 200.0), SHAPE[1] // 2
    for motion, body in zip(motions, (np.s_[:, : middle - 30], np.s_[:, middle + 25 :]), strict=True):
        moved[body] = texture.image(SHAPE, motion)[body]
    reference, deformed = prepared(texture.image(SHAPE), moved)
    found = find_initial_guess(reference, deformed)
    nodes = reference.mesh.nodes
    for motion, side in zip(motions, (nodes[:, 0] < middle - 25, nodes[:, 0] > middle + 25), strict=True):
        assert np.abs(found.displacement - motion.shift)[side].max() < WITHIN


def test_another_specimen_gives_no_confidence():
    reference, deformed = prepared(Texture.random(5).image(SHAPE), Texture.random(6).image(SHAPE))
    assert find_initial_guess(reference, deformed).confidence < 0.15


def test_confidence_is_the_share_that_correlates():
    texture = Texture.random(7)
    reference, deformed = prepared(texture.image(SHAPE), texture.image(SHAPE, Affine(shift=(20.0, 0.0))))
    displacement = np.tile([20.0, 0.0], (len(reference.mesh.nodes), 1))
    assert Search().confidence(Residual.at(reference, deformed, [displacement])) == 1
    left = reference.mesh.nodes[:, 0] < 160
    displacement[left] += 12
    partly = Residual.at(reference, deformed, [displacement])
    assert Search().confidence(partly) == pytest.approx(1 - left.mean(), abs=0.15)


def test_a_solve_is_the_same_bits_from_a_residual_that_is_known():
    texture = Texture.random(8)
    reference, deformed = prepared(texture.image(SHAPE), texture.image(SHAPE, Affine(shift=(0.3, -0.2))))
    rest = np.zeros_like(reference.mesh.nodes)
    residual = Residual.at(reference, deformed, [rest])
    alone, known = (solve(reference, deformed, rest, SolverSettings(), Statistics(), one) for one in (None, residual))
    np.testing.assert_array_equal(known.displacement, alone.displacement)
    np.testing.assert_array_equal(known.displacement_std, alone.displacement_std)


def test_starts_are_surer_and_surer_and_the_same_on_any_threads():
    texture = Texture.random(8, 3.0)
    reference, deformed = prepared(texture.image(SHAPE), texture.image(SHAPE, MOTIONS["turn"]))
    threads, every = cv2.getNumThreads(), []
    try:
        for count in (1, 4):
            cv2.setNumThreads(count)
            every.append(list(Search().candidates(reference, deformed)))
    finally:
        cv2.setNumThreads(threads)
    for one, four in zip(*every, strict=True):
        np.testing.assert_array_equal(one.displacement, four.displacement)
    sure = [found.confidence for found in every[0]]
    assert sure == sorted(sure)
