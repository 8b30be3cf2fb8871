"""The discretisation error: what mesh and recovery leave out of the field, estimated from the images themselves.

The stated uncertainty is that of noise. What the elements cannot follow is estimated by halving them: Gauss-Newton
steps from the recovered field on triangles of half the side give a second, finer field (the hierarchical estimator of
Bank and Weiser, Math. Comp. 44, 1985), and what both differ by beyond noise is the error of the coarser one. The
variance of that difference over that of the field is a property of the two meshes and the texture alone, found once
from random scores. Recovered slopes of a smooth field are smoothed by the mass matrix M over the lumped one L (Lele,
J. Comput. Phys. 103, 1992): undoing that shows the error of strain where waves are long and noise hides the difference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic._kernels.owned_pixels import interpolate_nodal
from rgbmidic._kernels.threads import one_blas_thread
from rgbmidic.correlation.assembly import Assembly, rigid_functions
from rgbmidic.correlation.blocks import BlockTable
from rgbmidic.correlation.brightness import GainFit
from rgbmidic.correlation.equations import Equations, Estimate, Problem, compare, gauss_newton_step
from rgbmidic.correlation.images import apply_prefilter
from rgbmidic.correlation.light_bias import with_consistent_gradient
from rgbmidic.correlation.one_sided_fit import one_sided_error, with_one_sided_error
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.residual import PrecisionMethod, Residual, curved_deviation
from rgbmidic.correlation.solution import Solution
from rgbmidic.correlation.uncertainty import robust_loss
from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.mesh.outline_mesh import EDGES, edge_keys
from rgbmidic.mesh.recovery import Recovery, at_free_boundary, slope_operators
from rgbmidic.settings import SMALLEST_HALVED, SolverSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class DiscretisationConstants:
    """Constants of the estimate.

    Attributes
    ----------
    draws
        Random scores from which the variance of the difference is found: averaged over a window to 6 % (derived).
    noises
        Images of noise from which is found what both fits leave of it: 800 blocks of 13 px in 380 px, to 5 % (derived).
    spread
        Times that squares are averaged with those of the nodes beside: a window of standard deviation 1.5 elements.
    of_difference
        Error over the difference. Of what the mesh loses the halved one loses 1/16 for displacement and 1/4 for strain
        where waves are long, next to nothing at 3 elements: 4/3 to 1.1 for strain (derived). For displacement 1.07, and
        more for what is lost with differences taken for noise; chosen on the DIC Challenge star.
    unsmoothed
        Inverse second moment of the rows of TRI3's mass matrix over h^2/3: what `_RefinedMesh.unsmooth` overstates.
    significance
        Standard deviations of the mean square of noise alone by which the difference, of displacement (2) and of strain
        (3), and the `_RefinedMesh.smoothing_loss` (3) must exceed it. Strain's difference has 3 to 4 times the noise of
        strain, so that what passes by chance would be a multiple of it. Chosen: affine fields come out 15 % larger at
        most.
    significance_at_edge
        The same at the boundary, where the difference has 10 to 16 times the noise of strain.
    uneven
        Variance of the same over that with equal weights: a robust loss weighs pixels unevenly (measured on affine
        fields).
    chance
        Noise by what the finer mesh leaves, over the stated one, from which it is less by chance: both are known to 6
        to 12 % (67 blocks), and nothing is taken off. Of values below it the mean is too small by about
        half of what is missing (measured: .9).
    held
        Fraction of the mean texture that is added to that of an element, so that its square root exists (derived).
    """

    draws: int = 16
    noises: int = 2
    spread: int = 4
    of_difference: float = 1.25
    unsmoothed: float = 0.72
    significance: tuple[float, ...] = (1.2, 1.2, 4.0, 4.0, 4.0, 2.0, 2.0, 2.0)
    significance_at_edge: tuple[float, ...] = (3.6, 3.6, 12.0, 12.0, 12.0, 2.0, 2.0, 2.0)
    uneven: tuple[float, ...] = (1.15, 1.15, 1.4, 1.4, 1.4, 1.4, 1.4, 1.4)
    chance: float = 0.8
    held: float = 1e-6


_CONSTANTS = DiscretisationConstants()


def discretisation_error(
    reference: Reference,
    deformed: Deformed,
    solution: Solution,
    options: SolverSettings,
    method: PrecisionMethod | None,
) -> Solution:
    """Estimate what mesh and recovery leave out of a solution.

    It takes about as long as the solve; what depends on the reference alone is prepared with its first frame.

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
        not measured, and everywhere on elements under 8 px, where the uncertainty is that of `with_one_sided_error`.
        Else `displacement_std` and `strain_std` are then those of noise
        alone: the misfit of the elements, which the residual holds, is taken out. ``hypot(std, error)`` is the standard
        uncertainty with both.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> from rgbmidic.correlation import solve
    >>> from rgbmidic.mesh import Region
    >>> from rgbmidic.settings import SolverSettings
    >>> speckle = gaussian_filter(np.random.default_rng(0).normal(size=(1, 80, 80)), (0, 1.5, 1.5)).astype(np.float32)
    >>> region = Region.from_rectangle((0, 0, 79, 79), shape=(80, 80))
    >>> reference = Reference.prepare(1 + speckle, region, mesh=Tri3Mesh.from_region(region, element_size=26))
    >>> deformed, options = Deformed.prepare(1 + speckle), SolverSettings()
    >>> solution = solve(reference, deformed, np.zeros_like(reference.mesh.nodes), options, None)
    >>> solution = discretisation_error(reference, deformed, solution, options, None)
    >>> bool(np.nanmax(solution.displacement_error) < 0.05)
    True
    """
    mesh, measured = reference.mesh, solution.measured
    if not measured.any() or mesh.size < SMALLEST_HALVED:
        return with_one_sided_error(mesh, solution)
    refined, noise_statistics = reference.derive(_refined_mesh)
    with one_blas_thread():
        values, variance, deformation = _finer_field(refined, deformed, solution, options, method)
        std = np.concatenate([solution.displacement_std, solution.strain_std], axis=1)
        noise = np.sqrt(noise_statistics.field_variance * np.column_stack([variance, variance, variance.mean(axis=1)]))
        turned = np.sqrt(np.einsum("nij,nj->ni", deformation**2, noise[:, :2] ** 2))
        noise[:, :4] *= np.tile(turned / np.maximum(noise[:, :2], 1e-300), 2)  # slopes of u have its direction
        less = noise < _CONSTANTS.chance * std
        coarse = np.concatenate([solution.displacement, solution.strain], axis=1)
        active = np.asarray(measured[mesh.elements].all(axis=1))
        difference = np.concatenate([coarse - values, refined.smoothing_loss(coarse)], axis=1)
        error = refined.error(noise_statistics, difference, np.where(less, noise, std))
        std = np.where(less, noise / np.sqrt(_CONSTANTS.chance), std)
        error = np.fmax(error, one_sided_error(mesh, active, solution.displacement, std[:, :2]))
    return replace(
        solution,
        displacement_std=std[:, :2],
        bias_std=np.minimum(solution.bias_std, std[:, :2]),
        strain_std=std[:, 2:],
        displacement_error=np.where(np.isfinite(solution.displacement), error[:, :2], np.nan),
        strain_error=np.where(np.isfinite(solution.strain), error[:, 2:], np.nan),
    )


def _finer_field(
    refined: _RefinedMesh,
    deformed: Deformed,
    solution: Solution,
    options: SolverSettings,
    method: PrecisionMethod | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Take Gauss-Newton steps on the halved mesh from the recovered field.

    Returns
    -------
    tuple
        u, v, exx, eyy, exy (N, 5) at the nodes of the solution, NaN where the finer mesh sees too little; the variance
        of the scores in x and y of the reference that it leaves, (N, 2), as `_score_variance`; and the deformation
        gradient (N, 2, 2) that carries these axes.
    """
    mesh, fine, count = refined.mesh, refined.fine, len(refined.mesh.nodes)
    active = np.asarray(solution.measured[mesh.elements].all(axis=1))
    start = refined.interpolated(solution.displacement[mesh.nearest_nodes(solution.measured)[1]], active)
    fine, functions = fine.filtered_as(start), rigid_functions(mesh.nodes, options.rigid).reshape(count, -1)
    functions = refined.prolonged(functions).reshape(2 * len(start), -1)
    problem = Problem(reference=fine, deformed=deformed, options=options, method=method, functions=functions)
    estimate = Estimate(displacement=start, rigid=np.nan_to_num(solution.rigid))
    first = compare(problem, estimate)
    children = np.repeat(active, len(_CHILDREN))
    prior_weights = first.weights * np.repeat(children, np.diff(fine.pixels.offsets))
    weights, _ = _precision_weights(method, first, prior_weights)
    fine = with_consistent_gradient(first, weights)
    problem, first = replace(problem, reference=fine), replace(first, reference=fine)
    without, noise = np.zeros((start.size, 0)), None if method is None else prior_weights  # without rigid functions
    equations = Equations.build(fine, weights, without, start, noise)
    estimate = gauss_newton_step(problem, equations, first, estimate)
    last = compare(problem, estimate)
    weights, loss = _precision_weights(method, last, prior_weights)
    equations = Equations.build(fine, weights, without, start, noise)
    # a robust loss bends less than the weights of one residual state: with these alone noise is followed too little
    correction = loss * equations.solve(_right_side(fine, equations.weights, last.difference)).reshape(-1, 2)
    last = replace(last, difference=_noise_residual(fine, last.difference, correction).difference)
    fitted = estimate.displacement + equations.turned(correction)
    recovery = refined.recovery(children & equations.textured[fine.mesh.elements].all(axis=1), equations)
    variance = _score_variance(last, equations.weights, refined.deviation(equations, recovery, fitted)) * loss**2
    valid = (equations.textured & ~fine.mesh.adjacent_nodes(~equations.textured))[:count]
    return np.where(valid[:, None], recovery.field(*fitted.T), np.nan), variance[:count], equations.deformation[:count]


