"""The frames of a result: the record of one, an npz file for each, and the table of those that are there.

``000007.npz`` holds every quantity of frame 7, for `numpy.load` and others: a zip archive with a CRC-32 of every array,
its directory at the end. All records have the same arrays in the same order, so that the directory is one structure of
fixed length: a quantity is found without a look at the others, which `zipfile` takes (0.04 instead of 0.16 ms a frame,
0.4 instead of 1.0 ms for the history of a point). The archive's comment holds the digest of the run, the frame, and a
CRC-32 of the directory and these. A record that is replaced or discarded is gone at once; nothing is ever written into
a file.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from rgbmidic.disk import npy_array, npy_bytes, require_regular_file, write_complete
from rgbmidic.errors import AnotherTestError, InputError, ResultError, convert_disk_errors
from rgbmidic.renamed import state_new_names
from rgbmidic.results.provenance import PROVENANCE, RESTORE_REMEDY
from rgbmidic.results.quantities import QUANTITIES
from rgbmidic.text import HtmlRepr
from rgbmidic.typing import BoolArray, IntArray

if TYPE_CHECKING:
    from rgbmidic.correlation.solution import Solution

FRAMES = "solution"
"""Folder of the records in that of a result."""
_NAME = re.compile(r"([0-9]{6}|[1-9][0-9]{6,})\.npz")
_LOCAL_BYTES, _END_BYTES = struct.calcsize("<4s5H3I2H"), struct.calcsize("<4s4H2IH")
"""What precedes the name of an array and its content, and what ends the directory: PKWARE's APPNOTE.TXT 6.3, 4.3."""
_COMMENT = struct.Struct("<16sQ4x")
"""Digest of the run, frame, and room for the checksum."""
_NOT_YET, _DAMAGED = "not measured yet", "damaged"
_REMEDY = "`rgbmidic run --resume` measures it again, `partial=True` reads the rest"


@lru_cache(maxsize=4)
def _layout(names: tuple[str, ...]) -> tuple[dict[str, bytes], struct.Struct]:
    """Lay out the directory of every record.

    Returns the name of each array in the archive, by its quantity; and what is read of the directory, its end and the
    comment: method, CRC-32, bytes and place of every array, run and frame.
    """
    files = {name: f"{QUANTITIES[name].file_name}.npy".encode() for name in names}
    entries = "".join(f"10xH4x2I18xI{len(file)}x" for file in files.values())
    return files, struct.Struct(f"<{entries}{_END_BYTES}x{_COMMENT.format.lstrip('<')}")


