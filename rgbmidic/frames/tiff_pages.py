"""Pages and tags of TIFF files (DNG, NEF, ARW and other raws are TIFF inside), and whether their data is all there.

LibRaw and tifffile both open some truncated files and fill what is missing with zeros, so the extents are checked
first.
"""

from __future__ import annotations

import logging
import math
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import FrameError, damaged_file, library_faults
from rgbmidic.frames.metadata import check_size

if TYPE_CHECKING:
    import tifffile

# A file's faults come back as one FrameError, and tifffile's log of them would reach the terminal as well.
logging.getLogger("tifffile").propagate = False
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_HEADERS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of TIFF and BigTIFF; several cameras' raws begin with II or MM, too, and are none."""
_FIRST_OFFSET = 8
"""Bytes of the header of a TIFF file, the shortest."""
UNCOMPRESSED = 1
"""Code of the compression of samples that are not compressed."""
PACKED_BITS = (10, 12, 14)
"""Bits of samples that are stored without a gap; they have a white level of their own."""


class Tag(IntEnum):
    """Codes of the tags that are read (TIFF 6.0; TIFF/EP; DNG 1.4, chapter 4)."""

    NEW_SUBFILE_TYPE = 254
    COLUMNS = 256
    ROWS = 257
    DESCRIPTION = 270
    ORIENTATION = 274
    STRIP_OFFSETS = 273
    SAMPLES_PER_PIXEL = 277
    STRIP_BYTES = 279
    COLOUR_MAP = 320
    TILE_OFFSETS = 324
    TILE_BYTES = 325
    SUB_PAGES = 330
    CFA_REPEAT = 33421
    CFA_PATTERN = 33422
    DNG_VERSION = 50706
    BLACK_REPEAT = 50713
    BLACK = 50714
    BLACK_DELTA_H = 50715
    BLACK_DELTA_V = 50716
    ACTIVE_AREA = 50829


_VALUE_BYTES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""Bytes of a value by its type (TIFF 6.0, BigTIFF); 1 of all others."""

Entries = dict[int, tuple[int, int, bytes]]
"""Type, number of values, and the values or where they lie, of the entries of a page by their codes."""


@contextmanager
def tiff_pages(path: Path) -> Iterator[list[tifffile.TiffPage]]:
    """Open the images of a TIFF file in full resolution, neither thumbnails nor previews.

    Raises
    ------
    FrameError
        It is no TIFF file, or what is done inside fails over a damaged header.
    """
    with open_tiff(path) as tiff:
        pages: dict[int, tifffile.TiffPage] = {}
        for frame in tiff.pages:
            page = frame.aspage()
            if page.offset in pages:  # tifffile would go round for ever
                raise ValueError("its list of images leads back to itself")
            pages[page.offset] = page
        all_pages = (
            image for page in pages.values() for image in (page, *(child.aspage() for child in page.pages or ()))
        )
        yield [page for page in all_pages if not int(page.subfiletype) & 1]  # not reduced


@contextmanager
def open_tiff(path: Path) -> Iterator[tifffile.TiffFile]:
    """Open a TIFF file; what is done inside and fails over a damaged header becomes a FrameError."""
    import tifffile

    with path.open("rb") as file:  # which `FrameSource` and `TiffStack` have found to be a regular one
        PageList(file, path)  # tifffile tries some camera raws that begin as a TIFF file does
    with library_faults(path, OSError), tifffile.TiffFile(path) as tiff:
        yield tiff


def is_dng(path: Path) -> bool:
    """Return whether the first image has the tag of DNG, whatever the file's name; False for what cannot be read."""
    try:
        with require_regular_file(path).open("rb") as file:
            pages = PageList(file, path)
            first = pages.page(pages.first) if pages.offset == 4 else None  # LibRaw reads no BigTIFF
            return first is not None and Tag.DNG_VERSION in first[0]
    except (OSError, FrameError):
        return False


