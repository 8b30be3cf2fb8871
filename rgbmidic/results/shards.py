"""The frames of a result on disk: pairs of files that only ever grow, and the table of what they hold.

``000007.frames`` holds records one after the other, ``000007.index`` an entry of 32 bytes for each, written once the
record is: an entry commits a frame. A process that is killed leaves at most a record without an entry, or part of an
entry; readers pass over both, and nobody appends to a file of another writer. A frame that is written twice counts as
it is in the file with the higher number, there as it was written last.
"""

from __future__ import annotations

import itertools
import os
import re
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import ResultError
from rgbmidic.results.files import writing
from rgbmidic.results.layout import RecordLayout
from rgbmidic.results.record import FrameRecord
from rgbmidic.typing import AnyArray, BoolArray

__all__ = ["FrameTable", "ShardWriter", "shard_files"]

_SHARD_FRAMES = 500
"""Frames of a pair of files: 100,000 frames are 200 pairs, which open in milliseconds; 5,000 nodes each are 150 MB."""
_BUFFER = 2**16
"""Bytes that the system is asked for at once: a call takes some us, as long as copying these. Small records come by the
dozen, large ones pass by the buffer."""
_NAME = re.compile(r"([0-9]{6,})\.(frames|index)")
_ENTRY = np.dtype([("frame", "<u8"), ("start", "<u8"), ("length", "<u8"), ("head", "<u4"), ("check", "<u4")])
_CHECKED = _ENTRY.itemsize - 4
_NOT_YET = "not measured yet"


def shard_files(folder: Path) -> list[Path]:
    """The files of this kind in a folder, in their order."""
    with suppress(FileNotFoundError):
        return sorted((file for file in folder.iterdir() if _NAME.fullmatch(file.name)), key=_number)
    return []


def _number(file: Path) -> tuple[int, str]:
    return int(file.name.partition(".")[0]), file.suffix


class ShardWriter:
    """Appends records to files of its own; a copy that is sent to another process opens others.

    Parameters
    ----------
    folder
        Where the files are; it must exist.
    layout
        Of the records.
    """

    def __init__(self, folder: Path, layout: RecordLayout) -> None:
        self.folder, self.layout = folder, layout
        self._records: BinaryIO | None = None
        self._index: BinaryIO | None = None
        self._count = self._end = 0

    def __reduce__(self) -> tuple[type[ShardWriter], tuple[Path, RecordLayout]]:
        return ShardWriter, (self.folder, self.layout)

    def append(self, frame: int, record: FrameRecord) -> None:
        """Write a frame; it counts from the moment this returns, and not at all where it raises.

        Raises
        ------
        ResultError
            The disk is full or refuses.
        """
        content, head = self.layout.encode(record.values)
        if self._count == _SHARD_FRAMES:
            self.close()
        records, index = self._files()
        entry = np.array([(frame, self._end, len(content), head, 0)], dtype=_ENTRY)
        entry["check"] = zlib.crc32(entry.tobytes()[:_CHECKED])
        _write_at(records, self._end, content)
        _write_at(index, self._count * _ENTRY.itemsize, entry.tobytes())
        self._count, self._end = self._count + 1, self._end + len(content)

    def close(self) -> None:
        """Wait until all is on the disk, and close the files.

        Raises
        ------
        ResultError
            The disk refuses.
        """
        files, self._records, self._index = (self._records, self._index), None, None
        self._count = self._end = 0
        for file in files:
            if file is not None:
                with writing(file.name), file:
                    os.fsync(file.fileno())

    def _files(self) -> tuple[BinaryIO, BinaryIO]:
        """Files for records and entries; new ones, of a number that nobody has, where none are open."""
        if self._records is None or self._index is None:
            used = [_number(file)[0] for file in shard_files(self.folder)]
            for number in itertools.count(max(used, default=-1) + 1):
                with writing(self.folder), suppress(FileExistsError):
                    self._records = (self.folder / f"{number:06d}.frames").open("xb", buffering=0)
                    self._index = (self.folder / f"{number:06d}.index").open("xb", buffering=0)
                    break
        assert self._records is not None
        assert self._index is not None
        return self._records, self._index