def _right_side(reference: Reference, weights: FloatImage, difference: FloatImage) -> FloatArray:
    """Right-hand side (2 N,) of a known difference of all lights (k, P)."""
    return reference.assembly.vector(reference.projected(weights, difference, reference.gradient).sum(axis=0))


def _precision_weights(
    method: PrecisionMethod | None, residual: Residual, prior_weights: FloatImage
) -> tuple[FloatImage, FloatArray | float]:
    """Weights by the residual's precision, and the factor (N, 1) by which the robust loss bends less."""
    precision = None if method is None else method.precision(residual)
    if precision is None:
        return prior_weights, 1.0
    weights = prior_weights * precision.factor
    return weights, robust_loss(precision, residual.reference, weights)[:, None]


def _score_variance(residual: Residual, weights: FloatImage, deviation: FloatImage) -> FloatArray:
    """Variance of the scores in x and y (N, 2) over the square of their information, per pixel, around each node."""
    table, mesh = (
        BlockTable.of(residual, weights, deviation=deviation).over_elements().together(),
        residual.reference.mesh,
    )
    x, y, information, count = table.sums[0, :4]
    xx, yy, information, count = map(table.windowed_means, (x * x, y * y, information, count))
    scale = np.divide(count, information**2, out=np.zeros_like(count), where=information > 0)
    return table.at(np.stack([xx * scale, yy * scale]), mesh.nodes).T


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _NoiseStatistics:
    """Effect of noise on both fields, from draws of it: nothing else about it is assumed.

    Attributes
    ----------
    variance : ndarray, shape (N, 8)
        Variance of the difference of both fields (5), and of the `_RefinedMesh.smoothing_loss` of the coarse one (3),
        over that of the coarse one.
    scatter : ndarray, shape (N, 8)
        Relative standard deviation of their mean square over a window.
    field_variance : ndarray, shape (N, 5)
        Variance of u, v, exx, eyy, exy over that of the scores in their direction which the finer mesh leaves.
    """

    variance: FloatArray
    scatter: FloatArray
    field_variance: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _RefinedMesh:
    """The mesh of a reference with each element in four, and what follows for all its frames.

    Attributes
    ----------
    mesh
        The reference's own.
    at_edge : ndarray, shape (N,), bool
        Its nodes `at_free_boundary`.
    fine
        The reference on the finer mesh: its first nodes are those of `mesh`, each other is between two `neighbours`.
    neighbour_mean : csr_matrix, shape (N, N)
        Mean over each node and those beside it, boundary and interior apart.
    unsmooth
        Takes strain (N, C) to ``(M^-1 L - 1) s``, 0 at the boundary: what recovered slopes of a smooth field have lost.
    """

    mesh: Tri3Mesh
    at_edge: BoolArray
    fine: Reference
    neighbour_mean: sp.csr_matrix
    unsmooth: Callable[[FloatArray], FloatArray]

    def prolonged(self, nodal: FloatArray) -> FloatArray:
        """Interpolate linearly at the nodes of the finer mesh."""
        return np.concatenate([nodal, nodal[self.mesh.neighbours].mean(axis=1)])

    def restricted(self, sums: FloatArray) -> FloatArray:
        """Sum right-hand sides (2 M, R) of the finer mesh to those (2 N, R) of the coarse one."""
        components, count = sums.reshape(-1, 2, *sums.shape[1:]), len(self.mesh.nodes)
        total = components[:count].copy()
        for end in self.mesh.neighbours.T:
            np.add.at(total, end, components[count:] / 2)
        return total.reshape(2 * count, *sums.shape[1:])

    def interpolated(self, nodal: FloatArray, active: BoolArray) -> FloatArray:
        """Interpolate a displacement (N, 2) at the nodes of the finer mesh, as everywhere between nodes."""
        ends = self.mesh.neighbours
        slopes = np.stack([operator @ nodal for operator in slope_operators(self.mesh, active)], axis=-1)[ends]
        arm = self.mesh.nodes[ends[:, 1]] - self.mesh.nodes[ends[:, 0]]
        sag = np.einsum("ncd,nd->nc", slopes[:, 1] - slopes[:, 0], arm) / 8
        return np.concatenate([nodal, nodal[ends].mean(axis=1) - sag])

    def recovery(self, active: BoolArray, equations: Equations) -> Recovery:
        """Recover the field on the finer mesh, at the nodes of the coarse one."""
        return Recovery.over(self.fine.material, active, equations.information(), len(self.mesh.nodes))

    def deviation(self, equations: Equations, recovery: Recovery, fitted: FloatArray) -> FloatImage:
        """Return what the recovered field has over its fit on the finer mesh, `fitted`; see `curved_deviation`."""
        nodal = (equations.turned_back(self.prolonged(part)) for part in recovery.offset_and_curvature(fitted))
        return curved_deviation(self.fine.material, self.fine.pixels.barycentric, *nodal)

    def averaged(self, values: FloatArray) -> FloatArray:
        """Mean (N, C) over a window of some 1.5 elements; NaN takes no part."""
        valid = np.isfinite(values)
        total, number = np.where(valid, values, 0), valid.astype(np.float64)
        for _ in range(_CONSTANTS.spread):
            total, number = self.neighbour_mean @ total, self.neighbour_mean @ number
        return np.asarray(np.divide(total, number, out=np.full_like(total, np.nan), where=number > 0))

    def smoothing_loss(self, field: FloatArray) -> FloatArray:
        """Return what the strain of a field (N, ..., 5) has lost by smoothing, (N, ..., 3); NaN at the boundary."""
        strain = np.ascontiguousarray(field[..., 2:])
        out = self.unsmooth(np.nan_to_num(strain.reshape(len(strain), -1))).reshape(strain.shape)
        out[self.at_edge] = np.nan
        return out

    def error(self, noise_statistics: _NoiseStatistics, difference: FloatArray, std: FloatArray) -> FloatArray:
        """Error (N, 5) from the difference of the two fields and what is `smoothing_loss` (N, 8), and noise (N, 5)."""
        constants = _CONSTANTS
        noise = np.array(constants.uneven) * noise_statistics.variance * np.column_stack([std, std[:, 2:]]) ** 2
        significance = (
            np.where(self.at_edge[:, None], constants.significance_at_edge, constants.significance)
            * noise_statistics.scatter
        )
        square = self._excess(difference, noise, significance)
        square[:, :5] *= constants.of_difference**2
        square[:, 2:5] = np.fmax(square[:, 2:5], constants.unsmoothed**2 * square[:, 5:])
        return np.asarray(np.sqrt(square[:, :5]))

    def _excess(self, values: FloatArray, variance: FloatArray, significance: FloatArray) -> FloatArray:
        """Mean square around each node beyond the noise, 0 where it may be noise; nodes count by their precision."""
        valid = np.isfinite(values) & (variance > 0)
        weight = np.divide(1, variance, out=np.full_like(variance, np.nan), where=valid)
        noise = 1 / self.averaged(weight)
        square = noise * self.averaged(weight * np.where(valid, values, 0) ** 2)
        return np.where(square > noise * (1 + significance), square - noise, np.where(np.isnan(square), np.nan, 0))


