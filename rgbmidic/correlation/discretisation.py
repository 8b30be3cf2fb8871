"""The discretisation error: what mesh and recovery leave out of the field, estimated from the images themselves.

The stated uncertainty is that of noise. What the elements cannot follow is estimated by halving them: Gauss-Newton
steps from the recovered field on triangles of half the side give a second, finer field (the hierarchical estimator of
Bank and Weiser, Math. Comp. 44, 1985), and what both differ by beyond noise is the error of the coarser one. The
variance of that difference over that of the field is a property of the two meshes and the texture alone, found once
from random scores. Recovered slopes of a smooth field are smoothed by the mass matrix M over the lumped one L (Lele,
J. Comput. Phys. 103, 1992): undoing that shows the error of strain where waves are long and noise hides the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from rgbmidic._kernels.correlation import interpolate_nodal
from rgbmidic._kernels.illumination import scores
from rgbmidic._kernels.threads import one_blas_thread
from rgbmidic.correlation.assembly import SCORE_RANGE, block_side, rigid_functions
from rgbmidic.correlation.equations import Equations, Estimate, Problem, compare, stepped
from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.correlation.recovery import Recovery, mass_matrix
from rgbmidic.correlation.reference import Deformed, Reference, ReferenceGeometry
from rgbmidic.correlation.residual import PrecisionMethod, Residual, corrected_values
from rgbmidic.correlation.solution import Solution
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.pixel_map import quadratic_fit
from rgbmidic.settings import SolverSettings
from rgbmidic.typing import AnyArray, BoolArray, FloatArray, FloatImage

__all__ = ["discretisation_error"]


def discretisation_error(
    reference: Reference,
    deformed: Deformed,
    solution: Solution,
    options: SolverSettings,
    method: PrecisionMethod | None,
) -> Solution:
    """Estimate what mesh and recovery leave out of a solution.

    Parameters
    ----------
    reference, deformed, options, method
        As `solve` was given them.
    solution
        What it returned.

    Returns
    -------
    Solution
        With `displacement_error` (N, 2) in px and `strain_error` (N, 3), as standard deviations: NaN at nodes that are
        not measured, and everywhere on elements under 8 px. `displacement_std` and `strain_std` are then those of noise
        alone: the misfit of the elements, which the residual holds, is taken out. ``hypot(std, error)`` is the standard
        uncertainty with both.
    """
    mesh, measured = reference.mesh, solution.measured
    if not measured.any() or mesh.size < _SMALLEST:
        return solution
    halves = _Halves.of(reference)
    used = np.asarray(measured[mesh.elements].all(axis=1))
    with one_blas_thread():
        fine = _FineField.solve(halves, deformed, solution, used, options, method)
    own = np.concatenate([solution.displacement, solution.strain], axis=1)
    std = np.concatenate([solution.displacement_std, solution.strain_std], axis=1)
    along = fine.noise_ratio / halves.noise_ratio
    along[along > _CHANCE] = 1
    std = std * np.sqrt(np.column_stack([along, along, along.mean(axis=1)]))
    error = halves.error(own - fine.values, solution.strain, std)
    return replace(
        solution,
        displacement_std=std[:, :2],
        strain_std=std[:, 2:],
        displacement_error=np.where(np.isfinite(solution.displacement), error[:, :2], np.nan),
        strain_error=np.where(np.isfinite(solution.strain), error[:, 2:], np.nan),
    )


_SMALLEST = 8.0
"""Side (px) of the smallest elements that are halved: those of 4 px have some eight samples for six unknowns."""
_STEPS = 2
"""Gauss-Newton steps on the finer mesh: what a third would change is 1 % of the difference (measured)."""
_DRAWS = 24
"""Random scores from which the variance of the difference is found: averaged over a window to 5 % (derived)."""
_SPREAD = 4
"""Times that squares are averaged with those of the nodes beside: a window of standard deviation 1.5 elements."""
_OF_DIFFERENCE = np.array([1.0, 1.0, 1.2, 1.2, 1.2])
"""Error over the difference. The finer mesh keeps 1/16 of the displacement's error and 1/4 of the strain's where waves
are long, nothing at 3 elements: 4/3 to 1.1 for strain."""
_UNSMOOTHED = 0.72
"""Second moment of the mass matrix's rows on TRI3 over h^2/3, inverted: what `_Halves.unsmoothed` overstates."""
_SURE = np.array([1.0, 1.0, 4.0, 4.0, 4.0])
_SURE_SMOOTH = 2.0
_UNEVEN = np.array([1.1, 1.1, 1.3, 1.3, 1.3])
"""Variance of the difference, and of what is unsmoothed, over that with equal weights: a robust loss weighs pixels
unevenly (measured on affine fields)."""
_CHANCE = 0.75
"""Scores' variance on the finer mesh over that at the recovered field from which it is less by chance: both are known to
12 % (67 blocks, `SCORE_RANGE`), and nothing is taken off the stated noise."""
_EDGE = 2.5
"""Error of one-sided slopes over that of central ones."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _FineField:
    """The field on the halved mesh.

    Attributes
    ----------
    values : ndarray, shape (N, 5)
        u, v, exx, eyy, exy at the nodes of the coarse mesh.
    noise_ratio : ndarray, shape (N, 2)
        Variance of the scores in x and y on the finer mesh over that at the recovered field.
    """

    values: FloatArray
    noise_ratio: FloatArray

    @classmethod
    def solve(
        cls,
        halves: _Halves,
        deformed: Deformed,
        solution: Solution,
        used: BoolArray,
        options: SolverSettings,
        method: PrecisionMethod | None,
    ) -> _FineField:
        """Take Gauss-Newton steps from the recovered field."""
        mesh, fine = halves.mesh, halves.fine
        known = solution.displacement[mesh.nearest(solution.measured)[1]]
        start, curvature = halves.interpolated(known, used)
        functions = rigid_functions(mesh.nodes, options.rigid)
        rigid = np.nan_to_num(solution.rigid)
        functions = halves.prolonged(functions.reshape(len(mesh.nodes), -1)).reshape(2 * len(start), -1)
        problem = Problem(reference=fine, deformed=deformed, options=options, method=method, functions=functions)
        estimate = Estimate(displacement=start, rigid=rigid)
        first = compare(problem, fine.values, estimate)
        values = corrected_values(first, options.brightness)
        first = replace(first, values=values, difference=first.difference_from(values))
        inside = np.repeat(np.repeat(used, 4), np.diff(fine.pixels.offsets))
        given = first.weights * inside
        weights, loss = _weighed(method, first, given)
        equations = Equations.build(fine, weights, functions[:, :0], start, None if method is None else given)
        for number in range(_STEPS):
            estimate = stepped(problem, equations, values, estimate, None if number else first.difference)
        # the loss bends less than the weights of one residual say
        found = start + loss[:, None] * (estimate.displacement - start)
        last = compare(problem, values, replace(estimate, displacement=found))
        used = np.repeat(used, 4) & equations.textured[fine.mesh.elements].all(axis=1)
        recovery, offset = halves.recovery(used, equations.information(fine))
        last_weights, _ = _weighed(method, last, given)
        before = _score_variance(first.without(np.zeros_like(start), curvature), weights, mesh.size)
        after = _score_variance(last.without(*recovery.bend(found, offset)), last_weights, fine.mesh.size)
        ratio = np.divide(after, before, out=np.ones_like(after), where=before > 0)
        count = len(mesh.nodes)
        known = (equations.textured & ~fine.mesh.beside(~equations.textured))[:count]
        field = np.concatenate([recovery.displacement(found), recovery.strain(found)], axis=1)[:count]
        return cls(
            values=np.where(known[:, None], field, np.nan),
            noise_ratio=_at_nodes(fine.mesh, ratio)[:count],
        )


def _weighed(method: PrecisionMethod | None, residual: Residual, given: FloatImage) -> tuple[FloatImage, FloatArray]:
    """Weights (k, P) by the residual's precision, and the factor (N,) by which the robust loss bends less than they."""
    precision = None if method is None else method.precision(residual)
    if precision is None:
        return given, np.ones(len(residual.reference.mesh.nodes))
    weights = given * precision.factor
    return weights, precision.robust_loss(residual.reference, weights)


