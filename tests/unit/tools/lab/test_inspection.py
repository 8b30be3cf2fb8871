"""What `rgbmidic inspect` says of frames whose speckle, noise, exposure and reflections are known."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from colour_scenes import CROSSTALK, FULL_SCALE, NOISE, A, mosaic_of, sparkle, speckle
from real_files import CROPS
from scipy.ndimage import shift
from small_tests import REGION, colour_test, grey_frame

import rgbmidic
from rgbmidic.cli import app as cli
from rgbmidic.cli.command import execute
from rgbmidic.errors import ConfigurationError, FrameError, InputError, RegionError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import CrosstalkField
from rgbmidic.illumination.images import Registration, frame_geometry
from rgbmidic.illumination.linear import NoiseModel, linearise
from rgbmidic.illumination.separation import separate
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import correlate
from rgbmidic.settings import FrameSettings
from rgbmidic.tools.lab.inspection import Inspection, inspect_files, inspect_frame
from rgbmidic.tools.lab.inspection.channels import Channel, estimate_noise, frame_channels, speckle_texture
from rgbmidic.tools.lab.inspection.prediction import gaussian_field
from rgbmidic.tools.lab.inspection.report import inspection_document, write_inspection
from rgbmidic.tools.lab.inspection.results import _speckle_checks
from rgbmidic.tools.scene.forecast import expected_std, nodal_variance_factor

Run = Callable[..., tuple[int, str, str]]
SHAPE = (192, 192)
BLACK = 64
CALIBRATION = Calibration(crosstalk=CROSSTALK, noise=NOISE)


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run the command in this process: exit status, standard output, standard error."""

    def run(*arguments: object) -> tuple[int, str, str]:
        status = execute(cli.app, [str(argument) for argument in arguments], debug=False)
        return status, *capsys.readouterr()

    return run


def raw(lights, *, cfa="RGGB", seed=0, noise=NOISE) -> Mosaic:
    """The frame as a camera stores it: whole grey levels over a black level."""
    values = mosaic_of(lights, cfa=cfa, seed=seed, noise=noise).values
    stored = np.clip(np.rint(values) + BLACK, 0, BLACK + FULL_SCALE).astype(np.uint16)
    return Mosaic(values=stored, cfa=cfa, black_level=np.array(BLACK), white_level=BLACK + FULL_SCALE)


@cache
def mat_lights(diameter=4.2, seed=0, level=1500.0, shape=SHAPE):
    return np.stack([level * speckle(shape, diameter=diameter, seed=seed)] * 3).astype(np.float32)


@cache
def glaring_lights():
    """Green reflects everywhere."""
    lights = mat_lights().copy()
    lights[1] += sparkle(SHAPE, 1200, 5)
    return lights


@cache
def mat() -> Inspection:
    return inspect_frame(raw(mat_lights()), calibration=CALIBRATION)


@cache
def glaring() -> Inspection:
    return inspect_frame(raw(glaring_lights()), calibration=CALIBRATION)


def codes(seen: Inspection) -> set[str]:
    return {finding.name for finding in seen.findings}


def test_a_good_frame_has_no_warnings_and_its_figures_are_those_it_was_made_with():
    inspection = mat()
    assert codes(inspection) == set()
    assert (inspection.kind, [one.name for one in inspection.channels]) == ("bayer", ["R", "G", "B"])
    sampled = mosaic_of(mat_lights(), noise=None)
    for one, channel in zip(inspection.channels, frame_channels([sampled]), strict=True):
        mean = np.nanmean(channel.values)
        assert one.mean == pytest.approx(mean / FULL_SCALE, rel=0.01)
        assert one.low < one.mean < one.high
        assert one.noise_dn == pytest.approx(np.sqrt(NOISE.variance(mean)), rel=0.01)
        assert one.saturated == 0
    for light in inspection.lights:
        assert light.mean == pytest.approx(mat_lights()[0].mean() / FULL_SCALE, rel=0.01)
        assert light.reflecting < 0.02
        assert light.valid == 1


def test_reflection_of_one_light_is_told():
    shares = [light.reflecting for light in glaring().lights]
    assert shares[1] > 0.95
    assert max(shares[0], shares[2]) < 0.05
    assert glaring().lights[1].contrast < 0.6 * glaring().lights[0].contrast
    assert codes(glaring()) == set()


