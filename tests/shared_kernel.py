"""A kernel's work that a test can hand to another process, which must be able to import it by name."""

import numpy as np

from rgbmidic._kernels.owned_pixels import block_sums
from rgbmidic._kernels.threads import set_threads


def summed(seed):
    """Whether two threads sum over the blocks of a random image, each of whose rows is an element, as numpy does."""
    set_threads(2)
    image = np.random.default_rng(seed).uniform(size=(500, 400)).astype(np.float32)
    rows = np.arange(500)
    lines = np.stack([rows * 400, np.full(500, 400), rows, 0 * rows], axis=1).astype(np.int32)
    out = np.empty((1, 125, 100), dtype=np.float32)
    block_sums(image.reshape(1, -1), lines, np.arange(501), 4, out)
    return np.allclose(out[0], image.reshape(125, 4, 100, 4).sum(axis=(1, 3)), rtol=1e-5)
