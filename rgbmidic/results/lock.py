"""Claims on a folder: files that name the processes that write there, and which frames each of them writes."""

from __future__ import annotations

import json
import os
import random
import secrets
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from rgbmidic.errors import ResultError
from rgbmidic.results.files import read_json, writing

__all__ = ["ALL_FRAMES", "Claim"]

ALL_FRAMES = range(sys.maxsize)
"""Whatever frames a folder has or will have."""
_PAUSES = (0.02, 0.05, 0.1, 0.2)
"""Seconds, at most, between tries. Two that start at once see each other and both step back; a pause drawn by chance
lets one be first. A process of an array looks at a folder in some ms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Claim:
    """A claim that this process holds; other processes of copies cannot release it.

    Attributes
    ----------
    file
        The file that says so.
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
                _write(file, {**_this_process(), "first": frames.start, "stop": frames.stop})
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
        """Let others have the frames."""
        if self.process == os.getpid():
            with writing(self.file):
                self.file.unlink(missing_ok=True)


def _write(file: Path, holder: dict[str, Any]) -> None:
    """Whole at once; it need not outlive the machine."""
    part = file.with_suffix(".part")
    with writing(file):
        part.write_text(json.dumps(holder), encoding="utf-8")
        part.replace(file)


def _others(mine: Path, frames: range) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Claims of others on any of these frames."""
    for file in mine.parent.glob("in_use.*.json"):
        if file == mine:
            continue
        with suppress(FileNotFoundError):
            holder = _holder(file)
            if not _may_live(holder):
                file.unlink(missing_ok=True)
            elif _overlap(holder, frames):
                yield file, holder


def _this_process() -> dict[str, Any]:
    return {"process": os.getpid(), "host": socket.gethostname()}


def _holder(file: Path) -> dict[str, Any]:
    """What a claim says; empty where it cannot be read."""
    try:
        holder = read_json(file)
    except ResultError:
        return {}
    return holder if isinstance(holder, dict) else {}


def _overlap(holder: dict[str, Any], frames: range) -> bool:
    """Whether a claim is on some of the frames; one that does not tell is on all."""
    first, stop = holder.get("first"), holder.get("stop")
    return not (isinstance(first, int) and isinstance(stop, int)) or max(first, frames.start) < min(stop, frames.stop)


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
