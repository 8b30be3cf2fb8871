"""Laws of the demosaicing methods: symmetry, no leak between colours, gains, unknown samples, flat frames."""

import warnings
from dataclasses import replace

import colour_scenes as scenes
import cv2
import numpy as np
import pytest
from naive_demosaic import site_channels

from rgbmidic.frames.data import shift_cfa
from rgbmidic.illumination.separation import DEMOSAICERS, demosaic, separate
from rgbmidic.illumination.texture import TextureModel

SHAPE = (160, 160)  # whole tiles: a flip must not move them
TEXTURE = TextureModel.of_speckle(4.2)
INSIDE = np.s_[:, 24:-24, 24:-24]


@pytest.fixture(scope="module")
def lights():
    """A common texture, a reflection over the green light."""
    albedo = scenes.speckle(SHAPE)
    found = np.array([1500, 2000, 1100])[:, None, None] * albedo
    found[1] += scenes.sparkle(SHAPE, 900, 5)
    return found


@pytest.mark.parametrize("flip", [(slice(None, None, -1), slice(None)), (slice(None), slice(None, None, -1))])
@pytest.mark.parametrize("method", ["malvar", "normalised", "reflection-aware"])
def test_a_flipped_frame_gives_flipped_channels(method, flip, lights):
    mosaic = scenes.mosaic_of(lights, cfa="RGGB")
    # sizes are even, so a flip exchanges the rows or columns of the cell
    cfa = shift_cfa("RGGB", int(flip[0].step == -1), int(flip[1].step == -1))
    flipped = replace(mosaic, values=mosaic.values[flip].copy(), saturated=mosaic.saturated[flip].copy(), cfa=cfa)
    expected = demosaic(mosaic, method).values[(slice(None), *flip)]
    # the reflection-aware texture is read from one half plane of distances: rounding of a fit, not of a sum
    np.testing.assert_allclose(demosaic(flipped, method).values[INSIDE], expected[INSIDE], atol=0.5, rtol=1e-3)


def test_a_frame_cropped_by_one_row_and_column_gives_the_same_channels(lights):
    mosaic = scenes.mosaic_of(lights)
    cropped = replace(mosaic, values=mosaic.values[1:, 1:], saturated=mosaic.saturated[1:, 1:], cfa="BGGR")
    whole, part = demosaic(mosaic, texture=TEXTURE).values[:, 1:, 1:], demosaic(cropped, texture=TEXTURE).values
    # tiles and blocks lie elsewhere, so trust is rounded differently: small against the contrast
    difference = np.sqrt(np.mean((whole - part)[INSIDE] ** 2, axis=(1, 2)))
    assert (difference < 0.06 * whole[INSIDE].std(axis=(1, 2))).all()


@pytest.mark.parametrize("colour", [0, 1, 2])
def test_a_channels_gain_changes_that_channel_alone(colour, lights):
    mosaic = scenes.mosaic_of(lights, noise=None)
    gain = np.where(site_channels(SHAPE, "RGGB") == colour, np.float32(2), np.float32(1))
    louder = replace(mosaic, values=mosaic.values * gain)
    before, after = (demosaic(frame, texture=TEXTURE).values for frame in (mosaic, louder))
    expected = before * np.where(np.arange(3) == colour, 2, 1)[:, None, None]
    np.testing.assert_allclose(after[INSIDE], expected[INSIDE], rtol=2e-3, atol=1)


def test_own_samples_are_nearly_kept(lights):
    mosaic = scenes.mosaic_of(lights)
    found = demosaic(mosaic, crosstalk=scenes.CROSSTALK).values
    own = np.take_along_axis(found, site_channels(SHAPE, "RGGB")[None], axis=0)[0]
    moved = (own - mosaic.values)[16:-16, 16:-16]
    # what is taken off is camera noise, whose standard deviation is 13 to 25 DN here
    assert np.sqrt(np.mean(moved**2)) < 15


def test_a_flat_reflection_on_one_colour_leaves_the_others_unchanged(lights):
    albedo = scenes.speckle(SHAPE)
    mat = np.array([1500, 1200, 1100])[:, None, None] * albedo
    flat = mat + np.array([0, 900, 0])[:, None, None]
    before, after = (
        separate(scenes.mosaic_of(one, noise=None), scenes.CROSSTALK, texture=TEXTURE).values for one in (mat, flat)
    )
    change = (after - before)[INSIDE]
    assert np.abs(change[[0, 2]]).max() < 2
    np.testing.assert_allclose(change[1], 900, atol=5)


