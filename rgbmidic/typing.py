"""Types of the annotations: arrays, whose shapes a docstring tells, and callbacks; and how input becomes an array."""

import reprlib
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, RgbmidicError

AnyArray = npt.NDArray[Any]
FloatArray = npt.NDArray[np.float64]
"""Coordinates, sums, matrices: double precision."""
FloatImage = npt.NDArray[np.float32]
"""Grey levels and weights at pixels: single precision."""
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
"""Indices, and labels of nodes and elements."""
Progress = Callable[[int, int, str], None]
"""Called with the number of things done, their total and a line about the last one."""


def as_numbers(
    values: npt.ArrayLike,
    needed: str,
    shape: tuple[int | None, ...],
    *,
    dtype: npt.DTypeLike = np.float64,
    error: type[RgbmidicError] = InputError,
) -> AnyArray:
    """Return a copy of input as an array of finite numbers of a type; None in the shape is any length.

    Raises
    ------
    RgbmidicError
        It is an `error` that states what was `needed` and what was given: no numbers, another shape, not finite, or
        not to be had in that type.
    """
    try:
        given = np.asarray(values)
        with np.errstate(invalid="ignore"):  # what the type does not hold differs
            array = given.astype(dtype) if given.dtype.kind in "buifO" else np.empty(0)
        same = bool((array == given).all()) if array.shape == given.shape else False
    except (TypeError, ValueError, OverflowError):
        array, same = np.empty(0), False
    fits = len(array.shape) == len(shape) and all(b is None or a == b for a, b in zip(array.shape, shape, strict=True))
    if not (same and fits and np.isfinite(array).all()):
        raise error(f"{needed}; given is {reprlib.repr(values)}")
    return array
