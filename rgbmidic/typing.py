"""Types of the annotations: arrays, whose shapes a docstring tells, and callbacks."""

from collections.abc import Callable
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
Progress = Callable[[int, int, str], None]
"""Called with the number of things done, their total and a line about the last one."""