_CHILDREN = np.array([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]])
"""Corners of the four parts of an element, 3 to 5 being the middles of its edges 01, 12 and 20."""


def _refined_mesh(reference: Reference) -> tuple[_RefinedMesh, _NoiseStatistics]:
    """Halve the elements of a reference, and find what noise does."""
    mesh, count = reference.mesh, len(reference.mesh.nodes)
    edge_index = np.unique(edge_keys(mesh.elements[:, EDGES].reshape(-1, 2), count), return_inverse=True)[1]
    six = np.concatenate([mesh.elements, count + edge_index.reshape(-1, 3)], axis=1)
    nodes = np.concatenate([mesh.nodes, mesh.nodes[mesh.neighbours].mean(axis=1)])
    fine_mesh = Tri3Mesh(nodes=nodes, elements=six[:, _CHILDREN].reshape(-1, 3))
    edge = at_free_boundary(mesh)
    i, j = mesh.neighbours[edge[mesh.neighbours[:, 0]] == edge[mesh.neighbours[:, 1]]].T
    itself = np.arange(count)
    row, column = np.concatenate([i, j, itself]), np.concatenate([j, i, itself])
    number = np.bincount(row, minlength=count)
    refined = _RefinedMesh(
        mesh=mesh,
        at_edge=edge,
        fine=_on_mesh(reference, fine_mesh),
        neighbour_mean=sp.csr_matrix((1 / number[row], (row, column)), shape=(count, count)),
        unsmooth=_unsmoothing(mesh),
    )
    return refined, _simulate_noise(refined, reference)


