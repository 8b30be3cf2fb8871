"""In what units a result is told, and when its frames were taken: what its settings and the camera's files say."""

from __future__ import annotations

import logging

import numpy as np

from rgbmidic.fields.differences import reference_share
from rgbmidic.fields.units import Units
from rgbmidic.results.quantities import UNKNOWN_TIME
from rgbmidic.results.result import Result
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["frame_times", "reference_frames", "shared_part", "units_of"]

logger = logging.getLogger(__name__)

_DIFFERENT = 0.01
"""Share by which a stated rate may differ from that of the frames' stamps before it is told."""


def units_of(result: Result, scale: ScaleSettings | None = None) -> Units:
    """The units of a result, with its own ``[scale]`` or another one in its place."""
    scale = _scale(result) if scale is None else scale
    timed = frame_times(result, scale) is not None
    return Units(mm_per_pixel=scale.mm_per_pixel, mm_per_pixel_std=scale.mm_per_pixel_std, timed=timed)


def frame_times(result: Result, scale: ScaleSettings | None = None) -> FloatArray | None:
    """Time (T,) of each frame in seconds, from the trigger where the camera tells it; None where nobody knows.

    What the files tell of every frame, else the number of the frame over `frame_rate`, that of ``[scale]`` before the
    camera's.
    """
    scale = _scale(result) if scale is None else scale
    stamps, finished = result.time_ns, result.finished
    rate = scale.frame_rate or result.provenance.get("frame_rate")
    if finished.all() and (stamps != UNKNOWN_TIME).all():
        times = np.asarray(stamps * 1e-9)
        steps = np.diff(times) / np.maximum(np.diff(result.number), 1)
        if scale.frame_rate and len(steps) and abs(float(np.median(steps)) * scale.frame_rate - 1) > _DIFFERENT:
            logger.warning(
                "scale.frame_rate states %g frames per second, the frames' own times %g: these are taken",
                scale.frame_rate,
                1 / float(np.median(steps)),
            )
        return times
    return np.asarray(result.number / rate) if rate and finished.all() else None


def reference_frames(result: Result) -> BoolArray:
    """Which frames (T,) belong to the reference."""
    chosen = np.zeros(len(result), dtype=bool)
    chosen[list(result.provenance["references"])] = True
    return chosen


def shared_part(result: Result) -> float:
    """Share of every frame's variance that the reference puts into all alike (`rgbmidic.fields.differences`)."""
    return reference_share(len(result.setting("frames", "reference", [0])))


def _scale(result: Result) -> ScaleSettings:
    return ScaleSettings(**result.provenance.get("settings", {}).get("scale", {}))
