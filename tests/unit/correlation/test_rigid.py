"""Rigid motions of the lights: the bordered equations by dense algebra, and what the images cannot show of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag
from textures import Affine, Texture

from rgbmidic import Region, Tri3Mesh, correlate
from rgbmidic.correlation import Status
from rgbmidic.correlation.assembly import Assembly, RigidMotions, rigid_functions
from rgbmidic.mesh.tri3 import with_data

SHAPE, REGION = (100, 200), (12, 12, 187, 87)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]
EVERYWHERE, LEFT, RIGHT, APART = X >= 0, X < 90, X > 110, X > 140
MOTIONS = ((0.3, 0.2), (0.9, -0.3), (-0.2, 0.7))
BODIES = ((LEFT | RIGHT) & (X > 11) & (X < 188) & (Y > 11) & (Y < 88)).astype(bool)
SMALL_ERROR = 0.0065
"""Error (px) without noise, where two lights see one spot together: twice the interpolation's."""


def test_the_bordered_equations_are_those_of_dense_algebra():
    mesh, random = Tri3Mesh.from_region(Region.from_rectangle((3, 5, 60, 50), (60, 70)), 13), np.random.default_rng(0)
    assembly, functions = Assembly.from_mesh(mesh), rigid_functions(mesh.nodes, "translation+rotation")
    slopes, shapes = (
        random.normal(size=(3, len(mesh.elements), 5, 2)),
        random.dirichlet(np.ones(3), (len(mesh.elements), 5)),
    )
    products = np.stack([slopes[..., 0] ** 2, slopes.prod(axis=-1), slopes[..., 1] ** 2], axis=-1)
    per_light = list(np.einsum("jenc,ena,enb->jeabc", products, shapes, shapes))
    hold = 1e-4 * assembly.smoothness.data + 1e-9 * assembly.diagonal
    solve = assembly.factorise(assembly.matrix(np.sum(per_light, axis=0), hold))
    textured = np.ones(len(mesh.elements), dtype=bool)
    rigid = RigidMotions.eliminate(
        assembly, per_light, functions, with_data(assembly.smoothness, hold), solve, textured
    )
    assert not rigid.unobservable.any()

    hessians = [assembly.matrix(blocks).toarray() for blocks in per_light]
    border = np.concatenate([hessian @ functions for hessian in hessians[1:]], axis=1)
    corner = block_diag(*(functions.T @ hessian @ functions for hessian in hessians[1:]))
    images, smooth = sum(hessians), with_data(assembly.smoothness, hold).toarray()
    whole = np.block([[images, border], [border.T, corner]])
    exact = np.linalg.inv(whole)
    free = len(images)
    np.testing.assert_allclose(rigid.inverse, exact[free:, free:], rtol=1e-3)
    # whatever the smoothness pulls, the iteration ends where the images want the coefficients
    wanted, found = random.normal(size=len(whole)), np.zeros(len(whole))
    sides = whole @ wanted
    for _ in range(4):
        rest = sides - whole @ found
        pull = -smooth @ found[:free]
        moved = solve(rest[:free] + pull)
        coefficients = rigid.increment(moved, pull, rest[free:])
        found += np.concatenate([moved - rigid.response @ coefficients, coefficients])
    np.testing.assert_allclose(found[free:], wanted[free:], atol=1e-4)
    np.testing.assert_allclose(solve(rest[:free] + pull), 0, atol=1e-6)


def seen_by(*lights, bodies=False, rigid="translation+rotation"):
    """The lights, each with its own shift, see where they are 1."""
    texture = Texture.random(5)
    pair = [
        np.stack([texture.image(SHAPE, Affine(shift=shift)) for shift in shifts[: len(lights)]])
        for shifts in (((0, 0),) * 3, MOTIONS)
    ]
    region = Region.from_mask(BODIES) if bodies else REGION
    return correlate(
        *pair, region=region, weights=np.array(lights, float), rigid=rigid, element_size=20, initial=(0.3, 0.2)
    )


@pytest.mark.parametrize("rigid", ["translation", "translation+rotation"])
@pytest.mark.parametrize(
    ("lights", "bodies", "named"),
    [
        ((LEFT, RIGHT), True, "light 1 shares"),
        ((LEFT, APART), False, "light 1 shares"),
        ((LEFT, RIGHT, RIGHT), True, "lights 1, 2 share"),
        ((LEFT, LEFT & (X > 60), APART), False, "light 2 shares"),
    ],
)
def test_lights_that_share_nothing_with_the_first_are_named(lights, bodies, named, rigid):
    found = seen_by(*lights, bodies=bodies, rigid=rigid)
    assert found.status is Status.FAILED
    assert found.reason.startswith(f"{named} too little seen texture with light 0")
    assert np.isnan(found.displacement).all()


@pytest.mark.parametrize(
    ("lights", "bodies"),
    [
        ((EVERYWHERE, EVERYWHERE), True),
        ((LEFT, RIGHT, EVERYWHERE), True),
        ((X < 80, (X > 65) & (X < 140), X > 125), False),
        ((LEFT, APART | ((X > 65) & (X < 85) & (Y > 40) & (Y < 60))), False),
    ],
)
def test_lights_that_meet_anywhere_or_through_another_are_measured(lights, bodies):
    found = seen_by(*lights, bodies=bodies)
    assert found.status is Status.CONVERGED
    assert found.measured.mean() > 0.6
    assert np.nanmax(np.abs(found.displacement - MOTIONS[0])) < SMALL_ERROR


def test_what_a_blind_light_does_is_not_known():
    found = seen_by(EVERYWHERE, X < 0, EVERYWHERE)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.rigid[[0, 2], :2], [(0, 0), np.subtract(MOTIONS[2], MOTIONS[0])], atol=SMALL_ERROR)
    assert np.isnan(found.rigid[1]).all()
