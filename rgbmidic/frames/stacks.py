"""Stacks of frames: numpy's own files (.npy) and HDF5 datasets (.h5, .hdf5, NeXus .nxs).

Arrays hold (T, H, W), (T, H, W, 3), or one frame alone, of uint8 or uint16.
"""

from __future__ import annotations

import io
import itertools
import math
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbmidic.errors import FrameError, damaged_file, first_line, library_faults, printable
from rgbmidic.frames.data import Integers, Recording, even_times
from rgbmidic.frames.metadata import (
    MAX_BYTES,
    MAX_FRAMES,
    EvenFrames,
    MovieHeader,
    StoredFrame,
    check_count,
    check_size,
    truncated_file,
)
from rgbmidic.frames.source import MovieSource, cache_by_file, split_dataset

if TYPE_CHECKING:
    import h5py


def _split_shape(shape: tuple[int, ...], dtype: np.dtype[Any], name: object) -> tuple[int, tuple[int, ...]]:
    """Return the number of frames in an array, and the shape of one, (H, W) or (H, W, 3).

    Raises
    ------
    FrameError
        It is no stack, or its values are no unsigned integers of 8 or 16 bit.
    """
    axes = 3 if len(shape) > 2 and shape[-1] == 3 else 2
    count = (1, *shape)[-axes - 1] if len(shape) in (axes, axes + 1) else 0
    if not count or not all(shape) or dtype.kind != "u" or dtype.itemsize > 2:
        raise FrameError(
            f"{name} is an array of shape {shape} and type {dtype}; allowed are (frames, rows, columns), the same with "
            "3 channels behind, or one frame alone, of uint8 or uint16"
        )
    return count, shape[-axes:]


class NpyFile(MovieSource):
    """A numpy array of frames, of which one is read at a time."""

    def _header(self) -> EvenFrames:
        return _npy_header(self.path)


@cache_by_file
def _npy_header(path: Path) -> EvenFrames:
    with path.open("rb") as file:
        # numpy refuses to parse more than 10,000 bytes, but reads as many as a damaged header announces, up to 4 GB
        head, size = io.BytesIO(file.read(2**16)), file.seek(0, 2)
    try:
        version = np.lib.format.read_magic(head)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read_header(head)
    except Exception as error:  # a damaged header is parsed as Python and fails in many ways
        raise damaged_file(path, f"its header is not numpy's: {first_line(error)}") from None
    count, (height, width, *channels) = _split_shape(shape, dtype, path)
    if fortran:
        raise FrameError(
            f"{path} is stored in Fortran order; save it with numpy.save(file, numpy.ascontiguousarray(stack))"
        )
    header = EvenFrames(
        shape=(height, width),
        recording=Recording(count=count),
        start=head.tell(),
        channels=tuple(channels),
        stored_bits=8 * dtype.itemsize,
        order=dtype.str[0],
        metadata=StoredFrame(kind="rgb" if channels else None),
    )
    return header.require_plausible(path).with_rest_noted(size)


HDF5_ENDINGS = (".h5", ".hdf5", ".nxs")


@dataclass(frozen=True, slots=True, kw_only=True)
class Hdf5File(MovieSource):
    """A dataset of frames, (T, H, W) or (T, H, W, 3), of which the chunks of one frame are read at a time.

    Attributes
    ----------
    dataset
        Its name in the file; empty: the only one that can be frames.
    """

    packages = ("h5py",)

    dataset: str = field(init=False)

    def __post_init__(self) -> None:
        """Take apart the names of file and dataset."""
        path, dataset = split_dataset(self.path)
        object.__setattr__(self, "path", Path(path))
        object.__setattr__(self, "dataset", dataset)

    def name(self, index: int) -> str:
        """Return the name of a frame: file, dataset where one is named, and the frame's index."""
        return f"{printable(self.path.name)}{self.dataset and ':'}{self.dataset} frame {index}"

    def _header(self) -> _Dataset:
        stacks = _hdf5_stacks(self.path)
        if self.dataset:
            name = "/" + self.dataset.strip("/")
        else:  # the only dataset of several frames, else the only one
            names = [name for name, stack in stacks.items() if stack.recording.count > 1] or list(stacks)
            if not names:
                raise FrameError(
                    f"{self.path} holds no dataset of shape (frames, rows, columns) and type uint8 or uint16"
                )
            if len(names) > 1:
                example = f'name one, as in "{self.path.name}:{names[0]}"'
                raise FrameError(f"{self.path} holds several datasets of frames, {', '.join(names)}: {example}")
            (name,) = names
        if name not in stacks:
            available = ", ".join(stacks) or "none"
            raise FrameError(f"{self.path} has no dataset of frames {name}; those there are: {available}")
        check_count(self.path, stacks[name].recording.count)
        return stacks[name]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Dataset(MovieHeader):
    """A dataset of an HDF5 file: the shape of a frame, (H, W) or (H, W, 3), the type of its samples, and its name."""

    frame: tuple[int, ...]
    dtype: np.dtype[Any]
    name: str

    def read(self, path: Path, index: int, rows: range) -> StoredFrame:
        import h5py

        rows_slice = slice(rows.start, rows.stop)
        with library_faults(path), h5py.File(path, "r", locking=False) as file:
            dataset = file[self.name]
            _check_written(dataset, index, self, path)
            values = np.asarray(dataset[index, rows_slice] if dataset.ndim > len(self.frame) else dataset[rows_slice])
        return StoredFrame.from_samples(values.astype(self.dtype.newbyteorder("="), copy=False), path)


