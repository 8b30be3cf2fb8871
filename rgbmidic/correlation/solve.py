"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3).

Minimised over the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first:
``sum_j integral (g_j(x + u + R beta_j) - f_j(x))^2 p_j dx``. A rigid motion is linear in x, so it lies in the TRI3
space: the light's own nodal displacement is ``u + R beta_j`` and its derivative is the light's Hessian times R.
The gradient of the reference image stands for that of the deformed one, so the Hessian is constant within a pass.

One pass after the other: compare the states -> match -> weigh -> equations -> iterate; then conclude. Every step is a
function from frozen states to a frozen state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation.curvature import CurvatureOffset, curvature_offset
from rgbmidic.correlation.equations import Equations, rigid_functions
from rgbmidic.correlation.grey_level import corrected_values
from rgbmidic.correlation.matching import matching_elements, misfit
from rgbmidic.correlation.node_status import Evidence, judge, lost_elements, one_sided_texture
from rgbmidic.correlation.precision import Precision, learn_precision
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.solution import NodeStatus, Solution, Status
from rgbmidic.correlation.uncertainty.nodal import nodal_std
from rgbmidic.errors import InputError
from rgbmidic.settings import SolverSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["solve"]

_LONGEST_STEP = 4.0
"""Longest motion of a node in one iteration, px."""
_FIRST_PASS = 0.01
"""Increment (px) at which the first pass hands over to the pass with the weights brought back anew."""
_PASSES = 8
"""Most passes: each brings the weights back with the latest displacement."""
_REFINED = {"none": 1, "global": 1, "local": 4}
"""Passes whose residual still changes weights and grey levels, for each grey-level correction."""
_PASS_ITERATIONS = 12
"""Most iterations of a pass: from within half a speckle 4 to 5 do (measured on the truth tests)."""
_PATIENCE = 5
"""Iterations after which a tenth of the nodes may still move: they wander where nothing matches."""
_STARTED = 0.25
"""Correlation coefficient at the start under which an element waits until its neighbours have brought it nearer."""
_SETTLED = 1e-3
"""Share of the weight that may still change for the passes to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Problem:
    """What is solved: two states, the options, and the rigid functions (2 N, m)."""

    reference: Reference
    deformed: Deformed
    options: SolverSettings
    statistics: bool
    functions: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Estimate:
    """The motion as far as it is known.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        px.
    rigid : ndarray, shape (k, m)
        Coefficients of each light's rigid functions.
    increment : ndarray, shape (N,)
        Motion of each node in the last iteration, px.
    history : tuple of float
        Largest such motion of a textured node in every iteration, px.
    squares : ndarray, shape (k, 3)
        Sums of w r^2, of w and of lost pixels before the last iteration.
    """

    displacement: FloatArray
    rigid: FloatArray
    increment: FloatArray
    history: tuple[float, ...] = ()
    squares: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class _Weighting:
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
    def given(self) -> FloatImage:
        """Pixel weights (k, P) without the precision of the lights."""
        return self.residual.weights * np.repeat(self.matched, np.diff(self.residual.reference.pixels.offsets))

    @property
    def weights(self) -> FloatImage:
        """Pixel weights (k, P) of the next pass."""
        return self.given if self.precision is None else self.given * self.precision.factor


class _UnsolvableError(Exception):
    """Nothing can be measured: the reason, and how far the iteration came."""

    def __init__(self, reason: str, history: tuple[float, ...] = ()) -> None:
        super().__init__(reason)
        self.history = history


def solve(
    reference: Reference,
    deformed: Deformed,
    initial: FloatArray,
    options: SolverSettings,
    *,
    statistics: bool = True,
) -> Solution:
    """Find the displacement of the reference mesh that brings the deformed images onto the reference ones.

    Parameters
    ----------
    reference, deformed
        The two states, prepared with the same prefilter.
    initial : ndarray, shape (N, 2)
        Displacement (u, v) in px to start from, within about half a speckle of the solution.
    options
        Rigid functions, grey-level correction, curvature, tolerance and iterations.
    statistics
        Weight every light by the inverse variance of its own residual around each pixel, robustly.

    Returns
    -------
    Solution
        Nodes that no light sees are NaN and flagged; a failed solve is NaN everywhere, with status and reason.

    Raises
    ------
    InputError
        The two states have different numbers or sizes of images, or `initial` does not fit the mesh.
    """
    if deformed.images.shape != reference.images.shape:
        raise InputError(
            f"reference and deformed images must have one shape; given are {reference.images.shape} and "
            f"{deformed.images.shape}"
        )
    if initial.shape != reference.mesh.nodes.shape or not np.isfinite(initial).all():
        raise InputError(f"the initial displacement must be finite with shape {reference.mesh.nodes.shape}")
    problem = _Problem(
        reference=reference,
        deformed=deformed,
        options=options,
        statistics=statistics,
        functions=rigid_functions(reference.mesh.nodes, options.rigid),
    )
    try:
        return _conclude(problem, *_passes(problem, _started(problem, initial)))
    except _UnsolvableError as error:
        return Solution.failed(reference.mesh, len(reference.images), str(error), error.history)


def _started(problem: _Problem, initial: FloatArray) -> _Estimate:
    lights = len(problem.reference.images)
    return _Estimate(
        displacement=initial,
        rigid=np.zeros((lights, problem.functions.shape[1])),
        increment=np.zeros(len(initial)),
        squares=np.zeros((lights, 3)),
    )


def _passes(problem: _Problem, estimate: _Estimate) -> tuple[_Estimate, Equations, _Weighting]:
    """Passes until the weights have settled."""
    tolerance = problem.options.tolerance
    weighting = _first_weighting(problem, estimate)
    equations: Equations | None = None
    for number in range(_PASSES):
        if equations is not None and _settled(weighting, equations) and not _refining(problem, weighting, number):
            break
        equations = _equations(problem, weighting, estimate)
        reached = max(tolerance, _FIRST_PASS) if number == 0 else tolerance
        estimate = _iterated(problem, equations, weighting.values, estimate, reached)
        weighting = _next_weighting(problem, weighting, equations, estimate, number)
    assert equations is not None
    if estimate.history[-1] > tolerance:
        estimate = _iterated(problem, equations, weighting.values, estimate, tolerance)
        weighting = replace(weighting, residual=_compared(problem, weighting.values, estimate))
    return estimate, equations, weighting


def _settled(weighting: _Weighting, equations: Equations) -> bool:
    weights = weighting.weights
    return bool(np.abs(weights - equations.weights).sum() <= _SETTLED * weights.sum()) and bool(weights.any())


def _refining(problem: _Problem, weighting: _Weighting, number: int) -> bool:
    """Whether the residual of a pass still changes weights or grey levels."""
    learns = problem.statistics or problem.options.brightness != "none"
    return learns and number <= weighting.returned + _REFINED[problem.options.brightness]


def _light_displacements(problem: _Problem, estimate: _Estimate) -> list[FloatArray]:
    """Displacement (N, 2) of every light: the common one and its own rigid motion."""
    return [estimate.displacement + (problem.functions @ rigid).reshape(-1, 2) for rigid in estimate.rigid]


def _compared(problem: _Problem, values: FloatImage, estimate: _Estimate) -> Residual:
    return Residual.at(problem.reference, problem.deformed, values, _light_displacements(problem, estimate))


def _first_weighting(problem: _Problem, estimate: _Estimate) -> _Weighting:
    residual = _compared(problem, problem.reference.values, estimate)
    return _Weighting(
        residual=residual,
        values=corrected_values(residual, "none" if problem.options.brightness == "none" else "global"),
        matched=matching_elements(residual, least=_STARTED),
    )


def _next_weighting(
    problem: _Problem, last: _Weighting, equations: Equations, estimate: _Estimate, number: int
) -> _Weighting:
    """What the displacement found by pass `number` says about matching, grey levels and precision."""
    residual = _compared(problem, last.values, estimate)
    matched = matching_elements(residual, last.precision)
    if not matched.all() or estimate.history[-1] > _FIRST_PASS:
        exhausted = len(estimate.history) >= problem.options.max_iterations
        motion = np.zeros_like(estimate.increment) if exhausted else estimate.increment
        std = _std(residual, equations, last.precision, 2)
        matched &= ~lost_elements(problem.reference.mesh, std, motion)
    # where elements have come back, what was learnt from their wrong match must be learnt anew, and once more: in
    # the pass that brings them back the residual is still that of a wrong match
    returned = number + 1 if (matched & ~last.matched).any() else last.returned
    weighting = replace(last, residual=residual, matched=matched, returned=returned)
    if not _refining(problem, weighting, number + 1):
        return weighting
    return replace(
        weighting,
        values=corrected_values(residual, problem.options.brightness),
        precision=learn_precision(residual) if problem.statistics else None,
    )


def _equations(problem: _Problem, weighting: _Weighting, estimate: _Estimate) -> Equations:
    """The equations of the next pass.

    Raises
    ------
    _UnsolvableError
        Nothing is left to be measured.
    """
    weights, history = weighting.weights, estimate.history
    if not weights.any():
        raise _UnsolvableError(_nothing_left(weighting), history)
    if problem.functions.shape[1] and not weights[0].any():
        raise _UnsolvableError(
            "the first light sees nothing, and the rigid motions of the others are counted from it: "
            "put a light first that sees, or measure without rigid motions",
            history,
        )
    given = None if weighting.precision is None else weighting.given
    try:
        equations = Equations.build(problem.reference, weights, problem.functions, given)
    except RuntimeError as error:  # what SuperLU raises on a matrix that is singular in double precision
        raise _UnsolvableError(f"the equations cannot be solved: {error}", history) from None
    if not equations.textured.any():
        raise _UnsolvableError(_nothing_left(weighting), history)
    return equations


def _nothing_left(weighting: _Weighting) -> str:
    if not weighting.matched.all():
        return "the images do not match anywhere in the region"
    if not weighting.residual.weights.any():
        return "no light sees the region: every weight is zero"
    return "the images have no texture in the region"


def _iterated(
    problem: _Problem, equations: Equations, values: FloatImage, estimate: _Estimate, tolerance: float
) -> _Estimate:
    """Gauss-Newton iterations with one Hessian until no textured node moves by more than `tolerance` px."""
    for turn in range(min(_PASS_ITERATIONS, problem.options.max_iterations - len(estimate.history))):
        estimate = _stepped(problem, equations, values, estimate)
        longest = estimate.history[-1]
        if not np.isfinite(estimate.displacement).all():
            raise _UnsolvableError("the iteration diverged", estimate.history)
        # a few nodes that wander where nothing matches must not keep the others waiting
        most = turn >= _PATIENCE and np.quantile(estimate.increment[equations.textured], 0.9) <= tolerance
        if longest <= tolerance or most:
            break
    return estimate


def _stepped(problem: _Problem, equations: Equations, values: FloatImage, estimate: _Estimate) -> _Estimate:
    """One Gauss-Newton iteration."""
    right_side, rigid_side, squares = _right_sides(problem, equations, values, estimate)
    motion, shifts = equations.increment(right_side, rigid_side)
    motion = motion.reshape(-1, 2)
    length = np.hypot(*motion.T)
    longest = float(length[equations.textured].max())
    rigid = estimate.rigid.copy()
    if shifts.size:
        shifts = shifts.reshape(rigid[1:].shape)
        rigid[1:] += shifts
        longest = max(longest, float(np.abs(problem.functions @ shifts.T).max()))
    bounded = motion * np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-30))[:, None]
    return _Estimate(
        displacement=estimate.displacement + bounded,
        rigid=rigid,
        increment=length,
        history=(*estimate.history, longest),
        squares=squares,
    )


def _right_sides(
    problem: _Problem, equations: Equations, values: FloatImage, estimate: _Estimate
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right-hand sides of the nodes (2 N,) and of the rigid functions ((k - 1) m,), and each light's sums (k, 3)."""
    total = -(equations.smoothness @ estimate.displacement.ravel())
    squares, rigid = np.zeros_like(estimate.squares), []
    for light, displacement in enumerate(_light_displacements(problem, estimate)):
        vector, squares[light] = problem.reference.right_side(
            problem.deformed, light, values[light], equations.weights[light], displacement
        )
        total += vector
        if light:
            rigid.append(problem.functions.T @ vector)
    return total, np.concatenate(rigid) if rigid else np.empty(0), squares


