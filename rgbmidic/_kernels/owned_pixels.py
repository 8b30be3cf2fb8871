"""The owned pixels of a region, moved to and from images of the rectangle around the region.

`lines` (R, 4) int32 are the rows of pixels of the elements: first slot, number of pixels, row and column in the
rectangle. Pixels are counted without sign: an index that may be negative would be looked at each time.
"""

import numpy as np

from rgbmidic._kernels.threads import compiled


@compiled("lines")
def to_image(start, stop, lines, values, top, left, out):
    """Write fields (n, P) float32 of the owned pixels into images ``out`` (n, H, W).

    The rectangle around the pixels begins at row `top` and column `left` of the images.
    """
    for n in range(len(values)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, row, column + i] = values[n, slot + i]


@compiled("lines")
def from_image(start, stop, lines, image, top, left, out):
    """Read fields ``out`` (n, P) at the owned pixels from such images (n, H, W)."""
    for n in range(len(image)):
        for q in range(start, stop):
            slot, number = np.uint64(lines[q, 0]), np.uint64(lines[q, 1])
            row, column = np.uint64(top + lines[q, 2]), np.uint64(left + lines[q, 3])
            for i in range(number):
                out[n, slot + i] = image[n, row, column + i]
