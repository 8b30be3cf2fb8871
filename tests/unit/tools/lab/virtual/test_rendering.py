"""The renderer: naive twin, energy, sampling, determinism, and the erratic reflection of the paper's Fig. 9."""

from dataclasses import replace

import numpy as np
import pytest
from naive_render import paint_at, trace

from rgbmidic._kernels.threads import set_threads, threads
from rgbmidic.errors import InputError
from rgbmidic.tools.lab.virtual import (
    AffineField,
    Camera,
    Cylinder,
    Finish,
    Light,
    Plate,
    Polarisers,
    Scene,
    Sphere,
    State,
    Surface,
    plate_scene,
    render,
    sphere_scene,
    strained_plate,
    truth,
    turned,
)
from rgbmidic.tools.lab.virtual.dataset import true_calibration
from rgbmidic.tools.lab.virtual.rendering import _aperture, paint, rays_per_pixel
from rgbmidic.tools.scene.camera import NOMINAL_DISTANCE, three_lights

FULL = 4095 - 64
FRONT = (0.0, 0.0, 600.0)


@pytest.mark.parametrize("body", [Plate(), Sphere(), Cylinder()])
def test_paint_kernel_equals_its_naive_twin(body):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-5, 5, (40, 2)), np.zeros(40)])
    if not isinstance(body, Plate):
        radial = rng.normal(size=(40, 3)) * [1, isinstance(body, Sphere), 1]
        points = body.radius * radial / np.linalg.norm(radial, axis=1)[:, None] + [0, 3 * isinstance(body, Cylinder), 0]
    surface = Surface(dome=0.004, black=Finish(albedo=0.1, spacing=0.04, slope_deg=3.0))
    cover, height, slope = surface.sample(points, body.parameters())
    paint, counts, seed = surface.parameters()
    for p, *found in zip(points, cover, height, slope, strict=True):
        expected = paint_at(p, body.parameters(), paint, counts, int(seed))
        for ours, theirs in zip(found, expected, strict=True):
            assert np.allclose(ours, theirs, rtol=1e-3, atol=2e-5)


@pytest.mark.parametrize("body", ["sphere", "plate", "cylinder"])
def test_tracing_equals_its_naive_twin(body):
    """Edges of the body, a tilt, a lens error and a reflection included."""
    bodies = {
        "sphere": Sphere(radius=0.15, centre=(0.02, 0.0, 600.15)),
        "plate": Plate(width=0.18, height=0.14, tilt_deg=(8.0, 3.0)),
        "cylinder": Cylinder(radius=0.08, length=0.2, centre=(0.0, 0.0, 600.08), tilt_deg=20.0),
    }
    near = tuple(
        replace(light, magnification=1e-3, shift=(0.1, -0.2)).aimed(FRONT)
        for light in (Light(name="a", position=(30.0, 10.0, 0.0)), Light(name="b", position=(300.0, 0.0, 500.0)))
    )
    camera = Camera(shape=(4, 5), samples=2, lens_blur=0.2)
    scene = Scene(body=bodies[body], lights=near, camera=camera, surface=Surface(droplet=0.1, softness=0.01))
    field = AffineField(gradient=((0.02, 0.01), (0.0, -0.01)), offset=(0.01, 0.0)) if body == "plate" else None
    state = State(angle_deg=5.0, translation=(0.01, 0.02, 0.0), displacement=field)
    turn, origin = state.pose(scene.body)
    frame = np.concatenate([-turn.T @ origin, turn.T.ravel()])
    lights = [[*(turn.T @ (np.array(li.position) - origin)), li.power * NOMINAL_DISTANCE**2] for li in near]
    lens = camera.lenses(near)[0]
    assert np.allclose(lens, [1.001 * camera.focal_px, 2.1, 1.3])
    pad, taps = _aperture(0.2, 2)
    affine = field.inverse() if field else np.array([1.0, 0, 0, 1, 0, 0])
    expected = trace(
        camera.shape, 2, taps, pad, lens, frame, scene.body.parameters(), affine, np.array(lights),
        scene.surface.parameters(),
    )  # fmt: skip
    image = render(scene, state) / (camera.full_scale * camera.exposure)
    assert expected.max() > 0.1
    assert (expected.reshape(2, -1).min(axis=1) < 0.02).any()
    assert np.abs(image - expected).max() < 2e-4


