"""Comparison of a measurement with a finite-element simulation, at the nodes of the simulation's mesh.

Differences are stated in two ways. At the *nodes* the simulation stands as it is, and what the measurement does not
resolve counts as difference. *Levelled*, the simulation is put through the measurement first: the best linear fit of
its displacement on the measurement's mesh, the recovery of the nodal values, and the same strain gauges. What is left
is neither noise nor resolution (levelling: Lava, Jones, Wittevrongel and Pierron, Strain 56, 2020, e12340).

Chi-square per degree of freedom is the mean square of the ratios of difference to standard uncertainty. Its expectation
under the stated covariance is the mean of the diagonal of the correlation matrix R, which is 1 whatever the correlation
of neighbouring nodes; that reduces the degrees of freedom to ``n^2 / tr(R^2)`` (Satterthwaite, Biometrics Bulletin 2,
1946). The stated variance is itself estimated, from blocks of pixels, so that the quotient is distributed like
Fisher's F. The form with the inverse of R is not taken: docs/how-to/compare.md.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rgbmidic.correlation.constants import USUAL
from rgbmidic.errors import InputError
from rgbmidic.fields import Field, NodalCovariance, strain_of_gradient
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.renamed import refuse_old_names, state_new_names
from rgbmidic.results.quantities import FAILED
from rgbmidic.results.result import Result
from rgbmidic.results.result_in_units import common_variance_fraction, frame_times, rectification_of
from rgbmidic.settings import ScaleSettings
from rgbmidic.tools.finite_elements.placement import Placement
from rgbmidic.tools.finite_elements.simulation import Levelling, Simulation, require_plane
from rgbmidic.tools.finite_elements.simulation_nodes import COMPARED_QUANTITIES, NODE_TOLERANCE, SimulationNodes
from rgbmidic.typing import FloatArray

logger = logging.getLogger(__name__)

VARIANTS = ("nodes", "levelled")
"""The simulation as it is at its nodes, and put through the measurement."""
_MIN_DEFORMATION = 1e-6
"""Least squared ratio to the uncertainty, of a node on average, of what is no rigid motion in a simulation (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Agreement of one quantity of a frame with the simulation.

    Attributes
    ----------
    values
        Their number n: nodes with data, of the displacement those of u and v.
    mean, rms
        Of the differences, measured minus simulated.
    std
        Median standard uncertainty.
    beyond_2
        Fraction of the differences above two standard uncertainties; .046 is ordinary.
    chi_square
        Per degree of freedom: 1 is expected where the simulation is right.
    degrees_of_freedom
        Of chi-square.
    probability
        Of a larger chi-square where the simulation is right.
    """

    values: int
    mean: float = math.nan
    rms: float = math.nan
    std: float = math.nan
    beyond_2: float = math.nan
    chi_square: float = math.nan
    degrees_of_freedom: float = math.nan
    probability: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """Multiple of the levelled simulation that fits a measured displacement best, with any shift and rotation.

    Where the loads are stated, a modulus that is too large by 3 % reads as a scale of 1.03.

    Attributes
    ----------
    scale, scale_std
        NaN where the simulation is no more than a rigid motion.
    rigid, rigid_std : ndarray, shape (3,)
        Shift (mm) of the middle of the measured nodes, and rotation (degrees, from x towards y), measured minus
        simulated.
    chi_square
        Of what the best multiple, shift and rotation leave, per degree of freedom.
    projection, information
        Sums of the simulation without a rigid motion, over the standard uncertainty, times the measured displacement
        over the same, and times itself: their quotient is the scale.
    errors : ndarray, shape (2, R)
        Errors of the projection of u and v, see `NodalCovariance.errors`.
    """

    scale: float = math.nan
    scale_std: float = math.nan
    rigid: FloatArray = field(default_factory=lambda: np.full(3, math.nan))
    rigid_std: FloatArray = field(default_factory=lambda: np.full(3, math.nan))
    chi_square: float = math.nan
    projection: float = 0.0
    information: float = 0.0
    errors: FloatArray = field(default_factory=lambda: np.zeros((2, 1)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameComparison:
    """One frame and the simulation at its time, at the M nodes of the simulation.

    Attributes
    ----------
    frame
        Index in the result.
    time
        Of the frame, on the simulation's clock.
    measured : mapping of str to Field, shape (M,)
        `COMPARED_QUANTITIES` with their standard uncertainty; NaN where a node has no data.
    simulated : mapping of str to mapping
        The same of the simulation, in each of the `VARIANTS`.
    agreement : mapping of (str, str) to Agreement
        By way and quantity; "displacement" is u and v together.
    fit
        Of the displacement.
    """

    frame: int
    time: float
    measured: Mapping[str, Field]
    simulated: Mapping[str, Mapping[str, FloatArray]]
    agreement: Mapping[tuple[str, str], Agreement]
    fit: Fit

    def difference(self, variant: str, name: str) -> FloatArray:
        """Return measured minus simulated (M,)."""
        return np.asarray(self.measured[name].values - self.simulated[variant][name])

    def ratio(self, variant: str, name: str) -> FloatArray:
        """Return the difference over its standard uncertainty (M,)."""
        return np.asarray(self.difference(variant, name) / self.measured[name].uncertainty)


@state_new_names
class Comparison:
    """A result and a simulation of the same test, compared frame by frame.

    Parameters
    ----------
    result
        The measurement.
    simulation
        The simulation.
    placement
        Where the simulation's mesh lies on the image.
    scale
        It replaces the ``[scale]`` that was kept with the result; None: that one.
    frames
        Indices of the frames to compare; None: all deformed ones that did not fail, or the last of them where the
        simulation is one state.
    remove_rigid
        Whether shift and rotation of the difference are taken off the measured displacement.

    Attributes
    ----------
    frames : tuple of int
        Those that are compared.
    frames_outside : tuple of int
        Those beyond the simulation's times.
    has_times
        Whether times are in seconds; else they are numbers of frames.
    relative_std
        Standard uncertainty of the scale of the image over the scale: it is one factor in all displacements.

    Raises
    ------
    InputError
        The simulation covers none of the measurement, or none of its times; a frame that is asked for is not measured
        or beyond its times.

    Examples
    --------
    >>> from rgbmidic import FiniteElementMesh
    >>> mesh = FiniteElementMesh(
    ...     name="plate",
    ...     points=np.array([[0, 0], [10, 0], [10, 8], [0, 8]]),
    ...     node_numbers=np.array([1, 2, 3, 4]),
    ...     elements=np.array([[0, 1, 2], [0, 2, 3]]),
    ...     element_numbers=np.array([11, 12]),
    ... )
    >>> simulation = Simulation(mesh=mesh, displacement=np.zeros((1, 4, 2)))
    >>> placement = Placement.fit([(0, 0, 80, 240), (10, 0, 240, 240)])
    >>> comparison = Comparison(Result.open("my_result"), simulation, placement, frames=[1])
    >>> comparison.frame(1).agreement["nodes", "displacement"].values > 0
    True
    """

    def __init__(
        self,
        result: Result,
        simulation: Simulation,
        placement: Placement,
        *,
        scale: ScaleSettings | None = None,
        frames: Sequence[int] | None = None,
        remove_rigid: bool = False,
    ) -> None:
        require_plane(result)
        self.result, self.simulation, self.placement, self.remove_rigid = result, simulation, placement, remove_rigid
        times = frame_times(result, scale)
        self.has_times = times is not None
        self.times, self.frames, self.frames_outside = _match_times(result, simulation, times, frames)
        self.mesh = Tri3Mesh(nodes=placement.to_mm(result.nodes), elements=result.elements)
        self.simulated_mesh = Tri3Mesh(nodes=simulation.mesh.points, elements=simulation.mesh.elements)
        self.levelling = Levelling(self.mesh, self.simulated_mesh)
        self.covariance = NodalCovariance.from_mesh(self.mesh, result.nodes)
        self.nodes = SimulationNodes(
            simulation=simulation, mesh=self.mesh, covariance=self.covariance, node_numbers=result.node_number
        )
        units = placement if placement.camera is None else rectification_of(result, scale, "mm").units
        self.relative_std = units.mm_per_pixel_std / units.mm_per_pixel if units.mm_per_pixel else 0.0
        image = Tri3Mesh(nodes=result.nodes, elements=result.elements)
        self._blocks = image.areas.sum() / USUAL.merged_block_side(image.size) ** 2

    @property
    def gauge(self) -> float:
        """Length of the virtual strain gauges, mm."""
        return self.nodes.gauges[0].length

    def iterate(self) -> Iterator[FrameComparison]:
        """Compare one frame after the other."""
        return (self.frame(index) for index in self.frames)

    def frame(self, index: int) -> FrameComparison:
        """Compare one of the `frames`; errors as `Result.frame`."""
        record, nodes, time = self.result.frame(index), self.result.nodes, float(self.times[index])
        displacement = np.stack([record.u, record.v], axis=1).astype(np.float64)
        measured = self.placement.vectors_to_mm(nodes, displacement).T
        slopes = self.placement.jacobian(np.where(np.isfinite(displacement), nodes + displacement, nodes))
        names = ("u_std", "v_std"), ("u_bias_std", "v_bias_std"), ("u_edge_std", "v_edge_std")
        stds = np.square([[getattr(record, name) for name in pair] for pair in names], dtype=np.float64)
        variance, bias, edge = np.einsum("nij,sjn->sin", slopes**2, [stds[0], *np.nan_to_num(stds[1:])])
        # a levelled simulation has passed through the recovery, and misses what that does
        noise, stated_std = (np.sqrt([np.maximum(total, 0), bias]) for total in (variance - edge, variance))
        simulated = self.simulation.interpolate(time)
        levelled = np.where(np.isfinite(measured), self.levelling(simulated), np.nan)
        fit, rigid, rigid_reduction = self._fit(index, measured, noise, levelled)
        if self.remove_rigid:
            measured = measured - rigid
        gradient = self.simulated_mesh.nodal_gradient(simulated)
        strain = strain_of_gradient(gradient, np.zeros((len(gradient), 4, 4))).components
        values, nodal_std = self.nodes.read(measured, stated_std)
        variants = {
            "nodes": (np.concatenate([simulated.T, strain.T]), nodal_std),
            "levelled": (self.nodes.read(levelled, noise * [[[1]], [[0]]])[0], self.nodes.read(measured, noise)[1]),
        }
        scale_std = self.relative_std * values * np.array([1, 1, 0, 0, 0])[:, None]
        std = np.hypot(nodal_std[0], scale_std)
        agreement = {}
        for variant, (simulated_values, noise_std) in variants.items():
            for name, rows in {
                "displacement": [0, 1],
                **{name: [row] for row, name in enumerate(COMPARED_QUANTITIES)},
            }.items():
                fit_reduction = rigid_reduction * len(rows) / 2 if self.remove_rigid and max(rows) < 2 else 0.0
                difference = (values - simulated_values)[rows]
                agreement[variant, name] = self._agreement(
                    rows, difference, noise_std[:, rows], scale_std[rows], fit_reduction
                )
        return FrameComparison(
            frame=index,
            time=time,
            measured={
                name: Field(name=name, dims=("node",), values=row, std=error)
                for name, row, error in zip(COMPARED_QUANTITIES, values, std, strict=True)
            },
            simulated={
                variant: dict(zip(COMPARED_QUANTITIES, rows, strict=True)) for variant, (rows, _) in variants.items()
            },
            agreement=agreement,
            fit=fit,
        )

    def best_scale(self, fits: Iterable[Fit]) -> tuple[float, float]:
        """Return the multiple of the simulation that fits several frames best, and its standard uncertainty.

        The fraction of the variance that all frames have in common, the reference's, does not average out.
        """
        common_fraction, usable_fits = (
            common_variance_fraction(self.result),
            [fit for fit in fits if np.isfinite(fit.scale)],
        )
        information = sum(fit.information for fit in usable_fits)
        if not information:
            return math.nan, math.nan
        scale = sum(fit.projection for fit in usable_fits) / information
        errors = np.stack([fit.errors for fit in usable_fits])
        variance = (1 - common_fraction) * (errors**2).sum() + common_fraction * (errors.sum(axis=0) ** 2).sum()
        return scale, math.hypot(math.sqrt(variance) / information, scale * self.relative_std)

    def _fit(
        self, index: int, measured: FloatArray, noise: FloatArray, levelled: FloatArray
    ) -> tuple[Fit, FloatArray, float]:
        """Fit a multiple of the simulation and a rigid motion; return also the latter's displacement (2, N).

        Of the `noise` (2, 2, N) the second half is the part that the lights' bias leaves. The third value is what the
        rigid motion is expected to take of the sum of squared ratios.
        """
        std, bias = noise
        valid = np.isfinite(measured + std + levelled).all(axis=0) & (std > 0).all(axis=0)
        if valid.sum() < 3:
            logger.warning("frame %d has data at %d nodes that the simulation covers: too few", index, valid.sum())
            return Fit(), np.full(measured.shape, math.nan), 0.0
        x, y = self.mesh.nodes.T - self.mesh.nodes[valid].mean(axis=0)[:, None]
        motions = np.array([[np.ones_like(x), 0 * x], [0 * x, np.ones_like(x)], [-y, x]])
        weighted, ratios, template, relative_bias = (
            np.where(valid, values / np.where(valid, std, 1), 0) for values in (motions, measured, levelled, bias)
        )
        unit_std = np.ones(std.shape)
        flat = weighted.reshape(3, -1)
        inverse = np.linalg.inv(flat @ flat.T)
        measured_motion, simulated_motion = (inverse @ flat @ values.ravel() for values in (ratios, template))
        motion_errors = self.covariance.errors(weighted, unit_std, relative_bias).reshape(3, -1)
        motion_covariance = motion_errors @ motion_errors.T
        residual, template = (
            ratios - np.tensordot(measured_motion, weighted, 1),
            template - np.tensordot(simulated_motion, weighted, 1),
        )
        information, projection = float((template**2).sum()), float((template * residual).sum())
        rigid, rigid_reduction = measured_motion - simulated_motion, float(np.trace(inverse @ motion_covariance))
        scale, scale_std, scale_reduction = math.nan, math.nan, 0.0
        errors = self.covariance.errors(template, unit_std, relative_bias)
        if information > _MIN_DEFORMATION * 2 * valid.sum():
            scale, energy = projection / information, float((errors**2).sum())
            scale_std = math.hypot(math.sqrt(energy) / information, scale * self.relative_std)
            residual, scale_reduction = residual - scale * template, energy / information
        unit = np.array([1, 1, 180 / np.pi])
        fit = Fit(
            scale=scale,
            scale_std=scale_std,
            rigid=rigid * unit,
            rigid_std=np.sqrt(np.diag(inverse @ motion_covariance @ inverse)) * unit,
            chi_square=float((residual**2).sum() / (2 * valid.sum() - rigid_reduction - scale_reduction)),
            projection=projection,
            information=information,
            errors=errors,
        )
        return fit, np.tensordot(rigid, motions, 1), rigid_reduction

    def _agreement(
        self, rows: list[int], difference: FloatArray, noise_stds: FloatArray, common: FloatArray, fit_reduction: float
    ) -> Agreement:
        """Compare some rows of the `COMPARED_QUANTITIES`, (r, M) each, of whose squared ratios a fit took some.

        `noise_stds` (2, r, M) is their noise, and the part of it that the lights' bias leaves.
        """
        from scipy.stats import f as fisher

        std = np.hypot(noise_stds[0], common)
        valid = np.isfinite(difference) & (std > 0)
        count, scale = int(valid.sum()), np.where(valid, std, 1)
        if not count:
            return Agreement(values=0)
        ratio, noise, bias, common_noise = (
            np.where(valid, values / scale, 0) for values in (difference, *noise_stds, common)
        )
        square = float((common_noise**2).sum()) ** 2
        fit = np.sqrt(np.maximum(noise**2 - bias**2, 0))
        for row, fit_row, bias_row, common_row in zip(rows, fit, bias, common_noise, strict=True):
            correlations, products = self.nodes.correlations[row]
            weighted_products = [
                (fit_row * fit_row, products[0]),
                (fit_row * bias_row, products[1]),
                (bias_row * bias_row, products[2]),
            ]
            weighted_products += [
                (2**0.5 * common_row * std, matrix)
                for std, matrix in zip((fit_row, bias_row), correlations, strict=True)
            ]
            square += sum(float(std @ matrix @ std) for std, matrix in weighted_products)
        chi_square, freedom = float((ratio**2).sum() / (count - fit_reduction)), count**2 / square
        return Agreement(
            values=count,
            mean=float(difference[valid].mean()),
            rms=float(np.sqrt(np.mean(difference[valid] ** 2))),
            std=float(np.median(std[valid])),
            beyond_2=float(np.mean(np.abs(ratio[valid]) > 2)),
            chi_square=chi_square,
            degrees_of_freedom=freedom,
            probability=float(fisher.sf(chi_square, freedom, len(rows) * self._blocks)),
        )


def _match_times(
    result: Result, simulation: Simulation, times: FloatArray | None, requested: Sequence[int] | None
) -> tuple[FloatArray, tuple[int, ...], tuple[int, ...]]:
    """Find the time (T,) of each frame, the frames to compare, and those beyond the simulation's times."""
    for index in requested or ():
        if result.frame(index).status == FAILED:
            raise InputError(f"frame {index} of {result.path} is not measured; compare another one (`frames`)")
        if index not in result.deformed:
            raise InputError(f"frame {index} of {result.path} is of the reference, against which nothing has moved")
    measured_frames = [index for index in result.deformed if result.finished[index] and result.status[index] != FAILED]
    frames = list(measured_frames if requested is None else requested)
    if not frames:
        raise InputError(f"no deformed frame of {result.path} is measured")
    clock = result.number.astype(np.float64) if times is None else times
    if simulation.times is None:
        return clock, tuple(frames if requested is not None else frames[-1:]), ()
    if times is None:
        logger.warning("the frames of %s have no times: their numbers count as the simulation's times", result.path)
    start, end = simulation.times[[0, -1]]
    slack = NODE_TOLERANCE * max(abs(start), abs(end))
    frames_inside = [index for index in frames if start - slack <= clock[index] <= end + slack]
    frames_outside = tuple(index for index in frames if index not in frames_inside)
    if not frames_inside or (requested is not None and frames_outside):
        unit = "s" if times is not None else "frames (their times are not known)"
        subject = f"the frames of {result.path} are at {min(clock[frames]):.9g} to {max(clock[frames]):.9g}"
        if frames_inside:
            subject = f"frame {frames_outside[0]} is at {clock[frames_outside[0]]:.9g}"
        raise InputError(
            f"{subject} {unit}, the simulation {simulation.name} spans {start:.9g} to {end:.9g}: state the "
            "`offset` between both clocks, or other `frames`"
        )
    return np.clip(clock, start, end), tuple(frames_inside), frames_outside


__getattr__ = refuse_old_names(__name__)
