"""What C libraries write to the process's standard error while they read a file."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["complaints"]

_LOCK = threading.Lock()


@contextmanager
def complaints(*starts: bytes) -> Iterator[list[str]]:
    """A list that holds, afterwards, the lines with one of these starts; other lines (of threads) are passed on.

    Neither rawpy nor OpenCV lets the handlers of LibRaw and libpng be replaced, hence the redirection.
    """
    told: list[str] = []
    with _LOCK, tempfile.TemporaryFile() as file:
        try:
            terminal = os.dup(2)
        except OSError:  # a program without standard error: nothing can reach the user
            yield told
            return
        os.dup2(file.fileno(), 2)
        try:
            yield told
        finally:
            os.dup2(terminal, 2)
            file.seek(0)
            for line in file:
                if line.startswith(starts):
                    told.append(line.decode(errors="replace").strip())
                elif line.strip():
                    os.write(terminal, line)
            os.close(terminal)
