"""What the kernel that paints a field does, element by element over all pixels."""

from __future__ import annotations

import numpy as np


def paint_field(out, grey, x, y, elements, values, low, high, colours, share, nearest):
    out[:] = grey * np.uint32(0x010101) | np.uint32(0xFF000000)
    rows, columns = np.indices(out.shape)
    under = (grey.astype(np.uint32) * share >> 8) * 0x010101
    for element in elements:
        corners, own = np.stack([x[element], y[element], np.ones(3)]), values[element]
        if not np.isfinite(corners).all() or not np.isfinite(own).all() or abs(np.linalg.det(corners)) < 1e-12:
            continue
        weights = np.einsum("ij,jrc->irc", np.linalg.inv(corners), np.stack([columns, rows, np.ones(out.shape)]))
        inside = weights.min(axis=0) >= -1e-6
        value = own[weights.argmax(axis=0)] if nearest else np.einsum("i,irc->rc", own, weights)
        place = np.clip((value - low) / (high - low) * len(colours), 0, len(colours) - 1).astype(int)
        out[inside] = (colours[place] + under)[inside]
