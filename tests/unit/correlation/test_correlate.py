"""`correlate`: what it takes, what it refuses, and how it says that it could not measure."""

from __future__ import annotations

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import NodeStatus, Region, Status, correlate
from rgbmidic.errors import InputError, RegionError

SHAPE = (90, 100)
SHIFT = (0.7, -0.4)


@pytest.fixture(scope="module")
def pair():
    texture = Texture.random(0)
    return texture.image(SHAPE), texture.image(SHAPE, Affine(shift=SHIFT))


def test_plain_arrays_give_a_mesh_a_field_and_its_uncertainty(pair):
    found = correlate(*pair)
    assert found.status is Status.CONVERGED
    assert found.reason == ""
    assert found.nodes.shape == found.displacement.shape == found.displacement_std.shape
    assert found.elements.shape[1] == 3
    assert found.history[-1] <= 1e-3
    assert found.iterations == len(found.history)
    np.testing.assert_array_equal(found.nodes.min(axis=0), (0, 0))
    np.testing.assert_array_equal(found.nodes.max(axis=0), (SHAPE[1] - 1, SHAPE[0] - 1))
    inner = ((found.nodes > 10) & (found.nodes < 80)).all(axis=1)
    np.testing.assert_allclose(found.displacement[inner], np.broadcast_to(SHIFT, (inner.sum(), 2)), atol=7e-4)


@pytest.mark.parametrize(("shift", "most"), [((0.0, 0.0), 3), ((0.3, -0.2), 5)])
def test_few_iterations_are_taken(shift, most):
    """Of images without noise; at rest the last row lies on the image's edge or just beyond it, as rounding has it."""
    texture = Texture.random(0)
    found = correlate(texture.image(SHAPE), texture.image(SHAPE, Affine(shift=shift)), initial=(0.0, 0.0))
    assert found.iterations <= most
    assert np.nanmedian(np.abs(found.displacement - shift)) < 5e-4  # what splines of this speckle err by


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64, np.int32])
def test_any_real_number_type_is_taken(pair, dtype):
    images = [np.round(image / 2).clip(0, 255).astype(dtype) for image in pair]
    found = correlate(*images, region=(12, 12, 85, 75))
    np.testing.assert_allclose(found.displacement, np.broadcast_to(SHIFT, found.displacement.shape), atol=0.016)


def test_a_region_may_be_a_mask_or_polygon(pair):
    polygon = Region.from_polygon([(12, 12), (85, 20), (60, 76), (15, 70)], SHAPE)
    found = correlate(*pair, region=polygon, element_size=15)
    assert found.measured.all()
    np.testing.assert_allclose(found.displacement, np.broadcast_to(SHIFT, found.displacement.shape), atol=0.005)


def test_a_stack_of_one_light_is_that_light(pair):
    f, g = pair
    np.testing.assert_array_equal(correlate(f[None], g[None]).displacement, correlate(f, g).displacement)


@pytest.mark.parametrize("initial", [None, SHIFT])
def test_gaps_are_filled_where_that_is_asked_for(pair, initial):
    images = [np.where(np.arange(SHAPE[1]) > 70, np.nan, image) for image in pair]
    options = {"region": (12, 12, 95, 75), "element_size": 12, "initial": initial}
    gaps, filled = (correlate(*images, fill=distance, **options) for distance in (0, 50))
    assert not gaps.measured.all()
    np.testing.assert_array_equal(np.isnan(gaps.displacement).any(axis=1), ~gaps.measured)
    assert (filled.node_status[~gaps.measured] == NodeStatus.FILLED).all()
    np.testing.assert_array_equal(filled.displacement[gaps.measured], gaps.displacement[gaps.measured])
    np.testing.assert_allclose(filled.displacement, np.broadcast_to(SHIFT, filled.displacement.shape), atol=0.009)
    assert filled.displacement_std[~gaps.measured].min() > np.median(gaps.displacement_std[gaps.measured])