def _std(residual: Residual, equations: Equations, precision: Precision | None, quantities: int) -> FloatArray:
    """Standard uncertainty (N, quantities) of the first of u, v (px), exx, eyy, exy."""
    std = nodal_std(residual, equations, quantities)
    return std if precision is None else std * precision.robust_loss(residual.reference, equations.weights)[:, None]


def _conclude(problem: _Problem, estimate: _Estimate, equations: Equations, weighting: _Weighting) -> Solution:
    """The solution: what counts, how certain it is, in which unit."""
    reference, options, mesh = problem.reference, problem.options, problem.reference.mesh
    mismatched = np.zeros(len(mesh.nodes), dtype=bool)
    mismatched[mesh.elements[~weighting.matched]] = True
    sound = equations.textured & ~mismatched
    offset = curvature_offset(reference, equations, estimate.displacement, sound)
    std = _std(weighting.residual.without(offset.deviation), equations, weighting.precision, 5)
    node_status, misfits = _judged(estimate, equations, weighting, mismatched, std)
    measured = node_status == NodeStatus.MEASURED
    displacement, strain, std = _with_curvature(reference, estimate.displacement, std, offset, options.curvature)
    inner = measured & ~mesh.beside(~measured)
    with np.errstate(invalid="ignore", divide="ignore"):
        residual = np.sqrt(estimate.squares[:, 0] / estimate.squares[:, 1])
    last = float(estimate.increment[measured].max())
    converged = last <= options.tolerance
    return Solution(
        nodes=mesh.nodes,
        elements=mesh.elements,
        displacement=np.where(measured[:, None], displacement, np.nan),
        displacement_std=np.where(measured[:, None], std[:, :2], np.nan),
        strain=np.where(inner[:, None], strain, np.nan),
        strain_std=np.where(inner[:, None], std[:, 2:], np.nan),
        node_status=node_status,
        light_share=equations.light_share,
        misfit=np.where(measured, misfits, np.nan),
        status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
        reason="" if converged else f"the last iteration still moved a node by {last:.3g} px",
        rigid=estimate.rigid,
        residual=residual,
        weight_share=_shares(equations.weights),
        history=np.array(estimate.history),
    )


