"""What a file tells of a frame, and how what the user states joins it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames.data import BAYER_PATTERNS, ChannelFrame, Mosaic
from rgbmidic.settings import FrameKind, FrameSettings
from rgbmidic.typing import AnyArray, FloatArray

__all__ = ["CHECKED_FROM", "MAXIMUM_BYTES", "StoredFrame", "check_size", "damaged", "raw_frame"]

MAXIMUM_BYTES = 2 * 2**30
"""Largest frame that is unpacked: 1 Gpx of 16 bit, where large sensors have 150 Mpx, or 400 Mpx by shifting."""

CHECKED_FROM, _COMPRESSION = 32 * 2**20, 100
"""Frames of more bytes than the first are refused when stored in less than their hundredth.

Deflate stores real frames of 8 bit in a quarter (coins in the dark, 4.1), pure noise of .3 DN on a black level of zero
in a seventeenth, but empty pictures, which bombs are, in a thousandth.
"""

_T = TypeVar("_T")
_BLACK_TOLERANCE = 1.0
"""DN: a file's black levels differ by position, and LibRaw rounds some; less than a grey level is no contradiction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredFrame:
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
    bits
        Bits of a sample where they are fewer than those of its type.
    """

    values: AnyArray
    kind: FrameKind | None = None
    cfa: str | None = None
    black_level: FloatArray | None = None
    white_level: float | None = None
    bits: int | None = None

    @classmethod
    def plain(cls, values: AnyArray, path: Path, cfa: str | None = None) -> StoredFrame:
        """Samples (H, W) or (H, W, C) of a picture that tells neither levels nor, as a rule, its pattern.

        Raises
        ------
        FrameError
            There are neither one nor three channels.
        """
        if values.ndim == 3 and values.shape[2] == 1:
            values = values[..., 0]
        if values.ndim == 2:
            return cls(values=values, kind="bayer" if cfa else None, cfa=cfa)
        if values.ndim != 3 or values.shape[2] != 3:
            raise FrameError(f"{path} has samples of shape {values.shape}; allowed are one channel or three (RGB)")
        return cls(values=values, kind="rgb")


def damaged(path: Path, reason: object) -> FrameError:
    """Error for a file that cannot be read whole."""
    return FrameError(f"{path} is damaged or truncated: {reason}")


def check_size(path: Path, *, needed: int, stored: int) -> None:
    """Refuse, before anything is unpacked, a header that announces more than a camera's frame.

    Parameters
    ----------
    path
        The file, for messages.
    needed
        Bytes of the unpacked samples.
    stored
        Bytes that they are stored in.

    Raises
    ------
    FrameError
        They exceed `MAXIMUM_BYTES`, or no frame of a camera can be compressed so much.
    """
    if max(needed, stored) > MAXIMUM_BYTES:
        told = f"{max(needed, stored) / 1e6:.0f} MB of samples; allowed are {MAXIMUM_BYTES / 1e6:.0f} MB"
        raise FrameError(f"{path} announces {told}")
    if needed > max(CHECKED_FROM, _COMPRESSION * stored):
        told = f"{needed / 1e6:.0f} MB of samples in {stored / 1e6:.3g} MB"
        raise FrameError(f"{path} announces {told}: no frame of a camera can be compressed so much")


def raw_frame(
    stored: StoredFrame, stated: FrameSettings, path: Path, shape: tuple[int, int] | None = None
) -> Mosaic | ChannelFrame:
    """The checked frame from what the file tells and what the user states; `shape` of the frame where this is a part.

    Raises
    ------
    FrameError
        Both say something and do not agree, or something needed is said by neither.
    """
    _agreed("shape", stated.shape, shape or stored.values.shape[:2], path)
    _agreed("dtype", stated.dtype and np.dtype(stated.dtype).newbyteorder("=").name, stored.values.dtype.name, path)
    stored = _grey_saved_as_colour(stored, stated.kind)
    kind: FrameKind = _agreed("kind", stated.kind, stored.kind, path) or "bayer"
    white = _white_level(stored, stated.white_level, path)
    black = _black_level(stored, stated.black_level, path)
    cfa = _pattern(stored, stated.cfa, kind, path)
    try:
        if cfa is not None:
            return Mosaic(values=stored.values, cfa=cfa, black_level=black, white_level=white)
        channels = np.moveaxis(np.atleast_3d(stored.values), -1, 0)
        return ChannelFrame(values=channels, black_level=black.mean(), white_level=white)
    except InputError as error:
        raise FrameError(f"{path}: {error}") from None


def _agreed(name: str, stated: _T | None, told: _T | None, path: Path) -> _T | None:
    if stated is not None and told is not None and stated != told:
        raise FrameError(f"{name} is stated as {stated}, but {path} says {told}")
    return told if stated is None else stated


def _grey_saved_as_colour(stored: StoredFrame, kind: FrameKind | None) -> StoredFrame:
    """One channel out of three identical ones, where the user states that the frame has only one."""
    first = stored.values[..., :1]
    if kind not in ("bayer", "monochrome") or stored.kind != "rgb" or not (stored.values == first).all():
        return stored
    return StoredFrame(values=first[..., 0], bits=stored.bits)


def _white_level(stored: StoredFrame, stated: float | None, path: Path) -> float:
    white = _agreed("white_level", stated, stored.white_level, path)
    largest = float(2**stored.bits - 1 if stored.bits else np.iinfo(stored.values.dtype).max)
    if white is not None and white > largest:
        raise FrameError(f"white_level is stated as {white}, but the samples of {path} end at {largest:.0f}")
    return largest if white is None else white


def _black_level(stored: StoredFrame, stated: float | None, path: Path) -> FloatArray:
    told = stored.black_level
    if told is None:
        return np.full((1, 1), 0.0 if stated is None else stated)
    if stated is not None and not (np.abs(told - stated) < _BLACK_TOLERANCE).all():
        raise FrameError(f"black_level is stated as {stated}, but {path} says {told.ravel().tolist()}")
    return told


def _pattern(stored: StoredFrame, stated: str | None, kind: FrameKind, path: Path) -> str | None:
    """Bayer pattern of a mosaic; None for a frame without a colour filter array."""
    if kind == "bayer":
        cfa = _agreed("cfa", stated and stated.upper(), stored.cfa, path)
        if cfa is None:
            raise FrameError(
                f"{path} does not tell its colour filter array: state cfa ({', '.join(BAYER_PATTERNS)}), or kind "
                '"monochrome" where the camera has none'
            )
        return cfa
    if stated is not None:
        raise FrameError(f"cfa is stated as {stated}, but {path} is read as {kind}, which has no colour filter array")
    if (kind == "rgb") != (stored.values.ndim == 3):
        told = "three channels" if stored.values.ndim == 3 else "one"
        raise FrameError(f'kind is stated as "{kind}", but {path} has {told}')
    return None
