"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3), in passes with new weights.

The unknowns are the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first,
of the criterion ``sum_j sum_x p_j r_j(x)^2``. The residual r_j is the difference of f_j(x) and g_j(x + u + R beta_j),
corrected for brightness. A rigid motion is linear in x, so it lies in the TRI3 space: the nodal displacement of light j
is ``u + R beta_j`` and its derivative is the light's Hessian times R. The gradient of the reference image stands for
that of the deformed one, carried along by the deformation gradient of the surface, so the Hessian is constant within a
pass (docs: how it works).

One pass after the other: equations -> iterate -> compare the states -> match -> weigh; then conclude. Every step is a
function from frozen states to a frozen state. A `Weighting` holds what a pass begins with: the residual, which elements
match, and how precise each light is.
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
    """Elements and lights of a pass, as the residual at an estimate determines them.

    Attributes
    ----------
    residual
        At the estimate, with the weights warped.
    matched : ndarray, shape (E,), bool
        Elements that take part.
    precision
        Of the lights; None: not learnt.
    reweight_until : int
        The passes up to the one after this number begin with weights that are learnt anew.
    weighting_displacement : ndarray, shape (N, 2)
        Displacement at which the precision was learnt, px.
    """

    residual: Residual
    matched: BoolArray
    precision: Precision | None = None
    reweight_until: int = 0
    weighting_displacement: FloatArray

    def weights(self, pixels: slice = slice(None)) -> FloatImage:
        """Weights (k, P) of pixels in the next pass."""
        weights = self.prior_weights(pixels)
        return weights if self.precision is None else weights * self.precision.factor[:, pixels]

    def prior_weights(self, pixels: slice = slice(None)) -> FloatImage:
        """Weights (k, P) of pixels without the precision of the lights."""
        weights = self.residual.weights[:, pixels]
        if self.matched.all():
            return weights
        return weights * np.repeat(self.matched, np.diff(self.residual.reference.pixels.offsets))[pixels]


@stage("weights")
def first_weighting(problem: Problem, estimate: Estimate, residual: Residual | None = None) -> Weighting:
    """Return the weighting of the first pass, at the initial guess, where the `residual` may be known."""
    residual = residual or compare(problem, estimate)
    return Weighting(
        residual=residual,
        matched=matching_elements(residual, estimate.displacement, min_zncc=problem.constants.min_initial_zncc),
        weighting_displacement=estimate.displacement,
    )


@stage("weights")
def next_weighting(
    problem: Problem, last: Weighting, equations: Equations, estimate: Estimate, number: int
) -> Weighting:
    """Find residual, matching and precision anew at the displacement found by pass `number`."""
    residual, method = compare(problem, estimate), problem.method
    # the residual that the pass has minimised: by other grey levels the displacement is not yet the best
    minimised = residual.with_values(last.residual.reference.values)
    # without the precision of the lights, which the first pass has not, an element half on another body may match
    precision = last.precision if number or method is None else method.precision(minimised)
    matched = matching_elements(residual, estimate.displacement, precision)
    if not matched.all() or estimate.longest > problem.constants.first_pass_tolerance:
        lost = _lost_nodes(problem, last, equations, residual, estimate, number)
        matched &= ~lost[problem.reference.mesh.elements].any(axis=1)
    if number >= problem.constants.max_reactivation_passes:
        matched &= last.matched
    reweight_until = _reweight_until(last, matched, equations, estimate, number)
    weighting = replace(last, residual=residual, matched=matched, reweight_until=reweight_until)
    if not is_reweighting(problem, weighting, number + 1):
        return weighting
    return replace(
        weighting,
        precision=precision if number == 0 or method is None else method.precision(minimised),
        weighting_displacement=estimate.displacement,
    )


