"""A check fails, is doubtful or passes by the size of its figure; what is accepted is not refused."""

from __future__ import annotations

import math

import pytest

from rgbmidic.illumination.checks import Check, refused, reported, warning


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(("value", "passed", "said"), [(0.5, True, False), (1.5, True, True), (2.5, False, True)])
def test_a_figure_passes_is_doubtful_or_fails_by_its_size(sign, value, passed, said):
    check = Check("noise", "too much", sign * value, limit=2, doubtful=1)
    assert check.passed == passed
    assert reported([check]) == ([check] if said else [])
    assert refused([check], ()) == ([] if passed else [check])
    assert refused([check], ["noise"]) == []


def test_what_is_no_number_or_only_a_sentence_fails():
    assert not Check("noise", "not known", math.nan, limit=2).passed
    assert not Check("name", "swapped").passed


def test_a_warning_never_fails():
    small, large, plain = warning("a", 1.0, above=2.0), warning("b", 3.0, above=2.0), warning("c")
    assert all(check.passed for check in (small, large, plain))
    assert reported([small, large, plain]) == [large, plain]
