"""Perturbation P on fields whose answer is known: none of what is smooth, all of the noise, whatever edges and gaps."""

import numpy as np
import pytest

from measures import MeasureArea, area_means, area_stds, areas_along_x, perturbation, residual_percent
from rgbmidic.errors import InputError
from rgbmidic.fields import high_pass

SHAPE = (300, 420)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)


def test_areas_stand_along_x_and_have_the_papers_size():
    areas = areas_along_x((60.0, 100.0), pitch=80.0)
    assert [area.name for area in areas] == ["A0", "A1", "A2", "A3", "A4"]
    assert areas[3].rectangle == (275.0, 50.0, 325.0, 150.0)
    assert areas[0].cut(X).shape == (101, 51)
    assert areas[0].cut(X).mean() == 60.0


def test_area_beyond_the_image_is_refused():
    with pytest.raises(InputError, match=r"A0.*420 x 300"):
        area_stds(X, [MeasureArea(name="A0", centre=(410.0, 100.0))])


def test_rotation_stretch_and_bending_of_the_whole_field_give_no_perturbation():
    field = 3 - 0.01 * X + 0.02 * Y + 1e-5 * X**2 - 3e-5 * X * Y + 2e-5 * Y**2
    assert perturbation(field, areas_along_x((30.0, 60.0), pitch=90.0)).max() < 1e-6


def test_a_wave_keeps_what_the_gaussian_takes_from_its_copy():
    """sin(k x) filtered by a Gaussian is exp(-k^2 s^2/2) sin(k x)."""
    for length, sigma in ((50.0, 40.0), (120.0, 40.0), (200.0, 40.0)):
        wave = 0.01 * np.sin(2 * np.pi * X / length)
        kept = 1 - np.exp(-0.5 * (2 * np.pi * sigma / length) ** 2)
        middle = high_pass(wave, sigma)[100:200, 170:250]
        assert middle == pytest.approx(kept * wave[100:200, 170:250], abs=2e-4)


def test_noise_gives_its_standard_deviation_everywhere_in_the_field():
    noise = np.random.default_rng(0).normal(scale=0.01, size=SHAPE)
    inner, edge = (MeasureArea(name="A", centre=centre) for centre in ((200.0, 150.0), (25.0, 50.0)))
    assert perturbation(noise, [inner, edge]) == pytest.approx(0.01, rel=0.05)


def test_what_lies_beyond_the_field_does_not_matter():
    """P near the edge of a bent field with noise equals that of the same place deep in a larger field."""
    y, x = np.mgrid[:600, :800].astype(float)
    field = 2e-3 * x + np.sin(x / 300) * np.cos(y / 250)
    field += np.random.default_rng(1).normal(scale=0.01, size=field.shape)
    area = MeasureArea(name="A", centre=(300.0, 300.0))
    whole = perturbation(field, [area])
    cut = field.copy()
    cut[:, :215] = np.nan  # the edge is 1.5 sigma from the area
    assert perturbation(cut, [area]) == pytest.approx(whole, rel=0.05)


def test_gaps_take_no_part_and_a_half_empty_area_gives_nothing():
    rng = np.random.default_rng(2)
    field = 0.5 + 0.01 * X + rng.normal(scale=0.01, size=SHAPE)
    holes = rng.random(SHAPE) < 0.2
    field[holes] = np.nan
    area = MeasureArea(name="A", centre=(200.0, 150.0))
    assert perturbation(field, [area]) == pytest.approx(0.01, rel=0.06)
    assert area_means(field, [area]) == pytest.approx(2.5, abs=0.01)
    field[:, 195:] = np.nan
    assert np.isnan(perturbation(field, [area])).all()


def test_high_pass_refuses_what_is_not_a_field():
    with pytest.raises(InputError, match="one image"):
        high_pass(np.zeros((2, 5, 5)))
    with pytest.raises(InputError, match="fewer than 10"):
        high_pass(np.full((40, 40), np.nan))


def test_residual_is_the_noise_in_percent_of_the_range():
    rng = np.random.default_rng(3)
    f = 1000 + 400 * np.sin(X / 7) * np.sin(Y / 6)
    moved = 1000 + 400 * np.sin((X - 0.4) / 7) * np.sin((Y + 0.3) / 6)
    shift = np.stack([np.full(SHAPE, 0.4), np.full(SHAPE, -0.3)])
    assert residual_percent(f, moved, shift) < 0.1
    noisy = residual_percent(f, moved + rng.normal(scale=8.0, size=SHAPE), np.zeros_like(shift))
    assert noisy > 1.0  # not brought back
    shift[:, :60] = np.nan
    moved[100, 100] = np.nan
    # the spline passes three quarters of the noise's deviation at these fractions of a pixel
    percent = residual_percent(f, moved + rng.normal(scale=8.0, size=SHAPE), shift)
    assert 50 * 8 / 870 < percent < 100 * 8 / 800