def _lost_nodes(
    problem: Problem, last: Weighting, equations: Equations, residual: Residual, estimate: Estimate, number: int
) -> BoolArray:
    """Find the nodes (N,) that leave the next pass; a one-sided texture does not hold a node either, but matches."""
    table = BlockTable.of_all(residual, equations.weights)
    std = standard_uncertainty(residual, table, equations, last.precision)
    unheld = std.max(axis=1) > problem.constants.max_std
    wanders = np.zeros(len(unheld), dtype=bool)
    if (
        number >= problem.constants.max_reactivation_passes
        and len(estimate.increments) < problem.options.max_iterations
    ):
        before, motion = estimate.increments[-2:]
        wanders = motion > np.maximum(problem.constants.divergence_step, before / 2)
    return np.asarray((unheld | wanders) & ~one_sided_texture(equations, residual))


def _reweight_until(last: Weighting, matched: BoolArray, equations: Equations, estimate: Estimate, number: int) -> int:
    """Return `Weighting.reweight_until` for the next pass.

    Where elements take part again, what was learnt from their wrong match must be learnt anew, and once more: in the
    pass in which they do the residual is still that of a wrong match. It is learnt once more where the nodes have moved
    since, and twice where another body at the region's rim has drawn the edge.
    """
    if (matched & ~last.matched).any():
        return number + 1
    constants = last.residual.reference.constants
    if last.precision is not None and last.precision.rim_differs:
        return max(last.reweight_until, constants.max_reactivation_passes)
    motion = np.hypot(*(estimate.displacement - last.weighting_displacement).T)[equations.textured]
    has_moved = (
        number == 1 < len(last.residual.weights)
        and (motion > constants.reweight_motion).mean() > constants.max_oscillating_fraction
    )
    return max(last.reweight_until, number) if has_moved else last.reweight_until


