"""Kernels of the reflection-aware demosaicing against their naive twins, odd sizes and unknown samples included."""

import naive_texture
import numpy as np
import pytest

from rgbmidic._kernels import demosaicing as kriging
from rgbmidic._kernels import illumination, texture
from rgbmidic.illumination.colour_factors import _channel_moments, _planes, interleave_bayer, upsample_rows
from rgbmidic.illumination.demosaicing import red_position
from rgbmidic.illumination.texture import lanczos_weights
from rgbmidic.settings import BAYER_PATTERNS

SHAPES = [(16, 24), (19, 21), (33, 18), (9, 531)]


def make_contrast(shape, unknown=0.02, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(0, 100, shape).astype(np.float32)
    values[rng.random(shape) < unknown] = np.nan
    return values


def grid_for(shape, block, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(0.5, 2, (3, *(-(-n // block) for n in shape))).astype(np.float32)


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("shape", SHAPES)
def test_sums_means_and_scaling(cfa, shape):
    values, red = make_contrast(shape), red_position(cfa)
    sums = np.empty((8, *(-(-n // 4) for n in shape)), dtype=np.float32)
    texture.block_sums(values, 4, sums)
    expected = naive_texture.block_sums(values, 4)
    np.testing.assert_allclose(sums[:4], expected[0], rtol=1e-5, atol=1e-3)
    np.testing.assert_array_equal(sums[4:], expected[1])
    mean, out = grid_for(shape, 4), np.empty_like(values)
    texture.subtract_mean(values, interleave_bayer(mean, 4, shape[1], red), 4, out)
    np.testing.assert_allclose(out, naive_texture.subtract_mean(values, mean, cfa, 4), rtol=1e-5, atol=1e-4)
    scale, padded = grid_for(shape, 8), np.empty((shape[0] + 4, shape[1] + 4 + 7), dtype=np.float32)
    texture.scaled_contrast(values, interleave_bayer(scale, 8, shape[1], red), 8, 2, padded)
    expected = naive_texture.scaled_contrast(values, scale, cfa, 8, 2, padded.shape[1])
    np.testing.assert_allclose(padded, expected, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("shape", SHAPES)
def test_moments_of_the_planes(cfa, shape):
    values, grid = make_contrast(shape, unknown=0.005), tuple(-(-n // 8) for n in shape)
    planes = np.empty((4, shape[0] // 2, shape[1] // 2), dtype=np.float32)
    unmixing, lights = np.random.default_rng(5).normal(size=(2, 4)).astype(np.float32), np.empty_like(planes[:2])
    texture.low_passed_planes(values, np.argsort(_planes(red_position(cfa))), unmixing, planes, lights)
    np.testing.assert_allclose(lights, np.tensordot(unmixing, planes, axes=1), rtol=1e-4, atol=1)
    sums = np.empty((11, *grid), dtype=np.float32)
    texture.plane_products(planes, texture.CELLS, sums)
    pairs = np.zeros((4, 4), dtype=int)
    pairs[np.triu_indices(4)] = np.arange(10)
    expected = naive_texture.cell_moments(values, cfa, 8)
    np.testing.assert_array_equal(sums[10], expected[1])
    moments = _channel_moments(sums[np.maximum(pairs, pairs.T)])
    np.testing.assert_allclose(moments, expected[0], rtol=1e-4, atol=1e5)


@pytest.mark.parametrize("width", [21, 150])
def test_planes_are_read_where_they_show_the_texture(width):
    """Waves of eight cells, displaced by as much more from block to block as a lens does."""
    y, x = np.mgrid[:30, :width].astype(float)
    displacement = np.zeros((2, 2, 8, -(-width // 4)))
    displacement[1] = np.linspace(-2.6, 1.9, displacement[1].size).reshape(displacement[1].shape)
    displacement[1, :, 2, 1] = -1e-17  # rounded to the next sample
    blocks = (np.arange(30) // 4)[:, None], np.arange(width) // 4
    at_x, at_y = (displacement[:, axis][:, *blocks] for axis in (0, 1))

    def wave(x, y):
        return np.sin(2 * np.pi * (x + 0.3 * y) / 8)

    planes = np.stack([wave(x, y), wave(x, y)]).astype(np.float32)
    planes[0, 3, 9] = np.nan
    out = np.empty_like(planes)
    texture.register_planes(planes, displacement, lanczos_weights(), out)
    expected = wave(x + at_x, y + at_y)
    known = np.isfinite(out)
    assert known[1, 8:-8, 8:-8].all()
    assert not known[0, 3, 9]
    assert not known[:, :3].any()
    assert np.abs(out - expected)[known].max() < 0.009  # .0065


@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_products_at_lags(cfa):
    values, lags = make_contrast((19, 14)), np.array([(0, 1), (1, -1), (2, 0), (3, 2)])
    sums, counts = np.zeros((2, len(lags), 6))
    texture.lag_products(values, *red_position(cfa), lags, 2, sums, counts)
    expected = naive_texture.lag_products(values, cfa, lags, 2)
    np.testing.assert_array_equal(counts, expected[1])
    np.testing.assert_allclose(sums, expected[0], rtol=1e-4, atol=1)


@pytest.mark.parametrize("size", [5, 7])
def test_prediction_with_different_filters_per_tile(size):
    rng, shape = np.random.default_rng(3), (37, 43)
    tiles = tuple(-(-n // kriging.TILE) for n in shape)
    index = rng.integers(0, 5, tiles).astype(np.int32)
    pair = rng.normal(size=(5, 2, 3, size**2, 2))
    taps = np.tile(pair, kriging.TILE // 2).astype(np.float32)
    pad = size // 2
    padded = rng.normal(size=(shape[0] + 2 * pad, tiles[1] * kriging.TILE + 2 * pad)).astype(np.float32)
    scale, mean, out = grid_for(shape, 8), grid_for(shape, 4), np.empty((2, *shape), dtype=np.float32)
    mixing = rng.normal(size=(2, 3)).astype(np.float32)
    wide = upsample_rows(scale, 8, shape[1]), 8, upsample_rows(mean, 4, shape[1]), 4
    kriging.predict(padded, index, taps, size, *wide, mixing, out)
    channels = naive_texture.predict(padded, index, taps, size, scale, 8, mean, 4, shape, kriging.TILE)
    np.testing.assert_allclose(out, np.tensordot(mixing, channels, axes=1), rtol=1e-4, atol=3e-4)


def test_unknown_samples_get_what_the_others_tell():
    share = np.ones((3, 1, 1))
    padded = np.full((12, 12), 2.0, dtype=np.float32)
    padded[5, 5] = np.nan
    out, unknown = padded.copy(), np.zeros(padded.shape, dtype=bool)
    kriging.fill_unknown(padded, share, 0, 0, 2, out, unknown)
    assert out[5, 5] == pytest.approx(2)
    assert not unknown.any()
    padded[3:8, 3:8] = np.nan
    kriging.fill_unknown(padded, share, 0, 0, 2, out, unknown)
    assert unknown[5, 5]
    assert np.isfinite(out).all()


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_black_is_subtracted_by_the_row(kind):
    rng = np.random.default_rng(4)
    samples, black = rng.integers(0, 200, (5, 7)).astype(kind), rng.uniform(0, 9, (2, 7)).astype(np.float32)
    values, saturated = np.empty((5, 7), np.float32), np.empty((5, 7), bool)
    illumination.subtract_black(samples, black, 150.0, values, saturated)
    np.testing.assert_array_equal(values, samples.astype(np.float32) - black[np.arange(5) % 2])
    np.testing.assert_array_equal(saturated, samples >= 150)


def test_slopes_of_three_channels_and_what_each_has_of_its_own():
    rng, crosstalk = np.random.default_rng(5), np.array([[1, 0.1, 0], [0.1, 1, 0.1], [0, 0.1, 1], [0.2, 0.3, 0.1]]).T
    covariance, energy = rng.uniform(-0.1, 2, (3, 4, 5)), np.array([1.1, 0.9, 1.1])
    variance, allowed = rng.uniform(1, 3, (3, 4, 5)), 0.03
    to_lights, pairs = np.linalg.pinv(crosstalk**2), [(0, 1), (0, 2), (1, 2)]
    to_pairs = np.stack([crosstalk[a] * crosstalk[b] for a, b in pairs])
    square, specific = np.empty_like(variance), np.empty_like(variance)
    sparkle = np.ascontiguousarray(to_lights)
    illumination.common_slopes(variance, covariance, energy, allowed, sparkle, to_pairs, square, specific)
    expected = naive_texture.common_slopes(variance, covariance, energy, allowed, to_lights, to_pairs)
    np.testing.assert_allclose([square, specific], expected, rtol=1e-10)
