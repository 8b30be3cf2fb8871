"""The normal equations of the solve, and the Gauss-Newton iteration with them (paper, eq. 3).

They hold the weighted Hessian of all lights, a weak smoothness for nodes without data, and the rigid motions of the
lights. They are factorised once for given weights; each iteration solves for the increment of the displacement.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rgbmidic.correlation.assembly import RigidMotions
from rgbmidic.correlation.constants import SolverConstants
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import PrecisionMethod, Residual
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.tri3 import with_data
from rgbmidic.settings import SolverSettings
from rgbmidic.timing import stage
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class Equations:
    """Factorised normal equations for given weights, in axes that turn and stretch with the surface.

    The reference's gradient stands for that of the deformed image, which the surface has turned and stretched: the
    motion is solved for in the axes of the reference and carried to where they are now (the inverse compositional
    step: Baker and Matthews, IJCV 56, 2004).

    Attributes
    ----------
    reference, weights
        The reference state, and the pixel weights (k, P).
    deformation : ndarray, shape (N, 2, 2)
        Deformation gradient of the surface around each node.
    functions : ndarray, shape (2 N, m)
        The rigid functions in the axes of the reference.
    blocks : ndarray, shape (E, 3, 3, 3)
        Element blocks of the Hessian.
    smoothness : float
        Factor on the smoothness of the `Assembly`.
    gradient
        Displacement gradient (N, 2, 2) around each node for a displacement (N, 2).
    node_blocks : ndarray, shape (3, N)
        Entries xx, xy and yy of the nodes' own blocks of the Hessian.
    solve
        Solves the normal equations with it.
    rigid
        The rigid motions of the lights after the first; None where there are none.
    observability : ndarray, shape (N,)
        Texture, and information, in a node's worse direction over what it must have to be measured.
    light_fraction : ndarray, shape (N, k), float64
        Fraction of each light in what determines a node; 0 where nothing does.
    """

    reference: Reference
    weights: FloatImage
    deformation: FloatArray
    functions: FloatArray
    blocks: FloatArray
    node_blocks: FloatArray
    smoothness: float
    gradient: Callable[[FloatArray], FloatArray]
    solve: Callable[[FloatArray], FloatArray]
    rigid: RigidMotions | None
    observability: FloatArray
    light_fraction: FloatArray

    @classmethod
    def build(
        cls,
        reference: Reference,
        weights: FloatImage,
        functions: FloatArray,
        displacement: FloatArray,
        prior_weights: FloatImage | None = None,
    ) -> Equations:
        """Assemble and factorise the equations for given weights.

        Parameters
        ----------
        reference
            The reference state, with P owned pixels under k lights.
        weights : ndarray, shape (k, P), float32
            Pixel weights.
        functions : ndarray, shape (2 N, m)
            Rigid functions.
        displacement : ndarray, shape (N, 2)
            Around which the equations are linearised, px.
        prior_weights : ndarray, shape (k, P), float32, optional
            The weights without the precision of the lights, where it is part of `weights`.

        Raises
        ------
        LinAlgError
            The matrix is singular in double precision.
        """
        assembly, constants = reference.assembly, reference.constants
        per_light = reference.hessians(weights)
        blocks = np.sum(per_light, axis=0)
        node_blocks = assembly.node_blocks(blocks)
        min_fraction = constants.min_texture if prior_weights is None else constants.min_information
        observability = _observability(node_blocks, assembly.nodal_area, min_fraction)
        if prior_weights is not None:
            texture = assembly.node_blocks(np.sum(reference.hessians(prior_weights), axis=0))
            texture_observability = _observability(texture, assembly.nodal_area, constants.min_texture)
            observability = np.minimum(observability, texture_observability)
        diagonal, textured = (node_blocks[0] + node_blocks[2]) / 2, observability > 1
        scale = float(np.median(diagonal[textured]) if textured.any() else diagonal.max(initial=0.0)) or 1.0
        # 1e-9 of the identity fixes the constant that the smoothness leaves free where nothing is seen: 1e5 times less
        # than the smoothness, 1e7 times more than rounding
        held = scale * (constants.smoothness * assembly.smoothness.data + 1e-9 * assembly.diagonal)
        solve = assembly.factorise(assembly.matrix(blocks, held))
        hold = with_data(assembly.smoothness, held)
        mean_gradient = _mean_gradient(reference.mesh, blocks)

        def gradient(displacement: FloatArray) -> FloatArray:
            nodal = mean_gradient(displacement).reshape(-1, 2)
            # nodes without data have that of the others, carried along as a displacement is
            return np.asarray(nodal - solve(hold @ nodal)).reshape(-1, 2, 2)

        deformation = _deformation(gradient(displacement))
        size, count = functions.shape
        functions = _turned_back(deformation, functions.reshape(size // 2, 2, count)).reshape(size, count)
        light = np.stack([xx + yy for xx, _, yy in map(assembly.node_blocks, per_light)], axis=1)
        total = light.sum(axis=1, keepdims=True)
        rigid = None
        if functions.shape[1] and len(per_light) > 1:
            textured_elements = np.asarray(textured[reference.mesh.elements].all(axis=1))
            rigid = RigidMotions.eliminate(assembly, per_light, functions, hold, solve, textured_elements)
        return cls(
            reference=reference,
            weights=weights,
            deformation=deformation,
            functions=functions,
            blocks=blocks,
            node_blocks=node_blocks,
            smoothness=constants.smoothness * scale,
            gradient=gradient,
            solve=solve,
            rigid=rigid,
            observability=observability,
            light_fraction=np.asarray(light / np.where(total > 0, total, 1.0)),
        )

    @property
    def textured(self) -> BoolArray:
        """Nodes (N,) that see enough texture."""
        return np.asarray(self.observability > 1)

    def information(self) -> FloatArray:
        """Return texture times weight in each element, over its area, (E,): proportional to the inverse variance."""
        return np.asarray(np.einsum("eaad->ed", self.blocks)[:, ::2].sum(axis=1) / self.reference.mesh.areas)

    def increment(
        self, right_side: FloatArray, held_side: FloatArray, rigid_side: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Solve for one increment.

        Parameters
        ----------
        right_side : ndarray, shape (2 N,)
            Of the nodes.
        held_side : ndarray, shape (2 N,)
            The smoothness' part of it.
        rigid_side : ndarray, shape ((k - 1) m,)
            Of the rigid functions.

        Returns
        -------
        tuple
            Motion of the nodes (N, 2) in px, and of the rigid functions ((k - 1) m,).
        """
        motion, rigid = self.solve(right_side), np.zeros(0)
        if self.rigid is not None:
            rigid = self.rigid.increment(motion, held_side, rigid_side)
            motion = motion - self.rigid.response @ rigid
        return self.turned(motion.reshape(-1, 2)), rigid

    def held_side(self, displacement: FloatArray) -> FloatArray:
        """Right-hand side (2 N,) of the smoothness: at nodes without texture, by what is not affine around them."""
        out = np.zeros_like(displacement)
        if not self.textured.all():
            smoothness, nodes = self.reference.assembly.smoothness, self.reference.mesh.nodes
            bend, at_border = ((smoothness @ field.ravel()).reshape(-1, 2) for field in (displacement, nodes))
            bend -= np.einsum("nij,nj->ni", self.gradient(displacement), at_border)
            out = np.where(self.textured[:, None], out, -self.smoothness * self.turned_back(bend))
        return out.ravel()

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Turn nodal vectors (N, 2, ...) from the axes of the reference to where they are now, stretched."""
        return np.asarray(np.einsum("nij,nj...->ni...", self.deformation, vectors))

    def turned_back(self, vectors: FloatArray) -> FloatArray:
        """Turn nodal vectors (N, 2, ...) into the axes of the reference."""
        return _turned_back(self.deformation, vectors)


def _mean_gradient(mesh: Tri3Mesh, blocks: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return what averages the gradient of a displacement (N, 2) over the elements around each node, (N, 2, 2).

    Elements count by what they show: one that is half on another body, and left out, turns in a way of its own.
    """
    texture = np.einsum("eaad->ed", blocks)[:, [0, 2]].sum(axis=1)
    texture_weight = texture + 1e-6 * (texture.mean() or 1.0)  # where nothing is shown all count alike
    nodal_weight = mesh.to_nodes(texture_weight)

    def average(displacement: FloatArray) -> FloatArray:
        components = texture_weight * mesh.element_gradient(displacement).reshape(-1, 4).T
        return np.stack([mesh.to_nodes(component) / nodal_weight for component in components], axis=1).reshape(-1, 2, 2)

    return average


