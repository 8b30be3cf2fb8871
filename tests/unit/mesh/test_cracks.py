"""Meshes split along stated cracks: what both sides share, how sound the elements are, and what is refused."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.tools.preparation.refinement import refine_elements

SHAPE = (301, 401)
SIZE = 25
LEAST_AREA = 0.2
"""Smallest element over the median one."""
MOVED = 4.0
"""How far (px) an end beside the region's edge may move onto it."""
y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
ring = np.hypot(x - 200, y - 150)
REGIONS = {
    "rectangle": Region.from_rectangle((0, 0, 400, 300), SHAPE),
    "ring": Region.from_mask((ring < 140) & (ring > 30)),
}
CRACKS = {
    "from the edge": [[(0, 150), (200, 160)]],
    "from beyond the edge": [[(-50, 140), (150, 160)]],
    "from nearly the edge": [[(3, 150), (150, 160)]],
    "between two tips": [[(110, 90), (180, 100)]],
    "as long as an element": [[(100, 100), (124, 110)]],
    "with corners": [[(20, 10), (100, 100), (200, 120), (390, 250)]],
    "digitised finely": [[(x, 150 + 30 * np.sin(x / 40)) for x in range(0, 250, 3)]],
    "oblique to the edge": [[(-10, -3), (300, 60)]],
    "through and through": [[(200, -5), (210, 310)]],
    "with a branch": [[(0, 100), (150, 100), (300, 200)], [(150, 100), (300, 40)]],
}
every_crack = pytest.mark.parametrize("crack", CRACKS)
both_regions = pytest.mark.parametrize("region", REGIONS)


def split_mesh(region, crack):
    return Tri3Mesh.from_region(REGIONS[region], SIZE, CRACKS[crack])


def bodies(mesh):
    """Number of parts of the mesh that share no node."""
    i, j = mesh.neighbours.T
    count = len(mesh.nodes)
    return connected_components(coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count)))[0]


@both_regions
@every_crack
def test_elements_are_sound_and_own_every_pixel_once(region, crack):
    mesh = split_mesh(region, crack)
    assert mesh.areas.min() > LEAST_AREA * np.median(mesh.areas)
    np.testing.assert_array_equal(np.unique(mesh.elements), np.arange(len(mesh.nodes)))
    pixels = PixelMap.from_mesh(mesh, REGIONS[region])
    owned = pixels.scatter(np.ones(pixels.rows.size, dtype=np.float32)) > 0
    assert pixels.rows.size == owned.sum()
    np.testing.assert_array_equal(owned, REGIONS[region].mask)


@both_regions
@every_crack
def test_no_element_reaches_across_the_path(region, crack):
    mesh = split_mesh(region, crack)
    middle = mesh.nodes[mesh.elements].mean(axis=1)
    for path in CRACKS[crack]:
        start, end = np.array(path[0], dtype=float), np.array(path[-1], dtype=float)
        if len(path) > 2:
            continue  # a side is told of straight paths only
        along = (end - start) / np.hypot(*(end - start))
        normal = np.array([-along[1], along[0]])
        beside = ((middle - start) @ along > SIZE) & ((middle - end) @ along < -SIZE)
        side = np.sign((middle - start) @ normal)
        height = (mesh.nodes[mesh.elements] - start) @ normal * side[:, None]
        assert beside.sum() > 0 or np.hypot(*(end - start)) < 3 * SIZE
        assert height[beside].min(initial=0) > -MOVED


@every_crack
def test_the_pieces_lie_on_the_stated_path(crack):
    dense = np.concatenate([np.linspace(a, b, 400) for path in CRACKS[crack] for a, b in pairwise(path)])
    mesh = split_mesh("rectangle", crack)
    middles = mesh.nodes[mesh.crack_edges].mean(axis=1)
    distance = np.linalg.norm(middles[:, None] - dense, axis=2).min(axis=1)
    # a fine curve has chords; an end moves to the edge, a branch to a node of the path it leaves
    assert np.median(distance) < 1.5
    assert distance.max() < 0.3 * SIZE


def test_both_sides_share_the_tip_and_nothing_else():
    mesh = split_mesh("rectangle", "from the edge")
    x = mesh.nodes[mesh.copies[:, 0], 0]
    assert 2 * len(mesh.copies) == len(mesh.crack_edges)
    assert x.min() == 0
    assert x.max() < 200
    tip = np.hypot(*(mesh.nodes - (200, 160)).T) < 0.01
    assert tip.sum() == 1
    inner = split_mesh("rectangle", "between two tips")
    assert 2 * len(inner.copies) == len(inner.crack_edges) - 2
    assert len(split_mesh("rectangle", "as long as an element").copies) == 1


def test_a_branch_makes_three_sides_of_its_root():
    mesh = split_mesh("rectangle", "with a branch")
    assert (np.unique(mesh.nodes, axis=0, return_counts=True)[1] == 3).sum() == 1


@pytest.mark.parametrize(
    ("region", "crack", "parts"),
    [
        ("rectangle", "from the edge", 1),
        ("rectangle", "through and through", 2),
        ("ring", "through and through", 2),
        ("ring", "with corners", 2),
    ],
)
def test_a_crack_from_edge_to_edge_parts_the_body(region, crack, parts):
    assert bodies(split_mesh(region, crack)) == parts


