"""The MIDIC solve: Gauss-Newton on the weighted sum over the lights (paper, eq. 3).

Minimised over the nodal displacement u and, where asked for, the rigid motions beta_j of the lights after the first:
``sum_j integral (g_j(x + u + R beta_j) - f_j(x))^2 p_j dx``. A rigid motion is linear in x, so it lies in the TRI3
space: the light's own nodal displacement is ``u + R beta_j`` and its derivative is the light's Hessian times R.
The gradient of the reference image stands for that of the deformed one, so the Hessian is constant within a pass.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic._kernels.correlation import element_hessian, element_moments, element_right_side, pull_back, warp
from rgbmidic.correlation.images import apply_prefilter, noise_energy
from rgbmidic.correlation.problem import Deformed, Reference
from rgbmidic.correlation.solution import NodeStatus, Solution, Status
from rgbmidic.correlation.system import factorise
from rgbmidic.correlation.uncertainty import nodal_std
from rgbmidic.errors import InputError

__all__ = ["solve"]

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float64]
FloatImage = npt.NDArray[np.float32]

_SMOOTHNESS = 1e-4
"""Weight of the smoothness that carries unseen nodes along, relative to the texture's median Hessian."""
_SEEN = 0.05
"""A node is measured if it has this share of the median texture around a node of its area."""
_MATCHED = 0.4
"""Correlation coefficient under which the images of an element do not match; the element then carries no weight
until its neighbours have brought it to a displacement at which they do."""
_LONGEST_STEP = 4.0
"""Longest motion of a node in one iteration, px."""
_FIRST_PASS = 0.05
"""Increment (px) at which the first pass hands over to the pass with the weights brought back anew."""
_PASSES = 8
"""Most passes: each brings the weights back with the latest displacement."""
_PASS_ITERATIONS = 12
_SETTLED = 1e-3
"""Share of the weight that may still change for the passes to end."""


