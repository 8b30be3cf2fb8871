"""Laws of the solve that hold whatever the images show: shifts, scales, copies, axes, threads."""

from __future__ import annotations

import numpy as np
import pytest
from bits import assert_same_on_threads
from hypothesis import given, settings
from hypothesis import strategies as st
from textures import Affine, Texture, noisy_pair

from rgbmidic import Solution, Status, correlate

SHAPE = (120, 132)
REGION = (18, 16, 112, 104)
FINE = {"tolerance": 1e-5, "prefilter": "binomial", "element_size": 22}
SAME = 2e-3
"""Displacements (px) that differ by single precision and by where the iteration stopped only."""

few = settings(max_examples=6)
seeds = st.integers(0, 2**32 - 1)
shifts = st.tuples(st.floats(-3, 3), st.floats(-3, 3))


def strained(seed: int, shift: tuple[float, float] = (0.4, -0.3), shape: tuple[int, int] = SHAPE) -> list[np.ndarray]:
    """A noisy pair under strain and rotation."""
    texture = Texture.random(seed)
    pair = [texture.image(shape), texture.image(shape, Affine.strain_and_rotation(0.004, 0.3, shift))]
    return noisy_pair(pair, 3.0, np.random.default_rng(seed))


def measured(*images: np.ndarray, **options: object) -> Solution:
    solution = correlate(*images, **{"region": REGION, **FINE, **options})
    assert solution.status is Status.CONVERGED, solution.reason
    assert solution.measured.all()
    return solution


@given(seed=seeds, shift=shifts)
@few
def test_a_rigid_shift_moves_every_node_alike(seed, shift):
    texture = Texture.random(seed)
    found = measured(texture.image(SHAPE), texture.image(SHAPE, Affine(shift=shift))).displacement
    np.testing.assert_allclose(found, np.broadcast_to(shift, found.shape), atol=3e-3)


@given(seed=seeds, dx=st.integers(0, 9), dy=st.integers(0, 9))
@few
def test_where_the_images_are_cut_out_changes_nothing(seed, dx, dy):
    pair = strained(seed)
    x0, y0, x1, y1 = REGION
    whole = measured(*pair).displacement
    cut = measured(*(image[dy:, dx:] for image in pair), region=(x0 - dx, y0 - dy, x1 - dx, y1 - dy)).displacement
    np.testing.assert_allclose(cut, whole, atol=SAME)


@given(seed=seeds, dx=st.integers(-9, 9), dy=st.integers(-9, 9))
@few
def test_whole_pixels_of_motion_add_exactly(seed, dx, dy):
    reference, deformed = strained(seed)
    moved = measured(reference, np.roll(deformed, (dy, dx), axis=(0, 1)))
    np.testing.assert_allclose(moved.displacement - (dx, dy), measured(reference, deformed).displacement, atol=SAME)


@given(seed=seeds)
@few
def test_exchanging_the_axes_exchanges_u_and_v(seed):
    pair = strained(seed)
    x0, y0, x1, y1 = REGION
    upright, lying = measured(*pair), measured(*(image.T for image in pair), region=(y0, x0, y1, x1))
    order = np.lexsort(np.round(upright.nodes, 3).T)
    turned = np.lexsort(np.round(lying.nodes[:, ::-1], 3).T)
    np.testing.assert_allclose(lying.nodes[turned, ::-1], upright.nodes[order], atol=1e-9)
    np.testing.assert_allclose(lying.displacement[turned, ::-1], upright.displacement[order], atol=SAME)


@given(seed=seeds, factor=st.floats(1e-3, 1e3))
@few
def test_the_unit_of_the_weights_changes_nothing(seed, factor):
    pair = strained(seed)
    weights = np.random.default_rng(seed).uniform(0.2, 1, SHAPE)
    once, scaled = (measured(*pair, weights=weights * c) for c in (1.0, factor))
    np.testing.assert_allclose(scaled.displacement, once.displacement, atol=SAME)
    np.testing.assert_allclose(scaled.displacement_std, once.displacement_std, rtol=1e-2)


@given(seed=seeds, gain=st.floats(0.01, 50), offset=st.floats(0, 300))
@few
def test_the_unit_of_the_grey_levels_changes_nothing(seed, gain, offset):
    pair = strained(seed)
    once, scaled = measured(*pair), measured(*(gain * (image + offset) for image in pair))  # float32 needs contrast
    # the gain is that of local means: what is added to all grey levels makes them more certain, by 3 % at a corner
    np.testing.assert_allclose(scaled.displacement, once.displacement, atol=5e-3)
    np.testing.assert_allclose(scaled.displacement_std, once.displacement_std, rtol=4e-2)


@pytest.mark.parametrize("copies", [2, 3, 5])
def test_copies_of_one_light_are_that_light(copies):
    reference, deformed = strained(7)
    one = measured(reference, deformed)
    many = measured(np.stack([reference] * copies), np.stack([deformed] * copies))
    np.testing.assert_allclose(many.displacement, one.displacement, atol=SAME)
    np.testing.assert_allclose(many.residual, np.repeat(one.residual, copies), rtol=1e-3)


def test_the_order_of_the_lights_changes_nothing():
    lights = [strained(seed) for seed in (1, 2, 3)]
    f, g = (np.stack(images) for images in zip(*lights, strict=True))
    weights = np.random.default_rng(0).uniform(0, 1, f.shape)
    there, back = measured(f, g, weights=weights), measured(f[::-1], g[::-1], weights=weights[::-1])
    np.testing.assert_allclose(back.displacement, there.displacement, atol=SAME)
    np.testing.assert_allclose(back.residual[::-1], there.residual, rtol=1e-3)


def test_an_excluded_light_has_no_say():
    reference, deformed = strained(1)
    nonsense = Texture.random(99).image(SHAPE)
    weights = np.stack([np.ones(SHAPE), np.zeros(SHAPE)])
    both = measured(np.stack([reference, nonsense]), np.stack([deformed, nonsense]), weights=weights)
    np.testing.assert_allclose(both.displacement, measured(reference, deformed).displacement, atol=SAME)
    assert both.weight_fraction[1] == 0
    assert np.isnan(both.residual[1])


def test_the_same_bits_every_time_and_on_any_number_of_threads():
    pair = strained(5)

    def found():
        results = [correlate(*pair, region=REGION) for _ in range(2)]
        return [values for result in results for values in (result.displacement, result.displacement_std)]

    assert_same_on_threads(found)
    first, first_std, second, second_std = found()
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first_std, second_std)
