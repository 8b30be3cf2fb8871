"""Triangles over nodes in a plane: their order and their areas."""

from __future__ import annotations

import reprlib

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.typing import AnyArray, FloatArray, as_numbers


def orient_elements(
    points: npt.ArrayLike, elements: npt.ArrayLike, name: str
) -> tuple[FloatArray, npt.NDArray[np.int32], FloatArray]:
    """Copies of nodes and triangles, checked and of their types, with corners as the axes turn; and twice the areas."""
    nodes = np.ascontiguousarray(as_numbers(points, f"{name} has finite nodes (N, 2)", (None, 2)))
    corners = as_numbers(elements, f"{name} has elements (E, 3), indices of nodes", (None, 3), dtype=np.int32)
    if not len(corners) or corners.min() < 0 or corners.max() >= len(nodes):
        raise InputError(f"{name}: elements (E, 3) must be there and name existing nodes")
    area = cross(nodes, corners)
    corners[area < 0] = corners[area < 0][:, [0, 2, 1]]
    return nodes, corners, np.abs(area)


def cross(points: FloatArray, elements: npt.NDArray[np.integer]) -> FloatArray:
    """Return twice the signed area (...) of triangles (..., 3)."""
    first, second = (points[elements[..., corner]] - points[elements[..., 0]] for corner in (1, 2))
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


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
    shape_matches = array.ndim == len(shape) and all(
        expected in (None, length) for expected, length in zip(shape, array.shape, strict=True)
    )
    if array.dtype.kind not in kinds or not shape_matches:
        noun = "True or False" if kinds == "b" else "numbers"
        size = ", ".join("any" if length is None else str(length) for length in shape)
        raise InputError(f"{name} must be an array ({size}) of {noun}; given is {reprlib.repr(values)}")
    return array
