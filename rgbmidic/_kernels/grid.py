"""Compiled loops between the owned pixels and coarse grids of square blocks.

Pixels are counted without sign: an index that may be negative would be looked at each time.
"""

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.threads import over_ranges

__all__ = ["block_index", "block_sums", "from_image", "score_sums", "to_image"]

_SLAB = 16384
"""Ranges of pixels start at multiples of it."""


@over_ranges("out", grain=_SLAB)
@compiled()
def block_index(start, stop, rows, columns, top, left, block, width, out):
    """Number of the block (of a grid `width` blocks wide) in which each pixel lies: ``out`` (P,) int32."""
    for i in range(np.uint64(start), np.uint64(stop)):
        out[i] = (rows[i] - top) // block * width + (columns[i] - left) // block


@over_ranges("out")
@compiled()
def block_sums(start, stop, values, index, out):
    """Sums of fields (n, P) over blocks: ``out`` (n, B), zero before."""
    for n in range(start, stop):
        for i in range(index.size):
            out[n, index[i]] += values[n, i]


@over_ranges("out")
@compiled()
def score_sums(start, stop, residual, weight, gradient_x, gradient_y, index, out):
    """Per light, sums over blocks of ``w r gx``, ``w r gy``, ``w (gx gx + gy gy)`` and of the pixels with weight.

    The fields are (k, P) float32; `out` (k, 4, B) float64, zero before.
    """
    for j in range(start, stop):
        for i in range(index.size):
            w = weight[j, i]
            if w > 0:
                gx, gy = gradient_x[j, i], gradient_y[j, i]
                pull = w * residual[j, i]
                b = index[i]
                out[j, 0, b] += pull * gx
                out[j, 1, b] += pull * gy
                out[j, 2, b] += w * (gx * gx + gy * gy)
                out[j, 3, b] += 1.0


@over_ranges("runs")
@compiled()
def to_image(start, stop, runs, rows, columns, top, left, values, out):
    """Fields (n, P) float32 of the owned pixels as images: ``out`` (n, h, w), whose first pixel is (top, left)."""
    for n in range(values.shape[0]):
        for run in range(start, stop):
            slot, length = np.uint64(runs[run, 0]), np.uint64(runs[run, 1])
            line = out[n, rows[slot] - top, columns[slot] - left :]
            for i in range(length):
                line[i] = values[n, slot + i]


@over_ranges("runs")
@compiled()
def from_image(start, stop, runs, rows, columns, top, left, image, out):
    """The way back: ``out`` (n, P) from images (n, h, w)."""
    for n in range(image.shape[0]):
        for run in range(start, stop):
            slot, length = np.uint64(runs[run, 0]), np.uint64(runs[run, 1])
            line = image[n, rows[slot] - top, columns[slot] - left :]
            for i in range(length):
                out[n, slot + i] = line[i]
