"""Medians as numpy's."""

from __future__ import annotations

import numpy as np
import pytest

from rgbmidic.correlation.median import median, of_three


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(1,), (2,), (3,), (50,), (7, 9)])
def test_the_median_is_numpys(shape, dtype):
    values = np.random.default_rng(0).normal(size=shape).astype(dtype)
    assert median(values) == np.median(values)


def test_the_median_of_each_three_is_numpys():
    values = np.random.default_rng(1).integers(0, 4, (3, 200)).astype(float)
    np.testing.assert_array_equal(of_three(*values), np.median(values, axis=0))
