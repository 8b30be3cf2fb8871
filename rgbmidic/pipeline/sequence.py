"""States of a test one after the other, as a camera gives them: each solution before the next state is asked for.

Initial guesses, tracking and reference updates are those of `rgbmidic.measure`, frame for frame, in constant memory.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Literal, Unpack, cast

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import Solution, Start
from rgbmidic.correlation.images import unmasked
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.errors import FrameError, InputError
from rgbmidic.illumination.separation import LightSeparation
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.correlate import solver_settings
from rgbmidic.pipeline.engine import Schedule, Threads
from rgbmidic.pipeline.frame import Measured, next_reference
from rgbmidic.pipeline.given import check_object, check_type
from rgbmidic.pipeline.order import STRIDE
from rgbmidic.pipeline.plan import Plan
from rgbmidic.results.quantities import NO_CHECKSUM
from rgbmidic.settings import (
    ELEMENT_SIZE,
    FrameSettings,
    IlluminationSettings,
    MeshSettings,
    RegionSettings,
    SolverOptions,
    TestSettings,
    WeightSettings,
)
from rgbmidic.weights import LightWeights, MaskWeights

logger = logging.getLogger(__name__)


def measure_sequence(
    states: Iterable[Any],
    settings: TestSettings | None = None,
    *,
    reference: Any = None,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    normalise: float | Literal["auto"] = "auto",
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
        Settings of a test, with ``frames.path = []``; they replace `region`, `element_size`, `normalise`,
        `statistics`, `update_reference` and the `options`.
    reference
        The reference state; None: the first of the `states`, which is measured like the others.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None: the whole image.
    element_size
        Side of the triangles in px.
    normalise
        Standard deviation in px of the Gaussian of the local mean by which every image is first divided; 0: grey levels
        are not changed; ``"auto"``: 10 px, 30 px if the mesh has cracks.
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
    """
    check_type("settings", settings, TestSettings | None, "a TestSettings")
    remaining = iter(states)
    own = reference is None
    if own:
        try:
            reference = next(remaining)
        except StopIteration:
            raise InputError("there is no state to measure: the sequence is empty") from None
    latest = _Latest(reference=reference, light_images=settings is None)
    mask = region if isinstance(region, Region) else None
    if settings is None:
        height, width = np.shape(getattr(reference, "values", reference))[-2:]
        whole = region is None or isinstance(region, Region)
        corners: Any = (0, 0, width - 1, height - 1) if whole else tuple(cast(Any, region))
        settings = TestSettings(
            frames=FrameSettings(path=(), update_reference=update_reference),
            region=RegionSettings(rectangle=corners),
            mesh=MeshSettings(element_size=element_size),
            illumination=IlluminationSettings(normalise=normalise),
            weights=WeightSettings(method="statistics" if statistics else "none"),
            solver=solver_settings(options),
        )
    elif options or region is not None:
        told = ", ".join([*options, *(["region"] if region is not None else [])])
        raise InputError(f"settings are given: state in them what {told} says")
    if settings.weights.threshold == "auto":
        raise InputError('weights.threshold = "auto" looks at the first deformed frame, which a sequence has not yet')
    check_object("separation", separation, "__call__")
    check_type("mesh", mesh, Tri3Mesh | None, "a Tri3Mesh")
    counted: Any = weights if weights is None or hasattr(weights, "deformed") else MaskWeights(cast(Any, weights))
    frames = replace(settings.frames, reference=(0,), first=0 if own else 1, last=None, step=1)
    plan = Plan.from_settings(
        replace(settings, frames=frames), source=latest, separation=separation, weights=counted, mesh=mesh, region=mask
    )
    return _solutions(plan, latest, chain([reference], remaining) if own else remaining)


@dataclass(slots=True)
class _Latest:
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


def _solutions(plan: Plan, latest: _Latest, states: Iterable[Any]) -> Iterator[Solution]:
    """The solution of each state, in the order and with the second tries of `Schedule`."""
    live = _Live(plan)
    schedule, worker = Schedule(plan, live), Threads(plan, 1)
    for place, latest.state in enumerate(states):
        schedule.want(place)
        schedule.run(worker)
        yield live.solution


class _Live:
    """The sink of a sequence: the latest solution, and of all states before it what a later one may start from."""

    def __init__(self, plan: Plan) -> None:
        self._plan, self._starts, self._checksum = plan, dict[int, Start](), NO_CHECKSUM
        self._updates: dict[tuple[int, ...], ReferenceUpdate] = {(): ReferenceUpdate.none(plan.reference)}
        self.solution: Solution

    def is_finished(self, place: int) -> bool:
        """Whether it is one of those that are kept."""
        return place in self._starts

    def start_after(self, place: int) -> Start:
        """Initial guess of the states that follow one."""
        return self._starts[place]

    def updated(self, places: Sequence[int]) -> ReferenceUpdate:
        """The reference that states made, while they were there."""
        return self._updates[tuple(places)]

    def keep(self, place: int, found: Measured, after: Start) -> None:
        """Take a state's solution, and forget what no later state starts from."""
        plan, record = self._plan, found.record
        mesh, lights = plan.reference.mesh, len(plan.images.names)
        self.solution = found.solution or Solution.failed(mesh, lights, record.reason, np.zeros(0))
        checksum = record.values["checksum"]
        if checksum == self._checksum != NO_CHECKSUM:
            logger.warning("state %d repeats the one before, bit for bit", place)
        self._checksum = checksum
        self._starts[place] = after
        if (frames := after.reference_updates)[-2:] not in self._updates:
            before = self._updates[frames[:-1][-2:]]
            self._updates[frames[-2:]] = next_reference(plan, before, plan.series.chosen[place], self.solution)
        # a later state starts from this one, from the first, or from the last at a multiple of a power of STRIDE
        needed = {place // STRIDE**power * STRIDE**power for power in range(20)}
        self._starts = {one: start for one, start in self._starts.items() if one in needed}
        kept = {(), *(start.reference_updates[-2:] for start in self._starts.values())}
        self._updates = {frames: one for frames, one in self._updates.items() if frames in kept}
