"""Cracks on known speckle: both sides measured along a stated path, lost without and found again, K at a tip."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from crack_scene import (
    FACTORS,
    GAP_LEVEL,
    MATERIAL,
    NOISE,
    PATH,
    REGION,
    SHAPE,
    SHIFT,
    TIP,
    as_nodal,
    cracked,
    deformed_image,
    noisy,
    opening_at,
    reference_image,
    truth,
    williams_field,
)
from textures import Texture

from rgbmidic import NodeStatus, Region, Tri3Mesh, correlate, measure_sequence
from rgbmidic.correlation import Deformed, Reference, TrackingState, fill, track
from rgbmidic.correlation.images import as_light_stack
from rgbmidic.fields import crack_jump
from rgbmidic.settings import SolverSettings
from rgbmidic.tools.finite_elements import stress_intensity
from rgbmidic.weights import Statistics

ERROR_NEAR = 0.019
"""rms error (px) of the nodes within an element of the crack; .013 measured, .011 far from it."""
LEFT = 0.28
"""Largest error (px) of a node that is kept beside a crack of which nothing is said, and which opens by 5 px."""
RATIO = (0.75, 1.25)
"""rms of error over stated uncertainty of these nodes: some 60 values a case, so to 10 %."""


def measured(opening, cracks=()):
    return correlate(noisy(reference_image(), 1), noisy(deformed_image(opening), 2), region=REGION, cracks=cracks)


def places(solution):
    return Tri3Mesh(nodes=solution.nodes, elements=solution.elements).observation_points


def near(solution):
    """Nodes within an element of the crack, but for the tip's own element."""
    return (np.abs(solution.nodes[:, 1] - PATH[0][1]) < 26) & (solution.nodes[:, 0] < PATH[1][0] - 12)


@pytest.mark.parametrize("opening", [2.0, 5.0])
def test_both_sides_of_a_stated_crack_are_measured_within_their_uncertainty(opening):
    split = measured(opening, [PATH])
    assert split.measured.all()
    error = split.displacement - truth(split.nodes, places(split)[:, 1] < PATH[0][1], opening)
    beside = near(split)
    assert np.sqrt(np.mean(error[beside] ** 2)) < ERROR_NEAR
    assert RATIO[0] < np.sqrt(np.mean((error / split.displacement_std)[beside] ** 2)) < RATIO[1]
    copies = Tri3Mesh(nodes=split.nodes, elements=split.elements).copies
    upper = np.take_along_axis(copies, np.argsort(places(split)[copies][..., 1], axis=1), axis=1)
    jump = np.diff(split.displacement[upper], axis=1)[:, 0, 1]
    np.testing.assert_allclose(jump, opening_at(split.nodes[copies[:, 0], 0], opening), atol=4 * ERROR_NEAR)


def test_without_the_path_nodes_at_the_crack_are_lost_for_their_reason():
    whole = measured(5.0)
    lost = ~whole.measured
    assert (whole.node_status[lost] == NodeStatus.DECORRELATED).all()
    assert (lost & near(whole)).sum() >= 3
    assert not (lost & ~near(whole)).any()
    error = whole.displacement - truth(whole.nodes, whole.nodes[:, 1] < PATH[0][1], 5.0)
    assert np.abs(error[~lost]).max() < LEFT


def test_filled_nodes_take_their_uncertainty_from_their_own_side():
    split = measured(5.0, [PATH])
    mesh = Tri3Mesh(nodes=split.nodes, elements=split.elements)
    above = mesh.observation_points[:, 1] < PATH[0][1]
    hole = above & (
        np.hypot(*(mesh.observation_points - (60, 105)).T) < 40
    )  # the nearest measured nodes are below the crack
    status = np.where(hole, NodeStatus.DECORRELATED, split.node_status).astype(np.uint8)
    std = np.broadcast_to(np.where(above[:, None], 0.01, 10.0), split.displacement.shape)
    gaps = replace(
        split,
        node_status=status,
        displacement=np.where(hole[:, None], np.nan, split.displacement),
        displacement_std=std,
    )
    filled = fill(mesh, gaps, 100.0)
    assert (filled.node_status[hole] == NodeStatus.FILLED).all()
    assert filled.displacement_std[hole].max() < 5
    start = TrackingState(displacement=None).extrapolate(mesh, gaps.displacement, gaps.measured).displacement
    assert np.abs(start - truth(mesh.nodes, above, 5.0))[hole].max() < 1.5


LIGHTS = (1.0, 0.7, 1.2)
"""Brightness of three lights on one paint."""
STATED = (0.75, 1.3)
"""rms of error over stated uncertainty of opening and sliding at all pairs but the tip's, in all cases together;
1.10 and 1.05 measured. With the local mean of meshes without cracks up to four pairs of five are lost."""
OPEN = [  # opening (px), grey level of the gap, part by which the lower side is lit more, element (px), lights
    (1.0, 400.0, 0.0, 12, 3),
    (2.0, GAP_LEVEL, 0.0, 12, 1),
    (5.0, 400.0, 0.0, 12, 1),
    (5.0, GAP_LEVEL, 0.0, 16, 3),
    (3.0, GAP_LEVEL, 0.05, 20, 1),
]