def _score_variance(residual: Residual, weights: FloatImage, size: float) -> FloatArray:
    """Variance of the fit's noise in x and y (E, 2), by the scores of blocks, up to a factor."""
    pixels, mesh = residual.reference.pixels, residual.reference.mesh
    side = block_side(pixels, size)
    sums = np.empty((4, weights.shape[1]), dtype=np.float32)
    scores(residual.difference, weights, *residual.reference.gradient, sums)
    x, y, information, count = pixels.block_sums(sums, side).astype(np.float64)
    xx, yy, information, count = (
        cv2.GaussianBlur(grid, (0, 0), SCORE_RANGE / side, borderType=cv2.BORDER_CONSTANT)
        for grid in (x * x, y * y, information, count)
    )
    scale = np.divide(count, information**2, out=np.zeros_like(count), where=information > 0)
    variance = np.stack([xx * scale, yy * scale], axis=-1)
    place = mesh.nodes[mesh.elements].mean(axis=1)[:, ::-1] - pixels.bounds[:2]
    row, column = np.clip(np.round(place / side - 0.5).astype(int), 0, np.array(count.shape) - 1).T
    return np.asarray(variance[row, column])


def _at_nodes(mesh: Tri3Mesh, per_element: FloatArray) -> FloatArray:
    """Mean (N, C) of values (E, C) over the elements around each node."""
    sums = [mesh.to_nodes(part * mesh.areas) for part in per_element.T]
    return np.stack(sums, axis=1) / mesh.to_nodes(mesh.areas)[:, None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Halves:
    """The mesh of a reference with each element in four, and what follows for all its frames.

    Attributes
    ----------
    mesh
        The reference's own.
    fine
        The reference on the finer mesh, whose first nodes are those of `mesh`.
    ends : ndarray, shape (M, 2)
        The two nodes that each other node of the finer mesh is between.
    around : csr_matrix, shape (N, N)
        Mean over each node and those beside it, boundary and interior apart.
    difference_gain : ndarray, shape (N, 5)
        Variance of the difference of both fields over that of the coarse one.
    unsmoothed_gain : ndarray, shape (N, 3)
        Variance of `unsmoothed` strain over that of strain.
    scatter : ndarray, shape (N, 8)
        Standard deviation of the mean square of both over a window, relative.
    noise_ratio : float
        That of `_FineField`, of noise alone.
    """

    mesh: Tri3Mesh
    fine: Reference
    ends: npt.NDArray[np.int64]
    around: sp.csr_matrix
    difference_gain: FloatArray
    unsmoothed_gain: FloatArray
    scatter: FloatArray
    noise_ratio: float

    @classmethod
    def of(cls, reference: Reference) -> _Halves:
        """Halve the elements of a reference; the last result is kept."""
        return _halves(reference)

    def prolonged(self, nodal: FloatArray) -> FloatArray:
        """Linear interpolation at the nodes of the finer mesh."""
        return np.concatenate([nodal, nodal[self.ends].mean(axis=1)])

    def interpolated(self, field: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Interpolate a field (N, 2) between nodes with its second derivatives there, and interpolate these."""
        operators = quadratic_fit(self.mesh, used)[3:]
        second = self.prolonged(np.stack([operator @ field for operator in operators], axis=-1))
        x, y = (self.mesh.nodes[self.ends[:, 1]] - self.mesh.nodes[self.ends[:, 0]]).T
        squares = np.stack([x * x, 2 * x * y, y * y], axis=1)
        fine = self.prolonged(field)
        fine[len(field) :] -= np.einsum("nct,nt->nc", second[len(field) :], squares) / 8
        return fine, second

    def recovery(self, used: BoolArray, information: FloatArray) -> tuple[Recovery, FloatArray]:
        """Recovery on the finer mesh, and the linear fit's offset there."""
        geometry = self.fine.geometry
        return Recovery.over(geometry.material, used, information, geometry.linear_offset), geometry.linear_offset

    def averaged(self, values: FloatArray) -> FloatArray:
        """Weighted mean (N, C) over a window of some 1.5 elements; NaN takes no part."""
        known = np.isfinite(values)
        total, number = np.where(known, values, 0), known.astype(np.float64)
        for _ in range(_SPREAD):
            total, number = self.around @ total, self.around @ number
        return np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)

    def unsmoothed(self, strain: FloatArray) -> FloatArray:
        """``(M^-1 L - 1) s``, the boundary held: what recovered slopes (N, C) of a smooth field have lost."""
        return _unsmoothing(self.mesh)(np.nan_to_num(strain))

    def error(self, difference: FloatArray, strain: FloatArray, std: FloatArray) -> FloatArray:
        """Error (N, 5) from the difference of the two fields (N, 5), strain (N, 3) and noise (N, 5)."""
        edge = self.mesh.on_boundary
        noise, sure = std**2 * self.difference_gain, _SURE * self.scatter[:, :5] * (1 + edge[:, None])
        square = _OF_DIFFERENCE**2 * self._beyond(difference, _UNEVEN * noise, sure)
        unsmoothed = np.where(edge[:, None], np.nan, self.unsmoothed(strain))
        noise = _UNEVEN[2:] * std[:, 2:] ** 2 * self.unsmoothed_gain
        smooth = _UNSMOOTHED**2 * self._beyond(unsmoothed, noise, _SURE_SMOOTH * self.scatter[:, 5:])
        smooth[edge] = _EDGE**2 * self._beside_edge(smooth)[edge]
        square[:, 2:] = np.fmax(square[:, 2:], smooth)
        return np.sqrt(square)

    def _beside_edge(self, values: FloatArray) -> FloatArray:
        """Mean of interior values (N, C) over the nodes beside each."""
        inner = ~self.mesh.on_boundary
        i, j = self.mesh.neighbours.T
        near = sp.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(inner),) * 2)
        number = near @ (inner[:, None] & np.isfinite(values)).astype(np.float64)
        total = near @ np.where(inner[:, None], np.nan_to_num(values), 0)
        return np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0)

    def _beyond(self, values: FloatArray, variance: FloatArray, sure: FloatArray) -> FloatArray:
        """Mean square of values around each node beyond their noise, where it is surely beyond."""
        known = np.isfinite(values * variance) & (variance > 0)
        weight = np.where(known, 1 / np.where(known, variance, 1), np.nan)
        scale = self.averaged(weight)
        square, noise = self.averaged(weight * np.where(known, values, 0) ** 2) / scale, 1 / scale
        return np.where(np.isnan(square), np.nan, np.where(square > noise * (1 + sure), square - noise, 0.0))


