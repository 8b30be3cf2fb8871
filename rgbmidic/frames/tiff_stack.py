"""TIFF and BigTIFF files of several frames: one page each, as ImageJ's hyperstacks and OME-TIFF are, too.

The list of pages is followed by own code, once: a hundred thousand pages take tifffile seconds, for every frame anew.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Literal
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import Integers, Recording, even_times
from rgbmidic.frames.images import checked_page, page_frame, page_rows
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import Layout, StoredFrame, check_count, damaged
from rgbmidic.frames.tiff_pages import HEADERS, is_stored_as_is, tiff_page
from rgbmidic.settings import regular
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from tifffile import TiffPage

__all__ = ["TiffStack", "is_tiff_stack"]

_PIECE = 512
"""Bytes that are read of a page at once: its usual one to two dozen entries."""
_MOST_ENTRIES = 4096
"""Entries of a page beyond which it is no page: those seen have a few dozen."""
_DESCRIPTION_BYTES = 256 * 2**20
"""Most bytes of a description: OME uses some 300 for every frame."""
_SHORT = 3
_NEW_TYPE, _COLUMNS, _ROWS, _DESCRIPTION = 254, 256, 257, 270
_UNITS = {"s": 1, "sec": 1, "seconds": 1}
_UNITS |= {"ms": 10**3, "msec": 10**3, "µs": 10**6, "us": 10**6, "usec": 10**6, "ns": 10**9}
"""Of time, by how many make a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffStack(Movie):
    """A TIFF file of several frames of one size, in the order of the file."""

    def _header(self) -> _Stack:
        return _stack(self.path)

    def _rows(self, index: int, rows: range) -> StoredFrame:
        stack = _stack(self.path)
        if index >= len(stack.offsets) > 1:
            raise FrameError(
                f"{self.path}: its list of frames ends after {index - 1}: truncated or still being written"
            )
        alone = len(stack.offsets) == 1
        with tiff_page(self.path, int(stack.offsets[0 if alone else index])) as page:
            checked_page(page, self.path)
            if (page.imagelength, page.imagewidth) != stack.shape:
                here = f"{page.imagelength} rows of {page.imagewidth} pixels"
                raise FrameError(
                    f"{self.path}: frame {index} has {here}, the first {stack.shape[0]} of {stack.shape[1]}"
                )
            behind = _behind(page, self.path, index, stack.recording.count, rows) if alone else None
            samples = behind if alone else page_rows(page, self.path, rows)
            stored = page_frame(page, self.path, samples)
            return stored if samples is not None else replace(stored, values=stored.values[rows.start : rows.stop])


def is_tiff_stack(path: Path) -> bool:
    """Return whether a TIFF file holds several frames; False for what cannot be read."""
    try:
        return _stack(path).recording.count > 1
    except (OSError, FrameError):
        return False


def _behind(page: TiffPage, path: Path, index: int, count: int, rows: range) -> AnyArray:
    """Read some rows of a frame of which only the first has a page, as ImageJ stores more than 4 GB."""
    if not is_stored_as_is(page) or not page.is_contiguous:
        raise FrameError(f"{path} announces {count} frames but has one page, whose samples are compressed or in pieces")
    layout = Layout.checked(path, count=count, start=page.dataoffsets[0], size=page.nbytes)
    dtype = np.dtype(page.dtype)
    data = layout.read(path, index, rows, page.imagelength)
    stored = np.frombuffer(data, dtype=dtype.newbyteorder(page.parent.byteorder))
    return stored.astype(dtype, copy=False).reshape(len(rows), *page.shape[1:])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Stack:
    """Where the pages begin (one, where all frames lie behind the first), the size of the first, and the recording."""

    offsets: Integers
    shape: tuple[int, int]
    recording: Recording


