"""A writer of Phantom movies (.cine), from the published layout alone: what the reader's tests and fast tests read."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

SETUP_LENGTH = 10408
_CODES = {None: 0, "GBRG": 3, "RGGB": 4}
_PACKINGS = {8: (8, 0), 16: (16, 0), 10: (16, 256), 12: (16, 1024)}
_TRIGGER = 1_700_000_000 * 2**32 + 123_456_789
_PLACES = {
    "FrameRate16": (0, "H"),
    "Shutter16": (2, "H"),
    "bFlipH": (756, "I"),
    "bFlipV": (760, "I"),
    "FrameRate": (768, "I"),
    "Shutter": (772, "I"),
    "CFA": (808, "I"),
    "RealBPP": (896, "I"),
    "ShutterNs": (1568, "I"),
    "BlackLevel": (5732, "i"),
    "WhiteLevel": (5736, "i"),
    "dFrameRate": (10400, "d"),
}


def even_times(count: int, rate: float, first: int, lost: Sequence[int] = ()) -> list[int]:
    """Times in ns from the trigger of `count` frames at `rate`, whose numbers begin with `first` and lack `lost`."""
    numbers = [number for number in range(count + len(lost)) if number not in lost]
    return [round((first + number) * 1e9 / rate) for number in numbers]


def write_cine(
    path: Path,
    frames: Iterable[Any],
    *,
    count: int,
    bits: int = 16,
    depth: int | None = None,
    cfa: str | None = None,
    levels: tuple[int, int] = (64, 4064),
    first: int = 0,
    rate: float = 1000.0,
    exposure_ns: int = 5000,
    times_ns: Sequence[int] | None = None,
    setup_length: int = SETUP_LENGTH,
    annotation: bytes = b"",
    top_down: bool = False,
    version: int = 1,
    changed: Mapping[str, Any] | None = None,
    compression: int | None = None,
) -> None:
    """Write upright frames (H, W), one after the other, so that `frames` may be a generator.

    `bits` is 8 or 16, or packed 10 (the frames are its codes) or 12. Unpacked frames are stored bottom-up unless
    `top_down`. `changed` are fields of SETUP; those behind `setup_length` are not stored.
    """
    upright = iter(frames)
    started = np.asarray(next(upright))
    rows, columns = started.shape
    bit_count, packing = _PACKINGS[bits]
    setup = bytearray(setup_length)
    fields = {
        **{"FrameRate16": min(int(rate), 65535), "FrameRate": int(rate), "dFrameRate": rate, "CFA": _CODES[cfa]},
        **{"Shutter16": exposure_ns // 1000, "Shutter": exposure_ns // 1000, "ShutterNs": exposure_ns},
        **{"RealBPP": depth or {8: 8, 10: 10}.get(bits, 12), "BlackLevel": levels[0], "WhiteLevel": levels[1]},
        **(changed or {}),
    }
    for name, value in fields.items():
        place, kind = _PLACES[name]
        if place + struct.calcsize(kind) <= setup_length:
            struct.pack_into("<" + kind, setup, place, value)
    struct.pack_into("<2sH", setup, 140, b"ST", setup_length)
    times = even_times(count, rate, first) if times_ns is None else times_ns
    stamps = [_TRIGGER + round(time * 2**32 / 1e9) for time in times]
    exposure = round(exposure_ns * 2**32 / 1e9)
    blocks = _block(1002, np.array(stamps, dtype="<u8")) + _block(1003, np.full(count, exposure, dtype="<u4"))
    table = 84 + setup_length + len(blocks)
    pointer = "<i8" if version else "<u4"
    size = -(-rows * columns * bits // 8)
    begin = table + count * np.dtype(pointer).itemsize
    step = 8 + len(annotation) + size
    kind = (2 if cfa else 0) if compression is None else compression
    head = (b"CI", 44, kind, version, first, count, first, count, 44, 84, table, _TRIGGER)
    height, most = -rows if top_down else rows, 2 ** min(fields["RealBPP"], 16)
    bitmap = (40, columns, height, 1, bit_count, packing, size, 0, 0, 0, most)
    with path.open("wb") as file:
        file.write(struct.pack("<2s3HiIi4IQ", *head) + struct.pack("<I2i2H6I", *bitmap) + setup + blocks)
        file.write((begin + step * np.arange(count)).astype(pointer).tobytes())
        for frame in chain([started], upright):
            stored = np.asarray(frame) if top_down or bits in (10, 12) else np.asarray(frame)[::-1]
            file.write(struct.pack("<I", 8 + len(annotation)) + annotation + struct.pack("<I", size))
            file.write(_packed(stored, bits))


def _block(kind: int, values: np.ndarray[Any, np.dtype[Any]]) -> bytes:
    return struct.pack("<IHH", 8 + values.nbytes, kind, 1) + values.tobytes()


def _packed(frame: np.ndarray[Any, np.dtype[Any]], bits: int) -> bytes:
    """The samples, bit after bit from the highest; those of a byte or more with the low byte first."""
    if bits in (8, 16):
        return frame.astype(f"<u{bits // 8}").tobytes()
    digits = frame.astype(">u2").reshape(-1, 1).view(np.uint8)
    return np.packbits(np.unpackbits(digits, axis=1)[:, 16 - bits :]).tobytes()
