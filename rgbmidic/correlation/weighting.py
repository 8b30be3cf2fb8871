"""Weights of a pass: what matches, how precise each light is, which grey levels the reference should have."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.grey_level import corrected_values
from rgbmidic.correlation.iteration import Estimate, Problem, compare
from rgbmidic.correlation.matching import matching_elements
from rgbmidic.correlation.node_status import lost_elements, one_sided_texture
from rgbmidic.correlation.precision import Precision, learn_precision
from rgbmidic.correlation.recovery import Recovery
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.uncertainty.nodal import nodal_std
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = [
    "FIRST_PASS",
    "Weighting",
    "first_weighting",
    "next_weighting",
    "refining",
    "settled",
    "standard_uncertainty",
]

FIRST_PASS = 0.01
"""Increment (px) at which the first pass hands over to the pass with the weights brought back anew. At .05 an iteration
less is needed, but from another start the result differs by up to 2.3e-4 px."""
_REFINED = {"none": 1, "global": 1, "local": 4}
"""Passes whose residual still changes weights and grey levels, for each grey-level correction."""
_STARTED = 0.25
"""Correlation coefficient at the start under which an element waits until its neighbours have brought it nearer."""
_RETURNS = 4
"""Passes that may bring elements back. At a fragment's edge some come and go with every pass: without a limit frames
took 40 to 50 iterations over the most passes, and a third of them did not converge (benchmarks/fast_event.py)."""
_SETTLED = 1e-3
"""Share of the weight that may still change for the passes to end."""
_LOOKED_AT = 16
"""One weight in so many tells it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighting:
    """What the residual at an estimate says about elements, lights and grey levels.

    Attributes
    ----------
    residual
        At the estimate, with the weights brought back.
    values : ndarray, shape (k, P), float32
        Reference grey levels, corrected for brightness.
    matched : ndarray, shape (E,), bool
        Elements that take part.
    precision
        Of the lights; None: not learnt.
    returned : int
        Number of the pass after the last one that brought elements back.
    """

    residual: Residual
    values: FloatImage
    matched: BoolArray
    precision: Precision | None = None
    returned: int = 0

    @property
    def seen(self) -> BoolArray:
        """Which lights (k,) see an element that takes part."""
        return np.asarray((self.residual.moments[:, self.matched, 0] > 0).any(axis=1))

    @property
    def given(self) -> FloatImage:
        """Pixel weights (k, P) without the precision of the lights."""
        return self._given(slice(None))

    @property
    def weights(self) -> FloatImage:
        """Pixel weights (k, P) of the next pass."""
        return self.of(slice(None))

    def of(self, pixels: slice) -> FloatImage:
        """Those of some pixels."""
        given = self._given(pixels)
        return given if self.precision is None else given * self.precision.factor[:, pixels]

    def _given(self, pixels: slice) -> FloatImage:
        weights = self.residual.weights[:, pixels]
        if self.matched.all():
            return weights
        return weights * np.repeat(self.matched, np.diff(self.residual.reference.pixels.offsets))[pixels]


@stage("weights")
def first_weighting(problem: Problem, estimate: Estimate) -> Weighting:
    residual = compare(problem, problem.reference.values, estimate)
    return Weighting(
        residual=residual,
        values=corrected_values(residual, "none" if problem.options.brightness == "none" else "global"),
        matched=matching_elements(residual, least=_STARTED),
    )


@stage("weights")
def next_weighting(
    problem: Problem, last: Weighting, equations: Equations, estimate: Estimate, number: int
) -> Weighting:
    """What the displacement found by pass `number` says about matching, grey levels and precision."""
    residual = compare(problem, last.values, estimate)
    matched = matching_elements(residual, last.precision)
    if not matched.all() or estimate.longest > FIRST_PASS:
        exhausted = len(estimate.increments) >= problem.options.max_iterations
        motion = np.zeros(len(estimate.displacement)) if exhausted else estimate.increments[-1]
        std = standard_uncertainty(residual, equations, last.precision)
        one_sided = one_sided_texture(equations, residual)
        matched &= ~lost_elements(problem.reference.mesh, std, motion, one_sided)
    if number >= _RETURNS:
        matched &= last.matched
    # where elements have come back, what was learnt from their wrong match must be learnt anew, and once more: in
    # the pass that brings them back the residual is still that of a wrong match
    returned = number + 1 if (matched & ~last.matched).any() else last.returned
    weighting = replace(last, residual=residual, matched=matched, returned=returned)
    if not refining(problem, weighting, number + 1):
        return weighting
    return replace(
        weighting,
        values=corrected_values(residual, problem.options.brightness),
        precision=learn_precision(residual) if problem.statistics else None,
    )


def settled(weighting: Weighting, equations: Equations) -> bool:
    """Whether the next pass would have the weights of the last one."""
    some = slice(None, None, _LOOKED_AT)
    weights = weighting.of(some)
    total = float(weights.sum())
    return total > 0 and float(np.abs(weights - equations.weights[:, some]).sum()) <= _SETTLED * total


def refining(problem: Problem, weighting: Weighting, number: int) -> bool:
    """Whether the residual of a pass still changes weights or grey levels."""
    learns = problem.statistics or problem.options.brightness != "none"
    return learns and number <= weighting.returned + _REFINED[problem.options.brightness]


def standard_uncertainty(
    residual: Residual, equations: Equations, precision: Precision | None, recovery: Recovery | None = None
) -> FloatArray:
    """Standard uncertainty of the linear fit's u and v, (N, 2), or of what the `recovery` gives, (N, 5).

    The latter holds the step, too, that the lights' channel-specific gradients would make from the solution: two
    gradients that measure the same motion differ by noise alone (Hausman, Econometrica 46, 1978). Where a reflection
    does not follow the surface it pulls with them, and what it still pulls without is less than that
    (docs/uncertainty.md).
    """
    std = nodal_std(residual, equations, recovery)
    if precision is not None:
        std = std * precision.robust_loss(residual.reference, equations.weights)[:, None]
    if recovery is None:
        return std
    pulls = residual.reference.channel_specific_pulls(equations.weights, residual.difference)
    pull, rigid_pull = pulls.sum(axis=0), (pulls[1:] @ equations.functions).ravel()
    step, _ = equations.increment(pull, np.zeros_like(pull), rigid_pull)
    disagreement = np.concatenate([recovery.displacement(step), recovery.strain(step)], axis=1)
    return np.asarray(np.hypot(std, disagreement))
