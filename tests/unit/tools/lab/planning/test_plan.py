"""Plans: where zones fall over the states, what overlaps, and lamps that stand better."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.tools.lab.planning import CONSTANTS, LampPlan, make_plan, propose_colours, propose_lamps
from rgbmidic.tools.lab.stereo_planning import stereo_outlooks
from rgbmidic.tools.lab.virtual import Cylinder, Light, Plate, Scene, State, turned
from rgbmidic.tools.lab.virtual.rendering import paint, sphere_scene
from rgbmidic.tools.scene.camera import SecondCamera, reference_camera, three_lights
from rgbmidic.tools.scene.scene import DatasetSettings, Experiment
from rgbmidic.tools.scene.zones import REFLECTS, predict_zones


def plan(scene: Scene, *states: State, **output: object) -> LampPlan:
    return make_plan(Experiment(scene=scene, states=states, output=DatasetSettings(**output)))


def coarse(scene: Scene, size: int = 160, pixel: float = 0.22) -> Scene:
    """The scene with four times coarser pixels and paint."""
    fine = scene.surface
    white, black = (replace(finish, spacing=4 * finish.spacing) for finish in (fine.white, fine.black))
    surface = replace(fine, white=white, black=black, droplet=4 * fine.droplet, softness=4 * fine.softness)
    return replace(scene, surface=surface, camera=replace(scene.camera, shape=(size, size), focal_px=600 / pixel))


def lamp(name: str, azimuth: float, inclination: float, distance: float = 550.0) -> Light:
    a, b = np.radians((azimuth, inclination))
    place = distance * np.array([np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), -np.cos(b)]) + (0, 0, 600)
    return Light(name=name, position=tuple(place.tolist())).aimed((0.0, 0.0, 600.0))


def with_lamps(scene: Scene, *directions: tuple[float, float]) -> Scene:
    lights = tuple(lamp(name, *where) for name, where in zip(("red", "green", "blue"), directions, strict=True))
    return replace(scene, lights=lights)


def overlap(made: LampPlan) -> float:
    return max(made.fraction(outlook.reflects.sum(axis=0) > 1) for outlook in made.outlooks)


def test_zones_are_those_of_both_states_at_the_points_of_the_reference():
    scene = coarse(sphere_scene())
    lamp_plan = plan(scene, turned(2.0), turned(6.0))
    assert lamp_plan.inside.mean() > 0.5
    shares = [predict_zones(scene).fraction, None]
    rows, columns = (np.round(a[lamp_plan.inside]).astype(int) for a in (lamp_plan.y, lamp_plan.x))
    near = abs(shares[0][:, rows, columns] - REFLECTS) > 0.02
    at_rest = shares[0][:, rows, columns] > REFLECTS
    # what reflects at rest reflects in every comparison with the state at rest
    for outlook in lamp_plan.outlooks:
        assert outlook.reflects[:, lamp_plan.inside][near & at_rest].all()
    # a reflection that moves covers more of the field, the farther the more
    covered = [outlook.reflects[0][lamp_plan.inside].mean() for outlook in lamp_plan.outlooks]
    assert at_rest[0].mean() < covered[0] < covered[1]


def test_the_field_stays_in_view_and_the_uncertainty_is_a_number_on_it():
    lamp_plan = plan(coarse(sphere_scene()), turned(4.0))
    x0, y0, x1, y1 = lamp_plan.field
    motion = lamp_plan.outlooks[0].displacement[:, lamp_plan.inside]
    assert x0 > 20 + np.abs(motion[0]).max() - 1
    assert y0 > 20
    assert x1 < 159
    assert y1 < 159
    assert np.isfinite(lamp_plan.outlooks[0].std[lamp_plan.inside]).all()
    assert 0 < lamp_plan.std < 0.1
    assert plan(coarse(sphere_scene()), turned(4.0), region=(40.0, 50.0, 90.0, 95.0)).field == (40, 50, 90, 95)


def test_a_field_off_the_body_is_refused():
    post = coarse(replace(sphere_scene(), body=Cylinder(radius=4.0, centre=(0.0, 0.0, 604.0))))
    with pytest.raises(InputError, match="does not lie on the body"):
        plan(post, region=(10.0, 10.0, 150.0, 150.0))
    with pytest.raises(InputError, match=r"state output\.region"):
        plan(replace(post, body=Plate(width=1.0, height=1.0)))


def test_lights_that_all_reflect_in_one_place_leave_none():
    scene = coarse(sphere_scene())
    heap = with_lamps(scene, (0.0, 20.0), (25.0, 20.0), (50.0, 20.0))
    apart = with_lamps(scene, (0.0, 50.0), (120.0, 50.0), (240.0, 50.0))
    heaped, spread = plan(heap, turned(3.0)), plan(apart, turned(3.0))
    outlook = heaped.outlooks[0]
    assert heaped.fraction(outlook.reflects.all(axis=0)) > 0.02
    np.testing.assert_array_equal(outlook.clean == 0, outlook.reflects.all(axis=0))
    assert overlap(spread) < 0.01
    assert spread.outlooks[0].std[spread.inside].max() < outlook.std[heaped.inside].max()


def test_moved_lamps_overlap_less_keep_their_distance_and_stay_apart():
    scene = with_lamps(coarse(sphere_scene()), (0.0, 20.0), (25.0, 20.0), (50.0, 20.0))
    lamp_plan = plan(scene, turned(1.0), turned(4.0))
    proposal = propose_lamps(lamp_plan)
    assert overlap(lamp_plan) > 0.05
    assert overlap(proposal) < 0.2 * overlap(lamp_plan)
    assert proposal.gain > 1.02
    assert proposal.std <= 1.2 * lamp_plan.std
    front = np.array(scene.body.front)
    towards = [np.array(light.position) - front for light in proposal.scene.lights]
    np.testing.assert_allclose([np.linalg.norm(t) for t in towards], 550.0)
    unit = np.array([t / np.linalg.norm(t) for t in towards])
    cosines = (unit @ unit.T)[np.triu_indices(3, 1)]
    assert cosines.max() <= np.cos(np.radians(CONSTANTS.min_angle)) + 1e-9
    # the proposal's figures are those of a plan made for it
    again = plan(replace(scene, lights=proposal.scene.lights), turned(1.0), turned(4.0))
    assert again.std == pytest.approx(proposal.std)


def test_lamps_of_a_cylinder_go_to_its_ends():
    scene = replace(
        coarse(sphere_scene(), size=120),
        body=Cylinder(radius=30.0, centre=(0.0, 0.0, 630.0)),
        lights=three_lights()[:2],
        camera=replace(reference_camera((120, 120), kind="monochrome"), focal_px=600 / 0.3),
    )
    proposal = propose_lamps(plan(scene, turned(3.0)))
    for light in proposal.scene.lights:
        assert abs(light.position[1]) > 2 * abs(light.position[0])
    assert max(proposal.fraction(mask) for mask in proposal.outlooks[0].reflects) < 0.01


def test_green_gets_the_light_that_reflects_least_before_a_bayer_camera():
    scene = with_lamps(coarse(sphere_scene()), (180.0, 60.0), (0.0, 22.0), (270.0, 25.0))
    lamp_plan = plan(scene, turned(4.0))
    reflecting = [lamp_plan.fraction(mask) for mask in lamp_plan.outlooks[0].reflects]
    assert int(np.argmin(reflecting)) == 0  # red has the best place
    proposal = propose_colours(lamp_plan)
    places = {light.name: np.array(light.position) for light in scene.lights}
    np.testing.assert_allclose(dict_of(proposal.scene.lights)["green"], places["red"], atol=1e-6)
    assert proposal.std < lamp_plan.std


def dict_of(lights):
    return {light.name: np.array(light.position) for light in lights}


def test_where_colours_are_alike_nothing_is_exchanged():
    scene = coarse(sphere_scene(kind="monochrome"))
    proposal = propose_colours(plan(scene, turned(2.0)))
    assert proposal.gain == 1
    assert proposal.scene.lights == scene.lights


def test_a_plan_without_states_compares_the_body_with_itself():
    lamp_plan = plan(coarse(sphere_scene()))
    assert len(lamp_plan.outlooks) == 1
    np.testing.assert_allclose(lamp_plan.outlooks[0].displacement[:, lamp_plan.inside], 0, atol=1e-9)


def test_a_paint_without_droplets_cannot_be_planned():
    scene = coarse(replace(sphere_scene(), surface=replace(paint(), coverage=0.0)))
    with pytest.raises(InputError, match="no texture"):
        plan(scene)


def test_two_cameras_see_depth_as_their_angle_has_it():
    """On a flat plate far away, w is as uncertain as the geometry of two rays has it, and v as a mean of both."""
    plate = Scene(body=Plate(), lights=three_lights(), camera=reference_camera((160, 160), focal_px=600 / 0.22))
    made = plan(coarse(plate), turned(0.5))
    outlooks = stereo_outlooks(made, SecondCamera(angle_deg=20.0), (40.0,))
    assert [outlook.angle_deg for outlook in outlooks] == [20.0, 40.0]
    one = made.std * made.scene.pixel
    for outlook in outlooks:
        u, v, w = outlook.std[0]
        assert v == pytest.approx(one / np.sqrt(2), rel=0.15)
        sine = np.sin(np.radians(outlook.angle_deg))
        # w = (x_right - cos x_left) / sin of equal errors
        assert w == pytest.approx(one * np.sqrt(2 - sine**2) / sine, rel=0.15)
        assert u == pytest.approx(one, rel=0.2)
        assert (outlook.seen == 1).all()
    assert outlooks[1].shape_std[2] < 0.6 * outlooks[0].shape_std[2]
    below = stereo_outlooks(made, SecondCamera(angle_deg=20.0, azimuth_deg=90.0), ())[0].std[0]
    assert below[[1, 0, 2]] == pytest.approx(outlooks[0].std[0], rel=0.15)
