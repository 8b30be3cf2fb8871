"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3).

Minimised over the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first:
``sum_j integral (g_j(x + u + R beta_j) - f_j(x))^2 p_j dx``. A rigid motion is linear in x, so it lies in the TRI3
space: the light's own nodal displacement is ``u + R beta_j`` and its derivative is the light's Hessian times R.
The gradient of the reference image stands for that of the deformed one, so the Hessian is constant within a pass;
between passes the weights are brought back anew, and what does not match is taken out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rgbmidic.correlation.comparison import Comparison
from rgbmidic.correlation.curvature import curvature_correction
from rgbmidic.correlation.problem import Deformed, Reference
from rgbmidic.correlation.solution import NodeStatus, Solution, Status
from rgbmidic.correlation.step import Step, rigid_functions
from rgbmidic.correlation.uncertainty import exact_std, functional_std
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
_LOST = 0.5
"""Uncertainty (px) from which a node is lost: a position uncertain by half a pixel is not within reach of a match."""
_MISFIT = 4.0
"""Residual around a node, over the median, from which it is lost where elements near it do not match."""
_WANDERING = 0.1
"""Motion (px) in the last iteration of a pass from which a node is lost."""
_PATIENCE = 5
_STARTED = 0.25
"""Correlation coefficient at the start under which an element waits until its neighbours have brought it nearer."""
_SETTLED = 1e-3
"""Share of the weight that may still change for the passes to end."""


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
    run = _Run(
        reference=reference,
        deformed=deformed,
        options=options,
        statistics=statistics,
        functions=rigid_functions(reference.mesh.nodes, options.rigid),
        displacement=initial.copy(),
    )
    return run.passes()