class PageList:
    """The pages of an open TIFF file, found without tifffile, which takes seconds for a hundred thousand of them.

    Offsets have `offset` bytes, 4 or in BigTIFF 8, in the byte `order` of the file; the `first` page begins at one.
    """

    def __init__(self, file: BinaryIO, path: Path) -> None:
        """Read the header; a FrameError where it is no TIFF file's."""
        head = file.read(4)
        if head not in _HEADERS:
            raise damaged_file(path, "it is not a TIFF file")
        self.file, self.offset = file, 8 if head in _HEADERS[2:] else 4
        self.order: Literal["little", "big"] = "little" if head[:1] == b"I" else "big"
        file.seek(self.offset)  # of both headers the offset of the first page is the last field
        self.first = int.from_bytes(file.read(self.offset), self.order)
        self.size = file.seek(0, 2)

    def offsets(self, path: Path) -> tuple[list[int], bool]:
        """Return the offsets of the pages in full resolution, and whether their list leads out of the file."""
        offset, page_offsets, visited = self.first, list[int](), set[int]()
        while offset and (page := self.page(offset)) is not None:
            if offset in visited:
                raise damaged_file(path, "its list of images leads back to itself")
            visited.add(offset)
            entries, next_offset = page
            if not self.value(entries, Tag.NEW_SUBFILE_TYPE) & 1:
                page_offsets.append(offset)
            offset = next_offset
        if not page_offsets:
            raise damaged_file(path, "its header leads to no image")
        return page_offsets, offset > 0

    def unlisted_bytes(self, page_offsets: list[int]) -> int:
        """Return the size of the largest area that neither these pages nor their values and samples take."""
        extents = [(0, 2 * self.offset), (self.size, self.size)]
        for page_offset in page_offsets:
            entries, _ = self.page(page_offset) or ({}, 0)
            if Tag.SUB_PAGES in entries:  # pages that no list leads to
                return 0
            extents.append((page_offset, page_offset + 2 * self.offset + len(entries) * (4 + 2 * self.offset)))
            for kind, number, content in entries.values():
                n_bytes = _VALUE_BYTES.get(kind, 1) * number
                if n_bytes > self.offset:
                    begin = int.from_bytes(content, self.order)
                    extents.append((begin, begin + n_bytes))
            begins, counts = self.segments(entries)
            extents += [(begin, begin + count) for begin, count in zip(begins, counts, strict=False)]
        largest = end = 0
        for begin, next_end in sorted(extents):
            largest, end = max(largest, begin - end), max(end, next_end)
        return largest

    def segments(self, entries: Entries) -> tuple[list[int], list[int]]:
        """Return the offsets and the numbers of bytes of a page's samples, by strips or tiles."""
        codes = (
            (Tag.TILE_OFFSETS, Tag.TILE_BYTES) if Tag.TILE_BYTES in entries else (Tag.STRIP_OFFSETS, Tag.STRIP_BYTES)
        )
        begins, counts = (self.numbers(entries, code) for code in codes)
        return begins, counts

    def numbers(self, entries: Entries, code: int) -> list[int]:
        """Return the whole numbers of an entry, such as one for each strip."""
        kind, number, content = entries.get(code, (3, 0, b""))
        width = _VALUE_BYTES.get(kind, 1)
        if width * number > self.offset:
            self.file.seek(min(int.from_bytes(content, self.order), self.size))
            content = self.file.read(min(width * number, self.size))
        starts = range(0, min(number * width, len(content) - width + 1), width)
        return [int.from_bytes(content[start : start + width], self.order) for start in starts]

    def page(self, offset: int) -> tuple[Entries, int] | None:
        """Read the entries of a page and the offset of the next one; None where the file ends before."""
        counter, entry = (8, "HHQ8s") if self.offset == 8 else (2, "HHI4s")
        if offset + counter > self.size:
            return None
        self.file.seek(offset)
        n_entries = int.from_bytes(self.file.read(counter), self.order)
        length = n_entries * (4 + 2 * self.offset)
        # pages that are seen have a few dozen entries
        if not 0 < n_entries <= 4096 or offset + counter + length + self.offset > self.size:
            return None
        fields = struct.iter_unpack(("<" if self.order == "little" else ">") + entry, self.file.read(length))
        entries = {code: (kind, count, content) for code, kind, count, content in fields}
        return entries, int.from_bytes(self.file.read(self.offset), self.order)

    def value(self, entries: Entries, code: int) -> int:
        """Return the one value of an entry; 0 where there is none."""
        short = 3  # the type of numbers of 16 bit
        kind, _, content = entries.get(code, (short, 0, b""))
        return int.from_bytes(content[: 2 if kind == short else 4], self.order)

    def text(self, entries: Entries, code: int) -> str:
        """Return the text of an entry; empty where there is none."""
        _, number, content = entries.get(code, (0, 0, b""))
        if number > self.offset:  # the entry holds where the text lies
            self.file.seek(min(int.from_bytes(content, self.order), self.size))
            content = self.file.read(min(number, 256 * 2**20))  # OME uses some 300 bytes for every frame
        return content[:number].decode(errors="replace").rstrip("\0")


