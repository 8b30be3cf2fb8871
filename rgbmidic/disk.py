"""Files that appear under their names only when they are complete; one that is damaged is an error that names it."""

from __future__ import annotations

import csv
import glob
import io
import json
import os
import socket
import threading
import zipfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from rgbmidic.errors import ResultError, RgbmidicError, convert_disk_errors

if TYPE_CHECKING:  # reading the settings does without numpy
    import numpy as np
    import numpy.typing as npt

    from rgbmidic.typing import AnyArray


def require_regular_file(path: Path) -> Path:
    """Return path itself, unless a pipe, a socket or a device is there: to open one may wait, and to read it never end.

    Every file that is read is opened as this gives it. One that is missing is left for the opening to report.

    Parameters
    ----------
    path
        Of a file that is to be read.

    Returns
    -------
    Path

    Raises
    ------
    OSError
        It is not a regular file.

    Examples
    --------
    >>> require_regular_file(Path("test.toml")).name
    'test.toml'
    """
    if "\0" in str(path):
        raise OSError("its name holds a NUL")
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError("it is not a regular file but a pipe, a socket or a device")
    return path


def write_complete(
    path: Path,
    write: Callable[[BinaryIO], object],
    *,
    exclusive: bool = False,
    error: type[RgbmidicError] = ResultError,
) -> None:
    """Write a file under another name and rename it when all of it is written; else nothing is left of it.

    The other name is of this host, process and thread: whoever else writes the same file does not disturb it.

    Parameters
    ----------
    path
        The file.
    write
        Writes its content.
    exclusive
        Whether a file of this name stays as it is, also one that another process writes at the same time; else it is
        replaced.
    error
        Kind of error that is raised.

    Raises
    ------
    RgbmidicError
        The file cannot be written.
    """
    temporary = path.with_name(f"{path.name}.{socket.gethostname()}.{threading.get_ident()}.{os.getpid()}.part")
    try:
        with convert_disk_errors(error, f"{path} cannot be written"), temporary.open("w+b") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
            if exclusive:
                try:
                    path.hardlink_to(temporary)
                except OSError:  # it is there; or the disk has no links, where nobody else starts at the same time
                    if not path.exists():
                        temporary.replace(path)
                return
            temporary.replace(path)
    finally:
        with suppress(OSError):  # a read-only disk refuses even to remove what is not there
            temporary.unlink()


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write an npz file, not compressed: its size on disk is what it takes in memory."""
    import numpy as np

    write_complete(path, lambda file: np.savez(file, **arrays))


def read_arrays(path: Path, names: Iterable[str]) -> dict[str, AnyArray]:
    """Read the named arrays of a file that `write_arrays` wrote, with their checksums; the others are not read.

    Raises
    ------
    ResultError
        The file is missing or damaged, or holds more than its size on disk.
    """
    try:
        with zipfile.ZipFile(require_regular_file(path)) as archive:
            entries = {name: archive.getinfo(f"{name}.npy") for name in names}
            if packed := [name for name, entry in entries.items() if entry.compress_type != zipfile.ZIP_STORED]:
                raise ValueError(f"{packed[0]} is compressed")
            return {name: npy_array(archive.read(entry)) for name, entry in entries.items()}
    except FileNotFoundError:
        raise ResultError(f"{path} is missing: the result is incomplete") from None
    except Exception as error:  # zipfile and numpy raise a dozen kinds on damaged files
        raise ResultError(f"{path} is damaged: {error}") from None


def npy_bytes(array: npt.ArrayLike) -> bytes:
    """Return an array as the content of an npy file."""
    import numpy as np

    values = np.asarray(array)
    return _npy_header(values.dtype, values.shape) + values.tobytes()


def npy_array(content: bytes) -> AnyArray:
    """Undo `npy_bytes`; content that its header does not fit is an error before memory is taken."""
    import numpy as np

    header_end = 10 + int.from_bytes(content[8:10], "little")
    shape, fortran, dtype = _parse_npy_header(content[:header_end])
    return np.frombuffer(content, dtype, offset=header_end).reshape(shape, order="F" if fortran else "C").copy()


@lru_cache(maxsize=256)
def _npy_header(dtype: np.dtype[Any], shape: tuple[int, ...]) -> bytes:
    import numpy as np

    file, header = io.BytesIO(), {"descr": dtype.str, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)
    return file.getvalue()


@lru_cache(maxsize=256)
def _parse_npy_header(header: bytes) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    import numpy as np

    file = io.BytesIO(header)
    np.lib.format.read_magic(file)
    return np.lib.format.read_array_header_1_0(file)


def write_table(file: BinaryIO, head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write CSV: a header line, then rows, whose decimal numbers have nine digits; a field without a value is empty."""
    text = io.TextIOWrapper(file, encoding="utf-8", newline="")
    writer = csv.writer(text)
    writer.writerow(head)
    for row in rows:
        writer.writerow(("" if x != x else f"{x:.9g}") if isinstance(x, float) else x for x in row)
    text.detach()  # leaves the file open for whoever opened it


def write_json(path: Path, document: Any, *, exclusive: bool = False) -> None:
    """Write a JSON file; if `exclusive`, an existing one stays, also where several processes begin at once."""
    write_text(path, json.dumps(document, indent=2) + "\n", exclusive=exclusive)


def write_text(path: Path, text: str, *, exclusive: bool = False) -> None:
    """Write a text file, as `write_complete`."""
    write_complete(path, lambda file: file.write(text.encode()), exclusive=exclusive)


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
        return json.loads(require_regular_file(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise ResultError(f"{path} is damaged: {error}") from None


def check_file(out: Path, *, overwrite: bool) -> None:
    """Refuse a file that is already there, unless it may be replaced, or whose folder is not.

    What a process of this host that was killed left of the file is removed.

    Raises
    ------
    ResultError
        It cannot be written.
    """
    with write_errors(out):
        if out.exists() and not (overwrite and out.is_file()):
            raise ResultError(f"{out} already exists; choose another name, or overwrite it (`overwrite=True`)")
        if not out.parent.is_dir():
            raise ResultError(f"{out} cannot be written: there is no folder {out.parent}")
        remove_partial_files(out.parent, glob.escape(out.name))


def remove_partial_files(folder: Path, names: str) -> None:
    """Remove what processes of this host that were killed left of files whose `names` match a pattern."""
    host = socket.gethostname()
    for partial_file in folder.glob(f"{names}.{glob.escape(host)}.*.part"):
        process = partial_file.name.split(".")[-2]
        if process.isdecimal() and not may_be_alive({"host": host, "process": int(process)}):
            partial_file.unlink(missing_ok=True)


def write_errors(path: Path | str) -> AbstractContextManager[None]:
    """Turn an error of the disk inside the block into a `ResultError` that names the file."""
    return convert_disk_errors(ResultError, f"{path} cannot be written")


def may_be_alive(holder: dict[str, Any]) -> bool:
    """Report whether the process of a claim or a file may live: False only for one of this host that is found dead."""
    if holder.get("host") != socket.gethostname() or os.name == "nt":  # where signal 0 would end a process
        return True
    try:
        os.kill(holder["process"], 0)
    except ProcessLookupError:
        return False
    except (KeyError, TypeError, OverflowError, OSError):
        pass
    return True
