"""What every demosaicing method takes and gives."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.frames.data import cfa_channels
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic

__all__ = ["Demosaicer", "check_mosaic", "red_position"]


@runtime_checkable
class Demosaicer(Protocol):
    """Gives every pixel all three camera channels, from a mosaic that has one of them at each.

    Calling it with a `LinearMosaic` of size (H, W) gives `LinearChannels` of shape (3, H, W), order R, G, B. A value
    is invalid, and NaN, when a saturated sample took part in it.
    """

    def __call__(self, mosaic: LinearMosaic) -> LinearChannels: ...


def check_mosaic(mosaic: LinearMosaic) -> None:
    """Raise `InputError` unless `mosaic` has at least one full 2x2 cell and consistent arrays."""
    if not isinstance(mosaic, LinearMosaic):
        raise InputError(f"demosaicing takes a LinearMosaic, not {type(mosaic).__name__}")
    if mosaic.values.ndim != 2 or min(mosaic.values.shape) < 2:
        raise InputError(f"a mosaic has at least 2 rows and 2 columns; given is shape {mosaic.values.shape}")
    if mosaic.saturated.shape != mosaic.values.shape:
        raise InputError(
            f"the saturation mask has shape {mosaic.saturated.shape}, the mosaic has {mosaic.values.shape}"
        )


def red_position(cfa: str) -> tuple[int, int]:
    """Row and column of red in the 2x2 cell of a Bayer pattern."""
    row, column = np.argwhere(cfa_channels(cfa) == 0)[0]
    return int(row), int(column)
