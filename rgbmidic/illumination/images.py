"""One image per illumination: what the demosaiced or 3-CCD channels become once the crosstalk is unmixed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.linearise import LinearChannels
from rgbmidic.illumination.texture import TextureModel
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["REFLECTING", "IlluminationImages"]

REFLECTING = 0.2
"""Reflection index from which a light counts as reflecting."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IlluminationImages:
    """The k illumination images of one mechanical state.

    Attributes
    ----------
    values : ndarray, shape (k, H, W), float32
        Grey level each light alone would give (DN above black in the channel the light is named after);
        NaN where not valid.
    valid : ndarray, shape (k, H, W), bool
        False where the value is unknown, for instance because a saturated sample took part in it.
    names : tuple of str, length k
        The lights' names.
    full_scale : float
        Grey level of a just saturated camera sample (DN above black).
    reflection : ndarray, shape (k, h, w), or None
        What `reflection_index` tells, on a grid of blocks of 8 px.
    texture : TextureModel or None
        The speckle's autocorrelation as the separation took it: hand it on to the other frames of a test; None where
        the separation does not use it.
    origin : tuple of int
        Column and row of the frame at which the images begin.
    """

    values: FloatImage
    valid: BoolArray
    names: tuple[str, ...]
    full_scale: float
    reflection: FloatArray | None = None
    texture: TextureModel | None = None
    origin: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float32)
        if values.ndim != 3:
            raise InputError(f"illumination images have shape (k, H, W), not {values.shape}")
        valid = np.asarray(self.valid, dtype=bool) & np.isfinite(values)
        if len(self.names) != len(values):
            raise InputError(f"{len(values)} illumination images cannot carry the {len(self.names)} names {self.names}")
        object.__setattr__(self, "values", values if valid.all() else np.where(valid, values, np.float32(np.nan)))
        object.__setattr__(self, "valid", valid)

    @classmethod
    def in_succession(cls, frames: Sequence[LinearChannels], names: Sequence[str] = ()) -> IlluminationImages:
        """Lights fired one after the other before a monochrome camera, from one frame (1, H, W) of each.

        Raises
        ------
        InputError
            The frames have different shapes, or the calibration that `names` come from is of another number of lights.
        """
        if names and len(names) != len(frames):
            raise InputError(
                f"the frames show {len(frames)} lights in succession (frames.path or frames.lights), but the "
                f"calibration is of {len(names)}: {', '.join(names)}"
            )
        if len(shapes := {frame.values.shape for frame in frames}) > 1:
            raise InputError(f"frames of lights in succession must have one shape; given are {sorted(shapes)}")
        return cls(
            values=np.concatenate([frame.values for frame in frames]),
            valid=np.concatenate([frame.valid for frame in frames]),
            names=tuple(names)
            or (("light",) if len(frames) == 1 else tuple(f"light {i + 1}" for i in range(len(frames)))),
            full_scale=frames[0].full_scale,
        )

    def reflection_index(self, step: int = 1, within: tuple[slice, slice] | None = None) -> FloatImage | None:
        """Share of a light that is not diffuse, from a single frame, (k, H, W) at every `step`-th pixel, of all or
        of the rows and columns `within`, which begin at whole multiples of 8.

        0 where its contrast is that of the light with the most contrast there, towards 1 in its reflection; None where
        the separation does not tell.
        """
        from rgbmidic.illumination.colour_factors import BLOCK, enlarged  # reading a result takes no kernels

        if self.reflection is None:
            return None
        rows, columns = within or (slice(0, self.shape[0]), slice(0, self.shape[1]))
        grid = self.reflection[:, rows.start // BLOCK : -(-rows.stop // BLOCK)]
        shape = rows.stop - rows.start, columns.stop - columns.start
        return enlarged(grid[..., columns.start // BLOCK : -(-columns.stop // BLOCK)], BLOCK, shape, step)

    @property
    def shape(self) -> tuple[int, int]:
        """Image size (H, W)."""
        return self.values.shape[1], self.values.shape[2]