def weights_converged(weighting: Weighting, equations: Equations) -> bool:
    """Return True if the next pass would have the weights of the last one."""
    constants = weighting.residual.reference.constants
    sample = slice(None, None, equations.weights.shape[1] // constants.sample_count + 1)
    weights = weighting.weights(sample)
    total = float(weights.sum())
    return (
        total > 0 and float(np.abs(weights - equations.weights[:, sample]).sum()) <= constants.weight_tolerance * total
    )


def is_reweighting(problem: Problem, weighting: Weighting, number: int) -> bool:
    """Return True if pass `number` begins with weights that are learnt anew."""
    return problem.method is not None and number <= weighting.reweight_until + 1


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
            return _conclude(*_passes(problem, Estimate(displacement=initial, rigid=rigid), residual))
    except UnsolvableError as error:
        return Solution.failed(reference.mesh, len(reference.images), str(error), error.history)


def _passes(
    problem: Problem, estimate: Estimate, residual: Residual | None
) -> tuple[Problem, Estimate, Equations, Weighting]:
    """Run passes until the weights have settled; the problem is returned with the lights' gradients decided."""
    tolerance = problem.options.tolerance
    estimate, weighting = _refine_initial_guess(problem, estimate, residual)
    equations: Equations | None = None
    for number in range(problem.constants.max_passes):
        if (
            equations is not None
            and not is_reweighting(problem, weighting, number)
            and weights_converged(weighting, equations)
        ):
            break
        equations = _equations(problem, weighting, estimate)
        pass_tolerance = max(tolerance, problem.constants.first_pass_tolerance) if number == 0 else tolerance
        estimate = iterate(problem, equations, weighting.residual, estimate, pass_tolerance)
        reference = problem.reference
        if number == 0:
            problem = replace(problem, reference=reference.filtered_as(estimate.displacement))
        weighting = next_weighting(problem, weighting, equations, estimate, number)
        if number == 0:
            problem, weighting = _adapt_reference(problem, weighting, estimate)
            equations = equations if problem.reference is reference else None
    assert equations is not None
    if estimate.longest > tolerance:
        estimate = iterate(problem, equations, weighting.residual, estimate, tolerance)
        oscillating = equations.textured & (estimate.increments[-1] > tolerance)
        matched = weighting.matched & ~oscillating[problem.reference.mesh.elements].any(axis=1)
        is_minority = 0 < oscillating.mean() < problem.constants.max_oscillating_fraction and matched.any()
        if is_minority and len(estimate.increments) < problem.options.max_iterations:
            weighting = replace(weighting, residual=compare(problem, estimate), matched=matched)
            equations = _equations(problem, weighting, estimate)
            estimate = iterate(problem, equations, weighting.residual, estimate, tolerance)
        weighting = replace(weighting, residual=compare(problem, estimate))
    return problem, estimate, equations, weighting


def _adapt_reference(problem: Problem, weighting: Weighting, estimate: Estimate) -> tuple[Problem, Weighting]:
    """Adapt the reference's gradients, and the window of the gain, to what the first pass shows."""
    constants, residual = problem.constants, weighting.residual
    adapted = with_consistent_gradient(residual, weighting.weights())
    if adapted.brightness != "auto" or residual.smooth_fraction <= constants.max_smooth_fraction:
        problem = replace(problem, reference=adapted)
        return problem, replace(weighting, residual=replace(residual, reference=adapted))
    assert adapted.gain_window is not None  # without one nothing is smooth
    narrow = adapted.with_gain_window(adapted.gain_window / constants.gain_window_ratio)
    problem = replace(problem, reference=narrow)
    residual, precision = compare(problem, estimate), weighting.precision
    if problem.method is not None:
        precision = problem.method.precision(residual)
    return problem, replace(weighting, residual=residual, precision=precision)


@stage("search")
def _refine_initial_guess(
    problem: Problem, estimate: Estimate, residual: Residual | None
) -> tuple[Estimate, Weighting]:
    """Bring the initial guess nearer where elements do not match there; what does not match then is left out."""
    weighting = first_weighting(problem, estimate, residual)
    if weighting.matched.all():
        return estimate, weighting
    refined = replace(estimate, displacement=refine_by_patch_matching(weighting.residual, estimate.displacement))
    nearer = first_weighting(problem, refined)
    if nearer.matched.sum() <= weighting.matched.sum():
        return estimate, weighting
    return refined, replace(nearer, matched=matching_elements(nearer.residual, refined.displacement))


@stage("equations")
def _equations(problem: Problem, weighting: Weighting, estimate: Estimate) -> Equations:
    """Build the equations of the next pass.

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
            problem.reference, weighting.weights(), problem.functions, estimate.displacement, prior_weights
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
def _conclude(problem: Problem, estimate: Estimate, equations: Equations, weighting: Weighting) -> Solution:
    """Conclude the solve: which nodes count as measured, their values and uncertainty."""
    reference, mesh = problem.reference, problem.reference.mesh
    active = weighting.matched & equations.textured[mesh.elements].all(axis=1)
    recovery = Recovery.over(reference.material, active, equations.information(reference))
    fitted = estimate.displacement
    residual = weighting.residual.subtract_curvature(*map(equations.turned_back, recovery.offset_and_curvature(fitted)))
    table = BlockTable.of_all(residual, equations.weights)
    std = standard_uncertainty(residual, table, equations, weighting.precision, recovery)
    if len(equations.weights) > 1:
        step = recovery.value @ gradient_step(weighting.residual, equations)
        excess = excess_over_chance(step, std[:, :2], residual, table, equations.weights)
        std = std * np.hypot(1, excess)[:, None]
    bias, bias_std = np.zeros_like(fitted), np.zeros_like(std)
    if weighting.precision is not None:
        lights = BlockTable.of_lights(residual, equations.weights, problem.constants.min_block_side)
        bias, bias_std = light_bias(lights, equations)
    sensitivity = table.sensitivity(mesh.nodes)
    scale = 1 / np.maximum(sensitivity, 1e-3)[:, None]
    fitted, std, bias_std = fitted + bias, np.hypot(std, bias_std) * scale, bias_std * scale
    field = recovery.field(*fitted.T)
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
