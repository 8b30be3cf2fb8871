"""The frames of a test in their order: which files, how many, of one size, each with its name and fingerprint."""

from __future__ import annotations

import glob
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.formats import FRAME_ENDINGS, Camera, open_source
from rgbmidic.frames.source import FrameSource
from rgbmidic.settings import FrameSettings

__all__ = ["FrameSeries", "list_frames", "open_series"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSeries:
    """The states of a test, read one by one, in any order.

    Attributes
    ----------
    lights : tuple of tuple of FrameSource
        The sources of each light fired in succession; a single tuple for simultaneous coloured lights.
    """

    lights: tuple[tuple[FrameSource, ...], ...]
    _ends: tuple[tuple[int, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ends = tuple(tuple(accumulate(len(source) for source in sources)) for sources in self.lights)
        object.__setattr__(self, "_ends", ends)

    def __len__(self) -> int:
        """Number of mechanical states."""
        return self._ends[0][-1]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the first header that can be read.

        Raises
        ------
        FrameError
            None can be read.
        """
        for _, shape in self.shapes():
            return shape
        return self.lights[0][0].shape

    def shapes(self) -> Iterator[tuple[FrameSource, tuple[int, int]]]:
        """Every source whose header can be read, with its rows and columns."""
        for source in (source for sources in self.lights for source in sources):
            try:
                yield source, source.shape
            except FrameError:
                continue

    def read(self, index: int) -> tuple[Mosaic | ChannelFrame, ...]:
        """Read state `index`: one frame per light fired in succession, else a single one.

        Raises
        ------
        FrameError
            A file is damaged or not what the settings say.
        IndexError
            There is no such state.
        """
        return tuple(source.read(inner) for source, inner in self._locate(index))

    def name(self, index: int) -> str:
        """Name of state `index`; of several lights in succession joined by " + "."""
        return " + ".join(source.name(inner) for source, inner in self._locate(index))

    def inputs(self, index: int) -> dict[str, str]:
        """Path and fingerprint of every file that state `index` comes from."""
        return {str(source.path): source.fingerprint for source, _ in self._locate(index)}

    def _locate(self, index: int) -> Iterator[tuple[FrameSource, int]]:
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in a series of {len(self)}")
        for sources, ends in zip(self.lights, self._ends, strict=True):
            position = bisect_right(ends, index)
            yield sources[position], index - (ends[position - 1] if position else 0)


def open_series(settings: FrameSettings, base: Path | str = ".", camera: Camera | None = None) -> FrameSeries:
    """Find the frames of a test and check that they belong together, from their headers alone.

    Parameters
    ----------
    settings
        The section ``[frames]``.
    base
        Folder that relative paths start from.
    camera
        Pattern and levels, as a calibration knows them, where neither the files nor the settings tell them.

    Raises
    ------
    FrameError
        No file matches, a frame has another size than the first, the lights have different numbers of frames, or a
        reference frame does not exist. A damaged file is left for `FrameSeries.read` to tell.
    """
    files = [list_frames(text, base) for text in settings.path]
    series = FrameSeries(lights=tuple(tuple(open_source(path, settings, camera) for path in paths) for paths in files))
    _check_counts(settings, series)
    _check_sizes(series)
    return series


def _check_counts(settings: FrameSettings, series: FrameSeries) -> None:
    counts = [sum(len(source) for source in sources) for sources in series.lights]
    if len(set(counts)) > 1:
        told = ", ".join(f"{text}: {count}" for text, count in zip(settings.path, counts, strict=True))
        raise FrameError(f"lights fired in succession need equal numbers of frames; given are {told}")
    if (last := max(settings.reference)) >= counts[0]:
        raise FrameError(f"frames.reference names frame {last}, but there are {counts[0]} (0 to {counts[0] - 1})")


def _check_sizes(series: FrameSeries) -> None:
    shapes = series.shapes()
    for first, (rows, columns) in shapes:
        for source, shape in shapes:
            if shape != (rows, columns):
                raise FrameError(
                    f"all frames must have one size: {source.path} has {shape[0]} rows of {shape[1]} pixels, "
                    f"{first.path} has {rows} of {columns}"
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
        files = [file for file in place.iterdir() if file.suffix.lower() in FRAME_ENDINGS and file.name[0] != "."]
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
