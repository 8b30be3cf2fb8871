"""Cracks: jumps and stress intensity factors of fields that are known in closed form, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic import Region, Tri3Mesh
from rgbmidic.errors import InputError
from rgbmidic.fields import Displacement, NodalCovariance, Units, crack_jump
from rgbmidic.tools.finite_elements import Williams, stress_intensity
from rgbmidic.tools.finite_elements.crack_tip import williams_series

SIZE = 14
STD = 0.01
TIP = (200.0, 200.0)
START = (0.0, 200.0)
RADII = (30.0, 150.0)
SCALE = 0.05
NU = 0.33
KAPPA = {"stress": (3 - NU) / (1 + NU), "strain": 3 - 4 * NU}
MATERIAL = Williams(youngs_modulus=70_000, poissons_ratio=NU, plane="stress", units=Units(mm_per_pixel=SCALE))
K1, K2, T = 0.02, -0.007, 0.05
"""Small, so that small and finite rotations are the same: what differs is of their second order."""


def split(*cracks, hole=()):
    region = Region.from_rectangle((5, 5, 394, 394), (400, 400)).without(hole)
    return Tri3Mesh.from_region(region, SIZE, cracks)


MESH = split([START, TIP])


def fields(mesh, displacement, std=STD):
    """Displacements (N, 2) or (T, N, 2) as the functions take them."""
    u, v = np.moveaxis(np.atleast_3d(displacement.reshape(-1, len(mesh.nodes), 2)), -1, 0)
    return Displacement.in_plane(u, v, np.full(u.shape, std), np.full(u.shape, std))


def textbook(mesh, williams, k1=K1, k2=K2, t=T, tip=TIP, direction=(1.0, 0.0)):
    """Displacement (N, 2) in px of the first terms, of Anderson, Fracture Mechanics (2005), table 2.2."""
    ahead = np.array(direction) / np.hypot(*direction)
    axes = np.array([ahead, [ahead[1], -ahead[0]]])  # the left side is up on the image, whose y is down
    x, y = ((mesh.nodes - tip) @ axes.T).T
    above = ((mesh.observation_points - tip) @ axes.T)[:, 1] > 0
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    angle = np.where((x < 0) & np.isin(np.arange(len(x)), mesh.copies), np.where(above, np.pi, -np.pi), angle)
    shear, kappa = williams.youngs_modulus / 2 / (1 + NU), KAPPA[williams.plane]
    s, c = np.sin(angle / 2), np.cos(angle / 2)
    root = np.sqrt(r * SCALE * 1e-3 / (2 * np.pi)) / (2 * shear) / (SCALE * 1e-3)
    u = root * (k1 * c * (kappa - 1 + 2 * s**2) + k2 * s * (kappa + 1 + 2 * c**2)) + t * (kappa + 1) * x / (8 * shear)
    v = root * (k1 * s * (kappa + 1 - 2 * c**2) - k2 * c * (kappa - 1 - 2 * s**2)) - t * (3 - kappa) * y / (8 * shear)
    return np.stack([u, v], axis=1) @ axes


def turned(mesh, displacement, degrees):
    """The same body, turned around the middle of the image."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    arm = mesh.nodes + displacement - 190
    return arm @ np.array([[c, s], [-s, c]]) + 190 - mesh.nodes


@pytest.mark.parametrize("plane", ["stress", "strain"])
@pytest.mark.parametrize("fit_tip", [False, True])
def test_the_factors_of_a_textbook_field_are_found_exactly(plane, fit_tip):
    williams = replace(MATERIAL, plane=plane, fit_tip=fit_tip)
    field = textbook(MESH, williams)
    found = stress_intensity(MESH.nodes, MESH.elements, fields(MESH, field, 1e-6), (201, 198), RADII, williams)
    np.testing.assert_allclose(found.factors.values, [[K1, K2]], rtol=1e-5)
    np.testing.assert_allclose(found.t_stress.values, T, rtol=1e-4)
    assert found.terms == 2
    if fit_tip:
        np.testing.assert_allclose(found.extension.values, 0, atol=1e-3)