@pytest.mark.parametrize("initial", [SHIFT, "nodes"])
def test_a_start_may_be_one_motion_or_one_per_node(pair, initial):
    blank = correlate(*pair, region=(12, 12, 85, 75))
    start = blank.displacement if initial == "nodes" else initial
    found = correlate(*pair, region=(12, 12, 85, 75), initial=start)
    np.testing.assert_allclose(found.displacement, blank.displacement, atol=2e-3)


@pytest.mark.parametrize("initial", [(20, -15), "turned"])
def test_a_wrong_start_is_one_candidate_beside_the_search(pair, initial):
    found = correlate(*pair, region=(12, 12, 85, 75))
    start = 0.5 * (found.nodes - found.nodes.mean(axis=0))[:, ::-1] if initial == "turned" else initial
    other = correlate(*pair, region=(12, 12, 85, 75), initial=start)
    assert other.measured.all()
    np.testing.assert_allclose(other.displacement, found.displacement, atol=2e-3)


def test_the_largest_number_of_iterations_is_kept_and_told():
    texture = Texture.random(0)
    pair = texture.image(SHAPE), texture.image(SHAPE, Affine(shift=(0.8, 0)))
    found = correlate(*pair, initial=(0, 0), max_iterations=1)
    assert found.iterations == 1
    assert found.status is Status.NOT_CONVERGED
    assert "px" in found.reason


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"deformed": np.ones((90, 99))}, r"one shape.*90, 100.*90, 99"),
        ({"reference": np.ones(100)}, "reference must be a real image"),
        ({"reference": np.ones((90, 100), complex)}, "reference must be a real image"),
        ({"reference": np.ones((90, 100), bool)}, "reference must be a real image .*, not bool"),
        ({"reference": np.ones((7, 100)), "deformed": np.ones((7, 100))}, "at least 8 x 8 px"),
        ({"reference": np.ones((0, 90, 100)), "deformed": np.ones((0, 90, 100))}, "at least one image"),
        ({"weights": np.ones((90, 99))}, "weights must have shape"),
        ({"weights": -np.ones(SHAPE)}, "weights must be finite, not negative"),
        ({"weights": np.full(SHAPE, np.nan)}, "weights must be finite, not negative"),
        ({"deformed_weights": np.full(SHAPE, np.inf)}, "deformed_weights must be finite"),
        ({"initial": (1, 2, 3)}, "initial must be finite with shape"),
        ({"initial": (np.nan, 0)}, "initial must be finite"),
        ({"prefilter": "median"}, 'prefilter must be one of "none", "binomial", "gaussian", not "median"'),
        ({"rigid": "scale"}, 'rigid must be one of "none", "translation", "translation.rotation", not "scale"'),
        ({"brightnes": "local"}, 'unknown option "brightnes".*did you mean "brightness"'),
        ({"element_size": 2}, "at least 4 px"),
        ({"region": Region.from_rectangle((0, 0, 50, 50), (80, 80))}, "region is for images"),
    ],
)
def test_bad_input_is_refused_in_words(pair, change, message):
    arguments = {"reference": pair[0], "deformed": pair[1], **change}
    with pytest.raises(InputError, match=message):
        correlate(arguments.pop("reference"), arguments.pop("deformed"), **arguments)


def test_a_region_outside_the_images_is_refused(pair):
    with pytest.raises(RegionError, match="does not overlap"):
        correlate(*pair, region=(200, 0, 300, 50))


FLAT, UNKNOWN = np.full(SHAPE, 200.0), np.full(SHAPE, np.nan)


