"""Factorisation, solves with it and quadratic forms of many vectors, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from bits import assert_same_on_threads

from rgbmidic import Region, Tri3Mesh
from rgbmidic._kernels.factors import node_energies
from rgbmidic.correlation.assembly import Assembly

RANDOM = np.random.default_rng(0)


def assembled(anchor, outlined=False):
    """Structure and matrix of a small mesh, symmetric and positive definite."""
    region = Region.from_rectangle((3, 5, 110, 90), (97, 121))
    if outlined:
        region = Region.from_polygon([(10, 5), (115, 20), (90, 90), (20, 80), (40, 45)], (97, 121))
    mesh = Tri3Mesh.from_region(region, 13)
    slopes, shapes = RANDOM.normal(size=(len(mesh.elements), 5, 2)), RANDOM.uniform(size=(len(mesh.elements), 5, 3))
    x, y = slopes[..., 0], slopes[..., 1]
    blocks = np.einsum("enc,ena,enb->eabc", np.stack([x * x, x * y, y * y], axis=2), shapes, shapes)
    assembly = Assembly.from_mesh(mesh)
    return assembly, assembly.matrix(blocks, anchor * assembly.diagonal)


@pytest.mark.parametrize("outlined", [False, True])
@pytest.mark.parametrize("anchor", [1.0, 1e-6])
@pytest.mark.parametrize("shape", [(), (0,), (1,), (32,), (70,)])
def test_a_factorised_matrix_solves_for_one_and_many_right_hand_sides(shape, anchor, outlined):
    assembly, matrix = assembled(anchor, outlined)
    wanted = RANDOM.normal(size=(assembly.size, *shape))
    found = assembly.factorise(matrix)(matrix @ wanted)
    assert found.shape == wanted.shape
    np.testing.assert_allclose(matrix @ found, matrix @ wanted, atol=1e-9)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("fault", ["zero", "negative", "texture in one direction", "constants are free"])
def test_a_singular_matrix_is_refused(fault):
    assembly, matrix = assembled(1.0)
    shapes = RANDOM.uniform(size=(len(assembly.unknowns) // 6, 5, 3))
    sloping = np.einsum("ena,enb,c->eabc", shapes, shapes, [4.0, 2.0, 1.0])
    singular = {
        "zero": matrix * 0,
        "negative": -matrix,
        "texture in one direction": assembly.matrix(sloping),
        "constants are free": assembly.smoothness,
    }
    with pytest.raises(np.linalg.LinAlgError, match="singular"):
        assembly.factorise(singular[fault])


def test_what_each_node_adds_to_a_quadratic_form():
    _, matrix = assembled(1.0)
    vectors = RANDOM.normal(size=(matrix.shape[0], 45))
    energies = np.full((len(vectors) // 2, 45), 7.0)
    node_energies(matrix.data, matrix.indices, matrix.indptr, vectors, energies)
    wanted = vectors * (matrix @ vectors)
    np.testing.assert_allclose(energies, wanted[::2] + wanted[1::2], atol=1e-10)


def test_the_same_bits_on_one_and_three_threads():
    assembly, matrix = assembled(1.0)
    right = RANDOM.normal(size=(assembly.size, 101))

    def found():
        solved, energies = assembly.factorise(matrix)(right), np.empty((assembly.size // 2, 101))
        node_energies(matrix.data, matrix.indices, matrix.indptr, solved, energies)
        return solved, energies

    assert_same_on_threads(found)
