"""The solve's accuracy figures on exactly rendered textures; each limit is a named constant.

The noise figures compare standard deviations over some 3,000 nodal values: their own statistical error is about 1.4 %.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from textures import Affine, Texture, noisy_pair

from rgbmidic import NodeStatus, Region, Status, correlate

RIGID_BIAS = {"none": 0.0012, "binomial": 0.0006, "gaussian": 0.0004}
"""|mean error| in px for rigid shifts of 0 to 1 px, no noise, 4 px speckle: .00085, .00043, .00028 (table
`interpolation` of docs/explanation/uncertainty.md)."""
AFFINE_RMS = 9.5e-4
"""rms error in px for 1 % strain and 2 degrees of rotation, no noise: up to 6.5e-4."""
STRAIN = 4e-5
"""rms error of the strain at the nodes, no noise: up to 2.8e-5."""
STRAIN_BIAS = 2.7e-6
"""Mean error of the strain at the nodes, no noise, rms over five textures: up to 1.8e-6."""
NOISE = 0.02
"""Standard deviation in px of u and v of one light, noise of 8 % of the contrast: .0160 with the default prefilter."""
ROOT_OF_LIGHTS = 0.015
"""Relative deviation of the noise under k lights from 1/sqrt(k): .010."""
PREDICTED_NOISE = 0.06
"""Relative deviation of the predicted from the observed noise: .042."""
LARGE_MOTION_RMS = 4.5e-4
"""rms error in px after a motion of 40 px without any hint: 3.1e-4."""
GAP_RMS = 5e-4
"""rms error in px of the nodes beside a hole, invalid pixels or an untextured part: 3.4e-4."""
LIGHT_SHIFT = 2.5e-4
"""Error in px of the shift between two lights found by the rigid functions: 5.8e-5."""
BLANK_RMS = {0.0: 5.5e-4, 2.0: 0.013}
"""rms error in px of nodes away from a part without texture, by noise in grey levels: 3.8e-4, .0087."""
SEEN_RMS = 0.02
"""rms error in px of nodes well away from a part that does not match, noise of 2 grey levels: .014."""

CURVED_RMS = (0.0012, 0.0021)
"""rms error in px at the nodes of a curved field, no noise: inside .0008, with the edges .0014."""

SHAPE = (200, 200)
REGION = (20, 20, 180, 180)
MOTION = Affine.strain_and_rotation(0.005, 0.5, (1.3, -0.6))
PREFILTERS = ("none", "binomial", "gaussian")


@cache
def texture(seed: int = 0) -> Texture:
    return Texture.random(seed, speckle=4.0)


@cache
def reference_image() -> np.ndarray:
    return texture().image(SHAPE)


def error(found, motion=MOTION, shape=SHAPE):
    """(N, 2) in px; NaN where not measured."""
    return found.displacement - motion.displacement(found.nodes, shape)


def rms(values):
    return float(np.sqrt(np.nanmean(values**2)))


@pytest.mark.parametrize("prefilter", PREFILTERS)
def test_rigid_shifts_are_not_biased(prefilter):
    for tenths in range(6):  # of u, and the other ones of v
        motion = Affine(shift=(tenths / 10, 1 - tenths / 10))
        found = correlate(reference_image(), texture().image(SHAPE, motion), region=REGION, prefilter=prefilter)
        assert found.status is Status.CONVERGED
        assert found.measured.all()
        assert np.abs(error(found, motion).mean(axis=0)).max() <= RIGID_BIAS[prefilter]


@pytest.mark.parametrize(
    ("strain", "degrees", "prefilter"),
    [
        *((0.01, turn, prefilter) for turn in (2.0, -2.0) for prefilter in PREFILTERS),
        (-0.01, 0.0, "none"),
        (0.0, 2.0, "binomial"),
    ],
)
def test_strain_and_rotation_are_recovered(strain, degrees, prefilter):
    motion = Affine.strain_and_rotation(strain, degrees)
    found = correlate(reference_image(), texture().image(SHAPE, motion), region=REGION, prefilter=prefilter)
    assert found.status is Status.CONVERGED
    assert found.measured.all()
    assert rms(error(found, motion)) <= AFFINE_RMS


@pytest.mark.parametrize("stretch", [0.0, 0.01])
def test_the_strain_of_a_stretch_is_that_stretch_and_of_a_rigid_motion_none(stretch):
    motion = Affine(shift=(0.4, 0.3), gradient=((1 + stretch, 0.002), (0.0, 1 - stretch / 3)))
    pairs = [(one.image(SHAPE), one.image(SHAPE, motion)) for one in map(texture, range(5))]
    strains = np.array([correlate(*pair, region=REGION).strain for pair in pairs])
    errors = strains - (stretch, -stretch / 3, 0.001)
    assert rms(errors.mean(axis=1)) <= STRAIN_BIAS
    assert rms(errors) <= STRAIN


DRAWS = 20
NOISE_SHAPE, NOISE_REGION = (230, 230), (15, 15, 214, 214)
SIGMA = 4.0
"""Standard deviation of the white noise in grey levels; that of the texture is 50."""


@cache
def noise(lights: int, prefilter: str = "binomial", *, statistics: bool = True) -> tuple[float, float]:
    """Observed and predicted standard deviation of u and v in px under one or three lights with independent noise.

    One light has the mean of the noise of three times the square root of 3: the same draws, which scatter no ratio.
    """
    motion = Affine(shift=(0.3, 0.2))
    pair = [texture().image(NOISE_SHAPE), texture().image(NOISE_SHAPE, motion)]
    random, found = np.random.default_rng(1), []
    for _ in range(DRAWS):
        noises = random.normal(scale=SIGMA, size=(2, 3, *NOISE_SHAPE))
        if lights == 1:
            noises = noises.sum(axis=1, keepdims=True) / np.sqrt(3)
        noisy = [image + by for image, by in zip(pair, noises, strict=True)]
        options = {"prefilter": prefilter, "statistics": statistics}
        found.append(correlate(*noisy, region=NOISE_REGION, initial=motion.shift, **options))
    observed = np.stack([one.displacement for one in found]).std(axis=0, ddof=1)
    return rms(observed), rms(np.stack([one.displacement_std for one in found]))


@pytest.mark.parametrize("statistics", [False, True])
def test_the_noise_falls_as_the_root_of_the_number_of_lights(statistics):
    alone = noise(1, statistics=statistics)[0]
    assert alone <= NOISE
    assert noise(3, statistics=statistics)[0] * np.sqrt(3) == pytest.approx(alone, rel=ROOT_OF_LIGHTS)


@pytest.mark.parametrize(
    ("lights", "options"),
    [
        (1, {"prefilter": "none", "statistics": False}),
        (1, {"statistics": False}),
        (3, {"statistics": False}),
        (1, {"statistics": True}),
        (3, {"statistics": True}),
    ],
)
def test_the_predicted_noise_is_the_observed_one(lights, options):
    observed, predicted = noise(lights, **options)
    assert predicted == pytest.approx(observed, rel=PREDICTED_NOISE)


def test_twice_the_noise_doubles_the_prediction():
    pair = [reference_image(), texture().image(SHAPE, MOTION)]
    quiet, loud = (
        rms(correlate(*noisy_pair(pair, sigma, np.random.default_rng(0)), region=REGION).displacement_std)
        for sigma in (3.0, 6.0)
    )
    assert loud / quiet == pytest.approx(2, rel=0.05)


def test_the_nodes_of_a_curved_field_are_right():
    bend = 2e-4  # second derivative of u in 1/px: the best linear fit of 25 px elements is off by 0.01 px
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    material = x.copy()
    for _ in range(30):
        material = x - bend / 2 * (material - 100) ** 2
    found = correlate(reference_image(), texture().at(material, y), region=REGION)
    off = found.displacement[:, 0] - bend / 2 * (found.nodes[:, 0] - 100) ** 2
    inner = (np.abs(found.nodes - 100) < 60).all(axis=1)
    assert rms(off[inner]) < CURVED_RMS[0]
    assert rms(off) < CURVED_RMS[1]
    assert rms(found.strain[inner, 0] - bend * (found.nodes[inner, 0] - 100)) < STRAIN


@pytest.mark.parametrize("shift", [(40.0, 0.0), (-28.3, 28.3), (0.4, -40.2)])
def test_forty_pixels_of_motion_need_no_hint(shift):
    shape, motion = (300, 300), Affine.strain_and_rotation(0.002, 0.2, shift)
    found = correlate(texture().image(shape), texture().image(shape, motion), region=(60, 60, 240, 240))
    assert found.status is Status.CONVERGED
    assert found.measured.all()
    assert rms(error(found, motion, shape)) <= LARGE_MOTION_RMS


def material_points(motion=MOTION, shape=SHAPE):
    """Where the points seen at the pixels of the deformed image were in the reference image: x, y of shape (H, W)."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2])
    back = (points - middle - motion.shift) @ np.linalg.inv(np.array(motion.gradient)).T + middle
    return back[:, 0].reshape(shape), back[:, 1].reshape(shape)