def test_the_gradient_on_either_side_of_a_jump_is_that_of_its_side():
    mesh = split_mesh("rectangle", "through and through")
    right = mesh.observation_points[:, 0] > 200 + 10 * mesh.observation_points[:, 1] / 315
    values = np.where(right[:, None], 5 + 0.01 * mesh.nodes, -0.02 * mesh.nodes)
    slopes = mesh.nodal_gradient(values)
    np.testing.assert_allclose(slopes[right], np.broadcast_to(0.01 * np.eye(2), slopes[right].shape), atol=1e-12)
    np.testing.assert_allclose(slopes[~right], np.broadcast_to(-0.02 * np.eye(2), slopes[~right].shape), atol=1e-12)


def test_without_a_crack_nodes_are_their_own_places():
    mesh = Tri3Mesh.from_region(REGIONS["ring"], SIZE)
    assert not len(mesh.copies)
    assert not len(mesh.crack_edges)
    np.testing.assert_array_equal(mesh.observation_points, mesh.nodes)


@given(ends=st.lists(st.tuples(st.integers(0, 400), st.integers(0, 300)), min_size=2, max_size=4, unique=True))
@settings(max_examples=30)
def test_any_path_gives_a_sound_mesh_or_one_clear_error(ends):
    try:
        mesh = Tri3Mesh.from_region(REGIONS["rectangle"], SIZE, [ends])
    except RegionError as error:
        message = str(error)
    else:
        message = ""
    if message:
        assert "mesh.cracks" in message
        return
    assert (mesh.areas > 0).all()
    pixels = PixelMap.from_mesh(mesh, REGIONS["rectangle"])
    assert pixels.rows.size >= 0.999 * REGIONS["rectangle"].mask.sum()  # a path along the edge leaves slivers out


@pytest.mark.parametrize(
    ("cracks", "error", "message"),
    [
        (
            [[(0, 150), (200, 150)], [(500, 10), (600, 20)]],
            RegionError,
            r"mesh.cracks\[1\] must run .*x 0 to 400, y 0 to 300",
        ),
        ([[(100, 150), (110, 150)]], RegionError, r"at least an element, 25 px; .* with 10 px in it"),
        ([[(100, 150)]], InputError, r"mesh.cracks\[0\] is at least two finite corners"),
        ([[(100, 150), (np.nan, 2)]], InputError, "finite"),
        ([[(10, 150), (390, 150)], [(200, 20), (203, 280)]], RegionError, "mesh.cracks cross"),
    ],
)
def test_a_path_that_cannot_be_meshed_is_one_clear_error(cracks, error, message):
    with pytest.raises(error, match=message):
        Tri3Mesh.from_region(REGIONS["rectangle"], SIZE, cracks)


def around(mesh, place, distance):
    return np.hypot(*(mesh.nodes[mesh.elements].mean(axis=1) - place).T) < distance


def smallest_angle(mesh):
    """In degrees."""
    corners = mesh.nodes[mesh.elements]
    first, second = (np.roll(corners, -turn, axis=1) - corners for turn in (1, 2))
    cosine = (first * second).sum(axis=2) / np.linalg.norm(first, axis=2) / np.linalg.norm(second, axis=2)
    return float(np.degrees(np.arccos(cosine.max())))


def outline(mesh):
    """Length of the edges that belong to one element; a node that hangs on an edge makes it longer."""
    start, end = mesh.nodes[mesh._boundary_edges()].swapaxes(0, 1)
    return np.hypot(*(end - start).T).sum()


@both_regions
@pytest.mark.parametrize("crack", [None, *CRACKS])
def test_bisected_elements_fit_together_and_cracks_stay_split(region, crack):
    mesh = coarse = Tri3Mesh.from_region(REGIONS[region], SIZE, CRACKS[crack] if crack else ())
    for _ in range(4):
        finer = refine_elements(mesh, around(mesh, (150, 110), 40), 5)
        np.testing.assert_array_equal(finer.nodes[: len(mesh.nodes)], mesh.nodes)
        mesh = finer
    assert len(mesh.elements) > len(coarse.elements) + 40
    assert np.isclose(mesh.areas.sum(), coarse.areas.sum(), rtol=1e-12)
    assert np.isclose(outline(mesh), outline(coarse), rtol=1e-12)
    first, second = mesh.nodes[mesh.elements][:, 1:].swapaxes(0, 1) - mesh.nodes[mesh.elements][:, 0]
    assert (first[:, 0] * second[:, 1] > first[:, 1] * second[:, 0]).all()
    assert smallest_angle(mesh) > 0.5 * smallest_angle(coarse)
    assert bodies(mesh) == bodies(coarse)
    far = ~around(mesh, (150, 110), 150)
    assert np.isin(np.round(mesh.areas[far], 6), np.round(coarse.areas, 6)).all()
    ends = (one.nodes[one.crack_edges].swapaxes(0, 1) for one in (mesh, coarse))
    lengths = [np.hypot(*(end - start).T).sum() for start, end in ends]
    assert np.isclose(*lengths, rtol=1e-12)


def test_no_part_is_shorter_than_the_least_leg():
    mesh = Tri3Mesh.from_region(REGIONS["ring"], SIZE)
    small = np.sqrt(2 * mesh.areas).min()
    for least in (9, 14):
        finer = mesh
        for _ in range(5):
            finer = refine_elements(finer, np.ones(len(finer.elements), dtype=bool), least)
        assert min(least, small) <= np.sqrt(2 * finer.areas).min() < 1.5 * least
        assert refine_elements(finer, np.ones(len(finer.elements), dtype=bool), 2 * least) is finer
    assert refine_elements(mesh, np.zeros(len(mesh.elements), dtype=bool), 4) is mesh
