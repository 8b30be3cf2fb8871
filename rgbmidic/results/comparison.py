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
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.constants import USUAL
from rgbmidic.errors import InputError
from rgbmidic.fields import NodalCovariance, Places, StrainGauges, strain_of_gradient
from rgbmidic.mesh import FiniteElementMesh, Placement, Tri3Mesh
from rgbmidic.results.physical import frame_times, rectification_of, shared_part
from rgbmidic.results.quantities import FAILED
from rgbmidic.results.result import Result
from rgbmidic.results.simulation import Levelling, Simulation, places_among
from rgbmidic.settings import ScaleSettings
from rgbmidic.typing import BoolArray, FloatArray, IntArray

logger = logging.getLogger(__name__)

QUANTITIES = ("u", "v", "exx", "eyy", "exy")
"""What is compared: displacement in mm and Green-Lagrange strain, along the axes of the simulation's mesh."""
WAYS = ("nodes", "levelled")
"""The simulation as it is at its nodes, and put through the measurement."""
_SAME = 1e-6
"""Distance over the size of an element under which two nodes are one: rounding of a placement (derived)."""
_RIGID = 1e-6
"""Least squared ratio to the uncertainty, of a node on average, of what is no rigid motion in a simulation (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """How one quantity of a frame agrees with the simulation.

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
    measured, std : mapping of str to ndarray, shape (M,)
        `QUANTITIES` and their standard uncertainty; NaN where a node has no data.
    simulated : mapping of str to mapping
        The same of the simulation, in each of the `WAYS`.
    agreement : mapping of (str, str) to Agreement
        By way and quantity; "displacement" is u and v together.
    fit
        Of the displacement.
    """

    frame: int
    time: float
    measured: Mapping[str, FloatArray]
    std: Mapping[str, FloatArray]
    simulated: Mapping[str, Mapping[str, FloatArray]]
    agreement: Mapping[tuple[str, str], Agreement]
    fit: Fit

    def difference(self, way: str, name: str) -> FloatArray:
        """Measured minus simulated (M,)."""
        return np.asarray(self.measured[name] - self.simulated[way][name])

    def ratio(self, way: str, name: str) -> FloatArray:
        """Difference over its standard uncertainty (M,)."""
        return np.asarray(self.difference(way, name) / self.std[name])


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
    left_out : tuple of int
        Those beyond the simulation's times.
    timed
        Whether times are in seconds; else they are numbers of frames.
    relative_std
        Standard uncertainty of the scale of the image over the scale: it is one factor in all displacements.

    Raises
    ------
    InputError
        The simulation covers none of the measurement, or none of its times; a frame that is asked for is not measured
        or beyond its times.
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
        self.result, self.simulation, self.placement, self.remove_rigid = result, simulation, placement, remove_rigid
        times = frame_times(result, scale)
        self.timed = times is not None
        self.times, self.frames, self.left_out = _matched(result, simulation, times, frames)
        self.mesh = Tri3Mesh(nodes=placement.to_mm(result.nodes), elements=result.elements)
        self.simulated_mesh = Tri3Mesh(nodes=simulation.mesh.points, elements=simulation.mesh.elements)
        self.levelling = Levelling(self.mesh, self.simulated_mesh)
        self.covariance = NodalCovariance.from_mesh(self.mesh, result.nodes)
        units = placement if placement.camera is None else rectification_of(result, scale, "mm").units
        self.relative_std = units.mm_per_pixel_std / units.mm_per_pixel if units.mm_per_pixel else 0.0
        image = Tri3Mesh(nodes=result.nodes, elements=result.elements)
        self._blocks = image.areas.sum() / max(USUAL.block, USUAL.of_element * image.size) ** 2

    @property
    def gauge(self) -> float:
        """Length of the virtual strain gauges, mm."""
        return self._gauges[0].length

    def each(self) -> Iterator[FrameComparison]:
        """Compare one frame after the other."""
        return (self.frame(index) for index in self.frames)

    def frame(self, index: int) -> FrameComparison:
        """Compare one of the `frames`; errors as `Result.frame`."""
        record, nodes, time = self.result.frame(index), self.result.nodes, float(self.times[index])
        moved = np.stack([record.u, record.v], axis=1).astype(np.float64)
        measured = self.placement.vectors_to_mm(nodes, moved).T
        slopes = self.placement.jacobian(np.where(np.isfinite(moved), nodes + moved, nodes))
        names = ("u_std", "v_std"), ("u_bias_std", "v_bias_std"), ("u_edge_std", "v_edge_std")
        stds = np.square([[getattr(record, name) for name in pair] for pair in names], dtype=np.float64)
        whole, bias, missed = np.einsum("nij,sjn->sin", slopes**2, [stds[0], *np.nan_to_num(stds[1:])])
        # a levelled simulation has passed through the recovery, and misses what that does
        noise, stated = (np.sqrt([np.maximum(one, 0), bias]) for one in (whole - missed, whole))
        simulated = self.simulation.at(time)
        levelled = np.where(np.isfinite(measured), self.levelling(simulated), np.nan)
        fit, rigid, taken = self._fit(index, measured, noise, levelled)
        if self.remove_rigid:
            measured = measured - rigid
        gradient = self.simulated_mesh.nodal_gradient(simulated)
        strain = strain_of_gradient(gradient, np.zeros((len(gradient), 4, 4))).components
        values, own = self._at_nodes(measured, stated)
        ways = {
            "nodes": (np.concatenate([simulated.T, strain.T]), own),
            "levelled": (self._at_nodes(levelled, noise * [[[1]], [[0]]])[0], self._at_nodes(measured, noise)[1]),
        }
        common = self.relative_std * values * np.array([1, 1, 0, 0, 0])[:, None]
        std = np.hypot(own[0], common)
        agreement = {}
        for way, (of_simulation, errors) in ways.items():
            for name, rows in {"displacement": [0, 1], **{name: [row] for row, name in enumerate(QUANTITIES)}}.items():
                left = taken * len(rows) / 2 if self.remove_rigid and max(rows) < 2 else 0.0
                difference = (values - of_simulation)[rows]
                agreement[way, name] = self._agreement(rows, difference, errors[:, rows], common[rows], left)
        return FrameComparison(
            frame=index,
            time=time,
            measured=dict(zip(QUANTITIES, values, strict=True)),
            std=dict(zip(QUANTITIES, std, strict=True)),
            simulated={way: dict(zip(QUANTITIES, rows, strict=True)) for way, (rows, _) in ways.items()},
            agreement=agreement,
            fit=fit,
        )

    def best_scale(self, fits: Iterable[Fit]) -> tuple[float, float]:
        """Return the multiple of the simulation that fits several frames best, and its standard uncertainty.

        The fraction of the variance that all frames have in common, the reference's, does not average out.
        """
        shared, known = shared_part(self.result), [fit for fit in fits if np.isfinite(fit.scale)]
        information = sum(fit.information for fit in known)
        if not information:
            return math.nan, math.nan
        scale = sum(fit.projection for fit in known) / information
        errors = np.stack([fit.errors for fit in known])
        variance = (1 - shared) * (errors**2).sum() + shared * (errors.sum(axis=0) ** 2).sum()
        return scale, math.hypot(math.sqrt(variance) / information, scale * self.relative_std)

    def _fit(
        self, index: int, measured: FloatArray, noise: FloatArray, levelled: FloatArray
    ) -> tuple[Fit, FloatArray, float]:
        """Fit a multiple of the simulation and a rigid motion; return also the latter's displacement (2, N).

        Of the `noise` (2, 2, N) the second half is the part that the lights' bias leaves. The third value is what the
        rigid motion is expected to take of the sum of squared ratios.
        """
        std, bias = noise
        known = np.isfinite(measured + std + levelled).all(axis=0) & (std > 0).all(axis=0)
        if known.sum() < 3:
            logger.warning("frame %d has data at %d nodes that the simulation covers: too few", index, known.sum())
            return Fit(), np.full(measured.shape, math.nan), 0.0
        x, y = self.mesh.nodes.T - self.mesh.nodes[known].mean(axis=0)[:, None]
        motions = np.array([[np.ones_like(x), 0 * x], [0 * x, np.ones_like(x)], [-y, x]])
        weighted, ratios, template, relative_bias = (
            np.where(known, part / np.where(known, std, 1), 0) for part in (motions, measured, levelled, bias)
        )
        one = np.ones(std.shape)
        flat = weighted.reshape(3, -1)
        inverse = np.linalg.inv(flat @ flat.T)
        found, simulated = (inverse @ flat @ part.ravel() for part in (ratios, template))
        motion_errors = self.covariance.errors(weighted, one, relative_bias).reshape(3, -1)
        spread = motion_errors @ motion_errors.T
        rest, template = ratios - np.tensordot(found, weighted, 1), template - np.tensordot(simulated, weighted, 1)
        information, projection = float((template**2).sum()), float((template * rest).sum())
        rigid, taken = found - simulated, float(np.trace(inverse @ spread))
        scale, scale_std, by_scale = math.nan, math.nan, 0.0
        errors = self.covariance.errors(template, one, relative_bias)
        if information > _RIGID * 2 * known.sum():
            scale, energy = projection / information, float((errors**2).sum())
            scale_std = math.hypot(math.sqrt(energy) / information, scale * self.relative_std)
            rest, by_scale = rest - scale * template, energy / information
        unit = np.array([1, 1, 180 / np.pi])
        fit = Fit(
            scale=scale,
            scale_std=scale_std,
            rigid=rigid * unit,
            rigid_std=np.sqrt(np.diag(inverse @ spread @ inverse)) * unit,
            chi_square=float((rest**2).sum() / (2 * known.sum() - taken - by_scale)),
            projection=projection,
            information=information,
            errors=errors,
        )
        return fit, np.tensordot(rigid, motions, 1), taken

    @cached_property
    def _own(self) -> IntArray:
        """Node (M,) of the measurement that is each of the simulation's, by number and place; -1 where there is none.

        All are -1 where the measurement has nodes of its own.
        """
        points, numbers = self.simulation.mesh.points, self.result.node_number
        own = np.arange(len(points)) if len(points) == len(self.mesh.nodes) else np.full(len(points), -1)
        if numbers is not None:
            own = places_among(numbers, self.simulation.mesh.node_numbers)
        away = np.abs(self.mesh.nodes[own] - points).max(axis=1)
        own = np.where(away < _SAME * self.mesh.size, own, -1)
        return own if len(np.unique(own[own >= 0])) == len(self.mesh.nodes) else np.full(len(points), -1)

    @cached_property
    def _places(self) -> Places:
        """The simulation's nodes in the measurement's mesh."""
        places = Places.of(self.mesh, self.simulation.mesh.points)
        if not places.inside.any():
            raise InputError(f"no node of {self.simulation.name} lies in the region that was measured")
        return places

    def _read(self, has_data: BoolArray | None = None) -> tuple[sp.csr_matrix, BoolArray]:
        """Matrix (M, N) that reads nodes (N,) with data at the simulation's, and which of these it reaches (M,)."""
        valid = np.ones(len(self.mesh.nodes), dtype=bool) if has_data is None else has_data
        if (same := self._own >= 0).any():
            entries = np.ones(same.sum()), (np.flatnonzero(same), self._own[same])
            return sp.csr_matrix(entries, shape=(len(same), len(valid))), same & valid[self._own]
        return self._places.weights(valid), self._places.measured(valid)

    @cached_property
    def _gauges(self) -> tuple[StrainGauges, sp.csr_matrix]:
        """The shortest strain gauges, and the matrix (M, G) that gives each node of the simulation its own."""
        read, inside = self._read()
        if (self._own >= 0).any():
            return StrainGauges.at_nodes(self.covariance), read
        gauges = StrainGauges.at_points(self.covariance, self.simulation.mesh.points[inside])
        return gauges, sp.eye(len(inside), format="csr")[:, inside]

    @cached_property
    def _correlations(self) -> list[tuple[list[sp.csr_matrix], list[sp.csr_matrix]]]:
        """Correlations C and K (M, M) between nodes of each of the `QUANTITIES`: of fit and lights' bias.

        With them their products C C, 2 C K and K K, entry by entry.
        """
        read, (gauges, given) = self._read()[0], self._gauges
        x, y = (given @ slope for slope in gauges.slopes)
        found = []
        for matrices in ([read], [x], [y], [x, y]):
            relative = self.covariance.relative(matrices)
            fit, bias = (sp.csr_matrix(root @ root.T) for root in (relative.fit, relative.bias))
            products = [sp.csr_matrix(one) for one in (fit.multiply(fit), 2 * fit.multiply(bias), bias.multiply(bias))]
            found.append(([fit, bias], products))
        return [found[0], *found]

    def _at_nodes(self, displacement: FloatArray, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement (2, N) and its strain at the simulation's nodes, (5, M), and their noise, (2, 5, M)."""
        has_data = np.asarray(np.isfinite(displacement + noise[0]).all(axis=0))
        read, measured = self._read(has_data)
        values, *own = np.full((3, len(QUANTITIES), len(measured)), np.nan)
        (gauges, given), bias = self._gauges, noise[1]
        node, gauge = given.nonzero()
        cases = [(own[0], noise), (own[1], np.stack([bias, bias]))]
        own[1][:] = 0.0
        for std, stds in cases if (bias > 0).any() else cases[:1]:
            for row, (part, *errors) in enumerate(zip(displacement, *stds, strict=True)):
                factor = read @ self.covariance.factor(*np.where(has_data, errors, 0))
                values[row] = np.where(measured, read @ np.where(has_data, part, 0), np.nan)
                variance = np.asarray(factor.multiply(factor).sum(axis=1)).ravel()
                std[row] = np.where(measured, np.sqrt(variance), np.nan)
            strain = gauges.strain(*displacement, *stds[0], *stds[1])
            values[2:, node], std[2:, node] = strain.components[gauge].T, strain.components_std[gauge].T
        return values, np.stack(own)

    def _agreement(
        self, rows: list[int], difference: FloatArray, own: FloatArray, common: FloatArray, taken: float
    ) -> Agreement:
        """Compare some rows of the `QUANTITIES`, (r, M) each, of which a fit took a part of the squared ratios.

        `own` (2, r, M) is their noise, and the part of it that the lights' bias leaves.
        """
        from scipy.stats import f as fisher

        std = np.hypot(own[0], common)
        known = np.isfinite(difference) & (std > 0)
        count, scale = int(known.sum()), np.where(known, std, 1)
        if not count:
            return Agreement(values=0)
        ratio, noise, bias, shared = (np.where(known, part / scale, 0) for part in (difference, *own, common))
        square = float((shared**2).sum()) ** 2
        fit = np.sqrt(np.maximum(noise**2 - bias**2, 0))
        for row, n, m, s in zip(rows, fit, bias, shared, strict=True):
            correlations, products = self._correlations[row]
            pairs = [(n * n, products[0]), (n * m, products[1]), (m * m, products[2])]
            pairs += [(2**0.5 * s * std, one) for std, one in zip((n, m), correlations, strict=True)]
            square += sum(float(std @ one @ std) for std, one in pairs)
        chi_square, freedom = float((ratio**2).sum() / (count - taken)), count**2 / square
        return Agreement(
            values=count,
            mean=float(difference[known].mean()),
            rms=float(np.sqrt(np.mean(difference[known] ** 2))),
            std=float(np.median(std[known])),
            beyond_2=float(np.mean(np.abs(ratio[known]) > 2)),
            chi_square=chi_square,
            degrees_of_freedom=freedom,
            probability=float(fisher.sf(chi_square, freedom, len(rows) * self._blocks)),
        )


def measured_mesh(result: Result) -> FiniteElementMesh | None:
    """Return the part of ``mesh.file`` that a result was measured on; None where it has none."""
    if result.node_number is None or result.element_number is None or result.node_mm is None:
        return None
    kept = result.provenance["finite_elements"]
    return FiniteElementMesh(
        name=kept["name"],
        points=result.node_mm,
        node_numbers=result.node_number,
        elements=result.elements,
        element_numbers=result.element_number,
        numbering=kept["numbering"],
    )


def _matched(
    result: Result, simulation: Simulation, times: FloatArray | None, asked: Sequence[int] | None
) -> tuple[FloatArray, tuple[int, ...], tuple[int, ...]]:
    """Find the time (T,) of each frame, the frames to compare, and those beyond the simulation's times."""
    for index in asked or ():
        if result.frame(index).status == FAILED:
            raise InputError(f"frame {index} of {result.path} is not measured; compare another one (--frames)")
        if index not in result.deformed:
            raise InputError(f"frame {index} of {result.path} is of the reference, against which nothing has moved")
    known = [index for index in result.deformed if result.finished[index] and result.status[index] != FAILED]
    frames = list(known if asked is None else asked)
    if not frames:
        raise InputError(f"no deformed frame of {result.path} is measured")
    clock = result.number.astype(np.float64) if times is None else times
    if simulation.times is None:
        return clock, tuple(frames if asked is not None else frames[-1:]), ()
    if times is None:
        logger.warning("the frames of %s have no times: their numbers count as the simulation's times", result.path)
    first, last = simulation.times[[0, -1]]
    slack = _SAME * max(abs(first), abs(last))
    within = [index for index in frames if first - slack <= clock[index] <= last + slack]
    beyond = tuple(index for index in frames if index not in within)
    if not within or (asked is not None and beyond):
        unit = "s" if times is not None else "frames (their times are not known)"
        which = f"the frames of {result.path} are at {min(clock[frames]):.9g} to {max(clock[frames]):.9g}"
        if within:
            which = f"frame {beyond[0]} is at {clock[beyond[0]]:.9g}"
        raise InputError(
            f"{which} {unit}, the simulation {simulation.name} spans {first:.9g} to {last:.9g}: state the "
            "--offset between both clocks, or other --frames"
        )
    return np.clip(clock, first, last), tuple(within), beyond
