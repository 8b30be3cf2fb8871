"""Properties of frame files before a test: what a reader finds in a file, a folder or a pattern; a frame as a TIFF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from rgbmidic.errors import FrameError, InputError
from rgbmidic.frames import FrameSeries, frame_formats, list_frames, open_series, open_source, write_tiff
from rgbmidic.frames.tiff import TIFF_ENDINGS
from rgbmidic.settings import FrameSettings


def describe(settings: FrameSettings) -> dict[str, Any]:
    """Describe frames from their headers, the first and the last of them; None where nothing states it.

    Parameters
    ----------
    settings
        A file, a folder or a pattern, and what the files do not state.

    Returns
    -------
    dict
        ``reader``: format of the first file; ``count``: frames in all files; ``shape``: rows and columns; ``kind``,
        ``cfa``: what the frames are, and the Bayer pattern of their first pixels; ``bit_depth``: bits of a sample, of
        the camera where the file states it, else of the file; ``black_level``, ``white_level``: grey levels (DN) that a
        run takes, stated or not, four black levels where they differ over the positions of the 2x2 cell;
        ``frame_rate``: frames per second, as the camera was set; ``exposure``: seconds that each frame collects light;
        ``trigger``: index of the frame at the trigger, which may lie before the first or behind the last;
        ``lost_frames``: frames missing between the first and the last; ``first_time_ns``, ``last_time_ns``: when these
        were taken, in ns from the trigger; ``warnings``: what else the header states that a user should know, and why
        the last frame cannot be read.

    Raises
    ------
    FrameError
        Nothing can be read, or what is stated contradicts the file.
    """
    series = _open_described(settings)
    source, recording = series.lights[0][0], series.recording
    stored = source.stored(0)
    frame, *_ = series.read(0)
    cfa, levels = getattr(frame, "cfa", None), tuple(frame.black_level.ravel().tolist())
    warnings = list(series.remarks)
    if recording.planes > 1:
        warnings.append(f"it holds {recording.planes_description} of each time: frames.lights = {recording.planes}")
    try:
        series.read(len(series) - 1)
    except FrameError as error:  # a movie that is truncated, or still being written
        warnings.append(str(error))
    has_numbers = recording.times_ns is not None or recording.numbers is not None or len(series.lights[0]) > 1
    return {
        "reader": next(
            (frame_format.name for frame_format in frame_formats() if frame_format.source is type(source)), "unknown"
        ),
        "count": len(series),
        "shape": frame.values.shape[-2:],
        "kind": "bayer" if cfa else settings.kind or stored.kind,
        "cfa": cfa,
        "bit_depth": recording.bit_depth or stored.bits or 8 * stored.values.itemsize,
        "black_level": levels[0] if len(set(levels)) == 1 else levels,
        "white_level": frame.white_level,
        "frame_rate": recording.frame_rate,
        "exposure": None if recording.exposure_ns is None else recording.exposure_ns / 1e9,
        "trigger": recording.trigger,
        "lost_frames": series.n_lost if has_numbers else None,
        "first_time_ns": series.time_ns(0),
        "last_time_ns": series.time_ns(len(series) - 1),
        "warnings": tuple(warnings),
    }


def description_text(description: Mapping[str, Any]) -> str:
    """Return one line for each known property of frames (`describe`)."""

    def text(value: object) -> str:
        if isinstance(value, tuple):
            return ", ".join(map(text, value))
        return f"{value:.6g}" if isinstance(value, float) else str(value)

    available = {name: value for name, value in description.items() if value is not None and name != "warnings"}
    return "\n".join(f"{name:<15}{text(value)}" for name, value in available.items())


def save_frame(settings: FrameSettings, index: int, path: Path, *, overwrite: bool = False) -> None:
    """Write the raw values of frame `index` as a 16-bit TIFF.

    Raises
    ------
    FrameError
        The frame cannot be read.
    InputError
        There is no such frame, or the file exists and is not to be replaced.
    """
    series = _open_described(settings)
    if not 0 <= index < len(series):
        raise InputError(f"there is no frame {index}: {settings.path[0]} holds {len(series)} (0 to {len(series) - 1})")
    if path.suffix.lower() not in TIFF_ENDINGS:
        raise InputError(f"a frame is saved as .tif, not as {path}")
    if path.exists() and not overwrite:
        raise InputError(f"{path} exists already; `overwrite=True` replaces it")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent} to save {path.name} in")
    write_tiff(path, series.read(index)[0])


def _open_described(settings: FrameSettings) -> FrameSeries:
    """Open the frames; a mosaic whose pattern nobody states is read as it is, one grey level at every pixel."""
    first = open_source(list_frames(settings.path[0])[0], settings)
    if (planes := first.recording.planes) > 1:
        settings = replace(settings, kind="monochrome", lights=planes)
    series = open_series(settings)
    if settings.kind is None and settings.cfa is None:
        stored = series.lights[0][0].stored(0)
        if stored.kind is None and stored.values.ndim == 2:
            return open_series(replace(settings, kind="monochrome"))
    return series
