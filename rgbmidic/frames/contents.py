"""What a frame file holds and what it tells about itself, before the user's statements are added."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rgbmidic.errors import FrameError
from rgbmidic.settings import FrameKind
from rgbmidic.typing import AnyArray, FloatArray

__all__ = ["FileContents", "damaged"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FileContents:
    """The samples of one frame with what its file tells; None where the file does not say.

    Attributes
    ----------
    values : ndarray, shape (H, W) or (H, W, 3), uint8 or uint16
        Raw grey levels (DN); three channels are R, G, B.
    kind
        ``"rgb"`` where the file has three channels; ``"bayer"`` or ``"monochrome"`` only where the file says so.
    cfa
        Bayer pattern valid for ``values[0, 0]``.
    black_level : ndarray, shape (2, 2), or None
        Black level (DN) of each position of the 2x2 cell.
    white_level
        Grey level (DN) of a saturated sample.
    """

    values: AnyArray
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: FloatArray | None = None
    white_level: float | None = None


def damaged(path: Path, reason: object) -> FrameError:
    """Error for a file that cannot be read whole."""
    return FrameError(f"{path} is damaged or truncated: {reason}")
