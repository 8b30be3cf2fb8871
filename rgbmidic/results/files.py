"""Files of a result: each appears under its name only when it is complete, and whatever is wrong with one is told."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import socket
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rgbmidic.errors import ResultError, disk_reason
from rgbmidic.settings import regular
from rgbmidic.typing import AnyArray

__all__ = [
    "check_file",
    "read_arrays",
    "read_json",
    "write_arrays",
    "write_complete",
    "write_json",
    "write_new_json",
    "writing",
]


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an npz file, not compressed: its size on disk is what it takes in memory."""
    write_complete(path, lambda file: np.savez(file, **arrays))


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, AnyArray]:
    """The named arrays of a file that `write_arrays` wrote, checksums verified; the others are not read.

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
    """One array, once its header is found to promise what the file holds."""
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type != zipfile.ZIP_STORED:
        raise ValueError(f"{name} is compressed")
    file = io.BytesIO(archive.read(entry))
    np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    promised, held = math.prod(shape) * dtype.itemsize, entry.file_size - file.tell()
    if promised != held:
        raise ValueError(f"the header of {name} promises {promised} bytes, the file holds {held}")
    file.seek(0)
    array: AnyArray = np.lib.format.read_array(file, allow_pickle=False)
    return array


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file."""
    write_complete(path, lambda file: file.write(_text(document)))


def write_new_json(path: Path, document: Any) -> bool:
    """Write a JSON file where there is none; of all who try at once one succeeds, the others are told False."""
    return write_complete(path, lambda file: file.write(_text(document)), _name_new)


def _text(document: Any) -> bytes:
    return json.dumps(document, indent=2).encode() + b"\n"


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


def _rename(temporary: Path, path: Path) -> bool:
    temporary.replace(path)
    return True


def _name_new(temporary: Path, path: Path) -> bool:
    """Rename where there is none yet."""
    try:
        path.hardlink_to(temporary)
    except FileExistsError:
        return False
    except OSError:  # a disk without links, where nobody else starts in the same millisecond
        return not path.exists() and _rename(temporary, path)
    return True


def write_complete(
    path: Path, write: Callable[[BinaryIO], object], rename: Callable[[Path, Path], bool] = _rename
) -> bool:
    """Write a file under another name and `rename` it when all of it is on the disk; else nothing is left of it."""
    temporary = path.with_name(f"{path.name}.{socket.gethostname()}.{os.getpid()}.part")
    try:
        with writing(path), temporary.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
            return rename(temporary, path)
    finally:
        with contextlib.suppress(OSError):  # a read-only disk refuses even to remove what is not there
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


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """What the disk refuses inside becomes a `ResultError` that names the file."""
    try:
        yield
    except OSError as error:
        raise ResultError(f"{path} cannot be written: {disk_reason(error)}") from None
