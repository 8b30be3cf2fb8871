"""Strain measures in closed form, their uncertainty, and gauges that tell nothing beside what is not measured."""

from __future__ import annotations

import numpy as np
import pytest
from nodal_tests import COVARIANCE, MESH

from rgbmidic.errors import InputError
from rgbmidic.fields import (
    MEASURES,
    Displacement,
    NodalCovariance,
    StrainGauges,
    shortest_gauge,
    strain_of,
    strain_of_gradient,
)
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.settings import ProbeSettings, convert_value

NODES = len(MESH.nodes)
STILL = np.zeros(NODES)
RANDOM = np.random.default_rng(5)


def turn(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]])


def field(gradient: np.ndarray) -> np.ndarray:
    """u and v (2, N) of a homogeneous displacement gradient."""
    return gradient @ (MESH.nodes - 100).T


@pytest.mark.parametrize(
    ("measure", "of_stretch"),
    [
        ("green-lagrange", lambda stretch: (stretch**2 - 1) / 2),
        ("hencky", np.log),
        ("biot", lambda stretch: stretch - 1),
    ],
)
def test_finite_strain_is_the_function_of_the_stretch_whatever_the_rotation(measure, of_stretch):
    axes, stretch = turn(25), np.array([1.3, 0.85])
    pure = axes * stretch @ axes.T
    expected = axes * of_stretch(stretch) @ axes.T
    for degrees in (0, 30, 170):
        strain = strain_of(
            MESH.nodes, MESH.elements, *field(turn(degrees) @ pure - np.eye(2)), STILL, STILL, measure=measure
        )
        np.testing.assert_allclose(strain.components, [expected[[0, 1, 0], [0, 1, 1]]] * NODES, atol=1e-12)
        np.testing.assert_allclose(
            np.stack([strain["e1"].values, strain["e2"].values], axis=1), [of_stretch(stretch)] * NODES, atol=1e-12
        )
        np.testing.assert_allclose(strain["direction"].values, 25)


def test_a_rotation_of_30_degrees_is_no_strain_but_a_small_one_of_13_percent():
    moved = field(turn(30) - np.eye(2))
    for measure in MEASURES[:3]:
        assert (
            np.abs(strain_of(MESH.nodes, MESH.elements, *moved, STILL, STILL, measure=measure).components).max() < 1e-12
        )
    small = strain_of(MESH.nodes, MESH.elements, *moved, STILL, STILL, measure="engineering")
    np.testing.assert_allclose(small.components, [[np.cos(np.pi / 6) - 1] * 2 + [0]] * NODES, atol=1e-12)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("stretch", [1.02, 1.5])
def test_the_equivalent_of_a_tensile_test_at_constant_volume_is_the_logarithm_of_the_stretch(measure, stretch):
    """Green-Lagrange strain in its place gives .647 at a stretch of 1.5, which is neither ln 1.5 nor its own .625."""
    for angle in (0, 30):
        gradient = turn(angle) @ np.diag([stretch**-0.5, stretch]) - np.eye(2)
        strain = strain_of_gradient(gradient, np.zeros((4, 4)), measure)
        assert strain["equivalent"].values == pytest.approx(np.log(stretch))


def test_the_equivalent_of_simple_shear_is_von_mises_s():
    gradient = np.array([[0, 0.8], [0, 0]])
    stretch = 0.4 + np.sqrt(0.4**2 + 1)
    found = strain_of_gradient(gradient, np.zeros((4, 4)))
    assert found["equivalent"].values == pytest.approx(2 / np.sqrt(3) * np.log(stretch))


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("gradient", [turn(40) * [1.2, 0.9] - np.eye(2), turn(200) * 1.1 - np.eye(2)])
def test_uncertainty_is_that_of_draws_of_the_gradient(measure, gradient):
    root = RANDOM.normal(size=(4, 4)) * 1e-4
    drawn = gradient + (RANDOM.normal(size=(20_000, 4)) @ root.T).reshape(-1, 2, 2)
    stated = strain_of_gradient(gradient, root @ root.T, measure)
    found = strain_of_gradient(drawn, np.zeros((len(drawn), 4, 4)), measure)
    np.testing.assert_allclose(found.components.std(axis=0), stated.components_std, rtol=0.03)
    np.testing.assert_allclose(found["equivalent"].values.std(), stated["equivalent"].std, rtol=0.03)
    if stated["shear"].values > 0.01:  # else which one is larger is chance
        for name in ("e1", "e2"):
            np.testing.assert_allclose(found[name].values.std(), stated[name].std, rtol=0.03)
        np.testing.assert_allclose(found["direction"].values.std(), stated["direction"].std, rtol=0.03)


