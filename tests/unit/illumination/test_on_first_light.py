"""Lateral registration undone: every light on the first one's pixels."""

from dataclasses import replace

import numpy as np
import pytest

from rgbmidic.errors import CalibrationError
from rgbmidic.illumination.images import IlluminationImages, Registration

SHAPE = (120, 140)
LIMIT = 2e-3  # of the contrast; cubic splines on waves of 16 px or longer


def wave(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 100 + 10 * np.sin(0.31 * x + 0.17 * y) + 10 * np.cos(0.11 * x - 0.38 * y)


def stack(registration: Registration) -> IlluminationImages:
    """Two lights that see one texture, the second where its registration says."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    # light 2 shows at x' = x + rho(x) what light 1 shows at x: invert by fixed point
    points = np.stack([x.ravel(), y.ravel()], 1)
    source = points.copy()
    for _ in range(20):
        source = points - registration.displacement(source)[1]
    second = wave(source[:, 0], source[:, 1]).reshape(SHAPE)
    values = np.stack([wave(x, y), second]).astype(np.float32)
    return IlluminationImages(
        values=values, valid=np.ones(values.shape, bool), names=("a", "b"), full_scale=255.0, registration=registration
    )


def example() -> Registration:
    blank = Registration.identity(("a", "b"), SHAPE)
    parameters = np.array([[0.0] * 5, [0.6, -0.4, 1e-3, 3e-3, -1e-3]])
    return Registration(lights=blank.lights, parameters=parameters, centre=blank.centre, radius=blank.radius)


def test_aligned_lights_show_the_same_texture() -> None:
    images = stack(example())
    aligned = images.on_first_light()
    inner = (slice(8, -8), slice(8, -8))
    before = np.abs(images.values[1] - images.values[0])[inner].max()
    after = np.abs(aligned.values[1] - aligned.values[0])[inner].max()
    assert before > 1.0
    assert after < LIMIT * 20


def test_first_light_and_an_identity_are_left_alone() -> None:
    images = stack(example())
    assert np.array_equal(images.on_first_light().values[0], images.values[0])
    identity = Registration.identity(("a", "b"), SHAPE)
    assert np.array_equal(replace(images, registration=identity).on_first_light().values, images.values)


def test_what_touches_an_invalid_pixel_is_invalid() -> None:
    images = stack(example())
    values = images.values.copy()
    values[1, 60, 70] = np.nan
    aligned = replace(images, values=values, valid=np.isfinite(values)).on_first_light()
    assert not aligned.valid[1, 60, 70]
    assert aligned.valid[0].all()
    assert aligned.valid[1, 60, 80]


def test_other_lights_are_refused() -> None:
    images = stack(example())
    with pytest.raises(CalibrationError, match="a, b"):
        replace(images, registration=Registration.identity(("red", "green"), SHAPE))