def test_the_factors_do_not_depend_on_where_the_crack_points_or_how_the_body_turns():
    ahead = np.array([-150.0, 60.0])
    start = np.array(TIP) - 250 * ahead / np.hypot(*ahead)
    mesh = split([tuple(start), TIP])
    field = textbook(mesh, MATERIAL, direction=ahead)
    for degrees in (0, 20):
        moved = fields(mesh, turned(mesh, field, degrees), 1e-6)
        found = stress_intensity(mesh.nodes, mesh.elements, moved, TIP, RADII, MATERIAL)
        np.testing.assert_allclose(
            found.factors.values, [[K1, K2]], atol=2e-3 * K1
        )  # the mesh's crack follows to a pixel


@pytest.mark.parametrize("n", range(1, 8))
def test_every_term_is_in_equilibrium_and_leaves_the_faces_free(n):
    kappa, step = 1.8, 1e-3
    nu = (3 - kappa) / (1 + kappa)

    def gradient(x, y):
        def at(x, y):
            return williams_series(np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi), range(n, n + 1), kappa)

        return np.stack([(at(x + step, y) - at(x - step, y)), (at(x, y + step) - at(x, y - step))], axis=2) / (2 * step)

    def stress(x, y):  # plane stress, over 2 G
        (xx, xy), (yx, yy) = gradient(x, y).transpose(1, 2, 0, 3)
        return np.stack([(xx + nu * yy) / (1 - nu), (yy + nu * xx) / (1 - nu), (xy + yx) / 2])

    face = np.linspace(-2, -0.5, 5)
    assert np.abs(stress(face, 0 * face)[1:]).max() < 1e-4
    x, y = np.array([0.7, -0.4, -1.1]), np.array([0.9, 1.2, -0.6])
    by_x, by_y = (
        (stress(x + dx, y + dy) - stress(x - dx, y - dy)) / (2 * step) for dx, dy in ((step, 0.0), (0.0, step))
    )
    assert np.abs(by_x[0] + by_y[2]).max() < 1e-3
    assert np.abs(by_x[2] + by_y[1]).max() < 1e-3


def test_a_rigid_motion_has_neither_jump_nor_factors():
    moved = fields(MESH, turned(MESH, np.full(MESH.nodes.shape, 3.0), 30))
    found = stress_intensity(MESH.nodes, MESH.elements, moved, TIP, RADII, MATERIAL)
    assert np.abs(found.factors.values).max() < 1e-10
    assert np.abs(found.t_stress.values).max() < 1e-8
    jump = crack_jump(MESH.nodes, MESH.elements, moved, START, TIP)
    assert np.abs([jump.opening.values, jump.sliding.values]).max() < 1e-9


def test_the_jump_is_stated_in_the_axes_of_the_deformed_crack():
    left = np.isin(np.arange(len(MESH.nodes)), MESH.copies) & (
        MESH.observation_points[:, 1] < TIP[1]
    )  # above: y is down
    field = np.where(left[:, None], (0.5, -2.0), 0.0)
    for degrees in (0, 40):
        jump = crack_jump(MESH.nodes, MESH.elements, fields(MESH, turned(MESH, field, degrees)), START, TIP)
        inner = slice(1, -1)  # at the last pair the middle line bends to the tip
        np.testing.assert_allclose(jump.opening.values[0, inner], 2.0, rtol=1e-9)
        np.testing.assert_allclose(jump.sliding.values[0, inner], 0.5, rtol=1e-9)
    back = crack_jump(MESH.nodes, MESH.elements, fields(MESH, field), TIP, START)
    np.testing.assert_allclose(back.opening.values[0, inner], 2.0, rtol=1e-9)
    np.testing.assert_allclose(back.sliding.values[0, inner], 0.5, rtol=1e-9)
    np.testing.assert_allclose(back.points[::-1], jump.points)
    np.testing.assert_allclose(jump.distance, jump.points[:, 0] - 5, atol=1e-9)


