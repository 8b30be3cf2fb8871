"""Element size of a test from its own frames: noise and discretisation error of several sizes, and the best of them.

The noise of a displacement falls as the elements grow, what they cannot follow grows. Both are looked at where they
matter, in a deformed frame of the test: the uncertainty that the solve states, the noise floor of static frames where
the test has them (iDICs Good Practices Guide), and the discretisation error. Their sum has a minimum.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rgbmidic.correlation import Deformed, Solution, Start, Status, track
from rgbmidic.correlation.discretisation import discretisation_error
from rgbmidic.errors import ConfigurationError, FrameError, InputError, RegionError, RgbmidicError
from rgbmidic.fields import NodalCovariance, Places, StrainGauges
from rgbmidic.fields.strain import SHORTEST
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.mesh.tri3 import refined
from rgbmidic.pipeline.frame import read_state
from rgbmidic.pipeline.plan import SPECKLES, Choice, Plan
from rgbmidic.settings import ELEMENT_SIZE, TestSettings
from rgbmidic.typing import BoolArray, FloatArray

logger = logging.getLogger(__name__)

SIZES = (10.0, 16.0, 25.0, 40.0, 63.0)
"""Element sizes (px) that are tried where none are stated: the default (the paper's) and steps of 1.6, which change the
noise by as much and the discretisation error of a smooth field by 4 (its third power)."""
_LEAST = 4.0
"""Smallest elements, px (`Tri3Mesh.from_region`)."""
_FEWEST = 3.0
"""Elements across the region: fewer have no node with neighbours on all sides, and no virtual strain gauge."""
_CANDIDATES = 5
"""Frames among which the key frame is looked for. Chosen: fifths of a test."""
_STATIC = 5
"""Static frames that the noise floor is taken from at most: 100 nodes in 5 frames give it to 4 %."""
_MEASURED = 0.97
"""Area that a size must measure, of the size that measures most: what it loses is where its error would be the largest,
such as a steep bump beside one node. Chosen: a node of elements of 40 px on 250 px is 8 %."""
_ALIKE = 1.05
"""Total errors of the displacement within this factor count as the same, and those of strain decide: an estimate of the
discretisation error is no better than that."""

_SURE, _INDEPENDENT = 2.0, 0.5
"""Standard deviations by which a mean square must exceed that of noise, and independent values in a nodal one, whose
neighbours are correlated. Chosen."""
_LARGEST = 0.99
"""Quantile over the nodes and components that stands for the largest strain: the very largest is one node's noise."""
_EQUAL = 0.1
"""How much shorter than three elements a gauge may be, as `StrainGauges` has it."""
_FINER = 1.4
"""Ratio of element sizes from which their fields are compared: mesh errors of nearer ones are too much alike. Chosen:
those of neighbours among `SIZES` are compared."""
_PASSES = 3
"""Bisections in a row at most: legs of 25 px become 9 px."""
_WORTH = 2.0
"""Discretisation error of strain over its noise from which bisecting an element makes strain better: the one falls as
the area of the elements, the other rises as its inverse, e^2/4 + 4 n^2 < e^2 + n^2 (derived). Displacement does not
decide: with it affine fields and waves had more nodes and no smaller errors (measured)."""
_EXACT = 2.0**-16
"""Places of refined nodes are multiples of it, px: where they begin to count can then be shifted without rounding."""

Progress = Callable[[int, int, str], None]


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
class SizeFigures:
    """Elements of one size on a test's own frames; what is not known is NaN.

    All errors are rms over the measured nodes and over the components: u, v in px; exx, eyy, exy at the nodes.

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
    bias, scatter, strain_bias, strain_scatter
        Noise floor: rms over the static frames of the mean over the nodes, and the scatter about it.
    stated, strain_stated
        Standard uncertainty from noise in the key frame.
    discretisation, strain_discretisation
        What the mesh and the recovery leave out in the key frame.
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
    bias: float = float("nan")
    scatter: float = float("nan")
    strain_bias: float = float("nan")
    strain_scatter: float = float("nan")
    stated: float = float("nan")
    strain_stated: float = float("nan")
    discretisation: float = float("nan")
    strain_discretisation: float = float("nan")
    seconds: float = float("nan")
    gauges: tuple[GaugeFigures, ...] = ()
    reason: str = ""

    @property
    def noise(self) -> float:
        """Noise of the displacement, px: as stated in the key frame, or the noise floor where that is more."""
        return float(np.fmax(self.stated, self.scatter))

    @property
    def strain_noise(self) -> float:
        """Noise of the strain at the nodes, as `noise`."""
        return float(np.fmax(self.strain_stated, self.strain_scatter))

    @property
    def total(self) -> float:
        """Error of the displacement, px: root of the squares of noise and discretisation error."""
        return float(np.hypot(self.noise, self.discretisation))

    @property
    def strain_total(self) -> float:
        """Error of the strain at the nodes, as `total`."""
        return float(np.hypot(self.strain_noise, self.strain_discretisation))


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
        usable = [one for one in self.sizes if one not in few and one.measured >= _MEASURED * most]
        usable = sorted((one for one in usable if np.isfinite(one.total)), key=lambda one: one.element_size)
        if not usable:
            return None
        least = min(one.total for one in usable)
        best = min(
            (one for one in usable if one.total <= _ALIKE * least),
            key=lambda one: np.nan_to_num(one.strain_total, nan=np.inf),
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


def largest_size(plan: Plan) -> float:
    """Largest elements (px) of which `_FEWEST` lie side by side across the region, in x and in y."""
    spans = [np.flatnonzero(plan.region.mask.any(axis=axis)) for axis in (0, 1)]
    return min(float(span[-1] - span[0]) for span in spans) / _FEWEST


def sizes_to_try(plan: Plan) -> tuple[float, ...]:
    """The `SIZES` that hold enough speckles and of which enough lie in the region; the nearest to that if none does.

    Raises
    ------
    RegionError
        The region is too small for any.
    """
    least, most = max(SPECKLES * (plan.speckle or 0.0), _LEAST), largest_size(plan)
    if most < _LEAST:
        raise RegionError(
            f"the region is too small to compare element sizes: {_FEWEST:g} elements of {_LEAST:g} px must lie across "
            "it; state mesh.element_size"
        )
    return tuple(size for size in SIZES if least <= size <= most) or (float(np.floor(min(least, most))),)


def study_sizes(
    settings: TestSettings,
    sizes: Sequence[float] = (),
    *,
    gauges: Sequence[float] | None = None,
    frames: Sequence[int] = (),
    static: bool = True,
    progress: Progress | None = None,
    **given: Any,
) -> ResolutionStudy:
    """Measure a deformed frame and the static frames of a test with elements of several sizes.

    Parameters
    ----------
    settings
        What TEST.toml says; its own element size is not looked at.
    sizes
        Element sizes in px; none: those of `SIZES` that suit speckle and region.
    gauges
        Lengths of virtual strain gauges in px; None: three elements of each size.
    frames
        Deformed frames among which the key frame is chosen, the one that departs most from an affine motion; none:
        five of the test, evenly spread.
    static
        Whether the noise floor is measured, where the reference is the mean of several frames.
    progress
        Called with the sizes done, their number and the next one.
    **given
        Objects in place of what the settings name, as `rgbmidic.measure` takes them.

    Returns
    -------
    ResolutionStudy

    Raises
    ------
    RgbmidicError
        The settings or frames are not usable, there is no deformed frame, none of them can be measured, or a size or
        gauge does not fit.
    """
    if settings.mesh_file is not None or given.get("mesh") is not None:
        what = "a mesh is given" if settings.mesh_file is None else f"mesh.file names {settings.mesh_file}"
        raise ConfigurationError(f"{what}, whose elements have their sizes: one is found for a mesh made here only")
    if sizes and min(sizes) < _LEAST:
        raise InputError(f"elements of {min(sizes):g} px are too small: {_LEAST:g} px are the least")
    middle = min(sizes, key=lambda size: abs(size - ELEMENT_SIZE), default=ELEMENT_SIZE)
    plan = Plan.from_settings(replace(settings, element_size=middle), **given)
    sizes = tuple(sorted(sizes)) or sizes_to_try(plan)
    if max(sizes) > (most := largest_size(plan)):
        raise InputError(
            f"elements of {max(sizes):g} px are too large for the region: {most:.0f} px are the largest of which "
            f"{_FEWEST:g} lie across it"
        )
    lengths = [SHORTEST * size for size in sizes] if gauges is None else sorted(gauges)
    if lengths and max(lengths) < (shortest := SHORTEST * min(sizes) * (1 - _EQUAL)):
        raise InputError(
            f"strain gauges of {max(lengths):g} px at most are too short: {shortest:g} px is the least, "
            f"{SHORTEST:g} elements of {min(sizes):g} px"
        )
    report = progress or (lambda done, total, line: None)
    report(0, len(sizes) + 1, "looking for the key frame")
    key = _KeyFrame.find(plan, frames)
    at_rest = settings.frames.reference[:_STATIC] if static and len(settings.frames.reference) > 1 else ()
    rest = [_deformed(plan, index) for index in at_rest]
    figures, finer = [], list[_Field]()
    for number, size in enumerate(sizes):
        report(number + 1, len(sizes) + 1, f"elements of {size:g} px")
        try:
            figures.append(_figures(_resized(plan, size), key, rest, lengths, finer))
        except RgbmidicError as error:
            logger.warning("elements of %g px: %s", size, error)
            figures.append(SizeFigures(element_size=size, reason=str(error)))
    return ResolutionStudy(
        frame=key.index,
        name=plan.series.name(key.index),
        static=len(rest),
        speckle=plan.speckle or float("nan"),
        preparation=key.seconds,
        sizes=_mesh_errors(figures),
    )


def _mesh_errors(sizes: Sequence[SizeFigures]) -> tuple[SizeFigures, ...]:
    """Figures of sizes in rising order, with discretisation errors that do not fall.

    A coarser mesh follows no more than a finer one: what falls as elements grow is none of the mesh's. It is, for
    instance, that of reflections, which each element averages.
    """
    out, least, fallen = list[SizeFigures](), np.array([np.inf, np.inf]), 0.0
    for one in reversed(sizes):
        stated = np.array([one.discretisation, one.strain_discretisation])
        least = np.fmin(least, stated)
        mesh = np.where(np.isfinite(stated), least, np.nan)
        fallen = float(np.fmax(fallen, np.sqrt(np.maximum(stated[0] ** 2 - mesh[0] ** 2, 0.0))))
        out.append(replace(one, discretisation=float(mesh[0]), strain_discretisation=float(mesh[1])))
    if fallen > max((one.noise for one in sizes if one.noise > 0), default=np.inf):
        logger.warning(
            "differences of %.2g px between element sizes fall as the elements grow, as those of reflections: they are "
            "not counted as the mesh's",
            fallen,
        )
    return tuple(reversed(out))


def choose(settings: TestSettings, **given: Any) -> Choice:
    """Find the element size of a test with ``mesh.element_size = "auto"``.

    It depends on the reference and the deformed frames alone, neither on time nor on the number of workers.

    Parameters
    ----------
    settings, **given
        As in `study_sizes`.

    Raises
    ------
    RgbmidicError
        As `study_sizes`, or nothing is known of any size.
    """
    try:
        study = study_sizes(settings, gauges=(), static=False, **given)
    except FrameError as error:
        raise FrameError(f'mesh.element_size = "auto": {error}; state a number') from error
    if (choice := study.choice) is None:
        why = "; ".join(f"{one.element_size:g} px: {one.reason or 'not known'}" for one in study.sizes)
        raise FrameError(f'mesh.element_size = "auto": no size can be judged in {study.name} ({why}); state a number')
    logger.info("%s", choice.reason)
    return choice


def refine(plan: Plan, frame: int | bool = True) -> Plan:
    """Bisect the elements whose discretisation error of strain in a deformed frame is more than twice its noise.

    It is done three times at most, in one frame, for the mesh of the whole test. No leg gets shorter than three
    speckles; both sides of a crack are bisected alike.

    Parameters
    ----------
    plan
        The test with elements of one size.
    frame
        Index of the frame; True: of five of the test, evenly spread, the one that departs most from an affine motion.

    Returns
    -------
    Plan
        With the finer mesh, and `Plan.refinement` that tells of it.

    Raises
    ------
    RgbmidicError
        There is no such deformed frame, or none can be measured.
    """
    try:
        key = _KeyFrame.find(plan, () if frame is True else (int(frame),))
    except (FrameError, InputError) as error:
        raise type(error)(f"mesh.refine: {error}") from error
    least, counts = max(SPECKLES * (plan.speckle or 0.0), _LEAST), [len(plan.reference.mesh.nodes)]
    while len(counts) <= _PASSES:
        mesh = plan.reference.mesh
        solution = _solve(plan, key.deformed, key.start(mesh))
        known = discretisation_error(plan.reference, key.deformed, solution, plan.solver, plan.method)
        finer = refined(mesh, _worth(mesh, known), least)
        if finer is mesh:
            break
        nodes = np.round(finer.nodes / _EXACT) * _EXACT
        plan = plan.on_mesh(Tri3Mesh(nodes=nodes, elements=finer.elements))
        counts.append(len(nodes))
    name = plan.series.name(key.index)
    worth = f"the discretisation error of strain in {name} is more than {_WORTH:g} times its noise"
    text = f"no element: there is none where {worth} and parts would have legs of {least:.3g} px or more"
    if counts[1:]:
        text = f"from {counts[0]} to {counts[-1]} nodes in {len(counts) - 1} steps, where {worth}; no leg is shorter "
        text += f"than {least:.3g} px"
    logger.info("refined: %s", text)
    return replace(plan, refinement=text)


def _worth(mesh: Tri3Mesh, known: Solution) -> BoolArray:
    """Elements (E,) whose strain gets better by bisection: by the squares at their corners; NaN takes no part."""
    error, noise = (
        np.nan_to_num(part[mesh.elements] ** 2).sum(axis=(1, 2)) for part in (known.strain_error, known.strain_std)
    )
    return np.asarray(error > _WORTH**2 * noise)


@dataclass(frozen=True, slots=True, kw_only=True)
class _KeyFrame:
    """The deformed frame that sizes are compared in, measured on the mesh of a plan."""

    index: int
    deformed: Deformed
    places: Tri3Mesh
    displacement: FloatArray
    seconds: float

    @classmethod
    def find(cls, plan: Plan, frames: Sequence[int]) -> _KeyFrame:
        """Measure some frames, and keep the one whose displacement departs most from an affine one."""
        chosen, reference = plan.series.chosen, plan.settings.frames.reference
        for index in frames:
            if index not in chosen or index in reference:
                what = "of the reference" if index in reference else f"not among {chosen[0]} to {chosen[-1]}"
                raise InputError(f"frame {index} is {what}: a deformed frame of the test is needed")
        all_ = [index for index in chosen if index not in reference]
        if not all_:
            raise FrameError("the test has no deformed frame, which shows what elements cannot follow")
        spread = np.unique(np.linspace(0, len(all_) - 1, _CANDIDATES + 1).round().astype(int)[1:])
        found, most, reasons = None, -1.0, []
        for index in frames or [all_[place] for place in spread]:
            before = time.process_time()
            try:
                deformed = _deformed(plan, index)
                seconds = time.process_time() - before
                solution = _solve(plan, deformed, None)
                if solution.status is Status.FAILED:
                    raise FrameError(solution.reason)
            except RgbmidicError as error:
                logger.warning("frame %d (%s) is passed over: %s", index, plan.series.name(index), error)
                reasons.append(f"{plan.series.name(index)}: {error}")
                continue
            if (rest := _beyond_affine(solution)) > most:
                mesh = plan.reference.mesh
                whole = solution.displacement[mesh.nearest(solution.measured)[1]]
                found = cls(index=index, deformed=deformed, places=mesh, displacement=whole, seconds=seconds)
                most = rest
        if found is None:
            raise FrameError(f"no deformed frame can be measured: {'; '.join(reasons)}")
        return found

    def start(self, mesh: Tri3Mesh) -> FloatArray:
        """The displacement (N, 2) at the nodes of another mesh of the region."""
        found = Places.of(self.places, mesh.places)
        corners = self.displacement[self.places.elements[found.element]]
        return np.asarray(np.einsum("nc,nci->ni", found.barycentric, corners))


def _deformed(plan: Plan, index: int) -> Deformed:
    """The images of a frame, ready to be interpolated."""
    window = plan.window_of()
    ready = plan.prepared(plan.lights(read_state(plan, index, window)[0], window), index)
    return Deformed.prepare(*ready, prefilter=plan.solver.prefilter, origin=window.origin)


def _resized(plan: Plan, size: float) -> Plan:
    """The same test on elements of another size; the weights are those prepared for this one's."""
    cracks = [np.subtract(path, plan.window.origin) for path in plan.settings.cracks]
    return replace(plan.on_mesh(Tri3Mesh.from_region(plan.region, size, cracks)), element_size=size)


def _solve(plan: Plan, deformed: Deformed, start: FloatArray | None) -> Solution:
    return track(plan.reference, deformed, Start(displacement=start), plan.solver, plan.method)


def _beyond_affine(solution: Solution) -> float:
    """What no affine motion follows of a displacement: rms over the measured nodes, px."""
    known = solution.measured
    basis = np.column_stack([np.ones(known.sum()), solution.nodes[known]])
    moved = solution.displacement[known]
    return _rms(np.asarray(moved - basis @ np.linalg.lstsq(basis, moved, rcond=None)[0]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Field:
    """Displacement and strain (N, 5) on a mesh, and their noise."""

    mesh: Tri3Mesh
    values: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, mesh: Tri3Mesh, solution: Solution) -> _Field:
        """Those of a solution, the noise without the misfit of the elements."""
        values = np.hstack([solution.displacement, solution.strain])
        return cls(mesh=mesh, values=values, noise=np.hstack([solution.displacement_std, solution.strain_std]))

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The field at points (P, 2), by the quadratics through the nodes around each node (`at_pixels`), and noise."""
        used = np.asarray(np.isfinite(self.values)[self.mesh.elements].all(axis=(1, 2)))
        known = np.nan_to_num(self.values)
        _, x, y, xx, xy, yy = (operator @ known for operator in quadratic_fit(self.mesh, used))
        places = Places.of(self.mesh, points)
        node, weight = self.mesh.elements[places.element], places.barycentric
        dx, dy = np.moveaxis(points[:, None] - self.mesh.nodes[node], -1, 0)[..., None]
        bent = xx[node] * dx * dx / 2 + xy[node] * dx * dy + yy[node] * dy * dy / 2
        out = np.einsum("pc,pci->pi", weight, self.values[node] + x[node] * dx + y[node] * dy + bent)
        noise = np.sqrt(np.einsum("pc,pci->pi", weight, self.noise[node] ** 2))
        return np.where(places.inside[:, None] & used[places.element][:, None], out, np.nan), noise

    def apart(self, finer: Sequence[_Field]) -> tuple[list[float], list[float]]:
        """How far this field is from each of `finer` elements beyond the noise of both, at the nodes of those.

        Halved elements show little of what is far smaller than they are, or lies between their nodes; the finer sizes
        of a study have measured it. Of displacement and strain.
        """
        found: tuple[list[float], list[float]] = ([], [])
        for other in finer:
            here, noise = self.at(other.mesh.nodes)
            square, variance = (here - other.values) ** 2, noise**2 + other.noise**2
            for errors, part in zip(found, (slice(2), slice(2, 5)), strict=True):
                known = np.isfinite(square[:, part] + variance[:, part])
                beyond, expected = (square - variance)[:, part][known], variance[:, part][known]
                plain = beyond.sum() > _SURE * np.sqrt(2 * (expected**2).sum() / _INDEPENDENT)
                errors.append(float(np.sqrt(beyond.mean())) if plain else 0.0)
        return found


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _figures(
    plan: Plan, key: _KeyFrame, rest: Sequence[Deformed], gauges: Sequence[float], finer: list[_Field]
) -> SizeFigures:
    """The figures of the size of a plan's elements; its field is added to those of `finer` elements."""
    mesh, speckle = plan.reference.mesh, plan.speckle or float("nan")
    before = time.process_time()
    solution = _solve(plan, key.deformed, key.start(mesh))
    seconds = time.process_time() - before
    if solution.status is Status.FAILED:
        raise FrameError(solution.reason)
    still = [_solve(plan, deformed, np.zeros_like(mesh.nodes)) for deformed in rest]
    single = np.sqrt(1 + 1 / len(plan.settings.frames.reference))
    moved, strain = (_floor([getattr(one, name) for one in still], single) for name in ("displacement", "strain"))
    known = discretisation_error(plan.reference, key.deformed, solution, plan.solver, plan.method)
    field = _Field.of(mesh, known)
    errors = [_rms(known.displacement_error), _rms(known.strain_error)]
    other = [one for one in finer if _FINER * one.mesh.size <= mesh.size]
    # it differs from all of them, each of which has an error of its own (in proportion to the size's third power);
    # reflections, which every size averages in its own way, hardly differ from the next
    part = [1 - (one.mesh.size / mesh.size) ** 3 for one in other]
    apart = [min(np.divide(found, part), default=0.0) for found in field.apart(other)]
    errors = [float(np.fmax(error, far)) for error, far in zip(errors, apart, strict=True)]
    finer.append(field)
    return SizeFigures(
        element_size=plan.element_size,
        speckles=plan.element_size / speckle,
        nodes=len(mesh.nodes),
        measured=float(mesh.areas @ solution.measured[mesh.elements].all(axis=1) / mesh.areas.sum()),
        bias=moved[0],
        scatter=moved[1],
        strain_bias=strain[0],
        strain_scatter=strain[1],
        stated=_rms(known.displacement_std),
        strain_stated=_rms(known.strain_std),
        discretisation=errors[0],
        strain_discretisation=errors[1],
        seconds=seconds,
        gauges=tuple(_gauge_figures(plan, solution, still, gauges)),
    )


def _floor(fields: Sequence[FloatArray], single: float) -> tuple[float, float]:
    """Bias and scatter of fields (N, C) of static frames, as of a `single` frame against the reference.

    They are differences among these frames, which do not depend on the reference: one frame scatters against the mean
    of n by sqrt(1 + 1/n) more than they do around their own mean.
    """
    if len(fields) < 2:
        return float("nan"), float("nan")
    stack = np.stack(fields)
    apart = (stack - stack.mean(axis=0)) * single * np.sqrt(len(fields) / (len(fields) - 1))
    mean = np.nanmean(apart, axis=1, keepdims=True)
    return _rms(mean), _rms(apart - mean)


def _gauge_figures(
    plan: Plan, solution: Solution, still: Sequence[Solution], lengths: Sequence[float]
) -> Iterator[GaugeFigures]:
    """Figures of the virtual strain gauges that are not too short for the elements."""
    mesh, measure = plan.reference.mesh, plan.settings.probes.measure
    fit = [length for length in lengths if length >= SHORTEST * plan.element_size * (1 - _EQUAL)]
    covariance = NodalCovariance.from_mesh(mesh) if fit else None
    single = np.sqrt(1 + 1 / len(plan.settings.frames.reference))
    for length in fit:
        assert covariance is not None
        gauge = StrainGauges.at_nodes(covariance, length)
        strains = [gauge.strain(*one.displacement.T, *one.displacement_std.T, measure=measure) for one in still]
        loaded = gauge.strain(*solution.displacement.T, *solution.displacement_std.T, measure=measure)
        floor = _floor([one.components for one in strains], single)[1]
        size = np.abs(loaded.components)
        largest = float(np.quantile(size[np.isfinite(size)], _LARGEST)) if np.isfinite(size).any() else float("nan")
        yield GaugeFigures(
            length=length, noise=floor if np.isfinite(floor) else _rms(loaded.components_std), largest=largest
        )
