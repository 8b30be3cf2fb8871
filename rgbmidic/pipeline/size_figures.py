"""Figures of element sizes on a test's own frames: noise, discretisation error, gauges, and the recommendation."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rgbmidic.correlation import Deformed, Solution, Start, Status, discretisation_error, track
from rgbmidic.errors import FrameError
from rgbmidic.fields import NodalCovariance, Places, StrainGauges
from rgbmidic.fields.strain import SHORTEST
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.suitability import SPECKLES
from rgbmidic.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolutionConstants:
    """Constants of the choice of element sizes.

    Attributes
    ----------
    least
        Smallest elements, px (`Tri3Mesh.from_region`).
    fewest
        Elements across the region: fewer have no node with neighbours on all sides, and no virtual strain gauge.
    candidates
        Frames among which the key frame is looked for. Chosen: fifths of a test.
    static
        Static frames that the noise floor is taken from at most: 100 nodes in 5 frames give it to 4 %.
    largest
        Quantile over the nodes and components that stands for the largest strain: the very largest is one node's noise.
    equal
        How much shorter than three elements a gauge may be, as `StrainGauges` has it.
    finer
        Ratio of element sizes from which their fields are compared: mesh errors of nearer ones are too much alike.
        Chosen: those of neighbours among `SIZES` are compared.
    passes
        Bisections in a row at most: legs of 25 px become 9 px.
    worth
        Discretisation error of strain over its noise from which bisecting an element makes strain better: the one falls
        as the area of the elements, the other rises as its inverse, e^2/4 + 4 n^2 < e^2 + n^2 (derived). Displacement
        does not decide: with it affine fields and waves had more nodes and no smaller errors (measured).
    exact
        Places of refined nodes are multiples of it, px: where they begin to count can then be shifted without rounding.
    measured
        Area that a size must measure, of the size that measures most: what it loses is where its error would be the
        largest, such as a steep bump beside one node. Chosen: a node of elements of 40 px on 250 px is 8 %.
    alike
        Total errors of the displacement within this factor count as the same, and those of strain decide: an estimate
        of the discretisation error is no better than that.
    sure, independent
        Standard deviations by which the mean square of a difference must exceed that of noise, and independent values
        in a nodal one, whose neighbours are correlated. Chosen.
    """

    least: float = 4.0
    fewest: float = 3.0
    candidates: int = 5
    static: int = 5
    largest: float = 0.99
    equal: float = 0.1
    finer: float = 1.4
    passes: int = 3
    worth: float = 2.0
    exact: float = 2.0**-16
    sure: float = 2.0
    independent: float = 0.5
    measured: float = 0.97
    alike: float = 1.05


CONSTANTS = ResolutionConstants()


@dataclass(frozen=True, slots=True, kw_only=True)
class GaugeFigures:
    """Virtual strain gauges of one length on elements of one size.

    Attributes
    ----------
    length
        px.
    noise
        Noise of exx, eyy and exy, rms over the nodes: the strain resolution; from static frames, else as stated.
    largest
        Largest value of a component of the strain in the key frame, the 99 % quantile over the nodes.
    """

    length: float
    noise: float
    largest: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorFigures:
    """Errors of displacement or strain, rms over the measured nodes and the components; what is not known is NaN.

    Attributes
    ----------
    bias, scatter
        Noise floor: rms over the static frames of the mean over the nodes, and the scatter about it.
    stated
        Standard uncertainty from noise in the key frame.
    discretisation
        What the mesh and the recovery leave out in the key frame.
    """

    bias: float = float("nan")
    scatter: float = float("nan")
    stated: float = float("nan")
    discretisation: float = float("nan")

    @property
    def noise(self) -> float:
        """Noise as stated in the key frame, or the noise floor where that is more."""
        return float(np.fmax(self.stated, self.scatter))

    @property
    def total(self) -> float:
        """Root of the squares of noise and discretisation error."""
        return float(np.hypot(self.noise, self.discretisation))


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeFigures(ErrorFigures):
    """Elements of one size on a test's own frames: errors of u and v, px, and what goes with them.

    Attributes
    ----------
    element_size
        px.
    speckles
        On the side of an element.
    nodes
        Number of nodes.
    measured
        Fraction of the area whose nodes the key frame measures.
    strain
        Errors of exx, eyy, exy at the nodes.
    seconds
        CPU seconds of the solve of the key frame.
    gauges
        Virtual strain gauges.
    reason
        Why nothing is known; else empty.
    """

    element_size: float
    speckles: float = float("nan")
    nodes: int = 0
    measured: float = 0.0
    strain: ErrorFigures = ErrorFigures()
    seconds: float = float("nan")
    gauges: tuple[GaugeFigures, ...] = ()
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """Element size that the frames of a test recommend, and why, in a sentence."""

    element_size: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolutionStudy:
    """Figures of several element sizes on a test's own frames.

    Attributes
    ----------
    frame, name
        The key frame: index and name.
    static
        Number of static frames that the noise floor is from; 0: the test has none, and noise is as stated.
    speckle
        Size of the speckle, px; NaN where it is not known.
    preparation
        CPU seconds of reading and separating the key frame, the same for all sizes; NaN where it was not measured.
    sizes
        Figures of each size.
    """

    frame: int
    name: str
    static: int
    speckle: float
    preparation: float
    sizes: tuple[SizeFigures, ...]

    @property
    def choice(self) -> Choice | None:
        """The size of the least total error among those that hold and measure enough; None where none is known."""
        most = max((one.measured for one in self.sizes), default=0.0)
        few = [one for one in self.sizes if one.speckles < SPECKLES]
        usable = [one for one in self.sizes if one not in few and one.measured >= CONSTANTS.measured * most]
        usable = sorted((one for one in usable if np.isfinite(one.total)), key=lambda one: one.element_size)
        if not usable:
            return None
        least = min(one.total for one in usable)
        best = min(
            (one for one in usable if one.total <= CONSTANTS.alike * least),
            key=lambda one: np.nan_to_num(one.strain.total, nan=np.inf),
        )
        smaller, larger = usable[: usable.index(best)][-1:], usable[usable.index(best) + 1 :][:1]
        lead = "the least" if best.total == least else "within 5 % of the least"
        parts = [
            f"elements of {best.element_size:g} px have {lead} total error in {self.name}: {best.total:.2g} px, from "
            f"noise of {best.noise:.2g} px and a discretisation error of {best.discretisation:.2g} px"
        ]
        for one, what in (*((one, "noise") for one in smaller), *((one, "discretisation error") for one in larger)):
            value = one.noise if what == "noise" else one.discretisation
            parts.append(f"with {one.element_size:g} px it is {one.total:.2g} px, for a {what} of {value:.2g} px")
        if few:
            names = ", ".join(f"{one.element_size:g}" for one in few)
            parts.append(f"{names} px are less than {SPECKLES:g} speckles of {self.speckle:.1f} px")
        return Choice(element_size=best.element_size, reason="; ".join(parts))


def solved(plan: Plan, deformed: Deformed, start: FloatArray | None) -> Solution:
    """Solution of a frame from an initial guess (N, 2), or from a search."""
    return track(plan.reference, deformed, Start(displacement=start), plan.solver, plan.method)


def rms(values: FloatArray) -> float:
    """Root mean square of the finite values; NaN where there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def measure_size(
    plan: Plan,
    deformed: Deformed,
    start: FloatArray,
    rest: Sequence[Deformed],
    gauges: Sequence[float],
    finer: list[tuple[Tri3Mesh, Solution]],
) -> SizeFigures:
    """Measure the figures of the size of a plan's elements.

    Parameters
    ----------
    plan
        The test with elements of this size.
    deformed, start
        The key frame and its initial guess (N, 2).
    rest
        Static frames.
    gauges
        Lengths of virtual strain gauges, px; those too short for the elements are left out.
    finer
        Meshes of finer elements and the solutions on them, to which those of these are added.
    """
    mesh, speckle = plan.reference.mesh, plan.speckle or float("nan")
    before = time.process_time()
    solution = solved(plan, deformed, start)
    seconds = time.process_time() - before
    if solution.status is Status.FAILED:
        raise FrameError(solution.reason)
    still = [solved(plan, static, np.zeros_like(mesh.nodes)) for static in rest]
    known = discretisation_error(plan.reference, deformed, solution, plan.solver, plan.method)
    other = [one for one in finer if CONSTANTS.finer * one[0].size <= mesh.size]
    # it differs from all of them, each of which has an error of its own (in proportion to the size's third power);
    # reflections, which every size averages in its own way, hardly differ from the next
    part = [1 - (fine.size / mesh.size) ** 3 for fine, _ in other]
    apart = [min(np.divide(found, part), default=0.0) for found in _apart(mesh, known, other)]
    finer.append((mesh, known))
    whole = solution.measured[mesh.elements].all(axis=1)

    def errors(name: str, beyond: float) -> dict[str, Any]:
        bias, scatter = _floor([getattr(one, name) for one in still], len(plan.settings.frames.reference))
        stated, error = (rms(getattr(known, f"{name}_{kind}")) for kind in ("std", "error"))
        return {"bias": bias, "scatter": scatter, "stated": stated, "discretisation": float(np.fmax(error, beyond))}

    return SizeFigures(
        element_size=plan.element_size,
        speckles=plan.element_size / speckle,
        nodes=len(mesh.nodes),
        measured=float(mesh.areas[whole].sum() / mesh.areas.sum()),
        strain=ErrorFigures(**errors("strain", apart[1])),
        seconds=seconds,
        gauges=tuple(_gauge_figures(plan, solution, still, gauges)),
        **errors("displacement", apart[0]),
    )