def white_plate(gloss=1.5, slope_deg=6.0, shape=(12, 12), **light):
    lamp = Light(name="lamp", position=(0.0, -100.0, 0.0), **light)
    finish = Finish(albedo=0.8, gloss=gloss, slope_deg=slope_deg)
    return Scene(
        body=Plate(width=1e4, height=1e4),
        lights=(lamp.aimed(FRONT),),
        camera=Camera(shape=shape, kind="monochrome", samples=6),
        surface=Surface(white=finish, black=finish, coverage=0.0),
    )


def test_ideal_white_facing_the_lamp_gives_the_stated_exposure():
    scene = white_plate(gloss=0.0, slope_deg=0.0)
    scene = scene.with_light(Light(name="lamp", position=(0.0, 0.0, 0.0)))
    assert np.allclose(render(scene)[0], 0.8 * 0.5 * FULL, rtol=1e-5)
    far = scene.with_light(Light(name="lamp", position=(0.0, 0.0, -600.0)))
    assert np.allclose(render(far)[0], 0.8 * 0.5 * FULL / 4, rtol=1e-5)


def test_lambert_cosine():
    scene = white_plate(gloss=0.0, slope_deg=0.0)
    lamp = Light(name="lamp", position=(0.0, 0.0, 0.0))
    for angle in (30, 60, 80):
        image = render(scene.with_light(lamp.turned(angle, FRONT)))
        assert np.allclose(image, 0.4 * FULL * np.cos(np.radians(angle)), rtol=2e-3)
    assert not render(scene.with_light(lamp.turned(100, FRONT))).any()


@pytest.mark.parametrize(("gloss", "slope"), [(1.5, 6.0), (3.0, 0.0), (5.0, 12.0)])
def test_no_light_leaks(gloss, slope):
    """By reciprocity the sum over all directions of incidence of what reaches the camera is the share reflected.

    reflectance = integral of (radiance / that of an ideal white) d(solid angle) / pi; in closed form
    albedo + 8 gloss lobe².
    """
    scene = white_plate(gloss=gloss, slope_deg=slope, shape=(6, 6))
    polar, azimuth = (a.ravel() for a in np.meshgrid((np.arange(45) + 0.5) * np.pi / 90, np.arange(8) * np.pi / 4))
    ways = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), -np.cos(polar)], axis=1)
    lamps = tuple(
        Light(name=str(i), position=tuple(position)).aimed(FRONT) for i, position in enumerate(FRONT + 1e5 * ways)
    )
    levels = render(replace(scene, lights=lamps)).mean(axis=(1, 2)) / (0.5 * FULL)
    total = (levels * np.sin(polar)).sum() * (np.pi / 90) * (np.pi / 4) / np.pi
    assert total == pytest.approx(scene.surface.white.reflectance, rel=0.03)
    assert total < 1


def test_light_adds_up_and_is_linear_in_power():
    scene = sphere_scene(size=24, samples=3)
    together = render(scene)
    for j, light in enumerate(scene.lights):
        alone = replace(scene, lights=(light,), camera=replace(scene.camera, crosstalk=np.eye(3)[:, :1]))
        assert np.allclose(render(alone)[0], together[j], rtol=1e-6)
        brighter = scene.with_light(replace(light, power=3 * light.power))
        assert np.allclose(render(brighter)[j], 3 * together[j], rtol=1e-5)


@pytest.mark.parametrize("lamps", [1, 3])
def test_crossed_polarisers_dim_the_diffuse_light_and_take_the_glare_off(lamps):
    scene = sphere_scene(size=32, samples=3)
    scene = replace(scene, lights=scene.lights[:lamps], camera=replace(scene.camera, crosstalk=np.eye(3)[:, :lamps]))
    white, black = (replace(finish, gloss=0.0) for finish in (scene.surface.white, scene.surface.black))
    mat = render(replace(scene, surface=replace(scene.surface, white=white, black=black)))
    glare = render(scene) - mat
    for polarisers in (Polarisers(), Polarisers(extinction=0.2, transmission=0.1, depolarised=0.5)):
        expected = polarisers.transmission * (mat + polarisers.glare * glare)
        assert np.allclose(render(scene.polarised(polarisers)), expected, rtol=1e-5)