class _Attribute:
    """A quantity of the table as an attribute of what holds it."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, holder: Any, owner: type | None = None) -> Any:
        if holder is None:  # asked of the class, by documentation
            raise AttributeError(self._name)
        return holder._quantity(self._name)


class QuantityAttributes:
    """Quantities with one shape in all frames as attributes: of all frames in a result, of one in a record."""

    __slots__ = ()
    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameRecord(QuantityAttributes, HtmlRepr):
    """The result of one frame; every quantity of `rgbmidic.results.QUANTITIES` is an attribute, such as ``record.u``.

    Attributes
    ----------
    values
        Every quantity by its name, in the shape and type of the table: an array, or a plain number or text.
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``).

    Raises
    ------
    InputError
        A quantity is missing, unknown or has another shape.

    Examples
    --------
    >>> FrameRecord.failed("too dark", nodes=2, lights=1).u.tolist()
    [nan, nan]
    """

    values: Mapping[str, Any]
    sizes: Mapping[str, int]

    def __post_init__(self) -> None:
        """Check names and shapes, and take over the types of the table."""
        if mismatched_names := self.values.keys() ^ QUANTITIES.keys():
            raise InputError(
                f"a frame record holds {', '.join(QUANTITIES)}; missing or unknown: {', '.join(mismatched_names)}"
            )
        values = {name: entry.convert(self.values[name], self.sizes) for name, entry in QUANTITIES.items()}
        object.__setattr__(self, "values", values)

    @classmethod
    def from_values(cls, *, nodes: int, lights: int, **values: Any) -> FrameRecord:
        """Make a record of some quantities; the others have the value of a frame that could not be measured.

        Parameters
        ----------
        nodes, lights
            Their numbers N and k.
        **values
            Quantities by name; None where not known. `inputs` may be the SHA-256 of each file by its path.

        Returns
        -------
        FrameRecord
        """
        sizes = {"node": nodes, "light": lights}
        blank = {name: entry.unmeasured(sizes) for name, entry in QUANTITIES.items()}
        quantities = {name: value for name, value in values.items() if value is not None}
        if isinstance(files := quantities.get("inputs"), Mapping):
            quantities["inputs"] = np.array(list(files.items()), dtype=np.str_).reshape(-1, 2)
        return cls(values=blank | quantities, sizes=sizes)

    @classmethod
    def from_solution(cls, solution: Solution, **quantities: Any) -> FrameRecord:
        """Make the record of a solved frame.

        Parameters
        ----------
        solution
            From which the quantities that have a `ResultQuantity.source` are taken.
        **quantities
            The others, as in `from_values`.

        Returns
        -------
        FrameRecord
        """
        nodes, lights = np.shape(solution.light_fraction)
        has_error = np.isfinite(solution.displacement_error).any()
        for entry in QUANTITIES.values():
            if entry.source and (has_error or not entry.is_estimated):
                quantities[entry.name] = entry.read_from(solution)
        return cls.from_values(nodes=nodes, lights=lights, **quantities)

    @classmethod
    def failed(cls, reason: str, *, nodes: int, lights: int, **quantities: Any) -> FrameRecord:
        """Make the record of a frame that could not be measured at all: NaN everywhere, and the reason.

        Parameters
        ----------
        reason
            Why nothing could be measured.
        nodes, lights
            Their numbers N and k.
        **quantities
            Other quantities, as in `from_values`.

        Returns
        -------
        FrameRecord
        """
        return cls.from_values(nodes=nodes, lights=lights, reason=reason, **quantities)

    def __repr__(self) -> str:
        """Return number, status and size of the frame, and the names of its quantities."""
        outcome = QUANTITIES["status"].codes[self.values["status"]]
        reason = f": {self.values['reason']}" if self.values["reason"] else ""
        summary = f"<rgbmidic frame {self.values['number']}, {outcome}{reason}; {self.sizes['node']} nodes>"
        return f"{summary}\nquantities: {', '.join(QUANTITIES)}"

    def _quantity(self, name: str, /) -> Any:
        return self.values[name]


for _entry in QUANTITIES.values():
    _holder = QuantityAttributes if _entry.is_stackable or _entry.is_estimated else FrameRecord
    setattr(_holder, _entry.name, _Attribute(_entry.name))


def record_files(folder: Path) -> dict[int, os.DirEntry[str]]:
    """List the files of records in a folder by their frames."""
    with suppress(FileNotFoundError), os.scandir(folder) as entries:
        return {int(entry.name.removesuffix(".npz")): entry for entry in entries if _NAME.fullmatch(entry.name)}
    return {}


def record_file(folder: Path, frame: int) -> Path:
    """Return the name of a frame's file."""
    return folder / f"{frame:06d}.npz"


def write_record(folder: Path, frame: int, record: FrameRecord, run: bytes, check: Callable[[], None]) -> None:
    """Write a frame, which counts from the moment this returns; a record that is there is replaced.

    Parameters
    ----------
    folder
        Where the files are; it must exist.
    frame
        Its index in the result.
    record
        What is kept of it.
    run : bytes, length 16
        Digest of what the frames of the result share.
    check
        It is called when the file has been made under another name in the folder: a folder that takes the place of this
        one before then fails the check, and one that does so later has no such file to rename.

    Raises
    ------
    ResultError
        The disk is full or refuses, or the check fails; nothing is left of the frame.
    """
    buffer, (files, _) = io.BytesIO(), _layout(tuple(QUANTITIES))
    contents = {name: npy_bytes(record.values[name]) for name in files}
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, entry in QUANTITIES.items():
            is_picture = entry.dtype is np.uint8 and not entry.is_stackable
            method = zipfile.ZIP_DEFLATED if is_picture else zipfile.ZIP_STORED
            file_info = zipfile.ZipInfo(files[name].decode())  # without a date: the same bits each time
            archive.writestr(file_info, contents[name], method, zlib.Z_BEST_SPEED)
        archive.comment = _COMMENT.pack(run, frame)
    content = buffer.getbuffer()
    content[-4:] = zlib.crc32(content[archive.start_dir : -4]).to_bytes(4, "little")

    def write(file: BinaryIO) -> None:
        check()
        file.write(content)

    write_complete(record_file(folder, frame), write)


