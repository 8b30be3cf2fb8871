"""Solves with a factorisation and quadratic forms of many vectors, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp

from rgbmidic._kernels.threads import set_threads, threads
from rgbmidic._kernels.triangular import node_energies
from rgbmidic.correlation.assembly import factorise

RANDOM = np.random.default_rng(0)


def symmetric(size, anchor):
    """A sparse symmetric positive definite matrix."""
    part = sp.random(size, size, density=3 / size, random_state=np.random.default_rng(1))
    return sp.csc_matrix(part @ part.T + anchor * sp.eye(size))


@pytest.mark.parametrize("anchor", [1.0, 1e-6])
@pytest.mark.parametrize("shape", [(120,), (120, 0), (120, 1), (120, 32), (120, 70)])
def test_a_factorised_matrix_solves_for_one_and_many_right_hand_sides(shape, anchor):
    matrix, wanted = symmetric(120, anchor), RANDOM.normal(size=shape)
    found = factorise(matrix)(matrix @ wanted)
    assert found.shape == shape
    np.testing.assert_allclose(matrix @ found, matrix @ wanted, atol=1e-10)


def test_what_each_node_adds_to_a_quadratic_form():
    matrix, vectors = symmetric(80, 1.0), RANDOM.normal(size=(80, 45))
    energies = np.full((40, 45), 7.0)
    node_energies(matrix.data, matrix.indices, matrix.indptr, vectors, energies)
    wanted = vectors * (matrix @ vectors)
    np.testing.assert_allclose(energies, wanted[::2] + wanted[1::2], atol=1e-10)


def test_the_same_bits_on_one_and_three_threads():
    matrix, right = symmetric(80, 1.0), RANDOM.normal(size=(80, 101))

    def found(number):
        set_threads(number)
        solved, energies = factorise(matrix)(right), np.empty((40, 101))
        node_energies(matrix.data, matrix.indices, matrix.indptr, solved, energies)
        return solved, energies

    before = threads()
    try:
        for one, three in zip(found(1), found(3), strict=True):
            np.testing.assert_array_equal(one, three)
    finally:
        set_threads(before)
