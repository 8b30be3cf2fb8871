"""Pictures, one a file: PNG and headerless samples in, plain 16-bit TIFF and raw Bayer DNG out.

PNG is decoded by OpenCV, with every checksum verified. The DNG tags follow the Adobe DNG specification 1.4, chapter 4;
LibRaw reads the frames back bit by bit.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.arguments import checked
from rgbmidic.disk import write_complete
from rgbmidic.errors import FrameError, InputError, damaged_file
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.frames.metadata import BROKEN_JPEG, EvenFrames, StoredFrame, captured_stderr, check_size
from rgbmidic.frames.source import FrameSource
from rgbmidic.typing import AnyArray

_LOG_PREFIX = re.compile(r"^\[ *(ERROR|WARN)\S*\] global \S+ \S+ ")
"""Origin of a line in OpenCV's log."""


def decode(content: bytes, path: Path) -> AnyArray:
    """Decode a picture with OpenCV.

    Parameters
    ----------
    content
        The file's bytes.
    path
        The file, for messages.

    Returns
    -------
    ndarray, shape (H, W) or (H, W, C)
        Samples as stored; three channels in the order R, G, B.

    Raises
    ------
    FrameError
        OpenCV cannot decode them.
    """
    import cv2

    # OpenCV 4 has it at its top, OpenCV 5 in a module
    set_log_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
    previous = set_log_level(3)  # LOG_LEVEL_WARNING
    try:
        with captured_stderr(b"libpng error", b"libpng warning", b"[ERROR", b"[ WARN", b"> ") as lines:
            # OpenCV opens no non-ASCII names on Windows, hence decoding from memory
            image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        set_log_level(previous)
    harmless = [line for line in lines if line.startswith(("libpng warning", "[ WARN"))]
    errors = [line for line in lines if line not in harmless or any(text in line for text in BROKEN_JPEG)]
    if image is None or errors:  # libtiff's errors do not always keep OpenCV from giving a picture
        raise damaged_file(path, _LOG_PREFIX.sub("", errors[0]) if errors else "its image data cannot be decoded")
    return image[..., ::-1] if image.ndim == 3 and image.shape[2] == 3 else image


_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3}
"""Channels of the colour types that are read: grey and RGB."""


class PngFile(FrameSource):
    """A PNG file; every chunk's checksum is verified."""

    def _shape(self) -> tuple[int, int]:
        with self.path.open("rb") as file:
            head = file.read(33)
        if len(head) < 33 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
            raise damaged_file(self.path, "it has no PNG header")
        columns, rows, bits, colour = struct.unpack(">IIBB", head[16:26])
        if bits not in (8, 16) or colour not in _CHANNELS:
            raise FrameError(
                f"{self.path} is not a plain image; allowed are grey or RGB PNGs of 8 or 16 bit without alpha"
            )
        n_bytes = rows * columns * _CHANNELS[colour] * bits // 8
        check_size(self.path, unpacked=n_bytes, stored=self.path.stat().st_size)
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        self._shape()
        content = self.path.read_bytes()
        _check_chunks(content, self.path)
        return StoredFrame.from_samples(decode(content, self.path), self.path)