def test_the_stated_uncertainty_is_that_of_draws_of_the_nodes_noise():
    draws, random = 300, np.random.default_rng(1)
    left = np.isin(np.arange(len(MESH.nodes)), MESH.copies) & (MESH.observation_points[:, 1] < TIP[1])
    field = np.where(left[:, None], (0.0, -6.0), 0.0) + textbook(MESH, MATERIAL, 20.0, 5.0)
    root = np.linalg.cholesky(NodalCovariance.from_mesh(MESH).correlation.toarray())
    noise = STD * (root @ random.normal(size=(draws, *field.shape)))
    jump = crack_jump(MESH.nodes, MESH.elements, fields(MESH, field + noise), START, TIP)
    for values, std in ((jump.opening.values, jump.opening.std), (jump.sliding.values, jump.sliding.std)):
        ratio = values.std(axis=0) / std.mean(axis=0)
        assert 0.88 < ratio.min() < ratio.max() < 1.12  # 300 draws: a ratio to 4 %, the largest of 60 to 10 %
    opened = textbook(MESH, MATERIAL, 5.0, 2.0) + noise[:60]
    found = stress_intensity(
        MESH.nodes, MESH.elements, fields(MESH, opened), TIP, RADII, replace(MATERIAL, fit_tip=True)
    )
    ratio = found.factors.values.std(axis=0) / found.factors.std.mean(axis=0)
    assert 0.75 < ratio.min() < ratio.max() < 1.25  # 60 draws: to 9 %
    assert 0.75 < (found.extension.values / found.extension.std).std() < 1.25
    np.testing.assert_allclose(found.chi_square.mean(), 1, atol=0.03)


def test_values_and_uncertainty_are_those_of_generalised_least_squares_with_the_whole_covariance():
    random, count = np.random.default_rng(5), len(MESH.nodes)
    std = random.uniform(0.5, 2, (2, count)) * STD
    u, v = textbook(MESH, MATERIAL).T + std * random.normal(size=(2, count))
    nodal = Displacement.in_plane(u[None], v[None], std[:1], std[1:])
    found = stress_intensity(MESH.nodes, MESH.elements, nodal, TIP, RADII, replace(MATERIAL, terms=4))
    x, y = (MESH.nodes - TIP).T
    used = (np.hypot(x, y) >= RADII[0]) & (np.hypot(x, y) <= RADII[1])
    face = np.isin(np.arange(count), MESH.copies)
    angle = np.where(face, np.where(MESH.observation_points[:, 1] < TIP[1], np.pi, -np.pi), np.arctan2(-y, x))
    series = williams_series(np.hypot(x, y)[used], angle[used], range(5), MATERIAL.kolosov)
    design = np.concatenate([series[:, 0], -series[:, 1]])
    correlation = NodalCovariance.from_mesh(MESH).correlation.toarray()[np.ix_(used, used)]
    zero = np.zeros_like(correlation)
    inverse = np.linalg.inv(
        np.block(
            [[correlation * np.outer(s, s) if i == j else zero for j in (0, 1)] for i, s in enumerate(std[:, used])]
        )
    )
    covariance = np.linalg.inv(design.T @ inverse @ design)
    data = np.r_[u[used], v[used]]
    values = covariance @ design.T @ inverse @ data
    left = data - design @ values
    chi_square = left @ inverse @ left / (len(data) - len(values))
    to_k = np.sqrt(2 * np.pi * SCALE * 1e-3) * MATERIAL.youngs_modulus / (1 + NU)
    stated = np.sqrt(np.diag(covariance) * max(1, chi_square))[2:4]
    np.testing.assert_allclose(found.chi_square, chi_square, rtol=1e-3)
    np.testing.assert_allclose(found.factors.std[0], to_k * stated, rtol=1e-3)
    np.testing.assert_allclose(found.factors.values[0], to_k * values[2:4], atol=0.02 * to_k * stated.min())


def test_the_tip_is_found_where_it_is_ahead_of_the_meshs():
    ahead = textbook(MESH, MATERIAL, tip=(206.0, 200.0))
    fitted = replace(MATERIAL, fit_tip=True, terms=3)
    found = stress_intensity(MESH.nodes, MESH.elements, fields(MESH, ahead, 1e-5), TIP, RADII, fitted)
    np.testing.assert_allclose(found.extension.values, 6, atol=0.01)
    np.testing.assert_allclose(found.factors.values, [[K1, K2]], rtol=1e-3)
    held = stress_intensity(
        MESH.nodes, MESH.elements, fields(MESH, ahead, 1e-6), TIP, RADII, replace(fitted, fit_tip=False)
    )
    assert held.chi_square[0] > 2
    lost = stress_intensity(MESH.nodes, MESH.elements, fields(MESH, 0 * ahead), TIP, RADII, fitted)
    assert np.isnan(lost.factors.values).all()  # without a load there is no tip to find


