"""Unmixing and the entry `separate`."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbmidic import illumination
from rgbmidic.errors import InputError
from rgbmidic.frames import ChannelFrame, Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import NEGLIGIBLE, Crosstalk, unmix
from rgbmidic.illumination.images import Registration
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic
from rgbmidic.illumination.separation import DEMOSAICERS, Separation, separate

A = np.array([[1, 0.10, 0.02], [0.14, 1, 0.16], [0.03, 0.12, 1]])
LIGHTS = ("red", "green", "blue")


def channels_of(lights, matrix, valid=None):
    values = np.tensordot(matrix, lights, axes=1)
    valid = np.ones(values.shape, bool) if valid is None else valid
    return LinearChannels(values=values.astype(np.float32), valid=valid, full_scale=4000.0)


@settings(max_examples=40)
@given(
    k=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
    neighbours=st.floats(0, 0.3),
)
def test_unmix_undoes_mix(k, seed, neighbours):
    rng = np.random.default_rng(seed)
    matrix = np.eye(3)[:, :k] + neighbours * rng.random((3, k)) * (1 - np.eye(3)[:, :k])
    lights = rng.uniform(0, 4000, (k, 7, 9))
    images = unmix(channels_of(lights, matrix), Crosstalk(matrix=matrix, lights=LIGHTS[:k]))
    np.testing.assert_allclose(images.values, lights, rtol=1e-4, atol=0.05)
    assert images.names == LIGHTS[:k]
    assert images.valid.all()


@pytest.mark.parametrize("crosstalk", [0.1, 0.4])
def test_a_clipped_channel_spoils_the_lights_it_dominates_and_no_other(crosstalk):
    matrix = np.array([[1.0, crosstalk, 0], [crosstalk, 1.0, 0], [0, 0, 1.0]])
    valid = np.ones((3, 4, 4), bool)
    valid[0, 1, 2] = False
    values = channels_of(np.full((3, 4, 4), 100.0), matrix, valid)
    images = unmix(values, Crosstalk(matrix=matrix, lights=LIGHTS))
    weak = crosstalk < NEGLIGIBLE
    assert images.valid[:, 1, 2].tolist() == [False, weak, True]
    assert np.isnan(images.values[~images.valid]).all()
    np.testing.assert_allclose(images.values[images.valid], 100, rtol=1e-5)
    assert images.valid.sum() == 3 * 16 - (1 if weak else 2)


def test_a_channel_without_any_value_adds_nothing_to_the_lights_that_hardly_need_it():
    matrix = np.array([[1.0, 0, 0], [0.1, 1.0, 0], [0, 0, 1.0]])
    values = channels_of(np.full((3, 4, 4), 100.0), matrix, np.ones((3, 4, 4), bool))
    values.values[0, 1, 2], values.valid[0, 1, 2] = np.nan, False
    images = unmix(values, Crosstalk(matrix=matrix, lights=LIGHTS))
    assert images.valid[:, 1, 2].tolist() == [False, True, True]
    np.testing.assert_allclose(images.values[1:, 1, 2], [110, 100], rtol=1e-5)


def test_wrong_number_of_channels_is_an_error():
    with pytest.raises(InputError, match="3 camera channels"):
        unmix(channels_of(np.ones((3, 4, 4)), np.eye(3)[:2]), Crosstalk(matrix=A, lights=LIGHTS))


# the normalised mosaic gives contrasts, and the reflection-aware method needs a speckle: both have tests of their own
@pytest.mark.parametrize("method", sorted(set(DEMOSAICERS) - {"normalised", "reflection-aware"}))
def test_separate_recovers_smooth_lights(method):
    rows, columns = np.mgrid[:40, :40]
    lights = np.stack([200 + 3 * rows, 300 + 2 * columns, 500 - rows - columns])
    mixed = np.tensordot(A, lights, axes=1)
    site = np.array([[0, 1], [1, 2]])[rows % 2, columns % 2]
    values = np.take_along_axis(mixed, site[None], axis=0)[0].astype(np.float32)
    mosaic = LinearMosaic(values=values, saturated=np.zeros(values.shape, bool), cfa="RGGB", full_scale=4000.0)
    images = separate(mosaic, Crosstalk(matrix=A, lights=LIGHTS), method)
    inside = np.s_[:, 8:-8, 8:-8]
    np.testing.assert_allclose(images.values[inside], lights[inside], atol=4)


def test_unknown_method_names_the_allowed_ones():
    mosaic = LinearMosaic(
        values=np.ones((4, 4), np.float32), saturated=np.zeros((4, 4), bool), cfa="RGGB", full_scale=1
    )
    with pytest.raises(InputError, match="malvar"):
        separate(mosaic, Crosstalk(matrix=A, lights=LIGHTS), "nearest")
    with pytest.raises(InputError, match="3 camera channels"):
        separate(mosaic, Crosstalk.identity(("one",)), "malvar")


def test_raw_frames_are_separated_by_one_public_call():
    values = np.random.default_rng(0).integers(100, 4000, (64, 64)).astype(np.uint16)
    mosaic = Mosaic(values=values, cfa="RGGB", black_level=64, white_level=4095)
    crosstalk = Crosstalk(matrix=A, lights=LIGHTS)
    linear = illumination.linearise(mosaic)
    known = illumination.separate(linear, crosstalk, "malvar")
    by_steps = illumination.unmix(illumination.demosaic(mosaic, "malvar"), crosstalk)
    for images in (illumination.separate(mosaic, Calibration(crosstalk=crosstalk), "malvar"), by_steps):
        np.testing.assert_array_equal(images.values, known.values)
    frame = ChannelFrame(values=np.stack([values] * 3), black_level=64, white_level=4095)
    direct = illumination.separate(frame, crosstalk)
    np.testing.assert_array_equal(direct.values, illumination.unmix(illumination.linearise(frame), crosstalk).values)
    with pytest.raises(InputError, match="the calibration has no crosstalk"):
        illumination.separate(mosaic, Calibration())


def test_the_public_call_gives_the_images_of_a_measurement_each_light_where_it_lies():
    values = np.random.default_rng(0).integers(100, 4000, (32, 32)).astype(np.uint16)
    mosaic = Mosaic(values=values, cfa="RGGB", black_level=64, white_level=4095)
    registration = replace(
        Registration.identity(LIGHTS, values.shape), parameters=np.array([[0.0] * 5, [0.4, 0, 0, 1e-3, 0], [0.0] * 5])
    )
    calibration = Calibration(crosstalk=Crosstalk(matrix=A, lights=LIGHTS), registration=registration)
    images, measured = illumination.separate(mosaic, calibration), Separation(calibration=calibration)((mosaic,))
    np.testing.assert_array_equal(images.values, measured.values)
    assert images.registration is measured.registration is registration
    assert (images.on_first_light().values[1] != images.values[1]).any()
