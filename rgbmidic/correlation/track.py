"""One frame after the other: each starts from the last one's displacement, and from a search where that fails."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.solution import NO_MATCH, Solution, Status
from rgbmidic.correlation.solve import solve
from rgbmidic.correlation.start import coarse_start, refine_start
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import SolverSettings
from rgbmidic.typing import FloatArray

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
    """

    displacement: FloatArray | None
    unmeasured: float = 0.0

    def after(self, solution: Solution) -> Start:
        """The start of the frame after `solution`: gaps get the displacement of the nearest measured node."""
        measured = solution.measured
        if not measured.any():
            return self
        nearest = Tri3Mesh(nodes=solution.nodes, elements=solution.elements).nearest(measured)[1]
        return Start(displacement=solution.displacement[nearest], unmeasured=solution.unmeasured_share)


LARGEST_TURN = 8.0
"""Turn (degrees) that the search for a start still finds with speckles of 3.5 px; coarser ones allow 12 (measured)."""
_LOSS = 0.01
"""Share of the nodes whose loss each further start makes acceptable, half of it at the first: a few may really go."""


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
        How to solve, see `solve`; ``options.search_radius`` bounds the motion that a search looks for.
    """
    best: Solution | None = None
    for number, initial in enumerate(_starts(reference, deformed, start.displacement, options.search_radius)):
        trial = solve(reference, deformed, initial, options, statistics=statistics)
        if best is None or (trial.status, trial.unmeasured_share) < (best.status, best.unmeasured_share):
            best = trial
        if best.status is Status.CONVERGED and best.unmeasured_share <= start.unmeasured + (number + 0.5) * _LOSS:
            break
    assert best is not None
    if best.reason == NO_MATCH:
        return replace(best, reason=f"{NO_MATCH}; {_limits(options)}")
    return best


def _limits(options: SolverSettings) -> str:
    return (
        f"looked for were motions up to search_radius = {options.search_radius:g} px and turns up to about "
        f"{LARGEST_TURN:g} degrees, from rest and from the last frame measured: state a larger solver.search_radius, "
        "or take frames in between"
    )


def _starts(
    reference: Reference, deformed: Deformed, last: FloatArray | None, search_radius: float
) -> Iterator[FloatArray]:
    """Displacements to start from, cheapest first, each made only when it is asked for."""
    if last is not None:
        yield last
        yield refine_start(reference, deformed, last)
        yield coarse_start(reference, deformed, search_radius, last)
    yield coarse_start(reference, deformed, search_radius)