@pytest.mark.parametrize("diameter", [3.0, 4.2, 6.0])
def test_speckle_size_of_a_coarse_lattice_is_that_of_the_full_image(diameter):
    full = mat_lights(diameter, seed=2)[0]
    nowhere, inside = np.zeros(SHAPE, bool), np.ones(SHAPE, bool)
    whole = Channel(name="M", values=full, saturated=nowhere, step=1)
    true = speckle_texture(whole, inside, NoiseModel(gain=np.inf, read_noise=0.0)).diameter
    for channel in frame_channels([mosaic_of(mat_lights(diameter, seed=2))]):
        assert speckle_texture(channel, inside, NOISE).diameter == pytest.approx(true, rel=0.06)
        assert speckle_texture(channel, inside, None).diameter == pytest.approx(true, rel=0.2)


def test_speckle_size_of_gaussian_textures_is_known_in_closed_form():
    for sigma in (1.2, 2.5):
        field = gaussian_field(TextureModel(weights=(1.0,), widths=(sigma,)), (256, 256), np.random.default_rng(1))
        channel = Channel(name="M", values=500 + 50 * field, saturated=np.zeros((256, 256), bool), step=1)
        fitted = speckle_texture(channel, np.ones((256, 256), bool), NoiseModel(gain=np.inf, read_noise=0.0))
        assert fitted.diameter == pytest.approx(2 * np.sqrt(2 * np.log(2)) * sigma, rel=0.08)


def test_a_random_texture_has_the_spectrum_it_is_drawn_with():
    texture = TextureModel.of_speckle(6.0)
    fields = [gaussian_field(texture, (128, 128), np.random.default_rng(seed)) for seed in range(20)]
    power = np.mean([np.abs(np.fft.fft2(field)) ** 2 for field in fields], axis=0) / 128**2
    radius = np.hypot(np.fft.fftfreq(128)[:, None], np.fft.fftfreq(128))
    for low, high in ((0.0, 0.05), (0.05, 0.1), (0.1, 0.15)):
        ring = (radius > low) & (radius <= high)
        assert power[ring].mean() == pytest.approx(texture.spectrum(radius[ring]).mean(), rel=0.05)


def test_inner_nodes_of_an_even_field_follow_the_closed_form_of_plan():
    """The mesh's own equations against the sum over wave numbers that `rgbmidic plan` uses."""
    side, information, score = 20.0, 0.03, 7e-6
    mesh = Tri3Mesh.from_region(Region.from_rectangle((0, 0, 240, 240), (241, 241)), side)
    everywhere = np.ones(len(mesh.elements))
    (std,) = expected_std(mesh, information * everywhere, score * everywhere)
    inner = ((mesh.nodes > 60) & (mesh.nodes < 180)).all(axis=1)
    closed = np.sqrt(nodal_variance_factor() * score) / (side * information)
    assert np.sqrt(np.mean(std[inner] ** 2)) == pytest.approx(closed, rel=0.01)
    assert std[~inner].max() > 1.4 * closed
    blind = np.where((mesh.nodes[mesh.elements].mean(axis=1)[:, 0] < 100), 0.0, information)
    assert np.isnan(expected_std(mesh, blind, score * everywhere)).mean() == pytest.approx(5 / 13, abs=0.01)


def test_noise_is_estimated_from_a_flat_or_coarsely_painted_frame():
    inside = np.ones(SHAPE, bool)
    flat = np.full((3, *SHAPE), 800.0, dtype=np.float32)
    for lights, limits in ((flat, (0.8, 1.2)), (mat_lights(6.0), (0.8, 1.8))):
        channels = frame_channels([mosaic_of(lights)])
        for channel, found in zip(channels, estimate_noise(channels, inside), strict=True):
            true = np.sqrt(NOISE.variance(np.nanmean(channel.values)))
            assert limits[0] < found / true < limits[1]


