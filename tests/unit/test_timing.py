"""Seconds of stages: what a stage calls of others is theirs, and nothing is measured unless asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from rgbmidic import timing
from rgbmidic.timing import STAGES, record_stages, stage, timed_items

Pass = Callable[[float], None]


@pytest.fixture
def wait(monkeypatch: pytest.MonkeyPatch) -> Pass:
    """Lets seconds pass on the clock of the stages, which stands still otherwise."""
    now = [1000.0]

    def pass_by(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr(timing, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    return pass_by


@stage("weights")
def weigh(wait: Pass) -> None:
    wait(2)
    with stage("iteration"):
        wait(5)


def starts(wait: Pass) -> Iterator[int]:
    wait(3)
    yield 1
    wait(4)


def test_a_stage_within_a_stage_counts_for_itself_and_all_adds_up(wait):
    with record_stages() as seconds:
        wait(1)
        for _ in timed_items("search", starts(wait)):
            weigh(wait)
    assert seconds == dict.fromkeys(STAGES, 0.0) | {"weights": 2, "iteration": 5, "search": 7, "rest": 1}


@stage("equations")
def fail(wait: Pass) -> None:
    wait(2)
    raise ValueError("no")


def test_an_error_leaves_the_stage_and_nothing_is_measured_unasked(wait):
    with record_stages() as seconds:
        with pytest.raises(ValueError, match="no"):
            fail(wait)
        wait(3)
    assert seconds == dict.fromkeys(STAGES, 0.0) | {"equations": 2, "rest": 3}
    with record_stages(False) as unasked:
        weigh(wait)
    assert unasked == {}
