"""States that a script has in memory: one pair (`correlate`), or one after the other (`measure_sequence`).

Of a sequence, each solution is there before the next state is asked for, as a camera gives them. Initial guesses,
tracking and reference updates are those of `rgbmidic.measure`, frame for frame, in constant memory.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Any, Unpack, cast

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.threads import aside
from rgbmidic.correlation import (
    Deformed,
    Reference,
    Solution,
    TrackingState,
    discretisation_error,
    fill,
    track,
    unresolved_strain,
    with_one_sided_error,
)
from rgbmidic.correlation.images import as_light_stack
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.correlation.residual import PrecisionMethod
from rgbmidic.errors import ConfigurationError, FrameError, InputError
from rgbmidic.illumination.separation import LightSeparation
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.engine import Outcome, Schedule, Threads
from rgbmidic.pipeline.frame import messages, next_reference
from rgbmidic.pipeline.plan import STRIDE, Plan
from rgbmidic.pipeline.user_objects import check_object, check_type
from rgbmidic.results.quantities import NO_CHECKSUM
from rgbmidic.settings import ELEMENT_SIZE, SolverOptions, TestSettings, check_names, sections
from rgbmidic.typing import FloatArray, unmasked
from rgbmidic.weights import LightWeights, MaskWeights, Statistics, as_weights

logger = logging.getLogger(__name__)


def correlate(
    reference: npt.ArrayLike,
    deformed: npt.ArrayLike,
    *,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    cracks: Sequence[npt.ArrayLike] = (),
    weights: npt.ArrayLike | None = None,
    initial: npt.ArrayLike | None = None,
    deformed_weights: npt.ArrayLike | None = None,
    statistics: bool | PrecisionMethod = True,
    mesh_error: bool = False,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Measure the displacement between two states seen under k lights (k = 1: plain DIC).

    Parameters
    ----------
    reference, deformed : array_like, shape (H, W) or (k, H, W)
        Grey levels; NaN marks an invalid pixel.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    cracks
        Paths, each of corners (x, y) in px, along which the mesh is split, see `Tri3Mesh.from_region`.
    weights : array_like, shape (H, W) or (k, H, W), optional
        Weight of each light at each pixel of the reference, finite and not negative; 0 excludes the pixel.
    initial : array_like, shape (2,) or (N, 2), optional
        Initial guess of the displacement (u, v) in px. Where the solve fails from it or loses nodes, or None is given,
        initial guesses are found by a search, and the best solution is returned.
    deformed_weights
        Like `weights`, on the deformed images.
    statistics
        True: weight the lights by the statistics of the residual around each pixel (`rgbmidic.weights.Statistics`).
        False: only by `weights`. Or an object with a method of your own.
    mesh_error
        Estimate the discretisation error, too (`rgbmidic.discretisation_error`).
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults: prefilter, rigid, brightness, fill,
        tolerance, max_iterations.

    Returns
    -------
    Solution
        With `nodes` (N, 2), `elements` (E, 3), `displacement` (N, 2) in px, `displacement_std` (N, 2) in px,
        `status`, and more.

    Raises
    ------
    InputError
        The images have different shapes, a weight or initial guess does not fit them, or a setting is unknown.
    RegionError
        The region is empty, too small or outside the image.

    Examples
    --------
    >>> import numpy as np
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(120, 160)), 1.5)
    >>> solution = correlate(speckle, np.roll(speckle, 2, axis=1), region=(20, 20, 140, 100))
    >>> solution.status.name
    'CONVERGED'
    >>> np.allclose(solution.displacement, (2, 0), atol=0.01)
    True
    """
    f, g = as_light_stack(reference, "reference"), as_light_stack(deformed, "deformed")
    if f.shape != g.shape:
        raise InputError(f"reference and deformed images must have one shape; given are {f.shape} and {g.shape}")
    height, width = f.shape[1:]
    if not isinstance(region, Region):
        region = Region.from_rectangle(region if region is not None else (0, 0, width - 1, height - 1), (height, width))
    mesh = Tri3Mesh.from_region(region, element_size, cracks)
    solver = solver_settings(options)
    light_weights = as_weights(weights, f.shape, "weights"), as_weights(deformed_weights, f.shape, "deformed_weights")
    second = aside(Deformed.prepare, g, light_weights[1], prefilter=solver.prefilter)
    first = Reference.prepare(
        f, region, light_weights[0], mesh=mesh, prefilter=solver.prefilter, brightness=solver.brightness
    )
    method = (Statistics() if statistics else None) if isinstance(statistics, bool) else statistics
    check_object("statistics", method, "precision")
    start = TrackingState(displacement=initial_displacement(initial, len(mesh.nodes)))
    solution = track(first, second.result(), start, solver, method)
    if solution.disagreement:
        logger.warning("%s", solution.disagreement)
    tracked = solution
    if mesh_error:
        solution = discretisation_error(first, second.result(), tracked, solver, method)
    else:
        solution = with_one_sided_error(mesh, tracked)
    if unresolved := unresolved_strain(mesh, tracked, solution):
        logger.warning("%s", unresolved)
    return fill(mesh, solution, solver.fill) if solver.fill else solution


