"""The frames of a result on disk: files that only ever grow, the records in them, and the table of what they hold.

``000007.frames`` holds records one after the other, each behind a header of 40 bytes with the run, the frame and the
length of the record: a frame counts once its record is whole. Readers go from header to header; where one is damaged
they look for the next one of the same run. A process that is killed leaves at most the beginning of a record; readers
pass over it, and nobody appends to a file of another writer. A frame that is written twice counts as it is in the file
with the higher number, there as it was written last; one that is discarded has `_NO_FRAME` in its header.

A record begins with a head of unsigned 32-bit numbers: the CRC-32 of each quantity, its size in bytes and, of each
that is not stackable, its shape. The quantities of one shape in all frames follow raw, the smallest first; then the
others: texts as JSON, pictures packed by zlib, other arrays raw. All numbers are little-endian.
"""

from __future__ import annotations

import itertools
import json
import math
import mmap
import os
import re
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError, disk_faults
from rgbmidic.results.files import PROVENANCE, PUT_BACK, writing
from rgbmidic.results.quantities import QUANTITIES, FrameRecord
from rgbmidic.typing import BoolArray

_SHARD_FRAMES = 500
"""Frames of a file: 100,000 frames are 200 files; 5,000 nodes each are 150 MB."""
_BUFFER = 2**16
"""Bytes that the system is asked for at once: a call takes some us, as long as copying these. Small records come by the
dozen, large ones pass by the buffer."""
_AHEAD = 1024
"""Bytes read where single quantities are asked for: the head (some 300 bytes) and the plain numbers lie in them."""
_FAST = 1
"""zlib's quickest level."""
_RATIO = 1032
"""How many times its size packed content can have at most (zlib's technical details, "Maximum Compression Factor")."""
_NAME = re.compile(r"([0-9]{6,})\.frames")
_HEADER = struct.Struct("<16sQQII")
"""Digest of the run, frame, bytes of the record, CRC-32 of the record's head, CRC-32 of these 36 bytes."""
_CHECKED = _HEADER.size - 4
_NO_FRAME = 2**63 - 1
_NUMBER_SIZE = 4
"""Bytes of a number of the head."""
_PLACE = np.dtype([(name, np.int64) for name in ("shard", "start", "length", "head")])
_NOT_YET, _DAMAGED = "not measured yet", "damaged"
_REMEDY = "`rgbmidic run` with --resume measures it again, --partial (partial=True) reads the rest"


