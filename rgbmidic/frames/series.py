"""The frames of a test in their order: which files, how many, of one size, each with its name and fingerprint."""

from __future__ import annotations

import glob
import logging
import math
import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from pathlib import Path

from rgbmidic.errors import FrameError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.formats import FRAME_ENDINGS, Camera, advice, open_source
from rgbmidic.frames.source import FrameSource
from rgbmidic.settings import FrameSettings

logger = logging.getLogger(__name__)

__all__ = ["FrameSeries", "list_frames", "open_series"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSeries:
    """The states of a test, read one by one, in any order.

    Attributes
    ----------
    lights : tuple of tuple of FrameSource
        The sources of each light fired in succession; a single tuple for simultaneous coloured lights.
    numbers
        Number of the frame that each state is, from 0 and with gaps where frames are missing; by default the states
        are numbered through.
    """

    lights: tuple[tuple[FrameSource, ...], ...]
    numbers: Sequence[int] = ()
    _ends: tuple[tuple[int, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ends = tuple(tuple(accumulate(len(source) for source in sources)) for sources in self.lights)
        object.__setattr__(self, "_ends", ends)
        object.__setattr__(self, "numbers", self.numbers or range(len(self)))

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


def open_series(
    settings: FrameSettings, base: Path | str = ".", camera: Camera | None = None, *, in_order: bool = True
) -> FrameSeries:
    """Find the frames of a test and check that they belong together, from their headers alone.

    Parameters
    ----------
    settings
        The section ``[frames]``.
    base
        Folder that relative paths start from.
    camera
        Pattern and levels, as a calibration knows them, where neither the files nor the settings tell them.
    in_order
        Whether the frames follow one another in time, so that numbers missing in their names are told (as a warning)
        and kept as gaps in `FrameSeries.numbers`.

    Raises
    ------
    FrameError
        No file matches, a frame has another size than the first, the lights have different frames, or a reference
        frame does not exist. A damaged file is left for `FrameSeries.read` to tell.
    """
    files = [list_frames(text, base) for text in settings.path]
    lights = tuple(tuple(open_source(path, settings, camera) for path in paths) for paths in files)
    series = FrameSeries(lights=lights)
    _check_counts(settings, series)
    _check_sizes(series)
    return replace(series, numbers=_numbers(settings, lights)) if in_order else series


def _check_counts(settings: FrameSettings, series: FrameSeries) -> None:
    counts = [sum(len(source) for source in sources) for sources in series.lights]
    if len(set(counts)) > 1:
        told = ", ".join(f"{text}: {count}" for text, count in zip(settings.path, counts, strict=True))
        raise FrameError(f"lights fired in succession need equal numbers of frames; given are {told}")
    if (last := max(settings.reference)) >= counts[0]:
        raise FrameError(f"frames.reference names frame {last}, but there are {counts[0]} (0 to {counts[0] - 1})")


def _numbers(settings: FrameSettings, lights: Sequence[Sequence[FrameSource]]) -> Sequence[int]:
    """Frame numbers that the names of all lights tell; empty where they tell none."""
    found: dict[str, tuple[int, ...]] = {}
    for text, sources in zip(settings.path, lights, strict=True):
        if counts := _counts(sources):
            step = math.gcd(*(count - counts[0] for count in counts))
            found[text] = tuple((count - counts[0]) // step for count in counts)
            _tell_gaps(text, counts, step)
    if len(set(found.values())) > 1:
        told = "; ".join(f"{text}: {_listed(numbers)}" for text, numbers in found.items())
        raise FrameError(f"lights fired in succession need the same frames; those there are, counted from 0, {told}")
    return next(iter(found.values()), ())


def _counts(sources: Sequence[FrameSource]) -> tuple[int, ...]:
    """Numbers in the names; empty where they are no counter: a counter is the only thing in which the names differ."""
    names = [re.split(r"([0-9]+)", str(source.path)) for source in sources]
    if any(len(source) > 1 for source in sources) or len({len(name) for name in names}) > 1:
        return ()
    differing = [part for part in zip(*names, strict=True) if len(set(part)) > 1]
    if len(differing) != 1 or not differing[0][0].isdecimal():
        return ()
    counts = tuple(int(part) for part in differing[0])
    return counts if len(set(counts)) == len(counts) else ()


def _tell_gaps(text: str, counts: tuple[int, ...], step: int) -> None:
    """A warning for missing numbers; where they are more than those that are there, somebody chose some frames."""
    expected = range(counts[0], counts[-1] + 1, step)
    if len(counts) < len(expected) <= 2 * len(counts):
        missing = sorted(set(expected) - set(counts))
        told = f"{len(missing)} in the numbering, {_listed(missing)}; the frames after keep their numbers"
        logger.warning("frames are missing from %s: %s", text, told)


def _listed(numbers: Sequence[int], most: int = 10) -> str:
    return ", ".join(map(str, numbers[:most])) + (", ..." if len(numbers) > most else "")


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
        found = sorted(file for file in place.iterdir() if file.name[0] != ".")
        files = [file for file in found if file.suffix.lower() in FRAME_ENDINGS]
    else:
        found = files = _matching(Path(pattern), Path(base))
    files = [file for file in files if file.is_file() or not file.exists()]  # a link to nothing is told when it is read
    if not files:
        what = "a folder without frames" if place.is_dir() else "no file matches"
        other = next((f"; {file.name} is {text}" for file in found if (text := advice(file))), "")
        raise FrameError(f"no frames: {what}: {pattern} (looked for in {Path(base).resolve()}){other}")
    return tuple(sorted(files, key=_natural_key))


def _matching(pattern: Path, base: Path) -> list[Path]:
    """Files that match; what exists of the pattern's beginning is taken literally, brackets included."""
    parts = list(pattern.parts)
    while parts and (base / parts[0]).exists():
        base /= parts.pop(0)
    if not parts:
        return [base]
    return [base / match for match in glob.glob(str(Path(*parts)), root_dir=base, recursive=True)]  # noqa: PTH207


def _natural_key(path: Path) -> tuple[list[tuple[int, str]], str]:
    parts = re.split(r"([0-9]+)", str(path).casefold())
    keys = [(int(part), "") if position % 2 else (0, part) for position, part in enumerate(parts)]
    return keys, str(path)
