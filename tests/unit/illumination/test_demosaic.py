"""Malvar's demosaicing and the normalised mosaic: naive twin, colour-demosaicing, borders and saturation."""

import naive_demosaic
import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.illumination.demosaicing import malvar_demosaic, normalised_demosaic
from rgbmidic.illumination.linear import LinearMosaic
from rgbmidic.settings import BAYER_PATTERNS


def make_mosaic(shape, cfa, seed=0, saturated_share=0.0):
    rng = np.random.default_rng(seed)
    values = rng.uniform(0, 1000, shape).astype(np.float32)
    return LinearMosaic(values=values, saturated=rng.random(shape) < saturated_share, cfa=cfa, full_scale=1000.0)


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("shape", [(12, 14), (11, 13), (5, 2), (2, 2), (3, 6)])
def test_kernel_equals_naive_twin_with_saturation(cfa, shape):
    mosaic = make_mosaic(shape, cfa, seed=sum(shape), saturated_share=0.05)
    channels = malvar_demosaic(mosaic)
    expected = naive_demosaic.malvar(np.where(mosaic.saturated, np.nan, mosaic.values), cfa)
    np.testing.assert_allclose(channels.values, expected, rtol=1e-5, atol=1e-3)
    np.testing.assert_array_equal(channels.valid, np.isfinite(expected))


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
@pytest.mark.parametrize("shape", [(31, 28), (24, 33), (31, 33)])
def test_agrees_with_colour_demosaicing_inside(shape, cfa):
    oracle = pytest.importorskip("colour_demosaicing").demosaicing_CFA_Bayer_Malvar2004
    mosaic = make_mosaic(shape, cfa)
    expected = np.moveaxis(oracle(mosaic.values.astype(float), cfa), -1, 0)
    inside = np.s_[:, 2:-2, 2:-2]
    np.testing.assert_allclose(malvar_demosaic(mosaic).values[inside], expected[inside], rtol=1e-5, atol=1e-3)


def test_a_linear_ramp_common_to_all_channels_is_reproduced_exactly():
    rows, columns = np.mgrid[:20, :21].astype(np.float32)
    mosaic = LinearMosaic(
        values=3 * rows + 5 * columns, saturated=np.zeros((20, 21), bool), cfa="GBRG", full_scale=1000.0
    )
    inside = np.s_[:, 2:-2, 2:-2]
    expected = np.broadcast_to(mosaic.values, (3, 20, 21))
    np.testing.assert_allclose(malvar_demosaic(mosaic).values[inside], expected[inside], atol=1e-4)


@pytest.mark.parametrize("method", [malvar_demosaic, normalised_demosaic])
def test_methods_reject_bad_input(method):
    with pytest.raises(InputError, match="at least 2 rows"):
        method(make_mosaic((1, 8), "RGGB"))
    good = make_mosaic((4, 4), "RGGB")
    with pytest.raises(InputError, match="saturation mask"):
        method(LinearMosaic(values=good.values, saturated=np.zeros((4, 5), bool), cfa="RGGB", full_scale=1.0))


@pytest.mark.parametrize("method", [malvar_demosaic, normalised_demosaic])
def test_methods_keep_a_grey_field_and_mark_saturation(method):
    saturated = np.zeros((40, 44), bool)
    saturated[20, 20] = True
    values = np.where(saturated, 1000, 400).astype(np.float32)
    channels = method(LinearMosaic(values=values, saturated=saturated, cfa="RGGB", full_scale=1000.0))
    assert not channels.valid[0, 20, 20]
    assert channels.valid[:, :10].all()
    np.testing.assert_allclose(channels.values[channels.valid], 400, rtol=1e-4)


def test_normalised_mosaic_shows_one_texture_in_all_channels():
    rows, columns = np.mgrid[:64, :64]
    texture = 1 + 0.3 * np.cos(0.9 * columns + 0.5 * rows)
    site = naive_demosaic.site_channels(texture.shape, "RGGB")
    values = (np.array([300, 900, 500])[site] * texture).astype(np.float32)
    mosaic = LinearMosaic(values=values, saturated=np.zeros(values.shape, bool), cfa="RGGB", full_scale=1000.0)
    channels = normalised_demosaic(mosaic).values[:, 16:-16, 16:-16]
    expected = np.array([300, 900, 500])[:, None, None] * texture[16:-16, 16:-16]
    np.testing.assert_allclose(channels, expected, rtol=0.02)