class _Place(NamedTuple):
    """Where a quantity lies: its place in the order of all, its type, and its shape, or where the head has it."""

    order: int
    dtype: np.dtype[Any]
    shape: tuple[int, ...] | slice


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordLayout:
    """Where each quantity of a record lies.

    Attributes
    ----------
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``) of every frame.
    places
        Of every quantity, in the order in which they lie.
    head
        Bytes of the head.
    """

    sizes: Mapping[str, int]
    places: Mapping[str, _Place]
    head: int

    @classmethod
    def of(cls, sizes: Mapping[str, int]) -> RecordLayout:
        """Lay out records with these sizes of ``"node"`` and ``"light"``."""
        blank = {name: entry.unmeasured(sizes) for name, entry in QUANTITIES.items()}
        fixed = sorted((name for name in blank if QUANTITIES[name].stackable), key=lambda name: blank[name].nbytes)
        places, end = dict[str, _Place](), 2 * len(blank)
        for order, name in enumerate(dict.fromkeys([*fixed, *blank])):
            begin, end = end, end + (0 if name in fixed else blank[name].ndim)
            dtype = np.dtype(QUANTITIES[name].dtype).newbyteorder("<")
            places[name] = _Place(order, dtype, blank[name].shape if name in fixed else slice(begin, end))
        return cls(sizes=dict(sizes), places=places, head=end * _NUMBER_SIZE)

    def encode(self, values: Mapping[str, Any]) -> tuple[bytes, int]:
        """Return the bytes of a record with these quantities, and the CRC-32 of its head."""
        parts = [_packed(place, values[name]) for name, place in self.places.items()]
        shapes = (np.shape(values[name]) for name, place in self.places.items() if isinstance(place.shape, slice))
        numbers = [*map(zlib.crc32, parts), *map(len, parts), *itertools.chain(*shapes)]
        head = struct.pack(f"<{len(numbers)}I", *numbers)
        return b"".join([head, *parts]), zlib.crc32(head)

    def decode(
        self, file: BinaryIO, start: int, length: int, check: int, names: Iterable[str] | None = None
    ) -> dict[str, Any]:
        """Read the record at `start` of a file and verify every checksum.

        Parameters
        ----------
        file
            Open for reading.
        start, length
            First byte and number of bytes of the record.
        check
            CRC-32 of its head.
        names
            Quantities to read; None: all.

        Returns
        -------
        dict
            Each quantity by its name, in the shape and type of the table.

        Raises
        ------
        ResultError
            The record is damaged, or has other sizes.
        """
        file.seek(start)
        block = file.read(length if names is None or length < _AHEAD else _AHEAD)
        if length < self.head or zlib.crc32(block[: self.head]) != check:
            raise ResultError("its head is damaged, or of another mesh or other lights")
        numbers, count = struct.unpack_from(f"<{self.head // _NUMBER_SIZE}I", block), len(self.places)
        ends = list(accumulate(numbers[count : 2 * count], initial=self.head))
        values = {}
        for name in self.places if names is None else names:
            quantity, place = QUANTITIES[name], self.places[name]
            first, end = ends[place.order : place.order + 2]
            part = block[first:end]
            if end > len(block):
                file.seek(start + first)
                part = file.read(min(end - first, length))
            if zlib.crc32(part) != numbers[place.order]:
                raise ResultError(f"the checksum of {name} is wrong")
            if isinstance(place.shape, slice):
                values[name] = quantity.convert(_unpacked(place, part, numbers[place.shape]), self.sizes)
            else:
                array = np.frombuffer(part, dtype=place.dtype)
                values[name] = array.reshape(place.shape).astype(quantity.dtype) if place.shape else array.item()
        return values


def _packed(place: _Place, value: Any) -> bytes:
    if place.dtype.kind == "U":
        return json.dumps(np.asarray(value).tolist()).encode("ascii")
    raw = np.asarray(value, dtype=place.dtype).tobytes()
    return zlib.compress(raw, _FAST) if place.dtype == np.uint8 and isinstance(place.shape, slice) else raw


def _unpacked(place: _Place, part: bytes, shape: Sequence[int]) -> Any:
    """Undo `_packed`; a head that promises more than there is is an error before memory is taken for it."""
    if place.dtype.kind == "U":
        return np.array(json.loads(part), dtype=np.str_).reshape(shape)
    if place.dtype == np.uint8:
        part = zlib.decompressobj().decompress(part, min(math.prod(shape), _RATIO * len(part)) + 1)
    return np.frombuffer(part, dtype=place.dtype).reshape(shape).copy()


def shard_files(folder: Path) -> list[Path]:
    """List the files of records in a folder, in the order of their numbers."""
    with suppress(FileNotFoundError):
        return sorted((file for file in folder.iterdir() if _NAME.fullmatch(file.name)), key=_number)
    return []


def _number(file: Path) -> int:
    return int(file.name.partition(".")[0])


