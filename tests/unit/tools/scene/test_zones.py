"""Predicted reflection zones against rendered ones, on every body."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import Cylinder, Plate, Scene, State, Surface, render, turned
from rgbmidic.tools.lab.virtual.rendering import paint, sphere_scene
from rgbmidic.tools.scene.camera import reference_camera, three_lights
from rgbmidic.tools.scene.zones import REFLECTS, Reflectance, macroscopic_reflectance, material_points, predict_zones

OVERLAP = 0.9
"""Common part of predicted and rendered zone over both together; the zone's edge moves by a few pixels."""
SHARE = 0.02
"""Root mean square difference of the specular share; the wrinkles' slopes are not quite Gaussian."""


def coarse_scene(body, size: int = 96) -> Scene:
    """A field of 21 mm with few rays: coarse pixels and wrinkles."""
    coarse = paint(droplet=0.3, seed=5)
    finishes = {name: replace(getattr(coarse, name), spacing=0.12) for name in ("white", "black")}
    lights = three_lights()
    return Scene(
        body=body,
        lights=lights,
        camera=replace(reference_camera((size, size)), focal_px=600 / 0.22, samples=5),
        surface=replace(coarse, **finishes),
    )


def rendered_share(scene: Scene, state: State) -> np.ndarray:
    """Specular share of the light, blurred over the speckle."""
    mat = {name: replace(getattr(scene.surface, name), gloss=0.0) for name in ("white", "black")}
    whole, diffuse = render(scene, state), render(replace(scene, surface=replace(scene.surface, **mat)), state)
    blur = [[cv2.GaussianBlur(image, (0, 0), 5) for image in stack] for stack in (whole, diffuse)]
    return 1 - np.array(blur[1]) / np.array(blur[0])


@pytest.mark.parametrize(
    ("body", "state"),
    [
        (sphere_scene().body, State()),
        (sphere_scene().body, turned(5.0)),
        (Cylinder(radius=30.0, centre=(0.0, 0.0, 630.0), tilt_deg=30.0), State(angle_deg=3.0)),
        (Plate(width=300.0, height=300.0, tilt_deg=(7.0, 0.0)), State(angle_deg=1.0, translation=(2.0, 0.0, 0.0))),
    ],
    ids=["sphere", "turned sphere", "cylinder", "plate"],
)
def test_the_predicted_zone_is_the_rendered_one(body, state):
    scene = coarse_scene(body)
    predicted, rendered = predict_zones(scene, state).fraction, rendered_share(scene, state)
    inner = np.s_[:, 10:-10, 10:-10]
    predicted, rendered = predicted[inner], rendered[inner]
    assert np.sqrt(np.mean((predicted - rendered) ** 2)) < SHARE
    zone = np.stack([predicted > REFLECTS, rendered > REFLECTS])
    assert zone[1].mean() > 0.02
    assert zone.all(axis=0).sum() / zone.any(axis=0).sum() > OVERLAP


def test_the_predicted_level_is_the_rendered_one():
    scene = coarse_scene(sphere_scene().body)
    level = predict_zones(scene).level
    blurred = np.array([cv2.GaussianBlur(image, (0, 0), 8) for image in render(scene)])
    inner = np.s_[:, 16:-16, 16:-16]
    ratio = blurred[inner] / level[inner]
    # the droplets' cover of a small field is not that of the mean
    assert abs(ratio.mean() - 1) < 0.05
    assert ratio.std() < 0.08


def test_wrinkles_widen_the_lobe_and_keep_its_volume():
    smooth = macroscopic_reflectance(
        Surface(white=replace(paint().white, slope_deg=0.0), black=replace(paint().black, slope_deg=0))
    )
    rough = macroscopic_reflectance(paint())
    assert smooth.width_deg == pytest.approx(4.0)
    assert smooth.specular == pytest.approx(1.5)
    assert rough.width_deg > 1.3 * smooth.width_deg
    assert rough.specular * rough.width_deg**2 == pytest.approx(smooth.specular * smooth.width_deg**2)
    assert macroscopic_reflectance(replace(paint(), dome=0.004)).width_deg > rough.width_deg


def test_points_of_the_body_keep_their_light_on_a_mat_paint_and_their_zone_moves_on_a_turning_one():
    scene = sphere_scene(size=64)
    scene = replace(scene, camera=replace(scene.camera, focal_px=1500.0))
    material = material_points(scene)
    before, after = (predict_zones(scene, state, material=material) for state in (State(), turned(4.0)))
    np.testing.assert_allclose(after.lambert, before.lambert, atol=0.08)
    moved = np.linalg.norm(after.slopes - before.slopes, axis=1)
    # the half-way slope changes by the angle of rotation, seen in the body's axes
    np.testing.assert_allclose(np.nanmedian(moved), np.radians(4.0), rtol=0.1)


def test_a_mat_paint_reflects_nowhere():
    share = predict_zones(sphere_scene(size=64, gloss=0.0)).fraction
    assert np.nanmax(share) == 0


def test_lamps_may_be_moved_without_a_new_scene():
    scene = sphere_scene(size=64)
    moved = tuple(replace(light, position=scene.mirror_position(500.0)) for light in scene.lights)
    share = predict_zones(scene, lights=moved).fraction
    np.testing.assert_allclose(share[0], share[2])
    assert share[:, 32, 32].min() > 0.5


def test_a_surface_without_albedo_is_still_a_number():
    black = replace(paint(), white=replace(paint().white, albedo=0.0), black=replace(paint().black, albedo=0.0))
    assert macroscopic_reflectance(black).diffuse > 0
    with pytest.raises(InputError):
        Reflectance(diffuse=-1.0, specular=0.0, width_deg=1.0)
