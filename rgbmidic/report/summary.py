"""Numbers of a test report: quantiles of the fields over time, noise floor, speckle size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.report.style import time_axis
from rgbmidic.results import QUANTITIES, Maps, Result, speckle_diameter
from rgbmidic.results.quantities import FAILED
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.results.physical import Physical


class TimeHistory:
    """Quantiles over the nodes of the fields of some frames, read one frame after the other.

    Parameters
    ----------
    physical
        The result in the units of its scale.
    frames
        Indices of the frames in the result.

    Attributes
    ----------
    frames : tuple of int, length F
        Indices of the frames in the result.
    axis : tuple of ndarray, shape (F,), and str
        Times, or numbers of the frames where no time is known, and the label of the axis.
    timed : bool
        Whether the times are known.
    symbols : dict
        Symbol of each quantity.
    quantiles : dict
        Of each quantity the 5 %, 50 % and 95 % quantile over the nodes, shape (F, 3); NaN where nothing is measured.
    fractions : ndarray, shape (F, S)
        Fraction of the nodes with each `node_status`.
    fastest : float
        Largest velocity of a node between two neighbouring ones of these frames, px per unit of time; 0 where unknown.

    Raises
    ------
    ResultError
        A frame is damaged.
    """

    def __init__(self, physical: Physical, frames: Sequence[int]) -> None:
        self.frames, self.timed, times = tuple(frames), physical.units.timed, physical.times[list(frames)]
        read = ("u", "v", "u_std", "v_std", "exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std", "misfit")
        self.axis = time_axis(times if self.timed else None, physical.result.number[list(frames)])
        self.symbols = {
            name: entry.symbol for name, entry in Maps(result=physical.result, physical=physical).all.items()
        }
        self.quantiles = {name: np.full((len(times), 3), np.nan) for name in read}
        self.fractions = np.empty((len(times), len(QUANTITIES["node_status"].codes)))
        self.fastest, before = 0.0, np.array(np.nan)
        for place, frame in enumerate(frames):
            values = physical.frame(frame)
            for name, quantiles in self.quantiles.items():
                if (known := values[name][np.isfinite(values[name])]).size:
                    quantiles[place] = np.quantile(known, (0.05, 0.5, 0.95))
            codes = range(self.fractions.shape[1])
            self.fractions[place] = [(values["node_status"] == code).mean() for code in codes]
            here = np.stack([values["u"], values["v"]]) / physical.length
            if place:
                step = np.hypot(*(here - before)) / (times[place] - times[place - 1])
                self.fastest = max(self.fastest, float(np.nan_to_num(step).max(initial=0)))
            before = here

    def typical(self, name: str) -> FloatArray:
        """Return the quantiles over the nodes of a quantity, medians of the frames (3,); NaN where it is in none."""
        known = self._known(name)
        return np.asarray(np.median(known, axis=0)) if len(known) else np.full(3, np.nan)

    def extreme(self, name: str) -> float:
        """Return the value farthest from 0 of a quantity's median over the nodes; NaN where nothing is measured."""
        return float(max(self._known(name)[:, 1], key=abs, default=np.nan))

    def _known(self, name: str) -> FloatArray:
        rows = self.quantiles[name]
        return np.asarray(rows[np.isfinite(rows).all(axis=1)])

    def key_frames(self, count: int) -> tuple[int, ...]:
        """Select frames between which the field changes by about as much: its quantiles' path in equal parts."""
        fields = np.stack([self.quantiles[name] for name in ("u", "v")])
        seen = np.flatnonzero(np.isfinite(fields).all(axis=(0, 2)))
        if not len(seen):
            return ()
        path = np.cumsum(np.abs(np.diff(fields[:, seen], axis=1, prepend=0)).sum(axis=(0, 2)))  # from rest
        places = np.searchsorted(path, path[-1] * np.arange(1, count + 1) / count * (1 - 1e-9))
        return tuple(self.frames[seen[place]] for place in sorted({*places.tolist()}))

    @property
    def farthest(self) -> int:
        """The frame whose median displacement is the largest."""
        length = np.hypot(self.quantiles["u"][:, 1], self.quantiles["v"][:, 1])
        return self.frames[int(np.nan_to_num(length).argmax())]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseFloor:
    """Noise floor: standard deviation of the fields of static frames, as of a single frame against the reference.

    Attributes
    ----------
    count
        Number of static frames.
    measured
        Of u, v (in the unit of `Physical.units`), exx, eyy and exy: the rms over the nodes.
    common
        Of the same: the standard deviation of the mean over the nodes, which is what all nodes have in common, such as
        vibration.
    """

    count: int
    measured: dict[str, float]
    common: dict[str, float]


def noise_floor(physical: Physical, most: int = 50) -> NoiseFloor | None:
    """Estimate the noise floor from the frames of the reference.

    The reference is the mean of n frames; the differences of these frames among each other do not depend on it. Another
    frame scatters against the mean by sqrt(1 + 1/n) more than they do around their own mean.

    Parameters
    ----------
    physical
        The result in the units of its scale.
    most
        Static frames that are read at most. A standard deviation over n frames and N nodes has the relative
        uncertainty 1 / sqrt(2 n N) for independent nodes: below 1 % from 100 nodes on.

    Returns
    -------
    NoiseFloor or None
        None where fewer than two frames of the reference are measured.
    """
    result, names = physical.result, ("u", "v", "exx", "eyy", "exy")
    static = [place for place in result.provenance["references"] if result.status[place] != FAILED][:most]
    if len(static) < 2:
        return None
    fields = np.array([[values[name] for name in names] for values in map(physical.frame, static)], dtype=np.float64)
    variances = np.ma.masked_invalid(fields.var(axis=0, ddof=1)).mean(axis=1)
    common = np.ma.masked_invalid(fields).mean(axis=2).filled(np.nan).var(axis=0, ddof=1)
    single = 1 + 1 / len(result.setting("frames", "reference", static))
    both = np.sqrt(single * np.array([variances.filled(np.nan), common])).tolist()
    measured, mean = (dict(zip(names, deviations, strict=True)) for deviations in both)
    return NoiseFloor(count=len(static), measured=measured, common=mean)


def speckle_size(result: Result) -> float | None:
    """Return the full width at half maximum (px) of the reference's autocorrelation; None where none was kept.

    It is the median over the lights, around the mesh, of the separated images, which are interpolated at all pixels;
    `rgbmidic inspect` evaluates the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (left, top), (right, bottom) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    parts = result.reference[:, max(top, 0) : bottom, max(left, 0) : right].astype(np.float32)
    sizes = [size for part in parts if (size := speckle_diameter(part)) is not None]
    return float(np.median(sizes)) if sizes else None
