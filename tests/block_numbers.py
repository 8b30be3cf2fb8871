"""A kernel's work that a test can hand to another process, which must be able to import it by name."""

import numpy as np

from rgbmidic._kernels.grid import block_index
from rgbmidic._kernels.threads import set_threads


def blocks(seed):
    """Whether two threads number the blocks of 200,000 random pixels as numpy does."""
    set_threads(2)
    rows, columns = np.random.default_rng(seed).integers(0, 500, (2, 200_000), dtype=np.int32)
    out = np.empty(rows.size, dtype=np.int32)
    block_index(rows, columns, 0, 0, 7, 80, out)
    return bool((out == rows // 7 * 80 + columns // 7).all())
