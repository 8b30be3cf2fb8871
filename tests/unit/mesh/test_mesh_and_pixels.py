"""TRI3 meshes and pixel maps: orientation, coverage, one owner per pixel, shape functions, and what is refused."""

from __future__ import annotations

import logging
import pickle
import re
from weakref import ref

import naive_mesh
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rgbmidic.errors import InputError, RegionError
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh

SHAPE = (97, 121)


def disc_with_hole(shape=SHAPE):
    y, x = np.mgrid[: shape[0], : shape[1]]
    radius = np.hypot(x - 55, y - 48)
    return Region.from_mask((radius < 40) & (radius > 14))


def two_islands(shape=SHAPE):
    mask = np.zeros(shape, dtype=bool)
    mask[10:60, 5:50] = mask[30:90, 70:115] = True
    return Region.from_mask(mask)


REGIONS = {
    "rectangle": Region.from_rectangle((3, 5, 110, 90), SHAPE),
    "rectangle between pixels": Region.from_rectangle((3.3, 5.7, 110.1, 90.2), SHAPE),
    "whole image": Region.from_rectangle((0, 0, 120, 96), SHAPE),
    "polygon": Region.from_polygon([(10, 5), (115, 20), (90, 90), (20, 80), (40, 45)], SHAPE),
    "mask with a hole": disc_with_hole(),
    "two islands": two_islands(),
}


@pytest.mark.parametrize(
    ("rectangle", "size", "message"),
    [
        ((3, 5, 110, 90), 25.0, ""),
        ((3, 5, 27, 90), 25.0, ""),
        ((3, 5, 20, 90), 25.0, "the elements of 25 px are larger than the region, which is 1[78] px across"),
        ((3, 5, 10, 90), 8.0, "the region is [78] px across: two or three speckles"),
    ],
)
def test_a_region_too_small_to_trust_is_told_in_one_line(caplog, rectangle, size, message):
    with caplog.at_level(logging.WARNING, logger="rgbmidic.mesh"):
        Tri3Mesh.from_region(Region.from_rectangle(rectangle, SHAPE), size)
    assert len(caplog.messages) == bool(message)
    assert re.search(message, caplog.text)


@pytest.mark.parametrize("size", [6.5, 13, 25])
@pytest.mark.parametrize("name", REGIONS)
def test_elements_are_positive_and_every_node_is_used(name, size):
    mesh = Tri3Mesh.from_region(REGIONS[name], size)
    assert (mesh.areas > 0).all()
    np.testing.assert_array_equal(np.unique(mesh.elements), np.arange(len(mesh.nodes)))
    assert len(np.unique(mesh.nodes, axis=0)) == len(mesh.nodes)


@pytest.mark.parametrize("size", [6.5, 13, 25])
@pytest.mark.parametrize("name", REGIONS)
def test_every_pixel_of_the_region_has_exactly_one_owner_that_contains_it_or_is_beside_it(name, size):
    region = REGIONS[name]
    mesh = Tri3Mesh.from_region(region, size)
    pixels = PixelMap.from_mesh(mesh, region)
    assert len({*zip(pixels.rows.tolist(), pixels.columns.tolist(), strict=True)}) == pixels.rows.size
    owned = pixels.scatter(np.ones(pixels.rows.size, dtype=np.float32)) > 0
    np.testing.assert_array_equal(owned, region.mask)
    distance = outside(mesh, pixels)
    # the chords of a curved outline leave some pixels of its rim to an element that ends beside them
    assert distance.max() <= (1e-3 if region.rectangle is not None else RIM)
    assert (distance > 1e-3).mean() < 0.03


RIM = 4.0
"""px: farthest distance of a pixel from its owner's sides."""


def shape_functions(pixels):
    """Shape functions (P, 3) of the owner at every owned pixel."""
    e = np.repeat(np.arange(len(pixels.offsets) - 1), np.diff(pixels.offsets))
    position = np.stack([np.ones(e.size), pixels.local_x, pixels.local_y])
    return np.einsum("pac,cp->pa", pixels.barycentric[e], position.astype(np.float64))


def outside(mesh, pixels):
    """How far (px) every owned pixel lies beyond a side of its owner, shape (P,); 0 inside."""
    corners = mesh.nodes[mesh.elements]
    side = np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1), axis=2)
    height = np.repeat(2 * mesh.areas[:, None] / side, np.diff(pixels.offsets), axis=0)
    return np.maximum(-shape_functions(pixels) * height, 0).max(axis=1)


@pytest.mark.parametrize("name", ["polygon", "mask with a hole", "two islands"])
def test_a_mesh_of_any_outline_has_the_area_of_the_region(name):
    mesh = Tri3Mesh.from_region(REGIONS[name], 13)
    assert mesh.areas.sum() == pytest.approx(REGIONS[name].mask.sum(), rel=0.08)


