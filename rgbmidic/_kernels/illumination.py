"""From a Bayer mosaic to channels, and from channels to lights.

The mosaic comes padded by two pixels on every side, mirrored about the border pixel, which keeps the Bayer phase; a
sample that must not be used is NaN there and spreads to all it takes part in. ``red_row, red_column`` are the position
of red in the 2x2 cell of the unpadded mosaic; blue is diagonal to it.
"""

import numpy as np

from rgbmidic._kernels.threads import compiled


@compiled("out", axis=1)
def unmix(start, stop, channels, valid, grid, step, needed, out, out_valid):
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
            values[:], ok[:] = 0.0, True
            for colour in range(colours):
                given, known = channels[colour, y], valid[colour, y]
                for gx in range((width + step - 1) // step):
                    first, number = np.uint64(gx * step), np.uint64(min(step, width - gx * step))
                    above, below = grid[gy, gx, light, colour], grid[gy + 1, gx, light, colour]
                    left = above + (below - above) * down
                    above, below = grid[gy, gx + 1, light, colour], grid[gy + 1, gx + 1, light, colour]
                    slope = (above + (below - above) * down - left) / np.float32(step)
                    for i in range(number):
                        factor, value = left + slope * np.float32(np.int32(i)), given[first + i]
                        values[first + i] += factor * value if np.isfinite(value) else np.float32(0.0)
                if needed[light, colour]:
                    for x in range(np.uint64(width)):
                        ok[x] &= known[x]
            for x in range(np.uint64(width)):
                values[x] = values[x] if ok[x] else np.float32(np.nan)


PAD = 2
"""Pixels by which a mosaic is padded on every side."""


@compiled("out", axis=1)
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
