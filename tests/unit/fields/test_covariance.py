"""Correlation between nodes, and what it makes of means, gauges and rigid motions: covered in draws."""

from __future__ import annotations

import numpy as np
import pytest
from nodal_tests import COVARIANCE, MESH, dense_correlation, nodal_noise

from rgbmidic.errors import InputError
from rgbmidic.fields import Displacement, NodalCovariance, RigidMotion, make_probe
from rgbmidic.mesh import Region, Tri3Mesh

DRAWS = 100
STD = 0.01 * (1 + MESH.nodes[:, 0] / 200)
"""Twice as uncertain on the right as on the left."""
NOISE = nodal_noise(np.random.default_rng(2), DRAWS) * STD[:, None]
PLACES = {
    "point": (53.3, 47.1),
    "line": (20, 20, 200, 100),
    "circle": (100, 80, 40),
    "region": (20, 30, 150, 160),
    "gauge": (33, 40, 190, 120),
    "straight_gauge": (33, 40, 190, 120),
    "strain_gauge": (111, 90, 90),
}


def test_it_is_that_of_dense_algebra():
    round_region = Region.from_polygon([(10, 60), (60, 5), (115, 50), (70, 110)], (120, 120))
    for mesh in (MESH, Tri3Mesh.from_region(round_region, 14)):
        found = NodalCovariance.from_mesh(mesh).correlation.toarray()
        np.testing.assert_allclose(found, dense_correlation(mesh), atol=0.02)
        assert np.linalg.eigvalsh(found).min() > 0


def nodal(nodes: np.ndarray, motion: np.ndarray) -> Displacement:
    std = np.broadcast_to(STD[nodes], (len(motion), len(nodes)))
    return Displacement.in_plane(*np.moveaxis(motion[:, nodes], 2, 0), std, std)


@pytest.mark.parametrize("kind", PLACES)
def test_every_probe_is_covered_by_what_it_states(kind):
    """100 draws: of the errors 86 to 100 % within 1.96, rms over stated .8 to 1.2 (3 standard deviations of either)."""
    probe = make_probe(COVARIANCE, kind, 1, PLACES[kind])
    truth = np.broadcast_to(MESH.nodes @ np.array([[0.02, 0.005], [-0.004, -0.01]]), NOISE.shape)
    found, true = (probe.histories(nodal(probe.nodes, motion)) for motion in (truth + NOISE, truth))
    for measured, exact in zip(found, true, strict=True):
        ratio = (measured.values - exact.values) / measured.std
        assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2, measured.name
        assert np.mean(np.abs(ratio) < 1.96) >= 0.86, measured.name


def test_a_mean_over_neighbours_is_less_certain_than_their_number_says():
    probe = make_probe(COVARIANCE, "region", 1, (20, 30, 150, 160))
    mean, *_ = probe.histories(nodal(probe.nodes, NOISE))
    parts = probe.weights(np.ones((1, len(probe.nodes)), dtype=bool))[0][0, 0] * STD[probe.nodes]
    together = dense_correlation(MESH)[np.ix_(probe.nodes, probe.nodes)]
    assert mean.std[0] == pytest.approx(np.sqrt(parts @ together @ parts), rel=0.01)
    assert mean.std[0] > 1.03 * np.sqrt(parts @ parts)


def test_a_rigid_motion_is_found_covered_and_taken_off():
    errors = []
    angle, shift = np.radians(40), np.array([12.0, -7.0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = MESH.nodes.mean(axis=0)
    rigid = (MESH.nodes - centre) @ turn.T + centre + shift - MESH.nodes
    for noise in NOISE:
        found = RigidMotion.of(COVARIANCE, Displacement.in_plane(*(rigid + noise).T, STD, STD))
        turned, moved = found.rotation, found.shift
        errors.append([(turned.values - angle) / turned.std, *((moved.values - shift) / moved.std)])
    assert (np.abs(np.sqrt(np.mean(np.square(errors), axis=0)) - 1) < 0.2).all()
    exact = RigidMotion.of(COVARIANCE, Displacement.in_plane(*rigid.T, STD, STD))
    np.testing.assert_allclose(exact.at(MESH.nodes), rigid, atol=1e-9)
    own = np.stack([0.01 * (MESH.nodes[:, 0] - centre[0]), np.zeros(len(STD))])
    moved = (MESH.nodes + own.T - centre) @ turn.T + centre + shift - MESH.nodes
    left = exact.removed(MESH.nodes, Displacement.in_plane(*moved.T, STD, STD))
    np.testing.assert_allclose(left.values, own, atol=1e-9)
    np.testing.assert_allclose(left.std, [STD, STD])
    with pytest.raises(InputError, match="two measured nodes"):
        RigidMotion.of(COVARIANCE, Displacement.in_plane(*np.full((2, len(STD)), np.nan), STD, STD))
