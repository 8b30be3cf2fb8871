"""The threshold that a test finds for itself: on a reflection that disturbs, and where there is none."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from bench import lamp_for_reflection
from rgbmidic.errors import FrameError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linear import linearise
from rgbmidic.mesh import Region
from rgbmidic.settings import TestSettings
from rgbmidic.tools.lab.virtual import Finish, Light, Scene, Sphere, State, Surface, expose, record, render
from rgbmidic.tools.preparation.automatic_threshold import automatic_threshold, automatic_weights
from rgbmidic.tools.scene.camera import reference_camera
from rgbmidic.weights.threshold import FALLBACK, threshold_weights

SIZE, SPOT = 300, (80.0, 150.0)


def scene(gloss: float) -> Scene:
    """A sphere with a narrow reflection of the left lamp; that of the right one lies outside the field."""
    camera = replace(reference_camera((SIZE, SIZE), kind="monochrome"), focal_px=6000.0, samples=4)
    white = Finish(albedo=0.8, gloss=gloss, lobe_deg=2.0, slope_deg=2.0, spacing=0.1)
    surface = Surface(white=white, black=replace(white, albedo=0.1), droplet=0.42, dome=0.004, seed=1)
    body = Sphere()
    lights = tuple(
        Light(name=name, position=lamp_for_reflection(body, camera, spot)).aimed(body.front)
        for name, spot in (("right", (400.0, 40.0)), ("left", SPOT))
    )
    return expose(Scene(body=body, lights=lights, camera=camera, surface=surface))


@cache
def states(gloss: float) -> tuple[IlluminationImages, IlluminationImages]:
    """Reference, and the sphere turned by 0.3 degrees."""
    made = scene(gloss)
    names = tuple(light.name for light in made.lights)
    images = []
    for number, state in enumerate((State(), State(angle_deg=-0.3))):
        rendered = render(made, state)
        shots = [
            linearise(record(rendered, made.camera, made.lights, seed=10 * number + i, shining=(name,)))
            for i, name in enumerate(names)
        ]
        images.append(
            IlluminationImages(
                values=np.concatenate([shot.values for shot in shots]),
                valid=np.concatenate([shot.valid for shot in shots]),
                names=names,
                full_scale=made.camera.full_scale,
            )
        )
    return images[0], images[1]


REGION = Region.from_rectangle((8, 8, 291, 291), (SIZE, SIZE))


def find(gloss: float):
    return automatic_threshold(*states(gloss), REGION, element_size=16.0, prefilter="none")


def test_the_zone_is_that_of_the_light_whose_reflection_lies_in_the_field():
    found = find(1.5)
    assert np.hypot(found.zone.centre[0] - SPOT[0], found.zone.centre[1] - SPOT[1]) < 15
    assert 30 < found.zone.radius < 110
    assert found.zone.contrast > 3
    weights = threshold_weights(states(1.5)[0], threshold=found.value)
    column, row = (int(value) for value in SPOT)
    assert weights[1, row - 20 : row + 20, column - 20 : column + 20].max() == 0
    # what one light loses the other keeps
    assert weights[1][REGION.mask].mean() > 0.5
    assert weights.any(axis=0)[REGION.mask].mean() > 0.98


def test_where_nothing_reflects_there_is_no_threshold():
    assert find(0.0) is None


def test_images_that_do_not_match_give_no_threshold():
    reference, deformed = states(0.0)
    other = replace(deformed, values=deformed.values[:, ::-1].copy())
    assert automatic_threshold(reference, other, REGION, element_size=16.0, prefilter="none") is None


@pytest.mark.parametrize("blur", [5.0, 15.0])
def test_the_threshold_goes_with_the_blur_of_the_weights(blur):
    found = automatic_threshold(*states(1.5), REGION, blur=blur, element_size=16.0, prefilter="none")
    assert found.value == pytest.approx(find(1.5).value, rel=0.3)


def images_without_reflection() -> IlluminationImages:
    values = np.full((2, 60, 80), 100.0, dtype=np.float32)
    return IlluminationImages(values=values, valid=values > 0, names=("a", "b"), full_scale=1000.0)


def unreadable(index):
    raise FrameError(f"frame {index} is damaged")


@pytest.mark.parametrize(
    ("images_of", "frames", "message"),
    [
        (lambda _: images_without_reflection(), 1, "there is no deformed frame"),
        (lambda _: images_without_reflection(), 2, "no disturbed zone in frame 1"),
        (unreadable, 2, "frame 1 cannot be used: frame 1 is damaged"),
    ],
)
def test_where_no_threshold_is_found_the_paper_s_is_taken_and_told(caplog, images_of, frames, message):
    blank = images_without_reflection()
    settings = TestSettings.from_mapping(
        {"frames": {"path": "x"}, "region": {"rectangle": [0, 0, 79, 59]}, "calibration": {"file": "c"}}
    )
    region = Region.from_rectangle((0, 0, 79, 59), blank.shape)
    with caplog.at_level(logging.WARNING, logger="rgbmidic.pipeline"):
        weights = automatic_weights(settings, blank, region, frames=frames, images_of=images_of)
    assert message in caplog.text
    assert weights.threshold == pytest.approx(FALLBACK)
    assert weights.notes == {"weights_threshold": weights.threshold}