@lru_cache(maxsize=1)
def _unsmoothing(mesh: Tri3Mesh) -> AnyArray:
    mass = mass_matrix(mesh).tocsr()
    lumped = np.asarray(mass.sum(axis=1)).ravel()
    edge = mesh.on_boundary
    inner, outer = np.flatnonzero(~edge), np.flatnonzero(edge)
    factors = splu(mass[inner][:, inner].tocsc()) if inner.size else None

    def apply(strain: FloatArray) -> FloatArray:
        out = np.zeros_like(strain)
        if factors is not None:
            right = lumped[inner, None] * strain[inner] - mass[inner][:, outer] @ strain[outer]
            out[inner] = factors.solve(right) - strain[inner]
        return out

    return apply


def _split(mesh: Tri3Mesh) -> tuple[Tri3Mesh, npt.NDArray[np.int64]]:
    """Each element in four, its children together, and the ends (M, 2) of the edges in whose middle a node is added."""
    corners, count = mesh.elements.astype(np.int64), len(mesh.nodes)
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    keys, place = np.unique(edges[:, 0] * count + edges[:, 1], return_inverse=True)
    ends = np.stack(np.divmod(keys, count), axis=1)
    (a, b, c), (ab, bc, ca) = corners.T, count + place.reshape(3, -1)
    children = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Tri3Mesh(nodes=np.concatenate([mesh.nodes, mesh.nodes[ends].mean(axis=1)]), elements=children), ends


