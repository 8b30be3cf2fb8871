"""The disturbed zone and the weighting threshold of fields and images made to measure."""

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.weights import disturbed_zone, set_up_threshold
from rgbmidic.weights.threshold import threshold_weights

SHAPE = (640, 700)
CENTRE = (420.0, 300.0)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
R = np.hypot(X - CENTRE[0], Y - CENTRE[1])


def ripple(peak=5.0, width=110.0, seed=0):
    """Noise whose deviation is 1 + (peak - 1) exp(-r^2/2 w^2) times 0.004 px."""
    scale = 0.004 * (1 + (peak - 1) * np.exp(-((R / width) ** 2) / 2))
    return np.random.default_rng(seed).normal(size=SHAPE) * scale


def images(width=150.0, base=0.3, peak=0.6):
    values = np.float32(4000 * (base + peak * np.exp(-((R / width) ** 2) / 2)))
    return IlluminationImages(values=values[None], valid=np.ones((1, *SHAPE), bool), names=("lamp",), full_scale=4000.0)


def test_radius_is_where_p_falls_to_150_percent():
    zone = disturbed_zone(ripple(), CENTRE)
    assert zone.unaffected == pytest.approx(0.004, rel=0.1)
    assert zone.contrast == pytest.approx(5, rel=0.15)
    assert zone.radius == pytest.approx(110 * np.sqrt(2 * np.log(4 / 0.5)), rel=0.06)


def test_gaps_and_a_zone_that_the_image_cuts_do_not_move_the_radius():
    field = ripple()
    field[:, 560:] = np.nan
    field[200:230] = np.nan
    assert disturbed_zone(field, CENTRE).radius == pytest.approx(110 * np.sqrt(2 * np.log(8)), rel=0.08)


def test_nothing_disturbed_has_no_radius_and_no_threshold():
    quiet = ripple(peak=1.0)
    assert disturbed_zone(quiet, CENTRE).radius == 0
    with pytest.raises(InputError, match="no disturbed zone"):
        set_up_threshold(quiet, images())


def test_threshold_is_the_level_on_the_contour_less_the_margin():
    found = set_up_threshold(ripple(), images())
    assert found.zone.centre == pytest.approx(CENTRE, abs=2)
    expected = 0.3 + 0.6 * np.exp(-((found.zone.radius / 150) ** 2) / 2)
    assert found.contour == pytest.approx(expected, abs=0.01)
    assert found.value == pytest.approx(found.contour - 0.03)
    weights = threshold_weights(images(), threshold=found.value)[0]
    assert weights[found.zone.radius > R].max() == 0
    assert weights[1.3 * found.zone.radius < R].min() == 1


def test_a_field_too_small_to_show_a_zone_is_refused():
    with pytest.raises(InputError, match="does not reach"):
        disturbed_zone(np.ones((60, 60)), (30.0, 30.0))
