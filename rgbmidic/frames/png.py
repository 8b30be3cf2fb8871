"""PNG files: grey or RGB, 8 or 16 bit."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

from rgbmidic.errors import FrameError
from rgbmidic.frames.opencv import decode
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import StoredFrame, check_size, damaged

__all__ = ["PngFile"]

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3}
"""Channels of the colour types that are read: grey and RGB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PngFile(FrameSource):
    """A PNG file; every chunk's checksum is verified."""

    def _shape(self) -> tuple[int, int]:
        with self.path.open("rb") as file:
            head = file.read(33)
        if len(head) < 33 or head[:8] != _SIGNATURE or head[12:16] != b"IHDR":
            raise damaged(self.path, "it has no PNG header")
        columns, rows, bits, colour = struct.unpack(">IIBB", head[16:26])
        if bits not in (8, 16) or colour not in _CHANNELS:
            raise FrameError(
                f"{self.path} is not a plain image; allowed are grey or RGB PNGs of 8 or 16 bit without alpha"
            )
        needed = rows * columns * _CHANNELS[colour] * bits // 8
        check_size(self.path, needed=needed, stored=self.path.stat().st_size)
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        self._shape()
        content = self.path.read_bytes()
        _check_chunks(content, self.path)
        return StoredFrame.plain(decode(content, self.path), self.path)


def _check_chunks(content: bytes, path: Path) -> None:
    """An error where a checksum up to IEND is wrong, or the file ends before it."""
    start, name, whole = len(_SIGNATURE), b"", memoryview(content)
    while name != b"IEND":
        if start + 12 > len(content):
            raise damaged(path, "it ends before its end mark")
        length, name = struct.unpack(">I4s", whole[start : start + 8])
        end = start + 8 + length
        if end + 4 > len(content):
            raise damaged(path, "it ends before its end mark")
        if zlib.crc32(whole[start + 4 : end]) != int.from_bytes(whole[end : end + 4], "big"):
            raise damaged(path, f"the checksum of its {name.decode(errors='replace')} part is wrong")
        start = end + 4
