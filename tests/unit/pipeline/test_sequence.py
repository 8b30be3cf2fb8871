"""States one after the other: the solutions of the command, as they come and in constant memory."""

from __future__ import annotations

import gc
import weakref
from dataclasses import fields
from typing import get_type_hints

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

import rgbmidic
from rgbmidic import correlate, measure, measure_sequence
from rgbmidic.correlation import Status
from rgbmidic.errors import FrameError, InputError
from rgbmidic.settings import SolverOptions, SolverSettings, TestSettings

SIDE, COUNT = 72, 20


def states(change: float = 0.0) -> list[np.ndarray]:
    """Speckle that moves by .3 px a state, and of which a fraction `change` is another from state to state."""
    rng = np.random.default_rng(3)
    pattern, found = gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5), []
    for number in range(COUNT):
        seen = 1800 + 8000 * shift(pattern, (0, 0.3 * number), mode="nearest")
        found.append((seen + rng.normal(0, 4, size=seen.shape)).astype(np.float32))
        pattern = np.sqrt(1 - change) * pattern + np.sqrt(change) * gaussian_filter(rng.normal(size=(SIDE, SIDE)), 1.5)
    return found


def settings(**frames) -> TestSettings:
    sections = {"frames": {"path": []} | frames, "region": {"rectangle": [10, 10, 61, 61]}}
    return TestSettings.from_mapping(sections | {"mesh": {"element_size": 17}})


def assert_same(solutions, result):
    found = list(solutions)
    assert len(found) == len(result)
    for number, one in enumerate(found):
        np.testing.assert_array_equal(one.displacement[:, 0], result.u[number])
        np.testing.assert_array_equal(one.displacement_std[:, 1].astype(np.float32), result.v_std[number])


@pytest.mark.parametrize("spoilt", [None, 16])
def test_solutions_are_those_of_the_command(spoilt, tmp_path):
    frames = states()
    if spoilt is not None:  # a key frame: measured again from the one before, and failed
        frames[spoilt] = np.full_like(frames[0], np.nan)
    result = measure(settings(), tmp_path / "out", source=frames)
    assert_same(measure_sequence(iter(frames), settings()), result)


def test_reference_updates_are_those_of_the_command(tmp_path):
    frames, known = states(0.05), settings(update_reference=True)
    result = measure(known, tmp_path / "out", source=frames)
    assert len(result.frame(COUNT - 1).reference_updates) > 2
    assert_same(measure_sequence(iter(frames), known), result)


def test_arrays_alone_with_a_reference_of_their_own():
    frames = states()[:4]
    found = list(measure_sequence(frames[1:], reference=frames[0], region=(10, 10, 61, 61), element_size=17))
    assert len(found) == 3
    for number, one in enumerate(found, start=1):
        assert one.status is Status.CONVERGED
        assert np.sqrt(np.mean((one.displacement - (0.3 * number, 0)) ** 2)) < 0.03


def test_nothing_but_the_reference_and_a_few_starts_is_kept():
    class Frame(np.ndarray):
        """An array that can be referred to weakly."""

    known = []

    def camera():
        for one in states():
            frame = one.view(Frame)
            known.append(weakref.ref(frame))
            yield frame
            del frame

    alive = []
    for _ in measure_sequence(camera(), region=(10, 10, 61, 61), element_size=17):
        gc.collect()
        alive.append(sum(one() is not None for one in known))
    assert max(alive) <= 4
    assert len(alive) == COUNT


def test_a_mask_holds_in_every_state():
    frames, mask = states()[:2], np.ones((1, SIDE, SIDE))
    mask[:, :, SIDE // 2 :] = 0
    *_, last = measure_sequence(frames, region=(10, 10, 61, 61), element_size=17, weights=mask)
    assert np.isnan(last.displacement[last.nodes[:, 0] > 58]).all()
    assert np.isfinite(last.displacement[last.nodes[:, 0] < 30]).all()


def test_what_contradicts_is_refused():
    with pytest.raises(InputError, match="the sequence is empty"):
        measure_sequence([])
    with pytest.raises(InputError, match="settings are given: state in them what region says"):
        measure_sequence(states()[:2], settings(), region=(0, 0, 1, 1))
    with pytest.raises(InputError, match="unknown option"):
        measure_sequence(states()[:2], tolerence=1)


def test_masked_samples_are_unknown_and_complex_ones_refused():
    frames, region = states()[:2], (10, 10, 61, 61)
    hidden = np.zeros(frames[1].shape, dtype=bool)
    hidden[:, :34] = True
    masked = np.ma.masked_array(frames[1], hidden)
    (found,) = measure_sequence([masked], reference=frames[0], region=region, element_size=17)
    (expected,) = measure_sequence(
        [np.where(hidden, np.float32(np.nan), frames[1])], reference=frames[0], region=region, element_size=17
    )
    np.testing.assert_array_equal(found.displacement, expected.displacement)
    assert np.isnan(found.displacement[found.nodes[:, 0] < 25]).all()
    alone = correlate(frames[0], masked, region=region, element_size=17)
    assert np.isnan(alone.displacement[alone.nodes[:, 0] < 25]).all()
    (failed,) = measure_sequence([frames[1] * (1 + 0j)], reference=frames[0], region=region, element_size=17)
    assert "must be an array of real numbers" in failed.reason
    with pytest.raises(FrameError, match="must be an array of real numbers"):
        list(measure_sequence([frames[1]], reference=frames[0] * (1 + 0j), region=region, element_size=17))


def test_masked_samples_of_a_raw_frame_are_refused(tmp_path):
    raw = [np.ma.masked_greater(np.round(one).astype(np.uint16), 2500) for one in states()[:2]]
    with pytest.raises(FrameError, match="has masked samples, which a raw frame cannot have"):
        measure(settings(), tmp_path / "out", source=raw)


def test_options_are_typed_as_the_settings_of_the_solve():
    stated = {field.name: field.type for field in fields(SolverSettings)}
    assert {name: str(kind) for name, kind in SolverOptions.__annotations__.items()}.keys() == stated.keys()
    assert get_type_hints(SolverOptions) == get_type_hints(SolverSettings)


def test_what_scripts_need_is_imported_from_the_package():
    assert rgbmidic.SolverSettings().max_iterations == 50
    raw = rgbmidic.separate.__module__, rgbmidic.read_histories.__module__, rgbmidic.export_result.__module__
    assert raw == ("rgbmidic.illumination.separation", "rgbmidic.results.histories", "rgbmidic.results.export")
