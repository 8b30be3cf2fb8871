"""Frame after frame: a jump, a specimen that leaves and comes back, and what is said when nothing is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic import Region, Status, Tri3Mesh
from rgbmidic.correlation import Deformed, NodeStatus, Reference, TrackingState, solve, track
from rgbmidic.correlation.reference import torn_elements
from rgbmidic.correlation.solution import rank
from rgbmidic.settings import SolverSettings
from rgbmidic.weights import Statistics

SHAPE = (200, 320)
OPTIONS = SolverSettings()


@pytest.fixture(scope="module")
def texture():
    return Texture.random(3)


@pytest.fixture(scope="module")
def reference(texture):
    image = np.asarray(texture.image(SHAPE), dtype=np.float32)[None]
    region = Region.from_rectangle((20, 20, 120, 180), SHAPE)
    return Reference.prepare(image, region, mesh=Tri3Mesh.from_region(region, 25), prefilter="binomial")


def moved(texture, motion):
    return Deformed.prepare(np.asarray(texture.image(SHAPE, motion), dtype=np.float32)[None], prefilter="binomial")


def test_a_jump_of_100_px_is_found(texture, reference):
    last = TrackingState(displacement=np.full((len(reference.mesh.nodes), 2), (60.0, 0.0)))
    found = track(reference, moved(texture, Affine(shift=(160.0, 0.0))), last, OPTIONS, Statistics())
    assert found.status is Status.CONVERGED
    assert np.abs(found.displacement - (160.0, 0.0)).max() < 1.6e-6


@pytest.mark.parametrize(
    "motion",
    [
        Affine(shift=(6.0, -5.0)),
        Affine.strain_and_rotation(0.02, 5.0, (2.0, 1.0)),
        Affine(gradient=((1.08, 0), (0, 1))),
    ],
)
def test_from_a_guess_some_pixels_away_a_single_solve_finds_all_nodes(texture, reference, motion):
    nodes = reference.mesh.nodes
    found = solve(reference, moved(texture, motion), np.zeros_like(nodes), OPTIONS, Statistics())
    assert found.status is Status.CONVERGED
    assert found.measured.all()
    assert found.iterations <= 8  # up to 22 where elements come back row by row
    assert np.abs(found.displacement - motion.displacement(nodes, SHAPE)).max() < 0.0068


@pytest.mark.parametrize("turns", [1, 2])
@pytest.mark.parametrize("blank", [0, 50])
def test_an_exact_copy_that_has_turned_is_found_exactly(texture, turns, blank):
    """At edges and beside nodes without texture, too: the smoothness that carries these costs nothing."""
    image = np.asarray(texture.image(SHAPE), dtype=np.float32)
    image[:, :blank] = image.mean()
    region = Region.from_rectangle((20, 20, SHAPE[1] - 20, SHAPE[0] - 20), SHAPE)
    reference = Reference.prepare(image[None], region, mesh=Tri3Mesh.from_region(region, 25), prefilter="binomial")
    turned = np.ascontiguousarray(np.rot90(image, -turns))
    height, width = SHAPE
    (x, y), nodes = reference.mesh.nodes.T, reference.mesh.nodes
    truth = (np.stack([height - 1 - y, x]) if turns == 1 else np.stack([width - 1 - x, height - 1 - y])).T - nodes
    start = TrackingState(displacement=None)
    found = track(reference, Deformed.prepare(turned[None], prefilter="binomial"), start, OPTIONS, Statistics())
    seen = nodes[:, 0] >= blank
    assert found.measured[seen].all()
    assert np.nanmax(np.abs(found.displacement - truth)) < 1e-5


@pytest.mark.parametrize(("stretch", "limit"), [(0.8, 0.00078), (1.1, 0.00036)])
def test_a_strained_pattern_is_compared_with_the_reference_that_is_filtered_alike(texture, reference, stretch, limit):
    """The prefilter takes more of a pattern that is compressed: .0052 and .0017 px where each state is filtered."""
    motion = Affine(gradient=((stretch, 0), (0, 1)))
    start = motion.displacement(reference.mesh.nodes, SHAPE)
    found = solve(reference, moved(texture, motion), start, OPTIONS, Statistics())
    assert found.measured.all()
    assert np.sqrt(np.mean((found.displacement - start) ** 2)) < limit


def test_elements_across_a_jump_are_torn_and_a_stretched_sheet_is_not(reference):
    mesh = reference.mesh
    stretched = mesh.nodes * (0.8, -0.3)
    assert not torn_elements(mesh, stretched).any()
    left = mesh.nodes[:, 0] < np.median(mesh.nodes[:, 0])
    across = left[mesh.elements].any(axis=1) & ~left[mesh.elements].all(axis=1)
    np.testing.assert_array_equal(torn_elements(mesh, stretched + np.where(left[:, None], (0.0, 25.0), 0.0)), across)


@pytest.mark.parametrize(("turn", "jump"), [(12.0, (5.0, -3.0)), (12.0, (30.0, 12.0)), (42.0, (5.0, -3.0))])
def test_a_fragment_that_has_turned_is_followed_as_the_specimen_jumps(texture, turn, jump):
    """It has turned about its middle: what it moves by from frame to frame is what the plate does."""
    middle, radius = np.array([SHAPE[1], SHAPE[0]]) / 2 - 0.5, 58.0

    def state(degrees, shift):
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
        inside = np.hypot(x - middle[0] - shift[0], y - middle[1] - shift[1]) < radius
        plate, fragment = (texture.image(SHAPE, Affine.strain_and_rotation(0, turn, shift)) for turn in (0.0, degrees))
        return np.where(inside, fragment, plate) + np.random.default_rng(1).normal(0, 2, SHAPE)

    region = Region.from_rectangle((50, 20, 270, 180), SHAPE)
    mesh = Tri3Mesh.from_region(region, 12)
    first = np.asarray(state(0.0, (0.0, 0.0)), dtype=np.float32)[None]
    reference = Reference.prepare(first, region, mesh=mesh, prefilter="binomial")
    away = np.hypot(*(mesh.nodes - middle).T) - radius
    inner, outer = away < -25, away > 25

    def motion(degrees, shift):
        turned, rigid = (Affine.strain_and_rotation(0, turn, shift) for turn in (degrees, 0.0))
        return np.where(away[:, None] < 0, *(one.displacement(mesh.nodes, SHAPE) for one in (turned, rigid)))

    second = Deformed.prepare(np.asarray(state(turn, jump), dtype=np.float32)[None], prefilter="binomial")
    found = track(reference, second, TrackingState(displacement=motion(turn - 0.3, (0.0, 0.0))), OPTIONS, Statistics())
    assert found.status is Status.CONVERGED
    assert found.iterations <= 20
    for part in (inner, outer):
        assert found.measured[part].mean() > 0.9
        assert np.nanmax(np.abs(found.displacement - motion(turn, jump))[part]) < 0.15


def test_a_specimen_that_leaves_is_found_again_and_a_restored_start_gives_the_same_bits(texture, reference):
    start, statuses = TrackingState(displacement=None), []
    for shift in (0.0, -110.0, -400.0, 60.0):
        solution = track(reference, moved(texture, Affine(shift=(shift, 0.0))), start, OPTIONS, Statistics())
        restored = replace(start, displacement=None if start.displacement is None else start.displacement.copy())
        start = start.extrapolate(reference.mesh, solution.displacement, solution.measured)
        statuses.append(solution.status)
    assert statuses[2] is Status.FAILED
    assert statuses[3] is Status.CONVERGED
    assert np.abs(solution.displacement - (60.0, 0.0)).max() < 1e-6
    again = track(reference, moved(texture, Affine(shift=(60.0, 0.0))), restored, OPTIONS, Statistics())
    np.testing.assert_array_equal(again.displacement, solution.displacement)


def test_a_frame_without_a_start_says_how_near_it_came(reference):
    failed = track(
        reference, moved(Texture.random(4), Affine()), TrackingState(displacement=None), OPTIONS, Statistics()
    )
    assert failed.status is Status.FAILED
    assert "do not match anywhere" in failed.reason
    assert "of 15% needed" in failed.reason
    assert "turns up to about 30 degrees" in failed.reason


def test_a_fragment_counts_for_more_than_the_last_iterations_of_a_node():
    """The better of two solves of a frame is the one with more nodes, but for a fiftieth of them the one that ended."""

    def nodes(lost):
        status = np.full(1000, NodeStatus.MEASURED, dtype=np.uint8)
        status[:lost] = NodeStatus.DECORRELATED
        return status

    held, ended = rank(Status.NOT_CONVERGED, nodes(0)), [rank(Status.CONVERGED, nodes(lost)) for lost in (0, 10, 80)]
    assert ended[0] < ended[1] < held < ended[2]
    assert rank(Status.CONVERGED, nodes(999)) < rank(Status.FAILED, nodes(1000))
