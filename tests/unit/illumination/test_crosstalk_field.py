"""A crosstalk matrix that varies over the field: unmixing undoes it at every pixel."""

from __future__ import annotations

import numpy as np
import pytest
from naive_calibration import unmix_field as naive_unmix_field

from rgbmidic._kernels.lights import unmix as unmix_kernel
from rgbmidic.errors import CalibrationError, InputError
from rgbmidic.illumination.crosstalk import Crosstalk, CrosstalkField, legendre_products, unmix
from rgbmidic.illumination.linear import LinearChannels

LIGHTS = ("red", "green", "blue")
MATRIX = np.array([[1, 0.2, 0.05], [0.15, 1, 0.3], [0.02, 0.25, 1]])
SHAPE = (70, 101)


def varying(shape=SHAPE):
    coefficients = np.random.default_rng(1).normal(0, 0.01, (5, 3, 3)) * (1 - np.eye(3))
    return Crosstalk(
        matrix=MATRIX, lights=LIGHTS, field=CrosstalkField(order=2, coefficients=coefficients, shape=shape)
    )


def pixels(shape=SHAPE):
    return np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1)


def test_kernel_agrees_with_its_twin():
    rng = np.random.default_rng(2)
    channels = rng.normal(100, 30, (3, 21, 37)).astype(np.float32)
    valid = rng.random((3, 21, 37)) > 0.1
    channels[~valid] = np.nan
    grid = rng.normal(0, 1, (4, 6, 2, 3)).astype(np.float32)
    needed = np.array([[True, False, True], [True, True, True]])
    out, out_valid = np.empty((2, 21, 37), np.float32), np.empty((2, 21, 37), bool)
    unmix_kernel(channels, valid, grid, 8, needed, out, out_valid)
    expected = naive_unmix_field(channels, valid, grid, 8, needed)
    assert (out_valid == np.isfinite(expected)).all()
    assert np.allclose(out, expected, rtol=1e-4, atol=1e-3, equal_nan=True)


def test_unmix_undoes_the_mixing_at_every_pixel():
    crosstalk = varying()
    lights = np.random.default_rng(3).uniform(100, 2000, (3, *SHAPE))
    mixed = np.einsum("yxck,kyx->cyx", crosstalk.at(pixels()), lights).astype(np.float32)
    found = unmix(LinearChannels(values=mixed, valid=np.ones(mixed.shape, bool), full_scale=4000.0), crosstalk)
    assert np.abs(found.values - lights).max() < 2.0
    plain = unmix(
        LinearChannels(values=mixed, valid=np.ones(mixed.shape, bool), full_scale=4000.0),
        Crosstalk(matrix=MATRIX, lights=LIGHTS),
    )
    assert np.abs(plain.values - lights).max() > 20


def test_frame_of_another_size_is_an_error():
    values = np.ones((3, 64, 64), np.float32)
    with pytest.raises(InputError, match="101 x 70 px; the frame has 64 x 64 px"):
        unmix(LinearChannels(values=values, valid=np.ones(values.shape, bool), full_scale=4000.0), varying())


def test_legendre_products_average_to_zero():
    terms = legendre_products(pixels((200, 300)), (200, 300), 3)
    assert terms.shape == (200, 300, 10)
    assert (terms[..., 0] == 1).all()
    assert np.abs(terms[..., 1:].mean(axis=(0, 1))).max() < 0.01


def test_mean_of_the_field_is_the_matrix():
    assert varying().at(pixels()).mean(axis=(0, 1)) == pytest.approx(MATRIX, abs=1e-3)
    assert (Crosstalk(matrix=MATRIX, lights=LIGHTS).at([[3, 4]]) == MATRIX).all()


def test_leakage_std_is_what_random_matrices_leave():
    rng = np.random.default_rng(4)
    half = rng.normal(0, 1e-3, (9, 9))
    crosstalk = Crosstalk(matrix=MATRIX, lights=LIGHTS, covariance=half @ half.T)
    errors = rng.multivariate_normal(np.zeros(9), half @ half.T, 4000).reshape(-1, 3, 3)
    left = -np.linalg.inv(MATRIX) @ errors
    assert crosstalk.leakage_std == pytest.approx(left.std(axis=0), rel=0.06)
    assert Crosstalk(matrix=MATRIX, lights=LIGHTS).leakage_std is None


def test_fields_that_do_not_fit_are_errors():
    with pytest.raises(CalibrationError, match="order 2 needs 5"):
        CrosstalkField(order=2, coefficients=np.zeros((3, 3, 3)), shape=SHAPE)
    field = CrosstalkField(order=1, coefficients=np.zeros((2, 3, 2)), shape=SHAPE)
    with pytest.raises(CalibrationError, match=r"matrices of shape \(3, 2\)"):
        Crosstalk(matrix=MATRIX, lights=LIGHTS, field=field)
