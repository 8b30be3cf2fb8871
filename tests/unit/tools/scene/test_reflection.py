"""Where lights reflect: mirror law, rough-surface lobe, height maps, binary weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from measures import Lobe
from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import Camera, Finish, Light, Sphere, Surface
from rgbmidic.tools.lab.virtual.rendering import plate_scene, sphere_scene
from rgbmidic.tools.scene.geometry_weights import angle_weights, surface_from_heights
from rgbmidic.tools.scene.zones import Reflectance, Zones, material_points, points_and_normals, zones_on_surface

PAINT = Finish(albedo=0.5, gloss=0.7, lobe_deg=6.0, slope_deg=0.0)
POINT, NORMAL = np.array([0.0, 0.0, 600.0]), np.array([0.0, 0.0, -1.0])


def lamp_at(angle_deg: float, distance: float = 500.0) -> list[float]:
    """A lamp seen from the point under an angle from its normal, which looks at the camera."""
    a = np.radians(angle_deg)
    return [distance * np.sin(a), 0.0, 600 - distance * np.cos(a)]


def reflection(points, normals, lamps, paint: Finish = PAINT) -> Zones:
    """Zones of lamps in these places on a smooth paint."""
    scene = plate_scene(kind="monochrome")
    scene = replace(scene, lights=scene.lights[:1], surface=Surface(white=paint, black=paint, coverage=0.0))
    lights = tuple(Light(name="lamp", position=tuple(place)) for place in lamps)
    return zones_on_surface(scene, points, normals, lights)


def test_a_lamp_in_the_mirror_direction_does_not_deviate():
    scene = plate_scene(tilt_deg=(8.0, -3.0))
    points, normals = points_and_normals(scene, np.zeros((3, 1)))
    result = reflection(points, normals, [scene.mirror_position(450.0)])
    np.testing.assert_allclose(result.deviation_deg, 0, atol=1e-5)
    np.testing.assert_allclose(result.slopes, 0, atol=1e-7)


def test_the_light_turns_twice_as_far_as_the_half_way_vector():
    angles = np.array([4.0, 15.0, 40.0])
    result = reflection(POINT[:, None], NORMAL[:, None], [lamp_at(angle) for angle in angles])
    np.testing.assert_allclose(result.deviation_deg[:, 0], angles, atol=1e-9)
    half = np.degrees(np.arctan(np.linalg.norm(result.slopes[:, :, 0], axis=1)))
    np.testing.assert_allclose(half, angles / 2, atol=1e-9)


def test_a_measured_lobe_is_met_again():
    lobe = Lobe(diffuse=0.5, specular=0.7, centre_deg=0.0, width_deg=11.0, std=(0, 0, 0, 0))
    paint = Finish(albedo=lobe.diffuse, gloss=lobe.specular, lobe_deg=lobe.width_deg / 2, slope_deg=0.0)
    angles = np.linspace(-40, 40, 17)
    level = reflection(POINT[:, None], NORMAL[:, None], [lamp_at(angle) for angle in angles], paint).radiance[:, 0]
    # the tangent of the half angle instead of the angle, and 1/(v.h)
    np.testing.assert_allclose(level, lobe(angles), rtol=0.015)


def test_the_share_is_that_of_the_peak_in_the_mirror_direction_and_falls_to_nothing():
    share = reflection(POINT[:, None], NORMAL[:, None], [lamp_at(0.1), lamp_at(60.0)]).fraction[:, 0]
    assert share[0] == pytest.approx(0.7 / 1.2, rel=1e-3)
    assert share[1] < 1e-4


def test_what_faces_away_is_not_seen():
    behind = reflection(POINT[:, None], NORMAL[:, None], [[0.0, 0.0, 900.0], lamp_at(20.0)])
    assert np.isnan(behind.deviation_deg[0]).all()
    assert np.isfinite(behind.deviation_deg[1]).all()
    turned = reflection(POINT[:, None], -NORMAL[:, None], [lamp_at(20.0)])
    assert np.isnan(turned.fraction).all()
    np.testing.assert_array_equal(angle_weights(turned.deviation_deg), 0)


def test_binary_weights_exclude_up_to_the_limit():
    weights = angle_weights(np.array([0.0, 14.9, 15.1, 90.0, np.nan]), 15.0)
    np.testing.assert_array_equal(weights, [0, 0, 1, 1, 0])
    assert weights.dtype == np.float32


def test_a_height_map_of_a_sphere_reflects_like_the_sphere():
    scene = sphere_scene(size=96)
    scene = replace(scene, camera=replace(scene.camera, focal_px=2000.0))
    points, normals = points_and_normals(scene, material_points(scene))
    front = scene.body.front[2]
    from_map = surface_from_heights(front - points[2], scene)
    np.testing.assert_allclose(from_map[0], points, atol=1e-9)
    lamps = [light.position for light in scene.lights]
    inner = np.s_[:, 2:-2, 2:-2]
    exact, mapped = (reflection(*surface, lamps).deviation_deg[inner] for surface in ((points, normals), from_map))
    np.testing.assert_allclose(mapped, exact, atol=0.02)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Reflectance(diffuse=0.0, specular=1.0, width_deg=5.0), "diffuse must be above 0"),
        (lambda: angle_weights(np.zeros(2), 0.0), "limit angle"),
        (lambda: surface_from_heights(np.full((3, 3), 700.0), plate_scene()), "below the distance"),
    ],
)
def test_what_makes_no_sense_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_the_camera_is_where_the_scene_has_it():
    # points of `points_and_normals` are in camera axes: the front point projects on the principal point
    scene = sphere_scene(size=64)
    points, _ = points_and_normals(scene, np.array([[0.0], [0.0], [-Sphere().radius]]))
    camera: Camera = scene.camera
    x = camera.focal_px * points[0] / points[2] + camera.centre[0]
    np.testing.assert_allclose(x, camera.centre[0], atol=1e-9)
