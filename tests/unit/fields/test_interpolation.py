"""The field between the nodes: quadratics and waves, slopes, missing nodes, and that all who read it read the same."""

from __future__ import annotations

import numpy as np
import pytest
from nodal_tests import COVARIANCE, MESH, dense_correlation

from rgbmidic.fields import Displacement, Field, MeshPoints, ProfileLine, StrainGauges, at_pixels, make_probe
from rgbmidic.fields.interpolation import PointSum
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import at_free_boundary, quadratic_fit
from rgbmidic.typing import FloatArray

ROUND = Tri3Mesh.from_region(Region.from_polygon([(10, 60), (60, 5), (115, 50), (70, 110)], (120, 120)), 11)
GRADED = Tri3Mesh(nodes=np.sign(ROUND.nodes - 60) * np.abs(ROUND.nodes - 60) ** 1.8 / 30, elements=ROUND.elements)
MESHES = {"regular": MESH, "outlined": ROUND, "graded": GRADED}
RANDOM = np.random.default_rng(0)
POINTS = RANDOM.uniform(*MESH.nodes[[0, -1]], (40, 2))
ALL = np.ones(len(MESH.nodes), dtype=bool)


def quadratic(points: FloatArray) -> FloatArray:
    x, y = (points - points.mean(axis=0)).T / 100
    return np.stack([1 + x - 2 * y + x * x - 3 * x * y, 3 - y + 2 * y * y + x * y], axis=1)


def naive(mesh: Tri3Mesh, values: FloatArray, point: FloatArray, has_data: np.ndarray) -> float:
    """The definition, corner by corner and node by node."""
    fits = [one.toarray() for one in quadratic_fit(mesh, has_data[mesh.elements].all(axis=1))]
    places, total = MeshPoints.of(mesh, point), 0.0
    edge = at_free_boundary(mesh, has_data[mesh.elements].all(axis=1))
    for node, shape in zip(mesh.elements[places.element[0]], places.barycentric[0], strict=True):
        slope, areas = np.zeros(2), 0.0
        for element, area in zip(mesh.elements, mesh.areas, strict=True):
            if node not in element or not has_data[element].all():
                continue
            for other in set(element.tolist()) - {int(node)}:
                x, y = mesh.nodes[node] - mesh.nodes[other]
                sx, sy, xx, xy, yy = (np.nan_to_num(values) @ one[other] for one in fits[1:])
                slope += area * np.array([sx + xx * x + xy * y, sy + xy * x + yy * y])
                areas += area
        slope /= max(areas, 1e-9)
        if edge[node]:
            slope = (slope + [np.nan_to_num(values) @ one[node] for one in fits[1:3]]) / 2
        total += shape * (values[node] + slope @ (point - mesh.nodes[node]) / 2)
    return float(total)


@pytest.mark.parametrize("kind", MESHES)
def test_a_quadratic_field_is_read_exactly_at_every_point_of_any_mesh(kind: str) -> None:
    mesh = MESHES[kind]
    points = np.concatenate([mesh.centres, mesh.nodes[mesh.neighbours].mean(axis=1), mesh.nodes])
    exact = quadratic(np.concatenate([mesh.nodes, points]))
    read = MeshPoints.of(mesh, points).read(exact[: len(mesh.nodes)])
    np.testing.assert_allclose(read, exact[len(mesh.nodes) :], atol=2e-5)


def test_it_is_the_definition_also_beside_missing_nodes() -> None:
    values, has_data = RANDOM.normal(size=len(MESH.nodes)), RANDOM.random(len(MESH.nodes)) > 0.1
    values[~has_data] = np.nan
    read, places = MeshPoints.of(MESH, POINTS).read(values), MeshPoints.of(MESH, POINTS)
    np.testing.assert_array_equal(np.isfinite(read), has_data[MESH.elements[places.element]].all(axis=1))
    assert 10 < np.isfinite(read).sum() < len(read)
    for point, one in zip(POINTS[np.isfinite(read)][:8], read[np.isfinite(read)], strict=False):
        assert one == pytest.approx(naive(MESH, values, point, has_data), abs=1e-9)


def test_it_is_continuous_across_edges() -> None:
    values = RANDOM.normal(size=(len(MESH.nodes), 2))
    ends = MESH.nodes[MESH.neighbours]
    across = (ends[:, 1] - ends[:, 0])[:, ::-1] * [1, -1] * 1e-7
    middle = 0.3 * ends[:, 0] + 0.7 * ends[:, 1]
    sides = [MeshPoints.of(MESH, middle + turn * across).read(values) for turn in (1, -1)]
    both = np.isfinite(sides[0] + sides[1]).all(axis=1)
    np.testing.assert_allclose(sides[0][both], sides[1][both], atol=1e-5)
    assert both.mean() > 0.7


