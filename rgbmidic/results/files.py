"""Files of a result, and claims on its folder.

A file appears under its name only when it is complete; a damaged one is an error that names it. A claim is a file that
names a process that writes into the folder, and the frames that it writes.
"""

from __future__ import annotations

import io
import json
import os
import random
import secrets
import socket
import sys
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np

from rgbmidic.errors import ResultError, disk_faults
from rgbmidic.settings import regular
from rgbmidic.typing import AnyArray

__all__ = [
    "ALL_FRAMES",
    "Claim",
    "check_file",
    "read_arrays",
    "read_json",
    "write_arrays",
    "write_complete",
    "write_json",
    "writing",
]


ALL_FRAMES = range(sys.maxsize)
"""All frames that a folder has or will have."""
_PAUSES = (0.02, 0.05, 0.1, 0.2)
"""Seconds, at most, between tries. Two that start at once see each other and both step back; a pause drawn by chance
lets one be first. A process of an array looks at a folder in some ms."""


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an npz file, not compressed: its size on disk is what it takes in memory."""
    write_complete(path, lambda file: np.savez(file, **arrays))


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, AnyArray]:
    """Read the named arrays of a file that `write_arrays` wrote, with their checksums; the others are not read.

    Raises
    ------
    ResultError
        The file is missing or damaged, or holds more than its size on disk.
    """
    try:
        with zipfile.ZipFile(regular(path)) as archive:
            return {name: _read_array(archive, name) for name in names}
    except FileNotFoundError:
        raise ResultError(f"{path} is missing: the result is incomplete") from None
    except Exception as error:  # zipfile and numpy raise a dozen kinds on damaged files
        raise ResultError(f"{path} is damaged: {error}") from None


def _read_array(archive: zipfile.ZipFile, name: str) -> AnyArray:
    """Read one array; a header that promises more than the file holds takes no memory."""
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
    content = archive.read(entry)
    file = io.BytesIO(content)
    np.lib.format.read_magic(file)
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    array = np.frombuffer(content, dtype, offset=file.tell())  # one that the header's shape does not fit is an error
    return array.reshape(shape, order="F" if fortran else "C").copy()


def write_json(path: Path, document: Any, *, new: bool = False) -> None:
    """Write a JSON file; a `new` one is not written where there is one, also where several processes begin at once."""
    content = json.dumps(document, indent=2).encode() + b"\n"
    write_complete(path, lambda file: file.write(content), new=new)


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises
    ------
    FileNotFoundError
        There is none.
    ResultError
        It is damaged.
    """
    try:
        return json.loads(regular(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None


def write_complete(path: Path, write: Callable[[BinaryIO], object], *, new: bool = False) -> None:
    """Write a file under another name and rename it when all of it is on the disk; else nothing is left of it.

    Parameters
    ----------
    path
        The file.
    write
        Writes its content.
    new
        Whether a file of this name stays as it is, also one that another process writes at the same time; else it is
        replaced.
    """
    temporary = path.with_name(f"{path.name}.{socket.gethostname()}.{os.getpid()}.part")
    try:
        with writing(path), temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
            if new:
                try:
                    path.hardlink_to(temporary)
                    return
                except FileExistsError:
                    return
                except OSError:  # a disk without links, where nobody else starts in the same millisecond
                    if path.exists():
                        return
            temporary.replace(path)
    finally:
        with suppress(OSError):  # a read-only disk refuses even to remove what is not there
            temporary.unlink()


def check_file(out: Path, *, overwrite: bool) -> None:
    """Refuse a file that is already there, unless it may be replaced, or whose folder is not.

    Raises
    ------
    ResultError
        It cannot be written.
    """
    with writing(out):
        if out.exists() and not (overwrite and out.is_file()):
            raise ResultError(
                f"{out} already exists; choose another name, or overwrite it (overwrite=True, --overwrite)"
            )
        if not out.parent.is_dir():
            raise ResultError(f"{out} cannot be written: there is no folder {out.parent}")


def writing(path: Path | str) -> AbstractContextManager[None]:
    """Turn an error of the disk inside the block into a `ResultError` that names the file."""
    return disk_faults(ResultError, f"{path} cannot be written")


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim that this process holds; other processes of copies cannot release it.

    Attributes
    ----------
    file
        The file of the claim.
    process
        Who holds it.
    """

    file: Path
    process: int

    @classmethod
    def take(cls, folder: Path, frames: range) -> Self:
        """Claim frames (consecutive) of a folder; claims that dead processes of this host left are removed.

        Raises
        ------
        ResultError
            Another run holds some of them, or the claim cannot be written.
        """
        for pause in _PAUSES:
            file = folder / f"in_use.{secrets.token_hex(8)}.json"
            if not (other := next(_others(file, frames), None)):
                holder = {"process": os.getpid(), "host": socket.gethostname()}
                part = file.with_suffix(".part")
                with writing(file):  # whole at once; it need not outlive the machine
                    part.write_text(json.dumps(holder | {"first": frames.start, "stop": frames.stop}), encoding="utf-8")
                    part.replace(file)
                if not (other := next(_others(file, frames), None)):
                    return cls(file=file, process=os.getpid())
                file.unlink(missing_ok=True)
            time.sleep(random.uniform(0, pause))
        assert other
        name, holder = other
        raise ResultError(
            f"{folder} is in use by process {holder.get('process', '?')} on {holder.get('host', '?')}; "
            f"give another folder, or delete {name} if that run is dead"
        )

    def release(self) -> None:
        """Remove the claim, so that other processes can write the frames."""
        if self.process == os.getpid():
            with writing(self.file):
                self.file.unlink(missing_ok=True)


def _others(mine: Path, frames: range) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the claims of other processes on any of these frames; one that cannot be read is on all of them."""
    for file in mine.parent.glob("in_use.*.json"):
        if file == mine:
            continue
        try:
            document = read_json(file)
        except FileNotFoundError:
            continue
        except ResultError:
            document = {}
        holder = document if isinstance(document, dict) else {}
        first, stop = holder.get("first"), holder.get("stop")
        if not _may_live(holder):
            file.unlink(missing_ok=True)
        elif not (isinstance(first, int) and isinstance(stop, int)) or (
            max(first, frames.start) < min(stop, frames.stop)
        ):
            yield file, holder


def _may_live(holder: dict[str, Any]) -> bool:
    """Report whether the process of a claim may live: False only for one of this host that is found dead."""
    if holder.get("host") != socket.gethostname() or os.name == "nt":  # where signal 0 would end a process
        return True
    try:
        os.kill(holder["process"], 0)
    except ProcessLookupError:
        return False
    except (KeyError, TypeError, OverflowError, OSError):
        pass
    return True