@pytest.mark.parametrize(("glare", "size"), [(False, 25), (True, 25), (False, 16)])
def test_predicted_uncertainty_is_the_scatter_of_repeated_frames(glare, size):
    """Frames of the paint moved by whole and half pixels of different phase; the truth is known."""
    lights = glaring_lights() if glare else mat_lights()
    inspection = inspect_frame(raw(lights), calibration=CALIBRATION, element_size=size)
    fine = _moved_lights(glare)
    errors = []
    first = _separated(fine((0.0, 0.0)), 10)
    for seed, motion in enumerate(((1.5, 0.5), (-0.5, 1.25), (1.0, -1.0), (0.25, 2.5))):
        second = _separated(fine(motion), 20 + seed)
        solution = correlate(first, second, initial=motion, element_size=size)
        inner = ((solution.nodes > 20) & (solution.nodes < SHAPE[0] - 21)).all(axis=1)
        errors.append((solution.displacement - motion)[inner])
    observed = np.sqrt(np.nanmean((np.array(errors) - np.nanmean(errors, axis=1, keepdims=True)) ** 2))
    inner = ((inspection.mesh.nodes > 20) & (inspection.mesh.nodes < SHAPE[0] - 21)).all(axis=1)
    predicted = np.sqrt(np.nanmean(inspection.prediction.std[inner] ** 2))
    assert 0.75 < predicted / observed < 1.25
    assert 0 < np.nanmedian(inspection.prediction.noise) <= 1.1 * np.nanmedian(inspection.prediction.std)
    assert min(light.std_alone.median for light in inspection.lights) > np.nanmedian(inspection.prediction.std)


def _moved_lights(glare):
    """Lights of a paint at any place, and a reflection that stays in the same place on it."""
    from scipy.ndimage import fourier_shift

    base = glaring_lights() if glare else mat_lights()
    wide = np.pad(base, ((0, 0), (32, 32), (32, 32)), mode="symmetric")
    spectra = np.fft.fft2(wide)

    def moved(motion):
        shifted = [np.fft.ifft2(fourier_shift(one, motion[::-1])).real for one in spectra]
        return np.stack(shifted)[:, 32:-32, 32:-32]

    return moved


def _separated(lights, seed):
    linear = mosaic_of(lights, seed=seed)
    return separate(linear, CROSSTALK).values


def test_more_noise_and_smaller_elements_mean_more_uncertainty():
    loud = NoiseModel(gain=1.0, read_noise=24.0)
    frame = raw(mat_lights(), noise=loud)
    noisy = inspect_frame(frame, calibration=replace(CALIBRATION, noise=loud))
    ratio = np.sqrt(loud.variance(700.0) / NOISE.variance(700.0))
    assert np.nanmedian(noisy.prediction.noise) / np.nanmedian(mat().prediction.noise) == pytest.approx(ratio, rel=0.2)
    small = inspect_frame(raw(mat_lights()), calibration=CALIBRATION, element_size=16)
    assert 1.2 < np.nanmedian(small.prediction.std) / np.nanmedian(mat().prediction.std) < 2.0


def test_only_the_region_and_its_surroundings_are_looked_at_where_they_are():
    """Registration and crosstalk that vary over the frame hold at the frame's own coordinates."""
    shape = (420, 440)
    lights = mat_lights(shape=shape)
    centre, radius = frame_geometry(shape)
    parameters = np.array([[0, 0, 0, 0, 0], [0.2, 0, 0, 2e-3, 0], [0, -0.3, 0, -1e-3, 0.0]])
    varying = np.zeros((2, 3, 3))
    varying[0, 1, 0] = 0.08
    calibration = Calibration(
        crosstalk=replace(CROSSTALK, field=CrosstalkField(order=1, coefficients=varying, shape=shape)),
        noise=NOISE,
        registration=Registration(lights=CROSSTALK.lights, parameters=parameters, centre=centre, radius=radius),
    )
    steps = []
    inspection = inspect_frame(
        raw(lights), calibration=calibration, region=(251, 231, 330, 300), progress=lambda *step: steps.append(step)
    )
    assert inspection.origin == (154, 134)
    assert inspection.images.shape == (300 + 97 - 134, 330 + 97 - 154)
    assert inspection.frame_shape == shape
    assert inspection.mesh.nodes.min(axis=0) == pytest.approx((251, 231))
    assert inspection.mesh.nodes.max(axis=0) == pytest.approx((330, 300))
    assert [done for done, _, _ in steps] == [0, 1, 2, 3]
    whole = inspect_frame(raw(lights), calibration=calibration)
    inside = np.s_[:, 231:301, 251:331]
    moved = np.s_[:, 231 - 134 : 301 - 134, 251 - 154 : 331 - 154]
    difference = inspection.images.values[moved] - whole.images.values[inside]
    # the texture is learnt from another part of the frame; half a pixel beside, it would be 30 % of the contrast
    assert np.sqrt(np.nanmean(difference**2)) < 0.02 * np.nanstd(whole.images.values[inside])


