"""One frame after the other: each starts from the last one's displacement, and from a search where that fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.solution import NO_MATCH, Solution, Status
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import FoundStart, find_starts
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import each
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["LARGEST_TURN", "Start", "track"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """From where a frame starts.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2), or None
        The last frame's displacement in px, gaps filled; None where there is none yet.
    unmeasured : float
        Share of the nodes that the last frame could not measure.
    renewals : tuple of int
        The frames that have become the reference in turn.
    best_match : float
        How well a frame has matched the last of them, see `Renewal.match`; 0 where none has.
    """

    displacement: FloatArray | None
    unmeasured: float = 0.0
    renewals: tuple[int, ...] = ()
    best_match: float = 0.0

    def after(self, mesh: Tri3Mesh, displacement: FloatArray, measured: BoolArray) -> Start:
        """The start of the frame after one that started here: nodes that it lost move as the nearest measured one.

        Where it lost all of them, the next frame starts here too.

        Parameters
        ----------
        mesh
            On the reference.
        displacement : ndarray, shape (N, 2)
            Of that frame, px.
        measured : ndarray, shape (N,)
            Which of them are measured.
        """
        if not measured.any():
            return self
        nearest = mesh.nearest(measured)[1]
        return replace(self, displacement=displacement[nearest], unmeasured=float((~measured).mean()))


LARGEST_TURN = 30.0
"""Turn (degrees) that the search for a start finds, with strains of 20 % or alone (benchmarks/starts.py)."""
NEEDED = 0.15
"""Confidence from which a start is worth a solve: another specimen gives at most .1 (benchmarks/starts.py)."""
_LOSS = 0.04
"""Share of the nodes whose loss each further start makes acceptable, half of it at the first: a few may really go, as
the 1 to 2 % at the edge of a turning fragment do."""


def track(
    reference: Reference,
    deformed: Deformed,
    start: Start,
    options: SolverSettings,
    *,
    statistics: bool = True,
) -> Solution:
    """Solve one frame from the last frame's displacement, and from a search where that fails or loses nodes.

    Parameters
    ----------
    reference, deformed
        The two states.
    start
        The last frame's end; without a displacement the start is searched.
    options, statistics
        How to solve, see `solve`.
    """
    best: Solution | None = None
    surest = 0.0
    last = [] if start.displacement is None else [FoundStart(displacement=start.displacement, confidence=np.nan)]
    for number, found in enumerate(chain(last, each("search", find_starts(reference, deformed, start.displacement)))):
        surest = float(np.fmax(surest, found.confidence))
        if found.confidence < NEEDED:
            continue
        trial = solve(reference, deformed, found.displacement, options, statistics=statistics)
        if best is None or (trial.status, trial.unmeasured_share) < (best.status, best.unmeasured_share):
            best = trial
        if best.status is Status.CONVERGED and best.unmeasured_share <= start.unmeasured + (number + 0.5) * _LOSS:
            break
    if best is None:  # from rest, for the reason why there is no start
        best = solve(reference, deformed, np.zeros_like(reference.mesh.nodes), options, statistics=statistics)
    return replace(best, reason=f"{NO_MATCH}; {_looked_for(surest)}") if best.reason == NO_MATCH else best


def _looked_for(surest: float) -> str:
    if surest >= NEEDED:
        return f"at the start found they agree around {surest:.0%} of the nodes, but the solve did not hold one of them"
    return (
        f"no start found: at the best one the images agree around {surest:.0%} of the nodes, of {NEEDED:.0%} needed. "
        f"Looked for were motions up to the region's longer side, at least 128 px, and turns up to about "
        f"{LARGEST_TURN:g} degrees: take frames in between"
    )
