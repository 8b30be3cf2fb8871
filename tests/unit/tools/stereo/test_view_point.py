"""A second camera in a virtual test sees the same material points where the cameras' geometry has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import AffineField, Cylinder, Plate, State, sphere_scene
from rgbmidic.tools.lab.virtual.view_point import ViewPoint, true_motion, true_pair
from rgbmidic.tools.scene.scene import Sphere
from rgbmidic.tools.scene.zones import material_points

FIELD = AffineField(gradient=((0.01, 0.002), (0.0, -0.003)), offset=(0.1, 0.0))
BODIES = {
    "sphere": (Sphere(), State(angle_deg=3.0, translation=(0.1, -0.2, 0.5))),
    "cylinder": (Cylinder(tilt_deg=10.0), State(angle_deg=-2.0, axis=(1.0, 0.0, 0.3))),
    "plate": (Plate(tilt_deg=(5.0, -3.0)), State(angle_deg=1.0, displacement=FIELD)),
}


@pytest.mark.parametrize("name", BODIES)
def test_both_cameras_see_one_material_point(name):
    body, state = BODIES[name]
    scene = replace(sphere_scene(size=128), body=body)
    left, right = ViewPoint.around(scene, 12.0), ViewPoint.around(scene, -9.0)
    pair = true_pair(scene, left, right)
    assert pair.angle_deg == pytest.approx(21.0)
    pixels = np.random.default_rng(0).uniform(20, 100, (30, 2))
    points, displacement = true_motion(scene, left, pixels, state)
    assert pair.project(points)[0] == pytest.approx(pixels, abs=1e-8)
    seen = right.scene(scene)
    material = material_points(left.scene(scene), left.state(body), tuple(pixels.T))
    for pose, places in ((right.state(body), points), (right.state(body, state), points + displacement)):
        x, y = pair.project(places)[1].T
        assert material_points(seen, pose, (x, y)) == pytest.approx(material, abs=1e-7)


def test_a_body_that_spins_is_refused():
    scene = sphere_scene(size=64)
    with pytest.raises(InputError, match="spins"):
        ViewPoint.around(scene, 10.0).state(scene.body, State(spin_deg=3.0))
