"""Compiled loop that turns camera channels into lights, pixel by pixel."""

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.threads import over_ranges

__all__ = ["unmix"]

BLOCK = 4096
"""Pixels at a time: what a core's fastest cache holds."""


@over_ranges("out", axis=1, grain=BLOCK)
@compiled()
def unmix(start, stop, channels, valid, matrix, needed, out, out_valid):
    """``out = matrix @ channels`` at every pixel; invalid, and NaN, where a `needed` channel is invalid.

    channels, valid: (C, P); matrix, needed: (k, C); out, out_valid: (k, P). An invalid channel that is not needed
    contributes the value it has, NaN nothing.
    """
    lights, colours = matrix.shape
    for first in range(start, stop, BLOCK):
        last = min(first + BLOCK, stop)
        for light in range(lights):
            values, ok = out[light, first:last], out_valid[light, first:last]
            for p in range(last - first):
                values[p], ok[p] = 0.0, True
            for colour in range(colours):
                factor, counts = matrix[light, colour], needed[light, colour]
                given, known = channels[colour, first:last], valid[colour, first:last]
                for p in range(last - first):
                    values[p] += factor * given[p] if np.isfinite(given[p]) else np.float32(0.0)
                if counts:
                    for p in range(last - first):
                        ok[p] &= known[p]
            for p in range(last - first):
                values[p] = values[p] if ok[p] else np.float32(np.nan)