def solve(
    reference: Reference,
    deformed: Deformed,
    initial: FloatArray,
    *,
    rigid: str = "none",
    tolerance: float = 1e-3,
    max_iterations: int = 50,
) -> Solution:
    """Find the displacement of the reference mesh that brings the deformed images onto the reference ones.

    Parameters
    ----------
    reference, deformed
        The two states, prepared with the same prefilter.
    initial : ndarray, shape (N, 2)
        Displacement (u, v) in px to start from, within about half a speckle of the solution.
    rigid
        Rigid functions of the lights after the first: ``"none"``, ``"translation"`` or ``"translation+rotation"``.
    tolerance
        The iteration stops when no measured node moves by more than this in px.
    max_iterations
        Iterations before the frame counts as not converged.

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
    functions = _rigid_functions(reference.mesh.nodes, rigid)
    state = _State(
        displacement=initial.copy(),
        rigid=np.zeros((len(reference.images), functions.shape[1])),
        matched=np.ones(len(reference.mesh.elements), dtype=bool),
    )
    step = None
    for number in range(_PASSES):
        weights = _pull_back(reference, deformed, state, functions)
        if not weights.any():
            return _failed(reference, state, "no light sees the region: every weight is zero")
        weights *= np.repeat(state.matched, np.diff(reference.pixels.offsets))
        if step is not None and np.abs(weights - step.weights).sum() <= _SETTLED * weights.sum():
            break
        step = _Step.build(reference, weights, functions)
        if not step.measured.any():
            reason = "the images have no texture" if state.matched.all() else "the images do not match anywhere"
            return _failed(reference, state, f"{reason} in the region")
        goal = max(tolerance, _FIRST_PASS) if number == 0 else tolerance
        _iterate(reference, deformed, state, step, functions, goal, max_iterations)
        if not np.isfinite(state.displacement).all():
            return _failed(reference, state, "the iteration diverged")
        state.matched = _matched_elements(reference, deformed, state, functions)
    assert step is not None
    if state.history[-1] > tolerance:
        _iterate(reference, deformed, state, step, functions, tolerance, max_iterations)
    return _conclude(reference, state, step, tolerance)


@dataclass(slots=True, kw_only=True)
class _State:
    """What the iteration changes."""

    displacement: FloatArray
    rigid: FloatArray
    matched: npt.NDArray[np.bool_]
    history: list[float] = field(default_factory=list)
    sums: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    """The linear algebra of a pass: weights (k, P), Hessian and its factors, Schur complement of the rigid part."""

    weights: FloatImage
    hessian: sp.csc_matrix
    smoothness: sp.csc_matrix
    solve: Callable[[FloatArray], FloatArray]
    border: FloatArray
    border_solved: FloatArray
    schur: FloatArray
    measured: npt.NDArray[np.bool_]

    @classmethod
    def build(cls, reference: Reference, weights: FloatImage, functions: FloatArray) -> _Step:
        equations = reference.equations
        per_light = [_hessian_blocks(reference, light, weights[light]) for light in range(len(weights))]
        hessian = equations.matrix(np.sum(per_light, axis=0))
        measured, scale = _observability(hessian, equations.nodal_area)
        smoothness = (_SMOOTHNESS * scale) * equations.smoothness
        solve = factorise(
            sp.csc_matrix(hessian + smoothness + 1e-9 * max(scale, 1e-30) * sp.eye(equations.size, format="csc"))
        )
        columns = [equations.matrix(blocks) @ functions for blocks in per_light[1:]] if functions.shape[1] else []
        border = np.concatenate(columns, axis=1) if columns else np.empty((equations.size, 0))
        corner = np.zeros((border.shape[1],) * 2)
        for i, column in enumerate(columns):
            part = slice(i * functions.shape[1], (i + 1) * functions.shape[1])
            corner[part, part] = functions.T @ column
        solved = solve(border) if border.shape[1] else border
        return cls(
            weights=weights,
            hessian=hessian,
            smoothness=smoothness,
            solve=solve,
            border=border,
            border_solved=solved,
            schur=corner - border.T @ solved,
            measured=measured,
        )

    def increment(self, right_side: FloatArray, rigid_side: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for the motion of the nodes (2 N,) and of the rigid functions ((k - 1) m,)."""
        free = self.solve(right_side)
        if not self.border.shape[1]:
            return free, np.empty(0)
        rigid = np.linalg.lstsq(self.schur, rigid_side - self.border.T @ free, rcond=1e-9)[0]
        return free - self.border_solved @ rigid, np.asarray(rigid, dtype=np.float64)


