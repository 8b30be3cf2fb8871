"""What run says of a reference: its texture, clipped samples, dark background, lights that lie apart, motion."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift
from small_tests import colour_test

from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording
from rgbmidic.illumination.displacement import LightDisplacement
from rgbmidic.illumination.images import IlluminationImages, Registration
from rgbmidic.illumination.plane_samples import saturation_pile
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.mesh import Region
from rgbmidic.pipeline import Plan, measure
from rgbmidic.pipeline.frame_quality import (
    ReferenceMotion,
    background_fraction,
    clipping,
    repetition,
    separation_doubts,
    speckle_size,
)
from rgbmidic.pipeline.user_objects import SourceSeries
from rgbmidic.settings import TestSettings
from rgbmidic.tools.lab.inspection import inspect_frame

SHAPE = (120, 140)
REGION = Region.from_rectangle((10, 10, 129, 109), SHAPE)


def speckle(seed: int = 0, sigma: float = 1.5, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    pattern = gaussian_filter(np.random.default_rng(seed).normal(size=shape), sigma)
    return 1500 + 400 * pattern / pattern.std()


def dots(pitch: float, jitter: float = 0.0) -> np.ndarray:
    """Dots on a grid, each displaced by `jitter` of the pitch."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    places = np.mgrid[0 : SHAPE[0] : pitch, 0 : SHAPE[1] : pitch].reshape(2, -1)
    places = places + jitter * pitch * np.random.default_rng(0).normal(size=places.shape)
    return 500 + 2000 * sum(np.exp(-((y - b) ** 2 + (x - a) ** 2) / (2 * (pitch / 5) ** 2)) for b, a in places.T)


def noisy(image: np.ndarray, seed: int = 0, noise: float = 10.0) -> np.ndarray:
    return np.clip(np.round(image + noise * np.random.default_rng(seed).normal(size=image.shape)), 0, 4095)


def images(*lights: np.ndarray) -> IlluminationImages:
    values = np.stack(lights).astype(np.float32)
    names = tuple("abc"[: len(lights)])
    return IlluminationImages(values=values, valid=np.ones(values.shape, bool), names=names, full_scale=4095.0)


def raw(image: np.ndarray, white: float = 4095.0) -> ChannelFrame:
    return ChannelFrame(values=image.astype(np.uint16)[None], black_level=np.zeros(1), white_level=white)


def run(tmp_path, source, **stated):
    document = {
        "frames": {"path": [], "kind": "monochrome", "white_level": 4095} | stated,
        "region": {"rectangle": [10, 10, 129, 109]},
        "mesh": {"element_size": 25},
    }
    return measure(TestSettings.from_mapping(document), tmp_path / "out", source=source)