def _deformation(gradient: FloatArray) -> FloatArray:
    """Deformation gradient (N, 2, 2), I + grad u; where that is nearly singular its rotation, the polar factor."""
    deformation = np.eye(2) + gradient
    square = np.maximum((deformation**2).sum(axis=(1, 2)), 1)
    flat = np.linalg.det(deformation) < 0.05 * square  # 20 times as long as wide, or of a 20th of its area: no match
    angle = np.arctan2(gradient[:, 1, 0] - gradient[:, 0, 1], 2 + gradient[:, 0, 0] + gradient[:, 1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)
    return np.where(flat[:, None, None], rotation, deformation)


def _turned_back(deformation: FloatArray, vectors: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nij,nj...->ni...", np.linalg.inv(deformation), vectors))


def _observability(node_blocks: FloatArray, area: FloatArray, min_fraction: float) -> FloatArray:
    """Texture that the nodes see in their worse direction, over a fraction `min_fraction` of the median, (N,).

    It is the smaller eigenvalue of a node's own 2 x 2 block.
    """
    xx, xy, yy = node_blocks
    half = (xx + yy) / 2
    smallest = half - np.hypot((xx - yy) / 2, xy)
    # texture in one direction only: sums of some 1000 products in single precision are uncertain by 1000 * 6e-8
    smallest[smallest < 1e-4 * half] = 0
    density = smallest / area
    # nodes that no light sees, or that are blank, have no part in the median
    typical = np.median(density[density > 1e-3 * density.max()]) if density.max() > 0 else 0.0
    return np.asarray(density / (min_fraction * typical) if typical > 0 else np.zeros_like(density))


@dataclass(frozen=True, slots=True, kw_only=True)
class Problem:
    """A problem to solve: two states, the options, the method of weighting, and the rigid functions (2 N, m)."""

    reference: Reference
    deformed: Deformed
    options: SolverSettings
    method: PrecisionMethod | None
    functions: FloatArray

    @property
    def constants(self) -> SolverConstants:
        """Those that the reference was prepared with."""
        return self.reference.constants


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """The motion as far as it is known.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        px.
    rigid : ndarray, shape (k, m)
        Coefficients of each light's rigid functions.
    equations : Equations or None
        Of the last iteration; None before it.
    increments : tuple of ndarray, shape (N,)
        Motion of each node in every iteration, px.
    motion : ndarray, shape (N, 2)
        That of the last one.
    longest : float
        Largest of a textured node, or by a light's rigid motion, px.
    ratio : float
        Of it to that before with the same equations; of the first one .1, more than it is at the end (.01 to .06).
    relaxation : float
        Fraction of a step that the next iteration takes.
    """

    displacement: FloatArray
    rigid: FloatArray
    equations: Equations | None = None
    increments: tuple[FloatArray, ...] = ()
    motion: FloatArray = field(default_factory=lambda: np.zeros(1))
    longest: float = float("inf")
    ratio: float = 0.1
    relaxation: float = 1.0

    @property
    def remainder(self) -> float:
        """Fraction of the last motion that is left to the solution, by a geometric series; 1 where it does not fall."""
        return self.ratio / (1 - self.ratio) if self.ratio < 0.5 else 1.0

    @property
    def remaining(self) -> float:
        """Largest motion that is left, px."""
        return self.remainder * self.longest

    def has_settled(self, motion: float) -> bool:
        """Return True if a quarter of a `motion` (px) is left, or what most of the nodes move by falls no more.

        Nodes that wander where nothing matches, a tenth of them, do not keep the others waiting.
        """
        if self.remainder < 1 or self.equations is None:
            return self.remaining <= motion / 4
        before, last = np.quantile(np.stack(self.increments[-5:])[[0, -1]][:, self.equations.textured], 0.9, axis=1)
        return bool(last <= motion or (len(self.increments) > 4 and last > before / 2))

    def history(self, nodes: BoolArray | slice = slice(None)) -> FloatArray:
        """Largest motion of `nodes` (N,), or of all, in every iteration, px; shape (iterations,)."""
        return np.array([increment[nodes].max() for increment in self.increments], dtype=np.float64)


_LONGEST_STEP = 4.0
"""Longest motion of a node in one iteration, px: a speckle (3 to 5 px), beyond which the gradient is another's."""


class UnsolvableError(Exception):
    """Nothing can be measured: the reason, and how far the iteration came."""

    def __init__(self, reason: str, estimate: Estimate) -> None:
        super().__init__(reason)
        self.history = estimate.history()


def compare(
    problem: Problem, estimate: Estimate, reference: Reference | None = None, last: Residual | None = None
) -> Residual:
    """Return the residual at an estimate, with the problem's reference or one that has been adapted; see `Residual`."""
    return Residual.at(reference or problem.reference, problem.deformed, _light_displacements(problem, estimate), last)


@stage("iteration")
def gauss_newton_step(problem: Problem, equations: Equations, residual: Residual, estimate: Estimate) -> Estimate:
    """Take one Gauss-Newton iteration from an estimate, whose residual is known.

    Raises
    ------
    UnsolvableError
        The iteration diverged.
    """
    held = equations.held_side(estimate.displacement)
    projected = equations.reference.projected(equations.weights, residual.difference)
    vectors = [equations.reference.assembly.vector(light) for light in projected]
    sides = [equations.functions.T @ vector for vector in vectors[1:]]
    steps = equations.increment(held + np.sum(vectors, axis=0), held, np.concatenate(sides) if sides else np.empty(0))
    is_first = equations is not estimate.equations
    relaxation = 1.0 if is_first else estimate.relaxation
    motion, shifts = (relaxation * step for step in steps)
    length = np.hypot(*motion.T)
    longest = float(length[equations.textured].max())
    rigid = estimate.rigid.copy()
    if shifts.size:
        shifts = shifts.reshape(rigid[1:].shape)
        rigid[1:] += shifts
        longest = max(longest, float(np.abs(problem.functions @ shifts.T).max()))
    if not np.isfinite(longest):
        raise UnsolvableError("the iteration diverged", estimate)
    motion *= np.minimum(1.0, _LONGEST_STEP / np.maximum(length, 1e-30))[:, None]
    ratio = 0.1 if is_first else longest / max(estimate.longest, 1e-30)
    # where the deformed images have more contrast than the reference, all nodes swing about the solution (Aitken):
    # from half of a step that the next one takes back each halves the error no longer
    swing = 0.0 if is_first else float((motion * estimate.motion).sum() / max((estimate.motion**2).sum(), 1e-30))
    return Estimate(
        displacement=estimate.displacement + motion,
        rigid=rigid,
        equations=equations,
        increments=(*estimate.increments, length),
        motion=motion,
        longest=longest,
        ratio=ratio,
        relaxation=relaxation / (1 - swing if swing < -0.5 else 1),
    )


def _light_displacements(problem: Problem, estimate: Estimate) -> list[FloatArray]:
    """Displacement (N, 2) of every light: the common one and its own rigid motion."""
    if not problem.functions.size:  # one array, by which `Reference.warps` knows that they move alike
        return [estimate.displacement] * len(estimate.rigid)
    return [estimate.displacement + (problem.functions @ rigid).reshape(-1, 2) for rigid in estimate.rigid]
