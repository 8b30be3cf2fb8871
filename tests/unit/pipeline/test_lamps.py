"""Gain and offset of each light against the reference."""

from __future__ import annotations

import numpy as np
import pytest
from textures import Affine, Texture

from rgbmidic.correlation import Reference
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.lamps import LampLight

SHAPE = (160, 200)
MOTION = Affine.strain_and_rotation(0.003, 0.3, (5.3, -3.6))


def states(gain: float, offset: float, noise: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    paint = Texture.random(3, speckle=4.0)
    random = np.random.default_rng(0)
    first, second = (paint.image(SHAPE), gain * paint.image(SHAPE, MOTION) + offset)
    pair = [image + noise * random.standard_normal(SHAPE) for image in (first, second)]
    return tuple(np.stack([image, image[::-1].copy()]).astype(np.float32) for image in pair)  # type: ignore[return-value]


def reference(images: np.ndarray) -> Reference:
    region = Region.from_rectangle((20, 20, 180, 140), SHAPE)
    return Reference.prepare(images, region, mesh=Tri3Mesh.from_region(region, 25))


def displacement(prepared: Reference) -> np.ndarray:
    return MOTION.displacement(prepared.mesh.nodes, SHAPE)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.8, 0.0), (1.2, 30.0), (0.5, -20.0)])
def test_gain_and_offset_are_found_where_the_surface_has_moved_to(gain, offset):
    first, second = states(gain, offset)
    prepared = reference(first)
    found = LampLight.of(first, prepared).change(second, displacement(prepared))
    # positions are rounded to whole pixels: elements differ, their median hardly
    assert found[0, 0] == pytest.approx(gain, rel=0.02)
    assert found[0, 1] == pytest.approx(offset, abs=0.02 * float(first[0].mean()))


def test_a_light_that_is_off_has_no_gain():
    first, second = states(1.0, 0.0)
    second[1] = np.random.default_rng(1).normal(0, 3, SHAPE)
    prepared = reference(first)
    found = LampLight.of(first, prepared).change(second, displacement(prepared))
    assert found[0, 0] == pytest.approx(1, rel=0.02)
    assert found[1, 0] < 0.094


def test_what_is_not_seen_in_both_states_is_left_out_and_nothing_gives_nan():
    first, second = states(0.9, 0.0)
    prepared, motion = reference(first), None
    motion = displacement(prepared)
    second[0, :, :100] = np.nan
    motion[motion[:, 0] > np.quantile(motion[:, 0], 0.9)] = np.nan
    assert LampLight.of(first, prepared).change(second, motion)[0, 0] == pytest.approx(0.9, rel=0.02)
    assert np.isnan(LampLight.of(first, prepared).change(np.full_like(second, np.nan), motion)).all()
    assert np.isnan(LampLight.of(first, prepared).change(second, np.full_like(motion, np.nan))).all()
    assert np.isnan(LampLight.of(first, prepared).change(second, motion + 1000)).all()