@cache_by_file
def _hdf5_stacks(path: Path) -> dict[str, _Dataset]:
    """Find what can be frames: every dataset of unsigned integers in two to four dimensions."""
    import h5py

    stacks: dict[str, _Dataset] = {}

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset):
            return
        try:
            count, frame = _split_shape(item.shape or (), item.dtype, name)
        except (FrameError, TypeError):
            return
        stacks[f"/{name}"] = _Dataset(
            shape=(frame[0], frame[1]),
            recording=_recording(item, count),
            frame=frame,
            dtype=item.dtype,
            name=f"/{name}",
        )

    with library_faults(path), h5py.File(path, "r", locking=False) as file:
        file.visititems(visit)
    return stacks


def _recording(dataset: h5py.Dataset, count: int) -> Recording:
    """Read the attributes `times_ns` (one whole number a frame) or `frame_rate`."""
    if count > MAX_FRAMES:  # refused when it is asked for: another dataset may be meant
        return Recording(count=count)
    rate, stamps = dataset.attrs.get("frame_rate"), dataset.attrs.get("times_ns")
    has_rate = rate is not None and np.ndim(rate) == 0 and np.isreal(rate) and 1e-3 <= float(rate) <= 1e12
    times: Integers | None = None
    if stamps is not None and np.shape(stamps) == (count,) and np.asarray(stamps).dtype.kind in "iu":
        times = np.asarray(stamps).astype(np.int64)
    elif has_rate:
        times = even_times(range(count), 1 / Fraction(float(rate)).limit_denominator(10**6))
    return Recording(count=count, frame_rate=float(rate) if has_rate else None, times_ns=times)


def _check_written(dataset: h5py.Dataset, index: int, stack: _Dataset, path: Path) -> None:
    """Refuse a frame of absurd size, or of which something is not in the file: libhdf5 fills it up with zeros."""
    import h5py

    size, n_bytes, count = path.stat().st_size, math.prod(stack.frame) * stack.dtype.itemsize, stack.recording.count
    check_size(path, unpacked=n_bytes, stored=min(dataset.id.get_storage_size(), size))
    if dataset.external or dataset.is_virtual:
        raise FrameError(f"{path}: the samples of {dataset.name} lie in other files; name the file that holds them")
    creation = dataset.id.get_create_plist()
    if dataset.chunks is None:
        offset, is_compact = dataset.id.get_offset(), creation.get_layout() == h5py.h5d.COMPACT
        if not is_compact and (offset is None or offset + (index + 1) * n_bytes > size):
            raise truncated_file(path, n_complete=max(size - offset, 0) // n_bytes if offset else 0, count=count)
        return
    chunk_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if chunk_bytes > MAX_BYTES:
        raise FrameError(
            f"{path} is stored in chunks of shape {dataset.chunks}, more than {MAX_BYTES / 1e6:.0f} MB each"
        )
    filters = [creation.get_filter(coordinates)[0] for coordinates in range(creation.get_nfilters())]
    axes = len(stack.frame)
    leading, lengths = [index // step * step for step in dataset.chunks[:-axes]], dataset.chunks[-axes:]
    corners = itertools.product(*(range(0, end, step) for end, step in zip(stack.frame, lengths, strict=True)))
    for corner in corners:  # the first element of every chunk that holds a part of the frame
        coordinates = (*leading, *corner)
        chunk = dataset.id.get_chunk_info_by_coord(coordinates)
        if chunk.byte_offset is None or chunk.byte_offset + chunk.size > size:
            raise FrameError(f"{path}: frame {index} of {count} is not all there: truncated or still being written")
        applied = {code for number, code in enumerate(filters) if not chunk.filter_mask >> number & 1}
        # the list of chunks may name one that a damaged index does not lead to: libhdf5 gives what memory holds instead
        n_stored = len(dataset.id.read_direct_chunk(coordinates)[1])
        if applied <= {h5py.h5z.FILTER_SHUFFLE} and n_stored != chunk_bytes:
            raise damaged_file(path, f"a chunk of frame {index} has {n_stored} bytes; needed are {chunk_bytes}")
