"""A lock on a folder: a file that names the process that writes there."""

from __future__ import annotations

import json
import os
import socket
from pathlib import Path
from typing import Any

from rgbmidic.errors import ResultError
from rgbmidic.results.files import read_json, writing

__all__ = ["release_lock", "take_lock"]


def take_lock(file: Path) -> None:
    """Create the lock; one that a dead process of this host left is taken over.

    Raises
    ------
    ResultError
        Another run holds it, or it cannot be written.
    """
    with writing(file):
        try:
            with file.open("x", encoding="utf-8") as opened:
                json.dump(_this_process(), opened)
        except FileExistsError:
            if _may_live(holder := _holder(file)):
                raise ResultError(
                    f"{file.parent} is in use by process {holder.get('process', '?')} on {holder.get('host', '?')}; "
                    f"give another folder, or delete {file} if that run is dead"
                ) from None
            file.unlink(missing_ok=True)
            take_lock(file)


def release_lock(file: Path) -> None:
    """Remove the lock if this process holds it."""
    if _holder(file) == _this_process():
        with writing(file):
            file.unlink(missing_ok=True)


def _this_process() -> dict[str, Any]:
    return {"process": os.getpid(), "host": socket.gethostname()}


def _holder(file: Path) -> dict[str, Any]:
    """Process and host that a lock names; empty where it cannot be read."""
    try:
        holder = read_json(file)
    except (FileNotFoundError, ResultError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _may_live(holder: dict[str, Any]) -> bool:
    """False only for a process of this host that is found dead."""
    if holder.get("host") != socket.gethostname() or os.name == "nt":  # where signal 0 would end a process
        return True
    try:
        os.kill(holder["process"], 0)
    except ProcessLookupError:
        return False
    except (KeyError, TypeError, OverflowError, OSError):
        return True
    return True