def _on_mesh(reference: Reference, mesh: Tri3Mesh) -> Reference:
    """Return a reference on another mesh of the same pixels."""
    old = reference.pixels
    region = Region.from_mask(old.scatter(np.ones(old.local_x.size, dtype=np.float32)) > 0)
    pixels = PixelMap.from_mesh(mesh, region)

    def resample(values: FloatImage) -> FloatImage:
        out = np.empty((*values.shape[:-1], pixels.local_x.size), dtype=np.float32)
        for row, target in zip(values.reshape(-1, values.shape[-1]), out.reshape(-1, out.shape[-1]), strict=True):
            target[:] = pixels.gather(old.scatter(row))
        return out

    names = "values", "inverse_level", "gradient", "pixel_weights", "rim"
    fields: dict[str, Any] = {name: resample(getattr(reference, name)) for name in names}
    texture = reference.texture
    fields["texture"] = replace(texture, images=resample(texture.images), texture=resample(texture.texture))
    images = fields["values"], fields["pixel_weights"], pixels
    fit = reference.gain_fit and GainFit.over(*images, reference.gain_fit.sigma)
    fields |= {"gain_fit": fit, "assembly": Assembly.from_mesh(mesh)}
    return replace(reference, mesh=mesh, material=mesh, pixels=pixels, **fields)


