"""Element size of a test from its own frames: noise and discretisation error of several sizes, and the best of them.

The noise of a displacement falls as the elements grow, what they cannot follow grows. Both are looked at where they
matter, in a deformed frame of the test: the uncertainty that the solve states, the noise floor of static frames where
the test has them (iDICs Good Practices Guide), and the discretisation error. Their sum has a minimum.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rgbmidic.correlation import Deformed, Solution, Status, TrackingState, discretisation_error, track
from rgbmidic.errors import ConfigurationError, FrameError, InputError, RegionError, RgbmidicError
from rgbmidic.fields import Displacement, MeshPoints, NodalCovariance, StrainGauges
from rgbmidic.fields.strain import SHORTEST
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.frame import prepared_frame
from rgbmidic.pipeline.frame_quality import SPECKLES
from rgbmidic.pipeline.plan import Plan
from rgbmidic.settings import ELEMENT_SIZE, TestSettings
from rgbmidic.tools.preparation.size_figures import (
    CONSTANTS,
    Choice,
    ErrorFigures,
    GaugeFigures,
    ResolutionStudy,
    SizeFigures,
)
from rgbmidic.typing import FloatArray, ProgressCallback

logger = logging.getLogger(__name__)

SIZES = (10.0, 16.0, 25.0, 40.0, 63.0)
"""Element sizes (px) that are tried where none are stated: the default (the paper's) and steps of 1.6, which change the
noise by as much and the discretisation error of a smooth field by 4 (its third power)."""


def sizes_to_try(plan: Plan, requested: Sequence[float] = ()) -> tuple[float, ...]:
    """The sizes that are stated, in rising order; else the `SIZES` that suit speckle and region.

    Those hold enough speckles, and enough lie across the region; the nearest to that if none does.

    Raises
    ------
    InputError
        Of the largest that is stated fewer than three lie side by side across the region, in x or in y.
    RegionError
        The region is too small for any.
    """
    spans = [np.flatnonzero(plan.region.mask.any(axis=axis)) for axis in (0, 1)]
    max_size = min(float(span[-1] - span[0]) for span in spans) / CONSTANTS.fewest
    min_size = max(SPECKLES * (plan.speckle or 0.0), CONSTANTS.min_size)
    if requested and max(requested) > max_size:
        raise InputError(
            f"elements of {max(requested):g} px are too large for the region: {max_size:.0f} px are the largest of "
            f"which {CONSTANTS.fewest:g} lie across it"
        )
    if not requested and max_size < CONSTANTS.min_size:
        raise RegionError(
            f"the region is too small to compare element sizes: {CONSTANTS.fewest:g} elements of "
            f"{CONSTANTS.min_size:g} px must lie across it; state mesh.element_size"
        )
    suited = requested or [size for size in SIZES if min_size <= size <= max_size]
    return tuple(sorted(suited)) or (float(np.floor(min(min_size, max_size))),)


def study_sizes(
    settings: TestSettings,
    sizes: Sequence[float] = (),
    *,
    gauges: Sequence[float] | None = None,
    frames: Sequence[int] = (),
    static: bool = True,
    progress: ProgressCallback | None = None,
    **objects: Any,
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
    **objects
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
    if settings.mesh.file is not None or objects.get("mesh") is not None:
        mesh_source = "a mesh is given" if settings.mesh.file is None else f"mesh.file names {settings.mesh.file}"
        raise ConfigurationError(
            f"{mesh_source}, whose elements have their sizes: one is found for a mesh made here only"
        )
    if sizes and min(sizes) < CONSTANTS.min_size:
        raise InputError(f"elements of {min(sizes):g} px are too small: {CONSTANTS.min_size:g} px are the least")
    middle = min(sizes, key=lambda size: abs(size - ELEMENT_SIZE), default=ELEMENT_SIZE)
    plan = Plan.from_settings(replace(settings, mesh=replace(settings.mesh, element_size=middle)), **objects)
    sizes = sizes_to_try(plan, sizes)
    lengths = [SHORTEST * size for size in sizes] if gauges is None else sorted(gauges)
    if lengths and max(lengths) < (shortest := SHORTEST * min(sizes) * (1 - CONSTANTS.equal)):
        raise InputError(
            f"strain gauges of {max(lengths):g} px at most are too short: {shortest:g} px is the least, "
            f"{SHORTEST:g} elements of {min(sizes):g} px"
        )
    report = progress or (lambda done, total, line: None)
    report(0, len(sizes) + 1, "looking for the key frame")
    key = KeyFrame.find(plan, frames)
    at_rest = settings.frames.reference[: CONSTANTS.static] if static and len(settings.frames.reference) > 1 else ()
    static_frames = [_deformed(plan, index) for index in at_rest]
    figures, finer = [], list[tuple[Tri3Mesh, Solution]]()
    for number, size in enumerate(sizes):
        report(number + 1, len(sizes) + 1, f"elements of {size:g} px")
        try:
            figures.append(key.figures(_resized(plan, size), static_frames, lengths, finer))
        except RgbmidicError as error:
            logger.warning("elements of %g px: %s", size, error)
            figures.append(SizeFigures(element_size=size, reason=str(error)))
    return ResolutionStudy(
        frame=key.index,
        name=plan.series.name(key.index),
        static=len(static_frames),
        speckle=plan.speckle or float("nan"),
        preparation=key.seconds,
        sizes=_mesh_errors(figures),
    )


def rms(values: FloatArray) -> float:
    """Root mean square of the finite values; NaN where there are none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def solved(plan: Plan, deformed: Deformed, start: FloatArray | None) -> Solution:
    """Solution of a frame from an initial guess (N, 2), or from a search."""
    return track(plan.reference, deformed, TrackingState(displacement=start), plan.settings.solver, plan.method)


def _field_at(mesh: Tri3Mesh, solution: Solution, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement and strain (P, 5) at points (P, 2), and their noise without the misfit of the elements."""
    mesh_points, nodal = MeshPoints.of(mesh, points), np.hstack([solution.displacement_std, solution.strain_std])
    corners = mesh.elements[mesh_points.element]
    noise = np.sqrt(np.einsum("pc,pci->pi", mesh_points.barycentric, nodal[corners] ** 2))
    return mesh_points.read(np.hstack([solution.displacement, solution.strain])), noise


def _excess_differences(
    mesh: Tri3Mesh, solution: Solution, finer: Sequence[tuple[Tri3Mesh, Solution]]
) -> tuple[list[float], list[float]]:
    """Compute how far a solution is from each of those on `finer` elements beyond their noise, at the nodes of those.

    Halved elements show little of what is far smaller than they are, or lies between their nodes; the finer sizes of a
    study have measured it. Of displacement and strain.
    """
    differences: tuple[list[float], list[float]] = ([], [])
    for fine, fine_solution in finer:
        values, noise = _field_at(mesh, solution, fine.nodes)
        square = (values - np.hstack([fine_solution.displacement, fine_solution.strain])) ** 2
        variance = noise**2 + np.hstack([fine_solution.displacement_std, fine_solution.strain_std]) ** 2
        for errors, columns in zip(differences, (slice(2), slice(2, 5)), strict=True):
            is_measured = np.isfinite(square[:, columns] + variance[:, columns])
            excess, expected = (square - variance)[:, columns][is_measured], variance[:, columns][is_measured]
            is_significant = excess.sum() > CONSTANTS.significance * np.sqrt(
                2 * (expected**2).sum() / CONSTANTS.independent
            )
            errors.append(float(np.sqrt(excess.mean())) if is_significant else 0.0)
    return differences


def _floor(fields: Sequence[FloatArray], references: int) -> tuple[float, float]:
    """Bias and scatter of fields (N, C) of static frames, as of one frame against the mean of `references`.

    They are differences among these frames, which do not depend on the reference: one frame scatters against the mean
    of n by sqrt(1 + 1/n) more than they do around their own mean.
    """
    if len(fields) < 2:
        return float("nan"), float("nan")
    stack = np.stack(fields)
    deviations = (stack - stack.mean(axis=0)) * np.sqrt(1 + 1 / references) * np.sqrt(len(fields) / (len(fields) - 1))
    mean = np.nanmean(deviations, axis=1, keepdims=True)
    return rms(mean), rms(deviations - mean)


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
        loaded, *strains = (
            gauge.strain(Displacement.in_plane(*one.displacement.T, *one.displacement_std.T), measure)
            for one in (solution, *still)
        )
        floor = _floor([static.components for static in strains], len(plan.settings.frames.reference))[1]
        size = np.abs(loaded.components)
        finite = size[np.isfinite(size)]
        largest = float(np.quantile(finite, CONSTANTS.largest)) if finite.size else float("nan")
        noise = floor if np.isfinite(floor) else rms(loaded.components_std)
        yield GaugeFigures(length=length, noise=noise, largest=largest)


def _mesh_errors(sizes: Sequence[SizeFigures]) -> tuple[SizeFigures, ...]:
    """Figures of sizes in rising order, with discretisation errors that do not fall.

    A coarser mesh follows no more than a finer one: what falls as elements grow is none of the mesh's. It is, for
    instance, that of reflections, which each element averages.
    """
    estimated = np.array([[figures.discretisation, figures.strain.discretisation] for figures in sizes])
    mesh = np.where(np.isfinite(estimated), np.fmin.accumulate(estimated[::-1])[::-1], np.nan)
    fallen = float(np.fmax.reduce(np.sqrt(np.maximum(estimated**2 - mesh**2, 0.0))[:, 0], initial=0.0))
    if fallen > max((figures.noise for figures in sizes if figures.noise > 0), default=np.inf):
        logger.warning(
            f"differences of {fallen:.2g} px between element sizes fall as the elements grow, as those of reflections: "
            "they are not counted as the mesh's"
        )
    return tuple(
        replace(
            figures,
            discretisation=float(displacement_error),
            strain=replace(figures.strain, discretisation=float(strain)),
        )
        for figures, (displacement_error, strain) in zip(sizes, mesh, strict=True)
    )


def choose(settings: TestSettings, **objects: Any) -> Choice:
    """Find the element size of a test with ``mesh.element_size = "auto"``.

    It depends on the reference and the deformed frames alone, neither on time nor on the number of workers.

    Parameters
    ----------
    settings, **objects
        As in `study_sizes`.

    Raises
    ------
    RgbmidicError
        As `study_sizes`, or nothing is known of any size.
    """
    try:
        study = study_sizes(settings, gauges=(), static=False, **objects)
    except FrameError as error:
        raise FrameError(f'mesh.element_size = "auto": {error}; state a number') from error
    if (choice := study.choice) is None:
        reasons = "; ".join(f"{figures.element_size:g} px: {figures.reason or 'not known'}" for figures in study.sizes)
        raise FrameError(
            f'mesh.element_size = "auto": no size can be judged in {study.name} ({reasons}); state a number'
        )
    logger.info("%s", choice.reason)
    return choice


@dataclass(frozen=True, slots=True)
class KeyFrame:
    """The deformed frame that sizes are compared in, measured on the mesh of a plan."""

    index: int
    deformed: Deformed
    mesh: Tri3Mesh
    solution: Solution
    seconds: float

    @classmethod
    def find(cls, plan: Plan, frames: Sequence[int]) -> KeyFrame:
        """Measure some frames, and keep the one whose displacement departs most from an affine one."""
        selected, reference = plan.series.selected, plan.settings.frames.reference
        for index in frames:
            if index not in selected or index in reference:
                reason = "of the reference" if index in reference else f"not among {selected[0]} to {selected[-1]}"
                raise InputError(f"frame {index} is {reason}: a deformed frame of the test is needed")
        deformed_frames = [index for index in selected if index not in reference]
        if not deformed_frames:
            raise FrameError("the test has no deformed frame, which shows what elements cannot follow")
        spread = np.unique(np.linspace(0, len(deformed_frames) - 1, CONSTANTS.candidates + 1).round().astype(int)[1:])
        best, max_departure, reasons = None, -1.0, []
        for index in frames or [deformed_frames[position] for position in spread]:
            before = time.process_time()
            try:
                deformed = _deformed(plan, index)
                seconds = time.process_time() - before
                solution = solved(plan, deformed, None)
                if solution.status is Status.FAILED:
                    raise FrameError(solution.reason)
            except RgbmidicError as error:
                logger.warning("frame %d (%s) is passed over: %s", index, plan.series.name(index), error)
                reasons.append(f"{plan.series.name(index)}: {error}")
                continue
            if (departure := _nonaffine_rms(solution)) > max_departure:
                best, max_departure = cls(index, deformed, plan.reference.mesh, solution, seconds), departure
        if best is None:
            raise FrameError(f"no deformed frame can be measured: {'; '.join(reasons)}")
        return best

    def start(self, mesh: Tri3Mesh) -> FloatArray:
        """The displacement (N, 2) at the nodes of another mesh of the region."""
        mesh_points = MeshPoints.of(self.mesh, mesh.observation_points)
        filled_displacement = self.solution.displacement[self.mesh.nearest_nodes(self.solution.measured)[1]]
        corners = filled_displacement[self.mesh.elements[mesh_points.element]]
        return np.asarray(np.einsum("nc,nci->ni", mesh_points.barycentric, corners))

    def figures(
        self,
        plan: Plan,
        static_frames: Sequence[Deformed],
        gauges: Sequence[float],
        finer: list[tuple[Tri3Mesh, Solution]],
    ) -> SizeFigures:
        """Measure the figures of the size of a plan's elements.

        Parameters
        ----------
        plan
            The test with elements of this size.
        static_frames
            Static frames.
        gauges
            Lengths of virtual strain gauges, px; those too short for the elements are left out.
        finer
            Meshes of finer elements and the solutions on them, to which those of these are added.
        """
        mesh, speckle = plan.reference.mesh, plan.speckle or float("nan")
        before = time.process_time()
        solution = solved(plan, self.deformed, self.start(mesh))
        seconds = time.process_time() - before
        if solution.status is Status.FAILED:
            raise FrameError(solution.reason)
        still = [solved(plan, static, np.zeros_like(mesh.nodes)) for static in static_frames]
        estimated = discretisation_error(plan.reference, self.deformed, solution, plan.settings.solver, plan.method)
        comparable = [item for item in finer if CONSTANTS.finer * item[0].size <= mesh.size]
        # it differs from all of them, each of which has an error of its own (in proportion to the size's third power);
        # reflections, which every size averages in its own way, hardly differ from the next
        fractions = [1 - (fine.size / mesh.size) ** 3 for fine, _ in comparable]
        excess = [
            min(np.divide(difference, fractions), default=0.0)
            for difference in _excess_differences(mesh, estimated, comparable)
        ]
        finer.append((mesh, estimated))
        is_measured = solution.measured[mesh.elements].all(axis=1)

        def errors(name: str, size_difference: float) -> dict[str, Any]:
            bias, scatter = _floor([getattr(item, name) for item in still], len(plan.settings.frames.reference))
            std, error = (rms(getattr(estimated, f"{name}_{kind}")) for kind in ("std", "error"))
            return {
                "bias": bias,
                "scatter": scatter,
                "stated": std,
                "discretisation": float(np.fmax(error, size_difference)),
            }

        return SizeFigures(
            element_size=plan.element_size,
            speckles=plan.element_size / speckle,
            nodes=len(mesh.nodes),
            measured=float(mesh.areas[is_measured].sum() / mesh.areas.sum()),
            strain=ErrorFigures(**errors("strain", excess[1])),
            seconds=seconds,
            gauges=tuple(_gauge_figures(plan, solution, still, gauges)),
            **errors("displacement", excess[0]),
        )


def _deformed(plan: Plan, index: int) -> Deformed:
    """The images of a frame, ready to be interpolated."""
    window = plan.window_of()
    return Deformed.prepare(
        *prepared_frame(plan, index, window), prefilter=plan.settings.solver.prefilter, origin=window.origin
    )


def _resized(plan: Plan, size: float) -> Plan:
    """The same test on elements of another size; the weights are those prepared for this one's."""
    cracks = [np.subtract(path, plan.window.origin) for path in plan.settings.mesh.cracks]
    return replace(plan.on_mesh(Tri3Mesh.from_region(plan.region, size, cracks)), element_size=size)


def _nonaffine_rms(solution: Solution) -> float:
    """Compute the rms of a displacement less its best affine motion, over the measured nodes, px."""
    is_measured = solution.measured
    basis = np.column_stack([np.ones(is_measured.sum()), solution.nodes[is_measured]])
    displacement = solution.displacement[is_measured]
    return rms(np.asarray(displacement - basis @ np.linalg.lstsq(basis, displacement, rcond=None)[0]))