def test_a_hole_and_the_gap_between_islands_are_not_meshed():
    assert not covered_by(Tri3Mesh.from_region(REGIONS["mask with a hole"], 13), (55, 48))
    assert not covered_by(Tri3Mesh.from_region(REGIONS["two islands"], 13), (60, 45))


def covered_by(mesh, point):
    return any(naive_mesh.contains(mesh.nodes[element], *point) for element in mesh.elements)


@given(
    width=st.integers(9, 40),
    height=st.integers(9, 40),
    left=st.floats(0, 3),
    top=st.floats(0, 3),
    size=st.floats(4, 30),
)
@settings(max_examples=40)
def test_any_rectangle_is_covered_once(width, height, left, top, size):
    shape = (height + 5, width + 5)
    region = Region.from_rectangle((left, top, left + width, top + height), shape)
    mesh = Tri3Mesh.from_region(region, size)
    pixels = PixelMap.from_mesh(mesh, region)
    assert mesh.areas.sum() == pytest.approx(np.prod(np.diff(np.reshape(region.rectangle, (2, 2)), axis=0)))
    assert pixels.rows.size == region.mask.sum()
    assert pixels.offsets[-1] == pixels.rows.size


@given(seed=st.integers(0, 2**32 - 1), outlined=st.booleans())
@settings(max_examples=15)
def test_owners_equal_the_naive_twin(seed, outlined):
    random = np.random.default_rng(seed)
    shape = (int(random.integers(18, 30)), int(random.integers(18, 30)))
    if outlined:
        corners = random.uniform(0, 1, (5, 2)) * (shape[1] - 1, shape[0] - 1)
        region = Region.from_polygon(corners, shape)
    else:
        region = Region.from_rectangle((*random.uniform(0, 4, 2), shape[1] - 2.5, shape[0] - 3), shape)
    try:
        mesh = Tri3Mesh.from_region(region, float(random.uniform(6, 12)))
    except RegionError:
        return  # a sliver of a polygon
    expected = naive_mesh.owners(mesh.nodes, mesh.elements, region.mask)
    if not (expected >= 0).any():
        return
    pixels = PixelMap.from_mesh(mesh, region)
    found = np.where(region.mask, -1, -2)
    found[pixels.rows, pixels.columns] = np.repeat(np.arange(len(mesh.elements)), np.diff(pixels.offsets))
    contained = expected >= 0
    distance = np.zeros(shape)
    distance[pixels.rows, pixels.columns] = outside(mesh, pixels)
    # a pixel on a shared side may go to either neighbour: the kernel allows for rounding
    assert distance[contained & (found != expected)].max(initial=0) < 1e-4
    assert (found[contained] >= 0).all()
    assert (distance[expected == -1] <= RIM).all()


def test_shape_functions_are_one_at_their_corner_and_sum_to_one():
    mesh = Tri3Mesh.from_region(REGIONS["polygon"], 13)
    pixels = PixelMap.from_mesh(mesh, REGIONS["polygon"])
    corners = mesh.nodes[mesh.elements] - pixels.origin[:, None]
    position = np.concatenate([np.ones((len(corners), 3, 1)), corners], axis=2)
    np.testing.assert_allclose(
        np.einsum("eac,ebc->eba", pixels.barycentric, position),
        np.broadcast_to(np.eye(3), (len(corners), 3, 3)),
        atol=1e-9,
    )
    np.testing.assert_allclose(shape_functions(pixels).sum(axis=1), 1, atol=1e-6)


def test_gather_and_scatter_are_inverse_on_the_region():
    region = REGIONS["whole image"]
    pixels = PixelMap.from_mesh(Tri3Mesh.from_region(region, 25), region)
    image = np.random.default_rng(0).normal(size=SHAPE).astype(np.float32)
    np.testing.assert_array_equal(pixels.scatter(pixels.gather(image)), image)
    np.testing.assert_array_equal(pixels.gather(np.stack([image, 2 * image]))[1], 2 * pixels.gather(image))


def test_the_size_of_the_elements_is_about_what_is_asked_for():
    mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 500, 250), (251, 501)), 25)
    assert mesh.areas == pytest.approx(25 * 25 / 2)
    outlined = Tri3Mesh.from_region(REGIONS["mask with a hole"], 13)
    assert np.median(np.sqrt(2 * outlined.areas)) == pytest.approx(13, rel=0.3)