_CHILDREN = np.array(
    [
        [[1, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5]],
        [[0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5]],
        [[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1]],
        [[0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]],
    ]
)
"""Values of an element's shape functions (last axis) at the corners of its four children."""


def _refined_reference(reference: Reference, mesh: Tri3Mesh) -> Reference:
    """The same reference on a finer mesh of the same pixels."""
    old = reference.pixels
    region = Region.from_mask(old.scatter(np.ones(old.local_x.size, dtype=np.float32)) > 0)
    geometry = ReferenceGeometry.of(mesh, region, reference.origin, None)

    def moved(values: FloatImage) -> FloatImage:
        flat = values.reshape(-1, values.shape[-1])
        images = [geometry.pixels.gather(old.scatter(row)) for row in flat]
        return np.array(images, dtype=np.float32).reshape(*values.shape[:-1], geometry.pixels.local_x.size)

    arrays = ("values", "gradient", "pixel_weights", "texture", "channel_specific")
    return replace(
        reference, geometry=geometry, unfitted=1.0, **{name: moved(getattr(reference, name)) for name in arrays}
    )


@lru_cache(maxsize=1)
def _halves(reference: Reference) -> _Halves:
    mesh, count = reference.mesh, len(reference.mesh.nodes)
    fine_mesh, ends = _split(mesh)
    fine = _refined_reference(reference, fine_mesh)
    edge = mesh.on_boundary
    i, j = mesh.neighbours[edge[mesh.neighbours[:, 0]] == edge[mesh.neighbours[:, 1]]].T
    itself = np.arange(count)
    row, column = np.concatenate([i, j, itself]), np.concatenate([j, i, itself])
    around = sp.csr_matrix((np.ones(row.size), (row, column)), shape=(count, count))
    halves = _Halves(
        mesh=mesh, fine=fine, ends=ends, around=sp.diags(1 / np.diff(around.indptr)) @ around,
        difference_gain=np.ones((count, 5)), unsmoothed_gain=np.ones((count, 3)), scatter=np.ones((count, 8)), noise_ratio=1.0,
    )  # fmt: skip
    return _with_noise(halves, reference)


