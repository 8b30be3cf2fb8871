"""One image per illumination: what the demosaiced or 3-CCD channels become once the crosstalk is unmixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import InputError
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
    covariance : ndarray, shape (k, k), float64, or None
        Covariance of the camera noise of the k values at one pixel (DN squared), at the median grey level of the
        images; None where the camera noise is not known.
    reflection_index : ndarray, shape (k, H, W), float32, or None
        Share of a light that is not diffuse, from a single frame: 0 where its contrast is that of the light with the
        most contrast there, towards 1 in its reflection; None where the separation does not tell.
    texture : TextureModel or None
        The speckle's autocorrelation that the separation took, to be shared by all frames of a test; None where it
        needs none.
    """

    values: FloatImage
    valid: BoolArray
    names: tuple[str, ...]
    full_scale: float
    covariance: FloatArray | None = None
    reflection_index: FloatImage | None = None
    texture: TextureModel | None = None

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float32)
        if values.ndim != 3:
            raise InputError(f"illumination images have shape (k, H, W), not {values.shape}")
        valid = np.asarray(self.valid, dtype=bool) & np.isfinite(values)
        if len(self.names) != len(values):
            raise InputError(f"{len(values)} illumination images cannot carry the {len(self.names)} names {self.names}")
        object.__setattr__(self, "values", np.where(valid, values, np.float32(np.nan)))
        object.__setattr__(self, "valid", valid)

    @property
    def shape(self) -> tuple[int, int]:
        """Image size (H, W)."""
        return self.values.shape[1], self.values.shape[2]