def _field_at(mesh: Tri3Mesh, solution: Solution, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement and strain (P, 5) at points (P, 2), and their noise without the misfit of the elements.

    They follow the quadratics through the nodes around each node (`rgbmidic.fields.at_pixels`).
    """
    values = np.hstack([solution.displacement, solution.strain])
    used = np.asarray(np.isfinite(values)[mesh.elements].all(axis=(1, 2)))
    _, x, y, xx, xy, yy = (operator @ np.nan_to_num(values) for operator in quadratic_fit(mesh, used))
    places = Places.of(mesh, points)
    node, weight = mesh.elements[places.element], places.barycentric
    dx, dy = np.moveaxis(points[:, None] - mesh.nodes[node], -1, 0)[..., None]
    bent = xx[node] * dx * dx / 2 + xy[node] * dx * dy + yy[node] * dy * dy / 2
    out = np.einsum("pc,pci->pi", weight, values[node] + x[node] * dx + y[node] * dy + bent)
    nodal = np.hstack([solution.displacement_std, solution.strain_std])[node]
    noise = np.sqrt(np.einsum("pc,pci->pi", weight, nodal**2))
    return np.where(places.inside[:, None] & used[places.element][:, None], out, np.nan), noise


def _apart(
    mesh: Tri3Mesh, solution: Solution, finer: Sequence[tuple[Tri3Mesh, Solution]]
) -> tuple[list[float], list[float]]:
    """How far a solution is from each of those on `finer` elements beyond the noise of both, at the nodes of those.

    Halved elements show little of what is far smaller than they are, or lies between their nodes; the finer sizes of a
    study have measured it. Of displacement and strain.
    """
    found: tuple[list[float], list[float]] = ([], [])
    for fine, other in finer:
        here, noise = _field_at(mesh, solution, fine.nodes)
        square = (here - np.hstack([other.displacement, other.strain])) ** 2
        variance = noise**2 + np.hstack([other.displacement_std, other.strain_std]) ** 2
        for errors, part in zip(found, (slice(2), slice(2, 5)), strict=True):
            known = np.isfinite(square[:, part] + variance[:, part])
            beyond, expected = (square - variance)[:, part][known], variance[:, part][known]
            plain = beyond.sum() > CONSTANTS.sure * np.sqrt(2 * (expected**2).sum() / CONSTANTS.independent)
            errors.append(float(np.sqrt(beyond.mean())) if plain else 0.0)
    return found


def _floor(fields: Sequence[FloatArray], references: int) -> tuple[float, float]:
    """Bias and scatter of fields (N, C) of static frames, as of one frame against the mean of `references`.

    They are differences among these frames, which do not depend on the reference: one frame scatters against the mean
    of n by sqrt(1 + 1/n) more than they do around their own mean.
    """
    if len(fields) < 2:
        return float("nan"), float("nan")
    stack = np.stack(fields)
    apart = (stack - stack.mean(axis=0)) * np.sqrt(1 + 1 / references) * np.sqrt(len(fields) / (len(fields) - 1))
    mean = np.nanmean(apart, axis=1, keepdims=True)
    return rms(mean), rms(apart - mean)


def _gauge_figures(
    plan: Plan, solution: Solution, still: Sequence[Solution], lengths: Sequence[float]
) -> Iterator[GaugeFigures]:
    """Figures of the virtual strain gauges that are not too short for the elements."""
    mesh, measure = plan.reference.mesh, plan.settings.probes.measure
    fit = [length for length in lengths if length >= SHORTEST * plan.element_size * (1 - CONSTANTS.equal)]
    if not fit:
        return
    covariance = NodalCovariance.from_mesh(mesh)
    for length in fit:
        gauge = StrainGauges.at_nodes(covariance, length)
        strains = [gauge.strain(*one.displacement.T, *one.displacement_std.T, measure=measure) for one in still]
        loaded = gauge.strain(*solution.displacement.T, *solution.displacement_std.T, measure=measure)
        floor = _floor([one.components for one in strains], len(plan.settings.frames.reference))[1]
        size = np.abs(loaded.components)
        known = size[np.isfinite(size)]
        largest = float(np.quantile(known, CONSTANTS.largest)) if known.size else float("nan")
        noise = floor if np.isfinite(floor) else rms(loaded.components_std)
        yield GaugeFigures(length=length, noise=noise, largest=largest)