def _with_noise(halves: _Halves, reference: Reference) -> _Halves:
    """Find the gains of noise from draws of it."""
    mesh, fine, count = halves.mesh, halves.fine, len(halves.mesh.nodes)
    random = np.random.default_rng(0)
    weights = fine.pixel_weights
    equations = Equations.build(fine, weights, np.zeros((2 * len(fine.mesh.nodes), 0)), np.zeros_like(fine.mesh.nodes))
    coarse = Equations.build(
        reference, reference.pixel_weights, np.zeros((2 * count, 0)), np.zeros_like(mesh.nodes)
    )
    everywhere = np.ones(len(mesh.elements), dtype=bool)
    offset = reference.geometry.linear_offset
    recovery = Recovery.over(reference.geometry.material, everywhere, coarse.information(reference), offset)
    finer, fine_offset = halves.recovery(np.repeat(everywhere, 4), equations.information(fine))
    # scores with the covariance of the Hessian, element by element
    blocks = equations.blocks
    covariance = np.empty((len(blocks), 6, 6))
    for a in range(2):
        for b in range(2):
            covariance[:, a::2, b::2] = blocks[..., a + b]
    covariance += 1e-6 * np.trace(blocks.sum(axis=0).sum(axis=0)[..., [0, 2]].sum() * np.eye(6)) / len(blocks) * np.eye(6)
    root = np.linalg.cholesky(covariance)
    drawn = (root @ random.standard_normal((len(blocks), 6, _DRAWS))).reshape(len(blocks), 3, 2, _DRAWS)
    right = np.stack([fine.assembly.vector(drawn[..., draw]) for draw in range(_DRAWS)], axis=1)
    lower = right.reshape(-1, 2, _DRAWS)
    restricted = lower[:count].copy()
    for end in halves.ends.T:
        np.add.at(restricted, end, lower[count:] / 2)
    fields = _fields(recovery, coarse.solve(restricted.reshape(2 * count, _DRAWS)))
    fine_fields = _fields(finer, equations.solve(right))[:count]
    flat = np.ascontiguousarray(fields[..., 2:]).reshape(count, -1)
    unsmoothed = halves.unsmoothed(flat).reshape(count, _DRAWS, 3)
    unsmoothed[mesh.on_boundary] = np.nan
    drawn = np.concatenate([fields - fine_fields, unsmoothed], axis=2) ** 2
    means = halves.averaged(drawn.reshape(count, -1)).reshape(count, _DRAWS, 8)
    scatter = halves.averaged(means.var(axis=1) / means.mean(axis=1) ** 2) ** 0.5
    gains = means.mean(axis=1) / halves.averaged((fields**2).mean(axis=1))[:, [0, 1, 2, 3, 4, 2, 3, 4]]
    ratios = [_drawn_ratio(halves, reference, equations, coarse, finer, recovery, random) for _ in range(2)]
    return replace(
        halves, difference_gain=gains[:, :5], unsmoothed_gain=gains[:, 5:], scatter=scatter,
        noise_ratio=float(np.mean(ratios)),
    )  # fmt: skip


