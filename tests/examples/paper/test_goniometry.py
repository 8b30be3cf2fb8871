"""Goniometry: a lobe put in comes out, with an uncertainty that covers the difference."""

import numpy as np
import pytest

from measures import fit_lobe, goniometry, pixel_levels
from rgbmidic.errors import InputError

ANGLES = np.arange(-45.0, 90.5, 1.5)


def level(angles, diffuse=1000.0, specular=1400.0, centre=15.0, width=11.0):
    return diffuse * np.cos(np.radians(angles)) + specular * np.exp(-((angles - centre) ** 2) / (2 * width**2))


def test_fit_recovers_a_known_lobe():
    rng = np.random.default_rng(0)
    lobe = fit_lobe(ANGLES, level(ANGLES) + rng.normal(scale=10.0, size=ANGLES.size))
    for value, true, std in zip(
        (lobe.diffuse, lobe.specular, lobe.centre_deg, lobe.width_deg), (1000, 1400, 15, 11), lobe.std, strict=True
    ):
        assert abs(value - true) < 4 * std
        assert std < 0.02 * true
    assert lobe(ANGLES) == pytest.approx(level(ANGLES), abs=30)


def test_stated_uncertainty_is_the_scatter_of_repetitions():
    rng = np.random.default_rng(1)
    lobes = [fit_lobe(ANGLES, level(ANGLES) + rng.normal(scale=20.0, size=ANGLES.size)) for _ in range(60)]
    scatter = np.std([lobe.centre_deg for lobe in lobes])
    assert np.mean([lobe.std[2] for lobe in lobes]) == pytest.approx(scatter, rel=0.3)


def erratic_pixels(rng, count=40):
    """White and black pixels, each with its own lobe in direction and strength."""
    white = np.arange(count) % 2 == 0
    return white, np.stack(
        [
            level(ANGLES, 1000 if w else 200, 1400 * rng.lognormal(sigma=0.2), 15 + rng.normal(scale=3), 8)
            for w in white
        ],
        axis=1,
    )


def test_bundles_band_and_lobe_of_erratic_pixels():
    white, levels = erratic_pixels(np.random.default_rng(2))
    result = goniometry(ANGLES, levels)
    assert (result.is_white == white).all()
    assert result.lobe.centre_deg == pytest.approx(15, abs=4 * result.lobe.std[2])
    first, last = result.band
    assert -15 < first < 5
    assert 25 < last < 45
    # what pixels have in common is no erratic part
    smooth = goniometry(ANGLES, level(ANGLES)[:, None] * np.ones(10) + np.arange(10))
    assert np.isnan(smooth.band).all()


def test_order_of_the_frames_does_not_matter():
    _, levels = erratic_pixels(np.random.default_rng(3))
    forth, back = goniometry(ANGLES, levels), goniometry(ANGLES[::-1], levels[::-1])
    assert forth.band == back.band
    assert (forth.angles_deg == back.angles_deg).all()


def test_pixel_levels_reads_x_and_y():
    frames = [np.arange(20.0).reshape(4, 5) * i for i in (1, 2)]
    assert pixel_levels(frames, [[3, 0], [1, 2]]).tolist() == [[3, 11], [6, 22]]
    with pytest.raises(InputError, match="frame 0"):
        pixel_levels(frames, [[5, 0]])
    with pytest.raises(InputError, match="whole numbers"):
        pixel_levels(frames, [[0.5, 0.0]])


def test_what_cannot_be_told_is_refused():
    with pytest.raises(InputError, match="at least 8"):
        fit_lobe(ANGLES[:5], level(ANGLES[:5]))
    near = ANGLES[(ANGLES > 5) & (ANGLES < 25)]
    with pytest.raises(InputError):
        goniometry(near, level(near)[:, None] * np.ones(3))
    with pytest.raises(InputError, match="belong to"):
        goniometry(ANGLES, np.ones((3, 4)))
