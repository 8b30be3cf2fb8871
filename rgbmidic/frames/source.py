"""Sources of a test's frames: files of one frame or of several, read frame by frame or in part."""

from __future__ import annotations

import hashlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache, wraps
from pathlib import Path
from typing import ClassVar, TypeVar

from rgbmidic.disk import require_regular_file
from rgbmidic.errors import FrameError, convert_disk_errors, damaged_file, printable
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, Window
from rgbmidic.frames.metadata import CameraMetadata, MovieHeader, StoredFrame, raw_frame
from rgbmidic.renamed import state_new_names
from rgbmidic.settings import FrameSettings

_T = TypeVar("_T")
_NOTHING_STATED = Recording()
_WITH_DATASET = re.compile(r"(.*\.(?:h5|hdf5|nxs)):(.+)", re.IGNORECASE | re.DOTALL)


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSource(ABC):
    """A file of one frame or several, read in any order; frames count from 0.

    A format defines how header and samples are read; one of several frames is a `MovieSource`. It is a dataclass only
    where it has fields of its own.

    Attributes
    ----------
    path
        The file; it need not exist before it is read.
    user_metadata
        What the user states of it.
    camera
        What a calibration states of it.

    Examples
    --------
    >>> from rgbmidic.frames import list_frames, open_source
    >>> path = list_frames("frames")[0]
    >>> source = open_source(path, FrameSettings(path=str(path)))
    >>> isinstance(source, FrameSource), source.read(0).cfa
    (True, 'RGGB')
    """

    packages: ClassVar[tuple[str, ...]] = ()
    """Packages, beside numpy and OpenCV, whose version decides on what is read."""

    path: Path
    user_metadata: FrameSettings
    camera: CameraMetadata | None = field(default=None, compare=False, repr=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the header alone."""
        with convert_disk_errors(FrameError, f"{self.path} cannot be read"):
            _check_file(self.path)
            return self._shape()

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the file."""
        return file_hash(self.path)

    @property
    def recording(self) -> Recording:
        """Recording of the frames, from the header alone; a file of one frame states nothing and is not read."""
        return _NOTHING_STATED

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks of the header for the user."""
        return self.recording.remarks

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.recording.count

    def __getitem__(self, index: int) -> Mosaic | ChannelFrame:
        """Return the frame `index`, as `read` gives it."""
        return self.read(index)

    def name(self, index: int) -> str:
        """Return the name of a frame in messages and results: the file's name.

        Parameters
        ----------
        index
            Index of the frame in the file.

        Returns
        -------
        str
        """
        return printable(self.path.name)

    def read(self, index: int, window: Window | None = None) -> Mosaic | ChannelFrame:
        """Read frame `index`, or a part of it.

        Parameters
        ----------
        index
            Index of the frame in the file.
        window
            The part of it that is read; None: all of it.

        Returns
        -------
        Mosaic or ChannelFrame

        Raises
        ------
        FrameError
            The file is missing, damaged, truncated, already demosaiced, or contradicts a statement or the calibration
            (both are named).
        IndexError
            There is no such frame.
        """
        shape = None if window is None or window.is_whole else window.frame
        return raw_frame(self.stored(index, window), self.user_metadata, self.path, self.camera, shape)

    def stored(self, index: int, window: Window | None = None) -> StoredFrame:
        """Return the samples of frame `index`, or of a part of it, with what the file alone states.

        Parameters
        ----------
        index
            Index of the frame in the file.
        window
            The part of it that is read; None: all of it.

        Returns
        -------
        StoredFrame

        Raises
        ------
        FrameError
            The file is missing, damaged, truncated, or of another size than the window's frame.
        IndexError
            There is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in {self.path}, which holds {len(self)}")
        with convert_disk_errors(FrameError, f"{self.path} cannot be read"):
            _check_file(self.path)
            if window is None or window.is_whole:
                return self._rows(index, slice(None))
            if (shape := self._shape()) != window.frame:
                sizes = "{} rows of {} pixels, the frames of the test {} of {}".format(*shape, *window.frame)
                raise FrameError(f"{self.path} has {sizes}")
            rows, columns = window.slices_in(Window.of_frame(shape))
            stored = self._rows(index, rows)
        return replace(stored, values=stored.values[:, columns])

    def _rows(self, index: int, rows: slice) -> StoredFrame:
        """Read some rows of a frame, the first of which is a whole multiple of 4: alone, where the format allows it."""
        stored = self._stored(index)
        return replace(stored, values=stored.values[rows])

    def _stored(self, index: int) -> StoredFrame:
        """Read a frame, of a format that does not allow to read some rows alone."""
        raise NotImplementedError(f"{type(self).__name__} reads no samples: it defines neither _rows nor _stored")

    @abstractmethod
    def _shape(self) -> tuple[int, int]: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class MovieSource(FrameSource):
    """A file of several frames, whose header is read when the number of its frames is asked for, and reads the frames.

    Of a frame only its own samples are read, whatever the size of the file; a header behind `cache_by_file` is read
    once.

    Examples
    --------
    >>> import numpy as np
    >>> from rgbmidic.frames import open_source
    >>> np.save("stack.npy", np.zeros((3, 40, 60), dtype=np.uint16))
    >>> statement = FrameSettings(path="stack.npy", kind="monochrome", black_level=0, white_level=4095)
    >>> movie = open_source(Path("stack.npy"), statement)
    >>> isinstance(movie, MovieSource), movie.recording.count
    (True, 3)
    >>> Path("stack.npy").unlink()
    """

    @property
    def recording(self) -> Recording:
        """Recording of the frames, from the header alone.

        Raises
        ------
        FrameError
            The file is missing, or its header is damaged.
        """
        with convert_disk_errors(FrameError, f"{self.path} cannot be read"):
            _check_file(self.path)
            return self._header().recording

    @property
    def fingerprint(self) -> str:
        """SHA-256 of size and samples of the content: a movie is too large to be read whole for it."""
        return file_fingerprint(self.path)

    def name(self, index: int) -> str:
        """Return the name of a frame in messages and results: the file's name and the frame's index.

        Parameters
        ----------
        index
            Index of the frame in the file.

        Returns
        -------
        str
        """
        return f"{printable(self.path.name)} frame {index}"

    def _shape(self) -> tuple[int, int]:
        return self._header().shape

    def _rows(self, index: int, rows: slice) -> StoredFrame:
        header = self._header()
        return header.read(self.path, index, range(header.shape[0])[rows])

    @abstractmethod
    def _header(self) -> MovieHeader: ...


def split_dataset(path: Path | str) -> tuple[str, str]:
    """Split a name into the file and the dataset named behind it: ``run.h5:/entry/data``; empty where none is."""
    match = _WITH_DATASET.fullmatch(str(path))
    return (match[1], match[2]) if match else (str(path), "")


def _check_file(path: Path) -> None:
    """Check that there is something to read."""
    if path.is_symlink() and not path.exists():
        raise FrameError(f"frame file not found: {path} is a link to {path.readlink()}, which does not exist")
    if not require_regular_file(path).is_file():
        raise FrameError(f"not a file but a folder: {path}" if path.exists() else f"frame file not found: {path}")
    if path.stat().st_size == 0:
        raise damaged_file(path, "it is empty")


def cache_by_file(parse: Callable[[Path], _T]) -> Callable[[Path | str], _T]:
    """Decorate `parse` so that a file that does not change is parsed once; what the disk refuses is a FrameError."""

    @lru_cache(maxsize=1024)
    def parse_cached(path: Path, size: int, modified: int) -> _T:
        return parse(path)

    @wraps(parse)
    def parse_current(path: Path | str) -> _T:
        with convert_disk_errors(FrameError, f"{path} cannot be read"):
            status = Path(path).stat()
            return parse_cached(Path(path), status.st_size, status.st_mtime_ns)

    return parse_current


@cache_by_file
def file_hash(path: Path | str) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits; it is computed once for a file that does not change.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    FrameError
        The file cannot be read.

    Examples
    --------
    >>> file_hash("calibration.json") == file_fingerprint("calibration.json")
    False
    """
    with require_regular_file(Path(path)).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache_by_file
def file_fingerprint(path: Path | str) -> str:
    """Return the SHA-256 of a file's size and of 64 pieces of 4 KiB spread evenly over it: of all of it up to 256 KiB.

    Parameters
    ----------
    path
        The file.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    FrameError
        The file cannot be read.

    Examples
    --------
    >>> len(file_fingerprint("calibration.json"))
    64
    """
    # 256 KiB, in pages of memory, are read in a millisecond; a movie that was exchanged differs in all of them, and one
    # that was cut in its size
    pieces, page = 64, 4096
    with require_regular_file(Path(path)).open("rb") as file:
        size = file.seek(0, 2)
        digest = hashlib.sha256(str(size).encode())
        for number in range(pieces):
            file.seek(max(size - page, 0) * number // (pieces - 1))
            digest.update(file.read(page))
    return digest.hexdigest()
