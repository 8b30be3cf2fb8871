"""The frames of a test in their order: which files, how many, of one size, each with its name and hash."""

from __future__ import annotations

import glob
import hashlib
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Protocol

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.readers import FRAME_SUFFIXES, frame_shape, read_frame
from rgbmidic.settings import FrameSettings

__all__ = ["FrameFile", "FrameSequence", "FrameSource", "file_hash", "list_frames", "open_frames"]


class FrameSource(Protocol):
    """A file that holds one frame or several.

    A camera's multi-frame format joins by a class with these members and a line in `_source`.
    """

    @property
    def path(self) -> Path:
        """The file."""
        ...

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the header alone."""
        ...

    def __len__(self) -> int:
        """Number of frames."""
        ...

    def name(self, index: int) -> str:
        """What to call a frame in messages and results."""
        ...

    def read(self, index: int) -> Mosaic | ChannelFrame:
        """Read one frame."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFile:
    """A file that holds one frame; a `FrameSource`.

    Attributes
    ----------
    path
        The file.
    settings
        What is stated about it.
    """

    path: Path
    settings: FrameSettings

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, from the header alone."""
        return frame_shape(self.path, self.settings.shape)

    def __len__(self) -> int:
        return 1

    def name(self, index: int) -> str:
        """The file's name."""
        return self.path.name

    def read(self, index: int) -> Mosaic | ChannelFrame:
        """Read the frame."""
        stated = self.settings
        return read_frame(
            self.path,
            kind=stated.kind,
            cfa=stated.cfa,
            black_level=stated.black_level,
            white_level=stated.white_level,
            shape=stated.shape,
            dtype=stated.dtype,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSequence:
    """The frames of a test, read one by one.

    Attributes
    ----------
    lights : tuple of tuple of FrameSource
        One series of files per light fired in succession; a single series for simultaneous coloured lights.
    """

    lights: tuple[tuple[FrameSource, ...], ...]

    def __len__(self) -> int:
        """Number of mechanical states."""
        return sum(len(source) for source in self.lights[0])

    def read(self, index: int) -> tuple[Mosaic | ChannelFrame, ...]:
        """Read state `index`: one frame per series, so a single one unless lights are fired in succession.

        Raises
        ------
        FrameError
            A file is damaged or not what the settings say.
        IndexError
            There is no such frame.
        """
        return tuple(source.read(inner) for source, inner in self._locate(index))

    def name(self, index: int) -> str:
        """File name of state `index`; of several lights in succession joined by " + "."""
        return " + ".join(source.name(inner) for source, inner in self._locate(index))

    def hashes(self, index: int) -> dict[str, str]:
        """Path and SHA-256 of every file that state `index` comes from."""
        return {str(source.path): file_hash(source.path) for source, _ in self._locate(index)}

    def _locate(self, index: int) -> Iterator[tuple[FrameSource, int]]:
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in a sequence of {len(self)}")
        for sources in self.lights:
            ends = list(accumulate(len(source) for source in sources))
            position = bisect_right(ends, index)
            yield sources[position], index - (ends[position - 1] if position else 0)


def open_frames(settings: FrameSettings, base: Path) -> FrameSequence:
    """Find the frames of a test and check that they belong together, from their headers alone.

    Parameters
    ----------
    settings
        The section ``[frames]``.
    base
        Folder that relative paths start from.

    Raises
    ------
    FrameError
        No file matches, a frame has another size than the first, the lights have different numbers of frames, or a
        reference frame does not exist. A damaged file is left for `FrameSequence.read` to tell.
    """
    lights = tuple(tuple(_source(path, settings) for path in list_frames(text, base)) for text in settings.path)
    sequence = FrameSequence(lights=lights)
    _check_counts(settings, sequence)
    _check_sizes([source for sources in lights for source in sources])
    return sequence


def _source(path: Path, settings: FrameSettings) -> FrameSource:
    return FrameFile(path=path, settings=settings)


def _check_counts(settings: FrameSettings, sequence: FrameSequence) -> None:
    counts = [sum(len(source) for source in sources) for sources in sequence.lights]
    if len(set(counts)) > 1:
        told = ", ".join(f"{text}: {count}" for text, count in zip(settings.path, counts, strict=True))
        raise FrameError(f"lights fired in succession need equal numbers of frames; given are {told}")
    if (last := max(settings.reference)) >= counts[0]:
        raise FrameError(f"frames.reference names frame {last}, but there are {counts[0]} (0 to {counts[0] - 1})")


def _check_sizes(sources: list[FrameSource]) -> None:
    first: tuple[FrameSource, tuple[int, int]] | None = None
    for source in sources:
        try:
            shape = source.shape
        except FrameError:
            continue
        first = first or (source, shape)
        if shape != first[1]:
            raise FrameError(
                f"all frames must have one size: {source.path} has {shape[0]} rows of {shape[1]} pixels, "
                f"{first[0].path} has {first[1][0]} of {first[1][1]}"
            )


def list_frames(pattern: str | Path, base: Path | str = ".") -> tuple[Path, ...]:
    """Frame files in natural order (frame9 before frame10).

    Parameters
    ----------
    pattern
        A file, a folder (its files with the ending of a frame), or a pattern with ``*``, ``?``, ``[...]`` or ``**``.
    base
        Folder that a relative pattern starts from.

    Raises
    ------
    FrameError
        Nothing matches.
    """
    place = Path(base) / pattern
    if place.is_dir():
        files = [file for file in place.iterdir() if file.suffix.lower() in FRAME_SUFFIXES and file.name[0] != "."]
    elif place.exists():
        files = [place]
    else:  # Path.glob refuses absolute patterns
        files = [Path(base) / match for match in glob.glob(str(pattern), root_dir=base, recursive=True)]  # noqa: PTH207
    files = [file for file in files if file.is_file()]
    if not files:
        what = "a folder without frames" if place.is_dir() else "no file matches"
        raise FrameError(f"no frames: {what}: {pattern} (looked for in {Path(base).resolve()})")
    return tuple(sorted(files, key=_natural_key))


def _natural_key(path: Path) -> tuple[list[tuple[int, str]], str]:
    parts = re.split(r"([0-9]+)", str(path).casefold())
    keys = [(int(part), "") if position % 2 else (0, part) for position, part in enumerate(parts)]
    return keys, str(path)


def file_hash(path: Path | str) -> str:
    """SHA-256 of a file, in hexadecimal digits.

    Raises
    ------
    FrameError
        The file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise FrameError(f"{path} cannot be read: {error.strerror or error}") from None
