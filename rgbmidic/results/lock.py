"""Locks of a result folder: files that name a process that writes into it, and the frames that it writes."""

from __future__ import annotations

import os
import random
import secrets
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rgbmidic.disk import may_be_alive, read_json, write_errors, write_json
from rgbmidic.errors import ResultError

ALL_FRAMES = range(sys.maxsize)
"""All frames that a folder has or will have."""
_PAUSES = (0.02, 0.05, 0.1, 0.2)
"""Seconds, at most, between tries. Two that start at once see each other and both step back; a pause drawn by chance
lets one be first. A process of an array looks at a folder in some ms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameLock:
    """A lock on frames that this process holds; copies in other processes cannot release it.

    Attributes
    ----------
    file
        The file of the lock.
    process
        Number of the process that holds it.
    """

    file: Path
    process: int

    @classmethod
    def acquire(cls, folder: Path, frames: range) -> Self:
        """Lock frames (consecutive) of a folder; locks that dead processes of this host left are removed.

        Raises
        ------
        ResultError
            Another run holds some of them, or the lock cannot be written.
        """
        for pause in _PAUSES:
            file = folder / f"in_use.{secrets.token_hex(8)}.json"
            if not (conflict := next(_conflicting_locks(file, frames), None)):
                holder = {"process": os.getpid(), "host": socket.gethostname()}
                write_json(file, holder | {"first": frames.start, "stop": frames.stop})
                if not (conflict := next(_conflicting_locks(file, frames), None)):
                    return cls(file=file, process=os.getpid())
                file.unlink(missing_ok=True)
            time.sleep(random.uniform(0, pause))
        assert conflict
        name, holder = conflict
        raise ResultError(
            f"{folder} is in use by process {holder.get('process', '?')} on {holder.get('host', '?')}; "
            f"give another folder, or delete {name} if that run is dead"
        )

    def check(self) -> None:
        """Refuse to write into a folder that no longer has this lock: another one lies in its place.

        Raises
        ------
        ResultError
            The lock is gone.
        """
        if not self.file.exists():
            raise ResultError(
                f"{self.file.parent} was replaced or emptied while this run wrote into it (its {self.file.name} is "
                "gone); what is there now stays as it is"
            )

    def release(self) -> None:
        """Remove the lock, so that other processes can write the frames."""
        if self.process == os.getpid():
            with write_errors(self.file):
                self.file.unlink(missing_ok=True)


def _conflicting_locks(lock_file: Path, frames: range) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Yield the locks of other processes on any of these frames; one that cannot be read is on all of them."""
    for file in lock_file.parent.glob("in_use.*.json"):
        if file == lock_file:
            continue
        try:
            document = read_json(file)
        except FileNotFoundError:
            continue
        except ResultError:
            document = {}
        holder = document if isinstance(document, dict) else {}
        first, stop = holder.get("first"), holder.get("stop")
        if not may_be_alive(holder):
            file.unlink(missing_ok=True)
        elif not (isinstance(first, int) and isinstance(stop, int)) or max(first, frames.start) < min(
            stop, frames.stop
        ):
            yield file, holder