def test_the_same_frame_gives_the_same_figures():
    inspection = inspect_frame(raw(mat_lights()), calibration=CALIBRATION)
    np.testing.assert_array_equal(inspection.prediction.std, mat().prediction.std)
    assert inspection_document(inspection) == inspection_document(mat())


def test_the_expected_uncertainty_knows_where_the_lights_lie():
    shifts = np.array([[0, 0], [0.6, 0.2], [-0.4, 0.5]])
    apart = np.stack(
        [shift(light, by[::-1], order=5, mode="mirror") for light, by in zip(mat_lights(), shifts, strict=False)]
    )
    parameters = np.pad(shifts, ((0, 0), (0, 3)))
    centre, radius = frame_geometry(SHAPE)
    right, wrong = (
        replace(
            CALIBRATION,
            registration=Registration(lights=CROSSTALK.lights, parameters=p, centre=centre, radius=radius),
        )
        for p in (parameters, -parameters)
    )
    with_it, without, misled = (inspect_frame(raw(apart), calibration=one) for one in (right, CALIBRATION, wrong))
    expected, plain, worse = (np.nanmedian(seen.prediction.std) for seen in (with_it, mat(), without))
    assert codes(with_it) == set()
    assert expected == pytest.approx(plain, rel=0.15)  # lights that lie apart show as much as lights in register
    assert worse > 1.3 * expected
    for seen, words in ((without, "no registration is calibrated"), (misled, "beyond the calibrated registration")):
        (text,) = [finding.text for finding in seen.findings if finding.name == "lights apart"]
        assert words in text
        assert "coloured" not in codes(seen)


def test_what_dimming_a_lamp_gains_is_what_the_dimmed_frame_shows():
    strength = np.array([1.0, 1.0, 5.0])
    lights = mat_lights(level=400.0) * strength[:, None, None].astype(np.float32)
    inspection = inspect_frame(raw(lights), calibration=CALIBRATION)
    (text,) = [finding.text for finding in inspection.findings if finding.name == "unequal lamps"]
    assert "blue dimmed to 20%" in text
    exposure = float(re.search(r"([\d.]+) times the exposure", text)[1])
    after, before = map(float, re.search(r"([\d.]+) px instead of ([\d.]+) px", text).groups())
    dimmed = inspect_frame(raw(mat_lights(level=400.0 * exposure)), calibration=CALIBRATION)
    assert max(channel.high for channel in dimmed.channels) < 1.05 * max(
        channel.high for channel in inspection.channels
    )
    assert codes(dimmed) == set()
    assert before == pytest.approx(np.nanmedian(inspection.prediction.std), rel=0.02)
    assert after == pytest.approx(np.nanmedian(dimmed.prediction.std), rel=0.05)
    assert before > 1.2 * after
    rough = inspect_frame(raw(lights), calibration=replace(CALIBRATION, noise=None))
    assert any("noise estimated" in finding.text for finding in rough.findings if finding.name == "unequal lamps")


def _coloured():
    return np.stack([1500 * speckle(SHAPE, seed=20 + n) for n in range(3)]).astype(np.float32)


def _fine():
    return np.stack([1500 * speckle(SHAPE, diameter=1.3, blur=0.3)] * 3).astype(np.float32)


def _blind():
    lights = mat_lights().copy()
    lights[:, 60:120, 60:120] = 700
    return lights


@pytest.mark.parametrize(
    ("lights", "code"),
    [
        (_fine, "fine speckle"),
        (lambda: mat_lights(11.0), "coarse speckle"),
        (lambda: mat_lights(level=5200.0), "saturated"),
        (lambda: mat_lights(level=300.0), "dark"),
        (_coloured, "coloured"),
        (_blind, "hidden"),
    ],
)
def test_troubles_are_told(lights, code):
    inspection = inspect_frame(raw(lights()), calibration=CALIBRATION)
    assert code in codes(inspection)
    assert "lights apart" not in codes(inspection)
    assert all(finding.text for finding in inspection.findings)


