"""Stacks of frames in numpy's own files (.npy)."""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic.errors import FrameError, first_line
from rgbmidic.frames.layout import Layout
from rgbmidic.frames.recording import Recording
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import StoredFrame, damaged

__all__ = ["NpyFile", "StackShape"]

_MAXIMUM_HEADER = 2**16
"""Bytes: numpy refuses to parse more than 10,000, but reads as many as a damaged header announces, up to 4 GB."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StackShape:
    """How an array holds frames: `count` of `shape`, (H, W) or (H, W, 3)."""

    count: int
    shape: tuple[int, ...]

    @classmethod
    def of(cls, shape: tuple[int, ...], dtype: np.dtype[Any], what: object) -> StackShape:
        """From the shape of an array: (T, H, W), (T, H, W, 3), and (H, W) or (H, W, 3) for one frame.

        Raises
        ------
        FrameError
            It is none of them, or its values are no unsigned integers of 8 or 16 bit.
        """
        frame = 3 if len(shape) > 2 and shape[-1] == 3 else 2
        count = (1, *shape)[-frame - 1] if len(shape) in (frame, frame + 1) else 0
        if not count or not all(shape) or dtype.kind != "u" or dtype.itemsize > 2:
            raise FrameError(
                f"{what} is an array of shape {shape} and type {dtype}; allowed are (frames, rows, columns), the same "
                "with 3 channels behind, or one frame alone, of uint8 or uint16"
            )
        return cls(count=count, shape=shape[-frame:])


@dataclass(frozen=True, slots=True, kw_only=True)
class NpyFile(Movie):
    """A numpy array of frames, of which one is read at a time."""

    def _recording(self) -> Recording:
        return Recording(count=_header(self.path).layout.count)

    def _shape(self) -> tuple[int, int]:
        rows, columns, *_ = _header(self.path).shape
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        header = _header(self.path)
        data = header.layout.read(self.path, index, rows, header.shape[0])
        values = np.frombuffer(data, dtype=header.dtype).reshape(len(rows), *header.shape[1:])
        return StoredFrame.plain(values.astype(header.dtype.newbyteorder("="), copy=False), self.path)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Header:
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    layout: Layout


@remembered
def _header(path: Path) -> _Header:
    with path.open("rb") as file:
        head = io.BytesIO(file.read(_MAXIMUM_HEADER))
    try:
        version = np.lib.format.read_magic(head)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(head)
    except Exception as error:  # a damaged header is parsed as Python and fails in many ways
        raise damaged(path, f"its header is not numpy's: {first_line(error)}") from None
    stack = StackShape.of(shape, dtype, path)
    if fortran:
        raise FrameError(
            f"{path} is stored in Fortran order; save it with numpy.save(file, numpy.ascontiguousarray(stack))"
        )
    size = math.prod(stack.shape) * dtype.itemsize
    layout = Layout.checked(path, count=stack.count, start=head.tell(), size=size)
    return _Header(shape=stack.shape, dtype=dtype, layout=layout)
