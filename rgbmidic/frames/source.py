"""What a test's frames are read from: files of one frame or several."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, wraps
from pathlib import Path
from typing import TypeVar

from rgbmidic.errors import FrameError, disk_reason, legible
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, Window
from rgbmidic.frames.stored import Camera, StoredFrame, damaged, raw_frame
from rgbmidic.settings import FrameSettings, regular

__all__ = ["FrameSource", "Movie", "file_fingerprint", "file_hash", "remembered"]

_T = TypeVar("_T")
_SAMPLES, _PIECE = 64, 4096
"""Pieces of a file, and their bytes, that its fingerprint is made of."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource(ABC):
    """A file of one frame or several, read in any order; frames count from 0.

    A format says how header and samples are read; one of several frames is a `Movie`.

    Attributes
    ----------
    path
        The file; it need not exist before it is read.
    stated
        What the user says of it.
    camera
        What a calibration knows of it.
    """

    path: Path
    stated: FrameSettings
    camera: Camera | None = field(default=None, compare=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the header alone."""
        with _on_disk(self.path):
            return self._shape()

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the file."""
        return file_hash(self.path)

    @property
    def recording(self) -> Recording:
        """How the frames were recorded, from the header alone; a file of one frame tells nothing and is not read."""
        return Recording()

    def __len__(self) -> int:
        """Number of frames."""
        return self.recording.count

    def __getitem__(self, index: int) -> Mosaic | ChannelFrame:
        """Frame `index`, as `read` gives it."""
        return self.read(index)

    def name(self, index: int) -> str:
        """What to call a frame in messages and results: the file's name."""
        return legible(self.path.name)

    def read(self, index: int, window: Window | None = None) -> Mosaic | ChannelFrame:
        """Read frame `index`, or a part of it.

        Raises
        ------
        FrameError
            The file is missing, damaged, truncated, already demosaiced, or contradicts a statement or the calibration
            (both are named).
        IndexError
            There is no such frame.
        """
        shape = None if window is None or window.is_whole else window.frame
        return raw_frame(self.told(index, window), self.stated, self.path, self.camera, shape)

    def told(self, index: int, window: Window | None = None) -> StoredFrame:
        """The samples of frame `index`, or a part of it, with what the file alone tells; raises as `read` does."""
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in {self.path}, which holds {len(self)}")
        with _on_disk(self.path):
            if window is None or window.is_whole:
                return self._stored(index)
            if (shape := self._shape()) != window.frame:
                told = "{} rows of {} pixels, the frames of the test {} of {}".format(*shape, *window.frame)
                raise FrameError(f"{self.path} has {told}")
            stored = self._rows(index, window.rows)
        return replace(stored, values=stored.values[:, window.columns.start : window.columns.stop])

    def _rows(self, index: int, rows: range) -> StoredFrame:
        """Some rows of a frame, the first of which is a whole multiple of 4: where a format lets only these be read."""
        stored = self._stored(index)
        return replace(stored, values=stored.values[rows.start : rows.stop])

    @abstractmethod
    def _shape(self) -> tuple[int, int]: ...

    @abstractmethod
    def _stored(self, index: int) -> StoredFrame: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Movie(FrameSource):
    """A file of several frames, whose header is read when the number of its frames is asked for.

    Of a frame only its own samples are read, whatever the size of the file; a header that is `remembered` is read once.
    """

    @property
    def recording(self) -> Recording:
        """How the frames were recorded, from the header alone.

        Raises
        ------
        FrameError
            The file is missing, or its header is damaged.
        """
        with _on_disk(self.path):
            return self._recording()

    @property
    def fingerprint(self) -> str:
        """Of size and samples of the content: a movie is too large to be read whole for it."""
        return file_fingerprint(self.path)

    def name(self, index: int) -> str:
        """What to call a frame in messages and results: the file's name and the frame's index."""
        return f"{legible(self.path.name)} frame {index}"

    @abstractmethod
    def _recording(self) -> Recording: ...


@contextmanager
def _on_disk(path: Path) -> Iterator[None]:
    """Something to read is there, and what the disk refuses becomes a FrameError."""
    try:
        if path.is_symlink() and not path.exists():
            raise FrameError(f"frame file not found: {path} is a link to {path.readlink()}, which does not exist")
        if not regular(path).is_file():
            raise FrameError(f"not a file but a folder: {path}" if path.exists() else f"frame file not found: {path}")
        if path.stat().st_size == 0:
            raise damaged(path, "it is empty")
        yield
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {disk_reason(error)}") from None


def remembered(parse: Callable[[Path], _T]) -> Callable[[Path], _T]:
    """What `parse` finds in a file, found once for a file that does not change; an OSError where there is none."""

    @lru_cache(maxsize=1024)
    def found(path: Path, size: int, modified: int) -> _T:
        return parse(path)

    @wraps(parse)
    def look(path: Path) -> _T:
        status = path.stat()
        return found(path, status.st_size, status.st_mtime_ns)

    return look


def file_hash(path: Path | str) -> str:
    """SHA-256 of a file, in hexadecimal digits; computed once for a file that does not change.

    Raises
    ------
    FrameError
        The file cannot be read.
    """
    return _digest(path, _sha256)


def file_fingerprint(path: Path | str) -> str:
    """SHA-256 of a file's size and of 64 pieces of 4 KiB spread evenly over it: of all of it up to 256 KiB.

    Raises
    ------
    FrameError
        The file cannot be read.
    """
    return _digest(path, _sampled)


def _digest(path: Path | str, function: Callable[[Path], str]) -> str:
    try:
        return function(Path(path))
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {disk_reason(error)}") from None


@remembered
def _sha256(path: Path) -> str:
    with regular(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@remembered
def _sampled(path: Path) -> str:
    with regular(path).open("rb") as file:
        size = file.seek(0, 2)
        digest = hashlib.sha256(str(size).encode())
        for number in range(_SAMPLES):
            file.seek(max(size - _PIECE, 0) * number // (_SAMPLES - 1))
            digest.update(file.read(_PIECE))
    return digest.hexdigest()
