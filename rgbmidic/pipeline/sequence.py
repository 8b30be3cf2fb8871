"""States one after the other, as a camera gives them: solutions as they come, in constant memory.

Starts, tracking and reference updates are those of `rgbmidic.pipeline.measure`, frame for frame: what changes is who
waits for whom.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from rgbmidic.correlation import Solution, Start
from rgbmidic.correlation.correlate import solver_settings
from rgbmidic.correlation.reference_update import ReferenceUpdate
from rgbmidic.errors import InputError, RgbmidicError
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline.frame import next_reference, solve_frame
from rgbmidic.pipeline.plan import Plan
from rgbmidic.pipeline.schedule import STRIDE, is_key, loses, parent, rank
from rgbmidic.pipeline.separation import LightSeparation
from rgbmidic.settings import (
    ELEMENT_SIZE,
    FrameSettings,
    IlluminationSettings,
    RegionSettings,
    TestSettings,
    WeightSettings,
)
from rgbmidic.weights import LightWeights, MaskWeights

__all__ = ["measure_sequence"]

logger = logging.getLogger(__name__)


def measure_sequence(
    states: Iterable[Any],
    settings: TestSettings | None = None,
    *,
    reference: Any = None,
    region: Sequence[float] | Region | None = None,
    element_size: float = ELEMENT_SIZE,
    normalise: float = 10.0,
    statistics: bool = True,
    update_reference: bool = False,
    separation: LightSeparation | None = None,
    weights: LightWeights | npt.ArrayLike | None = None,
    mesh: Tri3Mesh | None = None,
    **options: Any,
) -> Iterator[Solution]:
    """Measure states one after the other, each as soon as it is there: a list, a generator, a camera.

    Every solution is, bit for bit, that which `rgbmidic.measure` writes for the same frames; what is kept between them
    is the reference and a few starts, whatever the number of states. For a result folder give `rgbmidic.measure` the
    frames as its `source`.

    Parameters
    ----------
    states
        Without `settings` arrays (H, W) or (k, H, W), one image per light, NaN where not valid, or
        `IlluminationImages`.
        With `settings` whatever a frame source may give (`rgbmidic.pipeline.FrameSequence`), such as raw frames.
    settings
        What TEST.toml says, with ``frames.path = []``; it takes the place of `region`, `element_size`, `normalise`,
        `statistics`, `update_reference` and the `options`.
    reference
        The reference state; None: the first of the `states`, which is measured like the others.
    region
        Rectangle (x0, y0, x1, y1) in px, or a `rgbmidic.mesh.Region`; None takes the whole image.
    element_size
        Side of the triangles in px.
    normalise
        Standard deviation in px of the local mean by which every image is divided first; 0 leaves grey levels.
    statistics
        Weight every light by the inverse variance of its own residual around each pixel, robustly.
    update_reference
        Whether a later state becomes the reference where the match with the one before no longer serves.
    separation, mesh
        As in `rgbmidic.measure`.
    weights
        As in `rgbmidic.measure`; or an array (k, H, W) from 0 to 1 that holds in every state.
    **options
        Fields of `rgbmidic.settings.SolverSettings` and their defaults.

    Yields
    ------
    Solution
        Of each state on the reference. One that cannot be measured is `Status.FAILED` with its reason; the next states
        go on.

    Raises
    ------
    RgbmidicError
        The settings contradict themselves or the objects, or the reference is not usable.
    """
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
        corners: Any = (0, 0, width - 1, height - 1)
        if region is not None and not isinstance(region, Region):
            corners = tuple(region)
        settings = TestSettings(
            frames=FrameSettings(path=(), update_reference=update_reference),
            region=RegionSettings(rectangle=corners),
            element_size=element_size,
            illumination=IlluminationSettings(normalise=normalise),
            weights=WeightSettings(method="statistics" if statistics else "none"),
            solver=solver_settings(options),
        )
    elif options or region is not None:
        told = ", ".join([*options, *(["region"] if region is not None else [])])
        raise InputError(f"settings are given: state in them what {told} says")
    if settings.weights.threshold == "auto":
        raise InputError('weights.threshold = "auto" looks at the first deformed frame, which a sequence has not yet')
    counted: Any = weights if weights is None or hasattr(weights, "deformed") else MaskWeights(cast(Any, weights))
    frames = replace(settings.frames, reference=(0,), first=0 if own else 1, last=None, step=1)
    plan = Plan.from_settings(
        replace(settings, frames=frames), source=latest, separation=separation, weights=counted, mesh=mesh, region=mask
    )
    return _solutions(plan, latest, _with_first(reference, remaining) if own else remaining)


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
        if self.light_images and not hasattr(state, "values"):
            return np.asarray(state, dtype=np.float32)
        return state


def _with_first(first: Any, remaining: Iterator[Any]) -> Iterator[Any]:
    yield first
    yield from remaining


def _solutions(plan: Plan, latest: _Latest, states: Iterable[Any]) -> Iterator[Solution]:
    """The solution of each state, from the starts and with the second tries of `Schedule`."""
    starts: dict[int, Start] = {}
    updates: dict[tuple[int, ...], ReferenceUpdate] = {(): ReferenceUpdate.none(plan.reference)}
    for position, latest.state in enumerate(states):
        index, before = plan.series.chosen[position], parent(position)
        start = Start(displacement=None) if before is None else starts[before]
        found, after = _solved(plan, index, start, updates, key=is_key(position))
        if is_key(position) and loses(found, start):
            closer = starts[position - 1]
            again, after_again = _solved(plan, index, closer, updates, key=True)
            if rank(again) < rank(found):
                found, after, start = again, after_again, closer
            elif not found.measured.any():
                after = closer
        if (frames := after.reference_updates[-2:]) not in updates:
            updates[frames] = next_reference(plan, updates[start.reference_updates[-2:]], index, found)
        starts[position] = after
        # a later state starts from this one, from the first, or from the last at a multiple of a power of STRIDE
        needed, step = {0, position}, STRIDE
        while step <= position:
            needed.add(position // step * step)
            step *= STRIDE
        starts = {place: one for place, one in starts.items() if place in needed}
        kept = {(), *(one.reference_updates[-2:] for one in starts.values())}
        updates = {frames: one for frames, one in updates.items() if frames in kept}
        yield found


def _solved(
    plan: Plan, index: int, start: Start, updates: dict[tuple[int, ...], ReferenceUpdate], *, key: bool
) -> tuple[Solution, Start]:
    """The solution of the latest state from a start, and where the one after it starts."""
    try:
        given = replace(start, unmeasured=0.0) if key else start
        values = solve_frame(plan, index, given, updates[start.reference_updates[-2:]])
    except RgbmidicError as error:
        logger.warning("%s failed: %s", plan.series.name(index), error)
        mesh, lights = plan.reference.mesh, len(plan.images.names)
        return Solution.failed(mesh, lights, str(error), np.zeros(0)), start
    solution: Solution = values["solution"]
    if not solution.measured.any():
        return solution, start
    after = start.after(plan.reference.mesh, solution.displacement, solution.measured)
    best = float(np.float32(values["best_match"]))  # as a result keeps it
    return solution, replace(after, reference_updates=values["reference_updates"], best_match=best)
