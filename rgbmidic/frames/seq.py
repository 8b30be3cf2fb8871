"""NorPix StreamPix's sequences (.seq): uncompressed monochrome or raw samples with a time stamp behind each frame.

Layout: NorPix, "The NorPix Sequence File Format (.seq)", 2015; before version 5 of the header the frames begin behind
its 1024 bytes, and stamps have no microseconds. No file of a camera was at hand: read are files written by the tests.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.layout import Layout
from rgbmidic.frames.recording import Integers, Recording
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import StoredFrame, damaged

__all__ = ["SeqFile"]

_MAGIC = 0xFEED
_HEADER = struct.Struct("<I24xi4x512x6I3Id16xi8xI32xI364x")
"""Magic; version; width, height, bits stored, bits used, bytes, format; frames, origin, distance; rate; pattern;
compression; oldest frame."""

_RAW = {
    100: ("<u2", False),
    101: ("<u2", False),
    112: ("<u2", True),
    113: ("<u2", True),
    114: (">u2", True),
    115: (">u2", True),
}
"""Monochrome and raw Bayer formats: samples above 8 bit, and whether their highest bit is the type's highest."""

_BAYER = (101, 113, 115)
_PATTERNS = {1: "GRBG", 2: "BGGR", 3: "RGGB"}
"""By NorPix's `eHBayerPatternOrigin`; 0, green beside blue, is also what a header holds that tells no pattern."""

_PACKED = range(131, 135)


@dataclass(frozen=True, slots=True, kw_only=True)
class SeqFile(Movie):
    """An uncompressed sequence of StreamPix."""

    def _recording(self) -> Recording:
        return _header(self.path).recording

    def _shape(self) -> tuple[int, int]:
        return _header(self.path).shape

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        header = _header(self.path)
        place = (index + header.oldest) % header.layout.count
        data = header.layout.read(self.path, place, rows, header.shape[0])
        values = np.frombuffer(data, dtype=header.dtype).reshape(len(rows), -1) >> header.shift
        return StoredFrame(values=values, kind="bayer" if header.cfa else None, cfa=header.cfa, bits=header.bits)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    """What is known of the frames; `oldest` is the place in the file of the frame that was recorded first."""

    shape: tuple[int, int]
    dtype: str
    bits: int
    shift: int
    cfa: str | None
    oldest: int
    layout: Layout
    recording: Recording


@remembered
def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        content = file.read(_HEADER.size)
        if len(content) < _HEADER.size or int.from_bytes(content[:4], "little") != _MAGIC:
            raise damaged(path, "it does not begin as a NorPix sequence")
        return _parsed(content, file, path)


def _parsed(content: bytes, file: BinaryIO, path: Path) -> _Header:
    fields = _HEADER.unpack(content)
    _, version, columns, rows, stored_bits, bits, size, form, count, _, stride, rate, pattern, compression, oldest = (
        fields
    )
    _check_raw(path, form, compression)
    if not columns or not rows or stored_bits not in (8, 16) or not 1 <= bits <= stored_bits:
        raise damaged(path, f"it announces {rows} rows of {columns} samples, {bits} of {stored_bits} bits")
    if size != rows * columns * stored_bits // 8 or oldest >= max(count, 1):
        raise damaged(path, f"it announces {size} bytes for {rows} rows of {columns} samples of {stored_bits} bits")
    layout = Layout.checked(path, count=count, start=8192 if version >= 5 else 1024, size=size, stride=stride)
    dtype, upper = _RAW[form]
    return _Header(
        shape=(rows, columns),
        dtype=dtype if stored_bits == 16 else "u1",
        bits=bits,
        shift=stored_bits - bits if upper else 0,
        cfa=_PATTERNS.get(pattern) if form in _BAYER else None,
        oldest=oldest,
        layout=layout,
        recording=Recording(
            count=count,
            bit_depth=bits,
            frame_rate=rate if math.isfinite(rate) and rate > 0 else None,
            times_ns=_times_ns(file, layout, oldest, "<iHH" if version >= 5 else "<iH"),
        ),
    )


def _check_raw(path: Path, form: int, compression: int) -> None:
    if compression:
        _refuse(path, f"is compressed (method {compression})")
    if form in _PACKED:
        _refuse(path, f"holds packed samples (format {form})")
    if form not in _RAW:
        _refuse(path, f"holds colours (format {form}): its samples are no longer the sensor's, and it")


def _refuse(path: Path, what: str) -> NoReturn:
    raise FrameError(f"{path} {what} and is not read: export it uncompressed, 8 or 16 bit, monochrome or raw Bayer")


def _times_ns(file: BinaryIO, layout: Layout, oldest: int, stamp: str) -> Integers | None:
    """Time of every frame from the first; None where the file ends before the last stamp or they do not grow."""
    size = struct.calcsize(stamp)
    behind = layout.start + layout.size
    if layout.stride < layout.size + size or file.seek(0, 2) < behind + (layout.count - 1) * layout.stride + size:
        return None
    times = np.empty(layout.count, dtype=np.int64)
    for index in range(layout.count):
        file.seek(behind + (index + oldest) % layout.count * layout.stride)
        seconds, *parts = struct.unpack(stamp, file.read(size))
        times[index] = seconds * 10**9 + sum(part * 10**power for part, power in zip(parts, (6, 3), strict=False))
    times -= times[0]
    return times if (np.diff(times) > 0).all() else None
