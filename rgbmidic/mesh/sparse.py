"""Sparse matrices of one structure with different entries."""

from __future__ import annotations

from copy import copy
from typing import TypeVar

import scipy.sparse as sp

from rgbmidic.typing import FloatArray

__all__ = ["with_data"]

Matrix = TypeVar("Matrix", sp.csr_matrix, sp.csc_matrix)


def with_data(structure: Matrix, data: FloatArray) -> Matrix:
    """A matrix with the structure of another, shared with it and not looked through again, and its own `data`."""
    matrix = copy(structure)
    matrix.data = data
    return matrix
