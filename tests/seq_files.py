"""Writes NorPix sequences as the published description says (The NorPix Sequence File Format, 2015)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

from rgbmidic.typing import AnyArray

_FIELDS = {
    "version": (28, "<i"),
    "header_size": (32, "<i"),
    "columns": (548, "<I"),
    "rows": (552, "<I"),
    "bit_depth": (556, "<I"),
    "bit_depth_real": (560, "<I"),
    "image_size": (564, "<I"),
    "image_format": (568, "<I"),
    "allocated_frames": (572, "<I"),
    "true_image_size": (580, "<I"),
    "frame_rate": (584, "<d"),
    "bayer_pattern": (608, "<i"),
    "compression": (620, "<I"),
    "oldest_frame": (656, "<I"),
}
"""Byte and type of each field that is written."""


def write_seq(path: Path, frames: AnyArray, *, bits: int, times_us: list[int] | None = None, **fields: Any) -> Path:
    """A sequence of frames (T, H, W) as stored, uint8 or uint16 of any byte order, with stamps at `times_us`."""
    count, rows, columns = frames.shape
    size = frames[0].nbytes
    known = {
        "version": 5,
        "header_size": 1024,
        "columns": columns,
        "rows": rows,
        "bit_depth": 8 * frames.itemsize,
        "bit_depth_real": bits,
        "image_size": size,
        "image_format": 100,
        "allocated_frames": count,
        "frame_rate": 1000.0,
        **fields,
    }
    modern = known["version"] >= 5
    boundary = 8192 if modern else 512
    stride = known.setdefault("true_image_size", -(-(size + 8) // boundary) * boundary)
    content = bytearray((8192 if modern else 1024) + count * stride)
    content[:26] = struct.pack("<I", 0xFEED) + "Norpix seq\n".encode("utf-16-le")
    for index, frame in enumerate(frames):
        start = (8192 if modern else 1024) + index * stride
        content[start : start + size] = frame.tobytes()
        time = (times_us or [1000 * number for number in range(count)])[index] + 1_700_000_000_000_000
        seconds, rest = divmod(time, 10**6)
        stamp = struct.pack("<IHH", seconds, *divmod(rest, 1000))
        content[start + size : start + size + (8 if modern else 6)] = stamp[: 8 if modern else 6]
    path.write_bytes(content)
    change_header(path, known)
    return path


def change_header(path: Path, fields: dict[str, int]) -> None:
    """Change fields of a header, whatever the frames behind it are."""
    content = bytearray(path.read_bytes())
    for name, value in fields.items():
        struct.pack_into(_FIELDS[name][1], content, _FIELDS[name][0], value)
    path.write_bytes(content)