def test_the_jump_is_measured_within_its_uncertainty_with_default_settings():
    region, errors, measured = Region.from_rectangle(REGION, SHAPE), [], []
    for number, (opening, gap, jump, size, lights) in enumerate(OPEN):
        mesh = Tri3Mesh.from_region(region, size, [PATH])
        images = reference_image(number), *[deformed_image(opening, gap, jump, number)] * 4
        reference, *states = (
            np.stack([level * noisy(image, 10 * seed + light) for light, level in enumerate(LIGHTS[:lights])])
            for seed, image in enumerate(images)
        )
        solutions = [*measure_sequence(states, reference=reference, region=region, mesh=mesh)]
        found = crack_jump(mesh.nodes, mesh.elements, as_nodal(solutions), (10, PATH[0][1]), PATH[1])
        error = found.opening.values - opening_at(found.points[:, 0], opening)
        ratios = np.stack([error / found.opening.uncertainty, found.sliding.values / found.sliding.uncertainty])[
            ..., :-1
        ]
        measured.append(np.isfinite(ratios).mean())
        errors.append(ratios.reshape(2, -1))
    assert min(measured) > 0.9
    ratio = np.sqrt(np.nanmean(np.concatenate(errors, axis=1) ** 2, axis=1))
    assert STATED[0] < ratio.min() < ratio.max() < STATED[1]


def followed(frames):
    """Solutions of a sequence of images, one after the other."""
    region = Region.from_rectangle(REGION, SHAPE)
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(
        as_light_stack(noisy(reference_image(), 1), ""), region, mesh=mesh, prefilter="binomial"
    )
    start, solutions = TrackingState(displacement=None), []
    for number, image in enumerate(frames):
        deformed = Deformed.prepare(as_light_stack(noisy(image, 2 + number), ""), prefilter="binomial")
        solutions.append(track(reference, deformed, start, SolverSettings(), Statistics()))
        start = start.extrapolate(reference.mesh, solutions[-1].displacement, solutions[-1].measured)
    return solutions


def test_nodes_lost_at_a_crack_come_back_when_it_closes():
    openings = [0.0, 2.5, 5.0, 2.5, 0.0]
    before, _, widest, _, after = followed([deformed_image(opening) for opening in openings])
    assert before.measured.all()
    assert not widest.measured.all()
    assert after.measured.all()
    np.testing.assert_allclose(after.displacement, np.broadcast_to(SHIFT, after.displacement.shape), atol=0.06)


def test_nodes_under_a_corrupted_patch_are_lost_for_their_reason_and_come_back_when_it_is_clean():
    spoilt = deformed_image(0.0).copy()
    spoilt[60:150, 100:200] = Texture.random(7).image(SHAPE)[60:150, 100:200]
    before, during, after = followed([deformed_image(0.0), spoilt, deformed_image(0.0)])
    x, y = during.nodes.T
    inside = (np.abs(x - 150) < 40) & (np.abs(y - 105) < 35)
    assert before.measured.all()
    assert after.measured.all()
    assert inside.sum() >= 6
    assert (during.node_status[inside] == NodeStatus.DECORRELATED).all()
    outside = (np.abs(x - 150) > 80) | (np.abs(y - 105) > 75)
    assert during.measured[outside].all()
    np.testing.assert_allclose(after.displacement, np.broadcast_to(SHIFT, after.displacement.shape), atol=0.06)


DRAWS = 24
BIAS = 0.027
"""Largest error of K (MPa sqrt(m)) in images without noise; .008 and .018 measured, where noise gives .052 and .043."""
COVERED = (0.9, 1.2)
"""rms of error over stated uncertainty of both factors over the draws; 1.09 measured."""


def test_stress_intensity_factors_are_found_within_their_uncertainty():
    solutions, quiet = [cracked(NOISE, seed) for seed in range(DRAWS)], cracked(0.0, 0)
    mesh = quiet.nodes, quiet.elements
    found = stress_intensity(*mesh, as_nodal(solutions), TIP, (34, 118), MATERIAL)
    assert found.terms <= 5
    ratio = (found.factors.values - FACTORS) / found.factors.std
    assert COVERED[0] < np.sqrt(np.mean(ratio**2)) < COVERED[1]
    assert 0.9 < found.chi_square.mean() < 1.2  # .98 measured
    noisy_std = as_nodal(solutions[:1])
    still = replace(as_nodal([quiet]), std=noisy_std.std)
    exact = stress_intensity(*mesh, still, TIP, (34, 118), replace(MATERIAL, terms=found.terms))
    assert np.abs(exact.factors.values - FACTORS).max() < BIAS
    jump = crack_jump(*mesh, as_nodal(solutions), (6, TIP[1]), TIP)
    x = jump.points[:, 0] - TIP[0]
    above, below = (np.stack(williams_field(x, 0 * x - side * 1e-9, side)) for side in (1, -1))
    for values, std, axis, sign in (
        (jump.opening.values, jump.opening.std, 1, -1),
        (jump.sliding.values, jump.sliding.std, 0, 1),
    ):
        error = (values - sign * (above - below)[axis]) / std
        assert RATIO[0] < np.sqrt(np.nanmean(error[:, :-1] ** 2)) < RATIO[1]  # the last is half an element from the tip
