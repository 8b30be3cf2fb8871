"""TIFF and PNG files, 8 or 16 bit, and headerless binary frames."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.contents import FileContents, damaged
from rgbmidic.frames.tiff_structure import cfa_pattern, is_stored_as_is, tag, tiff_pages
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from tifffile import TiffPage

__all__ = ["png_shape", "read_headerless", "read_png", "read_tiff", "tiff_shape"]

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_GREY, _PNG_RGB = 0, 2
_MIN_IS_WHITE, _PALETTE = 0, 3
_COLOUR_MAP, _ORIENTATION = 320, 274


def read_tiff(path: Path) -> FileContents:
    """Read the image of a TIFF file: one frame, 1 or 3 channels, unsigned 8 or 16 bit.

    Raises
    ------
    FrameError
        The file is damaged, has several frames, another sample type or number of channels, or colours in a table.
    """
    with tiff_pages(path) as pages:
        page = _single_page(pages, path)
        values = _decode_page(page, path)
        if page.photometric == _PALETTE:
            _check_grey_table(page, values.dtype, path)
        elif page.photometric == _MIN_IS_WHITE:
            values = np.iinfo(values.dtype).max - values
        cfa = cfa_pattern(page)
    return _contents(values, cfa, path)


def tiff_shape(path: Path) -> tuple[int, int]:
    """Rows and columns, from the header alone."""
    with tiff_pages(path) as pages:
        page = _single_page(pages, path)
        return int(page.imagelength), int(page.imagewidth)


def _single_page(pages: list[TiffPage] | None, path: Path) -> TiffPage:
    if pages is None:
        raise damaged(path, "it is not a TIFF file")
    if not pages:
        raise damaged(path, "its header leads to no image")
    if len(pages) > 1:
        raise FrameError(f"{path} holds {len(pages)} frames; allowed is one frame per TIFF file")
    page = pages[0]
    if page.dtype is None or page.dtype.name not in ("uint8", "uint16"):
        kind = page.dtype or f"{page.bitspersample}-bit"
        raise FrameError(f"{path} has {kind} samples; allowed are unsigned 8 or 16 bit")
    if page.compression == 1 and not is_stored_as_is(page):
        raise damaged(
            path, f"its header announces {sum(page.databytecounts)} bytes of image data, too few for its size"
        )
    return page


def _decode_page(page: TiffPage, path: Path) -> AnyArray:
    """Samples of a page, (H, W) or (H, W, C); by OpenCV where tifffile lacks the decompressor (LZW, JPEG)."""
    try:
        values = np.asarray(page.asarray())
    except Exception as error:  # tifffile meets damaged data with many kinds of error
        decoded = _opencv(path) if (tag(page, _ORIENTATION) or (1,)) == (1,) else None
        if decoded is None or decoded.dtype != page.dtype:
            raise damaged(path, error) from None
        return decoded
    if values.ndim == 3 and page.planarconfig == 2:  # one plane after the other
        values = np.moveaxis(values, 0, -1)
    return values


def _check_grey_table(page: TiffPage, dtype: np.dtype[Any], path: Path) -> None:
    """Some cameras' software writes grey images with a colour table that changes nothing; others are refused."""
    table = np.asarray(page.tags[_COLOUR_MAP].value, dtype=np.int64).reshape(3, -1)
    ramp = np.arange(table.shape[1])
    # entries run to 65535: of 257 i and 256 i both are in use
    if dtype != np.uint8 or not (table // 256 == ramp).all():
        raise FrameError(f"{path} shows its grey levels through a colour table; save it as a plain grey image")


def read_png(path: Path) -> FileContents:
    """Read a PNG file: grey or RGB, 8 or 16 bit.

    Raises
    ------
    FrameError
        The file is damaged (every chunk's checksum is verified) or of another kind.
    """
    png_shape(path)
    for name, data, checksum in _png_chunks(path.read_bytes(), path):
        if zlib.crc32(name + data) != checksum:
            raise damaged(path, f"the checksum of its {name.decode(errors='replace')} part is wrong")
    values = _opencv(path)
    if values is None:
        raise damaged(path, "its image data cannot be decoded")
    return _contents(values, None, path)


def png_shape(path: Path) -> tuple[int, int]:
    """Rows and columns, from the header alone."""
    with path.open("rb") as file:
        head = file.read(33)
    if len(head) < 33 or head[:8] != _PNG_SIGNATURE or head[12:16] != b"IHDR":
        raise damaged(path, "it has no PNG header")
    columns, rows, bits, colour = struct.unpack(">IIBB", head[16:26])
    if bits not in (8, 16) or colour not in (_PNG_GREY, _PNG_RGB):
        raise FrameError(f"{path} is not a plain image; allowed are grey or RGB PNGs of 8 or 16 bit without alpha")
    return rows, columns


def _png_chunks(content: bytes, path: Path) -> Iterator[tuple[bytes, bytes, int]]:
    """Name, data and checksum of every chunk up to IEND; an error where the file ends before it."""
    start, name = len(_PNG_SIGNATURE), b""
    while name != b"IEND":
        if start + 12 > len(content):
            raise damaged(path, "it ends before its end mark")
        length, name = struct.unpack(">I4s", content[start : start + 8])
        data = content[start + 8 : start + 8 + length]
        if start + 12 + length > len(content):
            raise damaged(path, "it ends before its end mark")
        yield name, data, int.from_bytes(content[start + 8 + length : start + 12 + length], "big")
        start += 12 + length


def _opencv(path: Path) -> AnyArray | None:
    """Samples as stored, (H, W) or (H, W, 3) in the order R, G, B; None where OpenCV cannot decode them."""
    import cv2

    previous = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # faults come back as one FrameError
    try:
        # OpenCV opens no non-ASCII names on Windows, hence decoding from memory
        image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    finally:
        cv2.utils.logging.setLogLevel(previous)
    if image is None or image.ndim == 2:
        return image
    return image[..., ::-1] if image.shape[2] == 3 else image


def read_headerless(path: Path, shape: tuple[int, int], dtype: str, channels: int) -> FileContents:
    """Read a file that holds nothing but the samples of one frame, row by row.

    Raises
    ------
    FrameError
        The file's size does not match.
    """
    needed = math.prod(shape) * channels * np.dtype(dtype).itemsize
    size = path.stat().st_size
    if size != needed:
        raise FrameError(
            f"{path} has {size} bytes; {shape[0]} rows of {shape[1]} {dtype} samples with {channels} channel(s) need "
            f"{needed}"
        )
    stored = np.dtype(dtype).newbyteorder("<") if dtype == "uint16" else np.dtype(dtype)
    values = np.fromfile(path, dtype=stored).reshape(*shape, channels)
    return _contents(values[..., 0] if channels == 1 else values, None, path)


def _contents(values: AnyArray, cfa: str | None, path: Path) -> FileContents:
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim == 2:
        return FileContents(values=values, kind="bayer" if cfa else None, cfa=cfa)
    if values.ndim != 3 or values.shape[2] != 3:
        raise FrameError(f"{path} has samples of shape {values.shape}; allowed are one channel or three (RGB)")
    return FileContents(values=values, kind="rgb")