@remembered
def _stack(path: Path) -> _Stack:
    with regular(path).open("rb") as file:
        pages = _Pages.begin(file, path)
        offsets, ends_early = pages.offsets(path)
        content = pages.content(offsets[0]) or b""
        text = pages.text(content, _DESCRIPTION)
        shape = (pages.value(content, _ROWS), pages.value(content, _COLUMNS))
    images = re.search(r"^images=([0-9]{1,9})$", text, re.MULTILINE) if text.startswith("ImageJ=") else None
    count = int(images[1]) if images and len(offsets) == 1 else len(offsets) + (ends_early and len(offsets) > 1)
    check_count(path, count)
    times = _imagej_times(text, count) if images else _ome_times(text, count)
    recording = Recording(count=count, times_ns=times)
    return _Stack(offsets=np.array(offsets, dtype=np.int64), shape=shape, recording=recording)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Pages:
    """The pages of an open file of `size` bytes; widths in bytes of an offset, a number of entries, an entry."""

    file: BinaryIO
    size: int
    order: Literal["little", "big"]
    offset: int
    count: int
    entry: int

    @classmethod
    def begin(cls, file: BinaryIO, path: Path) -> _Pages:
        head = file.read(4)
        if head not in HEADERS:
            raise damaged(path, "it is not a TIFF file")
        order: Literal["little", "big"] = "little" if head[:1] == b"I" else "big"
        offset, count, entry = (8, 8, 20) if head in HEADERS[2:] else (4, 2, 12)
        return cls(file=file, size=file.seek(0, 2), order=order, offset=offset, count=count, entry=entry)

    def offsets(self, path: Path) -> tuple[list[int], bool]:
        """Where the pages in full resolution begin, and whether their list leads out of the file."""
        self.file.seek(self.offset)  # 4 or 8: of both headers the offset of the first page is the last field
        offset = self._number(self.file.read(self.offset), 0, self.offset)
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
        found = self._entry(content, code)
        width = 2 if self._number(content, found + 2, 2) == _SHORT else 4
        return self._number(content, found + 4 + self.offset, width) if found else 0

    def text(self, content: bytes, code: int) -> str:
        """Return the text of an entry; empty where there is none."""
        found = self._entry(content, code)
        number = self._number(content, found + 4, self.offset) if found else 0
        start = found + 4 + self.offset
        if number <= self.offset:
            return content[start : start + number].decode(errors="replace").rstrip("\0")
        self.file.seek(min(self._number(content, start, self.offset), self.size))
        return self.file.read(min(number, _DESCRIPTION_BYTES)).decode(errors="replace").rstrip("\0")

    def _entry(self, content: bytes, code: int) -> int:
        """Return where the entry begins; 0 where there is none."""
        starts = range(self.count, len(content) - self.offset, self.entry)
        return next((start for start in starts if self._number(content, start, 2) == code), 0)

    def _number(self, content: bytes, start: int, width: int) -> int:
        return int.from_bytes(content[start : start + width], self.order)


def _imagej_times(text: str, count: int) -> Integers | None:
    """Derive times from ImageJ's frame interval, where all images are frames in time."""
    entries = dict(line.split("=", 1) for line in text.splitlines() if "=" in line)
    others = {"channels", "slices"} & entries.keys()
    if entries.get("frames", "" if others else str(count)) != str(count):
        return None
    return _even_times(entries.get("finterval", ""), entries.get("tunit", "s"), count)


def _ome_times(text: str, count: int) -> Integers | None:
    """Derive times from OME's time increment or the time of every plane."""
    if "<OME" not in text[:1000] or "<!ENTITY" in text:
        return None
    try:
        pixels = ElementTree.fromstring(text.encode()).find(".//{*}Pixels")
    except ElementTree.ParseError:
        return None
    if pixels is None or pixels.get("SizeT") != str(count):
        return None
    if pixels.get("TimeIncrement"):
        return _even_times(pixels.get("TimeIncrement", ""), pixels.get("TimeIncrementUnit", "s"), count)
    planes = {plane.get("TheT"): plane for plane in pixels.iterfind("{*}Plane")}
    each = [planes.get(str(index), pixels) for index in range(count)]
    times = [_seconds(plane.get("DeltaT", ""), plane.get("DeltaTUnit", "s")) for plane in each]
    known = [round(time * 10**9) for time in times if time is not None]
    return np.array(known, dtype=np.int64) if len(known) == count else None


def _even_times(interval: str, unit: str, count: int) -> Integers | None:
    seconds = _seconds(interval, unit)
    return even_times(range(count), seconds) if seconds else None


def _seconds(text: str, unit: str) -> Fraction | None:
    if unit not in _UNITS or not re.fullmatch(r"[0-9]{1,9}(\.[0-9]{1,15})?([eE]-?[0-9])?", text):
        return None
    return Fraction(text) / _UNITS[unit]
