"""Array types of the annotations, whose docstrings tell their shapes, and arrays as users give them."""

from typing import Any

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]
FloatArray = npt.NDArray[np.float64]
"""Coordinates, sums, matrices: double precision."""
FloatImage = npt.NDArray[np.float32]
"""Grey levels and weights at pixels: single precision."""
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
"""Indices, and labels of nodes and elements."""


def plain(given: npt.ArrayLike) -> AnyArray:
    """Return an array whose masked entries are NaN: as floats where there are any, else of the dtype given."""
    if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
        values: Any = given if given.dtype.kind in "fc" else given.astype(np.float64)
        return np.asarray(np.ma.filled(values, np.nan))
    return np.asarray(given)