def _rigid_functions(nodes: FloatArray, rigid: str) -> FloatArray:
    """Nodal values (2 N, m) of the rigid motions: shifts in x and y (px), rotation (rad) about the mesh's middle."""
    names = ("none", "translation", "translation+rotation")
    if rigid not in names:
        raise InputError(f"unknown rigid functions {rigid!r}; allowed are {', '.join(names)}")
    arm = nodes - nodes.mean(axis=0)
    columns = np.zeros((len(nodes), 2, 3))
    columns[:, 0, 0] = columns[:, 1, 1] = 1
    columns[:, 0, 2], columns[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return columns.reshape(-1, 3)[:, : (0, 2, 3)[names.index(rigid)]]


def _light_displacement(state: _State, functions: FloatArray, light: int) -> FloatArray:
    return np.asarray(state.displacement + (functions @ state.rigid[light]).reshape(-1, 2))


def _pull_back(reference: Reference, deformed: Deformed, state: _State, functions: FloatArray) -> FloatImage:
    pixels, mesh = reference.pixels, reference.mesh
    out = np.empty_like(reference.pixel_weights)
    for light, weight in enumerate(deformed.weights):
        pull_back(
            weight, reference.pixel_weights[light], pixels.local_x, pixels.local_y, pixels.offsets, pixels.origin,
            mesh.elements, pixels.barycentric, _light_displacement(state, functions, light), out[light],
        )  # fmt: skip
    return out


def _hessian_blocks(
    reference: Reference,
    light: int,
    weight: FloatImage,
    gradient: tuple[FloatImage, FloatImage] | None = None,
) -> FloatArray:
    gradient_x, gradient_y = gradient or (reference.gradient_x[light], reference.gradient_y[light])
    pixels = reference.pixels
    out = np.zeros((len(reference.mesh.elements), 3, 3, 3))
    element_hessian(
        gradient_x, gradient_y, weight, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, out
    )
    return out


def _observability(hessian: sp.csc_matrix, area: FloatArray) -> tuple[npt.NDArray[np.bool_], float]:
    """Which nodes see enough texture, and the typical diagonal entry of the Hessian.

    The texture a node sees in its worse direction is the smaller eigenvalue of its own 2 x 2 block.
    """
    diagonal = hessian.diagonal().reshape(-1, 2)
    nodes = np.arange(len(diagonal))
    mixed = np.asarray(hessian[2 * nodes, 2 * nodes + 1]).ravel()
    half = diagonal.sum(axis=1) / 2
    smallest = half - np.hypot((diagonal[:, 0] - diagonal[:, 1]) / 2, mixed)
    density = smallest / area
    typical = np.median(density[density > 1e-3 * density.max()]) if density.max() > 0 else 0.0
    seen = density > _SEEN * typical if typical > 0 else np.zeros(len(density), dtype=bool)
    return seen, float(np.median(half[seen])) if seen.any() else 0.0


def _iterate(
    reference: Reference,
    deformed: Deformed,
    state: _State,
    step: _Step,
    functions: FloatArray,
    tolerance: float,
    max_iterations: int,
) -> None:
    """Gauss-Newton iterations with one Hessian until no measured node moves by more than `tolerance` px."""
    for _ in range(min(_PASS_ITERATIONS, max_iterations - len(state.history))):
        right_side, rigid_side, state.sums = _right_sides(reference, deformed, state, step, functions)
        motion, rigid = step.increment(right_side, rigid_side)
        motion = motion.reshape(-1, 2)
        length = np.hypot(*motion.T)
        motion *= np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-30))[:, None]
        state.displacement += motion
        longest = float(length[step.measured].max())
        if rigid.size:
            state.rigid[1:] += rigid.reshape(state.rigid[1:].shape)
            longest = max(longest, float(np.abs(functions @ rigid.reshape(state.rigid[1:].shape).T).max()))
        state.history.append(longest)
        if not np.isfinite(longest) or longest <= tolerance:
            return


