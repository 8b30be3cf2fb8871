"""The stated uncertainty of nodes: at any element size, beside holes, and away from a crack."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from textures import Affine, Texture

from rgbmidic import Region, Tri3Mesh, correlate
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.constants import USUAL
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh.recovery import Recovery, functional_std

NOISE = 3.0
"""Standard deviation of the noise, 6 % of the texture's contrast."""


def noisy(image, seed):
    return image + np.random.default_rng(seed).normal(0, NOISE, image.shape)


@pytest.mark.parametrize("prefilter", ["none", "binomial"])
@pytest.mark.parametrize("size", [6, 13, 20])
def test_the_unfitted_share_is_that_of_the_projection(size, prefilter):
    shape = (60, 60)
    region = Region.from_rectangle((4, 4, 55, 55), shape)
    mesh = Tri3Mesh.from_region(region, size)
    image = Texture.random(1).image(shape)[None].astype(np.float32)
    reference = Reference.prepare(image, region, mesh=mesh, prefilter=prefilter)
    pixels, slopes = reference.pixels, (reference.gradient[0][0], reference.gradient[1][0])
    columns = np.zeros((pixels.rows.size, len(mesh.nodes), 2))
    for element, corners in enumerate(mesh.elements):
        own = slice(pixels.offsets[element], pixels.offsets[element + 1])
        for node, (constant, in_x, in_y) in zip(corners, pixels.barycentric[element], strict=True):
            values = constant + in_x * pixels.local_x[own] + in_y * pixels.local_y[own]
            columns[own, node] = values[:, None] * np.stack([slope[own] for slope in slopes], axis=1)
    (top, left, _, _), grid = pixels.bounds, pixels.grid(USUAL.score_block_side)
    index = (pixels.rows - top) // USUAL.score_block_side * grid[1] + (pixels.columns - left) // USUAL.score_block_side
    used = reference.pixel_weights[0] > 0
    inside = (index[:, None] == np.arange(grid[0] * grid[1])) & used[:, None]
    scores = np.concatenate([slope[:, None] * inside for slope in slopes], axis=1).astype(float)
    system = columns.reshape(len(columns), -1) * used[:, None]
    unfitted = scores - system @ np.linalg.lstsq(system, scores, rcond=1e-6)[0]
    inner = np.repeat(~mesh.on_boundary, 2)
    moved = system @ np.linalg.pinv(system.T @ system, rcond=1e-9)[:, inner]

    def passed(columns):
        images = (pixels.scatter(column) for column in columns.T.astype(np.float32))
        return sum((apply_prefilter(image, prefilter) ** 2).sum() for image in images) / (columns**2).sum()

    half = unfitted.shape[1] // 2
    axes = zip((unfitted[:, :half], unfitted[:, half:]), (moved[:, ::2], moved[:, 1::2]), strict=True)
    ratio = np.sqrt(np.prod([passed(residual) / passed(motion) for residual, motion in axes]))
    left = (unfitted**2).sum() / (scores**2).sum() * ratio
    assert reference.residual_leverage == pytest.approx(left, rel=0.1)


@pytest.mark.parametrize("shape", ["rectangle", "disc with a hole"])
def test_nodes_of_one_colour_are_five_edges_apart_and_each_knows_the_nearest(shape):
    y, x = np.mgrid[:200, :260]
    radius = np.hypot(x - 130, y - 100)
    region = Region.from_mask((radius < 95) & (radius > 30))
    if shape == "rectangle":
        region = Region.from_rectangle((5, 5, 250, 190), x.shape)
    mesh = Tri3Mesh.from_region(region, 13)
    (colours, nearest_of), (i, j), count = mesh.colouring, mesh.neighbours.T, len(mesh.nodes)
    edges = dijkstra(coo_matrix((np.ones(i.size), (i, j)), shape=(count, count)), directed=False, unweighted=True)
    same = colours[:, None] == colours
    assert (edges[same] == np.where(np.eye(count)[same] > 0, 0, np.maximum(edges[same], 5))).all()
    # greedy: each node sees all colours before its own
    for node in range(count):
        around = colours[(edges[node] < 5) & (np.arange(count) < node)]
        assert colours[node] == np.flatnonzero(~np.isin(np.arange(count + 1), around))[0]
    distance = np.hypot(*(mesh.nodes[:, None] - mesh.nodes).T)
    for colour, nearest in enumerate(nearest_of):
        within = np.where((edges < 5) & (colours == colour), distance, np.inf).min(axis=1)
        assert ((nearest == count) == np.isinf(within)).all()
        known = np.flatnonzero(nearest < count)
        assert (colours[nearest[known]] == colour).all()
        np.testing.assert_allclose(distance[known, nearest[known]], within[known], rtol=1e-12)


