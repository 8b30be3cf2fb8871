"""Noise floor of a test: what the fields of its static frames scatter by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.results.quantities import FAILED
from rgbmidic.results.result_in_units import ResultInUnits


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseFloor:
    """Noise floor: standard deviation of the fields of static frames, as of a single frame against the reference.

    Attributes
    ----------
    count
        Number of static frames.
    single_frame
        Of u, v (in the unit of `ResultInUnits.units`), exx, eyy and exy: the rms over the nodes.
    common_mode
        Of the same: the standard deviation of the mean over the nodes, which is what all nodes have in common, such as
        vibration.
    """

    count: int
    single_frame: dict[str, float]
    common_mode: dict[str, float]


def noise_floor(physical: ResultInUnits, max_frames: int = 50) -> NoiseFloor | None:
    """Estimate the noise floor from the frames of the reference.

    The reference is the mean of n frames; the differences of these frames among each other do not depend on it. Another
    frame scatters against the mean by sqrt(1 + 1/n) more than they do around their own mean.

    Parameters
    ----------
    physical
        The result in the units of its scale.
    max_frames
        Static frames that are read at most. A standard deviation over n frames and N nodes has the relative
        uncertainty 1 / sqrt(2 n N) for independent nodes: below 1 % from 100 nodes on.

    Returns
    -------
    NoiseFloor or None
        None where fewer than two frames of the reference are measured.
    """
    result, names = physical.result, (*physical.components, "exx", "eyy", "exy")
    static = [frame_index for frame_index in result.provenance["references"] if result.status[frame_index] != FAILED][
        :max_frames
    ]
    if len(static) < 2:
        return None
    fields = np.array([[values[name] for name in names] for values in map(physical.frame, static)], dtype=np.float64)
    variances = np.ma.masked_invalid(fields.var(axis=0, ddof=1)).mean(axis=1)
    common_variance = np.ma.masked_invalid(fields).mean(axis=2).filled(np.nan).var(axis=0, ddof=1)
    single = 1 + 1 / len(result.setting("frames", "reference", static))
    std_rows = np.sqrt(single * np.array([variances.filled(np.nan), common_variance])).tolist()
    single_frame, common_mode = (dict(zip(names, deviations, strict=True)) for deviations in std_rows)
    return NoiseFloor(count=len(static), single_frame=single_frame, common_mode=common_mode)
