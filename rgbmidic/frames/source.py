"""What a test's frames are read from: files of one frame or several."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import ClassVar

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.stored import StoredFrame, damaged, raw_frame
from rgbmidic.settings import FrameSettings

__all__ = ["FrameSource", "file_hash"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource(ABC):
    """A file of one frame or several, read in any order; frames count from 0.

    A format says how header and samples are read; one of several frames overrides `__len__` and `name` too.

    Attributes
    ----------
    path
        The file; it need not exist before it is read.
    stated
        What the user says of it.
    tells_camera
        Whether the file itself tells pattern and levels.
    """

    path: Path
    stated: FrameSettings
    tells_camera: ClassVar[bool] = False

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the header alone."""
        with _on_disk(self.path):
            return self._shape()

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the file."""
        return file_hash(self.path)

    def __len__(self) -> int:
        """Number of frames."""
        return 1

    def name(self, index: int) -> str:
        """What to call a frame in messages and results: the file's name."""
        return self.path.name

    def read(self, index: int) -> Mosaic | ChannelFrame:
        """Read frame `index`.

        Raises
        ------
        FrameError
            The file is missing, damaged, truncated, already demosaiced, or contradicts a statement (both are named).
        IndexError
            There is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in {self.path}, which holds {len(self)}")
        with _on_disk(self.path):
            stored = self._stored(index)
        return raw_frame(stored, self.stated, self.path)

    @abstractmethod
    def _shape(self) -> tuple[int, int]: ...

    @abstractmethod
    def _stored(self, index: int) -> StoredFrame: ...


@contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    """Something to read is there, and what the disk refuses becomes a FrameError."""
    if path.is_symlink() and not path.exists():
        raise FrameError(f"frame file not found: {path} is a link to {path.readlink()}, which does not exist")
    if not path.is_file():
        raise FrameError(f"not a file but a folder: {path}" if path.exists() else f"frame file not found: {path}")
    try:
        if path.stat().st_size == 0:
            raise damaged(path, "it is empty")
        yield
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {error.strerror or error}") from None


def file_hash(path: Path | str) -> str:
    """SHA-256 of a file, in hexadecimal digits; computed once for a file that does not change.

    Raises
    ------
    FrameError
        The file cannot be read.
    """
    try:
        status = Path(path).stat()
        return _sha256(Path(path), status.st_size, status.st_mtime_ns)
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {error.strerror or error}") from None


@lru_cache(maxsize=1024)
def _sha256(path: Path, size: int, modified: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
