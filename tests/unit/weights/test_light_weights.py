"""The methods of weighting, made from the settings: what each gives for images that are partly bright or not valid."""

from __future__ import annotations

import logging
import pickle

import numpy as np
import pytest

from rgbmidic.errors import FrameError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region
from rgbmidic.settings import TestSettings
from rgbmidic.weights import prepare_weights
from rgbmidic.weights.threshold import FALLBACK

SHAPE = (60, 80)
REGION = Region.from_rectangle((0, 0, 79, 59), SHAPE)


def images() -> IlluminationImages:
    """Two lights of a tenth of full scale; the first is bright on the left, the second not valid at the top."""
    values = np.full((2, *SHAPE), 100.0, dtype=np.float32)
    values[0, :, :40] = 900
    valid = np.ones(values.shape, dtype=bool)
    valid[1, :10] = False
    return IlluminationImages(values=values, valid=valid, names=("a", "b"), full_scale=1000.0)


def prepared(images_of=None, *, frames=2, **weights):
    settings = TestSettings.from_mapping(
        {"frames": {"path": "x"}, "region": {"rectangle": [0, 0, 79, 59]}, "calibration": {"file": "c"}}
        | {"weights": weights}
    )
    return prepare_weights(settings, images(), REGION, frames=frames, images_of=images_of or (lambda _: images()))


@pytest.mark.parametrize("method", ["statistics", "none"])
def test_statistics_and_none_take_every_valid_pixel(method):
    weights = prepared(method=method)
    for found in (weights.reference(images()), weights.deformed(images(), 1)):
        np.testing.assert_array_equal(found, images().valid)
        assert found.dtype == np.float32


def test_a_threshold_excludes_what_is_bright_in_either_state():
    weights = prepared(method="threshold", threshold=0.5, blur=2.0)
    for found in (weights.reference(images()), weights.deformed(images(), 1)):
        np.testing.assert_array_equal(found[0, :, :36], 0)
        np.testing.assert_array_equal(found[0, :, 44:], 1)
        np.testing.assert_array_equal(found[1, :10], 0)
        np.testing.assert_array_equal(found[1, 16:], 1)
    assert prepared(method="threshold", threshold=0.05).reference(images()).max() == 0
    assert not weights.notes


def unreadable(index):
    raise FrameError(f"frame {index} is damaged")


@pytest.mark.parametrize(
    ("images_of", "frames", "message"),
    [
        (None, 1, "there is no deformed frame"),
        (None, 2, "no disturbed zone in frame 1"),
        (unreadable, 2, "frame 1 cannot be used: frame 1 is damaged"),
    ],
)
def test_where_no_threshold_is_found_the_paper_s_is_taken_and_told(caplog, images_of, frames, message):
    with caplog.at_level(logging.WARNING, logger="rgbmidic.weights"):
        weights = prepared(images_of, frames=frames, method="threshold", threshold="auto")
    assert message in caplog.text
    assert weights.threshold == pytest.approx(FALLBACK)
    assert weights.notes == {"weights_threshold": weights.threshold}


@pytest.mark.parametrize("method", ["statistics", "threshold"])
def test_weights_can_be_pickled(method):
    weights = prepared(method=method)
    again = pickle.loads(pickle.dumps(weights))
    np.testing.assert_array_equal(again.deformed(images(), 1), weights.deformed(images(), 1))