@pytest.mark.parametrize(("size", "code"), [(2.0, "fine speckle"), (26.0, "coloured")])
def test_coarse_speckle_whose_colours_hardly_agree_is_not_called_too_fine(size, code):
    texture = SimpleNamespace(specific=0.2, correlation=0.74)
    seen = SimpleNamespace(texture=texture, speckle_px=size, element_size=100.0, repetition="", doubts=())
    assert [check.name for check in _speckle_checks(seen) if not check.passed] == [code]


@pytest.mark.parametrize("region", [(26, 250, 285, 800), (60, 450, 280, 640), (100, 250, 280, 450)])
def test_edges_of_a_specimen_before_a_dark_background_hide_no_texture(real_data, region):
    """The real specimen with a hole of radius 52 px, between columns 38 and 355."""
    file = real_data("dic_challenge_sample12") / "oht_cfrp_00.tiff"
    left, top = crop_origin(file)
    box = np.array(region) - (left, top, left, top)
    inspection = inspect_files([file], frame=FrameSettings(path=("f",), kind="monochrome"), region=tuple(box))
    y, x = (
        np.mgrid[: inspection.region.shape[0], : inspection.region.shape[1]]
        + np.array(inspection.origin[::-1])[:, None, None]
    )
    x, y = x + left, y + top
    empty = (np.hypot(x - 192, y - 541) < 52) | (x < 38) | (x > 354)
    inside = inspection.region
    assert (inspection.lacks_contrast != empty)[inside].mean() < 0.01
    np.testing.assert_array_equal(inspection.background[inside], inspection.lacks_contrast[inside])
    text = next((finding.text for finding in inspection.findings if finding.name == "hidden"), None)
    if empty[inside].any():
        assert "draw it inside the specimen" in text
        assert "reflects" not in text
    else:
        assert text is None
    nodes = inspection.mesh.nodes + np.array([left, top])
    hole = np.hypot(*(nodes - (192, 541)).T) < 52 - 25
    assert np.isnan(inspection.prediction.std[hole]).all()
    specimen = (np.hypot(*(nodes - (192, 541)).T) > 52) & (abs(nodes[:, 0] - 196) < 158)
    assert np.isfinite(inspection.prediction.std[specimen]).all()


def crop_origin(file):
    """Column and row of the full frame at which the real frame begins."""
    folder = file.parent
    if folder.parent != CROPS:
        return 0, 0
    return tomllib.loads((CROPS / "crops.toml").read_text(encoding="utf-8"))[folder.name]["window"][:2]


def test_three_lights_before_a_dark_background_and_with_a_dim_part():
    lights = mat_lights(level=1200.0).copy()
    lights[:, :, :48] = 90
    lights[:, 120:, 120:] *= 0.2
    lights[:, 40:80, 100:140] = 600
    inspection = inspect_frame(raw(lights), calibration=CALIBRATION)
    assert inspection.background[:, :46].mean() > 0.98
    assert inspection.background[:, 50:].mean() < 0.01
    assert inspection.lacks_contrast[120:, 120:].mean() < 0.02
    assert inspection.lacks_contrast[55:65, 115:125].all()
    text = next(finding.text for finding in inspection.findings if finding.name == "hidden")
    assert "draw it inside the specimen" in text
    assert "reflect" in text
    assert np.isnan(inspection.prediction.std[inspection.mesh.nodes[:, 0] < 20]).all()


def test_without_calibration_the_channels_stand_for_the_lights():
    inspection = inspect_frame(raw(glaring_lights()))
    assert codes(inspection) == {"crosstalk unknown", "noise unknown"}
    assert [light.name for light in inspection.lights] == ["red", "green", "blue"]
    assert inspection.lights[1].reflecting > 0.95
    assert not inspection.crosstalk_known
    assert not inspection.noise_known
    level = np.tensordot(A, glaring_lights().mean(axis=(1, 2)), axes=1)
    np.testing.assert_allclose([light.mean * FULL_SCALE for light in inspection.lights], level, rtol=0.01)


