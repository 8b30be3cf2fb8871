"""Files that appear under their names only when all of them is written."""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from rgbmidic.errors import ResultError, RgbmidicError, convert_disk_errors


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