@pytest.mark.parametrize(
    ("reference", "deformed", "options", "reason"),
    [
        (FLAT, FLAT, {}, "no texture"),
        (FLAT, None, {}, "no texture"),
        (UNKNOWN, None, {}, "no light sees"),
        (None, UNKNOWN, {}, "no light sees"),
        (None, None, {"weights": np.zeros(SHAPE)}, "no light sees"),
        (None, None, {"deformed_weights": np.zeros(SHAPE)}, "no light sees"),
        (None, FLAT, {}, "do not match"),
        (None, Texture.random(5).image(SHAPE), {}, "do not match"),
    ],
)
def test_what_cannot_be_measured_is_nan_with_a_reason_and_no_crash(pair, reference, deformed, options, reason):
    images = (pair[0] if reference is None else reference, pair[1] if deformed is None else deformed)
    found = correlate(*images, **options)
    assert found.status is Status.FAILED
    assert reason in found.reason
    assert np.isnan(found.displacement).all()
    assert np.isnan(found.displacement_std).all()
    assert (found.node_status != NodeStatus.MEASURED).all()
    assert np.isnan(found.residual).all()


@pytest.mark.parametrize("prefilter", ["none", "binomial"])
def test_texture_in_one_direction_only_is_no_texture_and_no_crash(prefilter):
    ramp = np.add.outer(np.arange(100.0), np.arange(110.0))
    found = correlate(ramp, ramp - 1, region=(15, 15, 95, 85), prefilter=prefilter)
    assert found.status is Status.FAILED
    assert np.isnan(found.displacement).all()


def test_solutions_can_be_compared_and_kept_in_a_set(pair):
    one, other = (correlate(*pair, initial=SHIFT) for _ in range(2))
    assert one == one
    assert one != other
    assert len({one, other}) == 2


@pytest.mark.parametrize("degrees", [8, 30, 85])
def test_a_turn_costs_no_iterations(degrees):
    shape, lights = (160, 160), (Texture.random(3), Texture.random(4))
    motions = [Affine.strain_and_rotation(0.01, degrees, shift) for shift in ((2.3, 1.1), (2.7, 0.7))]
    images = np.stack([texture.image(shape) for texture in lights])
    turned = np.stack([texture.image(shape, motion) for texture, motion in zip(lights, motions, strict=True)])
    start = correlate(images, images, region=(50, 50, 110, 110), initial=(0, 0)).nodes
    truth = motions[0].displacement(start, shape)
    found = correlate(
        images, turned, region=(50, 50, 110, 110), initial=truth + 0.3, rigid="translation", statistics=False
    )
    assert found.status is Status.CONVERGED
    assert found.iterations <= 8
    np.testing.assert_allclose(found.displacement, truth, atol=0.0069)
    np.testing.assert_allclose(found.rigid[1], (0.4, -0.4), atol=0.0016)


@pytest.mark.parametrize("shift", [0.0, 0.3, 1.0])
def test_a_node_beyond_the_last_pixel_is_not_measured(shift):
    texture, motion = Texture.random(5), Affine(shift=(shift, 0))
    images = (texture.image(SHAPE, one) + noise for one, noise in zip((None, motion), white_noise(SHAPE), strict=True))
    found = correlate(*images, element_size=18)
    last = found.nodes[:, 0] == SHAPE[1] - 1
    assert found.measured[~last].all()
    assert found.measured[last].all() == (shift == 0)
    assert found.measured[last].any() == (shift == 0)
    assert (found.node_status[last] == NodeStatus.NOT_SEEN).all() == (shift > 0)


def test_a_background_at_rest_beside_a_rectangle_does_not_count():
    shape, inside = (200, 120), np.abs(np.arange(120) - 59.5) < 40
    images = (
        np.where(inside, Texture.random(6).image(shape, one), Texture.random(7).image(shape)) + noise
        for one, noise in zip((None, Affine(shift=(0, 3))), white_noise(shape), strict=True)
    )
    found = correlate(*images, region=(19, 10, 100, 189), element_size=20)  # a pixel of it on either side
    error = found.displacement - (0, 3)
    assert found.measured.mean() > 0.95
    assert np.sqrt(np.nanmean(error**2)) < 0.04  # .017 to .023, with the background .075 to .105
    assert np.sqrt(np.nanmean((error / found.displacement_std) ** 2)) < 1.4


def white_noise(shape):
    """Noise of 2 grey levels of two images."""
    return np.random.default_rng(1).normal(0, 2, (2, *shape))