@pytest.mark.parametrize(("along", "across"), [(1.0, 0.0), (0.8, 0.004), (0.7, 0.2), (0.6, 0.6)])
@pytest.mark.parametrize("lost", [0.0, 0.01, 1.0])
def test_polarisers_pass_what_their_mueller_matrices_pass(along, across, lost):
    """Real polarisers before an unpolarised lamp and the camera; `across` and `along` are transmittances of one."""

    def polariser(sign):
        even, odd, rest = (along + across) / 2, sign * (along - across) / 2, np.sqrt(along * across)
        return np.array([[even, odd, 0], [odd, even, 0], [0, 0, rest]])

    def passed(surface, sign):
        return (polariser(sign) @ surface @ polariser(1) @ [1, 0, 0])[0]

    keeps, loses = np.eye(3), np.diag([1.0, 0, 0])
    polarisers = Polarisers(
        extinction=passed(keeps, -1) / passed(keeps, 1), transmission=passed(loses, -1), depolarised=lost
    )
    left = (1 - lost) * passed(keeps, -1) + lost * passed(loses, -1)
    assert polarisers.transmission * polarisers.glare == pytest.approx(left, rel=1e-12)


def test_the_number_of_threads_does_not_change_a_bit():
    scene = sphere_scene(size=40, samples=4)
    available = threads()
    two = render(scene, turned(3.0))
    set_threads(1)
    try:
        one = render(scene, turned(3.0))
    finally:
        set_threads(available)
    assert np.array_equal(one, two)


@pytest.mark.parametrize(
    ("scene", "limit"),
    [
        (plate_scene(size=48, lens_blur=0.45), 0.1),
        (plate_scene(size=48, gloss=1.5, glare="green"), 0.6),
        (sphere_scene(size=48, droplet=0.16), 0.6),
        (replace(plate_scene(size=48, glare="green"), surface=paint(gloss=3.0, lobe_deg=2.0)), 0.8),
    ],
    ids=["mat", "glare", "sphere", "sharp"],
)
def test_sampling_pattern_leaves_no_trace(scene, limit):
    """The error of the default sampling is below the shot noise, and has no peak in its spectrum."""
    image = render(scene)
    fine = render(replace(scene, camera=replace(scene.camera, samples=int(1.7 * rays_per_pixel(scene)))))
    shot = np.sqrt(fine.mean() / scene.camera.gain)
    for error in image - fine:
        assert error.std() < limit * shot
        power = np.abs(np.fft.fft2(error - error.mean())) ** 2
        # white noise of 2304 samples reaches about 8 (exponential law), shaped by the lens about 20; a beat of the
        # sampling pattern with itself would put most of the power, a ratio of hundreds, into one line
        assert power.max() < 40 * power.mean()


def test_image_holds_nothing_beyond_the_lens():
    """Aperture and blur are applied before sampling: halving the pixel does not uncover detail the lens cannot pass."""
    coarse = plate_scene(size=32, tilt_deg=(0.0, 0.0), lens_blur=1.5)
    fine = plate_scene(size=64, tilt_deg=(0.0, 0.0), lens_blur=3.0, focal_px=2 * 600 / 0.055)
    a, b = render(coarse)[0], render(fine)[0]
    shrunk = b.reshape(32, 2, 32, 2).mean(axis=(1, 3))
    assert np.abs(a - shrunk)[4:-4, 4:-4].max() < 0.02 * a.mean()


def test_a_shift_by_whole_pixels_moves_the_image_by_whole_pixels():
    scene = plate_scene(size=40, tilt_deg=(0.0, 0.0), gloss=0.0)
    still = render(scene)[0]
    moved = render(scene, State(translation=(3 * 0.055, 0.0, 0.0)))[0]
    ratio = moved[:, 3:] / still[:, :-3]
    assert np.abs(ratio - 1).max() < 0.01  # only the direction of the light changes


def test_general_field_renders_what_the_affine_one_renders():
    scene = plate_scene(size=24, samples=3)
    affine = strained_plate(strain=0.01)
    general = State(displacement=lambda x, y: affine.displacement(x, y))
    assert np.abs(render(scene, affine) - render(scene, general)).max() < 0.5
    with pytest.raises(InputError, match="inverted"):
        render(scene, State(displacement=lambda x, y: (np.sin(300 * x), 0 * y)))


