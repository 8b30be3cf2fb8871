"""From a Bayer mosaic to channels, and from channels to lights.

`malvar` takes the mosaic padded by two pixels on every side, mirrored about the border pixel, which keeps the Bayer
phase; a sample that must not be used is NaN there and spreads to all it takes part in. ``red_row, red_column`` are the
position of red in the 2x2 cell of the unpadded mosaic; blue is diagonal to it.
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
                samples, sample_valid = channels[colour, y], valid[colour, y]
                for gx in range((width + step - 1) // step):
                    first, number = np.uint64(gx * step), np.uint64(min(step, width - gx * step))
                    above, below = grid[gy, gx, light, colour], grid[gy + 1, gx, light, colour]
                    factor_left = above + (below - above) * down
                    above, below = grid[gy, gx + 1, light, colour], grid[gy + 1, gx + 1, light, colour]
                    slope = (above + (below - above) * down - factor_left) / np.float32(step)
                    for i in range(number):
                        factor, value = factor_left + slope * np.float32(np.int32(i)), samples[first + i]
                        values[first + i] += factor * value if np.isfinite(value) else np.float32(0.0)
                if needed[light, colour]:
                    for x in range(np.uint64(width)):
                        ok[x] &= sample_valid[x]
            for x in range(np.uint64(width)):
                values[x] = values[x] if ok[x] else np.float32(np.nan)


PAD = 2
"""Pixels by which a mosaic is padded on every side."""


@compiled("out", axis=1)
def malvar(start, stop, padded, red_row, red_column, out):
    """Bilinear average corrected by the Laplacian of the sampled channel (Malvar 2004); fills (3, H, W) `out`."""
    columns = out.shape[2]
    for i in range(start, stop):
        above2, above, centre_row, below, below2 = padded[i], padded[i + 1], padded[i + 2], padded[i + 3], padded[i + 4]
        in_red_row = i % 2 == red_row
        row_colour = 0 if in_red_row else 2
        first_column = red_column if in_red_row else 1 - red_column
        row_colour_out, green_out, other_out = out[row_colour, i], out[1, i], out[2 - row_colour, i]
        for j in range(first_column, columns, 2):
            c = j + PAD
            centre = centre_row[c]
            cross = above[c] + below[c] + centre_row[c - 1] + centre_row[c + 1]
            far = above2[c] + below2[c] + centre_row[c - 2] + centre_row[c + 2]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            row_colour_out[j] = centre
            green_out[j] = 0.125 * (4 * centre + 2 * cross - far)
            other_out[j] = 0.125 * (6 * centre + 2 * diagonal - 1.5 * far)
        for j in range(1 - first_column, columns, 2):
            c = j + PAD
            centre = centre_row[c]
            across, along = centre_row[c - 1] + centre_row[c + 1], above[c] + below[c]
            across2, along2 = centre_row[c - 2] + centre_row[c + 2], above2[c] + below2[c]
            diagonal = above[c - 1] + above[c + 1] + below[c - 1] + below[c + 1]
            row_colour_out[j] = 0.125 * (5 * centre + 4 * across - across2 - diagonal + 0.5 * along2)
            green_out[j] = centre
            other_out[j] = 0.125 * (5 * centre + 4 * along - along2 - diagonal + 0.5 * across2)


@compiled("values")
def subtract_black(start, stop, samples, black, white, values, saturated):
    """Write ``values = samples - black`` of a mosaic (H, W) as float32, and where the samples reach `white`.

    `black` (2, W) float32 has the levels along even and along odd rows.
    """
    for i in range(start, stop):
        line, level, target, marks = samples[i], black[i % 2], values[i], saturated[i]
        for j in range(line.size):
            target[j] = np.float32(line[j]) - level[j]
            marks[j] = line[j] >= white


@compiled("square", axis=1)
def common_slopes(start, stop, variance, covariance, energy, allowed, to_lights, to_pairs, square, specific):
    """One-factor analysis of three channels in each block, less what the lights' sparkle adds to their covariances.

    `variance` (3, h, w) of the channels; `covariance` (3, h, w) of red green, red blue, green blue, to be divided by
    `energy` (3,), and before that freed of ``to_pairs @ max(to_lights @ sparkle, 0)``; to_lights: (k, 3), to_pairs:
    (3, k). `allowed` is what all channels may have of their own. `square` (3, h, w) receives the squares of the slopes,
    `specific` the channels' own variances relative to them.
    """
    lights, sparkle, leaked = len(to_lights), np.empty(3), np.empty(3)
    for i in range(start, stop):
        for j in range(square.shape[2]):
            least = 1e-4 * min(variance[0, i, j], variance[1, i, j], variance[2, i, j])
            sparkle[:] = 0.0
            for _ in range(2):  # the correction is small and settles at once
                leaked[:] = 0.0
                for light in range(lights):
                    a, b, c = to_lights[light]
                    seen = max(a * sparkle[0] + b * sparkle[1] + c * sparkle[2], 0.0)
                    for pair in range(3):
                        leaked[pair] += to_pairs[pair, light] * seen
                red_green = max((covariance[0, i, j] - leaked[0]) / energy[0], least)
                red_blue = max((covariance[1, i, j] - leaked[1]) / energy[1], least)
                green_blue = max((covariance[2, i, j] - leaked[2]) / energy[2], least)
                square[0, i, j] = min(red_green * red_blue / green_blue, variance[0, i, j])
                square[1, i, j] = min(red_green * green_blue / red_blue, variance[1, i, j])
                square[2, i, j] = min(red_blue * green_blue / red_green, variance[2, i, j])
                excess = np.inf
                for c in range(3):
                    specific[c, i, j] = variance[c, i, j] / square[c, i, j]
                    excess = min(excess, specific[c, i, j])
                # at least one channel is free of reflections at each place, unless it shows too much of its own
                for c in range(3):
                    specific[c, i, j] += max(excess - 1.0 - allowed, 0.0) - excess
                    sparkle[c] = specific[c, i, j] * square[c, i, j]
