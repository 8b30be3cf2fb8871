"""Sums over blocks and back, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest
from bits import assert_same_on_threads

from rgbmidic._kernels.owned_pixels import product_sums, score_sums
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh


@pytest.fixture(params=["rectangle", "polygon"])
def pixels(request):
    if request.param == "rectangle":
        region = Region.from_rectangle((7, 5, 66, 48), (60, 80))
    else:
        region = Region.from_polygon([(5, 5), (70, 12), (60, 52), (12, 45)], (60, 80))
    return PixelMap.from_mesh(Tri3Mesh.from_region(region, 12), region)


def expected_blocks(pixels, side):
    top, left, height, width = pixels.bounds
    assert (top, left) == (pixels.rows.min(), pixels.columns.min())
    assert (height, width) == (np.ptp(pixels.rows) + 1, np.ptp(pixels.columns) + 1)
    return (pixels.rows - top) // side, (pixels.columns - left) // side


def expected_sums(pixels, fields, side):
    row, column = expected_blocks(pixels, side)
    assert pixels.grid(side) == (row.max() + 1, column.max() + 1)
    wanted = np.zeros((len(fields), *pixels.grid(side)))
    np.add.at(wanted, (slice(None), row, column), fields)
    return wanted


@pytest.mark.parametrize("side", [4, 13])
def test_sums_over_blocks(pixels, side):
    values = np.random.default_rng(0).normal(size=(2, pixels.rows.size)).astype(np.float32)
    np.testing.assert_allclose(pixels.block_sums(values, side), expected_sums(pixels, values, side), atol=1e-4)


def test_sums_of_products_of_two_fields(pixels):
    random = np.random.default_rng(2)
    a, b = values = random.normal(size=(2, pixels.rows.size)).astype(np.float32)
    v, w = weights = np.maximum(random.normal(size=values.shape), 0).astype(np.float32)
    out = np.full((6, *pixels.grid(4)), 7, dtype=np.float32)
    product_sums(values, weights, pixels.lines, pixels.run_offsets, pixels.offsets, 4, out)
    shared = np.sqrt(v * w)
    fields = np.stack([v * a * a, v, shared * a * b, shared, w * b * b, w])
    np.testing.assert_allclose(out, expected_sums(pixels, fields, 4), atol=1e-4)


@pytest.mark.parametrize(("side", "number"), [(4, 4), (13, 4), (13, 0)])
def test_scores_of_each_light_and_the_slopes_of_both_states_together(pixels, side, number):
    random = np.random.default_rng(1)
    residual, gx, gy, own_x, own_y, values, inverse = random.normal(size=(7, 3, pixels.rows.size)).astype(np.float32)
    weight = np.maximum(random.normal(size=residual.shape), 0).astype(np.float32)
    out, common = (np.full((*n, *pixels.grid(side)), 7, dtype=np.float32) for n in ((3, 4), (number,)))
    fields = residual, weight, gx, gy, own_x, own_y, values, inverse, np.empty((0, 2, 6), dtype=np.float32)
    geometry = pixels.local_x, pixels.local_y, pixels.lines, pixels.run_offsets, pixels.offsets
    score_sums(*fields, *geometry, side, out, common)
    scores = weight * residual * gx, weight * residual * gy, weight * (gx**2 + gy**2), weight > 0
    expected = np.stack([expected_sums(pixels, light, side) for light in zip(*scores, strict=True)])
    np.testing.assert_allclose(out, expected, atol=4e-4)
    element = np.repeat(np.arange(len(pixels.origin)), np.diff(pixels.offsets))
    slot = {place: n for n, place in enumerate(zip(element, pixels.rows, pixels.columns, strict=True))}
    f, slopes = values * inverse, np.zeros((2, residual.shape[1]))
    g = f - residual
    first_row = {e: row for e, row, _ in reversed(slot)}
    for (e, row, column), a in slot.items():
        if (row - first_row[e]) % 2:
            continue
        for gradient, beside in ((gx, (e, row, column + 1)), (gy, (e, row + 1, column))):
            if (b := slot.get(beside)) is not None:
                mean = (weight[:, a] * gradient[:, a] + weight[:, b] * gradient[:, b]) / 2
                slopes[:, a] += mean @ (f[:, b] - f[:, a]), mean @ (g[:, b] - g[:, a])
    own = ((weight * residual * gradient).sum(axis=0) for gradient in (own_x, own_y))
    np.testing.assert_allclose(common, expected_sums(pixels, [*own, *slopes], side)[:number], atol=4e-4)


def test_the_same_bits_on_one_and_three_threads(pixels):
    values = np.random.default_rng(3).uniform(size=(2, pixels.rows.size)).astype(np.float32)

    def found():
        sums, common = np.zeros((6, *pixels.grid(4)), np.float32), np.zeros((4, *pixels.grid(4)), np.float32)
        summed = np.zeros((2, *common.shape), np.float32)
        product_sums(values, values, pixels.lines, pixels.run_offsets, pixels.offsets, 4, sums)
        geometry = pixels.local_x, pixels.local_y, pixels.lines, pixels.run_offsets, pixels.offsets
        polynomials = np.ones((len(pixels.origin), 2, 6), dtype=np.float32)
        score_sums(*[values] * 8, polynomials, *geometry, 4, summed, common)
        blocks = pixels.block_sums(values, 5)
        return sums, summed, common, blocks, pixels.from_blocks(blocks, 5), pixels.scatter(values[1])

    assert_same_on_threads(found)


def test_the_image_of_a_field_comes_back(pixels):
    values = np.random.default_rng(4).normal(size=(2, pixels.rows.size)).astype(np.float32)
    whole = np.stack([pixels.scatter(part, fill=np.nan) for part in values])
    np.testing.assert_array_equal(whole[:, pixels.rows, pixels.columns], values)
    assert np.isfinite(whole).sum() == values.size
    np.testing.assert_array_equal(pixels.gather(whole), values)


@pytest.mark.parametrize("side", [6, 13])
def test_a_grid_of_blocks_is_interpolated_between_their_centres(pixels, side):
    shape = pixels.grid(side)
    top, left, _, _ = pixels.bounds
    y, x = (side * (np.arange(n) + 0.5) - 0.5 for n in shape)
    plane = (3 + 0.2 * y[:, None] - 0.1 * x).astype(np.float32)
    row = np.clip(pixels.rows - top, y[0], y[-1])
    column = np.clip(pixels.columns - left, x[0], x[-1])
    np.testing.assert_allclose(pixels.from_blocks(plane[None], side)[0], 3 + 0.2 * row - 0.1 * column, atol=1e-4)