@dataclass(slots=True, kw_only=True)
class _Run:
    """One solve under way: the two states, and what the passes change."""

    reference: Reference
    deformed: Deformed
    options: SolverSettings
    statistics: bool
    functions: FloatArray
    displacement: FloatArray
    rigid: FloatArray = field(init=False)
    values: FloatImage = field(init=False)
    factor: FloatImage | None = None
    bend: FloatImage | None = None
    matched: BoolArray = field(init=False)
    seen: Comparison = field(init=False)
    history: list[float] = field(default_factory=list)
    sums: FloatArray = field(init=False)
    motion: FloatArray = field(init=False)
    returned: int = 0

    def __post_init__(self) -> None:
        lights = len(self.reference.images)
        self.rigid = np.zeros((lights, self.functions.shape[1]))
        self.values = self.reference.values
        self.matched = np.ones(len(self.reference.mesh.elements), dtype=bool)
        self.sums = np.zeros((lights, 3))
        self.motion = np.zeros(len(self.displacement))

    def passes(self) -> Solution:
        """Passes until the weights have settled, then the result."""
        step: Step | None = None
        tolerance = self.options.tolerance
        self.seen = self._compare()
        self.matched = self.seen.matched(_STARTED)
        if self.options.brightness != "none":
            self.values = self.seen.brightness("global")
        for number in range(_PASSES):
            weights = self._weights()
            if not weights.any():
                return self._failed(self._nothing_left())
            if self.functions.shape[1] and not weights[0].any():
                return self._failed(
                    "the first light sees nothing, and the rigid motions of the others are counted from it: "
                    "put a light first that sees, or measure without rigid motions"
                )
            change = np.abs(weights - step.weights).sum() if step is not None else np.inf
            if step is not None and change <= _SETTLED * weights.sum() and not self._refining(number):
                break
            try:
                step = Step.build(
                    self.reference, weights, self.functions, None if self.factor is None else self._given()
                )
            except RuntimeError as error:  # what SuperLU raises on a matrix that is singular in double precision
                return self._failed(f"the equations cannot be solved: {error}")
            if not step.measured.any():
                return self._failed(self._nothing_left())
            self._iterate(step, max(tolerance, _FIRST_PASS) if number == 0 else tolerance)
            if not np.isfinite(self.displacement).all():
                return self._failed("the iteration diverged")
            self._learn(number, step)
        assert step is not None
        if self.history[-1] > tolerance:
            self._iterate(step, tolerance)
            self.seen = self._compare()
        return self._conclude(step)

    def _refining(self, number: int) -> bool:
        refined = self.statistics or self.options.brightness != "none"
        return refined and number <= self.returned + _REFINED[self.options.brightness]

    def _light_displacement(self, light: int) -> FloatArray:
        return np.asarray(self.displacement + (self.functions @ self.rigid[light]).reshape(-1, 2))

    def _pull_back(self) -> FloatImage:
        lights = range(len(self.values))
        return np.stack([self.reference.pull_back(self.deformed, j, self._light_displacement(j)) for j in lights])

    def _weights(self) -> FloatImage:
        """Pixel weights (k, P) of the next pass: those last brought back, where the images match."""
        weights = self._given()
        return weights if self.factor is None else weights * self.factor

    def _given(self) -> FloatImage:
        """Those weights without the precision of the lights."""
        return self.seen.weights * np.repeat(self.matched, np.diff(self.reference.pixels.offsets))

    def _compare(self) -> Comparison:
        lights = range(len(self.values))
        return Comparison(
            reference=self.reference,
            values=self.values,
            warped=np.stack([self.reference.warp(self.deformed, j, self._light_displacement(j)) for j in lights]),
            weights=self._pull_back(),
        )

    def _learn(self, number: int, step: Step) -> None:
        """What the displacement found says about matching, brightness and precision."""
        comparison = self.seen = self._compare()
        before = self.matched
        self.matched = comparison.matched()
        if not self.matched.all() or self.history[-1] > _FIRST_PASS:
            # a node whose own pixels match nothing wanders, though its elements match as a whole
            lost = self._std(comparison, step, 2).max(axis=1) > _LOST
            if len(self.history) < self.options.max_iterations:
                lost |= self.motion > _WANDERING
            self.matched &= ~lost[self.reference.mesh.elements].any(axis=1)
        # where elements have come back, what was learnt from their wrong match must be learnt anew, and once more: in
        # the pass that brings them back the residual is still that of a wrong match
        if (self.matched & ~before).any():
            self.returned = number + 1
        if number >= self.returned + _REFINED[self.options.brightness]:
            return
        if self.options.brightness != "none":
            self.values = comparison.brightness(self.options.brightness)
        if self.statistics:
            self.factor, self.bend = comparison.precision()

    def _iterate(self, step: Step, tolerance: float) -> None:
        """Gauss-Newton iterations with one Hessian until no measured node moves by more than `tolerance` px."""
        for turn in range(min(_PASS_ITERATIONS, self.options.max_iterations - len(self.history))):
            right_side, rigid_side = self._right_sides(step)
            motion, rigid = step.increment(right_side, rigid_side)
            motion = motion.reshape(-1, 2)
            length = np.hypot(*motion.T)
            self.displacement += motion * np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-30))[:, None]
            self.motion = length
            longest = float(length[step.measured].max())
            if rigid.size:
                shifts = rigid.reshape(self.rigid[1:].shape)
                self.rigid[1:] += shifts
                longest = max(longest, float(np.abs(self.functions @ shifts.T).max()))
            self.history.append(longest)
            if not np.isfinite(longest) or longest <= tolerance:
                return
            # a few nodes that wander where nothing matches must not keep the others waiting
            if turn >= _PATIENCE and np.quantile(length[step.measured], 0.9) <= tolerance:
                return

    def _right_sides(self, step: Step) -> tuple[FloatArray, FloatArray]:
        """Right-hand sides of the nodes (2 N,) and of the rigid functions ((k - 1) m,)."""
        total = -(step.smoothness @ self.displacement.ravel())
        rigid = []
        for light, (values, weight) in enumerate(zip(self.values, step.weights, strict=True)):
            displacement = self._light_displacement(light)
            vector, self.sums[light] = self.reference.right_side(self.deformed, light, values, weight, displacement)
            total += vector
            if light:
                rigid.append(self.functions.T @ vector)
        return total, np.concatenate(rigid) if rigid else np.empty(0)

    def _conclude(self, step: Step) -> Solution:
        elements = self.reference.mesh.elements
        displacement = self.displacement
        bent = curvature_correction(self.reference, step, displacement)
        std, strain_std = np.split(self._std(self.seen.without(bent.deviation), step, 5), [2], axis=1)
        beside_mismatch = np.zeros(len(std), dtype=bool)
        beside_mismatch[elements[~self.matched]] = True
        misfit = self.seen.misfit(step.weights, step.measured)
        lost = step.measured & ((std.max(axis=1) > _LOST) | (self._beside(beside_mismatch) & (misfit > _MISFIT)))
        measured = step.measured & ~lost & ~step.blind(self.seen.noise_hessian)
        if not measured.any():
            return self._failed(
                "the texture runs in one direction only: what lies along it cannot be measured"
                if (step.measured & ~lost).any()
                else "the images do not match anywhere in the region"
            )
        decorrelated = lost | (beside_mismatch & ~measured)
        node_status = np.where(measured, NodeStatus.MEASURED, NodeStatus.NOT_SEEN).astype(np.uint8)
        node_status[decorrelated] = NodeStatus.DECORRELATED
        if self.options.curvature:
            displacement = displacement - bent.displacement
        else:
            std, strain_std = np.hypot(std, bent.displacement), np.hypot(strain_std, bent.strain)
        strain = self.reference.strain(displacement)
        if self.options.curvature:
            strain = strain - bent.one_sided
        inner = measured & ~self._beside(~measured)
        with np.errstate(invalid="ignore", divide="ignore"):
            residual = np.sqrt(self.sums[:, 0] / self.sums[:, 1])
        last = float(self.motion[measured].max())
        converged = last <= self.options.tolerance
        return Solution(
            nodes=self.reference.mesh.nodes,
            elements=elements,
            displacement=np.where(measured[:, None], displacement, np.nan),
            displacement_std=np.where(measured[:, None], std, np.nan),
            strain=np.where(inner[:, None], strain, np.nan),
            strain_std=np.where(inner[:, None], strain_std, np.nan),
            node_status=node_status,
            light_share=step.light_share,
            misfit=np.where(measured, misfit, np.nan),
            status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
            reason="" if converged else f"the last iteration still moved a node by {last:.3g} px",
            rigid=self.rigid,
            residual=residual,
            weight_share=_shares(step.weights),
            history=np.array(self.history),
        )

    def _std(self, comparison: Comparison, step: Step, count: int) -> FloatArray:
        """Standard uncertainty (N, count) of the first of u, v (px), exx, eyy, exy from the scores."""
        reference = self.reference
        scores = reference.equations.matrix(comparison.score_covariance(step.weights, int(step.measured.sum())))
        std = functional_std(step.solve, scores, reference.probing, reference.functionals[:count], step.measured)
        if count > 2:
            near_hole = np.flatnonzero(step.measured & self._beside(self._beside(self._beside(~step.measured))))
            std[near_hole, 2:] = exact_std(step.solve, scores, reference.functionals[2:count], near_hole)
        return std * self._robust_loss(step)

    def _robust_loss(self, step: Step) -> float:
        """Factor on the uncertainty: a robust loss bends less than its weights say."""
        if self.bend is None:
            return 1.0
        total = float(step.weights.sum(dtype=np.float64))
        return total / max(float((step.weights * self.bend).sum(dtype=np.float64)), 0.1 * total)

    def _beside(self, nodes: BoolArray) -> BoolArray:
        """Nodes that share an element with one of `nodes`, shape (N,)."""
        elements = self.reference.mesh.elements
        beside = np.zeros(len(nodes), dtype=bool)
        beside[elements[nodes[elements].any(axis=1)]] = True
        return beside

    def _nothing_left(self) -> str:
        if not self.matched.all():
            return "the images do not match anywhere in the region"
        if not self.seen.weights.any():
            return "no light sees the region: every weight is zero"
        return "the images have no texture in the region"

    def _failed(self, reason: str) -> Solution:
        lights = len(self.values)
        nothing = np.full(self.reference.mesh.nodes.shape, np.nan)
        return Solution(
            nodes=self.reference.mesh.nodes,
            elements=self.reference.mesh.elements,
            displacement=nothing,
            displacement_std=nothing.copy(),
            strain=np.full((len(nothing), 3), np.nan),
            strain_std=np.full((len(nothing), 3), np.nan),
            node_status=np.full(len(nothing), NodeStatus.NOT_SEEN, dtype=np.uint8),
            light_share=np.zeros((len(nothing), lights)),
            misfit=np.full(len(nothing), np.nan),
            status=Status.FAILED,
            reason=reason,
            rigid=self.rigid,
            residual=np.full(lights, np.nan),
            weight_share=np.zeros(lights),
            history=np.array(self.history),
        )


def _shares(weights: FloatImage) -> FloatArray:
    """Mean share (k,) of each light in the sum of the weights (k, P)."""
    total = weights.sum(axis=0)
    return np.asarray((weights / np.where(total > 0, total, np.float32(1))).mean(axis=1, dtype=np.float64))
