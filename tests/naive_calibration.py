"""Slow obvious twin of the kernel that unmixes with a matrix that varies over the field."""

from __future__ import annotations

import numpy as np


def unmix_field(channels, valid, grid, step, needed):
    """Every pixel with its own bilinearly interpolated matrix."""
    colours, height, width = channels.shape
    lights = grid.shape[2]
    out = np.full((lights, height, width), np.nan)
    for y in range(height):
        for x in range(width):
            j, i = y // step, x // step
            t, s = y / step - j, x / step - i
            above = (1 - s) * grid[j, i] + s * grid[j, i + 1]
            below = (1 - s) * grid[j + 1, i] + s * grid[j + 1, i + 1]
            matrix = (1 - t) * above + t * below
            for light in range(lights):
                usable = [c for c in range(colours) if valid[c, y, x]]
                if all(valid[c, y, x] or not needed[light, c] for c in range(colours)):
                    out[light, y, x] = sum(matrix[light, c] * channels[c, y, x] for c in usable)
    return out
