"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3), with weights from its residual.

The unknowns are the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first,
of the criterion ``sum_j sum_x p_j r_j(x)^2``. The residual r_j is the difference of f_j(x) and g_j(x + u + R beta_j),
corrected for brightness. A rigid motion is linear in x, so it lies in the TRI3 space: the nodal displacement of light j
is ``u + R beta_j`` and its derivative is the light's Hessian times R. The gradient of the reference image stands for
that of the deformed one, carried along by the deformation gradient of the surface, so the Hessian is constant as long
as the weights are (docs: how it works).

The loop is: compare the states, weigh elements and lights where little of the motion is left, assemble the equations
where the weights have changed, take a Gauss-Newton step; until neither changes; then conclude. Every step is a function
from frozen states to a frozen state, and none depends on how many came before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic._kernels.threads import one_blas_thread
from rgbmidic.correlation.assembly import rigid_functions
from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.conclusion import conclude
from rgbmidic.correlation.equations import (
    Equations,
    Estimate,
    Problem,
    UnsolvableError,
    compare,
    gauss_newton_step,
)
from rgbmidic.correlation.light_bias import with_consistent_gradient
from rgbmidic.correlation.nodes import matching_elements, one_sided_texture
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import PrecisionMethod, Residual, refine_by_patch_matching
from rgbmidic.correlation.solution import NO_MATCH, Solution
from rgbmidic.correlation.uncertainty import standard_uncertainty
from rgbmidic.errors import InputError
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
    """Return the matched elements (E,) less those with a node that the images do not hold.

    As long as these are the last ones and the nodes stay there is none but those that are out already. A one-sided
    texture does not hold a node either, but matches.
    """
    if estimate.remaining <= problem.constants.reweight_motion / 4 and np.array_equal(matched, last.matched):
        return matched
    std = standard_uncertainty(BlockTable.of(residual, equations.weights), equations, last.precision)
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
    estimate, weighting = _refine_initial_guess(problem, estimate, residual)
    equations, is_weighed = assemble(problem, weighting, estimate), False
    for _ in range(problem.options.max_iterations):
        estimate = gauss_newton_step(problem, equations, weighting.residual, estimate)
        if is_weighed and estimate.remaining <= problem.options.tolerance / 10:
            break
        is_weighed = estimate.has_settled(problem.constants.reweight_motion)
        if is_weighed:
            weighting = weigh(problem, weighting, equations, estimate)
            if not weighting.has_converged(equations):
                equations = assemble(problem, weighting, estimate)
        else:
            weighting = follow(problem, weighting, estimate)
    return conclude(problem, estimate, equations, weighting)


@stage("iteration")
def follow(problem: Problem, last: Weighting, estimate: Estimate) -> Weighting:
    """Compare the states at an estimate, with the weights as they are."""
    return replace(last, residual=compare(problem, estimate, last.residual.reference, last.residual))


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
