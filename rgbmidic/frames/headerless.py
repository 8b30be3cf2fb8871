"""Files that hold nothing but the samples of one frame, row by row."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbmidic.errors import FrameError
from rgbmidic.frames.source import FrameSource
from rgbmidic.frames.stored import StoredFrame
from rgbmidic.settings import FrameSettings

__all__ = ["HeaderlessFile", "is_headerless"]


def is_headerless(path: Path, stated: FrameSettings) -> bool:
    """Whether the name, or for ``.raw`` a stated shape, says so: cameras of several makers write .raw with a header."""
    return path.suffix.lower() == ".bin" or (path.suffix.lower() == ".raw" and stated.shape is not None)


@dataclass(frozen=True, slots=True, kw_only=True)
class HeaderlessFile(FrameSource):
    """A file without a header: shape and sample type are stated."""

    def _shape(self) -> tuple[int, int]:
        if self.stated.shape is None or self.stated.dtype is None:
            raise FrameError(f"{self.path} has no header: both its shape (rows, columns) and its dtype must be stated")
        return self.stated.shape

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        shape, dtype = self._shape(), np.dtype("<u2" if self.stated.dtype == "uint16" else self.stated.dtype)
        channels = 3 if self.stated.kind == "rgb" else 1
        needed, size = math.prod(shape) * channels * dtype.itemsize, self.path.stat().st_size
        if size != needed:
            raise FrameError(
                f"{self.path} has {size} bytes; {shape[0]} rows of {shape[1]} {self.stated.dtype} samples with "
                f"{channels} channel(s) need {needed}"
            )
        row = shape[1] * channels
        values = np.fromfile(self.path, dtype=dtype, count=len(rows) * row, offset=rows.start * row * dtype.itemsize)
        return StoredFrame.plain(values.reshape(len(rows), shape[1], channels), self.path)
