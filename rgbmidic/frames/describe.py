"""Description of a file, a folder or a pattern of raw frames from its headers; one of its frames as a plain TIFF."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames.formats import reader_name
from rgbmidic.frames.images import TIFF_ENDINGS, write_tiff
from rgbmidic.frames.series import FrameSeries, open_series
from rgbmidic.settings import FrameSettings

__all__ = ["Description", "describe", "save_frame"]

_SECOND = 1e9


@dataclass(frozen=True, slots=True, kw_only=True)
class Description:
    """What a reader sees; None where neither the files nor the user state it.

    Attributes
    ----------
    reader
        Format that the files, or the first of them, are read as.
    count
        Number of frames in all files.
    shape
        Rows and columns.
    kind, cfa
        What the frames are, and the Bayer pattern of their first pixels.
    bit_depth
        Bits of a sample: of the camera where the file states it, else of the file.
    black_level, white_level
        Grey levels (DN) that a run takes, stated or not; four black levels where they differ over the positions of the
        2x2 cell.
    frame_rate
        Frames per second, as the camera was set.
    exposure
        Time in s that each frame collects light.
    trigger
        Index of the frame at the trigger; it may lie before the first or behind the last.
    lost_frames
        Number of frames missing between the first and the last.
    first_time_ns, last_time_ns
        When the first and the last frame were taken, in ns from the trigger.
    warnings
        What else the header states that a user should know, and why the last frame cannot be read.
    """

    reader: str
    count: int
    shape: tuple[int, int]
    kind: str | None
    cfa: str | None
    bit_depth: int
    black_level: float | tuple[float, ...]
    white_level: float
    frame_rate: float | None
    exposure: float | None
    trigger: int | None
    lost_frames: int | None
    first_time_ns: int | None
    last_time_ns: int | None
    warnings: tuple[str, ...]

    def as_json(self) -> str:
        """Return a JSON object, with null for what is not known."""
        return json.dumps(asdict(self), indent=2)

    def as_text(self) -> str:
        """Return one line for each thing that is known."""
        known = {name: value for name, value in asdict(self).items() if value is not None and name != "warnings"}
        return "\n".join(f"{name:<15}{_text(value)}" for name, value in known.items())


def describe(settings: FrameSettings) -> Description:
    """Describe frames from their headers, the first and the last of them.

    Parameters
    ----------
    settings
        A file, a folder or a pattern, and what the files do not state.

    Returns
    -------
    Description

    Raises
    ------
    FrameError
        Nothing can be read, or what is stated contradicts the file.
    """
    series = _opened(settings)
    source, recording = series.lights[0][0], series.recording
    stored = source.stored(0)
    frame, *_ = series.read(0)
    cfa, levels = getattr(frame, "cfa", None), tuple(frame.black_level.ravel().tolist())
    warnings = list(recording.remarks)
    try:
        series.read(len(series) - 1)
    except FrameError as error:  # a movie that is truncated, or still being written
        warnings.append(str(error))
    numbered = recording.times_ns is not None or recording.numbers is not None or len(series.lights[0]) > 1
    return Description(
        reader=reader_name(source),
        count=len(series),
        shape=(frame.values.shape[-2], frame.values.shape[-1]),
        kind="bayer" if cfa else settings.kind or stored.kind,
        cfa=cfa,
        bit_depth=recording.bit_depth or stored.bits or 8 * stored.values.itemsize,
        black_level=levels[0] if len(set(levels)) == 1 else levels,
        white_level=frame.white_level,
        frame_rate=recording.frame_rate,
        exposure=None if recording.exposure_ns is None else recording.exposure_ns / _SECOND,
        trigger=recording.trigger,
        lost_frames=series.lost if numbered else None,
        first_time_ns=series.time_ns(0),
        last_time_ns=series.time_ns(len(series) - 1),
        warnings=tuple(warnings),
    )


def save_frame(settings: FrameSettings, index: int, path: Path, *, overwrite: bool = False) -> None:
    """Write the raw values of frame `index` as a 16-bit TIFF.

    Raises
    ------
    FrameError
        The frame cannot be read.
    InputError
        There is no such frame, or the file exists and is not to be replaced.
    """
    series = _opened(settings)
    if not 0 <= index < len(series):
        raise InputError(f"there is no frame {index}: {settings.path[0]} holds {len(series)} (0 to {len(series) - 1})")
    if path.suffix.lower() not in TIFF_ENDINGS:
        raise InputError(f"a frame is saved as .tif, not as {path}")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; --overwrite replaces it")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent} to save {path.name} in")
    write_tiff(path, series.read(index)[0])


def _opened(settings: FrameSettings) -> FrameSeries:
    """Open the frames; a mosaic whose pattern nobody states is read as it is, one grey level at every pixel."""
    series = open_series(settings)
    if settings.kind is None and settings.cfa is None:
        stored = series.lights[0][0].stored(0)
        if stored.kind is None and stored.values.ndim == 2:
            return open_series(replace(settings, kind="monochrome"))
    return series


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
