"""Displacements of sphere and plate against closed forms that share no code with the renderer."""

import math

import numpy as np
import pytest

from rgbmidic.tools.lab.virtual import (
    AffineField,
    Cylinder,
    Plate,
    State,
    material_points,
    plate_scene,
    sphere_scene,
    strained_plate,
    truth,
    turned,
)
from rgbmidic.tools.lab.virtual.rendering import DISTANCE
from rgbmidic.tools.scene.camera import PIXEL

FOCAL = DISTANCE / PIXEL
RADIUS = 41.25
TOLERANCE_PX = 1e-8


def pixels(size):
    centre = (size - 1) / 2
    x, y = np.meshgrid(np.arange(size) - centre, np.arange(size) - centre)
    return x, y


def sphere_displacement(size, angle_deg):
    """Law of cosines for the hit, complex multiplication for the turn about the front point."""
    x, y = pixels(size)
    slope = np.hypot(x, y) / FOCAL
    gamma = np.arctan(slope)
    centre = DISTANCE + RADIUS
    distance = centre * np.cos(gamma) - np.sqrt(RADIUS**2 - (centre * np.sin(gamma)) ** 2)
    depth = distance * np.cos(gamma)
    px, py = x * depth / FOCAL, y * depth / FOCAL
    # about y with y downwards: x -> x cos + z sin, z -> z cos - x sin, both from the front point
    turned_point = (px + 1j * (depth - DISTANCE)) * np.exp(-1j * math.radians(angle_deg))
    depth_after = DISTANCE + turned_point.imag
    return FOCAL * turned_point.real / depth_after - x, FOCAL * py / depth_after - y


@pytest.mark.parametrize("angle", [1 / 3, 8.0, -14.0])
def test_sphere_turning_about_its_front_point(angle):
    scene = sphere_scene(size=64, focal_px=FOCAL)
    u, v = truth(scene, turned(angle))
    expected_u, expected_v = sphere_displacement(64, angle)
    assert np.abs(u - expected_u).max() < TOLERANCE_PX
    assert np.abs(v - expected_v).max() < TOLERANCE_PX


def homography(tilt, gradient=0.0, shift=(0.0, 0.0)):
    """Plate coordinates (X, Y, 1) to image, for a plate tilted about y and stretched and shifted in its plane."""
    c, s = math.cos(tilt), math.sin(tilt)
    stretch = np.array([[1 + gradient, 0, shift[0]], [0, 1 + gradient, shift[1]], [0, 0, 1]])
    place = np.array([[c, 0, 0], [0, 1, 0], [-s, 0, DISTANCE]])
    return np.diag([FOCAL, FOCAL, 1]) @ place @ stretch


def test_tilted_plate_stretched_and_shifted():
    scene = plate_scene(size=64)
    u, v = truth(scene, strained_plate(shift_px=(0.25, 0.075), strain=0.002))
    x, y = pixels(64)
    before = homography(0.15)
    after = homography(0.15, 0.002, (0.25 * PIXEL, 0.075 * PIXEL))
    q = after @ np.linalg.inv(before) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    assert np.abs(u.ravel() - (q[0] / q[2] - x.ravel())).max() < TOLERANCE_PX
    assert np.abs(v.ravel() - (q[1] / q[2] - y.ravel())).max() < TOLERANCE_PX


def test_general_field_gives_what_the_affine_one_gives():
    affine = AffineField(gradient=((0.01, 0.003), (-0.002, 0.004)), offset=(0.02, -0.01))
    scene = plate_scene(size=24)
    reference = State(displacement=affine)
    general = State(displacement=lambda x, y: affine(x, y))
    difference = material_points(scene, reference) - material_points(scene, general)
    assert np.abs(difference).max() < 1e-8


def test_translation_of_a_plate_facing_the_camera_is_uniform():
    scene = plate_scene(size=16, tilt_deg=(0.0, 0.0))
    u, v = truth(scene, State(translation=(2 * PIXEL, -PIXEL, 0.0)))
    assert np.abs(u - 2).max() < 1e-9
    assert np.abs(v + 1).max() < 1e-9


def test_points_off_the_body_and_hidden_points_have_no_displacement():
    from dataclasses import replace

    scene = sphere_scene(size=32, focal_px=FOCAL / 64)
    u, _ = truth(scene, turned(0.0))
    assert np.isnan(u[0, 0])
    assert abs(u[16, 16]) < 1e-9
    half_turn = truth(scene, State(angle_deg=180.0, pivot=(0.0, 0.0, DISTANCE + RADIUS)))
    assert np.isnan(half_turn).all()
    small = replace(plate_scene(size=32, tilt_deg=(0.0, 0.0)), body=Plate(width=0.8, height=0.4))
    inside = np.isfinite(truth(small, State())[0])
    assert inside[:, 16].sum() == 8
    assert inside[16].sum() == 14


def test_cylinder_rolls_like_the_sphere_on_its_equator():
    from dataclasses import replace

    sphere = sphere_scene(size=33, focal_px=FOCAL / 8)
    cylinder = replace(sphere, body=Cylinder(radius=RADIUS, centre=(0.0, 0.0, DISTANCE + RADIUS)))
    a, b = truth(sphere, turned(5.0))[:, 16], truth(cylinder, turned(5.0))[:, 16]
    assert np.allclose(a, b, atol=1e-9)
    assert np.allclose(truth(cylinder, turned(5.0))[0, 0], b[0], atol=1e-6)
