"""Every correlation and interpolation kernel against its naive twin, at edges, with NaN, and on one and two threads."""

from __future__ import annotations

from types import SimpleNamespace

import naive_correlation as naive
import numpy as np
import pytest
from bits import assert_same_on_threads

from rgbmidic._kernels import correlation as kernels
from rgbmidic._kernels import owned_pixels
from rgbmidic._kernels.splines import PAD, bspline_coefficients, pixel_gradient, sample_with_gradient
from rgbmidic.correlation.reference import _count_nonuniform_blocks
from rgbmidic.correlation.residual import curved_deviation
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh

SHAPE = (31, 38)
MOTIONS = ("none", "inside", "over the edge", "far outside")


def scene(seed=0, motion="inside", shape=SHAPE, outlined=False):
    """Random images, weights and displacement on a small mesh."""
    random = np.random.default_rng(seed)
    region = Region.from_rectangle((3.4, 2, shape[1] - 4, shape[0] - 3.7), shape)
    if outlined:
        region = Region.from_polygon([(2, 3), (35, 6), (30, 28), (5, 24)], shape)
    mesh = Tri3Mesh.from_region(region, 9)
    pixels = PixelMap.from_mesh(mesh, region)
    image = random.uniform(0, 200, shape).astype(np.float32)
    coefficients = np.empty((shape[0] + 2 * PAD, shape[1] + 2 * PAD), dtype=np.float32)
    bspline_coefficients(image, coefficients)
    spread, shift = {"none": (0, 0), "inside": (0.9, 0.3), "over the edge": (2, -4.5), "far outside": (1, 300)}[motion]
    count = pixels.rows.size
    weight = random.uniform(0, 1, count).astype(np.float32)
    weight[random.random(count) < 0.3] = 0
    return SimpleNamespace(
        mesh=mesh,
        pixels=pixels,
        image=image,
        coefficients=coefficients,
        displacement=shift + random.uniform(-spread, spread, mesh.nodes.shape)
        if spread
        else np.zeros(mesh.nodes.shape),
        reference=random.uniform(0, 200, count).astype(np.float32),
        gradient=random.normal(0, 20, (2, count)).astype(np.float32),
        weight=weight,
        on_map=(pixels.local_x, pixels.local_y, pixels.offsets),
        random=random,
    )


def close(found, expected, scale=None):
    """Equal to single precision, relative to the largest value (sums of mixed signs cancel)."""
    scale = np.nanmax(np.abs(expected)) if scale is None else scale
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5 * max(scale, 1e-30))


def moved(case):
    """The arguments that describe pixels moved by a displacement."""
    return (
        case.pixels.runs,
        case.pixels.run_offsets,
        case.pixels.origin,
        case.mesh.elements,
        case.pixels.barycentric,
        case.displacement,
    )


@pytest.mark.parametrize("shape", [(8, 8), (9, 31), (64, 65), (130, 71), (3, 200)])
def test_coefficients_equal_scipys_with_a_mirrored_border(shape):
    image = np.random.default_rng(sum(shape)).uniform(0, 4000, shape).astype(np.float32)
    out = np.full((shape[0] + 2 * PAD, shape[1] + 2 * PAD), np.nan, dtype=np.float32)
    bspline_coefficients(image, out)
    np.testing.assert_allclose(out, naive.bspline_coefficients(image), rtol=1e-5, atol=5e-3)


def test_the_spline_passes_through_the_pixels_and_an_invalid_one_stays_invalid():
    case = scene(1)
    y, x = (axis.ravel().astype(np.float64) for axis in np.mgrid[: SHAPE[0], : SHAPE[1]])
    out = np.empty((3, x.size), dtype=np.float32)
    sample_with_gradient(case.coefficients, x, y, *out)
    np.testing.assert_allclose(out[0], case.image.ravel(), atol=2e-3)
    case.image[10, 12] = np.nan
    bspline_coefficients(case.image, case.coefficients)
    sample_with_gradient(case.coefficients, x, y, *out)
    assert np.isnan(out[:, 10 * SHAPE[1] + 12]).all()