def test_no_strain_has_the_equivalent_and_the_direction_of_noise():
    covariance = np.eye(4) * 1e-8
    stated = strain_of_gradient(np.zeros((2, 2)), covariance)
    drawn = strain_of_gradient(RANDOM.normal(size=(5000, 2, 2)) * 1e-4, np.broadcast_to(covariance, (5000, 4, 4)))
    assert stated["equivalent"].std == pytest.approx(np.sqrt(np.mean(drawn["equivalent"].values ** 2)), rel=0.03)
    assert np.median(drawn["direction"].std) > 15
    assert drawn["direction"].std.max() == pytest.approx(180 / np.sqrt(12))


def test_nothing_is_told_beside_what_is_not_measured_and_the_rest_stays_right():
    u, v = field(np.array([[0.01, 0.004], [0.002, -0.003]]))
    hole = np.hypot(*(MESH.nodes - [110, 90]).T) < 15
    strain = strain_of(
        MESH.nodes, MESH.elements, np.where(hole, np.nan, u), v, STILL, STILL, gauge=120, measure="engineering"
    )
    beside = MESH.adjacent_nodes(hole)
    assert beside.sum() > hole.sum() > 0
    assert np.isnan(strain.components[beside]).all()
    np.testing.assert_allclose(strain.components[~beside], [[0.01, -0.003, 0.003]] * (~beside).sum(), atol=1e-12)


@pytest.mark.parametrize("rectangle", [(20, 30, 372, 210), (20, 30, 370, 210), (22, 32, 366, 208), (20, 30, 360, 200)])
@pytest.mark.parametrize("size", [18, 12, 9])
def test_the_shortest_gauges_have_a_strain_at_every_node_of_an_edge(rectangle, size):
    ring = [(231, 120), (222, 142), (200, 151), (178, 142), (169, 120), (178, 98), (200, 89), (222, 98)]
    mesh = Tri3Mesh.from_region(Region.from_rectangle(rectangle, (240, 400)).without([ring]), size)
    u, v = np.array([[0.01, 0.004], [0.002, -0.003]]) @ mesh.nodes.T
    std = np.full(len(u), 0.01)
    strain = strain_of(mesh.nodes, mesh.elements, u, v, std, std, measure="engineering")
    np.testing.assert_allclose(strain.components, [[0.01, -0.003, 0.003]] * len(u), atol=1e-12)
    # one-sided: 4.3 times as uncertain as the median at most (12 of variance before, and NaN)
    assert strain.components_std.max() < 4.5 * np.median(strain.components_std)


def test_no_gauge_reaches_across_a_crack():
    region = Region.from_rectangle((5, 5, 155, 105), (110, 160))
    mesh = Tri3Mesh.from_region(region, 12, [[[0, 55], [160, 55]]])
    opened = np.where(mesh.observation_points[:, 1] < 55, 0.0, 3.0)
    still = np.zeros(len(mesh.nodes))
    strain = strain_of(mesh.nodes, mesh.elements, still, opened, still, still, gauge=80)
    assert np.abs(strain.components).max() < 1e-12


def test_a_longer_gauge_is_more_certain_and_sees_less():
    wave = 0.1 * np.sin(2 * np.pi * MESH.nodes[:, 0] / 120)
    std = np.full(NODES, 0.01)
    told = [
        StrainGauges.at_nodes(COVARIANCE, length).strain(Displacement.in_plane(wave, STILL, std, std))
        for length in (60, 90, 130, 180)
    ]
    heights = [np.nanmax(strain.components[:, 0]) for strain in told]
    stds = [np.median(strain.components_std[:, 0]) for strain in told]
    assert (np.diff(heights) < 0).all()
    assert (np.diff(stds) < 0).all()


def test_gauges_that_are_too_short_or_outside_are_refused_in_one_line():
    assert shortest_gauge(MESH) == pytest.approx(60)
    with pytest.raises(InputError, match=r"at least 60 px long, 3 elements; given are 30 px"):
        StrainGauges.at_nodes(COVARIANCE, 30)
    with pytest.raises(InputError, match=r"\(300, 90\) px is outside the region that was measured, .* x 10 to 210"):
        StrainGauges.at_points(COVARIANCE, np.array([[300.0, 90.0]]))
    with pytest.raises(InputError, match=r'unknown strain measure "euler"; allowed are green-lagrange, hencky'):
        strain_of_gradient(np.zeros((2, 2)), np.zeros((4, 4)), "euler")
    with pytest.raises(InputError, match=r"needs u_std and v_std, .*; 0 arrays are given"):
        strain_of(MESH.nodes, MESH.elements, STILL, STILL)


def test_the_settings_offer_the_measures_that_there_are():
    for measure in MEASURES:
        assert ProbeSettings(measure=measure).measure == measure
    from typing import get_type_hints

    from rgbmidic.errors import ConfigurationError

    with pytest.raises(ConfigurationError, match=", ".join(f'"{measure}"' for measure in MEASURES)):
        convert_value("euler", get_type_hints(ProbeSettings)["measure"], "probes.measure", None)


def test_a_small_mesh_has_the_correlation_of_its_own_size():
    tiny = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 40, 40), (60, 60)), 40)
    assert np.isfinite(NodalCovariance.from_mesh(tiny).correlation.toarray()).all()
