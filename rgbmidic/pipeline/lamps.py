"""The light of the lamps in a frame over that in the reference, in grey levels, whatever the solve takes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import Reference
from rgbmidic.correlation.brightness import ELEMENTS, gain_and_offset
from rgbmidic.typing import FloatArray, FloatImage, IntArray

LEAST_GAIN = 0.3
"""Light of a lamp over that in the reference, below which the lamp seems to fail; chosen."""
_MIN_PIXELS = 12
"""Pixels of an element that must be known in both states: a contrast of 12 values is known to 20 % (derived)."""
_SAMPLES = 36
"""Pixels of an element that are looked at: their contrast is known to 12 % (derived)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LampLight:
    """Grey levels of the reference at some pixels of M elements, with which those of the frames are compared.

    Attributes
    ----------
    corners : ndarray, shape (M, 3)
        Nodes of the elements.
    centres : ndarray, shape (M, 2)
        Their centres (x, y), px.
    rows, columns : ndarray, shape (M, n)
        The pixels.
    values : ndarray, shape (k, M, n)
        Grey levels there; NaN where unknown.
    """

    corners: npt.NDArray[np.int32]
    centres: FloatArray
    rows: IntArray
    columns: IntArray
    values: FloatArray

    @classmethod
    def of(cls, images: FloatImage, reference: Reference) -> LampLight:
        """Take the grey levels of a reference out of its images (k, H, W)."""
        mesh, pixels = reference.mesh, reference.pixels
        elements = np.arange(0, len(mesh.elements), 1 + len(mesh.elements) // ELEMENTS)
        size = np.diff(pixels.offsets)[elements]
        elements, size = elements[size >= _MIN_PIXELS], size[size >= _MIN_PIXELS]
        slots = pixels.offsets[elements, None] + np.arange(_SAMPLES) * size[:, None] // _SAMPLES
        columns = pixels.local_x[slots].astype(np.int64) + pixels.origin[elements, :1]
        rows = pixels.local_y[slots].astype(np.int64) + pixels.origin[elements, 1:]
        return cls(
            corners=mesh.elements[elements],
            centres=mesh.centres[elements],
            rows=rows,
            columns=columns,
            values=images[:, rows, columns].astype(np.float64),
        )

    def change(self, images: FloatImage, displacement: FloatArray) -> FloatArray:
        """Return gain and offset of every light, ``frame = gain reference + offset``, in grey levels.

        They are those of `gain_and_offset`, whatever the solve takes of them, against the first reference, and of a
        lamp that is off, too: the gain is what the lamp gives, the offset what the mean has beyond that (reflections,
        stray light) in the middle of the elements.

        Parameters
        ----------
        images : ndarray, shape (k, H, W)
            Images of the frame, of the size of the reference's or not; NaN where unknown.
        displacement : ndarray, shape (N, 2)
            Of the nodes in px, from their place in the reference's images to that in the frame's; elements with a node
            that is NaN are left out.

        Returns
        -------
        ndarray, shape (k, 2)
            Gain and offset (grey levels); NaN where no element is seen in both states.
        """
        motion = displacement[self.corners].mean(axis=1)
        usable = np.isfinite(motion).all(axis=1)
        if not usable.any():
            return np.full((len(images), 2), np.nan)
        step, (height, width) = np.round(motion[usable]).astype(np.int64), images.shape[1:]
        across, down = self.columns[usable] + step[:, :1], self.rows[usable] + step[:, 1:]
        inside = (down >= 0) & (down < height) & (across >= 0) & (across < width)
        f = self.values[:, usable]
        g = images[:, np.clip(down, 0, height - 1), np.clip(across, 0, width - 1)].astype(np.float64)
        valid = inside & np.isfinite(f) & np.isfinite(g)
        valid &= valid.sum(axis=-1, keepdims=True) >= _MIN_PIXELS
        f, g = np.where(valid, f, 0), np.where(valid, g, 0)
        moments = np.stack(
            [valid.sum(axis=-1), *(product.sum(axis=-1) for product in (f, g, f * f, f * g, g * g))], axis=-1
        )
        centres = self.centres[usable]
        gain, offset = gain_and_offset(moments, centres - centres.mean(axis=0), -1.0)
        return np.stack([gain, np.where(np.isfinite(gain), offset[:, 0], np.nan)], axis=1)


def dimmed_lights(lights: Sequence[str], brightness: FloatArray) -> list[tuple[str, float]]:
    """Name the lights whose lamp seems to fail, and the gain of each: under `LEAST_GAIN`."""
    return [(light, gain) for light, gain in zip(lights, brightness[:, 0], strict=True) if gain < LEAST_GAIN]
