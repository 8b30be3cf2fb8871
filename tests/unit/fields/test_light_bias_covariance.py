"""What the lights' bias leaves is alike over its range: covered in draws by every probe, gauge and fit."""

from __future__ import annotations

import numpy as np
import pytest
from nodal_tests import COVARIANCE, MESH, nodal_noise

from rgbmidic.fields import Displacement, Field, NodalCovariance, RigidMotion, StrainGauges, make_probe
from rgbmidic.mesh import Region, Tri3Mesh

RANGE, DRAWS = 34.0, 300
PLACES = {
    "point": (53.3, 47.1),
    "line": (20, 20, 200, 100),
    "circle": (100, 80, 40),
    "region": (20, 30, 150, 160),
    "gauge": (33, 40, 190, 120),
    "strain_gauge": (111, 90, 90),
}
FIT = 0.004 * (1 + MESH.nodes[:, 0] / 200)
BIAS = 0.008 * np.exp(-(((MESH.nodes[:, 0] - 80) / 60) ** 2))
"""As in glare over the left half."""
STD = np.hypot(FIT, BIAS)


def correlation(nodes: np.ndarray) -> np.ndarray:
    """exp(-d^2 / (4 r^2)) between nodes (N, 2)."""
    return np.asarray(np.exp(-((nodes[:, None] - nodes) ** 2).sum(axis=-1) / (4 * RANGE**2)))


ROOT = np.linalg.cholesky(correlation(MESH.nodes) + 1e-9 * np.eye(len(MESH.nodes)))
_RANDOM = np.random.default_rng(4)
NOISE = nodal_noise(_RANDOM, DRAWS) * FIT[:, None]
NOISE = NOISE + (ROOT @ _RANDOM.normal(size=(DRAWS, len(FIT), 2))) * BIAS[:, None]
FIELDS = np.stack(
    [*NOISE.transpose(2, 0, 1), *(np.broadcast_to(part, NOISE.shape[:2]) for part in (STD, STD, BIAS, BIAS))]
)


def test_its_correlation_is_that_of_its_distance_in_px_of_the_image() -> None:
    """Within .01 on any mesh, also where nodes are in mm."""
    outline = Region.from_polygon([(10, 60), (60, 5), (115, 50), (70, 110)], (120, 120))
    for mesh in (MESH, Tri3Mesh.from_region(outline, 9)):
        in_mm = Tri3Mesh(nodes=0.05 * mesh.nodes, elements=mesh.elements)
        for found in (NodalCovariance.from_mesh(mesh), NodalCovariance.from_mesh(in_mm, mesh.nodes)):
            np.testing.assert_allclose((found.bias @ found.bias.T).toarray(), correlation(mesh.nodes), atol=0.01)
            one = np.ones(len(mesh.nodes))
            field = Field(name="u", values=one, std=2 * one, bias=one)
            np.testing.assert_allclose(found.variance(np.eye(len(mesh.nodes)), field), 4.0)


@pytest.mark.parametrize("kind", PLACES)
def test_every_probe_is_covered(kind: str) -> None:
    """300 draws: rms of error over stated within 3 standard deviations of 1."""
    probe = make_probe(COVARIANCE, kind, 1, PLACES[kind])
    for history in probe.histories(Displacement.in_plane(*FIELDS[..., probe.nodes])):
        if history.name.endswith(("_u", "_v", "extension", "exx", "eyy", "exy")):
            assert history.std is not None
            assert abs(np.sqrt(np.mean((history.values / history.std) ** 2)) - 1) < 0.13, history.name


def test_a_mean_in_glare_is_less_certain() -> None:
    """With the whole uncertainty correlated by the mesh it was stated half as large."""
    probe = make_probe(COVARIANCE, "region", 1, (40, 40, 120, 130))
    exact = COVARIANCE.correlation.toarray() * np.outer(FIT, FIT) + correlation(MESH.nodes) * np.outer(BIAS, BIAS)
    part = exact[np.ix_(probe.nodes, probe.nodes)]
    mean, *_ = probe.histories(Displacement.in_plane(*FIELDS[:, :1, probe.nodes]))
    plain, *_ = probe.histories(Displacement.in_plane(*FIELDS[:4, :1, probe.nodes]))
    covariance = COVARIANCE.subset(probe.nodes)
    factor = covariance.factor(STD[probe.nodes], BIAS[probe.nodes])
    np.testing.assert_allclose((factor @ factor.T).toarray(), part, atol=1e-2 * BIAS.max() ** 2)
    assert np.all(np.asarray(mean.std) > 1.5 * np.asarray(plain.std))


def test_gauges_at_nodes_have_it_as_it_is_and_that_of_the_fit_by_its_inflation() -> None:
    gauges = StrainGauges.at_nodes(COVARIANCE, 80)
    still = np.zeros(len(STD))
    _, found = gauges.gradient(Displacement.in_plane(still, still, STD, STD, BIAS, BIAS))
    _, fit = gauges.gradient(Displacement.in_plane(still, still, FIT, FIT))
    dense = correlation(MESH.nodes) * np.outer(BIAS, BIAS)
    x, y = (slope.toarray() for slope in gauges.slopes)
    for (row, column), (a, b) in {(0, 0): (x, x), (0, 1): (x, y), (1, 1): (y, y), (3, 3): (y, y)}.items():
        exact = np.einsum("gn,nm,gm->g", a, dense, b)
        scale = np.sqrt(np.einsum("gn,nm,gm->g", a, dense, a) * np.einsum("gn,nm,gm->g", b, dense, b)).max()
        np.testing.assert_allclose((found - fit)[:, row, column], exact, atol=0.03 * scale)
    missing = np.where(np.arange(len(STD)) == 40, np.nan, 0.0)
    _, beside = gauges.gradient(Displacement.in_plane(missing, still, STD, STD, BIAS, BIAS))
    assert np.isfinite(beside).all(axis=(1, 2)).sum() == len(STD) - MESH.adjacent_nodes(np.isnan(missing)).sum()


def test_a_rigid_motion_is_covered() -> None:
    found = [RigidMotion.of(COVARIANCE, Displacement.in_plane(*fields)) for fields in FIELDS.swapaxes(0, 1)]
    ratios = [[one.rotation.values / one.rotation.std, *(one.shift.values / one.shift.std)] for one in found]
    assert (np.abs(np.sqrt(np.mean(np.square(ratios), axis=0)) - 1) < 0.13).all()
    removed = found[0].removed(MESH.nodes, Displacement.in_plane(*FIELDS[:, 0]))
    np.testing.assert_allclose([*removed.std, *removed.bias], FIELDS[2:, 0], atol=1e-9)
