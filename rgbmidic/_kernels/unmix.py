"""Compiled loop that turns camera channels into lights, pixel by pixel."""

import numpy as np
from numba import njit, prange

__all__ = ["unmix"]

BLOCK = 4096
"""Pixels per task: what a core's fastest cache holds."""


@njit(cache=True, parallel=True, nogil=True)
def unmix(channels, valid, matrix, needed, out, out_valid):
    """``out = matrix @ channels`` at every pixel; invalid, and NaN, where a `needed` channel is invalid.

    channels, valid: (C, P); matrix, needed: (k, C); out, out_valid: (k, P). An invalid channel that is not needed
    contributes the value it has, NaN nothing.
    """
    lights, colours = matrix.shape
    pixels = channels.shape[1]
    for b in prange((pixels + BLOCK - 1) // BLOCK):
        start, stop = b * BLOCK, min((b + 1) * BLOCK, pixels)
        for light in range(lights):
            values, ok = out[light, start:stop], out_valid[light, start:stop]
            values[:] = 0.0
            ok[:] = True
            for colour in range(colours):
                factor, counts = matrix[light, colour], needed[light, colour]
                for p in range(stop - start):
                    value = channels[colour, start + p]
                    values[p] += factor * value if np.isfinite(value) else np.float32(0.0)
                    ok[p] &= valid[colour, start + p] or not counts
            for p in range(stop - start):
                values[p] = values[p] if ok[p] else np.float32(np.nan)
