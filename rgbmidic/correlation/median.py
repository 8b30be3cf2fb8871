"""Medians of a few thousand numbers, several in every pass of a solve."""

from __future__ import annotations

import numpy as np

from rgbmidic.typing import AnyArray, FloatArray

__all__ = ["median", "of_three"]


def median(values: AnyArray) -> float:
    """That of finite values, at least one, as `numpy.median`, which takes longer to look at them than to order them."""
    flat = np.ravel(values)
    middle = flat.size // 2
    ordered = np.partition(flat, [middle - 1, middle] if middle and flat.size % 2 == 0 else middle)
    return float((ordered[middle] + ordered[middle - 1 + flat.size % 2]) / 2)


def of_three(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
    """Median of each three values side by side."""
    return np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