def solver_settings(options: SolverOptions) -> sections.SolverSettings:
    """The settings of the solve that options of a function state.

    Raises
    ------
    InputError
        An option is unknown or out of range.
    """
    if "normalise" in options:
        raise InputError('"normalise" is no option any more: brightness is a width in px, "auto", "constant" or "none"')
    try:
        check_names(options, (entry.name for entry in fields(sections.SolverSettings)), "option", "correlate")
        return sections.SolverSettings(**options)
    except ConfigurationError as error:
        raise InputError(str(error)) from None


def initial_displacement(initial: npt.ArrayLike | None, nodes: int) -> FloatArray | None:
    """Return an initial guess as an array, or None where none is given.

    Parameters
    ----------
    initial : array_like, shape (2,) or (N, 2), optional
        Displacement (u, v) in px.
    nodes
        Number N of nodes of the mesh.

    Returns
    -------
    ndarray, shape (N, 2), or None

    Raises
    ------
    InputError
        Not (2,) or (N, 2), or not finite.
    """
    if initial is None:
        return None
    try:
        values = np.asarray(initial, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"initial must be numbers (u, v) in px; given is {initial!r}") from None
    if values.shape not in ((2,), (nodes, 2)) or not np.isfinite(values).all():
        raise InputError(f"initial must be finite with shape (2,) or ({nodes}, 2); given is shape {values.shape}")
    return np.broadcast_to(values, (nodes, 2)).copy()


def measure_sequence(
    states: Iterable[Any],
    settings: TestSettings | None = None,
    *,
    reference: Any = None,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    statistics: bool = True,
    update_reference: bool = False,
    separation: LightSeparation | None = None,
    weights: LightWeights | npt.ArrayLike | None = None,
    mesh: Tri3Mesh | None = None,
    **options: Unpack[SolverOptions],
) -> Iterator[Solution]:
    """Measure states one by one, each as soon as it is available: from a list, a generator, a camera.

    Every solution is identical, bit for bit, to that of `rgbmidic.measure` for the same frames. Only the reference and
    a few initial guesses are kept between states, whatever their number. To write a result folder, pass the frames to
    `rgbmidic.measure` as `source`.

    Parameters
    ----------
    states
        Without `settings` arrays (H, W) or (k, H, W), one image per light, NaN or masked where not valid, or
        `IlluminationImages`.
        With `settings` anything that a frame source may return (`rgbmidic.pipeline.FrameSequence`), such as raw frames.
    settings
        Settings of a test, with ``frames.path = []``; they replace `region`, `element_size`,
        `statistics`, `update_reference` and the `options`.
    reference
        The reference state; None: the first of the `states`, which is measured like the others.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    statistics
        Weight every light by the inverse variance of its own residual around each pixel, robustly.
    update_reference
        Whether a later state becomes the reference when the correlation with the present one is low.
    separation, mesh
        As in `rgbmidic.measure`.
    weights
        As in `rgbmidic.measure`; or an array (k, H, W) from 0 to 1 that applies to every state.
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults.

    Yields
    ------
    Solution
        One for each state, relative to the reference. A state that cannot be measured, because of an unexpected error
        in a given object, too, is `Status.FAILED` with its reason; the next states are measured.

    Raises
    ------
    RgbmidicError
        The settings contradict themselves or the objects, or the reference is not usable.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> speckle = 1000 + 3000 * gaussian_filter(np.random.default_rng(0).normal(size=(80, 80)), 1.5)
    >>> states = (np.roll(speckle, frame, axis=1) for frame in range(3))
    >>> solutions = measure_sequence(states, element_size=40)
    >>> [round(float(np.nanmedian(solution.displacement[:, 0])), 2) for solution in solutions]
    [0.0, 1.0, 2.0]
    """
    check_type("settings", settings, TestSettings | None, "a TestSettings")
    if not np.iterable(states):
        raise InputError(f"the states are images, one after the other, not {states!r}")
    remaining = iter(states)
    reference_in_states = reference is None
    if reference_in_states and (reference := next(remaining, None)) is None:
        raise InputError("there is no state to measure: the sequence is empty")
    latest = _LatestFrameSource(reference=reference, light_images=settings is None)
    mask = region if isinstance(region, Region) else None
    if settings is None:
        if np.ndim(values := getattr(reference, "values", reference)) < 2:
            raise InputError(f"the reference is an image (H, W) or one of each light (k, H, W), not {reference!r}")
        height, width = np.shape(values)[-2:]
        rectangle: Any = (0, 0, width - 1, height - 1) if region is None or mask is not None else region
        corners = tuple(rectangle) if np.iterable(rectangle) else rectangle
        settings = TestSettings(
            frames=sections.FrameSettings(path=(), update_reference=update_reference),
            region=sections.RegionSettings(rectangle=corners),
            mesh=sections.MeshSettings(element_size=element_size),
            weights=sections.WeightSettings(method="statistics" if statistics else "none"),
            solver=solver_settings(options),
        )
    elif options or region is not None:
        option_names = ", ".join([*options, *(["region"] if region is not None else [])])
        raise InputError(f"settings are given: state in them what {option_names} says")
    if settings.weights.threshold == "auto":
        raise InputError('weights.threshold = "auto" looks at the first deformed frame, which a sequence has not yet')
    counted: Any = weights if weights is None or hasattr(weights, "deformed") else MaskWeights(cast(Any, weights))
    frames = replace(settings.frames, reference=(0,), first=0 if reference_in_states else 1, last=None, step=1)
    plan = Plan.from_settings(
        replace(settings, frames=frames), source=latest, separation=separation, weights=counted, mesh=mesh, region=mask
    )
    return _solutions(plan, latest, chain([reference], remaining) if reference_in_states else remaining)


