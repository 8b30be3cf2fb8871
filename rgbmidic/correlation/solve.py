"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3), with weights from its residual.

The unknowns are the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first,
of the criterion ``sum_j sum_x p_j r_j(x)^2``. The residual r_j is the difference of f_j(x) and g_j(x + u + R beta_j),
corrected for brightness. A rigid motion is linear in x, so it lies in the TRI3 space: the nodal displacement of light j
is ``u + R beta_j`` and its derivative is the light's Hessian times R. The gradient of the reference image stands for
that of the deformed one, carried along by the deformation gradient of the surface, so the Hessian is constant as long
as the weights are (docs: how it works).

The loop is: assemble the equations, solve them by Gauss-Newton iterations, compare the states, weigh elements and
lights; until the weights have converged; then conclude. Every step is a function from frozen states to a frozen state,
and none depends on how many came before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic._kernels.threads import one_blas_thread
from rgbmidic.correlation.assembly import rigid_functions
from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.equations import (
    Equations,
    Estimate,
    Problem,
    UnsolvableError,
    compare,
    iterate,
)
from rgbmidic.correlation.light_bias import light_bias, with_consistent_gradient
from rgbmidic.correlation.nodes import classify_nodes, matching_elements, misfit, one_sided_texture
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import PrecisionMethod, Residual, refine_by_patch_matching
from rgbmidic.correlation.solution import NO_MATCH, NodeStatus, Solution, Status
from rgbmidic.correlation.uncertainty import excess_over_chance, gradient_step, standard_uncertainty
from rgbmidic.errors import InputError
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic.weights.precision import Precision


