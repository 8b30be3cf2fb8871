"""How bright each light is in a state, against the reference: lamps flicker, shutters jitter, a light goes out."""

from __future__ import annotations

import numpy as np

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
    first: FloatImage,
    second: FloatImage,
    reference: Reference,
    displacement: FloatArray,
) -> FloatArray:
    """Gain and offset of every light, ``second = gain first + offset``, as the median over the elements.

    The gain is the ratio of the speckle's contrasts (what the lamp gives), which noise that is alike in both states
    changes little; the offset is what the mean has beyond that (reflections, stray light).

    Parameters
    ----------
    first, second : ndarray, shape (k, H, W)
        Images of the two states in grey levels, before any normalisation, of one size or not; NaN where unknown.
    reference
        Mesh and pixels of the reference state.
    displacement : ndarray, shape (N, 2)
        Of the nodes in px, from their place in the first images to that in the second; elements with a node that is NaN
        are left out.

    Returns
    -------
    ndarray, shape (k, 2)
        Gain and offset (grey levels); NaN where no element is seen in both states.
    """
    mesh, pixels = reference.mesh, reference.pixels
    chosen = np.arange(0, len(mesh.elements), max(1, len(mesh.elements) // _MANY))
    motion, size = displacement[mesh.elements[chosen]].mean(axis=1), np.diff(pixels.offsets)[chosen]
    seen = np.isfinite(motion).all(axis=1) & (size >= _LEAST)
    chosen, step, size = chosen[seen], np.round(motion[seen]).astype(np.int64), size[seen]
    slots = pixels.offsets[chosen, None] + np.arange(_ENOUGH) * size[:, None] // _ENOUGH
    columns = pixels.local_x[slots].astype(np.int64) + pixels.origin[chosen, :1]
    rows = pixels.local_y[slots].astype(np.int64) + pixels.origin[chosen, 1:]
    height, width = second.shape[1:]
    across, down = columns + step[:, :1], rows + step[:, 1:]
    inside = (down >= 0) & (down < height) & (across >= 0) & (across < width)
    there = np.clip(down, 0, height - 1) * width + np.clip(across, 0, width - 1)
    f, g = (
        np.take(images.reshape(len(images), -1), at, axis=1)
        for images, at in ((first, rows * first.shape[2] + columns), (second, there))
    )
    return np.array([_gain_and_offset(*pair, inside) for pair in zip(f, g, strict=True)])


def _gain_and_offset(f: FloatImage, g: FloatImage, inside: BoolArray) -> tuple[float, float]:
    """From the samples (E, n) of elements."""
    known = inside & np.isfinite(f) & np.isfinite(g)
    known &= known.sum(axis=1, keepdims=True) >= _LEAST
    seen = np.asarray(known.any(axis=1))
    known, number = known[seen], known[seen].sum(axis=1)

    def moments(values: FloatImage) -> tuple[FloatArray, FloatArray]:
        exact = np.where(known, values[seen], 0).astype(np.float64)
        mean = exact.sum(axis=1) / number
        return mean, np.maximum((exact**2).sum(axis=1) / number - mean**2, 0)

    (mean_f, contrast_f), (mean_g, contrast_g) = moments(f), moments(g)
    textured = contrast_f > 0.05 * np.median(contrast_f) if seen.any() else seen[:0]
    if not textured.any():
        return float("nan"), float("nan")
    gain = float(np.median(np.sqrt(contrast_g[textured] / contrast_f[textured])))
    return gain, float(np.median(mean_g[textured] - gain * mean_f[textured]))
