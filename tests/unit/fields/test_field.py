"""A field keeps values and uncertainties together; displacements of three components have the same probes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.fields import Displacement, Field, NodalCovariance, StrainGauges, Units, make_probe
from rgbmidic.mesh import Region, Tri3Mesh

MESH = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 120, 90), shape=(100, 130)), element_size=15)
COUNT = len(MESH.nodes)
FLAT = NodalCovariance.from_mesh(MESH)
IN_SPACE = replace(FLAT, surface=np.column_stack([0.05 * MESH.nodes, 0.02 * MESH.nodes[:, 0]]))
MIXING = np.array([[1.0, 0.0, 0.0], [0.3, 0.8, 0.0], [2.0, -1.0, 3.0]]) * 1e-3
"""Root of the covariance of u, v and w, mm: along the line of sight they are as uncertain as they are correlated."""
COVARIANCE = np.broadcast_to((MIXING @ MIXING.T)[:, :, None, None], (3, 3, 1, COUNT))


def in_space(values: np.ndarray) -> Displacement:
    """Displacements (3, T, N) in mm with that covariance."""
    covariance = np.broadcast_to(COVARIANCE, (3, 3, *values.shape[1:]))
    std = np.sqrt(np.einsum("iitn->itn", covariance))
    return Displacement(unit="mm", values=values, std=std, covariance=covariance)


def noise(draws: int) -> np.ndarray:
    root = FLAT.fit.toarray()
    independent = np.random.default_rng(0).normal(size=(draws, root.shape[1], 3))
    return np.einsum("nr,trk,ik->itn", root, independent, MIXING, optimize=True)


@pytest.mark.parametrize(("kind", "place"), [("point", (60, 40)), ("gauge", (20, 40, 100, 50))])
def test_a_probe_in_space_is_as_uncertain_as_it_says(kind: str, place: tuple[float, ...]) -> None:
    probe = make_probe(IN_SPACE, kind, 1, place)
    histories = probe.histories(in_space(noise(2000)).isel(node=probe.nodes))
    for history in histories:
        assert history.values.std() == pytest.approx(np.median(history.uncertainty), rel=0.06), history.name
    assert [history.name for history in histories][:3] == (
        ["point_1_u", "point_1_v", "point_1_w"] if kind == "point" else ["gauge_1_extension", "gauge_1_strain"]
    )


def test_an_extensometer_in_space_has_the_length_in_space() -> None:
    probe = make_probe(IN_SPACE, "gauge", 1, (20, 40, 100, 40))
    moved = np.zeros((3, 1, COUNT))
    moved[0] = 0.01 * 0.05 * MESH.nodes[:, 0]
    _, strain = probe.histories(in_space(moved).isel(node=probe.nodes))
    assert strain.values[0] == pytest.approx(np.hypot(1.01 * 0.05, 0.02) / np.hypot(0.05, 0.02) - 1, rel=1e-9)


def test_slopes_of_three_components_have_their_covariance() -> None:
    gauges, draws = StrainGauges.at_nodes(FLAT, 60), noise(400)
    slopes = np.array([gauges.gradient(in_space(draws).isel(frame=draw))[0] for draw in range(400)])
    stated = gauges.gradient(in_space(draws).isel(frame=0))[1]
    middle = np.hypot(*(MESH.nodes - (60, 45)).T).argmin()
    found, expected = np.cov(slopes[:, middle].reshape(400, 6).T), stated[middle]
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / size, expected / size, atol=0.2)
    zero = replace(in_space(draws), covariance=None).isel(frame=0)
    assert np.abs(gauges.gradient(zero)[1][:, :2, 2:]).max() == 0


def test_what_has_no_uncertainty_has_no_variance() -> None:
    zero = np.zeros((1, COUNT))
    probe = make_probe(FLAT, "point", 1, (60, 40))
    assert np.isnan(probe.histories(Displacement.in_plane(zero, zero).isel(node=probe.nodes))[0].uncertainty).all()


def test_arrays_go_together() -> None:
    field = Field(name="u", unit="px", dims=("node",), values=np.arange(4.0), std=np.ones(4), bias=np.full(4, 0.5))
    both = Field.concatenate([field, field])
    assert (both.dims, both.values.shape) == (("frame", "node"), (2, 4))
    part = both.isel(frame=1, node=[3, 0])
    assert (part.dims, part.values.tolist(), part.std is not None) == (("node",), [3.0, 0.0], True)
    longer = Field.concatenate([field, field], "node")
    assert (longer.dims, longer.values.shape) == (("node",), (8,))
    in_mm = Units(mm_per_pixel=0.1, mm_per_pixel_std=0.01).convert(field)
    np.testing.assert_allclose(in_mm.uncertainty, np.hypot(0.1, 0.01 * np.arange(4)))
    np.testing.assert_allclose(in_mm.bias, 0.05)  # type: ignore[arg-type]
    assert Units(mm_per_pixel=0.1).convert(replace(field, unit="deg")).unit == "deg"


def test_neighbours_whose_covariances_are_nearly_round_are_correlated() -> None:
    """Eigenvectors differ from node to node without a cause, u and v being as uncertain; their errors do not."""
    root = np.diag([1.0, 1.0, 5.0])[..., None] + 0.01 * np.random.default_rng(1).normal(size=(3, 3, COUNT))
    covariance = 1e-6 * np.einsum("ikn,jkn->ijn", root, root)
    std = np.sqrt(np.einsum("iin->in", covariance))
    displacement = Displacement(unit="mm", values=np.zeros((3, COUNT)), std=std, covariance=covariance)
    mean = np.full(COUNT, 1 / COUNT)
    of_mean = np.diag(IN_SPACE.of_sums(mean[None], displacement))
    np.testing.assert_allclose(of_mean, [IN_SPACE.variance(mean, one) for one in displacement.components], rtol=0.01)
