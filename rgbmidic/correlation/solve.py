"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3).

Minimised over the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first:
``sum_j integral (g_j(x + u + R beta_j) - f_j(x))^2 p_j dx``. A rigid motion is linear in x, so it lies in the TRI3
space: the light's own nodal displacement is ``u + R beta_j`` and its derivative is the light's Hessian times R.
The gradient of the reference image stands for that of the deformed one, turned by the surface's own rotation, so the
Hessian is constant within a pass.

One pass after the other: compare the states -> match -> weigh -> equations -> iterate; then conclude. Every step is a
function from frozen states to a frozen state.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import one_blas_thread
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.iteration import Estimate, Problem, UnsolvableError, compare, iterate
from rgbmidic.correlation.matching import misfit
from rgbmidic.correlation.node_status import Evidence, judge, one_sided_texture
from rgbmidic.correlation.recovery import Recovery
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.rigid import rigid_functions
from rgbmidic.correlation.solution import NO_MATCH, NodeStatus, Solution, Status
from rgbmidic.correlation.weighting import (
    FIRST_PASS,
    Weighting,
    first_weighting,
    next_weighting,
    refining,
    settled,
    standard_uncertainty,
)
from rgbmidic.errors import InputError
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["solve"]

_PASSES = 8
"""Most passes: each brings the weights back with the latest displacement."""


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
        Rigid functions, grey-level correction, tolerance and iterations.
    statistics
        Weight every light by the inverse variance of its own residual around each pixel, robustly.

    Returns
    -------
    Solution
        Nodes that no light sees are NaN and flagged; a failed solve is NaN everywhere, with status and reason.

    Raises
    ------
    InputError
        The two states have different numbers of images, or `initial` does not fit the mesh.
    """
    if len(deformed.weights) != len(reference.images):
        raise InputError(
            f"reference and deformed state must have as many images; given are {len(reference.images)} and "
            f"{len(deformed.weights)}"
        )
    if initial.shape != reference.mesh.nodes.shape or not np.isfinite(initial).all():
        raise InputError(f"the initial displacement must be finite with shape {reference.mesh.nodes.shape}")
    problem = Problem(
        reference=reference,
        deformed=deformed,
        options=options,
        statistics=statistics,
        functions=rigid_functions(reference.mesh.nodes, options.rigid),
    )
    try:
        with one_blas_thread():
            return _conclude(problem, *_passes(problem, Estimate.start(problem, initial)))
    except UnsolvableError as error:
        return Solution.failed(reference.mesh, len(reference.images), str(error), error.history)


def _passes(problem: Problem, estimate: Estimate) -> tuple[Estimate, Equations, Weighting]:
    """Passes until the weights have settled."""
    tolerance = problem.options.tolerance
    weighting = first_weighting(problem, estimate)
    equations: Equations | None = None
    for number in range(_PASSES):
        if equations is not None and not refining(problem, weighting, number) and settled(weighting, equations):
            break
        equations = _equations(problem, weighting, estimate)
        reached = max(tolerance, FIRST_PASS) if number == 0 else tolerance
        estimate = iterate(problem, equations, weighting.values, weighting.residual, estimate, reached)
        weighting = next_weighting(problem, weighting, equations, estimate, number)
    assert equations is not None
    if estimate.longest > tolerance:
        estimate = iterate(problem, equations, weighting.values, weighting.residual, estimate, tolerance)
        weighting = replace(weighting, residual=compare(problem, weighting.values, estimate))
    return estimate, equations, weighting


@stage("equations")
def _equations(problem: Problem, weighting: Weighting, estimate: Estimate) -> Equations:
    """The equations of the next pass.

    Raises
    ------
    UnsolvableError
        Nothing is left to be measured.
    """
    seen = weighting.seen
    if not seen.any():
        raise UnsolvableError(_nothing_left(weighting), estimate)
    if problem.functions.shape[1] and not seen[0]:
        raise UnsolvableError(
            "the first light sees nothing, and the rigid motions of the others are counted from it: "
            "put a light first that sees, or measure without rigid motions",
            estimate,
        )
    given = None if weighting.precision is None else weighting.given
    try:
        equations = Equations.build(
            problem.reference, weighting.weights, problem.functions, estimate.displacement, given
        )
    except np.linalg.LinAlgError as error:
        raise UnsolvableError(f"the equations cannot be solved: {error}", estimate) from None
    if not equations.textured.any():
        raise UnsolvableError(_nothing_left(weighting), estimate)
    return equations


def _nothing_left(weighting: Weighting) -> str:
    if not weighting.matched.all():
        return NO_MATCH
    if not weighting.residual.weights.any():
        return "no light sees the region: every weight is zero"
    return "the images have no texture in the region"


def _hidden(lights: BoolArray) -> str:
    numbers = [str(number) for number in np.flatnonzero(lights)]
    named = f"lights {', '.join(numbers)} share" if len(numbers) > 1 else f"light {numbers[0]} shares"
    return (
        f"{named} too little seen texture with light 0 (the first), directly or through others, to tell a rigid motion "
        "from displacement: widen what is seen (region, weights), measure the bodies apart, or set "
        'solver.rigid = "none"'
    )


@stage("conclusion")
def _conclude(problem: Problem, estimate: Estimate, equations: Equations, weighting: Weighting) -> Solution:
    """The solution: what counts, how certain it is, in which unit."""
    reference, options, mesh = problem.reference, problem.options, problem.reference.mesh
    mismatched = np.zeros(len(mesh.nodes), dtype=bool)
    mismatched[mesh.elements[~weighting.matched]] = True
    used = weighting.matched & equations.textured[mesh.elements].all(axis=1)
    recovery = Recovery.over(reference.material, used, equations.information(reference), reference.linear_offset)
    fitted = estimate.displacement
    residual = weighting.residual.without(*recovery.bend(fitted, reference.linear_offset))
    std = standard_uncertainty(residual, equations, weighting.precision, recovery)
    squares = weighting.residual.squares(equations.weights)
    misfits = misfit(mesh, squares, equations.textured)
    node_status = _judged(estimate, equations, weighting, mismatched, std, misfits)
    if equations.rigid is not None and equations.rigid.hidden.any():
        raise UnsolvableError(_hidden(equations.rigid.hidden), estimate)
    measured = node_status == NodeStatus.MEASURED
    inner = measured & ~mesh.beside(~measured) & (mesh.to_nodes(used.astype(np.float64)) > 0)
    square, total, _ = squares.sum(axis=1).T
    history = estimate.history(measured)
    converged = bool(history[-1] <= options.tolerance)
    return Solution(
        nodes=mesh.nodes,
        elements=mesh.elements,
        displacement=np.where(measured[:, None], recovery.displacement(fitted), np.nan),
        displacement_std=np.where(measured[:, None], std[:, :2], np.nan),
        strain=np.where(inner[:, None], recovery.strain(fitted), np.nan),
        strain_std=np.where(inner[:, None], std[:, 2:], np.nan),
        node_status=node_status,
        light_share=equations.light_share,
        misfit=np.where(measured, misfits, np.nan),
        status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
        reason="" if converged else _unsettled(problem, estimate, measured),
        rigid=np.where(np.any(equations.weights, axis=1, keepdims=True), estimate.rigid, np.nan),
        residual=np.sqrt(np.divide(square, total, out=np.full(total.size, np.nan), where=total > 0)),
        weight_share=_shares(equations.weights),
        history=history,
    )


def _judged(
    estimate: Estimate,
    equations: Equations,
    weighting: Weighting,
    mismatched: BoolArray,
    std: FloatArray,
    misfits: FloatArray,
) -> npt.NDArray[np.uint8]:
    """Status of every node (N,).

    Raises
    ------
    UnsolvableError
        No node is measured.
    """
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
        raise UnsolvableError(
            "the texture runs in one direction only: what lies along it cannot be measured" if one_sided else NO_MATCH,
            estimate,
        )
    return node_status


def _unsettled(problem: Problem, estimate: Estimate, measured: BoolArray) -> str:
    """Where the last iteration still moved which of the `measured` nodes (N,)."""
    motion, tolerance = np.where(measured, estimate.increments[-1], 0.0), problem.options.tolerance
    x, y = problem.reference.mesh.nodes[motion.argmax()] + problem.reference.origin
    return (
        f"iteration {len(estimate.increments)}, the last, still moved {int((motion > tolerance).sum())} of "
        f"{int(measured.sum())} nodes by more than the tolerance of {tolerance:g} px, most the one at x {x:.0f}, "
        f"y {y:.0f}: by {motion.max():.3g} px"
    )


def _shares(weights: FloatImage) -> FloatArray:
    """Mean share (k,) of each light in the sum of the weights (k, P), over about 100 000 pixels."""
    some = weights[:, :: max(1, weights.shape[1] // 100_000)]
    total = some.sum(axis=0)
    return np.asarray((some / np.where(total > 0, total, np.float32(1))).mean(axis=1, dtype=np.float64))
