"""The sensor: noise as stated, saturation, Bayer phases, crosstalk from spectra, calibration captures."""

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.settings import BAYER_PATTERNS
from rgbmidic.tools.lab.virtual import (
    Camera,
    Led,
    Light,
    Sensitivities,
    expose,
    paper_scene,
    record,
    render,
    sphere_scene,
)
from rgbmidic.tools.lab.virtual.dataset import dark_frames, single_light_frames
from rgbmidic.tools.scene.camera import mosaic_samples
from rgbmidic.tools.scene.spectra import HALF_MAXIMUM, spectral_response

LIGHTS = tuple(Light(name=name, position=(0.0, 0.0, 0.0)) for name in ("red", "green", "blue"))
CROSSTALK = np.array([[1, 0.10, 0.02], [0.14, 1, 0.16], [0.03, 0.12, 1]])


def uniform(level, shape=(300, 300), **settings):
    camera = Camera(shape=shape, kind="monochrome", **settings)
    frame = record(np.full((1, *shape), level, dtype=np.float32), camera, LIGHTS[:1], seed=3)
    return camera, frame.values[0].astype(float)


@pytest.mark.parametrize("level", [0.0, 100.0, 1000.0, 3000.0])
@pytest.mark.parametrize(("gain", "read_noise"), [(4.0, 12.0), (0.5, 3.0), (20.0, 40.0)])
def test_noise_follows_gain_and_read_noise(level, gain, read_noise):
    camera, values = uniform(level, gain=gain, read_noise=read_noise)
    rounding = 1 / 12
    assert values.mean() - 64 == pytest.approx(
        level, abs=5 * np.sqrt(camera.noise.variance(level) / values.size) + 1e-3
    )
    assert values.var() == pytest.approx(float(camera.noise.variance(np.array(level))) + rounding, rel=0.03)
    neighbours = np.corrcoef(values[:, 1:].ravel(), values[:, :-1].ravel())[0, 1]
    assert abs(neighbours) < 0.015


def test_saturation_clips_at_the_white_level():
    for bits in (8, 12, 16):
        camera, values = uniform(1.5 * 2**bits, bits=bits, black_level=16)
        assert (values == 2**bits - 1).all()
        assert camera.full_scale == 2**bits - 17


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_every_bayer_phase_samples_its_channel(cfa):
    camera = Camera(shape=(6, 8), cfa=cfa, crosstalk=CROSSTALK, read_noise=0.0, gain=1e8)
    images = np.random.default_rng(0).uniform(100, 2000, (3, 6, 8)).astype(np.float32)
    mosaic = record(images, camera, LIGHTS, seed=0)
    assert isinstance(mosaic, Mosaic)
    channels = np.einsum("cl,lyx->cyx", CROSSTALK, images)
    expected = np.take_along_axis(channels, np.tile(cfa_channels(cfa), (3, 4))[None], axis=0)[0]
    assert np.abs(mosaic.values - 64 - expected).max() <= 0.6
    assert mosaic.cfa == cfa


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_the_two_greens_differ_as_stated(cfa):
    """Each sample is that of its row of the true crosstalk's four sites."""
    difference = (-0.018, 0.012, -0.006)
    camera = Camera(shape=(6, 8), cfa=cfa, crosstalk=CROSSTALK, green_difference=difference, read_noise=0.0, gain=1e8)
    images = np.random.default_rng(0).uniform(100, 2000, (3, 6, 8)).astype(np.float32)
    values = record(images, camera, LIGHTS, seed=0).values - 64.0
    sites = np.einsum("cl,lyx->cyx", camera.true_crosstalk(LIGHTS).sites, images)
    for row, column in np.ndindex(2, 2):
        name = cfa[2 * row + column]
        site = {"R": 0, "G": 1 if "R" in cfa[2 * row : 2 * row + 2] else 2, "B": 3}[name]
        place = np.s_[row::2, column::2]
        assert np.abs(values[place] - sites[site][place]).max() <= 0.6


@pytest.mark.parametrize("difference", [(0.1,), (0.3, 0.0, 0.0)])
def test_a_difference_of_the_greens_is_of_what_they_see(difference):
    camera = Camera(shape=(6, 8), crosstalk=CROSSTALK, green_difference=difference)
    with pytest.raises(InputError, match=r"green_difference has one number per light \(red, green, blue\)"):
        camera.true_crosstalk(LIGHTS)


def test_three_ccd_has_every_channel_and_lights_can_be_switched():
    camera = Camera(shape=(4, 4), kind="rgb", crosstalk=CROSSTALK, read_noise=0.0, gain=1e8)
    images = np.ones((3, 4, 4), dtype=np.float32) * np.array([1000, 2000, 500], dtype=np.float32)[:, None, None]
    frame = record(images, camera, LIGHTS, seed=0)
    assert isinstance(frame, ChannelFrame)
    assert np.abs(frame.values[:, 0, 0] - 64 - CROSSTALK @ [1000, 2000, 500]).max() <= 0.6
    green = record(images, camera, LIGHTS, seed=0, shining=("green",))
    assert np.abs(green.values[:, 0, 0] - 64 - CROSSTALK[:, 1] * 2000).max() <= 0.6
    assert np.abs(record(images, camera, LIGHTS, seed=0, shining=()).values - 64.0).max() <= 1
    with pytest.raises(InputError, match="infrared"):
        record(images, camera, LIGHTS, seed=0, shining=("infrared",))