def _check_chunks(content: bytes, path: Path) -> None:
    """Refuse a file with a wrong checksum up to IEND, or that ends before it."""
    start, name, view = len(_SIGNATURE), b"", memoryview(content)
    while name != b"IEND":
        name = content[start + 4 : start + 8]
        end = start + 8 + int.from_bytes(view[start : start + 4], "big")
        if end + 4 > len(content):
            raise damaged_file(path, "it ends before its end mark")
        if zlib.crc32(view[start + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise damaged_file(path, f"the checksum of its {name.decode(errors='replace')} part is wrong")
        start = end + 4


class HeaderlessFile(FrameSource):
    """A file without a header: shape and sample type are stated."""

    def _shape(self) -> tuple[int, int]:
        if self.user_metadata.shape is None or self.user_metadata.dtype is None:
            raise FrameError(f"{self.path} has no header: both its shape (rows, columns) and its dtype must be stated")
        return self.user_metadata.shape

    def _rows(self, index: int, rows: slice) -> StoredFrame:
        shape = self._shape()
        dtype = np.dtype("<u2" if self.user_metadata.dtype == "uint16" else self.user_metadata.dtype)
        channels, size = 3 if self.user_metadata.kind == "rgb" else 1, self.path.stat().st_size
        frame = EvenFrames(shape=shape, channels=(channels,), stored_bits=8 * dtype.itemsize, order=dtype.str[0])
        if size != frame.size:
            raise FrameError(
                f"{self.path} has {size} bytes; {shape[0]} rows of {shape[1]} {self.user_metadata.dtype} samples with "
                f"{channels} channel(s) need {frame.size}"
            )
        return StoredFrame.from_samples(frame.read(self.path, 0, range(shape[0])[rows]).values, self.path)


@checked
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
    FrameError
        The file cannot be written.

    Examples
    --------
    >>> values = np.full((24, 32), 100, dtype=np.uint16)
    >>> write_dng("flat.dng", Mosaic(values=values, cfa="RGGB", black_level=np.full((2, 2), 16.0), white_level=1023.0))
    >>> Path("flat.dng").unlink()
    """
    if min(mosaic.values.shape) < 22:
        raise InputError(
            f"a DNG needs at least 22 rows and columns (LibRaw refuses smaller ones), not {mosaic.values.shape}: {path}"
        )
    tags = _dng_tags(mosaic, (1.0, 1.0, 1.0) if white_balance is None else white_balance, path)
    _write(path, mosaic.values, photometric="cfa", extratags=tags, rowsperstrip=mosaic.values.shape[0])


@checked
def write_tiff(path: Path | str, frame: Mosaic | ChannelFrame) -> None:
    """Write a frame as an uncompressed 16-bit TIFF: (H, W) for a mosaic or monochrome frame, (H, W, 3) for RGB.

    A TIFF holds neither pattern nor levels: whoever reads it states them. An existing file is replaced, once the
    new one is complete.

    Parameters
    ----------
    path
        File to write.
    frame
        The raw frame.

    Raises
    ------
    FrameError
        The file cannot be written.

    Examples
    --------
    >>> values = np.full((1, 4, 6), 100, dtype=np.uint16)
    >>> frame = ChannelFrame(values=values, black_level=np.zeros(1), white_level=1023.0)
    >>> write_tiff("flat.tif", frame)
    >>> Path("flat.tif").unlink()
    """
    if isinstance(frame, ChannelFrame) and len(frame.values) == 3:
        _write(path, np.ascontiguousarray(np.moveaxis(frame.values, 0, -1)), photometric="rgb")
    else:
        _write(path, frame.values.reshape(frame.values.shape[-2:]), photometric="minisblack")


def _write(path: Path | str, values: np.ndarray[Any, np.dtype[np.uint16]], **options: Any) -> None:
    import tifffile

    options |= {"metadata": None, "byteorder": "<", "software": "rgbmidic"}
    write_complete(Path(path), lambda file: tifffile.imwrite(file, values, **options), error=FrameError)


def _dng_tags(mosaic: Mosaic, white_balance: Sequence[float], path: Path | str) -> list[tuple[Any, ...]]:
    if np.shape(white_balance) != (3,) or not all(np.isfinite(factor) and factor > 0 for factor in white_balance):
        raise InputError(f"white_balance is three positive factors (R, G, B), not {white_balance!r}")
    xyz_to_srgb = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
    black = [_require_integer(level, "black", path) for level in mosaic.black_level.ravel()]
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
        (50717, "I", 1, _require_integer(mosaic.white_level, "white", path), True),  # WhiteLevel
        (50721, "2i", 9, _rationals(xyz_to_srgb), True),  # ColorMatrix1
        (50728, "2I", 3, _rationals(min(white_balance) / factor for factor in white_balance), True),  # AsShotNeutral
        (50778, "H", 1, 21, True),  # CalibrationIlluminant1: D65
    ]


def _rationals(numbers: Iterable[float]) -> list[int]:
    fractions = [Fraction(number).limit_denominator(10_000) for number in numbers]
    return [term for fraction in fractions for term in (fraction.numerator, fraction.denominator)]


def _require_integer(level: float, name: str, path: Path | str) -> int:
    if level != int(level) or level > 65535:
        raise InputError(f"a DNG holds a {name} level that is a whole number up to 65535, not {level}: {path}")
    return int(level)