@pytest.fixture
def told(caplog):
    caplog.set_level(logging.WARNING, logger="rgbmidic")
    return lambda: [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(("pitch", "jitter"), [(9, 0.0), (12, 0.0), (12, 0.1), (17, 0.05)])
def test_dots_on_a_grid_repeat_themselves_by_their_pitch(pitch, jitter):
    found = images(noisy(dots(pitch, jitter)))
    text = repetition(found, REGION, speckle_size(found, REGION))
    assert jitter or f"({pitch}, 0) px" in text or f"(0, {pitch}) px" in text
    assert "repeats itself" in text


@pytest.mark.parametrize("sigma", [0.8, 1.5, 3.0, 5.0])
@pytest.mark.parametrize("side", [50, 100])
def test_random_speckle_does_not_however_small_the_region(sigma, side):
    region = Region.from_rectangle((10, 10, 9 + side, 9 + side), SHAPE)
    for seed in range(5):
        found = images(noisy(speckle(seed, sigma)), noisy(speckle(seed + 9, sigma)))
        assert repetition(found, region, speckle_size(found, region)) is None


def test_dots_on_a_grid_are_told_by_inspect_and_run(tmp_path, told):
    frames = [noisy(np.roll(dots(12), 4 * index, axis=1), index).astype(np.uint16) for index in range(2)]
    result = run(tmp_path, frames)
    assert "the reference (frame 0): the texture repeats itself: displaced by" in told()[0]
    assert result.warnings == tuple(told())
    assert "repetition" in [check.name for check in inspect_frame(raw(frames[0]), region=REGION).findings]


@pytest.mark.parametrize("step", [1, 16])
def test_samples_pile_up_where_a_camera_saturates_below_its_white_level(step):
    bright = step * noisy(speckle())
    clipped = np.minimum(bright, 2000 * step).astype(np.uint16)
    assert saturation_pile(clipped, 65535) == 2000 * step
    assert saturation_pile(clipped, 2000 * step) is None
    assert saturation_pile(bright.astype(np.uint16), 65535) is None
    mosaic = Mosaic(values=clipped, cfa="RGGB", black_level=0, white_level=65535)
    assert clipping((mosaic,))[0] == 2000 * step
    # a plane that is saturated as a whole; a frame without any texture
    constant = np.full((10, 10), 700, dtype=np.uint16)
    assert saturation_pile(constant, 65535) == 700
    assert clipping((replace(mosaic, values=constant),)) is None


def test_clipped_samples_are_told_by_inspect_and_run_whatever_frame_has_them(tmp_path, told):
    glare = 3000 * np.exp(-(np.hypot(*(np.mgrid[: SHAPE[0], : SHAPE[1]] - 60)) ** 2) / 200)
    frames = [noisy(speckle() + (index > 0) * glare, index).astype(np.uint16) for index in range(4)]
    result = run(tmp_path, frames, white_level=65535)
    # what clipped samples that count as measured do to the strain at an edge may be another warning
    (line,) = [line for line in told() if "samples" in line]
    assert line.startswith("frames 1 to 3 (frame 1, ...): samples pile up at 4095 DN, below white_level 65535")
    assert result.warnings == tuple(told())
    stated, guessed = (inspect_frame(raw(frames[1], white), region=REGION) for white in (4095, 65535))
    assert "white level" in [check.name for check in guessed.findings]
    assert "dark" not in [check.name for check in guessed.findings]
    np.testing.assert_array_equal(guessed.prediction.std, stated.prediction.std)


@pytest.mark.parametrize("noise", [4.0, 30.0])
def test_the_dark_beside_a_specimen_is_background(noise, tmp_path, told):
    beside = np.arange(SHAPE[1]) >= 100
    image = np.where(beside, 100.0, speckle())
    found = images(noisy(image, noise=noise))
    share = beside[10:130].mean()
    assert background_fraction(found, REGION, 4.0, None) == pytest.approx(share, abs=0.05)
    assert background_fraction(images(noisy(speckle())), REGION, 4.0, None) == 0
    shaded = speckle() * np.linspace(0.2, 1, SHAPE[1])  # paint that is lit less
    assert background_fraction(images(noisy(shaded, noise=4.0)), REGION, 4.0, None) == 0
    frames = [noisy(image, index, noise).astype(np.uint16) for index in range(2)]
    assert any("holds dark background" in line for line in run(tmp_path, frames).warnings)


@pytest.mark.parametrize("kind", ["mosaic", "grey"])
@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.03, -0.04), (0.3, 0.4), (-6.0, 8.0), (20.0, 0.0)])
def test_motion_of_the_reference_frames_is_found(kind, motion):
    still = speckle(shape=(260, 280))
    values = [noisy(shift(still, by[::-1], order=5, mode="wrap"), seed) for seed, by in enumerate(((0, 0), motion))]
    region = Region.from_rectangle((20, 20, 259, 239), still.shape)
    if kind == "mosaic":  # the light of the colours differs
        gains = np.tile([[1.0, 0.6], [0.6, 0.3]], (130, 140))
        states = [
            (Mosaic(values=(gains * v).astype(np.uint16), cfa="RGGB", black_level=0, white_level=4095),) for v in values
        ]
    else:
        states = [(raw(v),) for v in values]
    watch = ReferenceMotion(region.mask)
    assert [id(state) for state in watch.watch(states)] == [id(state) for state in states]
    assert watch.largest == pytest.approx(np.hypot(*motion), rel=0.1, abs=0.005)


class Exposed(SourceSeries):
    """Frames of 1 kHz that were exposed for so many µs."""

    @property
    def recording(self) -> Recording:
        times = np.arange(len(self), dtype=np.int64) * 1_000_000
        return Recording(count=len(self), times_ns=times, exposure_ns=1000 * self.source.exposed_us)


class Frames(list):
    exposed_us = 0


@pytest.mark.parametrize(("exposed_us", "said"), [(400, 0), (600, 1)])
def test_motion_of_more_than_a_pixel_during_the_exposure_is_told(exposed_us, said, tmp_path, told):
    frames = Frames(noisy(np.roll(speckle(), 2 * index, axis=1), index).astype(np.uint16) for index in range(3))
    frames.exposed_us = exposed_us
    stated = TestSettings.from_mapping(
        {"frames": {"path": [], "kind": "monochrome", "white_level": 4095}, "region": {"rectangle": [20, 20, 109, 99]}}
    )
    source = Exposed(source=frames, user_metadata=stated.frames, selected=range(3), shape=SHAPE)
    measure(stated, tmp_path / "out", source=source)
    assert len(told()) == said
    assert all(
        "frames 1 to 2 (frame 1, ...): motion blur: the specimen moves by more than 1 px" in one for one in told()
    )


@pytest.mark.parametrize(("motion", "said"), [((0.03, 0.02), 0), ((0.3, 0.1), 1)])
def test_a_camera_that_shakes_is_not_another_camera(motion, said, tmp_path, told):
    """The difference of two reference frames that moved is no noise."""
    test = colour_test(tmp_path, ((0.0, 0.0), motion))
    Plan.from_settings(test.settings(frames={"reference": [0, 1]}))
    assert len(told()) == said
    assert all(line.startswith("the reference frames move against each other by up to 0.3") for line in told())