@pytest.mark.parametrize("seed", range(3))
def test_samples_and_gradients_equal_the_naive_twin(seed):
    case = scene(seed)
    x = np.concatenate([case.random.uniform(-3, SHAPE[1] + 2, 80), [0, SHAPE[1] - 1, SHAPE[1] - 1, 12]])
    y = np.concatenate([case.random.uniform(-3, SHAPE[0] + 2, 80), [0, SHAPE[0] - 1, 3.5, SHAPE[0] - 1]])
    out = np.empty((3, x.size), dtype=np.float32)
    sample_with_gradient(case.coefficients, x, y, *out)
    close(out, naive.sample_with_gradient(case.coefficients, x, y))


@pytest.mark.parametrize("outlined", [False, True])
def test_gradients_at_the_owned_pixels_equal_the_naive_twin(outlined):
    case = scene(1, outlined=outlined)
    out = np.empty((2, case.pixels.local_x.size), dtype=np.float32)
    pixel_gradient(case.pixels.lines, case.coefficients, *case.pixels.bounds[:2], *out)
    close(out, naive.sample_with_gradient(case.coefficients, case.pixels.columns, case.pixels.rows)[1:])


def test_an_invalid_coefficient_reaches_the_pixels_around_it_only():
    case = scene(4, "none")
    weights = np.ones(SHAPE, np.float32), case.weight
    clean = compared(case, *weights)[0]
    case.coefficients[15 + PAD, 18 + PAD] = np.nan
    dirty = compared(case, *weights)[0]
    touched = np.isnan(naive.warp(case.coefficients, case.pixels, case.mesh, case.displacement))
    np.testing.assert_array_equal(np.isnan(dirty), touched)
    assert touched.any()
    np.testing.assert_array_equal(dirty[~touched], clean[~touched])


@pytest.mark.parametrize("outlined", [False, True])
def test_hessian_equals_the_naive_twin(outlined):
    case = scene(5, outlined=outlined)
    out = np.full((len(case.mesh.elements), 3, 3, 3), 7.0)
    kernels.element_hessian(*case.gradient, case.weight, *case.on_map, case.pixels.barycentric, out)
    close(out, naive.element_hessian(case.gradient, case.weight, case.pixels))


@pytest.mark.parametrize(("outlined", "side", "apart"), [(False, 4, 2), (True, 4, 3), (True, 50, 2)])
def test_products_of_blocks_equal_the_naive_twin(outlined, side, apart):
    case = scene(6, outlined=outlined)
    sign = case.random.choice(np.float32([-1, 1]), case.pixels.grid(side))
    out = block_products(case, sign, side, apart, fill=2.0) - 2.0
    close(out, naive.element_block_products(case.gradient, case.weight, case.pixels, sign, side, apart))


def block_products(case, sign, side, apart, fill=0.0):
    """What `element_block_products` adds."""
    pixels, out = case.pixels, np.full((apart * apart, len(case.mesh.elements), 3, 3), fill)
    place = pixels.runs, pixels.run_offsets, pixels.origin - pixels.bounds[1::-1], pixels.barycentric
    kernels.element_block_products(*case.gradient, case.weight, *place, sign, side, apart, out)
    return out


@pytest.mark.parametrize("outlined", [False, True])
@pytest.mark.parametrize("motion", MOTIONS)
def test_compared_states_equal_the_naive_twins(motion, outlined):
    case = scene(6, motion, outlined=outlined)
    given = case.random.uniform(0.2, 1, SHAPE).astype(np.float32)
    given[case.random.random(SHAPE) < 0.1] = 0
    given[4:25, 5:30] = 1
    difference, weight, moments = compared(case, given, case.weight)
    expected = np.nan_to_num(case.reference - naive.warp(case.coefficients, case.pixels, case.mesh, case.displacement))
    np.testing.assert_allclose(difference, expected, atol=0.02)
    expected = naive.pull_back(given, case.weight, case.pixels, case.mesh, case.displacement)
    np.testing.assert_allclose(weight, expected, atol=1e-4)
    expected = naive.element_moments(case.reference, difference, weight, case.pixels)
    np.testing.assert_allclose(moments, expected, rtol=1e-5)
    assert (difference == 0).all() == (motion == "far outside")
    assert (weight == 0).all() == (motion == "far outside")


