"""Phantom movies (.cine): frames as the sensor gave them, each read by itself.

The format is Vision Research's ("The Cine File Format"); the header is checked before anything large is read. Samples
come as 8 bit, as 8 to 16 bit in 16-bit containers, or packed: 12 bit, or 10 bit in a code that is not linear. Offsets
are those of the structures CINEFILEHEADER, BITMAPINFOHEADER and SETUP; SETUP has grown over the years, and of it only
what a file stores is read.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import FrameError, damaged_file
from rgbmidic.frames.data import SECOND, Recording
from rgbmidic.frames.metadata import MovieHeader, StoredFrame, check_size, truncated_file, unpack_bits
from rgbmidic.frames.source import MovieSource, cache_by_file
from rgbmidic.settings import FrameKind
from rgbmidic.typing import AnyArray

CINE_ENDINGS = (".cine", ".cin", ".cci")

_FILE, _BITMAP = struct.Struct("<2s3HiIi4IQ"), struct.Struct("<I2i2H6I")
_SETUP = {
    "frame_rate_16": (0, "H"),
    "shutter_us_16": (2, "H"),
    "flip_horizontally": (756, "I"),
    "flip_vertically": (760, "I"),
    "frame_rate_32": (768, "I"),
    "shutter_us": (772, "I"),
    "cfa": (808, "I"),
    "rotate": (884, "i"),
    "bits": (896, "I"),
    "shutter_ns": (1568, "I"),
    "black": (5732, "i"),
    "white": (5736, "i"),
    "frame_rate": (10400, "d"),
}
"""Place and type of the fields of SETUP that are read."""
_MARK, _LENGTH = 140, 142
_TIMES, _EXPOSURES = 1002, 1003
_STAMPS = {_TIMES: "<u8", _EXPOSURES: "<u4"}
_MAX_BLOCKS, _MAX_FRAMES = 100, 2**25
"""Limits beyond any file of a camera: Phantom's own have five blocks, the largest memories some million frames."""

_LEAD, _UNINTERPOLATED = 1, 2
_PACKED_BITS = {256: 10, 1024: 12}
"""Bits of a sample that each code of packed frames means."""
_PATTERNS = {3: "GBRG", 4: "RGGB"}

_ReadBytes = Callable[[int, int], bytes]
"""Gives the bytes of a movie's header from some byte on, so many."""

_STEPS = (
    "311111111111101111111111111111011111111111111101111111111111110111111111111111101111111111111110111111111111"
    "111101111111111111110111111111111011111111111111111211111111121111112111121112111211121121121121121211212121"
    "121212121212122121221212212212212212221222122212222212222222122222222222222222222222322222223222223222322232"
    "223223223223223232322323232323232323323232332332332332333233323332333332333333332333333333333333333343333333"
    "343333433334333433433343343433434334343434343434343443434434434434434443444344443444444344444444444444444444"
    "444444544444544445444544454454454454454545445454545454554545455455455455455545554555545555554555555555555555"
    "555555555565555556555565556555655655655656556565656565656565656656656566566656665666566665666666665666666666"
    "666667666666667666676666766676676676676766767676767676767676776767767767776777677767777767777777777767777787"
    "777777777787777787777877787787787787787878778787878788787878878878878878887888878888878888888888888888888888"
    "888988888988889888988988988988989898898988"
)
_LINEAR = np.full(1024, 4095, dtype=np.uint16)
_LINEAR[: len(_STEPS) + 1] = np.cumsum([2, *map(int, _STEPS)])
"""Grey level (12 bit) of each code of packed 10 bit: appendix 1 of the format's description, as hypercine publishes it.

Stored as the steps from one code to the next; the codes above 1014, white, are saturated.
"""