def _unsmoothing(mesh: Tri3Mesh) -> Callable[[FloatArray], FloatArray]:
    """See `_RefinedMesh.unsmooth`."""
    mass, edge = mesh.mass_matrix.tocsr(), mesh.on_boundary
    lumped = np.asarray(mass.sum(axis=1)).ravel()
    inner, outer = np.flatnonzero(~edge), np.flatnonzero(edge)
    solve = splu(mass[inner][:, inner].tocsc()).solve if inner.size else None

    def unsmooth(strain: FloatArray) -> FloatArray:
        out = np.zeros_like(strain)
        if solve is not None:
            right = lumped[inner, None] * strain[inner] - mass[inner][:, outer] @ strain[outer]
            out[inner] = solve(right) - strain[inner]
        return out

    return unsmooth


def _simulate_noise(refined: _RefinedMesh, reference: Reference) -> _NoiseStatistics:
    """Simulate noise on both meshes from random scores with the covariance of the Hessian, and from images of noise."""
    mesh, fine, count, random = refined.mesh, refined.fine, len(refined.mesh.nodes), np.random.default_rng(0)
    finer, coarse = (
        Equations.build(state, state.pixel_weights, np.zeros((state.assembly.size, 0)), np.zeros_like(state.mesh.nodes))
        for state in (fine, reference)
    )
    everywhere = np.ones(len(mesh.elements), dtype=bool)
    recovery = Recovery.over(reference.material, everywhere, coarse.information())
    fine_recovery = refined.recovery(np.repeat(everywhere, len(_CHILDREN)), finer)
    scores = _scores(finer, random)
    right = np.stack([fine.assembly.vector(score) for score in scores], axis=1)
    solution = coarse.solve(refined.restricted(right))
    fields = recovery.field(solution[::2], solution[1::2])
    solution = finer.solve(right)
    difference = fields - fine_recovery.field(solution[::2], solution[1::2])
    squares = np.concatenate([difference, refined.smoothing_loss(fields)], axis=2) ** 2
    means = refined.averaged(squares.reshape(count, -1)).reshape(squares.shape)
    typical = means.mean(axis=1)
    per_node = (fields**2).mean(axis=1)
    node_variance = refined.averaged(per_node)
    # a node that scatters more than its neighbours, by more than draws may, is not averaged with them
    per_node = np.maximum(node_variance, per_node / (1 + 2 * np.sqrt(2 / _CONSTANTS.draws)))
    scatter = np.sqrt(refined.averaged(means.var(axis=1) / typical**2))
    residual_variance, energy = np.zeros((count, 2)), 0.0
    for _ in range(_CONSTANTS.noises):
        white = random.standard_normal((len(fine.values), *fine.pixels.shape), dtype=np.float32)
        noise = fine.pixels.gather(np.stack([apply_prefilter(image, fine.prefilter) for image in white]))
        side = _right_side(fine, fine.pixel_weights, noise)
        solution = finer.solve(side).reshape(-1, 2)
        residual, deviation = _noise_residual(fine, noise, solution), refined.deviation(finer, fine_recovery, solution)
        residual_variance += _score_variance(residual, fine.pixel_weights, deviation)[:count] / _CONSTANTS.noises
        energy += float(side @ side) / float((right**2).sum()) * _CONSTANTS.draws / _CONSTANTS.noises
    if not mesh.is_graded:
        residual_variance[:] = residual_variance.mean(axis=0)
    field_variance = (
        energy * per_node / np.column_stack([residual_variance, residual_variance, residual_variance.mean(axis=1)])
    )
    variance = typical / np.concatenate([node_variance, node_variance[:, 2:]], axis=1)
    return _NoiseStatistics(variance=variance, scatter=scatter, field_variance=field_variance)