def test_a_branch_and_lost_nodes_leave_the_other_pairs():
    mesh = split([START, TIP], [(100, 200), (150, 120)])
    jump = crack_jump(mesh.nodes, mesh.elements, fields(mesh, np.zeros(mesh.nodes.shape)), START, TIP)
    assert np.abs(jump.points[:, 0] - 100).min() > SIZE / 3
    lost = np.zeros(MESH.nodes.shape)
    lost[np.hypot(*(MESH.nodes - (100, 200)).T) < SIZE] = np.nan
    jump = crack_jump(MESH.nodes, MESH.elements, fields(MESH, lost), START, TIP)
    gone = np.isnan(jump.opening.values[0])
    assert 3 <= gone.sum() <= 6
    assert np.abs(jump.points[gone, 0] - 100).max() < 2.5 * SIZE


def test_an_annulus_that_is_not_measured_in_a_frame_has_no_factors_there():
    frames = np.stack([textbook(MESH, MATERIAL)] * 3)
    angle = np.degrees(np.arctan2(*(MESH.nodes - TIP).T[::-1]))
    frames[1, (angle > 20) & (angle < 80)] = np.nan
    frames[2, (angle > 20) & (angle < 50)] = np.nan
    found = stress_intensity(MESH.nodes, MESH.elements, fields(MESH, frames), TIP, RADII, MATERIAL)
    np.testing.assert_array_equal(np.isnan(found.factors.values[:, 0]), [False, True, False])
    np.testing.assert_array_equal(np.isnan(found.chi_square), [False, True, False])


BENT = split([(0, 200), (120, 200), (200, 160)])
HOLED = split([START, TIP], hole=[[(250, 180), (280, 180), (280, 210), (250, 210)]])
WHOLE = Tri3Mesh.from_region(Region.from_rectangle((5, 5, 394, 394), (400, 400)), SIZE)


@pytest.mark.parametrize(
    ("mesh", "tip", "radii", "message"),
    [
        (WHOLE, TIP, RADII, r"no node of this result is the tip of a crack; cracks are stated in \[mesh\] cracks"),
        (
            MESH,
            (230, 200),
            RADII,
            r"at \(230, 200\) px is not the tip of a crack .* lies at \(200, 200\) px, 30 px away",
        ),
        (MESH, TIP, (20, 100), r"inner radius of 2 elements, 2.\.\d px, or more, .* given are 20 and 100 px"),
        (MESH, TIP, (100, 60), r"a larger outer one; given are 100 and 60 px"),
        (MESH, TIP, (30, 220), r"leaves the region \(edge or hole\) at \d+ % of its angles; it may reach to 19\d"),
        (HOLED, TIP, RADII, r"leaves the region \(edge or hole\) .* it may reach to 4\d"),
        (BENT, (200, 160), RADII, r"straight from the tip at \(200, 160\) px .* leaves its line by \d"),
        (MESH, TIP, (30, 34), r"has \d nodes, none over up to \d+ degrees; 12 are needed, and one every 45 degrees"),
        (split([(150, 200), TIP]), TIP, RADII, r"straight from the tip .* it is 5\d(\.\d+)? px long"),
    ],
)
def test_an_annulus_that_cannot_be_fitted_is_refused_for_its_reason(mesh, tip, radii, message):
    with pytest.raises(InputError, match=message):
        stress_intensity(mesh.nodes, mesh.elements, fields(mesh, 0 * mesh.nodes), tip, radii, MATERIAL)


@pytest.mark.parametrize(
    ("mesh", "start", "end", "message"),
    [
        (WHOLE, START, TIP, r"no node of this result is on a crack"),
        (MESH, (5, 230), TIP, r"the crack at \(5, 230\) px is not on a crack of the mesh; the nearest"),
        (MESH, TIP, TIP, r"two different points of one crack"),
        (split([START, (120, 200)], [(160, 100), (300, 100)]), START, (300, 100), r"two different points of one crack"),
    ],
)
def test_a_path_that_is_not_a_crack_is_refused(mesh, start, end, message):
    with pytest.raises(InputError, match=message):
        crack_jump(mesh.nodes, mesh.elements, fields(mesh, 0 * mesh.nodes), start, end)


def test_factors_need_millimetres_and_a_material():
    with pytest.raises(InputError, match=r"need the scale .* mm_per_pixel or camera"):
        replace(MATERIAL, units=Units())
    with pytest.raises(InputError, match=r"Poisson's ratio above -1 and at most .5, .* given are 70000, 0.6"):
        replace(MATERIAL, poissons_ratio=0.6)
