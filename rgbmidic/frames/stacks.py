"""Stacks of frames in numpy's own files (.npy).

Stacks of frames in HDF5 files (.h5, .hdf5, NeXus .nxs): one dataset, named behind the file or the only one.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import FrameError, RgbmidicError, first_line, legible
from rgbmidic.frames.data import Integers, Recording, even_times
from rgbmidic.frames.source import Movie, remembered
from rgbmidic.frames.stored import (
    MAXIMUM_BYTES,
    MAXIMUM_FRAMES,
    Layout,
    StoredFrame,
    check_count,
    check_size,
    cut_short,
    damaged,
)

if TYPE_CHECKING:
    import h5py

__all__ = ["HDF5_ENDINGS", "Hdf5File", "NpyFile", "StackShape", "split_dataset"]


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


HDF5_ENDINGS = (".h5", ".hdf5", ".nxs")

_NAMED = re.compile(r"(.*\.(?:h5|hdf5|nxs)):(.+)", re.IGNORECASE | re.DOTALL)


def split_dataset(path: Path | str) -> tuple[str, str]:
    """The file, and the dataset that is named behind it: ``run.h5:/entry/data``; empty where none is."""
    found = _NAMED.fullmatch(str(path))
    return (found[1], found[2]) if found else (str(path), "")


@dataclass(frozen=True, slots=True, kw_only=True)
class Hdf5File(Movie):
    """A dataset of frames, (T, H, W) or (T, H, W, 3), of which the chunks of one frame are read at a time.

    Attributes
    ----------
    dataset
        Its name in the file; empty: the only one that can be frames.
    """

    dataset: str = field(init=False)

    def __post_init__(self) -> None:
        path, dataset = split_dataset(self.path)
        object.__setattr__(self, "path", Path(path))
        object.__setattr__(self, "dataset", dataset)

    def name(self, index: int) -> str:
        """What to call a frame in messages and results: file, dataset where one is named, and the frame's index."""
        return f"{legible(self.path.name)}{self.dataset and ':'}{self.dataset} frame {index}"

    def _recording(self) -> Recording:
        return self._header().recording

    def _shape(self) -> tuple[int, int]:
        rows, columns, *_ = self._header().stack.shape
        return rows, columns

    def _stored(self, index: int) -> StoredFrame:
        return self._rows(index, range(self._shape()[0]))

    def _rows(self, index: int, rows: range) -> StoredFrame:
        header, part = self._header(), slice(rows.start, rows.stop)
        with _opened(self.path) as file:
            dataset = file[header.name]
            _check_written(dataset, index, header.stack, self.path)
            values = np.asarray(dataset[index, part] if dataset.ndim > len(header.stack.shape) else dataset[part])
        return StoredFrame.plain(values.astype(values.dtype.newbyteorder("="), copy=False), self.path)

    def _header(self) -> _Hdf5Header:
        headers = _headers(self.path)
        name = "/" + self.dataset.strip("/") if self.dataset else _only(headers, self.path)
        if name not in headers:
            told = ", ".join(headers) or "none"
            raise FrameError(f"{self.path} has no dataset of frames {name}; those there are: {told}")
        check_count(self.path, headers[name].stack.count)
        return headers[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hdf5Header:
    name: str
    stack: StackShape
    recording: Recording


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """The file; what libhdf5 raises while it is open becomes a FrameError."""
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            yield file
    except RgbmidicError:
        raise
    except Exception as error:  # h5py meets damaged files with many kinds of error
        raise damaged(path, first_line(error)) from None


@remembered
def _headers(path: Path) -> dict[str, _Hdf5Header]:
    """What can be frames: every dataset of unsigned integers in two to four dimensions."""
    import h5py

    found: dict[str, _Hdf5Header] = {}

    def look(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        try:
            stack = StackShape.of(item.shape or (), item.dtype, name)
        except (FrameError, TypeError):
            return
        found[f"/{name}"] = _Hdf5Header(name=name, stack=stack, recording=_recording(item, stack.count))

    with _opened(path) as file:
        file.visititems(look)
    return found


def _only(headers: dict[str, _Hdf5Header], path: Path) -> str:
    """Name of the only dataset of several frames, else of the only one."""
    names = [name for name, header in headers.items() if header.stack.count > 1] or list(headers)
    if len(names) == 1:
        return names[0]
    if not names:
        raise FrameError(f"{path} holds no dataset of shape (frames, rows, columns) and type uint8 or uint16")
    raise FrameError(
        f'{path} holds several datasets of frames, {", ".join(names)}: name one, as in "{path.name}:{names[0]}"'
    )


def _recording(dataset: h5py.Dataset, count: int) -> Recording:
    """From the attributes `times_ns` (one whole number a frame) or `frame_rate`."""
    if count > MAXIMUM_FRAMES:  # refused when it is asked for: another dataset may be meant
        return Recording(count=count)
    rate, times = dataset.attrs.get("frame_rate"), dataset.attrs.get("times_ns")
    known = rate is not None and np.ndim(rate) == 0 and np.isreal(rate) and 1e-3 <= float(rate) <= 1e12
    if times is not None and np.shape(times) == (count,) and np.asarray(times).dtype.kind in "iu":
        told: Integers | None = np.asarray(times).astype(np.int64)
    else:
        told = even_times(range(count), 1 / Fraction(float(rate)).limit_denominator(10**6)) if known else None
    return Recording(count=count, frame_rate=float(rate) if known else None, times_ns=told)


def _check_written(dataset: h5py.Dataset, index: int, stack: StackShape, path: Path) -> None:
    """Refuse a frame of absurd size, or of which something is not in the file: libhdf5 fills it up with zeros."""
    import h5py

    needed = math.prod(stack.shape) * dataset.dtype.itemsize
    check_size(path, needed=needed, stored=min(dataset.id.get_storage_size(), path.stat().st_size))
    if dataset.external or dataset.is_virtual:
        raise FrameError(f"{path}: the samples of {dataset.name} lie in other files; name the file that holds them")
    if dataset.chunks is None:
        offset = dataset.id.get_offset()
        inside_header = dataset.id.get_create_plist().get_layout() == h5py.h5d.COMPACT
        if not inside_header and (offset is None or offset + (index + 1) * needed > path.stat().st_size):
            raise cut_short(
                path, whole=max(path.stat().st_size - (offset or 0), 0) // needed if offset else 0, count=stack.count
            )
        return
    if math.prod(dataset.chunks) * dataset.dtype.itemsize > MAXIMUM_BYTES:
        raise FrameError(
            f"{path} is stored in chunks of shape {dataset.chunks}, more than {MAXIMUM_BYTES / 1e6:.0f} MB each"
        )
    created, size = dataset.id.get_create_plist(), math.prod(dataset.chunks) * dataset.dtype.itemsize
    filters = [created.get_filter(place)[0] for place in range(created.get_nfilters())]
    for corner in _corners(dataset, index, stack):
        chunk = dataset.id.get_chunk_info_by_coord(corner)
        if chunk.byte_offset is None or chunk.byte_offset + chunk.size > path.stat().st_size:
            raise FrameError(
                f"{path}: frame {index} of {stack.count} is not all there: truncated or still being written"
            )
        used = {code for place, code in enumerate(filters) if not chunk.filter_mask >> place & 1}
        # the list of chunks may name one that a damaged index does not lead to: libhdf5 gives what memory holds instead
        found = len(dataset.id.read_direct_chunk(corner)[1])
        if used <= {h5py.h5z.FILTER_SHUFFLE} and found != size:
            raise damaged(path, f"a chunk of frame {index} has {found} bytes; needed are {size}")


def _corners(dataset: h5py.Dataset, index: int, stack: StackShape) -> Iterator[tuple[int, ...]]:
    """First element of every chunk that holds a part of a frame."""
    lengths = dataset.chunks[-len(stack.shape) :]
    within = itertools.product(*(range(0, end, step) for end, step in zip(stack.shape, lengths, strict=True)))
    first = (index,)[: dataset.ndim - len(stack.shape)]
    yield from ((*(frame // dataset.chunks[0] * dataset.chunks[0] for frame in first), *corner) for corner in within)
