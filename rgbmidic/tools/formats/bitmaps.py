"""Pictures that cameras' software writes without compression: PGM (Netpbm, "P5") and Windows bitmaps (BMP)."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import FrameError, damaged_file
from rgbmidic.frames.metadata import EvenFrames, StoredFrame, check_size
from rgbmidic.frames.source import FrameSource

_PGM = re.compile(rb"P5(?:\s|#[^\n]*\n)+([0-9]{1,9})(?:\s|#[^\n]*\n)+([0-9]{1,9})(?:\s|#[^\n]*\n)+([0-9]{1,5})\s")
_BMP = struct.Struct("<2s8x2I2i2HI12xI4x")
"""Magic; place of the samples; bytes of the second header; columns, rows; planes, bits; compression; colours."""


class PgmFile(FrameSource):
    """A grey picture of up to 16 bit; its largest grey level is the white level unless it is 2^n - 1."""

    def _header(self) -> tuple[EvenFrames, int]:
        with self.path.open("rb") as file:
            head, size = file.read(4096), file.seek(0, 2)
        if (header := _PGM.match(head)) is None:
            problem = (
                "is no binary grey picture (P5) of the Netpbm formats" if head[:1] == b"P" else "has no PGM header"
            )
            raise FrameError(f"{self.path} {problem}")
        columns, rows, largest = map(int, header.groups())
        if not (columns and rows and 0 < largest < 65536):
            raise damaged_file(self.path, f"it announces {rows} rows of {columns} samples up to {largest}")
        bits = 8 if largest < 256 else 16
        frame = EvenFrames(shape=(rows, columns), start=header.end(), stored_bits=bits, order=">")
        if size != header.end() + frame.require_plausible(self.path).size:
            raise damaged_file(self.path, f"it has {size} bytes; its header announces {header.end() + frame.size}")
        return frame, largest

    def _shape(self) -> tuple[int, int]:
        return self._header()[0].shape

    def _rows(self, index: int, rows: slice) -> StoredFrame:
        frame, largest = self._header()
        values = frame.read(self.path, 0, range(frame.shape[0])[rows]).values
        if values.size and values.max() > largest:
            raise damaged_file(self.path, f"it has grey levels up to {values.max()}; its header announces {largest}")
        if largest & (largest + 1):
            return StoredFrame(values=values, white_level=float(largest))
        return StoredFrame(values=values, bits=largest.bit_length())


class BmpFile(FrameSource):
    """A bitmap of 8-bit grey levels or of 24-bit colours, uncompressed."""

    def _shape(self) -> tuple[int, int]:
        header = self._header()
        return header.rows, header.columns

    def _stored(self, index: int) -> StoredFrame:
        header = self._header()
        content = self.path.read_bytes()
        lines = np.frombuffer(content, np.uint8, header.line_bytes * header.rows, header.start).reshape(header.rows, -1)
        values = lines[:, : header.columns * header.channels].reshape(header.rows, header.columns, -1)
        if header.bottom_up:
            values = values[::-1]
        if header.channels == 1:
            table = np.frombuffer(content, np.uint8, 4 * header.colours, header.table).reshape(-1, 4)[:, :3]
            grey = np.arange(len(table), dtype=np.uint8)[:, None]
            if (table != grey).any() or (values.size and values.max() >= len(table)):
                raise FrameError(f"{self.path} shows its grey levels through a colour table; save it as a grey image")
        return StoredFrame.from_samples(values[..., ::-1], self.path)  # stored as blue, green, red

    def _header(self) -> _Bitmap:
        with self.path.open("rb") as file:
            head, size = file.read(_BMP.size), file.seek(0, 2)
        if len(head) < _BMP.size or head[:2] != b"BM":
            raise damaged_file(self.path, "it has no BMP header")
        _, start, length, columns, rows, _, bits, compression, colours = _BMP.unpack(head)
        if bits not in (8, 24) or compression:
            raise FrameError(
                f"{self.path} is a bitmap of {bits} bit, compression {compression}; allowed are 8 bit grey or 24 bit, "
                "uncompressed"
            )
        line, table = -(-columns * bits // 32) * 4, 14 + length
        colours = (colours or 256) if bits == 8 else 0
        if columns < 1 or not rows or length < 40 or colours > 256 or start < table + 4 * colours:
            raise damaged_file(self.path, f"its header announces {rows} rows of {columns} pixels from byte {start} on")
        check_size(self.path, unpacked=line * abs(rows), stored=line * abs(rows))
        if size < start + line * abs(rows):
            raise damaged_file(self.path, f"it has {size} bytes; its header announces {start + line * abs(rows)}")
        return _Bitmap(abs(rows), columns, bits // 8, line, start, table, colours, bottom_up=rows > 0)


@dataclass(frozen=True, slots=True)
class _Bitmap:
    """Size of a bitmap, bytes of its lines, and where samples and colour table begin."""

    rows: int
    columns: int
    channels: int
    line_bytes: int
    start: int
    table: int
    colours: int
    bottom_up: bool