def test_greens_that_differ_as_calibrated_are_no_wrong_pattern():
    """A strong red lamp leaks into the greens in rows with red more than into those in rows with blue."""
    lights = mat_lights().copy() * np.array([1.6, 0.25, 0.25], dtype=np.float32)[:, None, None]
    frame, half = raw(lights), np.rint(0.015 * lights[0]).astype(int)
    values = frame.values.astype(int)
    values[0::2, 1::2] += half[0::2, 1::2]  # RGGB
    values[1::2, 0::2] -= half[1::2, 0::2]
    frame = replace(frame, values=values.astype(np.uint16))
    assert "pattern" in codes(inspect_frame(frame, calibration=CALIBRATION))
    four = replace(CROSSTALK, green_difference=np.array([0.03, 0, 0]))
    inspection = inspect_frame(frame, calibration=replace(CALIBRATION, crosstalk=four))
    assert inspection.greens < 0.005
    assert "pattern" not in codes(inspection)


def test_a_wrong_pattern_is_told():
    lights = mat_lights().copy() * np.array([1.0, 0.6, 0.4], dtype=np.float32)[:, None, None]
    wrong = replace(raw(lights), cfa="GRBG")
    with pytest.raises(FrameError, match=r'greens of the pattern differ.*calibration.accept = \["greens"\]'):
        inspect_frame(wrong, calibration=CALIBRATION)
    told = codes(inspect_frame(wrong, calibration=CALIBRATION, accept=["greens"]))
    assert told >= {"pattern", "not calibrated: greens"}
    with pytest.raises(ConfigurationError, match="accept takes noise, levels, greens, lights, demosaiced, not green"):
        inspect_frame(wrong, calibration=CALIBRATION, accept=["green"])
    assert "pattern" not in codes(inspect_frame(raw(lights), calibration=CALIBRATION))


def test_monochrome_frames_have_neither_lattice_nor_reflection_index():
    frame = grey_frame(1, (0.0, 0.0))
    inspection = inspect_frame(frame, calibration=Calibration(noise=NoiseModel(gain=np.inf, read_noise=8.0)))
    assert (inspection.kind, inspection.reflection_index, inspection.texture) == ("monochrome", None, None)
    assert [one.name for one in inspection.channels] == ["M"]
    assert codes(inspection) == set()
    repeats = [grey_frame(1, (0.0, 0.0), noise_seed=n) for n in (1, 2)]
    images = [linearise(one).values for one in repeats]
    solution = correlate(*images, initial=(0, 0))
    observed = np.sqrt(np.nanmean(solution.displacement**2))
    assert np.sqrt(np.nanmean(inspection.prediction.std**2)) / observed == pytest.approx(1, abs=0.35)


def test_lights_in_succession_and_three_channels():
    frames = [grey_frame(seed, (0.0, 0.0)) for seed in (1, 2)]
    inspection = inspect_frame(frames)
    assert [one.name for one in inspection.channels] == ["M1", "M2"]
    assert [light.name for light in inspection.lights] == ["light 1", "light 2"]
    channels = np.tensordot(A, glaring_lights(), axes=1)
    channels = channels + np.random.default_rng(1).normal(size=channels.shape) * np.sqrt(NOISE.variance(channels))
    values = np.clip(np.rint(channels) + BLACK, 0, 4095).astype(np.uint16)
    colour = ChannelFrame(values=values, black_level=np.array(BLACK), white_level=4095)
    inspection = inspect_frame(colour, calibration=CALIBRATION)
    assert (inspection.kind, inspection.texture) == ("rgb", None)
    assert inspection.lights[1].reflecting > 0.9
    assert np.nanmax(inspection.prediction.mosaic) == 0


def test_frames_that_cannot_be_inspected():
    with pytest.raises(InputError, match="at least 64"):
        inspect_frame(raw(mat_lights()[:, :48, :60]))
    full = Mosaic(values=np.full(SHAPE, 4095), cfa="RGGB", black_level=np.array(BLACK), white_level=4095)
    with pytest.raises(InputError, match="saturated"):
        inspect_frame(full)
    with pytest.raises(InputError, match="constant"):
        inspect_frame(replace(full, values=np.full(SHAPE, 700)))
    with pytest.raises(RegionError):
        inspect_frame(raw(mat_lights()), region=(400, 400, 500, 500))
    with pytest.raises(InputError, match="succession"):
        inspect_frame([raw(mat_lights())] * 2)


