"""TIFF and BigTIFF files of several frames: one page each, as ImageJ's hyperstacks and OME-TIFF are, too."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import Integers, Recording, even_times, fraction
from rgbmidic.frames.images import checked_page, page_frame, page_rows
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import Layout, StoredFrame, check_count
from rgbmidic.frames.tiff_pages import COLUMNS, DESCRIPTION, ROWS, PageList, is_stored_as_is, tiff_page
from rgbmidic.settings import regular
from rgbmidic.typing import AnyArray

if TYPE_CHECKING:
    from tifffile import TiffPage

__all__ = ["TiffStack", "is_tiff_stack"]

_UNITS = {"s": 1, "sec": 1, "seconds": 1}
_UNITS |= {"ms": 10**3, "msec": 10**3, "µs": 10**6, "us": 10**6, "usec": 10**6, "ns": 10**9}
"""Of time, by how many make a second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TiffStack(Movie):
    """A TIFF file of several frames of one size, in the order of the file."""

    def _header(self) -> _Stack:
        return _stack(self.path)


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

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame."""
        if index >= len(self.offsets) > 1:
            raise FrameError(f"{path}: its list of frames ends after {index - 1}: truncated or still being written")
        alone = len(self.offsets) == 1
        with tiff_page(path, int(self.offsets[0 if alone else index])) as page:
            checked_page(page, path)
            if (page.imagelength, page.imagewidth) != self.shape:
                here = f"{page.imagelength} rows of {page.imagewidth} pixels"
                raise FrameError(f"{path}: frame {index} has {here}, the first {self.shape[0]} of {self.shape[1]}")
            count = self.recording.count
            samples = _behind(page, path, index, count, rows) if alone else page_rows(page, path, rows)
            stored = page_frame(page, path, samples)
            return stored if samples is not None else replace(stored, values=stored.values[rows.start : rows.stop])


@remembered
def _stack(path: Path) -> _Stack:
    with regular(path).open("rb") as file:
        pages = PageList.begin(file, path)
        offsets, ends_early = pages.offsets(path)
        content = pages.content(offsets[0]) or b""
        text = pages.text(content, DESCRIPTION)
        shape = (pages.value(content, ROWS), pages.value(content, COLUMNS))
    images = re.search(r"^images=([0-9]{1,9})$", text, re.MULTILINE) if text.startswith("ImageJ=") else None
    count = int(images[1]) if images and len(offsets) == 1 else len(offsets) + (ends_early and len(offsets) > 1)
    check_count(path, count)
    times = _imagej_times(text, count) if images else _ome_times(text, count)
    recording = Recording(count=count, times_ns=times)
    return _Stack(offsets=np.array(offsets, dtype=np.int64), shape=shape, recording=recording)


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
    number = fraction(text)
    return None if number is None or unit not in _UNITS else number / _UNITS[unit]
