"""The conclusion of a solve: the field at the nodes, its uncertainty, and which nodes count as measured.

The sources of uncertainty follow one another as on their page (docs/explanation/uncertainty.md): noise, carried through
the equations, with the rigid motions of the lights; what the gradients disagree by; what the biases of the lights
leave; all of it over the sensitivity of the deformed images. Of a node that still moves it is not known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.equations import Equations, Estimate, Problem, UnsolvableError
from rgbmidic.correlation.light_bias import light_bias
from rgbmidic.correlation.nodes import classify_nodes, misfit, one_sided_texture
from rgbmidic.correlation.residual import curved_deviation
from rgbmidic.correlation.solution import NO_MATCH, NodeStatus, Solution, Status
from rgbmidic.correlation.uncertainty import gradient_disagreement, standard_uncertainty
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from rgbmidic.correlation.solve import Weighting


@dataclass(frozen=True, slots=True, kw_only=True)
class _Field:
    """u, v, exx, eyy, exy at the nodes: values, standard uncertainty, and what the lights' biases leave of it, (N, 5).

    With the sensitivity (N,) of the deformed images, which is in both.
    """

    values: FloatArray
    std: FloatArray
    bias_std: FloatArray
    sensitivity: FloatArray


@stage("conclusion")
def conclude(problem: Problem, estimate: Estimate, equations: Equations, weighting: Weighting) -> Solution:
    """Conclude a solve from its last estimate, with the equations that gave it and the comparison there.

    Raises
    ------
    UnsolvableError
        Nothing is measured, or lights share too little texture for their rigid motions.
    """
    field = _field(problem, estimate, equations, weighting)
    node_status = _node_status(problem, equations, weighting, field)
    if reason := _failure(equations, weighting, field, node_status):
        raise UnsolvableError(reason, estimate)
    return _solution(problem, estimate, equations, weighting, field, node_status)


def _field(problem: Problem, estimate: Estimate, equations: Equations, weighting: Weighting) -> _Field:
    """Recover the field from the linear fit, correct it by the bias of the lights, and state its uncertainty."""
    mesh, residual, fitted = problem.reference.mesh, weighting.residual, estimate.displacement
    active = weighting.matched & equations.textured[mesh.elements].all(axis=1)
    recovery = Recovery.over(problem.reference.material, active, equations.information())
    curvature = map(equations.turned_back, recovery.offset_and_curvature(fitted))
    deviation = curved_deviation(problem.reference.material, residual.reference.pixels.barycentric, *curvature)
    table = BlockTable.of(residual, equations.weights, deviation=deviation)
    std = standard_uncertainty(table, equations, weighting.precision, recovery)
    std *= gradient_disagreement(residual, table, equations, recovery, std)[:, None]
    bias, bias_std = np.zeros_like(fitted), np.zeros_like(std)
    if weighting.precision is not None:
        bias, bias_std = light_bias(table, equations)
    sensitivity = table.over_elements().sensitivity(mesh.nodes)
    scale = 1 / np.maximum(sensitivity, 1e-3)[:, None]
    std = np.where(_unsettled(problem, estimate)[:, None], np.nan, np.hypot(std, bias_std) * scale)
    values = recovery.field(*(fitted + bias).T)
    return _Field(values=values, std=std, bias_std=bias_std * scale, sensitivity=sensitivity)


def _unsettled(problem: Problem, estimate: Estimate) -> BoolArray:
    """Nodes (N,) that swing between two matches: where they are many none, for then the frame has not converged."""
    is_moving = estimate.remainder * estimate.increments[-1] > problem.options.tolerance
    return np.asarray(is_moving & (is_moving.mean() < problem.constants.max_oscillating_fraction))


def _node_status(problem: Problem, equations: Equations, weighting: Weighting, field: _Field) -> npt.NDArray[np.uint8]:
    """`NodeStatus` of every node (N,)."""
    reference, std = problem.reference, field.std[:, :2]
    positions = reference.mesh.nodes + field.values[:, :2] - reference.offset(problem.deformed)
    inside = problem.deformed.contains(positions, std)
    return classify_nodes(equations, weighting.residual, weighting.matched, std, field.sensitivity, inside)


def _failure(equations: Equations, weighting: Weighting, field: _Field, node_status: npt.NDArray[np.uint8]) -> str:
    """Return why the solve has no solution; empty where it has one."""
    if not (node_status == NodeStatus.MEASURED).any():
        if np.isnan(field.std[equations.textured]).all():
            return "the region is too small for its elements: nothing is left of the noise to state an uncertainty"
        along = one_sided_texture(equations, weighting.residual) & (node_status == NodeStatus.NOT_SEEN)
        one_sided = "the texture runs in one direction only: what lies along it cannot be measured"
        return one_sided if along.any() else NO_MATCH
    if equations.rigid is not None and equations.rigid.unobservable.any():
        numbers = [str(number) for number in np.flatnonzero(equations.rigid.unobservable)]
        subject = f"lights {', '.join(numbers)} share" if len(numbers) > 1 else f"light {numbers[0]} shares"
        return (
            f"{subject} too little seen texture with light 0 (the first), directly or through others, to tell a rigid "
            "motion from displacement: widen what is seen (region, weights), measure the bodies apart, or set "
            'solver.rigid = "none"'
        )
    return ""


def _solution(
    problem: Problem,
    estimate: Estimate,
    equations: Equations,
    weighting: Weighting,
    field: _Field,
    node_status: npt.NDArray[np.uint8],
) -> Solution:
    """Put the solution together: displacement at the measured nodes, strain where those around are, too."""
    mesh, measured = problem.reference.mesh, np.asarray(node_status == NodeStatus.MEASURED)
    active = weighting.matched & equations.textured[mesh.elements].all(axis=1)
    inner = measured & ~mesh.adjacent_nodes(~measured) & (mesh.to_nodes(active.astype(np.float64)) > 0)
    squares = weighting.residual.squares(equations.weights)
    square, total, _ = squares.sum(axis=1).T
    sample = equations.weights[:, :: max(1, equations.weights.shape[1] // 100_000)]
    total_weight, history = sample.sum(axis=0), estimate.history(measured)
    converged = bool(estimate.remainder * history[-1] <= problem.options.tolerance)
    return replace(
        Solution.failed(mesh, len(equations.weights), "", history),
        displacement=np.where(measured[:, None], field.values[:, :2], np.nan),
        displacement_std=np.where(measured[:, None], field.std[:, :2], np.nan),
        bias_std=np.where(measured[:, None], field.bias_std[:, :2], np.nan),
        edge_std=np.where(measured[:, None], np.zeros(2), np.nan),
        strain=np.where(inner[:, None], field.values[:, 2:], np.nan),
        strain_std=np.where(inner[:, None], field.std[:, 2:], np.nan),
        node_status=node_status,
        light_fraction=equations.light_fraction,
        misfit=np.where(measured, misfit(mesh, squares, equations.textured), np.nan),
        status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
        reason="" if converged else _last_motion(problem, estimate, measured),
        rigid=np.where(total[:, None] > 0, estimate.rigid, np.nan),
        residual=np.sqrt(np.divide(square, total, out=np.full(total.size, np.nan), where=total > 0)),
        weight_fraction=np.mean(
            sample / np.where(total_weight > 0, total_weight, np.float32(1)), axis=1, dtype=np.float64
        ),
    )


def _last_motion(problem: Problem, estimate: Estimate, measured: BoolArray) -> str:
    """Report which of the `measured` nodes (N,) the last iteration still moved, and where."""
    motion, tolerance = np.where(measured, estimate.increments[-1], 0.0), problem.options.tolerance
    x, y = problem.reference.mesh.nodes[motion.argmax()] + problem.reference.origin
    return (
        f"iteration {len(estimate.increments)}, the last, still moved {int((motion > tolerance).sum())} of "
        f"{int(measured.sum())} nodes by more than the tolerance of {tolerance:g} px, most the one at x {x:.0f}, "
        f"y {y:.0f}: by {motion.max():.3g} px"
    )