def part(inside):
    """Masks of a part of the surface in the reference image and, moved along, in the deformed one."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    return inside(x, y), inside(*material_points())


def pair_with(masks, inside_reference, inside_deformed):
    """The strained pair with something else in a part of the surface."""
    deformed = texture().image(SHAPE, MOTION)
    return np.where(masks[0], inside_reference, reference_image()), np.where(masks[1], inside_deformed, deformed)


def away(found, inside, margin):
    """Nodes at least `margin` px from a part."""
    reach = [
        inside(found.nodes[:, 0] + dx, found.nodes[:, 1] + dy)
        for dx in (-margin, 0, margin)
        for dy in (-margin, 0, margin)
    ]
    return ~np.any(reach, axis=0)


def disc(x, y):
    return np.hypot(x - 100, y - 95) < 30


def left_half(x, y):
    return x < 100


def square(x, y):
    return np.maximum(np.abs(x - 100), np.abs(y - 100)) < 40


@pytest.mark.parametrize("inside", ["nothing", "something else"])
def test_a_hole_in_the_region_leaves_the_rest_as_good_as_without(inside):
    masks = part(disc)
    content = (np.nan, np.nan) if inside == "nothing" else (texture(8).image(SHAPE), texture(9).image(SHAPE))
    box = np.zeros(SHAPE, dtype=bool)
    box[20:181, 20:181] = True
    found = correlate(*pair_with(masks, *content), region=Region.from_mask(box & ~masks[0]))
    assert found.status is Status.CONVERGED
    assert found.measured.all()
    assert rms(error(found)) <= GAP_RMS


@pytest.mark.parametrize("side", ["reference", "deformed", "both"])
def test_invalid_pixels_flag_the_nodes_without_others_and_spare_the_rest(side):
    masks = part(disc)
    pair = pair_with(masks, np.nan, np.nan)
    whole = reference_image(), texture().image(SHAPE, MOTION)
    found = correlate(
        pair[0] if side != "deformed" else whole[0], pair[1] if side != "reference" else whole[1], region=REGION
    )
    assert found.status is Status.CONVERGED
    middle = np.hypot(*(found.nodes - (100, 95)).T) < 10
    assert middle.any()
    assert (found.node_status[middle] == NodeStatus.NOT_SEEN).all()
    assert np.isnan(found.displacement[middle]).all()
    assert found.measured[away(found, disc, 5)].all()
    assert rms(error(found)) <= GAP_RMS


def test_single_invalid_pixels_cost_little():
    reference = reference_image().copy()
    reference[np.random.default_rng(0).random(SHAPE) < 0.01] = np.nan
    found = correlate(reference, texture().image(SHAPE, MOTION), region=REGION)
    assert found.measured.all()
    assert rms(error(found)) <= GAP_RMS


@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_nodes_without_texture_are_flagged_and_the_others_measured(sigma):
    pair = pair_with(part(left_half), 200.0, 200.0)
    found = correlate(*noisy_pair(list(pair), sigma, np.random.default_rng(0)), region=REGION)
    assert found.status is Status.CONVERGED
    blank = found.nodes[:, 0] < 80
    assert (found.node_status[blank] != NodeStatus.MEASURED).all()
    assert np.isnan(found.displacement[blank]).all()
    assert found.measured[found.nodes[:, 0] > 100 + 27].all()
    assert rms(error(found)[found.nodes[:, 0] > 110]) <= BLANK_RMS[sigma]


@pytest.mark.parametrize("inside", [left_half, square])
def test_a_part_that_does_not_match_is_flagged_and_spoils_nothing_else(inside):
    reference, deformed = pair_with(part(inside), reference_image(), texture(9).image(SHAPE))
    noisy = noisy_pair([reference, deformed], 2.0, np.random.default_rng(0))
    found = correlate(*noisy, region=REGION)
    assert found.status is Status.CONVERGED
    well_inside = away(found, lambda x, y: ~inside(x, y), 15)
    assert well_inside.any()
    assert (found.node_status[well_inside] == NodeStatus.DECORRELATED).all()
    assert np.isnan(found.displacement[well_inside]).all()
    outside = away(found, inside, 28)
    assert found.measured[outside].all()
    assert rms(error(found)[outside]) <= SEEN_RMS
    assert np.nanmax(np.abs(error(found))) <= 0.2


@pytest.mark.parametrize("rigid", ["translation", "translation+rotation"])
def test_a_shift_between_two_lights_is_found_and_taken_out(rigid):
    between = np.array([0.37, -0.21])
    other = Affine(shift=tuple(np.array(MOTION.shift) + between), gradient=MOTION.gradient)
    f = np.stack([reference_image(), texture(1).image(SHAPE)])
    g = np.stack([texture().image(SHAPE, MOTION), texture(1).image(SHAPE, other)])
    weights = np.ones((2, *SHAPE))
    weights[0, :, :80] = weights[1, :, 120:] = 0
    found = correlate(f, g, region=REGION, rigid=rigid, weights=weights)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.rigid[0], 0)
    np.testing.assert_allclose(found.rigid[1, :2], between, atol=LIGHT_SHIFT)
    assert rms(error(found)) <= AFFINE_RMS
    assert rms(error(correlate(f, g, region=REGION, weights=weights))) > 10 * AFFINE_RMS


def test_a_rotation_between_two_lights_is_found():
    turn = np.radians(0.2)
    gradient = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    f = np.stack([reference_image(), texture(1).image(SHAPE)])
    g = np.stack([reference_image(), texture(1).image(SHAPE, Affine(gradient=tuple(map(tuple, gradient))))])
    found = correlate(f, g, region=REGION, rigid="translation+rotation")
    assert found.status is Status.CONVERGED
    assert found.rigid[1, 2] == pytest.approx(turn, abs=1e-5)
    assert rms(found.displacement) <= AFFINE_RMS


def test_one_blind_light_costs_nothing_where_the_other_sees():
    f = np.stack([reference_image(), texture(1).image(SHAPE)])
    g = np.stack([texture().image(SHAPE, MOTION), texture(1).image(SHAPE, MOTION)])
    g[0][part(left_half)[1]] = np.nan
    g[1][~part(lambda x, y: x < 120)[1]] = np.nan
    found = correlate(f, g, region=REGION)
    assert found.status is Status.CONVERGED
    assert found.measured.all()
    assert rms(error(found)) <= AFFINE_RMS
    assert 0.3 < found.weight_fraction[0] < 0.55
    assert 0.5 < found.weight_fraction[1] < 0.7


@pytest.mark.parametrize("noise", [0.001, 0.01, 0.1])
@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_stripes_are_not_measured_along_their_direction(noise, slope):
    line = texture(4).image((2, 600))[0]
    rows, columns = np.mgrid[:160, :200]
    seen = [np.interp(columns + slope * rows + shift, np.arange(600), line) for shift in (0.0, 0.3)]
    found = correlate(*noisy_pair(seen, noise * line.std(), np.random.default_rng(1)), region=(20, 20, 180, 140))
    assert not found.measured.any()
    assert "texture" in found.reason


def test_texture_longer_one_way_than_the_other_is_measured():
    rng = np.random.default_rng(2)
    image = 1000 + 300 * gaussian_filter(rng.standard_normal((160, 200)), (1.5, 4)) / 0.1
    found = correlate(*noisy_pair([image, image], 20.0, rng), region=(20, 20, 180, 140))
    assert found.measured.all()


def test_rigid_motions_need_a_first_light_that_sees():
    pair = np.stack([reference_image()] * 2)
    weights = np.stack([np.zeros(SHAPE), np.ones(SHAPE)])
    found = correlate(pair, pair, weights=weights, rigid="translation", region=REGION)
    assert found.status is Status.FAILED
    assert "first light" in found.reason


@pytest.mark.parametrize("level", [0.0, 5.0])
@pytest.mark.parametrize("brightness", ["constant", "auto"])
def test_a_light_that_is_off_leaves_the_others_their_displacement(level, brightness):
    """Its noise is not taken for speckle of little contrast: the error is as stated."""
    errors, image, random = [], reference_image(), np.random.default_rng(0)
    for _ in range(4):
        first, second = np.stack([[image, image], [image, np.full_like(image, level)]]) + random.normal(
            0, 2, (2, 2, *image.shape)
        )
        found = correlate(first, second, region=REGION, brightness=brightness, statistics=True)
        assert found.measured.all()
        errors.append(found.displacement / found.displacement_std)
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.25


@pytest.mark.parametrize("unit", [1e-12, 1e12])
@pytest.mark.parametrize("brightness", ["none", "auto"])
def test_uncertainty_does_not_depend_on_the_unit_of_the_grey_levels(unit, brightness):
    pair = noisy_pair([reference_image(), reference_image()], 2.0, np.random.default_rng(3))
    once, scaled = (correlate(*(i * u for i in pair), region=REGION, brightness=brightness) for u in (1.0, unit))
    np.testing.assert_allclose(scaled.displacement_std, once.displacement_std, rtol=0.02)


@pytest.mark.parametrize("degrees", [2.0, 3.0])
def test_elements_that_come_back_are_as_certain_as_if_they_had_never_been_lost(degrees):
    motion = Affine.strain_and_rotation(0.0, degrees)
    pair = noisy_pair([texture(5).image(SHAPE), texture(5).image(SHAPE, motion)], 2.0, np.random.default_rng(0))
    once = correlate(*pair, region=REGION, initial=(0, 0))  # the corners are off by more than a speckle
    start = motion.displacement(once.nodes, SHAPE)
    assert np.abs(start).max() > 2
    wanted = correlate(*pair, region=REGION, initial=start)
    assert once.measured.all()
    np.testing.assert_allclose(once.displacement_std, wanted.displacement_std, rtol=0.2)
