"""Pages and tags of TIFF files (DNG, NEF, ARW and other raws are TIFF inside), and whether their data is all there.

LibRaw and tifffile both open some truncated files and fill what is missing with zeros, so the extents are checked
first.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Literal

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.stored import damaged, faults_of
from rgbmidic.settings import regular
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

# A file's faults come back as one FrameError; without a handler Python would print tifffile's log as well.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

_HEADERS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""Of TIFF and BigTIFF; several cameras' raws begin with II or MM, too, and are none."""
UNCOMPRESSED = 1
_REDUCED = 1
_RAW_PHOTOMETRIC = (32803, 34892)
_DNG_VERSION = 50706
COLUMNS, ROWS, DESCRIPTION = 256, 257, 270
_NEW_TYPE = 254
_SHORT = 3
_CLASSIC = 4
"""Bytes of an offset in TIFF; in BigTIFF, which LibRaw does not read, they are 8."""
_PIECE = 512
"""Bytes that are read of a page at once: its usual one to two dozen entries."""
_MOST_ENTRIES = 4096
"""Entries of a page beyond which it is no page: those seen have a few dozen."""
_TEXT_BYTES = 256 * 2**20
"""Most bytes of a description: OME uses some 300 for every frame."""
_CFA_REPEAT, _CFA_PATTERN = 33421, 33422
_ACTIVE_AREA, _BLACK_REPEAT, _BLACK, _BLACK_DELTAS = 50829, 50713, 50714, (50715, 50716)


@contextmanager
def tiff_pages(path: Path) -> Iterator[list[TiffPage]]:
    """Open the images of a TIFF file in full resolution, neither thumbnails nor previews.

    Raises
    ------
    FrameError
        It is no TIFF file, or what is done inside fails over a damaged header.
    """
    with _opened(path) as tiff:
        pages: dict[int, TiffPage] = {}
        for frame in tiff.pages:
            page = frame.aspage()
            if page.offset in pages:  # tifffile would go round for ever
                raise ValueError("its list of images leads back to itself")
            pages[page.offset] = page
        found = (one for page in pages.values() for one in (page, *(child.aspage() for child in page.pages or ())))
        yield [page for page in found if not int(page.subfiletype) & _REDUCED]


@contextmanager
def tiff_page(path: Path, offset: int) -> Iterator[TiffPage]:
    """Open the image that begins at byte `offset` of a TIFF file.

    Raises
    ------
    FrameError
        It is no TIFF file, or what is done inside fails over a damaged header.
    """
    import tifffile

    with _opened(path) as tiff:
        tiff.filehandle.seek(offset)
        yield tifffile.TiffPage(tiff, index=0)


@contextmanager
def _opened(path: Path) -> Iterator[TiffFile]:
    import tifffile

    with regular(path).open("rb") as file:
        if file.read(4) not in _HEADERS:  # tifffile tries some camera raws that begin as a TIFF file does
            raise damaged(path, "it is not a TIFF file")
    with faults_of(path, OSError), tifffile.TiffFile(path) as tiff:
        yield tiff


def is_dng(path: Path) -> bool:
    """Return whether the first image has the tag of DNG, whatever the file's name; False for what cannot be read."""
    try:
        with regular(path).open("rb") as file:
            pages = PageList.begin(file, path)
            first = pages.content(pages.first) if pages.offset == _CLASSIC else None
            return first is not None and pages.place(first, _DNG_VERSION) > 0
    except (OSError, FrameError):
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class PageList:
    """The pages of an open TIFF file, found without tifffile, which takes seconds for a hundred thousand of them.

    Attributes
    ----------
    file, size
        The file and its bytes.
    order
        Its byte order.
    offset, count, entry
        Widths in bytes of an offset, of a number of entries, of an entry.
    first
        Where the first page begins.
    """

    file: BinaryIO
    size: int
    order: Literal["little", "big"]
    offset: int
    count: int
    entry: int
    first: int

    @classmethod
    def begin(cls, file: BinaryIO, path: Path) -> PageList:
        """Read the header; a FrameError where it is no TIFF file's."""
        head = file.read(4)
        if head not in _HEADERS:
            raise damaged(path, "it is not a TIFF file")
        order: Literal["little", "big"] = "little" if head[:1] == b"I" else "big"
        offset, count, entry = (8, 8, 20) if head in _HEADERS[2:] else (4, 2, 12)
        file.seek(offset)  # 4 or 8: of both headers the offset of the first page is the last field
        first = int.from_bytes(file.read(offset), order)
        size = file.seek(0, 2)
        return cls(file=file, size=size, order=order, offset=offset, count=count, entry=entry, first=first)

    def offsets(self, path: Path) -> tuple[list[int], bool]:
        """Where the pages in full resolution begin, and whether their list leads out of the file."""
        offset = self.first
        found: list[int] = []
        seen: set[int] = set()
        while offset:
            content = self.content(offset)
            if offset in seen or (content is None and not found):
                raise damaged(path, "its list of images leads back to itself" if found else "it leads to no image")
            if content is None:
                return found, True
            seen.add(offset)
            # entries come in the order of their codes, and that of reduced images is the lowest
            if self._number(content, self.count, 2) != _NEW_TYPE or not self.value(content, _NEW_TYPE) & 1:
                found.append(offset)
            offset = self._number(content, len(content) - self.offset, self.offset)
        if not found:
            raise damaged(path, "its header leads to no image")
        return found, False

    def content(self, offset: int) -> bytes | None:
        """Read the number of entries, the entries and the offset of the next page; None where the file ends before."""
        if offset + self.count > self.size:
            return None
        self.file.seek(offset)
        content = self.file.read(_PIECE)
        number = self._number(content, 0, self.count)
        needed = self.count + number * self.entry + self.offset
        if not 0 < number <= _MOST_ENTRIES or offset + needed > self.size:
            return None
        return content[:needed] + self.file.read(max(needed - len(content), 0))

    def value(self, content: bytes, code: int) -> int:
        """Return the one value of an entry; 0 where there is none."""
        found = self.place(content, code)
        width = 2 if self._number(content, found + 2, 2) == _SHORT else 4
        return self._number(content, found + 4 + self.offset, width) if found else 0

    def text(self, content: bytes, code: int) -> str:
        """Return the text of an entry; empty where there is none."""
        found = self.place(content, code)
        number = self._number(content, found + 4, self.offset) if found else 0
        start = found + 4 + self.offset
        if number <= self.offset:
            return content[start : start + number].decode(errors="replace").rstrip("\0")
        self.file.seek(min(self._number(content, start, self.offset), self.size))
        return self.file.read(min(number, _TEXT_BYTES)).decode(errors="replace").rstrip("\0")

    def place(self, content: bytes, code: int) -> int:
        """Return where the entry begins; 0 where there is none."""
        starts = range(self.count, len(content) - self.offset, self.entry)
        return next((start for start in starts if self._number(content, start, 2) == code), 0)

    def _number(self, content: bytes, start: int, width: int) -> int:
        return int.from_bytes(content[start : start + width], self.order)