class ShardWriter:
    """Writer of records to a file that nobody else writes; a copy that is sent to another process opens another file.

    Parameters
    ----------
    folder
        Where the files are; it must exist.
    layout
        Of the records.
    run : bytes, length 16
        Digest of what the frames of the result share.
    """

    def __init__(self, folder: Path, layout: RecordLayout, run: bytes) -> None:
        self.folder, self.layout, self.run = folder, layout, run
        self._file: BinaryIO | None = None
        self._count = self._end = 0

    def __reduce__(self) -> tuple[type[ShardWriter], tuple[Path, RecordLayout, bytes]]:
        """Send what the writer was made of; the open file stays here."""
        return ShardWriter, (self.folder, self.layout, self.run)

    def append(self, frame: int, record: FrameRecord) -> None:
        """Write a frame; it counts from the moment this returns, and not at all where it raises.

        Raises
        ------
        ResultError
            The disk is full or refuses.
        """
        content, head = self.layout.encode(record.values)
        content = _header(self.run, frame, len(content), head) + content
        if self._count == _SHARD_FRAMES:
            self.close()
        if self._file is None:
            number = max(map(_number, shard_files(self.folder)), default=-1)
            while self._file is None:  # of a number that nobody has
                number += 1
                with writing(self.folder), suppress(FileExistsError):
                    self._file = (self.folder / f"{number:06d}.frames").open("xb", buffering=0)
        try:
            with writing(self._file.name):
                self._file.seek(self._end)
                rest = memoryview(content)
                while rest:
                    rest = rest[self._file.write(rest) :]
        except BaseException:  # nothing of it stays where the disk refuses
            with suppress(OSError):
                self._file.truncate(self._end)
            raise
        self._count, self._end = self._count + 1, self._end + len(content)

    def close(self) -> None:
        """Wait until all is on the disk, and close the file.

        Raises
        ------
        ResultError
            The disk refuses.
        """
        file, self._file = self._file, None
        self._count = self._end = 0
        if file is not None:
            with writing(file.name), file:
                os.fsync(file.fileno())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTable:
    """Which frames a result holds at the time it is loaded, and where; reads them.

    Attributes
    ----------
    layout
        Of the records.
    files
        Files of records.
    places : ndarray, shape (T,), of the fields ``shard``, ``start``, ``length``, ``head``
        Which of the files each frame is in, -1 where it is not measured yet; first byte of its record, its bytes, and
        the checksum of its head.
    damaged : ndarray, shape (T,), bool
        Frames that are known to be lost to damage; they are not `finished`.
    gaps
        Files in which the header of a record is damaged: frames that are missing may have been there.
    """

    layout: RecordLayout
    files: Sequence[Path]
    places: npt.NDArray[np.void]
    damaged: BoolArray
    gaps: tuple[Path, ...]

    @classmethod
    def load(cls, folder: Path, layout: RecordLayout, count: int, run: bytes) -> FrameTable:
        """Read the headers of all records; what is damaged is passed over.

        Parameters
        ----------
        folder
            Where the files are.
        layout
            Of the records.
        count
            Number of frames T of the result.
        run : bytes, length 16
            Digest of the run.

        Raises
        ------
        ResultError
            A file cannot be read, or holds frames of another run.
        """
        places, files, gaps = np.zeros(count, dtype=_PLACE), shard_files(folder), []
        places["shard"] = -1
        for number, file in enumerate(files):
            records, damaged = _records(file, run)
            gaps += [file] if damaged else []
            for frame, *place in records:
                if frame != _NO_FRAME:
                    places[frame] = (number, *place)
        lost = np.zeros(count, dtype=bool)
        return cls(layout=layout, files=files, places=places, damaged=lost, gaps=tuple(gaps))

    @property
    def finished(self) -> BoolArray:
        """Which frames there are, shape (T,)."""
        return np.asarray(self.places["shard"] >= 0)

    def without_damaged(self, *, ended: bool) -> FrameTable:
        """Read every record once and return the table without the damaged ones.

        Parameters
        ----------
        ended
            Whether all frames were there once: what is missing is then damaged too.
        """
        damaged = ~self.finished & ended
        for frame in np.flatnonzero(self.finished).tolist():
            try:
                next(self.each(None, [frame]))
            except ResultError:
                damaged[frame] = True
        places = self.places.copy()
        places["shard"][damaged] = -1
        return replace(self, places=places, damaged=damaged)

    def read(self, frame: int) -> FrameRecord:
        """Read all of one frame; a frame that is not measured yet gives a blank record with that as its reason.

        Raises
        ------
        ResultError
            It is damaged.
        """
        return FrameRecord(values=next(self.each(None, [frame])), sizes=self.layout.sizes)

    def each(self, names: Sequence[str] | None, frames: Iterable[int]) -> Iterator[dict[str, Any]]:
        """Read some quantities of one frame after the other.

        Parameters
        ----------
        names
            The quantities; None: all.
        frames
            Their indices, in any order.

        Yields
        ------
        dict
            The quantities of a frame by name.

        Raises
        ------
        ResultError
            A record is damaged; the message names file and frame.
        """
        chosen = np.fromiter(frames, dtype=np.int64)
        opened, blanks = -1, dict[str, dict[str, Any]]()
        with ExitStack() as stack:
            try:
                for frame, (shard, start, length, head) in zip(
                    chosen.tolist(), self.places[chosen].tolist(), strict=True
                ):
                    if shard >= 0:
                        if shard != opened:
                            stack.close()
                            file = stack.enter_context(self.files[shard].open("rb", buffering=_BUFFER))
                            opened = shard
                        yield self.layout.decode(file, start, length, head, names)
                        continue
                    reason, sizes = _DAMAGED if self.damaged[frame] else _NOT_YET, self.layout.sizes
                    if reason not in blanks:
                        blank = FrameRecord.failed(reason, nodes=sizes["node"], lights=sizes["light"]).values
                        blanks[reason] = {name: blank[name] for name in (blank if names is None else names)}
                    yield dict(blanks[reason])
            except OSError as error:
                raise ResultError(f"{self.files[shard]} cannot be read: {error.strerror or error}") from None
            except (ResultError, ValueError, TypeError, RecursionError, zlib.error) as error:
                raise ResultError(f"{self.files[shard]} is damaged in frame {frame}: {error}; {_REMEDY}") from None


