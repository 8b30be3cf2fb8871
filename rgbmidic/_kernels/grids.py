"""Between the values of a coarse grid, one per block of pixels: linearly, beyond the outermost centres constant."""

import numpy as np

from rgbmidic._kernels.threads import helper


@helper()
def between(row, block, rows):
    """Return the two rows of a grid that a row of pixels lies between, and how far on from the first it is."""
    position = min(max((row + 0.5) / block - 0.5, 0.0), rows - 1.0)
    low = int(position)
    return low, min(low + 1, rows - 1), np.float32(position - low)