def test_reflection_is_erratic_inside_the_lobe_and_smooth_outside():
    """Paper, Fig. 9: neighbouring pixels answer differently to one degree of the lamp, but only in the reflection."""
    scene = plate_scene(size=24, tilt_deg=(15.0, 0.0), gloss=1.5, kind="monochrome", crosstalk=None)
    shiny = Finish(albedo=0.8, gloss=5.0, lobe_deg=2.0)
    scene = replace(
        scene,
        lights=(Light(name="lamp", position=scene.mirror_position(550.0)).aimed(FRONT),),
        surface=Surface(white=shiny, black=replace(shiny, albedo=0.1)),
    )

    def change(angle):
        """Spread over the pixels of the relative change for one degree of the lamp."""
        before, after = (render(scene.with_light(scene.lights[0].turned(a, FRONT)))[0] for a in (angle, angle + 1))
        return (after / before).std(), before.mean()

    peak, flank, outside = change(0.0), change(-20.0), change(45.0)
    assert outside[0] < 0.001
    assert peak[0] > 0.005
    assert flank[0] > 0.02
    assert peak[1] > 2 * outside[1]


def test_lateral_colour_is_so_many_px_at_the_corner_from_light_to_light():
    scene = plate_scene(size=60, lateral_colour=0.5)
    registration = scene.camera.true_registration(scene.lights)
    corners = np.array([[0.0, 0.0], [59.0, 0.0], [59.0, 59.0], [29.5, 29.5]])
    outwards = (corners - 29.5) / np.hypot(29.5, 29.5)
    for light in range(3):
        assert np.allclose(registration.displacement(corners)[light], 0.5 * light * outwards, atol=1e-12)
    stored = true_calibration(scene).registration
    assert stored is not None
    assert np.array_equal(stored.parameters, registration.parameters)
    grey = replace(scene.camera, kind="monochrome", crosstalk=None)
    assert grey.true_registration(scene.lights) is None
    own = (replace(scene.lights[0], magnification=0.01), *scene.lights[1:])
    assert scene.camera.true_registration(own).parameters[1, 3] == pytest.approx((1 + 0.5 / 41.72) / 1.01 - 1, abs=1e-6)


def test_truth_and_pixel_are_of_the_first_lights_image():
    """A magnification of the first light's image is that of the camera: rendered, followed and scaled alike."""
    scene = replace(sphere_scene(size=40, samples=3, kind="monochrome"), lights=three_lights()[:1])
    longer = replace(scene, camera=replace(scene.camera, focal_px=1.01 * scene.camera.focal_px))
    zoomed = scene.with_light(replace(scene.lights[0], magnification=0.01))
    assert zoomed.pixel == pytest.approx(longer.pixel)
    assert np.allclose(truth(zoomed, turned(1.0)), truth(longer, turned(1.0)), atol=1e-9)
    assert np.allclose(render(zoomed), render(longer), rtol=1e-5)
    shifted = scene.with_light(replace(scene.lights[0], shift=(2.0, -1.0)))
    assert np.allclose(truth(shifted, turned(1.0))[:, :-1, 2:], truth(scene, turned(1.0))[:, 1:, :-2], atol=1e-9)


def test_lateral_aberration_moves_each_colour_along_the_radius():
    plain = sphere_scene(size=96, gloss=0.0, samples=4, focal_px=2000.0, lens_blur=1.0)
    shifted = replace(
        plain, lights=tuple(replace(li, magnification=m) for li, m in zip(plain.lights, (-0.01, 0, 0.01), strict=True))
    )
    a, b = render(plain), render(shifted)
    assert np.array_equal(a[1], b[1])
    strip = slice(40, 56)
    for j, expected in ((0, -0.4), (2, 0.4)):
        f, g = a[j, strip, 80:96], b[j, strip, 80:96]
        slope = np.gradient(a[j], axis=1)[strip, 80:96]
        moved = -((g - f) * slope).sum() / (slope**2).sum()
        assert moved == pytest.approx(expected, rel=0.35)


def test_exposure_time_blurs_along_the_motion():
    scene = plate_scene(size=32, tilt_deg=(0.0, 0.0), samples=4)
    moving = State(velocity=(4 * 0.055 / 0.001, 0.0, 0.0))
    blurred = render(replace(scene, camera=replace(scene.camera, exposure_time=0.001)), moving)[0]
    sharp = render(scene, moving)[0]
    assert np.array_equal(sharp, render(scene)[0])
    positions = [render(scene, State(translation=(x * 0.055, 0.0, 0.0)))[0] for x in np.linspace(-2, 2, 41)]
    assert np.abs(blurred - np.mean(positions, axis=0)).max() < 0.03 * sharp.mean()
    assert np.diff(blurred, axis=1).std() < 0.8 * np.diff(blurred, axis=0).std()
