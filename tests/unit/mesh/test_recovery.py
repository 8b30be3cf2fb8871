"""The field at the nodes recovered from the best linear fit: quadratics at any place of any mesh, waves, noise."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from rgbmidic.fields import at_pixels
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.mesh.recovery import Recovery, _relative_information, _ways

SIZE = 10.0
GAIN = {3: (0.90, 1.03), 4: (0.97, 1.03), 6: (0.99, 1.02)}
"""Height of a wave at the nodes over the true one, at periods in elements."""
QUIETER = 0.72
"""Scatter of an inner node over that of the linear fit."""
PIXEL_ERROR = {4: 0.05, 6: 0.01, 8: 0.004}
"""rms error between the nodes over the wave's, at periods in elements; measured .031, .006, .003."""
MESHES = ("rectangle", "disc with a hole", "jittered")


@cache
def meshed(kind: str) -> tuple[Tri3Mesh, PixelMap]:
    shape = (201, 201)
    y, x = np.mgrid[: shape[0], : shape[1]] - 100
    region = Region.from_rectangle((0, 0, 200, 200), shape)
    if kind == "disc with a hole":
        region = Region.from_mask((np.hypot(x, y) < 98) & (np.hypot(x - 20, y) > 30))
    mesh = Tri3Mesh.from_region(region, SIZE)
    if kind == "jittered":
        shift = np.random.default_rng(0).uniform(-1.5, 1.5, mesh.nodes.shape)
        mesh = Tri3Mesh(nodes=mesh.nodes + shift * ~mesh.on_boundary[:, None], elements=mesh.elements)
    return mesh, PixelMap.from_mesh(mesh, region)


def everywhere(mesh):
    return Recovery.over(mesh, np.ones(len(mesh.elements), dtype=bool))


def linear_fit(mesh, field):
    """Best linear fit (N,) of a function of (x, y): quadrature over 28 points of every element, exact to degree 3."""
    steps = np.array([(i, j, 6 - i - j) for i in range(7) for j in range(7 - i)], dtype=float) / 6
    # least-squares weights that integrate all cubics over a triangle
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    exact = np.array(
        [2 * np.prod([1, *range(1, i + 1), *range(1, j + 1)]) / np.prod(range(1, i + j + 3)) for i, j in powers]
    )
    weights = np.linalg.lstsq(np.array([steps[:, 0] ** i * steps[:, 1] ** j for i, j in powers]), exact, rcond=None)[0]
    places = np.einsum("qa,ead->eqd", steps, mesh.nodes[mesh.elements])
    parts = np.einsum("q,eq,qa->ea", weights, field(places[..., 0], places[..., 1]), steps) * mesh.areas[:, None]
    load = np.bincount(mesh.elements.ravel(), weights=parts.ravel())
    return np.linalg.solve(mesh.mass_matrix.toarray(), load)


@pytest.mark.parametrize("kind", MESHES)
@pytest.mark.parametrize("second", [(2, 0, 0), (0, 1, 0), (0, 0, 2), (1, -2, 3)])
def test_a_quadratic_field_is_recovered_at_every_node_with_its_slopes(kind, second):
    mesh, _ = meshed(kind)
    xx, xy, yy = np.array(second) * 1e-3

    def field(x, y):
        return 1 + 0.02 * x - 0.03 * y + (xx * x * x + 2 * xy * x * y + yy * y * y) / 2

    x, y = mesh.nodes.T
    recovery, fitted = everywhere(mesh), linear_fit(mesh, field)
    scale = 1e-3 * SIZE**2
    assert np.abs(fitted - field(x, y)).max() > 0.04 * scale  # the linear fit itself is off
    assert np.abs(recovery.value @ fitted - field(x, y)).max() < 2e-3 * scale
    assert np.abs(recovery.slope_x @ fitted - (0.02 + xx * x + xy * y)).max() < 0.02 * scale / SIZE
    assert np.abs(recovery.slope_y @ fitted - (-0.03 + xy * x + yy * y)).max() < 0.02 * scale / SIZE


def wave(period, degrees, phase):
    k = 2 * np.pi / period * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    return lambda x, y: np.cos(k[0] * x + k[1] * y + phase)


@pytest.mark.parametrize("kind", MESHES)
@pytest.mark.parametrize("elements", GAIN)
def test_short_waves_have_their_height_at_the_nodes(kind, elements):
    mesh, _ = meshed(kind)
    recovery = everywhere(mesh)
    inner = ~mesh.adjacent_nodes(mesh.adjacent_nodes(mesh.on_boundary))
    found, true = [], []
    for degrees in (0, 45, 90, 120):
        for phase in (0, np.pi / 2):
            field = wave(elements * mesh.size, degrees, phase)
            found.append((recovery.value @ linear_fit(mesh, field))[inner])
            true.append(field(*mesh.nodes.T)[inner])
    found, true = np.array(found), np.array(true)
    assert GAIN[elements][0] <= (found * true).sum() / (true * true).sum() <= GAIN[elements][1]