@pytest.mark.parametrize("copied", [False, True])
def test_a_mesh_under_which_things_are_kept_cannot_be_written_to(copied):
    given = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 9.0]])
    mesh = Tri3Mesh(nodes=given, elements=np.array([[0, 1, 2]]))
    mesh = pickle.loads(pickle.dumps(mesh)) if copied else mesh
    for name in ("nodes", "elements", "areas"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(mesh, name)[0] = 1
    given[0] = 5  # the caller's own array stays writable, and is another one
    assert mesh.nodes[0].tolist() == [0, 0]


def test_neighbours_and_sums_at_the_nodes():
    mesh = Tri3Mesh(nodes=[(0, 0), (10, 0), (10, 10), (0, 10)], elements=[(0, 1, 2), (0, 2, 3)])
    np.testing.assert_array_equal(mesh.neighbours, [(0, 1), (0, 2), (0, 3), (1, 2), (2, 3)])
    np.testing.assert_allclose(mesh.to_nodes(np.array([1.0, 10.0])), [11, 1, 11, 10])


def test_the_gradient_at_the_nodes_of_a_linear_field_is_exact_and_of_a_quadratic_one_inside():
    mesh = Tri3Mesh.from_region(REGIONS["rectangle"], 13)
    x, y = mesh.nodes.T
    linear = mesh.nodal_gradient(np.stack([2 * x - 3 * y, 0.5 * y + 7], axis=1))
    np.testing.assert_allclose(linear, np.broadcast_to([[2, -3], [0, 0.5]], linear.shape), atol=1e-9)
    inner = ~mesh.on_boundary
    quadratic = mesh.nodal_gradient(np.stack([x * x, x * y], axis=1))[inner]
    np.testing.assert_allclose(quadratic[:, 0], np.stack([2 * x, 0 * x], axis=1)[inner], atol=1e-8)
    np.testing.assert_allclose(quadratic[:, 1], np.stack([y, x], axis=1)[inner], atol=1e-8)


def test_boundary_nodes_are_those_on_the_outline():
    mesh = Tri3Mesh.from_region(REGIONS["rectangle"], 13)
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    np.testing.assert_array_equal(mesh.on_boundary, ((mesh.nodes == low) | (mesh.nodes == high)).any(axis=1))


def test_clockwise_elements_are_turned_and_impossible_meshes_refused():
    mesh = Tri3Mesh(nodes=[(0, 0), (10, 0), (10, 10)], elements=[(0, 2, 1)])
    np.testing.assert_array_equal(mesh.elements, [(0, 1, 2)])
    for nodes, elements, message in [
        ([(0, 0), (1, 1), (2, 2)], [(0, 1, 2)], "no area"),
        ([(0, 0), (1, 0), (2, 2)], [(0, 1, 3)], "name existing nodes"),
        ([(0, 0), (1, 0), (np.nan, 2)], [(0, 1, 2)], "finite"),
        ([(0, 0, 0), (1, 0, 0), (2, 2, 0)], [(0, 1, 2)], r"nodes \(N, 2\)"),
        ([(0, 0), (1, 0), (2, 2)], np.empty((0, 3)), r"elements \(E, 3\)"),
    ]:
        with pytest.raises(InputError, match=message):
            Tri3Mesh(nodes=nodes, elements=elements)


def test_too_small_regions_and_elements_are_refused():
    with pytest.raises(InputError, match="at least 4 px"):
        Tri3Mesh.from_region(REGIONS["rectangle"], 3.9)
    with pytest.raises(InputError, match="at least 4 px"):
        Tri3Mesh.from_region(REGIONS["rectangle"], float("nan"))
    with pytest.raises(RegionError, match="too small"):
        Tri3Mesh.from_region(Region.from_rectangle((10, 10, 13, 60), SHAPE), 25)
    line = np.zeros(SHAPE, dtype=bool)
    line[20, 10:60] = True
    with pytest.raises(RegionError, match="too small"):
        Tri3Mesh.from_region(Region.from_mask(line), 25)


def test_what_is_derived_from_a_mesh_is_kept_with_it_and_freed_with_it():
    mesh, calls = Tri3Mesh.from_region(Region.from_rectangle((2, 2, 40, 40), (50, 50)), 12), []

    def areas(of: Tri3Mesh, active: bytes) -> np.ndarray:
        calls.append(active)
        return of.areas * np.frombuffer(active, dtype=bool)

    every, other = (np.arange(len(mesh.elements)) >= first for first in (0, 1))
    halved = Tri3Mesh(nodes=mesh.nodes, elements=mesh.elements)
    for one in (mesh, halved, mesh):  # neither mesh nor mask drives out the other
        for active in (every, other, every):
            np.testing.assert_array_equal(one.derive(areas, active.tobytes()), mesh.areas * active)
    assert len(calls) == 4
    result = ref(halved.derive(areas, every.tobytes()))
    del halved, one
    assert result() is None  # at once: no cycle waits for the collection of garbage
