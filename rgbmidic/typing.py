"""Types of the annotations: arrays, whose shapes are in docstrings, and callbacks; input as arrays of numbers."""

import reprlib
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.renamed import refuse_old_names

AnyArray = npt.NDArray[Any]
FloatArray = npt.NDArray[np.float64]
"""Coordinates, sums, matrices: double precision."""
FloatImage = npt.NDArray[np.float32]
"""Grey levels and weights at pixels: single precision."""
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]
"""Indices, and labels of nodes and elements."""
ProgressCallback = Callable[[int, int, str], None]
"""Called with the number of things done, their total and a line about the last one."""


def as_numbers(
    values: npt.ArrayLike,
    requirement: str,
    shape: tuple[int | None, ...],
    *,
    dtype: npt.DTypeLike = np.float64,
    error: type[RgbmidicError] = InputError,
) -> AnyArray:
    """Return a copy of input as an array of finite numbers of a type; None in the shape is any length.

    Raises
    ------
    RgbmidicError
        It is an `error` that states the `requirement` and the input: no numbers, another shape, not finite, or not
        representable in that type.
    """
    try:
        original = np.asarray(values)
        with np.errstate(invalid="ignore"):  # what the type does not hold differs
            array = original.astype(dtype) if original.dtype.kind in "buifO" else np.empty(0)
        is_lossless = bool((array == original).all()) if array.shape == original.shape else False
    except (TypeError, ValueError, OverflowError):
        array, is_lossless = np.empty(0), False
    if not (is_lossless and _has_shape(array, shape) and np.isfinite(array).all()):
        raise error(f"{requirement}; given is {reprlib.repr(values)}")
    return array


def as_values(values: npt.ArrayLike, name: str, shape: tuple[int | None, ...], kinds: str = "buif") -> AnyArray:
    """Return what nodes or elements have as an array, NaN included; None in the shape is any length.

    Raises
    ------
    InputError
        It is of no numbers (of no flags, for `kinds` "b"), or of another shape.
    """
    try:
        array = np.asarray(values)
    except ValueError:  # rows of several lengths
        array = np.empty(0, dtype=object)
    if array.dtype.kind not in kinds or not _has_shape(array, shape):
        noun = "True or False" if kinds == "b" else "numbers"
        size = ", ".join("any" if length is None else str(length) for length in shape)
        raise InputError(f"{name} must be an array ({size}) of {noun}; given is {reprlib.repr(values)}")
    return array


def _has_shape(array: AnyArray, shape: tuple[int | None, ...]) -> bool:
    return array.ndim == len(shape) and all(
        expected in (None, length) for expected, length in zip(shape, array.shape, strict=True)
    )


def unmasked(array: npt.ArrayLike) -> AnyArray:
    """Return an array whose masked entries are NaN: as floats where there are any, else of the dtype given."""
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        values: Any = array if array.dtype.kind in "fc" else array.astype(np.float64)
        return np.asarray(np.ma.filled(values, np.nan))
    return np.asarray(array)


__getattr__ = refuse_old_names(__name__)