def compared(case, given, weight):
    """Difference, weight and moments for a deformed weight (H, W) and a reference weight (P,): of two lights alike."""
    difference, found = np.full((2, 2, case.pixels.rows.size), 7, dtype=np.float32)
    moments, is_changed = (
        np.full((2, len(case.mesh.elements), 6), 7.0),
        np.empty((2, len(case.mesh.elements)), dtype=bool),
    )
    kernels.find_changed_weights(twice(_count_nonuniform_blocks(given)), *given.shape, *moved(case), is_changed)
    found[:] = weight
    images = map(twice, (case.coefficients, given, case.reference, weight))
    kernels.compare_states(*images, is_changed, *moved(case), case.pixels.offsets, difference, found, moments)
    for output in (difference, found, moments, is_changed):
        np.testing.assert_array_equal(*output)
    return difference[0], found[0], moments[0]


def twice(field):
    return np.stack([field, field])


def test_without_motion_the_image_comes_back_up_to_its_last_row_and_column():
    region = Region.from_rectangle((0, 0, SHAPE[1] - 1, SHAPE[0] - 1), SHAPE)
    mesh = Tri3Mesh.from_region(region, 9)
    pixels = PixelMap.from_mesh(mesh, region)
    case = scene(7)
    case.pixels, case.mesh, case.displacement = pixels, mesh, np.zeros(mesh.nodes.shape)
    case.reference = pixels.gather(case.image)
    difference, weight, _ = compared(case, np.ones(SHAPE, np.float32), np.ones(pixels.rows.size, np.float32))
    np.testing.assert_allclose(difference, 0, atol=2e-3)
    np.testing.assert_array_equal(weight, 1)


def test_sums_over_elements_equal_their_naive_twins():
    case = scene(8, outlined=True)
    out = np.full((2, len(case.mesh.elements), 3), 7.0)
    weights = np.stack([case.weight, case.weight[::-1]])
    kernels.element_squares(case.gradient, weights, case.pixels.offsets, out)
    np.testing.assert_allclose(out, naive.element_squares(case.gradient, weights, case.pixels), rtol=1e-5)
    out = np.full((2, len(case.mesh.elements), 2), 7.0)
    kernels.element_sums(case.gradient, case.weight, case.pixels.offsets, out)
    close(out, naive.element_sums(case.gradient, case.weight, case.pixels))


def test_projection_and_interpolation_of_pixel_fields_equal_their_naive_twins():
    case = scene(10, outlined=True)
    out, fields = np.full((2, len(case.mesh.elements), 3, 2), 7.0), (case.weight, case.reference, *case.gradient)
    kernels.element_vector(*map(twice, fields), *case.on_map, case.pixels.barycentric, out)
    for light in out:
        close(light, naive.element_vector(*fields, case.pixels), scale=1e3)
    fields = np.full((2, case.reference.size), 7, dtype=np.float32)
    owned_pixels.interpolate_nodal(case.displacement, case.mesh.elements, *case.on_map, case.pixels.barycentric, fields)
    np.testing.assert_allclose(fields, naive.interpolate_nodal(case.displacement, case.pixels, case.mesh), atol=1e-5)


@pytest.mark.parametrize("outlined", [False, True])
def test_the_residual_less_a_curved_field_equals_the_naive_twin(outlined):
    case = scene(12, outlined=outlined)
    bend, carried = case.random.normal(size=(len(case.mesh.nodes), 2, 3)), case.displacement
    deviation = naive.curvature_deviation(bend, case.pixels, case.mesh)
    deviation -= naive.interpolate_nodal(carried, case.pixels, case.mesh)
    curved = case.reference - (case.gradient * deviation).sum(axis=0)
    polynomials = curved_deviation(case.mesh, case.pixels.barycentric, carried, bend)
    close(scores(case, case.reference, polynomials), scores(case, curved.astype(np.float32), polynomials[:0]))


