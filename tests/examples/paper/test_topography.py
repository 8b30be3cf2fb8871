"""Topography: form, slope, roughness and spacing of surfaces made to measure."""

import numpy as np
import pytest

from measures import detrend, local_slope, paint_classes, rms_slope, slope_uncertainty, wrinkle_spacing
from rgbmidic.errors import InputError

PITCH = 5.0
Y, X = np.mgrid[:240, :260] * PITCH


def wrinkles(spacing=25.0, rms=0.4, seed=0, shape=X.shape):
    """Noise of one wavelength in every direction."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(shape[0], PITCH)[:, None], np.fft.fftfreq(shape[1], PITCH)
    spectrum = np.exp(-(((np.hypot(fx, fy) - 1 / spacing) * spacing / 0.15) ** 2) / 2)
    field = np.fft.ifft2(spectrum * np.fft.fft2(rng.normal(size=shape))).real
    return rms * field / field.std()


def test_form_up_to_the_fourth_order_goes_and_the_rest_stays():
    x, y = X / 600 - 1, Y / 600 - 1
    form = 40 + 30 * x - 8 * y + 25 * x**2 * y - 9 * x**3 + 12 * x**4 * y**4 - 5 * y**4
    rough = wrinkles()
    height = form + rough
    height[20:30, 50:60] = np.nan
    flat = detrend(height)
    assert np.isnan(flat).sum() == 100
    known = np.isfinite(flat)
    assert np.abs(flat - rough)[known].max() < 0.15
    assert detrend(form).std() < 1e-9


def test_slope_of_a_plane_and_its_uncertainty():
    assert local_slope(0.1 * X - 0.05 * Y, PITCH) == pytest.approx(np.degrees(np.arctan(np.hypot(0.1, 0.05))))
    noise = np.random.default_rng(1).normal(scale=0.1, size=X.shape)
    steep = local_slope(0.2 * X + noise, PITCH)[1:-1, 1:-1]
    assert slope_uncertainty(0.1, PITCH) * np.cos(np.arctan(0.2)) ** 2 == pytest.approx(steep.std(), rel=0.05)
    assert slope_uncertainty(0.1, 5.0) == pytest.approx(0.81, abs=0.005)


@pytest.mark.parametrize("spacing", [20.0, 25.0, 40.0])
def test_spacing_of_wrinkles_comes_out_beside_a_longer_relief(spacing):
    relief = 3 * np.sin(X / 60) * np.sin(Y / 70)
    result, std = wrinkle_spacing(wrinkles(spacing) + relief, PITCH, longest=60.0)
    assert result == pytest.approx(spacing, rel=0.06)
    assert 0 < std < 0.06 * spacing


def test_slope_of_each_paint_without_the_noise():
    white = (X // 130 + Y // 130) % 2 == 0
    height = np.where(white, wrinkles(rms=0.3), wrinkles(rms=0.6, seed=1)) + np.where(white, 0.0, 4.0)
    noise = np.random.default_rng(2).normal(scale=0.05, size=X.shape)
    for where, rms in ((white, 0.3), (~white, 0.6)):
        # central differences see sin(2 pi p/l)/(2 pi p/l) of the slope of a wave of length l
        slope = rms * 2 * np.pi / 25 * np.sinc(2 * PITCH / 25)
        result = rms_slope(height + noise, where, PITCH, height_std=0.05)
        assert np.tan(np.radians(result)) == pytest.approx(slope, rel=0.1)


def test_paints_are_told_by_their_intensity():
    white = (X // 130) % 2 == 0
    intensity = np.where(white, 0.8, 0.1) + np.random.default_rng(3).normal(scale=0.05, size=X.shape)
    intensity[5, 5] = np.nan
    result = paint_classes(intensity)
    assert (result == white).mean() > 0.999
    assert not result[5, 5]
    with pytest.raises(InputError, match="two paints"):
        paint_classes(np.ones((10, 10)))


def test_maps_that_cannot_tell_are_refused():
    with pytest.raises(InputError, match="finer"):
        wrinkle_spacing(wrinkles(), 20.0, longest=60.0)
    with pytest.raises(InputError, match="two dimensions"):
        detrend(np.ones(5))
    with pytest.raises(InputError, match="bipolynomial"):
        detrend(np.ones((5, 5)))
    with pytest.raises(InputError, match="pitch"):
        local_slope(X, 0.0)
    with pytest.raises(InputError, match="no measured height"):
        rms_slope(X, np.zeros(X.shape, bool), PITCH)