def test_point_pixel_profile_sum_and_weights_are_one_field() -> None:
    values = RANDOM.normal(size=(len(MESH.nodes), 2))
    places = MeshPoints.of(MESH, np.round(POINTS))
    read = places.read(values)
    np.testing.assert_allclose(places.weights(ALL) @ values, read, atol=1e-12)
    pixels = at_pixels(MESH, values, (200, 240))
    columns, rows = np.round(POINTS).astype(int).T
    np.testing.assert_allclose(pixels[:, rows, columns].T, read, atol=1e-5)
    line = ProfileLine(COVARIANCE, StrainGauges.at_nodes(COVARIANCE), 33, 40, 190, 120)
    read = line.read(Field(name="u", dims=("node",), values=values[:, 0], std=np.full(len(values), 0.01)))
    along, spread = read.values, read.uncertainty
    np.testing.assert_allclose(along, MeshPoints.of(MESH, line.points).read(values[:, 0]), atol=1e-12)
    probe = make_probe(COVARIANCE, "point", 1, line.points[5])
    u, v = values[None, probe.nodes].transpose(2, 0, 1)
    point = probe.histories(Displacement.in_plane(u, v, np.full(u.shape, 0.01), np.full(u.shape, 0.01)))[0]
    assert point.values[0] == pytest.approx(along[5], abs=1e-12)
    assert point.std is not None
    assert point.std[0] == pytest.approx(spread[5], rel=1e-6)


def test_the_sum_over_points_has_the_slopes_of_the_field() -> None:
    values, area = RANDOM.normal(size=len(MESH.nodes)), RANDOM.uniform((40, 40), (150, 120), (300, 2))
    total = PointSum.over(MeshPoints.of(MESH, area), np.full(300, 1 / 300), slopes=True)
    weights, measured = total.weights(np.ones(len(total.nodes), dtype=bool))
    step = 1e-4
    read = [
        MeshPoints.of(MESH, area + shift).read(values) for shift in step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    ]
    slopes = (read[0] - read[1]).mean() / (2 * step), (read[2] - read[3]).mean() / (2 * step)
    assert measured == pytest.approx(1)
    expected = [MeshPoints.of(MESH, area).read(values).mean(), *slopes]
    np.testing.assert_allclose(weights @ values[total.nodes], expected, atol=1e-5)


def test_a_point_on_a_node_or_an_edge_needs_no_other_node() -> None:
    i, j = MESH.neighbours[len(MESH.neighbours) // 2]
    has_data = ALL.copy()
    has_data[MESH.elements[(MESH.elements == i).any(axis=1)]] = False
    has_data[[i, j]] = True
    places = MeshPoints.of(
        MESH, np.stack([MESH.nodes[i], MESH.nodes[[i, j]].mean(axis=0), MESH.nodes[[i, j]].mean(axis=0) + 1])
    )
    assert places.measured(has_data).tolist() == [True, True, False]


def test_between_nodes_the_stated_uncertainty_is_that_of_noise() -> None:
    weights = MeshPoints.of(MESH, POINTS).weights(ALL).toarray()
    one = np.ones(len(MESH.nodes))
    stated = np.sqrt(COVARIANCE.variance(weights, Field(name="u", values=one, std=one)))
    np.testing.assert_allclose(stated, np.sqrt(np.diag(weights @ dense_correlation(MESH) @ weights.T)), rtol=0.02)
    assert 0.5 < stated.min() < stated.max() < 1.1


def test_parts_of_the_elements_cover_them() -> None:
    places, parts = MeshPoints.subdivide(ROUND, 4)
    fine = Tri3Mesh(nodes=places.points, elements=parts)
    assert places.inside.all()
    assert len(parts) == 16 * len(ROUND.elements)
    np.testing.assert_allclose(fine.areas.sum(), ROUND.areas.sum())
    np.testing.assert_allclose(fine.areas.max(), ROUND.areas.max() / 16)


def test_a_part_of_a_mesh_has_the_sizes_of_the_whole() -> None:
    near = np.hypot(*GRADED.nodes.T) < 60
    part = GRADED.submesh(near)
    np.testing.assert_array_equal(part.sizes, GRADED.sizes[near])
    assert (part.size, part.is_graded) == (GRADED.size, True)
    np.testing.assert_allclose(part.areas.sum(), GRADED.areas[near[GRADED.elements].all(axis=1)].sum())