def _right_sides(
    reference: Reference, deformed: Deformed, state: _State, step: _Step, functions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right-hand sides of nodes (2 N,) and rigid functions, and per light the sums w r^2, w and lost pixels (k, 3)."""
    pixels, mesh, equations = reference.pixels, reference.mesh, reference.equations
    parts = np.zeros((len(mesh.elements), 3, 2))
    sums = np.zeros((len(mesh.elements), 3))
    total = -(step.smoothness @ state.displacement.ravel())
    rigid, light_sums = [], []
    for light, coefficients in enumerate(deformed.coefficients):
        element_right_side(
            coefficients, reference.values[light], reference.gradient_x[light], reference.gradient_y[light],
            step.weights[light], pixels.local_x, pixels.local_y, pixels.offsets, pixels.origin, mesh.elements,
            pixels.barycentric, _light_displacement(state, functions, light), parts, sums,
        )  # fmt: skip
        vector = equations.vector(parts)
        total += vector
        light_sums.append(sums.sum(axis=0))
        if light:
            rigid.append(functions.T @ vector)
    return total, np.concatenate(rigid) if rigid else np.empty(0), np.array(light_sums)


def _conclude(reference: Reference, state: _State, step: _Step, tolerance: float) -> Solution:
    elements = reference.mesh.elements
    node_status = np.where(step.measured, NodeStatus.MEASURED, NodeStatus.NOT_SEEN).astype(np.uint8)
    beside_mismatch = np.zeros(len(node_status), dtype=bool)
    beside_mismatch[elements[~state.matched]] = True
    node_status[beside_mismatch & ~step.measured] = NodeStatus.DECORRELATED
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = state.sums[:, 0] / state.sums[:, 1]
    energy = noise_energy(reference.prefilter, np.zeros((1, 2)))
    energy += noise_energy(reference.prefilter, state.displacement[step.measured])
    std = _displacement_std(reference, step, np.nan_to_num(variance) * 2 / energy)
    converged = state.history[-1] <= tolerance
    return Solution(
        nodes=reference.mesh.nodes,
        elements=elements,
        displacement=np.where(step.measured[:, None], state.displacement, np.nan),
        displacement_std=np.where(step.measured[:, None], std, np.nan),
        node_status=node_status,
        status=Status.CONVERGED if converged else Status.NOT_CONVERGED,
        reason="" if converged else f"the last iteration still moved a node by {state.history[-1]:.3g} px",
        rigid=state.rigid,
        residual=np.sqrt(variance),
        weight_share=step.weights.mean(axis=1, dtype=np.float64),
        history=np.array(state.history),
    )


def _matched_elements(
    reference: Reference, deformed: Deformed, state: _State, functions: FloatArray
) -> npt.NDArray[np.bool_]:
    """Elements (E,) whose images match: zero-mean correlation coefficient of all lights together, at the displacement
    found. Elements without weight or texture say nothing and count as matched."""
    pixels, mesh = reference.pixels, reference.mesh
    weights = _pull_back(reference, deformed, state, functions)
    warped = np.empty(pixels.rows.size, dtype=np.float32)
    moments = np.zeros((len(mesh.elements), 6))
    fg, ff, gg = np.zeros((3, len(mesh.elements)))
    for light, coefficients in enumerate(deformed.coefficients):
        warp(
            coefficients, pixels.local_x, pixels.local_y, pixels.offsets, pixels.origin, mesh.elements,
            pixels.barycentric, _light_displacement(state, functions, light), warped,
        )  # fmt: skip
        element_moments(reference.values[light], warped, weights[light], pixels.offsets, moments)
        total, f, g, f2, product, g2 = moments.T
        total = np.maximum(total, 1e-30)
        fg += product - f * g / total
        ff += f2 - f * f / total
        gg += g2 - g * g / total
    own = _correlation(fg, ff, gg)
    # a few speckles can match by chance; those of all elements around a node hardly
    around = _correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
    patch = np.median(around[mesh.elements], axis=1)
    return np.asarray(np.minimum(own, patch) >= _MATCHED)


def _correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from centred products; 1 where there is nothing to compare."""
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    empty = scale <= 1e-9 * scale.max(initial=0.0)
    return np.where(empty, 1.0, fg / np.where(empty, 1.0, scale))


def _displacement_std(reference: Reference, step: _Step, variance: FloatArray) -> FloatArray:
    """Sandwich uncertainty (N, 2) for white noise whose difference between the two images has variance (k,).

    The prefilter h correlates the noise: the right-hand side has the covariance
    ``s^2 integral (h * w grad f)(h * w grad f)^T phi phi^T`` (shape functions phi are smooth on the scale of h).
    """
    filtered = reference.prefilter != "none"
    pixels = reference.pixels
    one = np.ones(pixels.rows.size, dtype=np.float32)
    blocks = np.zeros((len(reference.mesh.elements), 3, 3, 3))
    for light, weight in enumerate(step.weights):
        gradient = [weight * reference.gradient_x[light], weight * reference.gradient_y[light]]
        if filtered:
            gradient = [pixels.gather(apply_prefilter(pixels.scatter(g), reference.prefilter)) for g in gradient]
        blocks += variance[light] * _hessian_blocks(reference, light, one, (gradient[0], gradient[1]))
    return nodal_std(step.solve, reference.equations.matrix(blocks), reference.probing)


def _failed(reference: Reference, state: _State, reason: str) -> Solution:
    lights = len(reference.images)
    nothing = np.full(reference.mesh.nodes.shape, np.nan)
    return Solution(
        nodes=reference.mesh.nodes,
        elements=reference.mesh.elements,
        displacement=nothing,
        displacement_std=nothing.copy(),
        node_status=np.full(len(nothing), NodeStatus.NOT_SEEN, dtype=np.uint8),
        status=Status.FAILED,
        reason=reason,
        rigid=state.rigid,
        residual=np.full(lights, np.nan),
        weight_share=np.zeros(lights),
        history=np.array(state.history),
    )
