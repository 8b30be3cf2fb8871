"""Frames out: uncompressed Bayer DNG that LibRaw reads back bit by bit, and plain 16-bit TIFF.

The DNG tags follow the Adobe DNG specification 1.4, chapter 4.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels

__all__ = ["MINIMUM_DNG_SIZE", "write_dng", "write_tiff"]

MINIMUM_DNG_SIZE = 22
"""Rows and columns below which LibRaw refuses a raw image."""

_XYZ_TO_SRGB = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
_ILLUMINANT_D65 = 21
_PHOTOMETRIC_CFA = 32803


def write_dng(path: Path | str, mosaic: Mosaic, *, white_balance: Sequence[float] | None = None) -> None:
    """Write a raw Bayer frame as an uncompressed DNG.

    Values, pattern, black level of each position of the cell and white level come back from LibRaw exactly as given.
    An existing file is replaced, once the new one is complete.

    Parameters
    ----------
    path
        File to write.
    mosaic
        Frame with at least 22 rows and columns; black and white levels are whole numbers.
    white_balance
        Factors that make a white surface grey, for R, G and B: only viewers use them. None: all 1.

    Raises
    ------
    InputError
        The frame is too small, a level is not a whole number, or a factor is not positive.
    """
    if min(mosaic.values.shape) < MINIMUM_DNG_SIZE:
        raise InputError(
            f"a DNG needs at least {MINIMUM_DNG_SIZE} rows and columns (LibRaw refuses smaller ones), "
            f"not {mosaic.values.shape}: {path}"
        )
    tags = [*_cfa_tags(mosaic, path), *_colour_tags((1.0, 1.0, 1.0) if white_balance is None else white_balance)]
    _write(path, mosaic.values, photometric=_PHOTOMETRIC_CFA, extratags=tags, rowsperstrip=mosaic.values.shape[0])


def write_tiff(path: Path | str, frame: Mosaic | ChannelFrame) -> None:
    """Write a frame as an uncompressed 16-bit TIFF: (H, W) for a mosaic or monochrome frame, (H, W, 3) for RGB.

    A TIFF does not tell pattern and levels: whoever reads it states them. An existing file is replaced, once the
    new one is complete.
    """
    if isinstance(frame, ChannelFrame) and len(frame.values) == 3:
        _write(path, np.ascontiguousarray(np.moveaxis(frame.values, 0, -1)), photometric="rgb")
    else:
        _write(path, frame.values.reshape(frame.values.shape[-2:]), photometric="minisblack")


def _write(path: Path | str, values: np.ndarray[Any, np.dtype[np.uint16]], **options: Any) -> None:
    import tifffile

    path = Path(path)
    temporary = path.with_name(path.name + ".part")
    try:
        tifffile.imwrite(temporary, values, metadata=None, byteorder="<", software="rgbmidic", **options)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _cfa_tags(mosaic: Mosaic, path: Path | str) -> list[tuple[Any, ...]]:
    black = [_whole(level, "black", path) for level in mosaic.black_level.ravel()]
    channels = bytes(int(channel) for channel in cfa_channels(mosaic.cfa).ravel())
    return [
        (50706, "B", 4, b"\x01\x04\x00\x00", True),  # DNGVersion
        (50707, "B", 4, b"\x01\x01\x00\x00", True),  # DNGBackwardVersion
        (50708, "s", 0, "rgbmidic", True),  # UniqueCameraModel
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, channels, True),  # CFAPattern
        (50710, "B", 3, b"\x00\x01\x02", True),  # CFAPlaneColor
        (50711, "H", 1, 1, True),  # CFALayout: rectangular
        (50713, "H", 2, (2, 2), True),  # BlackLevelRepeatDim
        (50714, "I", 4, black, True),  # BlackLevel, by position
        (50717, "I", 1, _whole(mosaic.white_level, "white", path), True),  # WhiteLevel
    ]


def _colour_tags(white_balance: Sequence[float]) -> list[tuple[Any, ...]]:
    if len(white_balance) != 3 or not all(np.isfinite(factor) and factor > 0 for factor in white_balance):
        raise InputError(f"white_balance is three positive factors (R, G, B), not {white_balance!r}")
    neutral = [min(white_balance) / factor for factor in white_balance]
    return [
        (50721, "2i", 9, _rationals(_XYZ_TO_SRGB), True),  # ColorMatrix1
        (50728, "2I", 3, _rationals(neutral), True),  # AsShotNeutral
        (50778, "H", 1, _ILLUMINANT_D65, True),  # CalibrationIlluminant1
    ]


def _rationals(numbers: Iterable[float]) -> list[int]:
    fractions = [Fraction(number).limit_denominator(10_000) for number in numbers]
    return [part for fraction in fractions for part in (fraction.numerator, fraction.denominator)]


def _whole(level: float, name: str, path: Path | str) -> int:
    if level != int(level) or level > 65535:
        raise InputError(f"a DNG holds a {name} level that is a whole number up to 65535, not {level}: {path}")
    return int(level)
