"""What the recovery misses near free boundaries: cubics exactly, quadratics not at all, and how much noise it has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.correlation import Solution, unresolved_strain, with_one_sided_error
from rgbmidic.correlation.one_sided_fit import _CONSTANTS, _boundary_fits, one_sided_error
from rgbmidic.correlation.solution import NodeStatus
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import Recovery, at_free_boundary
from rgbmidic.typing import FloatArray

Y, X = np.mgrid[:200, :200]
INSIDE = (np.abs(X - 100) < 90) & (np.abs(Y - 100) < 90)
MESH = Tri3Mesh.from_region(Region.from_mask(INSIDE & (np.hypot(X - 100, Y - 100) > 30)), 16)
USED, COUNT = np.ones(len(MESH.elements), dtype=bool), len(MESH.nodes)
RECOVERY = Recovery.over(MESH, USED)
OPERATORS = RECOVERY.value, RECOVERY.slope_x, RECOVERY.slope_y
EDGE = at_free_boundary(MESH)
NEAR = EDGE | MESH.adjacent_nodes(EDGE)


def field(points: FloatArray, cubic: bool) -> FloatArray:
    """A polynomial and its slopes along x and y, (..., 3)."""
    x, y = np.moveaxis(points - 100, -1, 0) / 50
    c, value = float(cubic), 1 + x - y + x * x - 2 * x * y + 3 * y * y
    slopes = 1 + 2 * x - 2 * y + c * (3 * x * x + 4 * x * y), -1 - 2 * x + 6 * y + c * (2 * x * x - 3 * y * y)
    return np.stack([value + c * (x**3 + 2 * x * x * y - y**3), slopes[0] / 50, slopes[1] / 50], axis=-1)


def best_linear_fit(cubic: bool) -> FloatArray:
    """Least squares over the elements, exact to the ninth order, element by element."""
    (points, rule), (first, second) = np.polynomial.legendre.leggauss(5), np.mgrid[:5, :5].reshape(2, -1)
    a, b, weights = (1 + points[first]) / 2, (1 + points[second]) / 2, rule[first] * rule[second]
    weights, shape = weights * (1 - a), np.stack([a, (1 - a) * b, (1 - a) * (1 - b)])
    right, mass = np.zeros(COUNT), np.zeros((COUNT, COUNT))
    for corners, area in zip(MESH.elements, MESH.areas, strict=True):
        weighted = shape * weights * area
        right[corners] += weighted @ field(shape.T @ MESH.nodes[corners], cubic)[:, 0]
        mass[np.ix_(corners, corners)] += weighted @ shape.T
    return np.linalg.solve(mass, right)


@pytest.mark.parametrize("cubic", [True, False])
def test_what_is_missed_of_a_cubic_is_known_exactly_and_nothing_of_a_quadratic(cubic: bool) -> None:
    fitted, fits = best_linear_fit(cubic), _boundary_fits(MESH, USED.tobytes())
    recovered = RECOVERY.value @ fitted
    for term, (operator, missed) in enumerate(zip(OPERATORS, (fits.value, fits.slope_x, fits.slope_y), strict=True)):
        error = (operator @ fitted - field(MESH.nodes, cubic)[:, term])[NEAR]
        size, left = np.linalg.norm(error), np.linalg.norm((missed @ recovered)[NEAR] - error)
        if cubic:  # a node whose window is narrow in one direction knows less
            assert left < 0.1 * size
        else:
            assert max(size, left) < 1e-4
        assert not np.diff(missed.indptr)[~NEAR].any()


def test_the_noise_of_the_operators_is_known() -> None:
    fits, inverse = _boundary_fits(MESH, USED.tobytes()), np.linalg.inv(MESH.mass_matrix.toarray())
    nodal = RECOVERY.value @ (RECOVERY.value @ inverse).T
    for operator, factor in ((fits.value, _CONSTANTS.noise), (fits.departure, _CONSTANTS.departure_noise)):
        rows = np.flatnonzero(np.diff(operator.indptr))
        true = np.einsum("ij,jk,ik->i", *(operator.toarray()[rows], nodal, operator.toarray()[rows]))
        stated = factor * operator.power(2)[rows] @ np.diag(nodal)
        assert 0.6 < true.sum() / stated.sum() < 1.2  # measured: .94 and .8


def solution(displacement: FloatArray, std: float) -> Solution:
    found = Solution.failed(MESH, 1, "", np.zeros(1))
    strain_std = np.full((COUNT, 3), std / MESH.size)
    measured = np.full(COUNT, NodeStatus.MEASURED, dtype=np.uint8)
    spread = np.full((COUNT, 2), std)
    return replace(
        found, displacement=displacement, displacement_std=spread, strain_std=strain_std, node_status=measured
    )


def test_strain_that_falls_off_at_a_hole_is_called_unresolved_and_an_affine_field_is_not() -> None:
    arm = MESH.nodes - 100
    falling = arm * (30 / np.hypot(*arm.T)[:, None]) ** 6
    for displacement, is_resolved in ((arm * 0.01, True), (falling, False)):
        found = solution(displacement, 0.01)
        with_error = with_one_sided_error(MESH, found)
        text = unresolved_strain(MESH, found, with_error)
        assert ("it may be off by" in text) is not is_resolved
        assert np.array_equal(with_error.displacement_std, found.displacement_std) == is_resolved
        error = one_sided_error(MESH, USED, displacement, found.displacement_std)
        assert not error[~NEAR].any()


def test_a_strain_error_that_nobody_reads_is_not_reported_however_small_the_noise() -> None:
    arm = MESH.nodes - 100
    found = solution(1e-6 * arm * (30 / np.hypot(*arm.T)[:, None]) ** 6, 1e-8)
    assert unresolved_strain(MESH, found, with_one_sided_error(MESH, found)) == ""


def test_few_nodes_have_no_error() -> None:
    used = MESH.elements == MESH.elements[0, 0]
    error = one_sided_error(MESH, used.any(axis=1), MESH.nodes**2, np.ones((COUNT, 2)))
    assert not error.any()
