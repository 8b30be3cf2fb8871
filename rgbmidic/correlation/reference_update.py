"""Reference update (incremental correlation): a later frame becomes the reference where the first no longer matches.

Nodes are material points: in frame r, measured at ``u_r``, they lie at ``nodes + u_r``. With r's images there as the
reference a later frame n gives ``w`` at the same points, and ``u = u_r + w`` is its displacement on the first one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from rgbmidic._kernels.mesh import claim_pixels
from rgbmidic.correlation.assembly import rigid_functions
from rgbmidic.correlation.images import centred_products, usable_reach
from rgbmidic.correlation.nodes import correlation
from rgbmidic.correlation.reference import Deformed, Reference, rasterise_lines
from rgbmidic.correlation.residual import PrecisionMethod, Residual
from rgbmidic.correlation.solution import Solution
from rgbmidic.correlation.start import TrackingState, nodal_slopes, track
from rgbmidic.errors import InputError
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.settings import SolverSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceUpdate:
    """A reference, the first or a later frame, with what has been measured up to it.

    Attributes
    ----------
    first : Reference
        Of the first frame; results are at its nodes.
    reference : Reference
        Of frame r, with the mesh where the nodes are there; `first` itself before any update.
    displacement : ndarray, shape (N, 2)
        Of frame r on the first one, px; gaps are carried over from the nearest node. What frame r did not measure is
        not seen on it either, and comes back with an older reference only.
    solution : Solution, or None
        Of frame r on the first one; None before any update.
    scores : ndarray, shape (E, 2), or None
        Sums over the elements of the residual of frame r on the first times the gradient, carried to where the elements
        are; None before any update.
    uv_correlation : ndarray, shape (N,)
        Correlation of the errors of u and v of frame r, that of the texture around each node.

    Examples
    --------
    >>> from rgbmidic.mesh import Region, Tri3Mesh
    >>> region = Region.from_rectangle((0, 0, 59, 39), shape=(40, 60))
    >>> images = np.random.default_rng(0).uniform(50, 200, (1, 40, 60)).astype(np.float32)
    >>> reference = Reference.prepare(images, region, mesh=Tri3Mesh.from_region(region, element_size=20))
    >>> ReferenceUpdate.none(reference).reference is reference
    True
    """

    first: Reference
    reference: Reference
    displacement: FloatArray
    solution: Solution | None = None
    scores: FloatArray | None = None
    uv_correlation: FloatArray | float = 0.0

    @classmethod
    def none(cls, first: Reference) -> ReferenceUpdate:
        """Return the first frame as its own reference.

        Parameters
        ----------
        first
            The first frame's reference.

        Returns
        -------
        ReferenceUpdate
        """
        return cls(first=first, reference=first, displacement=np.zeros_like(first.mesh.nodes))

    def track(
        self, deformed: Deformed, state: TrackingState, options: SolverSettings, method: PrecisionMethod | None
    ) -> Solution:
        """Solve for the displacement of a later frame on the first one, from a start on the first one; see `track`.

        Parameters
        ----------
        deformed
            Images of the later frame.
        state
            Initial guess on the first frame.
        options
            Settings of the solver.
        method
            What learns the precision of the lights from the residual; None: nothing does.

        Returns
        -------
        Solution
            On the first frame.
        """
        last = state.displacement
        relative_state = replace(state, displacement=None if last is None else last - self.displacement)
        return self.accumulated(track(self.reference, deformed, relative_state, options, method), deformed)

    def accumulated(self, step: Solution, deformed: Deformed) -> Solution:
        """Return the solution on the first frame from that on this reference.

        What the displacement of frame r errs by, the surface carries along: in the step with the deformation gradient F
        it becomes F times as much, in u and v together (`uv_correlation`). Both errors may have a part in common, and
        ``Var(u) = (F Var(u_r) F^T + Var(w)) (1 + 2 sum(a b) / sum(a^2 + b^2))``, where a and b are the scores of the
        elements between the first frame and frame r and in the step: the factor is 1/2 for noise alone, for frame r's
        cancels; 1 where the paint has changed, which adds up; and up to 2 where both are off alike, as by a pattern
        that is interpolated or filtered otherwise where it is compressed. Strains, linear in the displacement, add up
        likewise.

        Parameters
        ----------
        step
            Solution on this reference.
        deformed
            The images that it was found in.

        Returns
        -------
        Solution
            On the first frame.
        """
        if self.solution is None or self.scores is None or not step.measured.any():
            return step
        last, mesh = self.solution, self.first.mesh
        reference_scores, step_scores = self.scores, _scores(self.reference, deformed, step.displacement, step.rigid)
        valid = np.isfinite(reference_scores + step_scores)
        reference_scores, step_scores = reference_scores[valid], step_scores[valid]
        squares = float((reference_scores**2 + step_scores**2).sum())
        in_common = 1 + 2 * float((reference_scores * step_scores).sum()) / squares if squares > 0 else 1.0
        slope = nodal_slopes(self.reference.mesh, step.displacement, step.measured, self.first.constants)[0]
        deformation = np.moveaxis(np.eye(2) + slope, 0, -1)

        def propagated(std: FloatArray) -> FloatArray:
            """Variance (N, 2) along x and y of what has this standard uncertainty in frame r."""
            (u, v), uv = (std**2).T, self.uv_correlation * std.prod(axis=1)
            return np.stack([a**2 * u + b**2 * v + 2 * a * b * uv for a, b in deformation], axis=1)

        def total(of_reference: FloatArray, of_step: FloatArray) -> FloatArray:
            return np.asarray(np.sqrt(in_common * (of_reference + of_step**2)))

        strain = _single(last.strain_std)
        normal, slopes = propagated(strain[:, :2]), np.maximum((strain[:, :2] ** 2).sum(axis=1), 1e-300)
        # slopes along x and along y are alike: half the shear strain's are those of u, half those of v
        shear = strain[:, 2] ** 2 * normal.sum(axis=1) / slopes
        # what is missed near edges is found anew from the whole displacement
        before_std = np.sqrt(np.maximum(_single(last.displacement_std) ** 2 - _single(last.edge_std) ** 2, 0))
        return replace(
            step,
            nodes=mesh.nodes,
            elements=mesh.elements,
            displacement=self.displacement + step.displacement,
            displacement_std=total(propagated(before_std), step.displacement_std),
            bias_std=total(propagated(_single(last.bias_std)), step.bias_std),
            strain=_single(last.strain) + step.strain,
            strain_std=total(np.column_stack([normal, shear]), step.strain_std),
            rigid=last.rigid + step.rigid if step.rigid.size else step.rigid,
        )

    def _step(self, displacement: FloatArray, solution: Solution) -> tuple[FloatArray, FloatArray]:
        """Return what a `displacement` (N, 2) and the rigid motions of a solution add to those of frame r."""
        rigid = solution.rigid if self.solution is None else solution.rigid - self.solution.rigid
        return displacement - self.displacement, rigid

    def match(self, deformed: Deformed, solution: Solution) -> FloatArray:
        """Correlation coefficient (E,) of the elements with this reference, of the light that matches best.

        NaN where a node has no displacement, and where no light sees the element in both images.

        Parameters
        ----------
        deformed
            Images of the frame.
        solution
            Its displacement on this reference.

        Returns
        -------
        ndarray, shape (E,)
            From -1 to 1.
        """
        residual, has_displacement = _residual(self.reference, deformed, *self._step(solution.displacement, solution))
        lights = zip(*centred_products(residual.moments), strict=True)
        coefficients = np.array([correlation(fg, ff, gg) for fg, ff, gg in lights])
        best = np.where(residual.moments[..., 0] > 0, coefficients, -np.inf).max(axis=0)
        return np.where(has_displacement & (best > -np.inf), best, np.nan)

    @staticmethod
    def is_due(match: FloatArray, best: float, poor: float = 0.95, fraction: float = 0.1) -> bool:
        """Tell whether a frame should become the next reference: a tenth of its measured elements match poorly.

        Nodes without data call for none: they would be lost for good, where a glare passes and a crack closes.

        Parameters
        ----------
        match
            See `match`.
        best
            Largest median of `match` of the frames on this reference: camera noise alone keeps it below 1.
        poor
            Correlation coefficient, over `best`, under which an element calls for another reference. Paint of speckles
            of 4 px that changes by 5 % leaves a node of 25 px elements uncertain by 0.3 px, by 10 % nearly by the 0.5
            px from which it is decorrelated. Measured on paint that changes by 2 % a frame, nodes left after 24 frames:
            78 % with 0.95, 47 with 0.9, 39 with 0.8; without an update none from frame 12 on.
        fraction
            Of the measured elements that must call for it. Chosen: fewer are a glare or a crack that passes.

        Returns
        -------
        bool
        """
        measured = np.isfinite(match)
        return bool(measured.any() and (match[measured] < poor * best).mean() > fraction)

    def updated(
        self,
        solution: Solution,
        images: FloatImage,
        weights: FloatImage | None = None,
        origin: tuple[int, int] | None = None,
    ) -> ReferenceUpdate:
        """Make a frame the reference.

        All that the update holds follows from the arguments and `self`, uncertainty and strain in single precision: a
        solution read back from a result gives the same bits.

        Parameters
        ----------
        solution
            Of the frame, on the first one.
        images, weights : ndarray, shape (k, H, W), float32
            Of the frame, as `Reference.prepare` takes them.
        origin
            Column and row of the frame at which they begin; by default where those of the first do.

        Returns
        -------
        ReferenceUpdate
            With the frame as its reference.

        Raises
        ------
        InputError
            No element of the frame is measured.
        """
        mesh, measured = self.first.mesh, solution.measured
        if not measured[mesh.elements].all(axis=1).any():
            raise InputError("a frame in which no element is measured cannot be a reference")
        displacement = solution.displacement[mesh.nearest_nodes(measured)[1]]
        origin, prefilter = self.first.origin if origin is None else origin, self.first.prefilter
        motion = displacement - np.subtract(origin, self.first.origin)
        deformed_mesh = Tri3Mesh(nodes=mesh.nodes + motion, elements=mesh.elements)
        region = _region(self.first, deformed_mesh, measured, images.shape[1:])
        reference = Reference.prepare(
            images,
            region,
            weights,
            mesh=deformed_mesh,
            material=self.first.material,
            prefilter=prefilter,
            origin=origin,
            registration=self.first.registration,
            brightness=self.first.brightness,
            constants=self.first.constants,
        )
        deformed = Deformed.prepare(images, weights, prefilter=prefilter, origin=origin)
        scores = _scores(self.first, deformed, np.where(measured[:, None], displacement, np.nan), solution.rigid)
        (xx, xy), (yx, yy) = np.moveaxis(np.eye(2) + mesh.element_gradient(displacement), 0, -1)
        # of as many pixels and as large a gradient as frame r has there: det(F) F^-T
        cofactors = np.stack([yy, -yx, -xy, xx], axis=1).reshape(-1, 2, 2)
        return ReferenceUpdate(
            first=self.first,
            reference=reference,
            displacement=displacement,
            solution=solution,
            scores=np.einsum("ecd,ed->ec", cofactors, scores),
            uv_correlation=_uv_correlation(self.first, displacement),
        )


def _uv_correlation(first: Reference, displacement: FloatArray) -> FloatArray:
    """Correlation (N,) of u and v at a displacement (N, 2): that of F M^-1 F^T, with M the Hessian around each node."""
    hessians = first.hessians(first.pixel_weights)
    xx, xy, yy = first.assembly.node_blocks(np.sum(hessians, axis=0))
    adjugate = np.stack([yy, -xy, -xy, xx], axis=1).reshape(-1, 2, 2)
    deformation = np.eye(2) + first.mesh.nodal_gradient(displacement)
    covariance = deformation @ adjugate @ deformation.swapaxes(1, 2)
    scale = np.sqrt(np.maximum(covariance[:, 0, 0] * covariance[:, 1, 1], 0))
    return np.asarray(np.divide(covariance[:, 0, 1], scale, out=np.zeros_like(scale), where=scale > 0))


def _single(values: FloatArray) -> FloatArray:
    return values.astype(np.float32).astype(np.float64)


def _region(first: Reference, mesh: Tri3Mesh, measured: BoolArray, shape: tuple[int, ...]) -> Region:
    """Return the pixels of the elements whose nodes are all measured, but for those under the edges of cracks.

    Where the first region is a rectangle without cracks, the paint goes on beyond it: as many pixels are added there as
    `Reference.prepare` takes off.
    """
    measured_elements, cracks = np.asarray(measured[mesh.elements].all(axis=1)), first.mesh.crack_edges
    mask = _covered(mesh, measured_elements, shape) & ~rasterise_lines(mesh.nodes[cracks], shape)
    if first.pixels.local_x.size == first.pixels.bounds[2] * first.pixels.bounds[3] and not len(cracks):
        side = 2 * usable_reach(first.prefilter) + 1
        grown = cv2.dilate(mask.astype(np.uint8), np.ones((side, side), dtype=np.uint8)) > 0
        mask |= grown & ~_covered(mesh, ~measured_elements, shape)
    return Region.from_mask(mask)


def _covered(mesh: Tri3Mesh, elements: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """Pixels (H, W) of the chosen elements (E,)."""
    owner = np.full(shape, -1, dtype=np.int32)
    claim_pixels(mesh.nodes, mesh.elements[elements], owner)
    return owner >= 0


def _scores(reference: Reference, deformed: Deformed, displacement: FloatArray, rigid: FloatArray) -> FloatArray:
    """Sum the weighted residual at a displacement times the gradient over each element, (E, 2).

    The sums are NaN where a node has no displacement.
    """
    residual, has_displacement = _residual(reference, deformed, displacement, rigid)
    projected = reference.projected(residual.weights, residual.difference, reference.gradient)
    return np.where(has_displacement[:, None], projected.sum(axis=(0, 2)), np.nan)


def _residual(
    reference: Reference, deformed: Deformed, displacement: FloatArray, rigid: FloatArray
) -> tuple[Residual, BoolArray]:
    """Return the residual at a displacement (N, 2) with gaps, and the elements (E,) all of whose nodes have one.

    The lights' rigid coefficients are (k, m), NaN for a light that sees nothing.
    """
    finite = np.asarray(np.isfinite(displacement).all(axis=1))
    functions = rigid_functions(reference.mesh.nodes, "translation+rotation")[:, : rigid.shape[1]]
    rigid_motions = (np.nan_to_num(rigid) @ functions.T).reshape(len(rigid), *displacement.shape)
    motion = list(np.nan_to_num(displacement) + rigid_motions)
    has_displacement = np.asarray(finite[reference.mesh.elements].all(axis=1))
    filtered = reference.filtered_as(np.nan_to_num(displacement))
    return Residual.at(filtered, deformed, motion), has_displacement