def test_dead_pixels_are_missing_data_and_hurt_nobody_else(lights):
    clean = scenes.mosaic_of(lights)
    rng = np.random.default_rng(3)
    dead = rng.random(SHAPE) < 0.01
    broken = replace(clean, values=np.where(dead, np.float32(4000), clean.values), saturated=clean.saturated | dead)
    good, found = (separate(one, scenes.CROSSTALK, texture=TEXTURE) for one in (clean, broken))
    near = cv2.dilate(dead.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    # farther off only the trust in a tile may be rounded differently, 7 to 10 DN in draws of noise and dead pixels:
    # below the camera noise of 13 to 25 DN
    assert np.sqrt(np.mean((found.values - good.values)[:, ~near] ** 2)) < 12
    error = scenes.error(found, lights)
    assert (error < 1.25 * scenes.error(good, lights)).all()
    assert found.valid.mean() > 0.9


def difficult_frames():
    """Lights (3, H, W) that hold little or no texture."""
    speckled = 1500 * np.stack([scenes.speckle(SHAPE)] * 3)
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    middle = (abs(rows - 64) < 40) & (abs(columns - 72) < 40)
    return {
        "uniform": np.full((3, *SHAPE), 800.0),
        "black": np.zeros((3, *SHAPE)),
        "all saturated": np.full((3, *SHAPE), 9000.0),
        "black border": speckled * middle,
        "half dark": speckled * (columns > 72),
        "half saturated": speckled + 9000 * (columns > 72),
        "no blue light": speckled * np.array([1, 1, 0])[:, None, None],
        "one light alone": speckled * np.array([0, 1, 0])[:, None, None],
        "a bright edge": 100 + 2000.0 * np.stack([columns > 71] * 3),
    }


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("name", difficult_frames())
def test_difficult_frames_give_numbers_or_unknown_without_a_warning(name, noisy):
    lights = difficult_frames()[name]
    mosaic = scenes.mosaic_of(lights, noise=scenes.NOISE if noisy else None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        images = separate(mosaic, scenes.CROSSTALK)
    assert np.isfinite(images.values[images.valid]).all()
    assert np.isfinite(images.reflection_index()).all()
    sound = images.valid & (lights.sum(axis=0) < 3500)
    if sound.any():
        # Malvar rings at edges too; nothing may run away
        assert np.abs((images.values - lights)[sound]).max() < 1500


@pytest.mark.parametrize("name", DEMOSAICERS)
def test_a_zero_channel_breaks_no_method(name):
    mosaic = scenes.mosaic_of(difficult_frames()["no blue light"])
    mosaic = replace(mosaic, values=np.where(site_channels(SHAPE, "RGGB") == 2, 0, mosaic.values).astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        images = separate(mosaic, scenes.CROSSTALK, name)
    assert np.isfinite(images.values[images.valid]).all()


@pytest.mark.parametrize("share", [0.1, 0.3, 1.0])
def test_a_partly_coloured_specimen_is_no_worse_than_colour_by_colour(share):
    base, *own = (scenes.speckle(SHAPE, seed=seed) for seed in (1, 2, 3, 4))
    lights = [base.mean() + (1 - share) ** 0.5 * (base - base.mean()) + share**0.5 * (o - o.mean()) for o in own]
    lights = 1500 * np.maximum(lights, 0)
    mosaic = scenes.mosaic_of(lights)
    ours = scenes.error(separate(mosaic, scenes.CROSSTALK), lights)
    for other in ("colour by colour", "malvar", "Menon2007"):
        usual = scenes.error(scenes.separated(mosaic, other), lights)
        assert (ours < 1.05 * usual).all(), (other, ours, usual)


@pytest.mark.parametrize("method", ["Menon2007", "malvar"])
def test_usual_methods_leak_what_ours_does_not(method, lights):
    mosaic = scenes.mosaic_of(lights)
    ours, usual = (
        np.abs(scenes.separated(mosaic, name).values - lights)[INSIDE].mean(axis=(1, 2))
        for name in ("reflection-aware", method)
    )
    assert (ours[[0, 2]] < 0.6 * usual[[0, 2]]).all()