@pytest.mark.parametrize("kind", MESHES)
def test_inner_nodes_scatter_less_than_those_of_the_linear_fit(kind):
    mesh, _ = meshed(kind)
    value, covariance = everywhere(mesh).value.toarray(), np.linalg.inv(mesh.mass_matrix.toarray())
    inner = ~mesh.adjacent_nodes(mesh.on_boundary)
    recovered = np.einsum("ij,ij->i", value @ covariance, value)[inner].mean()
    assert recovered < QUIETER**2 * np.diag(covariance)[inner].mean()


@pytest.mark.parametrize("elements", PIXEL_ERROR)
def test_between_the_nodes_a_wave_is_followed_better_than_by_linear_elements(elements):
    mesh, pixels = meshed("disc with a hole")
    field = wave(elements * mesh.size, 30, 0.4)
    nodal = everywhere(mesh).value @ linear_fit(mesh, field)
    found = at_pixels(mesh, np.stack([nodal, nodal], axis=1), pixels.shape)[0]
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]]
    inside = np.isfinite(found) & (np.hypot(x - 100, y - 100) < 75) & (np.hypot(x - 120, y - 100) > 50)
    true = field(x, y)[inside]
    assert np.sqrt(np.mean((found[inside] - true) ** 2) / np.mean(true**2)) < PIXEL_ERROR[elements]


def test_nothing_passes_over_elements_that_are_not_used():
    mesh, _ = meshed("rectangle")
    centre = mesh.nodes[mesh.elements].mean(axis=1)[:, 0]
    used = np.abs(centre - 100) > SIZE
    recovery = Recovery.over(mesh, used)
    left = mesh.nodes[:, 0] < 100 - SIZE / 2
    field = np.where(left, 0.01 * mesh.nodes[:, 1], 3.0)
    np.testing.assert_allclose((recovery.value @ field)[left], field[left], atol=1e-6)
    np.testing.assert_allclose((recovery.slope_x @ field)[left], 0, atol=1e-6)
    np.testing.assert_allclose((recovery.slope_y @ field)[left], 0.01, atol=1e-6)


def test_a_node_that_is_known_badly_hardly_counts_elsewhere():
    mesh, _ = meshed("rectangle")
    middle = int(np.argmin(np.hypot(*(mesh.nodes - 100).T)))
    information = np.where((mesh.elements == middle).any(axis=1), 1e-3, 1.0)
    recovery = Recovery.over(mesh, mesh.areas > 0, information)
    others = np.delete(recovery.value.toarray()[:, middle], middle)
    plain = np.delete(everywhere(mesh).value.toarray()[:, middle], middle)
    assert np.abs(others).max() < 0.01 * np.abs(plain).max()


def test_a_step_in_elements_that_show_little_stays_in_them():
    mesh, _ = meshed("rectangle")
    centre = mesh.nodes[mesh.elements].mean(axis=1)[:, 0]
    step = np.abs(centre - 100) <= SIZE
    recovery = Recovery.over(mesh, mesh.areas > 0, np.where(step, 0.02, 1.0))
    field = np.where(mesh.nodes[:, 0] < 100, -1.0, 1.0)
    hidden = recovery.value @ field - field
    shown = everywhere(mesh).value @ field - field
    known = ~np.isin(np.arange(len(field)), mesh.elements[step]) | (np.abs(mesh.nodes[:, 0] - 100) >= SIZE / 2)
    assert np.abs(hidden[known]).max() < 0.05 * np.abs(shown).max()


def test_nodes_are_reached_over_the_widest_way():
    mesh, _ = meshed("rectangle")
    random = np.random.default_rng(0)
    active = random.uniform(size=len(mesh.elements)) > 0.2
    information = random.uniform(0.01, 1, active.size)
    edges = dict[tuple[int, int], float]()
    for corners, value in zip(mesh.elements[active], information[active], strict=True):
        for a in map(int, corners):
            for b in map(int, corners):
                edges[a, b] = max(edges.get((a, b), 0), value) if a != b else np.inf
    area = mesh.areas * active
    nodal = mesh.to_nodes(information * area) / np.maximum(mesh.to_nodes(area), 1e-300)
    structure = _ways(mesh, active.tobytes()).structure
    factors = _relative_information(mesh, active, information)
    row = np.repeat(np.arange(len(nodal)), np.diff(structure.indptr))
    for node, neighbour, factor in [*zip(row, structure.indices, factors, strict=True)][::7]:
        beside = {b for a, b in edges if a == node}
        way = max((min(edges[node, k], edges.get((k, neighbour), 0)) for k in beside), default=np.inf)
        expected = 0.5
        if nodal[node] > 0:
            expected = nodal[neighbour] / (nodal[node] + nodal[neighbour]) * min(1, 2 * way / nodal[node]) ** 2
        assert factor == pytest.approx(expected)
