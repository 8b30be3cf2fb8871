"""Seconds of stages: what a stage calls of others is theirs, and nothing is measured unless asked for."""

from __future__ import annotations

import time

import pytest

from rgbmidic.timing import STAGES, each, stage, timed


@stage("weights")
def weigh():
    time.sleep(0.02)
    with stage("iteration"):
        time.sleep(0.05)


def starts():
    time.sleep(0.03)
    yield 1


def test_a_stage_within_a_stage_counts_for_itself_and_all_adds_up():
    begin = time.perf_counter()
    with timed() as seconds:
        for _ in each("search", starts()):
            weigh()
    whole = time.perf_counter() - begin
    assert tuple(seconds) == STAGES
    assert seconds["weights"] >= 0.02
    assert seconds["iteration"] >= 0.05
    assert 0.03 <= seconds["search"] <= whole - 0.07
    assert sum(seconds.values()) == pytest.approx(whole, abs=0.005)


def test_an_error_leaves_the_stage_and_nothing_is_measured_unasked():
    with timed() as seconds:
        with pytest.raises(ValueError, match="no"), stage("equations"):
            raise ValueError("no")
        time.sleep(0.02)
    assert seconds["rest"] >= 0.02
    with timed(False) as unasked:
        weigh()
    assert unasked == {}