def _read_record(path: Path, frame: int, names: Iterable[str], run: bytes) -> dict[str, Any]:
    """Read some quantities of a frame and verify their checksums; what is of this run has its shapes."""
    files, directory = _layout(tuple(QUANTITIES))
    with require_regular_file(path).open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - directory.size, 0))
        content = file.read()
        if len(content) != directory.size or zlib.crc32(content[:-4]).to_bytes(4, "little") != content[-4:]:
            raise ResultError("its directory is damaged or cut off")
        *numbers, owner, number = directory.unpack(content)
        if owner != run:
            raise AnotherTestError(f"{path} is of another run than {path.parents[1] / PROVENANCE}: {RESTORE_REMEDY}")
        if number != frame:
            raise ResultError(f"it holds frame {number}")
        iterator = iter(numbers)
        entries, values = dict(zip(files, zip(iterator, iterator, iterator, iterator, strict=True), strict=True)), {}
        for name in names:
            method, check, length, offset = entries[name]
            file.seek(offset + _LOCAL_BYTES + len(files[name]))
            content = file.read(min(length, size))
            content = zlib.decompress(content, wbits=-zlib.MAX_WBITS) if method == zipfile.ZIP_DEFLATED else content
            if zlib.crc32(content) != check:
                raise ResultError(f"the checksum of {name} is wrong")
            array = npy_array(content)
            values[name] = array if QUANTITIES[name].axes else array.item()
    return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTable:
    """Which frames a result holds at the time it is loaded; reads them.

    Attributes
    ----------
    folder
        Where the files of the records are.
    sizes
        Number of nodes (``"node"``) and of lights (``"light"``) of every frame.
    run : bytes, length 16
        Digest of the run.
    write_times : ndarray, shape (T,), int64
        When each frame was written, ns; -1 where it is not measured yet.
    damaged : ndarray, shape (T,), bool
        Frames that are known to be lost to damage; they are not `finished`.
    """

    folder: Path
    sizes: Mapping[str, int]
    run: bytes
    write_times: IntArray
    damaged: BoolArray

    @classmethod
    def load(cls, path: Path, sizes: Mapping[str, int], count: int, run: bytes) -> FrameTable:
        """Look which of `count` frames the result in a folder holds now; none of them is read.

        `run` is the digest of the run.

        Raises
        ------
        ResultError
            The folder cannot be read.
        """
        folder, write_times = path / FRAMES, np.full(count, -1, dtype=np.int64)
        with convert_disk_errors(ResultError, f"{folder} cannot be read"):
            for frame, file in record_files(folder).items():
                with suppress(FileNotFoundError, IndexError):  # discarded just now, or of no frame
                    write_times[frame] = file.stat().st_mtime_ns
        damaged = np.zeros(count, dtype=bool)
        return cls(folder=folder, sizes=dict(sizes), run=run, write_times=write_times, damaged=damaged)

    @property
    def finished(self) -> BoolArray:
        """Which frames there are, shape (T,)."""
        return np.asarray((self.write_times >= 0) & ~self.damaged)

    def without_damaged(self, *, ended: bool) -> FrameTable:
        """Read every record once and return the table without the damaged ones.

        Parameters
        ----------
        ended
            Whether all frames were there once: what is missing is then damaged too.

        Raises
        ------
        AnotherTestError
            A record is of another run.
        """
        damaged = ~self.finished & ended
        for frame in np.flatnonzero(self.finished).tolist():
            try:
                self.read(frame)
            except AnotherTestError:
                raise
            except ResultError:
                damaged[frame] = True
        return replace(self, damaged=damaged)

    def read(self, frame: int, names: Iterable[str] = QUANTITIES) -> dict[str, Any]:
        """Read some quantities of a frame, all unless stated; those of a frame that is not there are blank.

        Parameters
        ----------
        frame
            Its index.
        names
            The quantities.

        Returns
        -------
        dict
            The quantities by name.

        Raises
        ------
        ResultError
            The record is damaged, or of another run; the message names file and frame.
        """
        if self.write_times[frame] < 0 or self.damaged[frame]:
            reason = _DAMAGED if self.damaged[frame] else _NOT_YET
            blank = {name: QUANTITIES[name].unmeasured(self.sizes) for name in names} | {"reason": reason}
            return {name: QUANTITIES[name].convert(blank[name], self.sizes) for name in names}
        file = record_file(self.folder, frame)
        try:
            return _read_record(file, frame, names, self.run)
        except OSError as error:
            raise ResultError(f"{file} cannot be read: {error.strerror or error}") from None
        except (AnotherTestError, KeyError):  # KeyError: there is no quantity of this name
            raise
        except Exception as error:  # numpy and zlib raise a dozen kinds on damaged files
            raise ResultError(f"{file} is damaged in frame {frame}: {error}; {_REMEDY}") from None