def _fields(recovery: Recovery, fitted: FloatArray) -> FloatArray:
    """u, v, exx, eyy, exy (N, R, 5) for nodal values (2 N, R) of the linear fit."""
    u, v = fitted[::2], fitted[1::2]
    (xu, xv), (yu, yv) = ((slope @ u, slope @ v) for slope in (recovery.slope_x, recovery.slope_y))
    return np.stack([recovery.value @ u, recovery.value @ v, xu, yv, (yu + xv) / 2], axis=-1)


def _drawn_ratio(
    halves: _Halves,
    reference: Reference,
    equations: Equations,
    coarse: Equations,
    finer: Recovery,
    recovery: Recovery,
    random: np.random.Generator,
) -> float:
    """Ratio of the scores' variances of `_FineField` for white noise that went through the prefilter."""
    fine, shape = halves.fine, halves.fine.pixels.shape
    noise = np.stack(
        [
            fine.pixels.gather(apply_prefilter(random.standard_normal(shape, dtype=np.float32), fine.prefilter))
            for _ in fine.values
        ]
    )
    right = fine.assembly.vector(
        sum(fine.projected(*light) for light in zip(fine.pixel_weights, noise, fine.gradient.swapaxes(0, 1), strict=True))
    )
    count = len(halves.mesh.nodes)
    lower = right.reshape(-1, 2)
    restricted = lower[:count].copy()
    for end in halves.ends.T:
        np.add.at(restricted, end, lower[count:] / 2)
    found = equations.solve(right).reshape(-1, 2)
    start, curvature = halves.interpolated(
        recovery.displacement(coarse.solve(restricted.ravel()).reshape(-1, 2)), np.ones(len(halves.mesh.elements), bool)
    )
    before, after = (_left(fine, noise, field) for field in (start, found))
    before = before.without(np.zeros_like(start), curvature)
    after = after.without(*finer.bend(found, fine.geometry.linear_offset))
    first, last = (
        _score_variance(residual, fine.pixel_weights, size)
        for residual, size in ((before, halves.mesh.size), (after, fine.mesh.size))
    )
    return float((fine.mesh.areas @ last).sum() / (fine.mesh.areas @ first).sum())


def _left(fine: Reference, noise: FloatImage, field: FloatArray) -> Residual:
    """Residual that is left of noise (k, P) by a fit (N, 2) to it."""
    shown = np.empty((2, noise.shape[1]), dtype=np.float32)
    interpolate_nodal(field, fine.mesh.elements, *fine.pixels.positions, shown)
    left = noise - fine.gradient[0] * shown[0] - fine.gradient[1] * shown[1]
    return Residual(
        reference=fine, values=fine.values, weights=fine.pixel_weights, difference=left, moments=np.zeros(0)
    )