def scores(case, residual, polynomials):
    """What `score_sums` makes of one light's residual less the effect of polynomials, on blocks of 4 px."""
    gradient, light = (case.gradient[:1], case.gradient[1:]), residual[None]
    pixels, out = case.pixels, np.empty((1, 4, *case.pixels.grid(4)), dtype=np.float32)
    geometry = pixels.local_x, pixels.local_y, pixels.lines, pixels.run_offsets, pixels.offsets, 4
    fields = light, case.weight[None], *gradient, *gradient, light, light
    owned_pixels.score_sums(*fields, polynomials, *geometry, out, out[0, :0])
    return out[0, :2]


@pytest.mark.parametrize("outlined", [False, True])
def test_second_derivatives_at_the_owned_pixels_equal_the_naive_twin(outlined):
    case = scene(13, outlined=outlined)
    out, expected = case.reference[None].copy(), case.reference.astype(np.float64)
    factors = case.random.normal(size=(len(case.mesh.elements), 3)).astype(np.float32)
    bounds = case.image[2:29, 3:35]  # of which some owned pixels are the edge
    places = zip(case.pixels.rows - 2, case.pixels.columns - 3, strict=True)
    element = np.repeat(np.arange(len(factors)), np.diff(case.pixels.offsets))
    for slot, (row, column) in enumerate(places):
        if 0 < row < len(bounds) - 1 and 0 < column < bounds.shape[1] - 1:
            around = bounds[row - 1 : row + 2, column - 1 : column + 2].astype(np.float64)
            xx, yy = (line @ (1, -2, 1) for line in (around[1], around[:, 1]))
            xy = (around[0, 0] - around[0, 2] - around[2, 0] + around[2, 2]) / 4
            expected[slot] += factors[element[slot]] @ (xx, xy, yy)
    top, left = case.pixels.bounds[:2]
    place = case.pixels.lines, case.pixels.run_offsets, top - 2, left - 3
    owned_pixels.add_second_derivatives(factors, np.ascontiguousarray(bounds[None]), *place, out)
    close(out[0], expected)


def all_outputs():
    """What every parallel kernel writes."""
    case = scene(11, "over the edge", shape=(151, 173))
    elements, count = len(case.mesh.elements), case.reference.size
    hessian, vector = np.empty((elements, 3, 3, 3)), np.empty((2, elements, 3, 2))
    squares, sums, fields = np.empty((2, elements, 3)), np.empty((2, elements, 2)), np.empty((2, count), np.float32)
    kernels.element_hessian(*case.gradient, case.weight, *case.on_map, case.pixels.barycentric, hessian)
    difference, weights, moments = compared(case, case.image, case.weight)
    kernels.element_squares(case.gradient, case.gradient**2, case.pixels.offsets, squares)
    kernels.element_sums(case.gradient, case.weight, case.pixels.offsets, sums)
    pairs = map(twice, (case.weight, case.reference, *case.gradient))
    kernels.element_vector(*pairs, *case.on_map, case.pixels.barycentric, vector)
    owned_pixels.interpolate_nodal(case.displacement, case.mesh.elements, *case.on_map, case.pixels.barycentric, fields)
    blocks = block_products(case, np.ones(case.pixels.grid(7), dtype=np.float32), 7, 2)
    second, factors = case.reference[None].copy(), case.random.normal(size=(elements, 3)).astype(np.float32)
    place = case.pixels.lines, case.pixels.run_offsets, *case.pixels.bounds[:2]
    owned_pixels.add_second_derivatives(factors, case.image[None], *place, second)
    found = hessian, difference, weights, moments, squares, sums, vector, fields, blocks, second
    return [case.coefficients, *found]


def test_the_same_bits_on_one_and_three_threads():
    assert_same_on_threads(all_outputs)