def _scores(equations: Equations, random: np.random.Generator) -> FloatArray:
    """Element vectors (draws, E, 3, 2) of random scores with the covariance of the Hessian."""
    blocks = equations.blocks
    covariance = np.empty((len(blocks), 6, 6))
    for a in range(2):
        for b in range(2):
            covariance[:, a::2, b::2] = blocks[..., a + b]
    covariance += _CONSTANTS.held * np.trace(covariance.mean(axis=0)) * np.eye(6)
    scores = np.linalg.cholesky(covariance) @ random.standard_normal((len(blocks), 6, _CONSTANTS.draws))
    return np.moveaxis(scores, 2, 0).reshape(_CONSTANTS.draws, -1, 3, 2)


def _noise_residual(reference: Reference, noise: FloatImage, field: FloatArray) -> Residual:
    """Residual that a displacement (N, 2) leaves of noise (k, P)."""
    motion = np.empty((2, noise.shape[1]), dtype=np.float32)
    interpolate_nodal(field, reference.mesh.elements, *reference.pixels.positions, motion)
    difference = noise - reference.gradient[0] * motion[0] - reference.gradient[1] * motion[1]
    moments = np.zeros((len(noise), 0, 6))
    return Residual(reference=reference, weights=reference.pixel_weights, difference=difference, moments=moments)
