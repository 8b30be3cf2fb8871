"""How bright each light is in a state, against the reference: lamps flicker, shutters jitter, a light goes out."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation.reference import Reference
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["brightness_change"]


_LEAST = 12
"""Pixels of an element that must be known in both states."""
_ENOUGH = 36
"""Pixels of an element that are looked at, about."""
_MANY = 400
"""Elements that are looked at, about: the median over them is known to 6 % of their scatter."""


def brightness_change(
    first: FloatImage, second: FloatImage, reference: Reference, displacement: FloatArray
) -> FloatArray:
    """Gain and offset of every light, ``second = gain first + offset``, as the median over the elements.

    The gain is the ratio of the speckle's contrasts (what the lamp gives), which noise that is alike in both states
    changes little; the offset is what the mean has beyond that (reflections, stray light).

    Parameters
    ----------
    first, second : ndarray, shape (k, H, W)
        Images of the two states in grey levels, before any normalisation; NaN where unknown.
    reference
        Mesh and pixels of the reference state.
    displacement : ndarray, shape (N, 2)
        Of the nodes in px; elements with a node that is NaN are left out.

    Returns
    -------
    ndarray, shape (k, 2)
        Gain and offset (grey levels); NaN where no element is seen in both states.
    """
    mesh, pixels = reference.mesh, reference.pixels
    count = len(mesh.elements)
    motion = displacement[mesh.elements].mean(axis=1)
    chosen = np.zeros(count, dtype=bool)
    chosen[:: max(1, count // _MANY)] = True
    slots = np.flatnonzero(np.repeat(chosen, np.diff(pixels.offsets)))
    slots = slots[:: max(1, slots.size // (_ENOUGH * int(chosen.sum())))]
    owner = np.searchsorted(pixels.offsets, slots, side="right") - 1
    step = np.round(np.nan_to_num(motion)).astype(np.int64)[owner]
    place = np.stack([pixels.local_x[slots], pixels.local_y[slots]]).astype(np.int64)
    columns, rows = place + pixels.origin[owner].T
    there = rows + step[:, 1], columns + step[:, 0]
    height, width = first.shape[1:]
    inside = (there[0] >= 0) & (there[0] < height) & (there[1] >= 0) & (there[1] < width)
    inside &= np.isfinite(motion).all(axis=1)[owner]
    moved = np.clip(there[0], 0, height - 1), np.clip(there[1], 0, width - 1)
    return np.array(
        [_gain_and_offset(f[rows, columns], g[moved], inside, owner, count) for f, g in zip(first, second, strict=True)]
    )


def _gain_and_offset(
    f: FloatImage, g: FloatImage, inside: BoolArray, owner: npt.NDArray[np.int64], elements: int
) -> tuple[float, float]:
    known = inside & np.isfinite(f) & np.isfinite(g)
    owner = owner[known]
    number = np.bincount(owner, minlength=elements)
    many = number >= _LEAST

    def moments(values: FloatImage) -> tuple[FloatArray, FloatArray]:
        exact = values[known].astype(np.float64)
        mean = np.bincount(owner, weights=exact, minlength=elements)[many] / number[many]
        square = np.bincount(owner, weights=exact**2, minlength=elements)[many] / number[many]
        return mean, np.maximum(square - mean**2, 0)

    (mean_f, contrast_f), (mean_g, contrast_g) = moments(f), moments(g)
    textured = contrast_f > 0.05 * np.median(contrast_f) if many.any() else np.zeros(0, dtype=bool)
    if not textured.any():
        return float("nan"), float("nan")
    gain = float(np.median(np.sqrt(contrast_g[textured] / contrast_f[textured])))
    return gain, float(np.median(mean_g[textured] - gain * mean_f[textured]))