@pytest.mark.parametrize("size", [5, 8, 12, 20, 32])
def test_elements_of_any_size_state_their_error(size):
    side = 160 if size > 8 else 110  # 480 nodes of 5 px and more, three times
    image, ratios = Texture.random(2, speckle=3).image((side, side)), []
    for seed in range(3):
        found = correlate(noisy(image, seed), noisy(image, 100 + seed), element_size=size, initial=(0, 0))
        ratios.append((found.displacement / found.displacement_std)[found.measured].ravel())
    assert 0.85 < np.sqrt(np.mean(np.concatenate(ratios) ** 2)) < 1.25


@pytest.mark.parametrize(("wave", "apart", "mesh_error"), [(0, 0, True), (0.5, 0, False), (0, 0.1, False)])
def test_the_uncertainty_turns_with_the_surface(wave, apart, mesh_error, monkeypatch):
    # what the recovery misses near edges turns as slopes do, not as noise
    monkeypatch.setattr("rgbmidic.pipeline.sequence.with_one_sided_error", lambda _, found: found)
    random, (y, x), options = np.random.default_rng(0), np.mgrid[:121, :121].astype(float), {"element_size": 16}
    streaks = np.stack([gaussian_filter(random.normal(size=x.shape), (1.5, 4.0)) for _ in range(2)])
    streaks = 300 + 40 / streaks.std() * streaks
    # what elements cannot follow, and two lights that disagree, along the streaks
    moved = ((y, x - wave * np.sin(y / 9) + shift) for shift in (apart, -apart))
    deformed = [map_coordinates(light, at, order=5, mode="mirror") for light, at in zip(streaks, moved, strict=True)]
    first, second = (stack + random.normal(0, 1, streaks.shape) for stack in (streaks, np.stack(deformed)))
    options |= {"region": (15, 15, 105, 105), "mesh_error": mesh_error}
    rest = correlate(first, second, initial=(0, 0), **options)
    x, y = rest.nodes.T
    turned = correlate(first, np.rot90(second, -1, axes=(1, 2)), initial=np.c_[120 - y - x, x - y], **options)
    least = 6e-4 * np.array([0, 1, 0])  # px: the bias of lights that agree is 0 or by chance
    for name, order, atol in zip(
        ("displacement_std", "bias_std", "strain_std"), ([1, 0], [1, 0], [1, 0, 2]), least, strict=True
    ):
        expected, stated = (np.nanmedian(getattr(one, name), axis=0) for one in (rest, turned))
        assert np.isfinite(expected).all()
        np.testing.assert_allclose(stated[order], expected, rtol=0.3, atol=atol, err_msg=name)


def test_the_smallest_element_beside_a_hole_is_told_by_the_common_way(monkeypatch):
    columns = []

    def counted(solve, covariance, mesh, asked):
        columns.append(len(asked) * len(mesh.colouring[1]))
        return functional_std(solve, covariance, mesh, asked)

    monkeypatch.setattr("rgbmidic.correlation.uncertainty.functional_std", counted)
    image = Texture.random(4, speckle=3).image((96, 96))
    first = noisy(image, 0)
    first[30:60, 35:60] = np.nan
    found = correlate(first, noisy(image, 1), element_size=4, initial=(0, 0))
    assert 0.6 < found.measured.mean() < 1
    # triangular solves do not grow with the rim of a hole: a fixed number of colours a pass
    assert max(columns) <= 5 * 30