def test_seed_decides_the_noise():
    scene = sphere_scene(size=24, samples=2)
    images = render(scene)
    a, b, c = (record(images, scene.camera, scene.lights, seed=seed).values for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_crosstalk_from_spectra_is_the_sum_over_wavelengths():
    wavelengths = np.arange(400.0, 701, 5)
    rows = [np.exp(-(((wavelengths - centre) / 40) ** 2)) for centre in (610, 540, 460)]
    sensitivities = Sensitivities(wavelengths=wavelengths, values=np.array(rows))
    leds = (Led(centre=630, width=18), Led(centre=525, width=30), Led(centre=465, width=20))
    response = spectral_response(sensitivities, leds)
    for light, led in enumerate(leds):
        power = led.power(wavelengths)
        assert power.sum() == pytest.approx(1)
        assert wavelengths[power.argmax()] == led.centre
        assert response[:, light] == pytest.approx([(row * power).sum() for row in rows])
    lights = tuple(replace(light, spectrum=led) for light, led in zip(LIGHTS, leds, strict=True))
    camera = Camera(shape=(4, 4), sensitivities=sensitivities)
    matrix = camera.true_crosstalk(lights).matrix
    assert np.allclose(matrix.max(axis=0), 1)
    assert matrix.argmax(axis=0).tolist() == [0, 1, 2]
    assert camera.response(lights).max() == 1
    with pytest.raises(InputError, match="spectrum"):
        camera.response(LIGHTS)


def test_camera_files_and_colour_science(real_data):
    folder = real_data("camera_sensitivities")
    leds = (Led(centre=630, width=18), Led(centre=525, width=30), Led(centre=465, width=20))
    for file in sorted(folder.glob("*.json")):
        response = spectral_response(Sensitivities.read(file), leds)
        assert response.argmax(axis=0).tolist() == [0, 1, 2], file.name
    spectra = real_data("led_and_camera_spectra") / "colour_science_0.4.7_spectra.csv"
    table = np.genfromtxt(spectra, delimiter=",", skip_header=1)
    blue = Led(centre=465, width=HALF_MAXIMUM * 20).power(table[:, 0])
    assert np.allclose(blue / blue.max(), table[:, 7] / table[:, 7].max(), atol=1e-4)
    nikon = Sensitivities.from_colour("Nikon 5100 (NPL)")
    assert np.allclose(np.interp(table[:, 0], nikon.wavelengths, nikon.values[1]), table[:, 11], atol=2e-3)


@pytest.mark.parametrize("text", ["", "nonsense", "nm,R,G,B\n400,1,2\n", "nm,R,G,B\n400,1,2,3\n410,1,2,3\n430,1,2,3\n"])
def test_damaged_sensitivities_are_named_errors(tmp_path, text):
    for name in ("camera.csv", "camera.json"):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError):
            Sensitivities.read(tmp_path / name)


def test_calibration_captures_show_one_light_each():
    scene = sphere_scene(size=32, samples=2)
    frames = single_light_frames(scene, count=2, seed=1)
    assert list(frames) == ["red", "green", "blue"]
    for index, light in enumerate(frames):
        half, full = (frame.values.astype(float) - 64 for frame in frames[light])
        assert full.mean() == pytest.approx(2 * half.mean(), rel=0.02)
        assert full.max() < 4031
        means = [full[0::2, 0::2].mean(), full[0::2, 1::2].mean(), full[1::2, 1::2].mean()]
        ratio = np.array(means) / max(means)
        assert ratio == pytest.approx(CROSSTALK[:, index], abs=0.03)
    dark = dark_frames(scene, count=16, seed=2)
    assert np.mean([frame.values for frame in dark]) == pytest.approx(64, abs=0.2)
    assert np.std([frame.values for frame in dark]) == pytest.approx(np.hypot(3, 12**-0.5), rel=0.03)


def test_exposure_brings_the_brightest_pixel_just_below_saturation():
    scene = expose(sphere_scene(size=48, samples=3), level=0.9)
    channels = np.einsum("cl,lyx->cyx", scene.camera.mixing(scene.lights), render(scene))
    assert channels.max() == pytest.approx(0.9 * scene.camera.full_scale, rel=1e-4)
    paper = paper_scene(size=32, samples=3)
    assert render(paper).max() == pytest.approx(0.97 * paper.camera.full_scale, rel=1e-4)
    assert paper.camera.kind == "monochrome"


@pytest.mark.parametrize(
    "wrong",
    [
        {"shape": (1, 4)},
        {"shape": (4, 4), "kind": "infrared"},
        {"shape": (4, 4), "cfa": "RGBG"},
        {"shape": (4, 4), "bits": 7},
        {"shape": (4, 4), "black_level": 5000},
        {"shape": (4, 4), "gain": 0.0},
        {"shape": (4, 4), "samples": 0},
        {"shape": (4, 4), "lens_blur": -1.0},
    ],
)
def test_impossible_cameras_are_refused(wrong):
    with pytest.raises(InputError):
        Camera(**wrong)


def test_scene_checks_lights_and_crosstalk():
    scene = sphere_scene(size=8)
    with pytest.raises(InputError, match="crosstalk"):
        replace(scene, lights=scene.lights[:2])
    with pytest.raises(InputError, match="own name"):
        replace(scene, lights=(scene.lights[0],) * 3)
    with pytest.raises(InputError, match="violet"):
        scene.light("violet")


@pytest.mark.parametrize("cfa", BAYER_PATTERNS)
def test_each_site_of_a_mosaic_takes_its_own_plane(cfa):
    planes = np.broadcast_to(np.arange(4.0)[:, None, None], (4, 5, 6))
    samples, colours = mosaic_samples(planes, cfa), mosaic_samples(planes[:3], cfa)
    for row in range(5):
        greens = 1 if 0 in samples[row] else 2  # in a row with red, or with blue
        np.testing.assert_array_equal(samples[row], np.choose(colours[row].astype(int), [0, greens, 3]))
