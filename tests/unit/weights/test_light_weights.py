"""The methods of weighting, made from the settings: what each gives for images that are partly bright or not valid."""

from __future__ import annotations

import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.settings import TestSettings
from rgbmidic.weights import MaskWeights, prepare_weights

SHAPE = (60, 80)


def images() -> IlluminationImages:
    """Two lights of a tenth of full scale; the first is bright on the left, the second not valid at the top."""
    values = np.full((2, *SHAPE), 100.0, dtype=np.float32)
    values[0, :, :40] = 900
    valid = np.ones(values.shape, dtype=bool)
    valid[1, :10] = False
    return IlluminationImages(values=values, valid=valid, names=("a", "b"), full_scale=1000.0)


def prepared(**weights):
    settings = TestSettings.from_mapping(
        {"frames": {"path": "x"}, "region": {"rectangle": [0, 0, 79, 59]}, "calibration": {"file": "c"}}
        | {"weights": weights}
    )
    return prepare_weights(settings, lights=("a", "b"), shape=SHAPE, frames=2)


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


def test_an_automatic_threshold_takes_the_frames_of_a_test():
    with pytest.raises(ConfigurationError, match=r'weights.threshold = "auto" is found from the frames of a test'):
        prepared(method="threshold", threshold="auto")


@pytest.mark.parametrize("method", ["statistics", "threshold"])
def test_weights_can_be_pickled(method):
    weights = prepared(method=method)
    again = pickle.loads(pickle.dumps(weights))
    np.testing.assert_array_equal(again.deformed(images(), 1), weights.deformed(images(), 1))


def test_masks_made_by_hand_count_where_they_are_not_zero_or_by_their_fraction(tmp_path):
    plain, grey = np.zeros(SHAPE, dtype=np.uint8), np.full(SHAPE, 51, dtype=np.uint8)
    plain[:, 20:], grey[:30] = 1, 255
    for name, mask in (("plain", plain), ("grey", grey)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), mask)
    files = [str(tmp_path / "plain.png"), str(tmp_path / "grey.png")]
    weights = prepared(method="images", images=files)
    for found in (weights.reference(images()), weights.deformed(images(), 1)):
        np.testing.assert_array_equal(found[0], plain)
        np.testing.assert_array_equal(found[1, :10], 0)
        np.testing.assert_array_equal(found[1, 10:30], 1)
        np.testing.assert_allclose(found[1, 30:], 0.2)
    part = replace(images(), values=images().values[:, 8:40, 16:48], valid=images().valid[:, 8:40, 16:48])
    np.testing.assert_array_equal(weights.reference(replace(part, origin=(16, 8)))[0], plain[8:40, 16:48])
    with pytest.raises(ConfigurationError, match=r"weights.images must name one mask per light \(a, b\).*given are 1"):
        prepared(method="images", images=files[:1])
    cv2.imwrite(str(tmp_path / "grey.png"), grey[:-1])
    with pytest.raises(InputError, match="need one size"):
        prepared(method="images", images=files)
    with pytest.raises(ConfigurationError, match="go together"):
        prepared(method="images")


def test_masks_by_a_function_of_the_frame():
    weights = MaskWeights(lambda images: images.values < 500)
    np.testing.assert_array_equal(weights.reference(images())[0, :, :40], 0)
    np.testing.assert_array_equal(weights.deformed(images(), 1)[0, :, 40:], 1)
    with pytest.raises(InputError, match="one mask per light"):
        MaskWeights(np.ones((1, *SHAPE))).reference(images())
    with pytest.raises(InputError, match="from 0 to 1; given are 0 to 255"):
        MaskWeights(np.arange(256.0).reshape(1, 16, 16))


def test_masks_are_found_beside_the_file_that_names_them(tmp_path):
    document = {"frames": {"path": "x"}, "region": {"rectangle": [0, 0, 9, 9]}}
    document["weights"] = {"method": "images", "images": ["a.png", "b.png"]}
    found = TestSettings.from_mapping(document, tmp_path)
    assert found.weights.images == (tmp_path / "a.png", tmp_path / "b.png")
    assert TestSettings.from_mapping(found.to_mapping(), found.base) == found