def test_files_of_a_test_are_inspected_as_the_test_says(tmp_path):
    test = colour_test(tmp_path / "test", [(0.0, 0.0)])
    inspection = inspect_files([test.frames[0]], test=rgbmidic.read_test(test.folder / "TEST.toml"))
    assert inspection.name == "frame_0.dng"
    assert inspection.crosstalk_known
    assert inspection.noise_known
    x0, y0, x1, y1 = REGION
    assert inspection.region.sum() == (x1 - x0 + 1) * (y1 - y0 + 1)
    assert rgbmidic.inspect_frame is inspect_frame
    damaged = tmp_path / "cut.dng"
    damaged.write_bytes(test.frames[0].read_bytes()[:2000])
    with pytest.raises(FrameError, match=r"cut\.dng"):
        inspect_files([damaged])


def test_files_are_written_and_nothing_is_overwritten(tmp_path):
    out = tmp_path / "out"
    write_inspection(mat(), out)
    document = json.loads((out / "inspection.json").read_text())
    assert document["std_px"]["median"] == pytest.approx(np.nanmedian(mat().prediction.std))
    assert [one["name"] for one in document["channels"]] == ["R", "G", "B"]
    assert document["warnings"] == []
    assert (out / "inspection.png").stat().st_size > 20_000
    with pytest.raises(rgbmidic.RgbmidicError, match="already there"):
        write_inspection(mat(), out)


@pytest.mark.usefixtures("small_pictures")
def test_command(command: Run, tmp_path: Path) -> None:
    test = colour_test(tmp_path / "test", [(0.0, 0.0)])
    out = tmp_path / "out"
    arguments = ["inspect", test.frames[0], "--test", test.folder / "TEST.toml", "--out", out]
    status, printed, error = command(*arguments)
    assert status == 0, error
    assert all(word in printed for word in ("green", "speckle", "all lights", "green alone", "inspection.png"))
    assert {file.name for file in out.iterdir()} == {"inspection.json", "inspection.png"}
    status, _, error = command(*arguments)
    assert (status, error.count("\n")) == (2, 1)
    assert "--overwrite" in error
    before = set(tmp_path.rglob("*"))
    status, printed, _ = command("inspect", test.frames[0], "--region", "16,16,128,128", "--element-size", "20")
    assert status == 0
    assert "warning: no crosstalk calibration" in printed
    assert set(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["none.tif"], "none.tif"),
        (["frame.tif"], "cfa"),
        (["frame.tif", "--cfa", "RGBG"], "RGBG"),
        (["frame.dng", "--cfa", "BGGR"], "BGGR"),
        (["frame.tif", "--cfa", "RGGB", "--calibration", "none.json"], "none.json"),
        (["frame.tif", "--cfa", "RGGB", "--test", "none.toml"], "none.toml"),
        (["frame.tif", "--cfa", "RGGB", "--region", "1,2,3"], "X0,Y0,X1,Y1"),
        (["frame.tif", "--cfa", "RGGB", "--region", "a"], "--region"),
        (["frame.tif", "--cfa", "RGGB", "--element-size", "2"], "4 px"),
        (["frame.tif", "--cfa", "RGGB", "--region", "500,500,600,600"], "overlap"),
        (["frame.tif", "--kind", "colour"], "kind"),
        (["frame.tif", "--cfa", "RGGB", "--white-level", "500"], "saturated"),
        (["small.tif", "--cfa", "RGGB"], "small.tif"),
        (["cut.dng"], "cut.dng"),
    ],
)
def test_wrong_input_is_one_line_status_2_and_nothing_written(
    command: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    word: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    frame = raw(mat_lights()[:, :96, :96] + 500)
    write_tiff(tmp_path / "frame.tif", frame)
    write_dng(tmp_path / "frame.dng", frame)
    write_tiff(tmp_path / "small.tif", replace(frame, values=frame.values[:40, :40]))
    (tmp_path / "cut.dng").write_bytes((tmp_path / "frame.dng").read_bytes()[:3000])
    status, printed, error = command("inspect", *arguments, "--out", "out")
    assert (status, printed) == (2, ""), error
    assert error.count("\n") == 1
    assert word in error
    assert not (tmp_path / "out").exists()
