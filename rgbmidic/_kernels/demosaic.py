"""Compiled loops that turn one padded Bayer mosaic into three full channels.

The mosaic comes padded by two pixels on every side, mirrored about the border pixel, which keeps the Bayer phase; a
sample that must not be used is NaN there and spreads to all it takes part in. ``red_row, red_column`` are the position
of red in the 2x2 cell of the unpadded mosaic; blue is diagonal to it.
"""

import numpy as np

from rgbmidic._kernels.compilation import compiled, helper
from rgbmidic._kernels.threads import over_ranges

__all__ = ["PAD", "malvar", "pad_mosaic"]

PAD = 2
"""Pixels added on every side by `pad_mosaic`."""


@helper()
def _mirror(index, size):
    period = 2 * (size - 1)
    index = abs(index) % period
    return min(index, period - index)


@over_ranges("out")
@compiled()
def pad_mosaic(start, stop, values, invalid, out):
    """Copy (H, W) `values` into (H + 4, W + 4) `out`, mirrored at the borders, NaN where `invalid`; H, W >= 2."""
    rows, columns = values.shape
    for i in range(start, stop):
        source = _mirror(i - PAD, rows)
        for j in range(columns):
            out[i, j + PAD] = np.nan if invalid[source, j] else values[source, j]
        for side in range(PAD):
            left = _mirror(side - PAD, columns)
            right = _mirror(columns + side, columns)
            out[i, side] = np.nan if invalid[source, left] else values[source, left]
            out[i, columns + PAD + side] = np.nan if invalid[source, right] else values[source, right]


@over_ranges("out", axis=1)
@compiled()
def malvar(start, stop, padded, red_row, red_column, out):
    """Bilinear average corrected by the Laplacian of the sampled channel (Malvar 2004); fills (3, H, W) `out`."""
    columns = out.shape[2]
    for i in range(start, stop):
        above2, above, here, below, below2 = padded[i], padded[i + 1], padded[i + 2], padded[i + 3], padded[i + 4]
        in_red_row = i % 2 == red_row
        own = 0 if in_red_row else 2
        own_start = red_column if in_red_row else 1 - red_column
        own_out, green_out, other_out = out[own, i], out[1, i], out[2 - own, i]
        for j in range(own_start, columns, 2):
            c = j + PAD
            centre = here[c]
            cross = above[c] + below[c] + here[c - 1] + here[c + 1]
            far = above2[c] + below2[c] + here[c - 2] + here[c + 2]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            own_out[j] = centre
            green_out[j] = 0.125 * (4 * centre + 2 * cross - far)
            other_out[j] = 0.125 * (6 * centre + 2 * diagonal - 1.5 * far)
        for j in range(1 - own_start, columns, 2):
            c = j + PAD
            centre = here[c]
            across, along = here[c - 1] + here[c + 1], above[c] + below[c]
            across2, along2 = here[c - 2] + here[c + 2], above2[c] + below2[c]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            own_out[j] = 0.125 * (5 * centre + 4 * across - across2 - diagonal + 0.5 * along2)
            green_out[j] = centre
            other_out[j] = 0.125 * (5 * centre + 4 * along - along2 - diagonal + 0.5 * across2)
