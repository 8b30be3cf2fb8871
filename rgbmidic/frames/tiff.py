"""TIFF files of one image, grey or RGB, 8 or 16 bit; and the reading of a page, for those of several."""

from __future__ import annotations

import lzma
import math
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.images import decode
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import CHECKED_FROM, StoredFrame, check_size, damaged
from rgbmidic.frames.tiff_pages import UNCOMPRESSED, cfa_pattern, is_stored_as_is, missing_data, tag, tiff_pages
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from tifffile import TiffPage

__all__ = ["TIFF_ENDINGS", "TiffFile", "checked_page", "page_frame", "page_rows"]

TIFF_ENDINGS = (".tif", ".tiff")

_BY_TIFFFILE: dict[int, Any] = {8: zlib.decompressobj, 32946: zlib.decompressobj, 34925: lzma.LZMADecompressor}
"""Compressions (deflate, LZMA) that tifffile undoes, without a limit, and what undoes them up to one."""
_BY_OPENCV = (5, 7, 32773)
"""LZW, JPEG, PackBits."""
_MIN_IS_WHITE, _PALETTE = 0, 3
_COLOUR_MAP, _ORIENTATION = 320, 274


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffFile(FrameSource):
    """A TIFF file of one image with 1 or 3 channels; a table of colours is refused."""

    def _shape(self) -> tuple[int, int]:
        with tiff_pages(self.path) as pages:
            page = _single_page(pages, self.path)
            return int(page.imagelength), int(page.imagewidth)

    def _stored(self, index: int) -> StoredFrame:
        with tiff_pages(self.path) as pages:
            page = _single_page(pages, self.path)
            if page.compression in _BY_OPENCV:
                return page_frame(page, self.path, _by_opencv(page, self.path))
            return page_frame(page, self.path)

    def _rows(self, index: int, rows: range) -> StoredFrame:
        with tiff_pages(self.path) as pages:
            page = _single_page(pages, self.path)
            if (samples := page_rows(page, self.path, rows)) is not None:
                return page_frame(page, self.path, samples)
        return FrameSource._rows(self, index, rows)


def page_rows(page: TiffPage, path: Path, rows: range) -> AnyArray | None:
    """Read the samples (n, W, C) of some rows of a checked page; None where it must be unpacked as a whole."""
    in_planes = page.planarconfig == 2 and page.samplesperpixel > 1
    if not is_stored_as_is(page) or not page.is_contiguous or in_planes:
        return None
    shape = len(rows), page.imagewidth, page.samplesperpixel
    dtype = np.dtype(page.dtype)
    start = page.dataoffsets[0] + rows.start * math.prod(shape[1:]) * dtype.itemsize
    stored = dtype.newbyteorder(page.parent.byteorder)
    samples = np.fromfile(path, dtype=stored, count=math.prod(shape), offset=start)
    return samples.astype(dtype, copy=False).reshape(shape)


def page_frame(page: TiffPage, path: Path, samples: AnyArray | None = None) -> StoredFrame:
    """Return the frame of a checked page, from its `samples` where they were read already.

    Raises
    ------
    FrameError
        They are damaged, or stored in a way that is not read.
    """
    values = _samples(page, path) if samples is None else samples
    if page.photometric == _PALETTE:
        table = np.asarray(page.tags[_COLOUR_MAP].value, dtype=np.int64).reshape(3, -1)
        # some cameras' software writes grey images with a table that changes nothing, of 257 i or of 256 i
        if values.dtype != np.uint8 or not (table // 256 == np.arange(table.shape[1])).all():
            raise FrameError(f"{path} shows its grey levels through a colour table; save it as a plain grey image")
    elif page.photometric == _MIN_IS_WHITE:
        values = np.iinfo(values.dtype).max - values
    return StoredFrame.plain(values, path, cfa_pattern(page))


def _single_page(pages: list[TiffPage], path: Path) -> TiffPage:
    if not pages:
        raise damaged(path, "its header leads to no image")
    if len(pages) > 1:
        raise FrameError(f"{path} holds {len(pages)} frames; allowed is one frame per TIFF file")
    checked_page(pages[0], path)
    return pages[0]


def checked_page(page: TiffPage, path: Path) -> None:
    """Refuse a page whose samples are no raw frame's or not all there, before anything is unpacked.

    Raises
    ------
    FrameError
        So they are.
    """
    if page.dtype is None or page.dtype.name not in ("uint8", "uint16"):
        kind = page.dtype or f"{page.bitspersample}-bit"
        raise FrameError(f"{path} has {kind} samples; allowed are unsigned 8 or 16 bit")
    if not (page.imagelength and page.imagewidth and page.samplesperpixel):  # an entry that is damaged counts as 0
        told = f"{page.imagelength} rows of {page.imagewidth} pixels with {page.samplesperpixel} samples"
        raise damaged(path, f"its header announces {told}")
    size = path.stat().st_size
    if reason := missing_data(page, size):
        raise damaged(path, reason)
    stored = sum(page.databytecounts)
    if page.compression == UNCOMPRESSED and not is_stored_as_is(page):
        raise damaged(path, f"its header announces {stored} bytes of image data, too few for its size")
    check_size(path, needed=page.nbytes, stored=min(stored, size))


def _samples(page: TiffPage, path: Path) -> AnyArray:
    """Read the samples of a page as they are stored, (H, W) or (H, W, C)."""
    if page.compression not in (UNCOMPRESSED, *_BY_TIFFFILE):
        raise _not_read(page, path)
    if page.compression in _BY_TIFFFILE:
        _check_unpacked(page, path)
    values = np.asarray(page.asarray())
    one_plane_after_the_other = values.ndim == 3 and page.planarconfig == 2
    return np.moveaxis(values, 0, -1) if one_plane_after_the_other else values


def _by_opencv(page: TiffPage, path: Path) -> AnyArray:
    """Read the samples of the only page of a file."""
    turned = (tag(page, _ORIENTATION) or (1,)) != (1,) or page.photometric in (_MIN_IS_WHITE, _PALETTE)
    if turned:  # OpenCV turns such samples, some more than others
        raise _not_read(page, path)
    values = decode(path.read_bytes(), path)
    if (*values.shape[:2], values.dtype) != (page.imagelength, page.imagewidth, page.dtype):
        raise damaged(path, f"its header announces another image than its data hold, {values.shape} {values.dtype}")
    return values


def _not_read(page: TiffPage, path: Path) -> FrameError:
    name = getattr(page.compression, "name", page.compression)
    return FrameError(f"{path} is stored in a way that is not read ({name}); save it as a plain uncompressed TIFF")


def _check_unpacked(page: TiffPage, path: Path) -> None:
    """Refuse parts that unpack to more than the whole image, and all of them to less: tifffile fills up with zeros."""
    limit, total = max(page.nbytes, CHECKED_FROM), 0
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(offset)
            unpacked = len(_BY_TIFFFILE[page.compression]().decompress(file.read(count), limit + 1))
            if unpacked > limit:
                raise damaged(path, f"a part of its image data unpacks to more than {limit} bytes")
            total += unpacked
    if total < page.nbytes:
        raise damaged(path, f"its image data unpack to {total} bytes, too few for its size")
