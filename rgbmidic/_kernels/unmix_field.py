"""Compiled loop that turns camera channels into lights with a matrix that varies slowly over the field."""

import numpy as np

from rgbmidic._kernels.compilation import compiled
from rgbmidic._kernels.threads import over_ranges

__all__ = ["unmix_field"]


@over_ranges("out", axis=1)
@compiled()
def unmix_field(start, stop, channels, valid, grid, step, needed, out, out_valid):
    """``out = matrix(x, y) @ channels`` with the matrix interpolated linearly between grid points `step` px apart.

    channels, valid: (C, H, W); grid: (GY, GX, k, C) at x, y = 0, step, 2 step ... beyond the last pixel; needed:
    (k, C); out, out_valid: (k, H, W). Invalid where a `needed` channel is; one not needed
    contributes the value it has, NaN nothing.
    """
    colours, lights, width = channels.shape[0], out.shape[0], out.shape[2]
    for y in range(start, stop):
        gy = y // step
        down = np.float32(y - gy * step) / np.float32(step)
        for light in range(lights):
            values, ok = out[light, y], out_valid[light, y]
            for x in range(width):
                values[x], ok[x] = 0.0, True
            for colour in range(colours):
                counts = needed[light, colour]
                for gx in range((width + step - 1) // step):
                    first, last = gx * step, min((gx + 1) * step, width)
                    above, below = grid[gy, gx, light, colour], grid[gy + 1, gx, light, colour]
                    left = above + (below - above) * down
                    above, below = grid[gy, gx + 1, light, colour], grid[gy + 1, gx + 1, light, colour]
                    slope = (above + (below - above) * down - left) / np.float32(step)
                    for x in range(first, last):
                        value = channels[colour, y, x]
                        factor = left + slope * np.float32(x - first)
                        values[x] += factor * value if np.isfinite(value) else np.float32(0.0)
                        ok[x] &= valid[colour, y, x] or not counts
            for x in range(width):
                values[x] = values[x] if ok[x] else np.float32(np.nan)