def missing_data(page: TiffPage, size: int) -> str | None:
    """Describe what the page announces that a file of `size` bytes does not hold; None where all is there."""
    parts = list(zip(page.dataoffsets, page.databytecounts, strict=False))
    end = max((offset + count for offset, count in parts), default=0)
    if end > size:
        return f"the header announces image data up to byte {end}, the file has {size} bytes"
    if any(count == 0 for _, count in parts):
        return "a part of its image data has the length zero"
    return None


def is_stored_as_is(page: TiffPage) -> bool:
    """Return whether the page's samples are uncompressed and their bytes are all there."""
    bits = page.bitspersample if isinstance(page.bitspersample, int) else page.bitspersample[0]
    needed = math.ceil(page.imagewidth * page.imagelength * page.samplesperpixel * bits / 8)
    return bool(page.compression == UNCOMPRESSED and sum(page.databytecounts) >= needed)


def tag(page: TiffPage, code: int) -> tuple[Any, ...] | None:
    """Return the value of a tag as a tuple, or None where the page does not have it."""
    if code not in page.tags:
        return None
    value = page.tags[code].value
    return tuple(value) if isinstance(value, tuple | list | bytes) else (value,)


def cfa_pattern(page: TiffPage) -> str | None:
    """Return the name of the 2x2 colour filter array in the page's tags, or None where there is none."""
    pattern = tag(page, _CFA_PATTERN)
    if pattern is None or tag(page, _CFA_REPEAT) != (2, 2) or not set(pattern) <= {0, 1, 2}:
        return None
    return "".join("RGB"[channel] for channel in pattern)


@dataclass(frozen=True, slots=True, kw_only=True)
class RawStructure:
    """What the TIFF tags of a camera raw state beyond what LibRaw gives.

    Attributes
    ----------
    stored_as_is
        Whether the samples are uncompressed and all there, so that zeros in them are real.
    black_cell : ndarray, shape (2, 2), or None
        DNG black level by position at `origin`; None where no tag states it or states more than a 2x2 cell can hold.
    origin
        First row and column of the DNG's active area on the sensor.
    """

    stored_as_is: bool
    black_cell: FloatArray | None
    origin: tuple[int, int]

    @classmethod
    def read(cls, path: Path) -> RawStructure | None:
        """Read and check the tags; None for files that are not TIFF inside or that only LibRaw can follow.

        Raises
        ------
        FrameError
            Image data that the header announces is not in the file.
        """
        try:
            with tiff_pages(path) as pages:
                raw = [page for page in pages if page.photometric in _RAW_PHOTOMETRIC] or pages
                page = max(raw, key=lambda page: page.imagewidth * page.imagelength)
                area = tag(page, _ACTIVE_AREA) or (0, 0)
                black = _black_cell(page)
                structure = cls(stored_as_is=is_stored_as_is(page), black_cell=black, origin=(area[0], area[1]))
                missing = [reason for page in raw if (reason := missing_data(page, path.stat().st_size))]
        except FrameError:
            return None
        if missing:
            raise damaged(path, missing[0])
        return structure

    def black_level(self, top: int, left: int) -> FloatArray | None:
        """Return the black level of each position of the 2x2 cell that starts at row `top`, column `left`.

        LibRaw moves odd margins to the next even row and column without moving the black levels along.
        """
        if self.black_cell is None:
            return None
        return np.roll(self.black_cell, (self.origin[0] - top, self.origin[1] - left), axis=(0, 1))


def _black_cell(page: TiffPage) -> FloatArray | None:
    levels, repeat = tag(page, _BLACK), tag(page, _BLACK_REPEAT) or (1, 1)
    if levels is None or any(delta in page.tags for delta in _BLACK_DELTAS) or not set(repeat) <= {1, 2}:
        return None
    numbers = np.array(levels, dtype=np.float64)
    if len(numbers) == 2 * math.prod(repeat):  # rationals come as numerator, denominator
        numbers = numbers[::2] / numbers[1::2]
    if len(numbers) != math.prod(repeat):
        return None
    return np.tile(numbers.reshape(repeat), (2 // repeat[0], 2 // repeat[1]))
