"""Sums over blocks and back, against plain loops."""

from __future__ import annotations

import numpy as np
import pytest

from rgbmidic._kernels.grid import block_sums, score_sums
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


@pytest.mark.parametrize("side", [4, 13])
def test_sums_over_blocks(pixels, side):
    random = np.random.default_rng(0)
    values = random.normal(size=(2, pixels.rows.size)).astype(np.float32)
    index, shape = pixels.blocks(side)
    row, column = expected_blocks(pixels, side)
    assert shape == (row.max() + 1, column.max() + 1)
    wanted = np.zeros((2, *shape))
    np.add.at(wanted, (slice(None), row, column), values)
    out = np.zeros((2, shape[0] * shape[1]))
    block_sums(values, index, out)
    np.testing.assert_allclose(out.reshape(wanted.shape), wanted, atol=1e-4)


def test_sums_of_scores(pixels):
    random = np.random.default_rng(1)
    residual, gx, gy = random.normal(size=(3, 3, pixels.rows.size)).astype(np.float32)
    weight = np.maximum(random.normal(size=residual.shape), 0).astype(np.float32)
    index, shape = pixels.blocks(9)
    out = np.zeros((3, 4, shape[0] * shape[1]))
    score_sums(residual, weight, gx, gy, index, out)
    fields = np.stack([weight * residual * gx, weight * residual * gy, weight * (gx**2 + gy**2), weight > 0], axis=1)
    wanted = np.zeros_like(out)
    np.add.at(wanted, (slice(None), slice(None), index), fields)
    np.testing.assert_allclose(out, wanted, atol=1e-3)


def test_a_grid_of_blocks_is_interpolated_between_their_centres(pixels):
    side = 6
    _, shape = pixels.blocks(side)
    top, left, _, _ = pixels.bounds
    y, x = (side * (np.arange(n) + 0.5) - 0.5 for n in shape)
    plane = (3 + 0.2 * y[:, None] - 0.1 * x).astype(np.float32)
    row = np.clip(pixels.rows - top, y[0], y[-1])
    column = np.clip(pixels.columns - left, x[0], x[-1])
    np.testing.assert_allclose(pixels.from_blocks(plane[None], side)[0], 3 + 0.2 * row - 0.1 * column, atol=1e-4)