def _judged(
    estimate: _Estimate, equations: Equations, weighting: _Weighting, mismatched: BoolArray, std: FloatArray
) -> tuple[npt.NDArray[np.uint8], FloatArray]:
    """Status and misfit of every node (N,).

    Raises
    ------
    _UnsolvableError
        No node is measured.
    """
    misfits = misfit(weighting.residual, equations.weights, equations.textured)
    evidence = Evidence(
        textured=equations.textured,
        one_sided=one_sided_texture(equations, weighting.residual),
        mismatched=mismatched,
        near_mismatch=weighting.residual.reference.mesh.beside(mismatched),
        std=std[:, :2],
        misfit=misfits,
    )
    node_status = judge(evidence)
    if not (node_status == NodeStatus.MEASURED).any():
        one_sided = (evidence.one_sided & (node_status == NodeStatus.NOT_SEEN)).any()
        raise _UnsolvableError(
            "the texture runs in one direction only: what lies along it cannot be measured"
            if one_sided
            else "the images do not match anywhere in the region",
            estimate.history,
        )
    return node_status, misfits


def _with_curvature(
    reference: Reference, displacement: FloatArray, std: FloatArray, offset: CurvatureOffset, corrected: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement, strain and standard uncertainty (N, 5), the curvature's offset taken off or part of the latter."""
    if not corrected:
        whole = np.concatenate([offset.displacement, offset.strain], axis=1)
        return displacement, reference.strain(displacement), np.hypot(std, whole)
    displacement = displacement - offset.displacement
    return displacement, reference.strain(displacement) - offset.one_sided, std


def _shares(weights: FloatImage) -> FloatArray:
    """Mean share (k,) of each light in the sum of the weights (k, P)."""
    total = weights.sum(axis=0)
    return np.asarray((weights / np.where(total > 0, total, np.float32(1))).mean(axis=1, dtype=np.float64))
