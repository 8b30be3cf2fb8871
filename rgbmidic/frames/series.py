"""The frames of a test in their order: which files, how many, of one size, each with its name and fingerprint."""

from __future__ import annotations

import hashlib
import logging
import math
import os
from bisect import bisect_right
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import accumulate
from pathlib import Path

from rgbmidic.errors import ConfigurationError, FrameError, printable
from rgbmidic.frames.data import ChannelFrame, Mosaic, Recording, Window
from rgbmidic.frames.formats import open_source
from rgbmidic.frames.metadata import CameraMetadata
from rgbmidic.frames.names import NamedFiles, list_frames
from rgbmidic.frames.source import FrameSource, file_fingerprint
from rgbmidic.settings import FrameSettings

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameSeries:
    """The states of a test, read one by one, in any order; they count from 0 over all files.

    Attributes
    ----------
    lights : tuple of tuple of FrameSource
        The sources of each light fired in succession; a single tuple for simultaneous coloured lights, and for lights
        that fire in turn before a camera which records one series.
    numbers
        Number of the frame that each state is, from 0 and with gaps where frames are missing; by default the states
        are numbered through.
    n_lights
        Number of lights that fire in turn in one series.
    first_frames
        Index in that series of the frame that each state begins with; by default every `n_lights`-th.
    selected
        The states that are to be measured; by default all.

    Examples
    --------
    >>> series = open_series(FrameSettings(path="frames/*.dng"))
    >>> series.selected == range(len(series))
    True
    """

    lights: tuple[tuple[FrameSource, ...], ...]
    numbers: Sequence[int] = ()
    n_lights: int = 1
    first_frames: Sequence[int] = ()
    selected: range = range(0)
    _ends: tuple[tuple[int, ...], ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Count the frames and fill in what follows from their number."""
        ends = tuple(tuple(accumulate(len(source) for source in sources)) for sources in self.lights)
        object.__setattr__(self, "_ends", ends)
        object.__setattr__(
            self, "first_frames", self.first_frames or range(0, ends[0][-1] - self.n_lights + 1, self.n_lights)
        )
        object.__setattr__(self, "numbers", self.numbers or range(len(self)))
        object.__setattr__(self, "selected", self.selected or range(len(self)))

    def __len__(self) -> int:
        """Return the number of mechanical states."""
        return len(self.first_frames)

    def __getitem__(self, index: int) -> tuple[Mosaic | ChannelFrame, ...]:
        """Return the state `index`, as `read` gives it: a series of files is a frame source as any other."""
        return self.read(index)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every frame, from the first header that can be read.

        Raises
        ------
        FrameError
            None can be read.
        """
        return next((shape for _, shape in self.shapes()), None) or self.lights[0][0].shape

    @property
    def recording(self) -> Recording:
        """Recording of the frames, as the first file states it."""
        return self.lights[0][0].recording

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks of the headers for the user, each once, with the file or files.

        Of files of one frame each the first is looked at: one camera wrote them all.
        """
        names_by_remark: dict[str, list[str]] = {}
        stacks = any(len(source) > 1 for sources in self.lights for source in sources)
        for source in (
            representative for sources in self.lights for representative in (sources if stacks else sources[:1])
        ):
            for remark in source.remarks:
                names_by_remark.setdefault(remark, []).append(printable(source.path.name))
        suffix = {
            remark: f" and {len(names) - 1} more" if len(names) > 1 else "" for remark, names in names_by_remark.items()
        }
        return tuple(f"{names[0]}{suffix[remark]}: {remark}" for remark, names in names_by_remark.items())

    @property
    def n_lost(self) -> int:
        """Number of frames missing between the first and the last of those that are chosen."""
        numbers = [self.numbers[index] for index in self.selected]
        step = self.selected.step
        return max((numbers[-1] - numbers[0]) // step + 1 - len(numbers), 0) if numbers else 0

    def shapes(self) -> Iterator[tuple[FrameSource, tuple[int, int]]]:
        """Yield every source whose header can be read, with its rows and columns.

        Yields
        ------
        source, shape : FrameSource, tuple of int
        """
        for source in (source for sources in self.lights for source in sources):
            try:
                yield source, source.shape
            except FrameError:
                continue

    @property
    def packages(self) -> list[str]:
        """Packages whose version decides on what is read (`FrameSource.packages`)."""
        return sorted({package for sources in self.lights for source in sources for package in source.packages})

    def read(self, index: int, window: Window | None = None) -> tuple[Mosaic | ChannelFrame, ...]:
        """Read state `index` or a part of it: one frame per light fired in succession, else a single one.

        Parameters
        ----------
        index
            Index of the state.
        window
            The part of it that is read; None: all of it.

        Returns
        -------
        tuple of Mosaic or ChannelFrame

        Raises
        ------
        FrameError
            A file is damaged or not what the settings state.
        IndexError
            There is no such state.
        """
        return tuple(source.read(inner, window) for source, inner in self._locate(index))

    def missing_lights(self) -> str:
        """Name the lights of which no file exists any more, by first file and number of files; else empty.

        Returns
        -------
        str
        """
        exists = os.path.exists  # which raises nothing
        missing = [sources for sources in self.lights if not any(exists(source.path) for source in sources)]
        return "; ".join(f"{sources[0].path} and all {len(sources)} files of its series" for sources in missing)

    def name(self, index: int) -> str:
        """Return the name of state `index`; those of several lights in succession joined by " + ".

        Parameters
        ----------
        index
            Index of the state.

        Returns
        -------
        str
        """
        return " + ".join(source.name(inner) for source, inner in self._locate(index))

    def time_ns(self, index: int) -> int | None:
        """Return when state `index` was taken (the first light's frame), in ns from the trigger; None: not stated.

        Parameters
        ----------
        index
            Index of the state.

        Returns
        -------
        int or None
        """
        source, inner = self._locate(index)[0]
        times = source.recording.times_ns
        return None if times is None else int(times[inner])

    def inputs(self, index: int, window: Window | None = None) -> dict[str, str]:
        """Return path and fingerprint of every file that state `index` comes from.

        Where a `window` of it is read, the fingerprint is that of the sampled content (`file_fingerprint`), so that the
        file is not read whole for it.

        Parameters
        ----------
        index
            Index of the state.
        window
            The part of it that is read; None: all of it.

        Returns
        -------
        dict of str to str
        """
        is_windowed = window is not None and not window.is_whole
        sources = [source for source, _ in self._locate(index)]
        return {
            printable(frame_source.path): file_fingerprint(frame_source.path)
            if is_windowed
            else frame_source.fingerprint
            for frame_source in sources
        }

    def fingerprint(self, unread: Collection[str] = ()) -> tuple[str, tuple[str, ...]]:
        """Return the SHA-256 of names and sampled content of all files, and the names of those that count without it.

        The sampled content is that of `file_fingerprint`, the order that of the files. With their name alone count
        those that cannot be read, which fail their own frames only, and those named as `unread` when the fingerprint
        was made that this one is compared with.

        Parameters
        ----------
        unread
            Names of files that count with their name alone.

        Returns
        -------
        digest : str
        without : tuple of str
        """
        digest, without = hashlib.sha256(), []
        for source in (source for sources in self.lights for source in sources):
            name, content = printable(source.path.name), "unread"
            if name not in unread:
                with suppress(FrameError):
                    content = file_fingerprint(source.path)
            if content == "unread":
                without.append(name)
            digest.update(f"{name}\0{content}\n".encode())
        return digest.hexdigest(), tuple(without)

    def _locate(self, index: int) -> list[tuple[FrameSource, int]]:
        """Return source, and frame in it, of every light of a state."""
        if not 0 <= index < len(self):
            raise IndexError(f"there is no frame {index} in a series of {len(self)}")
        begin, located = self.first_frames[index], []
        for light in range(max(self.n_lights, len(self.lights))):
            series, frame = (0, begin + light) if self.n_lights > 1 else (light, begin)
            position = bisect_right(self._ends[series], frame)
            located.append(
                (self.lights[series][position], frame - (self._ends[series][position - 1] if position else 0))
            )
        return located


def open_series(
    settings: FrameSettings, base: Path | str = ".", camera: CameraMetadata | None = None, *, in_order: bool = True
) -> FrameSeries:
    """Find the frames of a test and check that they belong together, from their headers alone.

    Parameters
    ----------
    settings
        The section ``[frames]``.
    base
        Folder that relative paths start from.
    camera
        What a calibration states of them; it must agree with files and settings, and fills in what neither states.
    in_order
        Whether the frames follow one another in time, so that numbers missing in their names or in the camera's count
        are reported (as a warning) and kept as gaps in `FrameSeries.numbers`.

    Returns
    -------
    FrameSeries

    Raises
    ------
    ConfigurationError
        `frames.path` is empty.
    FrameError
        No file matches, a movie's header is damaged, a frame has another size than the first, the lights have different
        frames, or a reference frame or the first or last frame does not exist. A damaged file of one frame is left for
        `FrameSeries.read` to report.

    Examples
    --------
    >>> series = open_series(FrameSettings(path="frames/*.dng"))
    >>> series.shape == series.read(0)[0].values.shape
    True
    """
    if not settings.path:
        raise ConfigurationError(
            "frames.path must name the frame files; it is empty, which is for a frame source that a script gives "
            "(rgbmidic.measure(settings, out, source=...))"
        )
    opened = [[open_source(path, settings, camera) for path in list_frames(text, base)] for text in settings.path]
    # a movie in two files, samples and header, is one source where a pattern matches both
    lights = tuple(tuple({source.path: source for source in sources}.values()) for sources in opened)
    for text, sources in zip(settings.path, lights, strict=True):
        _check_sources(text, sources, settings.lights)
    counts = [sum(map(len, sources)) for sources in lights]
    if len(set(counts)) > 1:
        numbers_given = ", ".join(f"{text}: {count}" for text, count in zip(settings.path, counts, strict=True))
        raise FrameError(f"lights fired in succession need equal numbers of frames; given are {numbers_given}")
    begins: Sequence[int] = ()
    numbers = _numbers(settings, lights) if in_order else ()
    if settings.lights > 1:
        begins, numbers = _complete_states(numbers or range(counts[0]), settings.lights)
    series = FrameSeries(lights=lights, numbers=numbers, n_lights=settings.lights, first_frames=begins)
    shapes = series.shapes()
    for first, (rows, columns) in shapes:
        for source, shape in shapes:
            if shape != (rows, columns):
                raise FrameError(
                    f"all frames must have one size: {source.path} has {shape[0]} rows of {shape[1]} pixels, "
                    f"{first.path} has {rows} of {columns}"
                )
    return replace(series, selected=selected_frames(settings, len(series)))


def _check_sources(text: str, sources: Sequence[FrameSource], lights: int) -> None:
    """Refuse a frame in two files, planes that are not the lights', and files after an unknown number of frames.

    Raises
    ------
    FrameError
        So they are.
    """
    kinds = {source.path.with_suffix(""): source.path for source in sources}
    for source in sources:
        if (twin := kinds[source.path.with_suffix("")]) != source.path:
            pair = f"{text} stands for {source.path.name} and {twin.name}: is that one frame in two files?"
            raise FrameError(f"{pair} State the pattern of one kind of them, as in *{source.path.suffix}")
        if (planes := source.recording.planes) not in (1, lights):
            raise FrameError(
                f"{source.path} holds {source.recording.planes_description} of {len(source) // planes} times: state "
                f"frames.lights = {planes} where each shows one light, else save one of them alone; lights is {lights}"
            )
    if max(map(len, sources)) > 1:
        for source in sources[:-1]:
            if source.shape and not source.recording.count_is_certain:  # a header that cannot be read raises an error
                raise FrameError(
                    f"{source.path} is truncated or still being written: its list of frames ends early, so the numbers "
                    f"of the frames in {sources[-1].path.name} are not known; leave it out, or read it alone"
                )


def _complete_states(numbers: Sequence[int], lights: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return first frame and number of every state of which no light's frame is lost, where the lights fire in turn."""
    index_of = {number: index for index, number in enumerate(numbers)}
    complete = [
        (index_of[number], number // lights)
        for number in numbers
        if number % lights == 0 and all(number + light in index_of for light in range(lights))
    ]
    if not complete:
        raise FrameError(f"frames.lights states {lights} lights in turn, but no {lights} frames make a state")
    begins, states = zip(*complete, strict=True)
    return begins, tuple(state - states[0] for state in states)


def selected_frames(settings: FrameSettings, count: int) -> range:
    """Return the states that the settings choose.

    Raises
    ------
    FrameError
        The first, the last or a frame of the reference does not exist.
    """
    last = count - 1 if settings.last is None else settings.last
    for key, index in (("reference", max(settings.reference)), ("last", last), ("first", settings.first)):
        if index >= count:
            raise FrameError(f"frames.{key} names frame {index}, but there are {count} (0 to {count - 1})")
    return range(settings.first, last + 1, settings.step)


def _numbers(settings: FrameSettings, lights: Sequence[Sequence[FrameSource]]) -> Sequence[int]:
    """Return the frame numbers that the names or the headers of all lights hold; empty where they hold none."""
    numbers_by_pattern: dict[str, tuple[int, ...]] = {}
    for text, sources in zip(settings.path, lights, strict=True):
        if counts := _counts(text, sources):
            scale = math.lcm(*(count.denominator for count in counts))
            step = Fraction(math.gcd(*(int(scale * (count - counts[0])) for count in counts)) or 1, scale)
            numbers = numbers_by_pattern[text] = tuple(int((count - counts[0]) / step) for count in counts)
            # where more numbers are missing than there are, somebody chose some frames
            if len(counts) <= numbers[-1] < 2 * len(counts):
                missing = [counts[0] + step * number for number in sorted(set(range(numbers[-1])) - set(numbers))]
                gaps = f"{len(missing)} in the numbering, {_listed(missing)}; the frames after keep their numbers"
                logger.warning("frames are missing from %s: %s", text, gaps)
    if len(set(numbers_by_pattern.values())) > 1:
        available = "; ".join(f"{text}: {_listed(numbers)}" for text, numbers in numbers_by_pattern.items())
        raise FrameError(
            f"lights fired in succession need the same frames; those there are, counted from 0, {available}"
        )
    return next(iter(numbers_by_pattern.values()), ())


def _counts(text: str, sources: Sequence[FrameSource]) -> tuple[Fraction, ...]:
    """Return the camera's numbers in a movie's header, else those in the names; empty where there are none."""
    if len(sources) == 1 and len(sources[0]) > 1:
        return tuple(map(Fraction, sources[0].recording.relative_numbers.tolist()))
    files = NamedFiles.from_files([source.path for source in sources])
    if files.doubt:
        logger.warning("the order of %s is uncertain (%s): taken as %s", text, files.doubt, files.first_and_last)
    return () if any(len(source) > 1 for source in sources) else files.counts


def _listed(numbers: Sequence[int | Fraction], max_count: int = 10) -> str:
    texts = [str(number) if number == int(number) else str(float(number)) for number in numbers[:max_count]]
    return ", ".join(texts) + (", ..." if len(numbers) > max_count else "")
