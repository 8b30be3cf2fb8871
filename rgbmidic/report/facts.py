"""What a report says in numbers: the course of a test, its noise floor, the size of its speckle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rgbmidic.results import QUANTITIES, Result, speckle_diameter
from rgbmidic.typing import FloatArray

if TYPE_CHECKING:
    from rgbmidic.results.physical import Physical

__all__ = ["Course", "NoiseFloor", "noise_floor", "speckle_size"]

_TOLD = ("u", "v", "u_std", "v_std", "exx", "eyy", "exy", "exx_std", "eyy_std", "exy_std", "misfit")
_QUANTILES = (0.05, 0.5, 0.95)
_STATIC = 50
"""Static frames that a noise floor is taken from at most: it is known to 2 % then."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """What the nodes of some frames tell, frame by frame.

    Attributes
    ----------
    frames : tuple of int, length F
        Places in the result.
    times : ndarray, shape (F,)
        In the unit of `Physical.units`.
    quantiles : dict
        Of each quantity the 5 %, 50 % and 95 % quantile over the nodes, shape (F, 3); NaN where nothing is measured.
    shares : ndarray, shape (F, S)
        Share of the nodes with each `node_status`.
    fastest : float
        Largest velocity of a node between two neighbouring ones of these frames, px per unit of time; 0 where unknown.
    """

    frames: tuple[int, ...]
    times: FloatArray
    quantiles: dict[str, FloatArray]
    shares: FloatArray
    fastest: float

    @classmethod
    def of(cls, told: Physical, frames: Sequence[int]) -> Course:
        """Of these frames, one after the other; a `ResultError` where one is damaged."""
        rows: dict[str, list[FloatArray]] = {name: [] for name in _TOLD}
        codes = range(len(QUANTITIES["node_status"].codes))
        shares, fastest, before = [], 0.0, None
        for frame in frames:
            values = told.frame(frame)
            for name, row in rows.items():
                row.append(_quantiles(values[name]))
            shares.append([float((values["node_status"] == code).mean()) for code in codes])
            here = np.stack([values["u"], values["v"]]) / told.length
            if before is not None:
                step = np.hypot(*(here - before[1])) / (told.times[frame] - told.times[before[0]])
                fastest = max(fastest, float(np.nan_to_num(step).max(initial=0)))
            before = frame, here
        return cls(
            frames=tuple(frames),
            times=told.times[list(frames)],
            quantiles={name: np.array(row) for name, row in rows.items()},
            shares=np.array(shares),
            fastest=fastest,
        )

    def median(self, name: str) -> float:
        """Median over the frames of a quantity's median over the nodes; NaN where nothing is measured."""
        known = self.quantiles[name][:, 1]
        known = known[np.isfinite(known)]
        return float(np.median(known)) if known.size else float("nan")

    @property
    def farthest(self) -> int:
        """The frame whose median node has moved farthest."""
        way = np.hypot(self.quantiles["u"][:, 1], self.quantiles["v"][:, 1])
        return self.frames[int(np.nan_to_num(way).argmax())]

    def extreme(self, name: str) -> float:
        """The value farthest from 0 of a quantity's median over the nodes; NaN where nothing is measured."""
        known = self.quantiles[name][:, 1]
        known = known[np.isfinite(known)]
        return float(known[np.abs(known).argmax()]) if known.size else float("nan")


def _quantiles(values: FloatArray) -> FloatArray:
    known = values[np.isfinite(values)]
    return np.quantile(known, _QUANTILES) if known.size else np.full(len(_QUANTILES), np.nan)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseFloor:
    """Scatter of what static frames show, one standard deviation, as that of a single frame against the reference.

    Attributes
    ----------
    count
        Number of static frames.
    measured
        Of u, v (in the unit of `Physical.units`), exx, eyy and exy: the rms over the nodes.
    """

    count: int
    measured: dict[str, float]


def noise_floor(told: Physical) -> NoiseFloor | None:
    """Noise floor from the frames of the reference, where several of them are measured; else None.

    The reference is their mean, which does not move what they scatter around. A frame of its own scatters against the
    mean of n by the factor sqrt(1 + 1/n) more than they do around theirs.
    """
    result, names = told.result, ("u", "v", "exx", "eyy", "exy")
    static = [place for place in result.provenance["references"] if result.status[place] != 2][:_STATIC]
    if len(static) < 2:
        return None
    sums, squares = np.zeros((2, len(names), len(result.nodes)))
    for frame in static:
        values = told.frame(frame)
        one = np.stack([values[name] for name in names]).astype(np.float64)
        sums, squares = sums + one, squares + one**2
    count = len(static)
    variance = np.maximum(squares - sums**2 / count, 0) / (count - 1)
    variance *= 1 + 1 / len(result.setting("frames", "reference", static))
    known = [row[np.isfinite(row)] for row in variance]
    rms = [float(np.sqrt(row.mean())) if row.size else float("nan") for row in known]
    return NoiseFloor(count=count, measured=dict(zip(names, rms, strict=True)))


def speckle_size(result: Result) -> float | None:
    """Full width at half maximum (px) of the reference's autocorrelation, around the mesh; None where none is kept.

    The median over the lights. The pictures are those of the separated lights, filled in at all pixels; `rgbmidic
    inspect` looks at the samples themselves.
    """
    if result.reference is None:
        return None
    nodes = result.nodes - result.reference_origin
    (left, top), (right, bottom) = nodes.min(axis=0).astype(int), nodes.max(axis=0).astype(int) + 1
    parts = result.reference[:, max(top, 0) : bottom, max(left, 0) : right].astype(np.float32)
    sizes = [size for part in parts if (size := speckle_diameter(part)) is not None]
    return float(np.median(sizes)) if sizes else None