@dataclass(slots=True)
class _LatestFrameSource:
    """A frame source of the reference, frame 0, and of the latest state, whatever its number."""

    reference: Any
    light_images: bool
    state: Any = None

    def __len__(self) -> int:
        return sys.maxsize

    def __getitem__(self, index: int) -> Any:
        state = self.state if index else self.reference
        if not self.light_images or hasattr(state, "values"):
            return state
        images = unmasked(state)
        if images.dtype.kind not in "uif":
            raise FrameError(f"a state must be an array of real numbers or IlluminationImages, not {images.dtype}")
        return images.astype(np.float32)


def _solutions(plan: Plan, latest: _LatestFrameSource, states: Iterable[Any]) -> Iterator[Solution]:
    """The solution of each state, in the order and with the second tries of `Schedule`."""
    sink = _SequenceSink(plan)
    schedule, worker = Schedule(plan, sink), Threads(plan, 1)
    for position, latest.state in enumerate(states):
        schedule.want(position)
        schedule.run(worker)
        yield sink.solution


class _SequenceSink:
    """The sink of a sequence: the latest solution, and of all states before it what a later one may start from."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._starts, self._checksum = plan, dict[int, TrackingState](), NO_CHECKSUM
        self._of_reference = set[int]()
        self._updates: dict[tuple[int, ...], ReferenceUpdate] = {(): ReferenceUpdate.none(plan.reference)}
        self.solution: Solution

    def is_finished(self, position: int) -> bool:
        """Return whether the start of a state is kept."""
        return position in self._starts

    def start_after(self, position: int) -> TrackingState:
        """Initial guess of the states that follow one."""
        return self._starts[position]

    def updated(self, positions: Sequence[int]) -> ReferenceUpdate:
        """The reference that states made, while they were there."""
        return self._updates[tuple(positions)]

    def keep(self, position: int, outcome: Outcome, initial_guess: TrackingState) -> None:
        """Take a state's solution, and forget what no later state starts from."""
        plan, (record, solution) = self._plan, outcome
        mesh, lights = plan.reference.mesh, len(plan.images.names)
        self.solution = solution or Solution.failed(mesh, lights, record.reason, np.zeros(0))
        checksum = record.values["checksum"]
        if checksum == self._checksum != NO_CHECKSUM:
            logger.warning("state %d repeats the one before, bit for bit", position)
        elif plan.series.selected[position] in plan.settings.frames.reference:
            self._of_reference.add(checksum)
        elif checksum in self._of_reference - {NO_CHECKSUM}:
            logger.warning("state %d is the reference, bit for bit: its displacement of 0 is not measured", position)
        self._checksum = checksum
        for text in messages(record.values):
            logger.warning("state %d: %s", position, text)
        self._starts[position] = initial_guess
        if (last := initial_guess.reference_updates[-1:]) not in self._updates:
            self._updates[last] = next_reference(plan, self._updates[()], position, self.solution)
        # a later state starts from this one, from the first, or from the last at a multiple of a power of STRIDE
        needed = {position // STRIDE**power * STRIDE**power for power in range(20)}
        self._starts = {item: start for item, start in self._starts.items() if item in needed}
        needed_updates = {(), *(start.reference_updates[-1:] for start in self._starts.values())}
        self._updates = {frames: item for frames, item in self._updates.items() if frames in needed_updates}
