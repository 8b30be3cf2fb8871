"""PNG files: grey or RGB, 8 or 16 bit."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rgbmidic.errors import FrameError
from rgbmidic.frames.opencv import decode
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import StoredFrame, damaged

__all__ = ["PngFile"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_GREY, _RGB = 0, 2


@dataclass(frozen=True, slots=True, kw_only=True)
class PngFile(FrameSource):
    """A PNG file; every chunk's checksum is verified."""

    def _shape(self) -> tuple[int, int]:
        with self.path.open("rb") as file:
            head = file.read(33)
        if len(head) < 33 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
            raise damaged(self.path, "it has no PNG header")
        columns, rows, bits, colour = struct.unpack(">IIBB", head[16:26])
        if bits not in (8, 16) or colour not in (_GREY, _RGB):
            raise FrameError(
                f"{self.path} is not a plain image; allowed are grey or RGB PNGs of 8 or 16 bit without alpha"
            )
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        self._shape()
        for name, data, checksum in _chunks(self.path.read_bytes(), self.path):
            if zlib.crc32(name + data) != checksum:
                raise damaged(self.path, f"the checksum of its {name.decode(errors='replace')} part is wrong")
        values = decode(self.path)
        if values is None:
            raise damaged(self.path, "its image data cannot be decoded")
        return StoredFrame.plain(values, self.path)


def _chunks(content: bytes, path: Path) -> Iterator[tuple[bytes, bytes, int]]:
    """Name, data and checksum of every chunk up to IEND; an error where the file ends before it."""
    start, name = len(_SIGNATURE), b""
    while name != b"IEND":
        if start + 12 > len(content):
            raise damaged(path, "it ends before its end mark")
        length, name = struct.unpack(">I4s", content[start : start + 8])
        data = content[start + 8 : start + 8 + length]
        if start + 12 + length > len(content):
            raise damaged(path, "it ends before its end mark")
        yield name, data, int.from_bytes(content[start + 8 + length : start + 12 + length], "big")
        start += 12 + length
