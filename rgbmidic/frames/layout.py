"""Frames that lie in a file at even distances, and samples that are packed into fewer bytes than they have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.stored import check_size, damaged
from rgbmidic.typing import AnyArray

__all__ = ["MAXIMUM_FRAMES", "Layout", "check_count", "cut_short", "unpack_bits"]

MAXIMUM_FRAMES = 2_000_000
"""Most frames that a header may announce: a camera of 64 GB holds so many of 128x128 pixels of 16 bit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """Where the frames of a file lie.

    Attributes
    ----------
    count
        Number of frames that the header announces; the file may end before.
    start
        Byte at which the first begins.
    size
        Bytes of the samples of one.
    stride
        Bytes from one to the next.
    """

    count: int
    start: int
    size: int
    stride: int

    @classmethod
    def checked(cls, path: Path, *, count: int, start: int, size: int, stride: int | None = None) -> Layout:
        """The layout that a header announces; a `stride` that is not given is the size.

        Raises
        ------
        FrameError
            No camera records such frames.
        """
        check_count(path, count)
        if size <= 0 or start < 0 or (stride is not None and stride < size):
            raise damaged(path, f"its header announces frames of {size} bytes, {stride} apart, from byte {start}")
        check_size(path, needed=size, stored=size)
        return cls(count=count, start=start, size=size, stride=size if stride is None else stride)

    def whole(self, file_size: int) -> int:
        """Number of frames that are all in a file of so many bytes."""
        return min(max((file_size - self.start - self.size) // self.stride + 1, 0), self.count)

    def read(self, path: Path, index: int, rows: range, of: int) -> bytes:
        """The bytes of some `rows` of frame `index`, which has `of` rows of one length.

        Raises
        ------
        FrameError
            The file ends before.
        """
        with path.open("rb") as file:
            begin, size = self.start + index * self.stride, file.seek(0, 2)
            if size < begin + self.size:
                raise cut_short(path, whole=self.whole(size), count=self.count)
            first, last = (self.size * row // of for row in (rows.start, rows.stop))
            file.seek(begin + first)
            return file.read(last - first)


def check_count(path: Path, count: int) -> None:
    """Refuse a header that announces no frames or more than a camera's.

    Raises
    ------
    FrameError
        So it does.
    """
    if not 1 <= count <= MAXIMUM_FRAMES:
        raise FrameError(f"{path} announces {count} frames; allowed are 1 to {MAXIMUM_FRAMES}")


def cut_short(path: Path, *, whole: int, count: int) -> FrameError:
    """Error for a frame behind the end of a file that holds only the first `whole` of its `count` frames."""
    where = f"after frame {whole - 1} of {count}" if whole else f"before the first of its {count} frames"
    return FrameError(f"{path}: the file ends {where}: truncated or still being written")


def unpack_bits(data: bytes, bits: int) -> AnyArray:
    """Samples of 9 to 15 bits that follow one another without a gap, the highest bit of each first.

    Parameters
    ----------
    data
        A whole number of groups of samples that end with a byte: 5 bytes hold 4 samples of 10 bits, 3 two of 12.
    bits
        Bits of a sample, an even number.

    Returns
    -------
    ndarray, shape (8 len(data) / bits,), uint16
    """
    group = math.lcm(bits, 8)
    packed = np.frombuffer(data, dtype=np.uint8).reshape(-1, group // 8)
    values = np.empty((len(packed), group // bits), dtype=np.uint16)
    for sample in range(group // bits):
        byte, begin = divmod(sample * bits, 8)
        both = packed[:, byte].astype(np.uint16) << 8 | packed[:, byte + 1]
        values[:, sample] = both >> (16 - bits - begin) & (2**bits - 1)
    return values.ravel()