def _records(file: Path, run: bytes) -> tuple[list[tuple[int, int, int, int]], bool]:
    """Frame, first byte, length and checksum of the head of each record of a file; whether a header is damaged.

    Raises
    ------
    ResultError
        It cannot be read, or holds a record of another run.
    """
    records, damaged, place, search = [], False, 0, 0
    with disk_faults(ResultError, f"{file} cannot be read"), file.open("rb", buffering=0) as opened:
        size = os.fstat(opened.fileno()).st_size
        while place < size:
            opened.seek(place)
            header = opened.read(_HEADER.size)
            found = _parsed(header, file, run)
            search = search if found is None else place + 1
            if found is not None and place + len(header) + found[1] <= size:
                frame, length, head = found
                records.append((frame, place + len(header), length, head))
                place += len(header) + length
                continue
            with mmap.mmap(opened.fileno(), size, access=mmap.ACCESS_READ) as content:
                place = content.find(run, search, max(size - _HEADER.size + len(run), 0))
            # a record that is not whole at the end is what a killed process leaves
            damaged |= place >= 0 or (found is None and len(header) == _HEADER.size)
            if place < 0:
                break
            search = place + 1
    return records, damaged


def _parsed(header: bytes, file: Path, run: bytes) -> tuple[int, int, int] | None:
    """Frame, length and checksum of the head that a header states; None where it is damaged."""
    if len(header) < _HEADER.size or zlib.crc32(header[:_CHECKED]) != int.from_bytes(header[_CHECKED:], "little"):
        return None
    owner, *stated, _ = _HEADER.unpack(header)
    if owner != run:
        raise ResultError(f"{file} is of another run than {file.parent.parent / PROVENANCE}: {PUT_BACK}")
    return tuple(stated)


def _header(run: bytes, frame: int, length: int, head: int) -> bytes:
    checked = _HEADER.pack(run, frame, length, head, 0)[:_CHECKED]
    return checked + struct.pack("<I", zlib.crc32(checked))


def discard(folder: Path, run: bytes, frames: Collection[int]) -> None:
    """Discard all records of some frames for good; no other run may write meanwhile.

    Raises
    ------
    ResultError
        The disk refuses.
    """
    for file in shard_files(folder):
        old = [record for record in _records(file, run)[0] if record[0] in frames]
        with writing(file), file.open("r+b") as opened:
            for _, start, length, head in old:
                opened.seek(start - _HEADER.size)
                opened.write(_header(run, _NO_FRAME, length, head))
            opened.flush()
            os.fsync(opened.fileno())
