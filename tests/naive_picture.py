"""What the kernel that paints a field does, pixel by pixel and element by element."""

from __future__ import annotations

import numpy as np

__all__ = ["paint_field"]


def paint_field(out, grey, x, y, elements, values, low, high, colours, share, nearest):
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            shown = int(grey[row, column]) * 0x010101 | 0xFF000000
            for element in elements:
                corners = np.stack([x[element], y[element], np.ones(3)])
                own = values[element]
                if not np.isfinite(corners).all() or not np.isfinite(own).all() or abs(np.linalg.det(corners)) < 1e-12:
                    continue
                weights = np.linalg.solve(corners, [column, row, 1.0])
                if weights.min() < -1e-6:
                    continue
                value = own[weights.argmax()] if nearest else weights @ own
                place = int(np.clip((value - low) / (high - low) * len(colours), 0, len(colours) - 1))
                shown = int(colours[place]) + (int(grey[row, column]) * share >> 8) * 0x010101
            out[row, column] = shown