def test_a_reference_of_moving_frames_is_one_line(tmp_path, told):
    frames = [noisy(np.roll(speckle(), 5 * index, axis=1), index).astype(np.uint16) for index in range(5)]
    result = run(tmp_path, frames, reference="0:4")
    assert told()[0].startswith("the reference frames move against each other by up to 15 px")
    assert len(told()) == 2  # of the test, and which frames could not be measured for it
    assert told()[1].endswith(f"cannot be measured: {told()[0]}")
    assert len(set(result.reasons)) == 1


def test_a_lamp_that_goes_out_is_one_line_of_the_run_and_is_kept_with_it(tmp_path, told):
    frames = []
    for index in range(4):
        moved = shift(speckle(), (0, 0.2 * index), mode="nearest")
        frames.append(np.stack([moved, (0.1 if index > 1 else 1.0) * moved]).astype(np.float32))
        frames[-1] += np.random.default_rng(index).normal(size=frames[-1].shape).astype(np.float32)
    result = run(tmp_path, frames, kind=None)
    (line,) = told()
    assert line == "frames 2 to 3 (frame 2, ...): light 2 gives less than 30% of its light in the reference"
    assert result.warnings == (line,)


def found_apart(std: float, *displacements: np.ndarray) -> IlluminationImages:
    """Lights that a separation found displaced, (2, h, w) each, with an uncertainty."""
    values = np.stack(displacements)
    values = values + std * np.random.default_rng(1).normal(size=values.shape)
    blocks = values.shape[2:]
    pictures = images(*[speckle(shape=(8 * blocks[0], 8 * blocks[1]))] * len(values))
    found = LightDisplacement(values=values - values.mean(axis=0), std=np.full((len(values), *blocks), std))
    return replace(pictures, displacement=found)


def magnified(by: float) -> np.ndarray:
    """Of a lens that magnifies a light more: 0 in the middle, `by` px at the left and right end."""
    y, x = np.mgrid[-1:1:40j, -1:1:40j]
    return by * np.stack([x, y])


def glints(rms: float, seed: int) -> np.ndarray:
    """Of glints on raised droplets: they slide over the surface over some 50 px."""
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(2, 40, 40)), (0, 5, 5))
    return rms * field / field.std()


@pytest.mark.parametrize(
    ("displacements", "std", "text"),
    [
        ((magnified(0), magnified(0.1), magnified(0.5)), 0.02, "no registration is calibrated, but c lies 0.42 px (up"),
        ((magnified(0), magnified(0.3), magnified(0.5)), 0.02, "b lies 0.25 px (up to 0.4"),
        ((magnified(0), magnified(0.05), magnified(0.1)), 0.02, ""),
        ((magnified(0), magnified(0.1), magnified(0.5)), 0.5, ""),  # it may be chance
        *[((glints(0.3, 3 * n), glints(0.3, 3 * n + 1), glints(0.3, 3 * n + 2)), 0.02, "") for n in range(4)],
    ],
)
def test_lights_that_lie_apart_are_told_and_glints_are_not(displacements, std, text):
    found = found_apart(std, *displacements)
    said = [check.text for check in separation_doubts(found, Region.from_mask(np.ones(found.shape, bool)))]
    assert [text in one for one in said] == [True] * bool(text)


def test_a_registration_of_another_set_up_is_told():
    found = found_apart(0.02, magnified(0), magnified(0.14), magnified(0))
    region = Region.from_mask(np.ones(found.shape, bool))
    assert separation_doubts(found, region) == []  # without one .15 px are not told
    registered = replace(found, registration=Registration.identity(found.names, found.shape))
    assert "beyond the calibrated registration b lies 0.1" in separation_doubts(registered, region)[0].text


def test_the_run_says_what_its_separation_has_found(tmp_path, told):
    def separation(frames):
        found = found_apart(0.02, magnified(0), magnified(0.8))
        cut = found.values[:, : SHAPE[0], : SHAPE[1]] + frames[0].values.mean()
        texture = TextureModel(weights=(1.0,), widths=(1.5,), common=False)
        return replace(found, values=cut, valid=np.ones(cut.shape, bool), texture=texture)

    settings = TestSettings.from_mapping(
        {
            "frames": {"path": [], "kind": "monochrome", "white_level": 4095},
            "region": {"rectangle": [10, 10, 129, 109]},
            "mesh": {"element_size": 25},
        }
    )
    measure(settings, tmp_path / "out", source=[raw(speckle()), raw(speckle() + 1)], separation=separation)
    said = "\n".join(told())
    assert "the reference (frame 0): no registration is calibrated, but b lies" in said
    assert "the samples contradict one texture common to the lights" in said
