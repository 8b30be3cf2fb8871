"""In what units a result is told, and when its frames were taken: what its settings and the camera's files say."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.results.quantities import UNKNOWN_TIME
from rgbmidic.results.result import Result
from rgbmidic.settings import ProbeSettings, ScaleSettings, read_section
from rgbmidic.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from rgbmidic.fields.units import Units

__all__ = ["exposure", "frame_times", "probes_of", "reference_frames", "scale_of", "shared_part", "units_of"]

logger = logging.getLogger(__name__)

_DIFFERENT = 0.01
"""Share by which a stated rate may differ from that of the frames' stamps before it is told."""


def scale_of(result: Result) -> ScaleSettings:
    """The ``[scale]`` that a result was measured with."""
    return read_section(ScaleSettings, "scale", result.provenance.get("settings", {}).get("scale", {}))


def probes_of(result: Result) -> ProbeSettings:
    """The ``[probes]`` that a result was measured with."""
    return read_section(ProbeSettings, "probes", result.provenance.get("settings", {}).get("probes", {}))


def units_of(result: Result, scale: ScaleSettings | None = None) -> Units:
    """The units of a result, with its own ``[scale]`` or another one in its place."""
    from rgbmidic.fields.units import Units

    scale = scale_of(result) if scale is None else scale
    return Units.of(scale, timed=frame_times(result, scale) is not None)


def frame_times(result: Result, scale: ScaleSettings | None = None) -> FloatArray | None:
    """Time (T,) of each frame in seconds, from the trigger where the camera tells it; None where nobody knows.

    What the files tell of every frame, else the number of the frame over `frame_rate`, that of ``[scale]`` before the
    camera's. NaN for frames that are not measured yet.
    """
    scale = scale_of(result) if scale is None else scale
    there = result.finished
    stamps, numbers = result.time_ns[there], result.number[there]
    if (stamps == UNKNOWN_TIME).any():
        own = result.provenance.get("frame_rate")
        rate = scale.frame_rate or own
        seconds = numbers / rate if rate else None
        if own:
            _compare(own, scale.frame_rate, "the camera was set to %.6g: the former is taken")
    else:
        seconds = stamps * 1e-9
        if len(seconds) > 1:
            own = float(np.median(np.maximum(np.diff(numbers), 1) / np.diff(seconds)))
            _compare(own, scale.frame_rate, "the frames' own times %.6g: these are taken")
    if seconds is None:
        return None
    times = np.full(len(result), np.nan)
    times[there] = seconds
    return times


def _compare(own: float, stated: float | None, told: str) -> None:
    """Tell where a stated frame rate is not that of the files."""
    if stated and abs(own / stated - 1) > _DIFFERENT:
        logger.warning(f"scale.frame_rate states %g frames per second, {told}", stated, own)


def exposure(result: Result) -> float | None:
    """Time in seconds that each frame collects light; None where the files do not tell it."""
    told = result.provenance.get("exposure_ns")
    return None if told is None else float(told) * 1e-9


def reference_frames(result: Result) -> BoolArray:
    """Which frames (T,) belong to the reference."""
    chosen = np.zeros(len(result), dtype=bool)
    chosen[list(result.provenance["references"])] = True
    return chosen


def shared_part(result: Result) -> float:
    """Share of every frame's variance that the reference puts into all alike (`rgbmidic.fields.differences`)."""
    from rgbmidic.fields.differences import reference_share

    return reference_share(len(result.setting("frames", "reference", [0])))
