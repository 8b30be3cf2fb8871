"""That a kernel gives the same bits on any number of threads."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np

from rgbmidic._kernels.threads import set_threads, threads


def assert_same_on_threads(work):
    """`work()` gives equal arrays on one and on three threads, which share the smallest kernel, too."""
    before, found = threads(), []
    try:
        for number in (1, 3):
            set_threads(number)
            with patch("rgbmidic._kernels.threads._MIN_SHARED_SIZE", 0):
                found.append(work())
    finally:
        set_threads(before)
    for one, three in zip(*found, strict=True):
        np.testing.assert_array_equal(one, three)