_JPEG_KINDS, _JPEG_HEADER = (6, 7), 4096
"""Kinds of compression; bytes in which a part of the image has its frame header."""
_FRAME_HEADER = re.compile(rb"\xff[\xc0-\xc3\xc5-\xc7]..[\x02-\x10](..)(..)([\x01-\x04])", re.DOTALL)


def missing_data(page: tifffile.TiffPage, size: int) -> str | None:
    """Describe what the page announces that a file of `size` bytes does not hold; None where all is there."""
    segments = list(zip(page.dataoffsets, page.databytecounts, strict=False))
    end = max((offset + count for offset, count in segments), default=0)
    if end > size:
        return f"the header announces image data up to byte {end}, the file has {size} bytes"
    if any(count == 0 for _, count in segments):
        return "a part of its image data has the length zero"
    if any(offset < _FIRST_OFFSET for offset, _ in segments):
        return "a part of its image data lies in the file's header"
    return None


def oversized_jpeg(page: tifffile.TiffPage, path: Path) -> str | None:
    """Describe what JPEG data of a page announce beyond its tiles, on which a decoder works for minutes; None: nothing.

    The first frame header (SOF, ITU T.81, B.2.2) of each part holds its rows, columns and components.
    """
    if page.compression not in _JPEG_KINDS or not is_dng(path):  # other raws cut one JPEG image into slices
        return None
    pixels = (page.tilelength or page.rowsperstrip) * (page.tilewidth or page.imagewidth) * page.samplesperpixel
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=False):
            file.seek(offset)
            found = _FRAME_HEADER.search(file.read(min(count, _JPEG_HEADER)))
            rows, columns = (int.from_bytes(part) for part in found.groups()[:2]) if found else (0, 0)
            if found and rows * columns * found[3][0] > 2 * pixels:
                return f"its JPEG data announce {rows} rows of {columns} x {found[3][0]} samples, the header {pixels}"
    return None


def has_uncompressed_data(page: tifffile.TiffPage) -> bool:
    """Return whether the page's samples are uncompressed and their bytes are all there."""
    bits = page.bitspersample if isinstance(page.bitspersample, int) else page.bitspersample[0]
    n_bytes = math.ceil(page.imagewidth * page.imagelength * page.samplesperpixel * bits / 8)
    return bool(page.compression == UNCOMPRESSED and sum(page.databytecounts) >= n_bytes)


@contextmanager
def only_page(path: Path) -> Iterator[tifffile.TiffPage]:
    """Open the image of a TIFF file of one, and check it."""
    with tiff_pages(path) as pages:
        if not pages:
            raise damaged_file(path, "its header leads to no image")
        if len(pages) > 1:
            raise FrameError(f"{path} holds {len(pages)} frames; allowed is one frame per TIFF file")
        check_page(pages[0], path)
        yield pages[0]


def check_page(page: tifffile.TiffPage, path: Path) -> None:
    """Refuse a page whose samples are no raw frame's or not all there, before anything is unpacked."""
    bits, integer = page.bitspersample, page.dtype is not None and page.dtype.kind == "u"
    if not integer or bits not in ((8, 16, *PACKED_BITS) if page.compression == UNCOMPRESSED else (8, 16)):
        kind = page.dtype if bits in (8, 16, 32, 64) else f"{bits}-bit"
        allowed = "unsigned 8 or 16 bit, and uncompressed 10, 12 or 14 bit"
        raise FrameError(f"{path} has {kind or 'unknown'} samples; allowed are {allowed}")
    if not (page.imagelength and page.imagewidth and page.samplesperpixel):  # an entry that is damaged counts as 0
        size_text = f"{page.imagelength} rows of {page.imagewidth} pixels with {page.samplesperpixel} samples"
        raise damaged_file(path, f"its header announces {size_text}")
    size = path.stat().st_size
    if reason := missing_data(page, size):
        raise damaged_file(path, reason)
    n_stored = sum(page.databytecounts)
    if page.compression == UNCOMPRESSED and not has_uncompressed_data(page):
        raise damaged_file(path, f"its header announces {n_stored} bytes of image data, too few for its size")
    check_size(path, unpacked=page.nbytes, stored=min(n_stored, size))


def tag(page: tifffile.TiffPage, code: int) -> tuple[Any, ...] | None:
    """Return the value of a tag as a tuple, or None where the page does not have it."""
    if code not in page.tags:
        return None
    value = page.tags[code].value
    return tuple(value) if isinstance(value, tuple | list | bytes) else (value,)
