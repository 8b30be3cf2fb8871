"""Numbers as text: two digits of the uncertainty, and the value to the same place."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rgbmidic.fields import format_value, format_with_std


@pytest.mark.parametrize(
    ("value", "std", "unit", "text"),
    [
        (-0.012517, 3e-4, "mm", "-0.01252 ± 0.00030 mm"),
        (0.1433, 0.00022, "mm", "0.14330 ± 0.00022 mm"),
        (6e-3, 8e-5, "", "0.006000 ± 0.000080"),
        (1.0, 0.0996, "px", "1.00 ± 0.10 px"),
        (-1e-9, 0.1, "px", "0.00 ± 0.10 px"),
        (5123.4, 130.0, "m/s", "5120 ± 130 m/s"),
        (98765.4, 1e6, "1/s", "1e+05 ± 1.0e+06 1/s"),
        (1.2342e-12, 3.2e-14, "", "1.234e-12 ± 3.2e-14"),
        (0.0, 3.2e-14, "", "0e+00 ± 3.2e-14"),
        (0.123456, math.nan, "mm", "0.1235 mm"),
        (0.123456, 0.0, "", "0.1235"),
        (math.nan, 0.1, "mm", "-"),
    ],
)
def test_value_and_uncertainty_end_at_one_place(value: float, std: float, unit: str, text: str) -> None:
    assert format_with_std(value, std, unit) == text


def test_two_digits_of_any_uncertainty_are_kept() -> None:
    for std in 10 ** np.random.default_rng(0).uniform(-12, 8, 500):
        text = format_value(std, std)
        assert float(text) == pytest.approx(std, rel=0.05)
        assert format_value(std * 3, std).partition("e")[0][-1].isdigit()
