"""Gauss-Newton iterations with one Hessian: from one estimate of the motion to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["Estimate", "Problem", "UnsolvableError", "compare", "iterate"]

_LONGEST_STEP = 4.0
"""Longest motion of a node in one iteration, px."""
_PASS_ITERATIONS = 12
"""Most iterations of a pass: from within half a speckle 4 to 5 do (measured on the truth tests)."""
_PATIENCE = 5
"""Iterations after which a tenth of the nodes may still move: they wander where nothing matches."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """What is solved: two states, the options, and the rigid functions (2 N, m)."""

    reference: Reference
    deformed: Deformed
    options: SolverSettings
    statistics: bool
    functions: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The motion as far as it is known.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        px.
    rigid : ndarray, shape (k, m)
        Coefficients of each light's rigid functions.
    increments : tuple of ndarray, shape (N,)
        Motion of each node in every iteration, px.
    longest : float
        Largest motion of a textured node, or by a light's rigid motion, in the last iteration, px.
    """

    displacement: FloatArray
    rigid: FloatArray
    increments: tuple[FloatArray, ...] = ()
    longest: float = float("inf")

    @classmethod
    def start(cls, problem: Problem, initial: FloatArray) -> Estimate:
        """From a displacement (N, 2), without rigid motions."""
        return cls(displacement=initial, rigid=np.zeros((len(problem.reference.images), problem.functions.shape[1])))

    def history(self, nodes: BoolArray | None = None) -> FloatArray:
        """Largest motion of `nodes` (N,), or of all, in every iteration, px; shape (iterations,)."""
        chosen = slice(None) if nodes is None else nodes
        return np.array([increment[chosen].max() for increment in self.increments], dtype=np.float64)


class UnsolvableError(Exception):
    """Nothing can be measured: the reason, and how far the iteration came."""

    def __init__(self, reason: str, estimate: Estimate) -> None:
        super().__init__(reason)
        self.history = estimate.history()


def compare(problem: Problem, values: FloatImage, estimate: Estimate) -> Residual:
    """Both states at an estimate, for reference grey levels `values` (k, P)."""
    return Residual.at(problem.reference, problem.deformed, values, _light_displacements(problem, estimate))


@stage("iteration")
def iterate(
    problem: Problem,
    equations: Equations,
    values: FloatImage,
    residual: Residual,
    estimate: Estimate,
    tolerance: float,
) -> Estimate:
    """Gauss-Newton iterations with one Hessian until no textured node moves by more than `tolerance` px, from an
    estimate whose `residual` is known, for reference grey levels `values` (k, P)."""
    known: FloatImage | None = residual.difference_from(values)
    for turn in range(min(_PASS_ITERATIONS, problem.options.max_iterations - len(estimate.increments))):
        estimate = _stepped(problem, equations, values, estimate, known)
        known = None
        if not np.isfinite(estimate.displacement).all():
            raise UnsolvableError("the iteration diverged", estimate)
        # a few nodes that wander where nothing matches must not keep the others waiting
        most = turn >= _PATIENCE and np.quantile(estimate.increments[-1][equations.textured], 0.9) <= tolerance
        if estimate.longest <= tolerance or most:
            break
    return estimate


def _stepped(
    problem: Problem, equations: Equations, values: FloatImage, estimate: Estimate, known: FloatImage | None
) -> Estimate:
    """One Gauss-Newton iteration; `known` is the difference (k, P) of the states at the estimate, if it is."""
    motion, shifts = equations.increment(*_right_sides(problem, equations, values, estimate, known))
    length = np.hypot(*motion.T)
    longest = float(length[equations.textured].max())
    rigid = estimate.rigid.copy()
    if shifts.size:
        shifts = shifts.reshape(rigid[1:].shape)
        rigid[1:] += shifts
        longest = max(longest, float(np.abs(problem.functions @ shifts.T).max()))
    bounded = motion * np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-30))[:, None]
    return Estimate(
        displacement=estimate.displacement + bounded,
        rigid=rigid,
        increments=(*estimate.increments, length),
        longest=longest,
    )


def _right_sides(
    problem: Problem, equations: Equations, values: FloatImage, estimate: Estimate, known: FloatImage | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right-hand sides of the nodes (2 N,), the smoothness' part of it, and of the rigid functions ((k - 1) m,)."""
    bend = problem.reference.assembly.smoothness @ estimate.displacement.ravel()
    held = -equations.smoothness * equations.turned_back(bend[:, None]).ravel()
    total, rigid = held.copy(), []
    for light, displacement in enumerate(_light_displacements(problem, estimate)):
        weight = equations.weights[light]
        if known is None:
            vector = problem.reference.right_side(problem.deformed, light, values[light], weight, displacement)
        else:
            vector = problem.reference.projected(light, weight, known[light])
        total += vector
        if light:
            rigid.append(equations.functions.T @ vector)
    return total, held, np.concatenate(rigid) if rigid else np.empty(0)


def _light_displacements(problem: Problem, estimate: Estimate) -> list[FloatArray]:
    """Displacement (N, 2) of every light: the common one and its own rigid motion."""
    return [estimate.displacement + (problem.functions @ rigid).reshape(-1, 2) for rigid in estimate.rigid]