def test_strain_beside_a_hole_has_the_uncertainty_of_its_own_column():
    shape = (150, 150)
    image = Texture.random(6).image(shape)
    first, weights = noisy(image, 0)[None].astype(np.float32), np.ones((1, *shape), dtype=np.float32)
    weights[0, 60:90, 55:95] = 0
    region = Region.from_rectangle((5, 5, 144, 144), shape)
    mesh = Tri3Mesh.from_region(region, 12)
    reference = Reference.prepare(first, region, weights, mesh=mesh, prefilter="binomial")
    deformed = Deformed.prepare(noisy(image, 1)[None].astype(np.float32), weights, prefilter="binomial")
    rest = np.zeros_like(mesh.nodes)
    pulled = Residual.at(reference, deformed, [rest]).weights
    equations = Equations.build(reference, pulled, np.zeros((2 * len(mesh.nodes), 0)), np.zeros_like(mesh.nodes))
    inner = equations.textured & ~mesh.adjacent_nodes(~equations.textured)
    assert 0 < inner.sum() < equations.textured.sum() < len(mesh.nodes)
    used = equations.textured[mesh.elements].all(axis=1)
    recovery = Recovery.over(mesh, used, equations.information())
    strain, hessian = recovery.strain_functionals, reference.assembly.matrix(equations.blocks)
    probed = functional_std(equations.solve, hessian, reference.material, [(one, inner) for one in strain])
    for number, functional in enumerate(strain):
        whole = np.zeros((len(mesh.nodes), len(mesh.nodes), 2))
        for axis, matrix in enumerate(functional):
            whole[..., axis] += 0 if matrix is None else matrix.toarray()
        column = equations.solve(whole.reshape(len(mesh.nodes), -1)[inner].T)
        exact = np.sqrt((column * (hessian @ column)).sum(axis=0))
        assert np.median(probed[inner, number] / exact) == pytest.approx(1, abs=0.05)
        assert (probed[inner, number] / exact).min() > 0.7
        assert (probed[inner, number] / exact).max() < 1.4


def test_a_crack_leaves_intact_material_as_certain_as_before():
    shape, middle, jump = (300, 300), 150, 6.0
    texture = Texture.random(8)
    halves = [texture.image(shape, Affine(shift=(0.3, v))) for v in (jump, -jump)]
    cracked = np.where(np.arange(shape[1]) < middle, *halves)
    first = noisy(texture.image(shape), 0)
    whole = correlate(first, noisy(halves[0], 1))
    found = correlate(first, noisy(cracked, 1))
    apart = np.abs(found.nodes[:, 0] - middle)
    true = np.stack([np.full(len(apart), 0.3), np.where(found.nodes[:, 0] < middle, jump, -jump)], axis=1)
    place = found.nodes + true
    stays = ((place >= 0) & (place <= 299)).all(axis=1)
    intact = (apart > 60) & found.measured
    np.testing.assert_array_equal(intact, (apart > 60) & stays)
    ratio = (found.displacement - true) / found.displacement_std
    # at the crack nodes are lost, or hold to the side that they lie on
    assert (np.abs(ratio)[(apart < 13) & found.measured] < 4.5).all()
    ratio = ratio[intact]
    assert 0.7 < np.sqrt(np.mean(ratio**2)) < 1.3
    assert np.median(found.displacement_std[intact]) < 1.3 * np.nanmedian(whole.displacement_std)


def test_stretched_edges_state_their_error():
    shape, stretch = (300, 300), 0.15
    texture = Texture.random(9)
    motion = Affine(gradient=((1 + stretch, 0.0), (0.0, 1.0)))
    found = correlate(noisy(texture.image(shape), 0), noisy(texture.image(shape, motion), 1), region=(40, 40, 259, 259))
    error = found.displacement - motion.displacement(found.nodes, shape)
    edge = np.isin(found.nodes[:, 0], (40.0, 259.0))
    assert found.measured.all()
    assert (np.abs(error) < 4.5 * found.displacement_std)[edge].all()