class CineFile(MovieSource):
    """A Phantom .cine file. Flips and rotation are settings of the camera's viewer and left to it."""

    def _header(self) -> _Header:
        return _header(self.path)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header(MovieHeader):
    """Header of a movie, with its levels of codes made linear.

    Attributes
    ----------
    bits
        Bits that a sample is stored in: 8, 16, or packed 10 or 12.
    bottom_up
        Whether the last row is stored first.
    metadata
        Pattern and grey levels (DN), without samples; no black level where that of the header cannot be.
    pointers : ndarray, shape (count,), int64
        Where each frame begins in the file.
    size
        Bytes of the file.
    """

    bits: int
    bottom_up: bool
    metadata: StoredFrame
    pointers: npt.NDArray[np.int64]
    size: int

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        """Read some rows of a frame."""
        height, columns = self.shape
        lines = self._lines(path, index, range(height - rows.stop, height - rows.start) if self.bottom_up else rows)
        if self.bits in (8, 16):
            samples: AnyArray = lines.view("u1" if self.bits == 8 else "<u2")
        else:
            samples = unpack_bits(lines, self.bits)
        values = samples[:, : columns * len(rows) // len(lines)].reshape(len(rows), columns)
        if self.bits == 10:  # packed samples of 10 bit are codes
            values = _LINEAR[values]
        return replace(self.metadata, values=values[::-1] if self.bottom_up else values)

    def _lines(self, path: Path, index: int, rows: range) -> npt.NDArray[np.uint8]:
        """Read the bytes of some rows of a frame, (n, bytes), or (1, bytes) where a row ends within a byte."""
        start = int(self.pointers[index])
        n_bytes = _frame_bytes(self.shape, self.bits)
        packed_bits = self.shape[1] * self.bits
        padded_bits = math.ceil(packed_bits / 32) * 32  # bits from one row to the next, as in Windows bitmaps
        is_whole = (self.pointers >= _FILE.size) & (self.pointers <= self.size - 8 - n_bytes)
        first_missing = int(np.argmin(np.append(is_whole, False)))
        end_error = truncated_file(path, n_complete=min(first_missing, index), count=self.recording.count)
        with path.open("rb") as file:
            if start < _FILE.size or start + 8 > self.size:
                raise end_error
            file.seek(start)
            annotation = int.from_bytes(file.read(4), "little")
            if annotation < 8 or start + annotation > self.size:
                raise damaged_file(path, f"the annotation of frame {index} has {annotation} bytes")
            file.seek(start + annotation - 4)
            size = int.from_bytes(file.read(4), "little")
            if (row_bits := {self.shape[0] * padded_bits // 8: padded_bits, n_bytes: packed_bits}.get(size)) is None:
                raise damaged_file(path, f"frame {index} has not the size that its header announces")
            if start + annotation + size > self.size:
                raise end_error
            first, last = rows.start * row_bits // 8, math.ceil(rows.stop * row_bits / 8)
            file.seek(first, 1)
            samples = np.fromfile(file, dtype=np.uint8, count=last - first)
            return samples.reshape(1 if row_bits % 8 else len(rows), -1)


@cache_by_file
def _header(path: Path) -> _Header:
    """Read the header of a movie.

    Raises
    ------
    FrameError
        It is damaged, or announces what no camera records or what is not the sensor's samples.
    """
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size

        def piece(start: int, length: int) -> bytes:
            if start + length > size:
                problem = f"its header goes on to byte {start + length}, behind the end of the file at byte {size}"
                raise damaged_file(path, problem)
            file.seek(start)
            return file.read(length)

        mark, _, compression, version, _, _, first, count, *offsets, trigger = _FILE.unpack(piece(0, _FILE.size))
        if mark != b"CI":
            raise FrameError(f"{path} is no Phantom movie: it does not begin as one")
        if not 0 < count <= _MAX_FRAMES:
            raise damaged_file(path, f"its header announces {count} frames")
        _, columns, height, _, bit_count, packing, *_, levels = _BITMAP.unpack(piece(offsets[0], _BITMAP.size))
        setup, end = _setup(path, piece, offsets[1])
        kind, cfa = _colours(path, compression, bit_count, setup.get("cfa", 0))
        bits, shape = _PACKED_BITS.get(packing, bit_count), (abs(height), columns)
        if packing not in _PACKED_BITS and (packing != 0 or bit_count not in (8, 16)):
            packing_error = f"packed in the way {packing}, which is unknown"
            raise damaged_file(path, f"its header announces samples of {bit_count} bit, {packing_error}")
        if min(shape) < 1:
            raise damaged_file(path, f"its header announces {shape[0]} rows of {shape[1]} pixels")
        check_size(path, unpacked=2 * math.prod(shape), stored=_frame_bytes(shape, bits))
        if version not in (0, 1):
            raise damaged_file(path, f"its header announces the version {version} of the format; known are 0 and 1")
        pointer_type = np.dtype("<i8" if version else "<u4")
        pointers = np.frombuffer(piece(offsets[2], count * pointer_type.itemsize), pointer_type)
        stamps = _stamps(path, piece, (end, offsets[2]), count)
    # of the code of 10 bit, 12; else the header's number, or as its number of levels needs
    bit_depth = next(
        (bits_used for bits_used in (setup.get("bits", 0), (levels - 1).bit_length()) if 8 <= bits_used <= bits), bits
    )
    depth = 12 if bits in (10, 12) else bit_depth
    black, white, remarks = _levels(setup, depth)
    if bits == 10 and white < len(_LINEAR):  # levels of 10 bit are codes as the samples are
        black, white = None if black is None else int(_LINEAR[black]), int(_LINEAR[white])
    return _Header(
        shape=shape,
        bits=bits,
        bottom_up=height > 0 and bits in (8, 16),
        metadata=StoredFrame(
            kind=kind,
            cfa=cfa,
            black_level=None if black is None else np.full((2, 2), float(black)),
            white_level=float(white),
        ),
        recording=Recording(
            count=count,
            bit_depth=depth,
            trigger=-first,
            times_ns=_since_trigger(stamps[_TIMES], trigger) if _TIMES in stamps else None,
            **_settings(setup, stamps.get(_EXPOSURES), remarks),
        ),
        pointers=pointers.astype(np.int64),
        size=size,
    )


def _frame_bytes(shape: tuple[int, int], bits: int) -> int:
    """Return the bytes of a frame."""
    return -(-math.prod(shape) * bits // 8)


def _setup(path: Path, piece: _ReadBytes, start: int) -> tuple[dict[str, Any], int]:
    """Read the fields that the camera's settings store, and where these end."""
    head = piece(start, _LENGTH + 2)
    length = int.from_bytes(head[_LENGTH:], "little")
    if head[_MARK:_LENGTH] != b"ST" or length < len(head):
        raise damaged_file(path, "the camera's settings in its header are not where they should be")
    content = piece(start, length)
    fields = {
        name: struct.unpack_from("<" + kind, content, offset)[0]
        for name, (offset, kind) in _SETUP.items()
        if offset + struct.calcsize(kind) <= length
    }
    return fields, start + length


def _colours(path: Path, compression: int, bit_count: int, code: int) -> tuple[FrameKind | None, str | None]:
    """Return kind and pattern; a colour camera's picture that was made grey has neither, nor has an unknown code.

    Raises
    ------
    FrameError
        The samples are not the sensor's, or the pattern is no Bayer pattern.
    """
    if compression == _LEAD or bit_count > 16:
        processing = "compressed (JPEG)" if compression == _LEAD else "processed (interpolated) colour"
        raise FrameError(
            f"{path} is {processing}: its samples are no longer the sensor's; save it as raw .cine from the camera's "
            "software"
        )
    if compression not in (0, _UNINTERPOLATED):
        raise damaged_file(path, f"its header announces the kind of compression {compression}, which is unknown")
    if code & 0xF0000000:
        raise FrameError(f"{path} joins the pictures of grey and colour heads (code {code:#x}), which is not read")
    if compression == _UNINTERPOLATED and code in (1, 2):
        raise FrameError(f"{path} has the colour filter array {code} of old cameras, which is no Bayer pattern")
    if compression == _UNINTERPOLATED and code in _PATTERNS:
        return "bayer", _PATTERNS[code]
    return ("monochrome" if code == compression == 0 else None), None


def _levels(setup: Mapping[str, int], depth: int) -> tuple[int | None, int, tuple[str, ...]]:
    """Return black and white level, and a remark on those of the header: some cameras store none, or 8-bit ones."""
    largest = 2**depth - 1
    black, white = setup.get("black", 0), setup.get("white", 0)
    if 0 <= black < white <= largest and (white > 255 or depth == 8):
        return black, white, ()
    remark = f"black level {black} and white level {white} of its header do not fit samples of {depth} bit: not used"
    return None, largest, (remark,) if black or white else ()


def _stamps(path: Path, piece: _ReadBytes, limits: tuple[int, int], count: int) -> dict[int, npt.NDArray[Any]]:
    """Read times and exposures (count,) of the frames from the tagged blocks, as far as there are any."""
    stamps: dict[int, npt.NDArray[Any]] = {}
    (offset, end), length = limits, 8
    for _ in range(_MAX_BLOCKS):
        if offset + 8 > end or length < 8:
            break
        length, kind = struct.unpack("<IH", piece(offset, 6))
        if kind in _STAMPS:
            stamp_type = np.dtype(_STAMPS[kind])
            if length - 8 < count * stamp_type.itemsize:
                raise damaged_file(path, f"block {kind} of its header has {length} bytes, too few for {count} frames")
            stamps[kind] = np.frombuffer(piece(offset + 8, count * stamp_type.itemsize), stamp_type)
        offset += length
    return stamps


def _since_trigger(times: npt.NDArray[np.uint64], trigger: int) -> npt.NDArray[np.int64]:
    """Convert to ns from the trigger; both are seconds in fixed point 32.32, whose last two bits are flags."""
    flags = np.uint64(3)
    ticks = ((times & ~flags) - (np.uint64(trigger) & ~flags)).astype(np.int64)
    return np.asarray((ticks >> 32) * SECOND + (((ticks & 0xFFFFFFFF) * SECOND + 2**31) >> 32))


def _settings(
    setup: Mapping[str, Any], exposures: npt.NDArray[np.uint32] | None, remarks: tuple[str, ...]
) -> dict[str, Any]:
    """Return frame rate, exposure and remarks: the exposure as stamped (0.32 fixed point seconds), else as set."""
    rates = (setup.get(name, 0.0) for name in ("frame_rate", "frame_rate_32", "frame_rate_16"))
    stamped = 0 if exposures is None else (int(np.sort(exposures)[len(exposures) // 2]) * SECOND + 2**31) >> 32
    us = setup.get("shutter_us", 0) or setup.get("shutter_us_16", 0)
    ignored = [name for name in ("flip_horizontally", "flip_vertically", "rotate") if setup.get(name, 0)]
    if ignored:
        names = ", ".join(ignored).replace("_", " ")
        remarks += (f"the viewer's settings are left out ({names}): frames are as the sensor gave them",)
    return {
        "frame_rate": next((float(rate) for rate in rates if math.isfinite(rate) and rate > 0), None),
        "exposure_ns": stamped or setup.get("shutter_ns", 0) or 1000 * us or None,
        "remarks": remarks,
    }