@dataclass(frozen=True, slots=True, kw_only=True)
class Weighting:
    """Elements and lights that the equations are assembled from, as the residual at an estimate determines them.

    Attributes
    ----------
    residual
        At the estimate, with the weights warped.
    matched : ndarray, shape (E,), bool
        Elements that take part.
    precision
        Of the lights; None: not learnt.
    learnt_at : ndarray, shape (N, 2)
        Displacement at which precision and grey levels of the reference were learnt, px; None: not yet.
    """

    residual: Residual
    matched: BoolArray
    precision: Precision | None = None
    learnt_at: FloatArray | None = None

    def weights(self, pixels: slice = slice(None)) -> FloatImage:
        """Weights (k, P) of pixels."""
        weights = self.prior_weights(pixels)
        return weights if self.precision is None else weights * self.precision.factor[:, pixels]

    def prior_weights(self, pixels: slice = slice(None)) -> FloatImage:
        """Weights (k, P) of pixels without the precision of the lights."""
        weights = self.residual.weights[:, pixels]
        if self.matched.all():
            return weights
        return weights * np.repeat(self.matched, np.diff(self.residual.reference.pixels.offsets))[pixels]

    def has_converged(self, equations: Equations) -> bool:
        """Return True if the equations would be assembled from the same reference and weights again."""
        if self.residual.reference is not equations.reference:
            return False
        # of 10,000 pixels a change of all weights by a thousandth is known to 1 % of it
        sample = slice(None, None, equations.weights.shape[1] // 10_000 + 1)
        weights = self.weights(sample)
        total, change = float(weights.sum()), float(np.abs(weights - equations.weights[:, sample]).sum())
        return total > 0 and change <= 1e-3 * total


@stage("weights")
def initial_weighting(problem: Problem, estimate: Estimate, residual: Residual | None = None) -> Weighting:
    """Return the weighting at the initial guess, where the `residual` may be known."""
    residual = residual or compare(problem, estimate)
    matched = matching_elements(residual, estimate.displacement, min_zncc=problem.constants.min_initial_zncc)
    return Weighting(residual=residual, matched=matched)


@stage("weights")
def weigh(problem: Problem, last: Weighting, equations: Equations, estimate: Estimate) -> Weighting:
    """Compare the states at an estimate: which elements match, and how much each light counts.

    The precision of the lights, and what the reference is compared by, are learnt anew where the nodes have moved. As
    long as they stay, elements may leave but not take part again: at a fragment's edge some would come and go.
    """
    constants, displacement = problem.constants, estimate.displacement
    if last.learnt_at is not None:
        motion = np.hypot(*(displacement - last.learnt_at).T)[equations.textured]
        if np.sqrt((motion**2).mean()) <= constants.reweight_motion:
            residual = compare(problem, estimate, last.residual.reference)
            matched = last.matched & matching_elements(residual, displacement, last.precision)
            matched = _held_elements(problem, last, equations, estimate, residual, matched)
            return replace(last, residual=residual, matched=matched)
    residual = compare(problem, estimate, problem.reference.filtered_as(displacement))
    # of the residual that the displacement minimises: by other grey levels it is not yet the best
    minimised = residual.with_values(last.residual.reference.values)
    precision = None if problem.method is None else problem.method.precision(minimised)
    matched = matching_elements(residual, displacement, precision)
    matched = _held_elements(problem, last, equations, estimate, residual, matched)
    weighting = Weighting(residual=residual, matched=matched, learnt_at=displacement)
    if problem.method is not None and not matched.all():
        # the residual of elements that match nothing would count in the variance around them
        precision = problem.method.precision(replace(minimised, weights=weighting.prior_weights()))
    weighting = replace(weighting, precision=precision)
    adapted = with_consistent_gradient(residual, weighting.weights())
    if adapted.brightness != "auto" or residual.smooth_fraction <= constants.max_smooth_fraction:
        return replace(weighting, residual=replace(residual, reference=adapted))
    assert adapted.gain_window is not None  # without one nothing is smooth
    narrow = adapted.with_gain_window(adapted.gain_window / constants.gain_window_ratio)
    residual = compare(problem, estimate, narrow)
    precision = None if problem.method is None else problem.method.precision(residual)
    return replace(weighting, residual=residual, precision=precision)


def _held_elements(
    problem: Problem,
    last: Weighting,
    equations: Equations,
    estimate: Estimate,
    residual: Residual,
    matched: BoolArray,
) -> BoolArray:
    """Return the matched elements (E,) less those with a node that the images do not hold, where some may have none.

    A one-sided texture does not hold a node either, but matches.
    """
    if matched.all() and estimate.has_settled:
        return matched
    table = BlockTable.of(residual, equations.weights, wide=True).together()
    std = standard_uncertainty(residual, table, equations, last.precision)
    lost = (std.max(axis=1) > problem.constants.max_std) & ~one_sided_texture(equations, residual)
    return np.asarray(matched & ~lost[problem.reference.mesh.elements].any(axis=1))


def solve(
    reference: Reference,
    deformed: Deformed,
    initial: FloatArray,
    options: SolverSettings,
    method: PrecisionMethod | None,
    residual: Residual | None = None,
) -> Solution:
    """Find the displacement of the reference mesh with which the warped deformed images match the reference ones.

    Parameters
    ----------
    reference, deformed
        The two states, prepared with the same prefilter.
    initial : ndarray, shape (N, 2)
        Initial guess of the displacement (u, v) in px, within 8 px of the solution.
    options
        Rigid functions, tolerance and iterations; prefilter and brightness are those of the two states.
    method
        Learns the lights' precision from the residual, such as `rgbmidic.weights.Statistics`; None leaves the weights
        as they are given.
    residual
        At the initial guess, if it is known.

    Returns
    -------
    Solution
        Nodes that no light sees are NaN and flagged; a failed solve is NaN everywhere, with status and reason.

    Raises
    ------
    InputError
        The two states have different numbers of images, or `initial` does not fit the mesh.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> random = np.random.default_rng(0)
    >>> speckle = 2 + gaussian_filter(random.normal(size=(1, 80, 80)), (0, 1.5, 1.5)).astype(np.float32)
    >>> region = Region.from_rectangle((10, 10, 69, 69), shape=(80, 80))
    >>> reference = Reference.prepare(speckle, region, mesh=Tri3Mesh.from_region(region, element_size=30))
    >>> deformed = Deformed.prepare(np.roll(speckle, 1, axis=2))
    >>> solution = solve(reference, deformed, np.zeros_like(reference.mesh.nodes), SolverSettings(), None)
    >>> solution.displacement.mean(axis=0).round(2).tolist()
    [1.0, 0.0]
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
        method=method,
        functions=rigid_functions(reference.mesh.nodes, options.rigid),
    )
    rigid = np.zeros((len(reference.images), problem.functions.shape[1]))
    try:
        with one_blas_thread():
            return _solve(problem, Estimate(displacement=initial, rigid=rigid), residual)
    except UnsolvableError as error:
        return Solution.failed(reference.mesh, len(reference.images), str(error), error.history)


def _solve(problem: Problem, estimate: Estimate, residual: Residual | None) -> Solution:
    options = problem.options
    estimate, weighting = _refine_initial_guess(problem, estimate, residual)
    for _ in range(8):  # two or three do, but where elements come and go
        equations = assemble(problem, weighting, estimate)
        estimate = iterate(problem, equations, weighting.residual, estimate)
        weighting = weigh(problem, weighting, equations, estimate)
        is_settled = estimate.longest <= options.tolerance and weighting.has_converged(equations)
        if is_settled or len(estimate.increments) >= options.max_iterations:
            break
    return conclude(problem, estimate, equations, weighting)


@stage("search")
def _refine_initial_guess(
    problem: Problem, estimate: Estimate, residual: Residual | None
) -> tuple[Estimate, Weighting]:
    """Bring the initial guess nearer where elements do not match there; what does not match then is left out."""
    weighting = initial_weighting(problem, estimate, residual)
    if weighting.matched.all():
        return estimate, weighting
    refined = replace(estimate, displacement=refine_by_patch_matching(weighting.residual, estimate.displacement))
    nearer = initial_weighting(problem, refined)
    if nearer.matched.sum() <= weighting.matched.sum():
        return estimate, weighting
    return refined, replace(nearer, matched=matching_elements(nearer.residual, refined.displacement))


@stage("equations")
def assemble(problem: Problem, weighting: Weighting, estimate: Estimate) -> Equations:
    """Assemble the equations for a weighting.

    Raises
    ------
    UnsolvableError
        Nothing is left to be measured.
    """
    has_data = np.any(weighting.residual.moments[:, weighting.matched, 0] > 0, axis=1)
    if not has_data.any():
        raise UnsolvableError(_nothing_left(weighting), estimate)
    if problem.functions.shape[1] and not has_data[0]:
        raise UnsolvableError(
            "the first light sees nothing, and the rigid motions of the others are counted from it: "
            "put a light first that sees, or measure without rigid motions",
            estimate,
        )
    prior_weights = None if weighting.precision is None else weighting.prior_weights()
    try:
        equations = Equations.build(
            weighting.residual.reference, weighting.weights(), problem.functions, estimate.displacement, prior_weights
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


@stage("conclusion")
def conclude(problem: Problem, estimate: Estimate, equations: Equations, weighting: Weighting) -> Solution:
    """Conclude the solve: which nodes count as measured, their values and uncertainty."""
    reference, mesh = weighting.residual.reference, problem.reference.mesh
    active = weighting.matched & equations.textured[mesh.elements].all(axis=1)
    recovery = Recovery.over(reference.material, active, equations.information())
    fitted = estimate.displacement
    residual = weighting.residual.subtract_curvature(*map(equations.turned_back, recovery.offset_and_curvature(fitted)))
    table = BlockTable.of(residual, equations.weights, wide=True).together()
    std = standard_uncertainty(residual, table, equations, weighting.precision, recovery)
    if len(equations.weights) > 1:
        step = recovery.value @ gradient_step(weighting.residual, equations)
        excess = excess_over_chance(step, std[:, :2], residual, table, equations.weights)
        std = std * np.hypot(1, excess)[:, None]
    bias, bias_std = np.zeros_like(fitted), np.zeros_like(std)
    if weighting.precision is not None:
        bias, bias_std = light_bias(BlockTable.of(residual, equations.weights), equations)
    sensitivity = table.sensitivity(mesh.nodes)
    scale = 1 / np.maximum(sensitivity, 1e-3)[:, None]
    fitted, std, bias_std = fitted + bias, np.hypot(std, bias_std) * scale, bias_std * scale
    field = recovery.field(*fitted.T)
    # nodes that swing between two matches: where they are few their values are not known, else the frame's are not
    is_moving = estimate.increments[-1] > problem.options.tolerance
    if is_moving.mean() < problem.constants.max_oscillating_fraction:
        std = np.where(is_moving[:, None], np.nan, std)
    positions = mesh.nodes + field[:, :2] - reference.offset(problem.deformed)
    inside = problem.deformed.contains(positions, std[:, :2])
    node_status = classify_nodes(equations, weighting.residual, weighting.matched, std[:, :2], sensitivity, inside)
    measured = np.asarray(node_status == NodeStatus.MEASURED)
    if not measured.any() and np.isnan(std[equations.textured]).all():
        raise UnsolvableError(
            "the region is too small for its elements: nothing is left of the noise to state an uncertainty", estimate
        )
    if not measured.any():
        along = one_sided_texture(equations, weighting.residual) & (node_status == NodeStatus.NOT_SEEN)
        one_sided = "the texture runs in one direction only: what lies along it cannot be measured"
        raise UnsolvableError(one_sided if along.any() else NO_MATCH, estimate)
    if equations.rigid is not None and equations.rigid.unobservable.any():
        numbers = [str(number) for number in np.flatnonzero(equations.rigid.unobservable)]
        subject = f"lights {', '.join(numbers)} share" if len(numbers) > 1 else f"light {numbers[0]} shares"
        raise UnsolvableError(
            f"{subject} too little seen texture with light 0 (the first), directly or through others, to tell a rigid "
            "motion from displacement: widen what is seen (region, weights), measure the bodies apart, or set "
            'solver.rigid = "none"',
            estimate,
        )
    inner = measured & ~mesh.adjacent_nodes(~measured) & (mesh.to_nodes(active.astype(np.float64)) > 0)
    squares = weighting.residual.squares(equations.weights)
    square, total, _ = squares.sum(axis=1).T
    sample = equations.weights[:, :: max(1, equations.weights.shape[1] // 100_000)]
    total_weight, history = sample.sum(axis=0), estimate.history(measured)
    converged = bool(history[-1] <= problem.options.tolerance)
    return replace(
        Solution.failed(mesh, len(reference.images), "", history),
        displacement=np.where(measured[:, None], field[:, :2], np.nan),
        displacement_std=np.where(measured[:, None], std[:, :2], np.nan),
        bias_std=np.where(measured[:, None], bias_std[:, :2], np.nan),
        edge_std=np.where(measured[:, None], np.zeros(2), np.nan),
        strain=np.where(inner[:, None], field[:, 2:], np.nan),
        strain_std=np.where(inner[:, None], std[:, 2:], np.nan),
        node_status=node_status,
        light_fraction=equations.light_fraction,
        misfit=np.where(measured, misfit(mesh, squares, equations.textured), np.nan),
        status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
        reason="" if converged else _unsettled(problem, estimate, measured),
        rigid=np.where(total[:, None] > 0, estimate.rigid, np.nan),
        residual=np.sqrt(np.divide(square, total, out=np.full(total.size, np.nan), where=total > 0)),
        weight_fraction=np.mean(
            sample / np.where(total_weight > 0, total_weight, np.float32(1)), axis=1, dtype=np.float64
        ),
    )


def _unsettled(problem: Problem, estimate: Estimate, measured: BoolArray) -> str:
    """Report which of the `measured` nodes (N,) the last iteration still moved, and where."""
    motion, tolerance = np.where(measured, estimate.increments[-1], 0.0), problem.options.tolerance
    x, y = problem.reference.mesh.nodes[motion.argmax()] + problem.reference.origin
    return (
        f"iteration {len(estimate.increments)}, the last, still moved {int((motion > tolerance).sum())} of "
        f"{int(measured.sum())} nodes by more than the tolerance of {tolerance:g} px, most the one at x {x:.0f}, "
        f"y {y:.0f}: by {motion.max():.3g} px"
    )