def _write_at(file: BinaryIO, start: int, content: bytes) -> None:
    """Write all of it at a place; nothing of it stays where the disk refuses."""
    try:
        with writing(file.name):
            file.seek(start)
            rest = memoryview(content)
            while rest:
                rest = rest[file.write(rest) :]
    except BaseException:
        with suppress(OSError):
            file.truncate(start)
        raise


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTable:
    """Which frames a result holds at the time it is loaded, and where; reads them.

    Attributes
    ----------
    layout
        Of the records.
    files
        Files of records.
    shard : ndarray, shape (T,), int64
        Which of the files each frame is in; -1 where it is not measured yet.
    start, length, head : ndarray, shape (T,), int64
        First byte of each record, its bytes, checksum of its head.
    """

    layout: RecordLayout
    files: Sequence[Path]
    shard: npt.NDArray[np.int64]
    start: npt.NDArray[np.int64]
    length: npt.NDArray[np.int64]
    head: npt.NDArray[np.int64]

    @classmethod
    def load(cls, folder: Path, layout: RecordLayout, count: int) -> FrameTable:
        """The table of a result of `count` frames.

        Raises
        ------
        ResultError
            An index is damaged, or has a frame that the result has not.
        """
        shard, start, length, head = np.full(count, -1), *np.zeros((3, count), dtype=np.int64)
        files = [file.with_suffix(".frames") for file in shard_files(folder) if file.suffix == ".index"]
        for number, file in enumerate(files):
            entries = _entries(file)
            frames = entries["frame"]
            if (frames >= count).any():
                raise ResultError(f"{file.with_suffix('.index')} is damaged: it names frame {frames.max()} of {count}")
            shard[frames] = number
            for column, name in ((start, "start"), (length, "length"), (head, "head")):
                column[frames] = entries[name]
        return cls(layout=layout, files=files, shard=shard, start=start, length=length, head=head)

    @property
    def finished(self) -> BoolArray:
        """Which frames there are, shape (T,)."""
        return np.asarray(self.shard >= 0)

    def read(self, frame: int) -> FrameRecord:
        """All of one frame; a blank record with the reason where it is not measured yet.

        Raises
        ------
        ResultError
            It is damaged.
        """
        return FrameRecord(values=next(self.each(None, [frame])), sizes=self.layout.sizes)

    def each(self, names: Sequence[str] | None, frames: Iterable[int]) -> Iterator[dict[str, Any]]:
        """The named quantities (None: all) of one frame after the other; errors as `read`."""
        chosen = np.fromiter(frames, dtype=np.int64)
        columns = (column[chosen].tolist() for column in (self.shard, self.start, self.length, self.head))
        opened, file, blank = -1, None, dict[str, Any]()
        try:
            for frame, shard, start, length, head in zip(chosen.tolist(), *columns, strict=True):  # noqa: B007 told below
                if shard < 0:
                    blank = blank or self._blank(names)
                    yield dict(blank)
                    continue
                if shard != opened:
                    if file is not None:
                        file.close()
                    opened, file = shard, self.files[shard].open("rb", buffering=_BUFFER)
                assert file is not None
                yield self.layout.decode(file, start, length, head, names)
        except OSError as error:
            raise ResultError(f"{self.files[shard]} cannot be read: {error.strerror or error}") from None
        except (ResultError, ValueError, TypeError, RecursionError, zlib.error) as error:
            raise ResultError(f"{self.files[shard]} is damaged in frame {frame}: {error}") from None
        finally:
            if file is not None:
                file.close()

    def _blank(self, names: Sequence[str] | None) -> dict[str, Any]:
        sizes = self.layout.sizes
        values = FrameRecord.failed(_NOT_YET, nodes=sizes["node"], lights=sizes["light"]).values
        return {name: values[name] for name in (values if names is None else names)}


def _entries(file: Path) -> AnyArray:
    """The entries that count of one file of records: whole, and of records that are whole."""
    index = file.with_suffix(".index")
    try:
        content, size = index.read_bytes(), file.stat().st_size
    except OSError as error:
        raise ResultError(f"{error.filename} cannot be read: {error.strerror or error}") from None
    entries = np.frombuffer(content, dtype=_ENTRY, count=len(content) // _ENTRY.itemsize)
    places = range(0, len(entries) * _ENTRY.itemsize, _ENTRY.itemsize)
    checks = np.array([zlib.crc32(content[place : place + _CHECKED]) for place in places], dtype=np.uint32)
    good = np.flatnonzero(checks == entries["check"])
    last = good[-1] + 1 if len(good) else 0
    if len(good) < last:
        raise ResultError(f"{index} is damaged: the checksum of an entry before its last is wrong")
    entries = entries[:last]
    start, length = entries["start"], entries["length"]
    return np.asarray(entries[(start <= size) & (length <= size) & (start + length <= size)])
