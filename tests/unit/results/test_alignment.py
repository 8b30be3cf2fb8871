"""The alignment of clocks: what is found is right within what is stated, and long channels take no long time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbmidic.errors import InputError
from rgbmidic.results import alignment
from rgbmidic.results.alignment import Alignment
from rgbmidic.results.channels import Channels
from rgbmidic.typing import FloatArray

STEP = 10e-6
"""Interval of the frames, s."""


def channel(times: FloatArray, values: FloatArray) -> Channels:
    return Channels(path=Path("daq.csv"), times=times, values={"load": values})


def edge(times: FloatArray, width: float) -> FloatArray:
    return np.tanh(times / width)


@pytest.mark.parametrize(("width", "sampling"), [(25e-6, 200e-6), (250e-6, 200e-6), (250e-6, 2e-6)])
def test_the_stated_uncertainty_of_an_offset_knows_the_interval_and_the_noise_of_the_channel(width, sampling):
    """An edge between two values of the channel lies anywhere between them: 1.4 µs were stated for 38 µs."""
    frames, pulls, stds = STEP * np.arange(300), [], []
    for seed in range(20):
        random = np.random.default_rng(seed)
        recorded = np.arange(-10e-3, 10e-3, sampling) + random.uniform(0, sampling)
        offset = random.uniform(-2e-3, 2e-3)
        found, std, _ = channel(recorded - offset, edge(recorded, width) + random.normal(0, 0.02, len(recorded))).align(
            "load", frames, edge(frames - 1.5e-3, width) + random.normal(0, 0.02, len(frames))
        )
        pulls.append((found.offset - offset - 1.5e-3) / std)
        stds.append(std)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.2
    assert np.median(stds) < sampling / 2 + 5e-6


def test_the_sums_of_all_offsets_are_those_of_each():
    random = np.random.default_rng(0)
    times, frames = np.cumsum(random.integers(1, 4, 80)) * 1.0, np.cumsum(random.integers(1, 3, 30)) * 1.0
    values = random.normal(0, 1, 80)
    values[[3, 40, 41]] = np.nan
    made = Alignment(times=times, values=values, variance=0, frame_times=frames, history=random.normal(5, 2, 30))
    assert made.intervals == (2, 1)
    offsets, found = made.coefficients()
    assert found == pytest.approx([made.correlation(one) for one in offsets], abs=1e-9)
    assert (found != 0).sum() > 100


def test_a_channel_much_longer_than_the_frames_is_aligned(caplog: pytest.LogCaptureFixture):
    """Of every half frame interval an offset: 200 s would be 40 million."""
    random = np.random.default_rng(0)
    recorded, frames = np.arange(0, 200, 5e-4), STEP * np.arange(1000)
    values = np.exp(-(((recorded - 77.7) / 3e-3) ** 2)) + random.normal(0, 0.02, len(recorded))
    history = np.exp(-(((frames - 4e-3) / 3e-3) ** 2)) + random.normal(0, 0.05, len(frames))
    found, std, _ = channel(recorded, values).align("load", frames, history)
    assert abs(found.offset + 77.696) < 3 * std < 1e-3
    assert not caplog.messages


def test_too_many_offsets_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(alignment, "_MAX_OFFSETS", 1000)
    times = np.arange(600.0)
    with pytest.raises(InputError, match=r"1218 offsets would have to be tried, 0\.5 s apart; at most 1000 are"):
        channel(times, np.sin(times)).align("load", times[:11], np.sin(times[:11]))


def test_what_correlates_as_well_elsewhere_is_stated(caplog: pytest.LogCaptureFixture):
    times = np.arange(0, 100, 0.2)
    channel(times, np.sin(times)).align("load", times[:100], np.sin(times[:100] - 1))
    assert "correlates as well with other offsets of its clock, such as" in caplog.text


def test_a_ramp_has_no_offset():
    times = np.arange(50.0)
    _, std, coefficient = channel(times, times).align("load", times[:20], times[:20] + 1)
    assert coefficient == pytest.approx(1)
    assert std > 1e3


def test_rounding_is_no_correlation():
    """A channel that is constant but for its last digits is not the edge that lies elsewhere."""
    times, frames = np.arange(-10e-3, 10e-3, 200e-6), STEP * np.arange(200)
    history = edge(frames - 1e-3, 50e-6) + np.random.default_rng(0).normal(0, 0.02, 200)
    found, std, _ = channel(times, edge(times - 1e-3, 50e-6)).align("load", frames, history)
    assert abs(found.offset) < 3 * std < 3e-4
