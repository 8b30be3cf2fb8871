"""What the options of the tests exchange: noise of photons, its sampler, last bits of renders; and what is kept."""

from __future__ import annotations

import numpy as np
import pytest
import renders
from draws import other_draws

from rgbmidic.tools.lab.virtual import Scene, plate_scene, record, render, turned
from rgbmidic.tools.scene import speckle

LEVEL = 400.0


def plain(scene: Scene) -> np.ndarray:
    """A frame of even light."""
    return record(np.full((3, 64, 64), LEVEL, np.float32), scene.camera, scene.lights, seed=5).values.astype(float)


@pytest.mark.parametrize("options", [{"number": 1}, {"number": 2}, {"sampler": "normal"}])
def test_the_noise_is_another_of_the_same_variance(options):
    scene = plate_scene(size=64, kind="rgb", crosstalk=None)
    with other_draws():
        usual = plain(scene)
    with other_draws(**options):
        other = plain(scene)
        np.testing.assert_array_equal(plain(scene), other)
    both = np.corrcoef(usual.ravel(), other.ravel())[0, 1]
    assert abs(both) < 0.05  # 12,288 samples: .009
    assert other.var() == pytest.approx(usual.var(), rel=0.1)
    assert other.mean() == pytest.approx(usual.mean(), rel=1e-3)


def test_what_draws_no_photons_stays_as_it_is():
    usual = np.random.default_rng(3).normal(size=9)
    with other_draws(1, "normal"):
        np.testing.assert_array_equal(np.random.default_rng(3).normal(size=9), usual)
        random = np.random.default_rng(4)
        assert np.random.default_rng(random) is random


def test_renders_change_by_the_jitter_alone():
    scene = plate_scene(size=32)
    with other_draws():
        usual = render(scene)
        with other_draws(jitter=1e-6):
            changed = render(scene)
    assert 0.3e-6 < np.std(changed / usual - 1) < 3e-6


def test_a_render_is_made_once_unless_it_is_to_be_made_anew(monkeypatch, tmp_path):
    made = []

    def trace(scene, state):
        made.append(state)
        return np.ones((3, 2, 2), np.float32)

    monkeypatch.setattr(renders, "_NEW", [trace, *renders._NEW[1:]])
    monkeypatch.setattr(renders, "_WORTH", -1.0)
    monkeypatch.setenv("RGBMIDIC_RENDERS", str(tmp_path))
    scene = plate_scene(size=2)
    with renders.kept_renders():
        for angle in (1.25, 1.5, 1.25):
            np.testing.assert_array_equal(render(scene, turned(angle)), 1)
        assert len(made) == 2
        with renders.new_renders():
            render(scene, turned(1.25))
            assert speckle.cover_covariance is renders._NEW[2]
        assert len(made) == 3
        told = [speckle.cover_covariance(scene.surface, np.linspace(0, distance, 9)) for distance in (0.1, 0.2, 0.1)]
    np.testing.assert_array_equal(told[0], told[2])
    np.testing.assert_array_equal(told[1], renders._NEW[2](scene.surface, np.linspace(0, 0.2, 9)))
    assert len(list(tmp_path.glob("*.pickle"))) == 2
