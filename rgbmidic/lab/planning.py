"""Planning a test before a lamp is mounted: where the reflections fall, what can be measured, better places for lamps.

Everything follows from a SCENE.toml: its reflection zones (`rgbmidic.scene.zones`) and the uncertainty in closed form
(`rgbmidic.scene.forecast`). Nothing is rendered.

Better places: the directions of the lamps are chosen anew, each at its own distance from the specimen. The reflection
zones should not overlap in any state and should lie outside the field as far as the light can afford to fall
obliquely; the colour that measures best (of a Bayer camera green, with two samples in four) deserves the light
that reflects least. All three follow from one cost: the uncertainty over field and states if every light counted by
the fourth power of its diffuse fraction, the weighting of a user who trusts no reflection.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import permutations

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.scene.camera import Light
from rgbmidic.scene.forecast import Forecast, Instrument, trace_change
from rgbmidic.scene.scene import Experiment, Scene, State
from rgbmidic.scene.zones import REFLECTS, Zones, material_points, predict_zones, region_in_view, truth
from rgbmidic.settings import IlluminationSettings
from rgbmidic.typing import BoolArray, FloatArray

AZIMUTH_STEP = 15.0
"""Degrees about the optical axis between the directions that are tried."""
INCLINATIONS = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0)
"""Degrees from the optical axis: not before the lens, not so oblique that wrinkles throw shadows."""
APART = 20.0
"""Least angle (degrees) between two lamps, seen from the specimen."""
_POINTS = 300
"""Points of the field at which lamps are compared; chosen for the time that it takes."""
_STATES = 6
"""States at which they are compared; chosen for the time that it takes."""
_DIFFUSE_POWER = 4
"""Power of the diffuse fraction in the cost (see above); chosen."""
_WORTHWHILE = 1.02
"""Gain from which lamps are moved; chosen: less is not worth mounting."""
_AFFORDABLE = 1.2
"""Largest growth of the expected uncertainty for lamps that are moved, which then stand more obliquely: a reflection
that hardly adds to the uncertainty need not be avoided at any price; chosen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Proposal:
    """Lamps that would stand better.

    Attributes
    ----------
    plan
        Zones and uncertainty with them.
    gain
        Cost of the present lamps over theirs; 1 where nothing better was found.
    """

    plan: Plan
    gain: float

    @property
    def lights(self) -> tuple[Light, ...]:
        """The lights with their new positions."""
        return self.plan.scene.lights


def propose_colours(plan: Plan) -> Proposal:
    """Return the present lamp directions with the colours exchanged for the best."""
    compared = _Compared.of(plan, _directions(plan.scene))
    orders = permutations(range(len(plan.scene.lights)))
    return compared.proposal(plan, min(orders, key=compared.cost), affordable=1.0)


def propose_lamps(plan: Plan) -> Proposal:
    """Return the best directions of a grid over azimuth and inclination, with the best colour for each."""
    present = _directions(plan.scene)
    compared = _Compared.of(plan, np.concatenate([present, _grid()]))
    orders = list(permutations(range(len(present))))
    guesses = sorted(orders, key=compared.cost)[:2] + [compared.greedy(order) for order in orders[:6]]
    return compared.proposal(plan, min(map(compared.descend, guesses), key=compared.cost), _AFFORDABLE)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Compared:
    """Directions with the information that each light would give from each.

    `information` (k, directions, states, points); `directions` (directions, 3), unit vectors from the specimen.
    """

    directions: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, plan: Plan, directions: FloatArray) -> _Compared:
        scene, instrument = plan.scene, plan.instrument
        rows, columns = np.nonzero(plan.inside)
        some = slice(None, None, max(1, rows.size // _POINTS))
        pixels = plan.x[rows[some], columns[some]], plan.y[rows[some], columns[some]]
        material = material_points(scene, None, pixels)
        index = np.unique(np.linspace(0, len(plan.outlooks) - 1, _STATES).round().astype(int))
        states = [plan.outlooks[i].state for i in index]
        brightness = np.nan_to_num(np.nanmean(plan.reference.level[:, plan.inside], axis=1))
        information = []
        for light, lamp in enumerate(scene.lights):
            candidates = tuple(_placed(lamp, scene, direction) for direction in directions)
            before, *after = (_zones(scene, candidates, light, material, state) for state in (State(), *states))
            clear = [_clear(instrument, light, before, one, brightness) for one in after]
            information.append(np.stack(clear, axis=1))
        return cls(directions=directions, information=np.stack(information))

    def cost(self, choice: Iterable[int]) -> float:
        """Root mean square uncertainty, in units of its own, of one direction per light."""
        total = sum(self.information[light, place] for light, place in enumerate(choice))
        return float(np.sqrt(np.mean(1 / np.maximum(total, 1e-9))))

    def allowed(self, light: int, choice: tuple[int, ...]) -> list[int]:
        """Directions for a light that keep clear of the other lights' chosen ones."""
        others = [place for other, place in enumerate(choice) if other != light]
        near = self.directions @ self.directions[others].T > np.cos(np.radians(APART))
        return [int(place) for place in np.flatnonzero(~near.any(axis=1))]

    def greedy(self, order: tuple[int, ...]) -> tuple[int, ...]:
        """One light after the other where it adds most."""
        choice: dict[int, int] = {}
        for light in order:
            taken = [self.directions[place] for place in choice.values()]
            total = sum((self.information[other, place] for other, place in choice.items()), np.zeros(1))
            costs = np.mean(1 / np.maximum(total + self.information[light], 1e-9), axis=(1, 2))
            for direction in taken:
                costs[self.directions @ direction > np.cos(np.radians(APART))] = np.inf
            choice[light] = int(costs.argmin())
        return tuple(choice[light] for light in range(len(self.information)))

    def descend(self, choice: tuple[int, ...]) -> tuple[int, ...]:
        """Move one light at a time to its best direction until none gains."""
        while True:
            before = self.cost(choice)
            for light in range(len(choice)):
                trials = [(*choice[:light], place, *choice[light + 1 :]) for place in self.allowed(light, choice)]
                choice = min([choice, *trials], key=self.cost)
            if not self.cost(choice) < before * (1 - 1e-6):
                return choice

    def proposal(self, plan: Plan, choice: tuple[int, ...], affordable: float) -> Proposal:
        """Return the plan with the lights in the chosen directions, if that gains.

        The uncertainty must not grow by more than the factor `affordable`.
        """
        gain = self.cost(range(len(choice))) / self.cost(choice)
        if gain < _WORTHWHILE:
            return Proposal(plan=plan, gain=1.0)
        scene, chosen = plan.scene, self.directions[list(choice)]
        lights = tuple(_placed(light, scene, direction) for light, direction in zip(scene.lights, chosen, strict=True))
        better = plan.with_lamps(replace(scene, lights=lights))
        if better.std > affordable * plan.std:
            return Proposal(plan=plan, gain=1.0)
        return Proposal(plan=better, gain=gain)


def _zones(scene: Scene, candidates: tuple[Light, ...], light: int, material: FloatArray, state: State) -> Zones:
    """Zones of one light from many places; `light` is its index, for its colour."""
    camera = replace(scene.camera, crosstalk=None, sensitivities=None)
    alone = replace(scene, lights=(scene.lights[light],), camera=camera)
    zones = predict_zones(alone, state, material=material, lights=candidates)
    response = scene.camera.response(scene.lights).max(axis=0)[light]
    return replace(zones, irradiance=zones.irradiance * response)


def _clear(instrument: Instrument, light: int, before: Zones, after: Zones, brightness: FloatArray) -> FloatArray:
    """Inverse variance (directions, points) of the pull of a light, times the fourth power of its diffuse fraction."""
    variance = instrument.light_variance(light, before, after, brightness)
    with np.errstate(invalid="ignore"):
        clear = (1 - np.fmax(before.fraction, after.fraction)) ** _DIFFUSE_POWER / variance
    full = instrument.scene.camera.full_scale
    for zones in (before, after):
        with np.errstate(invalid="ignore"):
            clear = np.where(instrument.white_level(zones) < full, clear, 0.0)
    return np.nan_to_num(clear)


def _directions(scene: Scene) -> FloatArray:
    """Return unit vectors (k, 3) from the body's front point to the lamps."""
    towards = np.array([light.position for light in scene.lights]) - scene.body.front
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _grid() -> FloatArray:
    azimuth, inclination = np.radians(
        np.meshgrid(np.arange(0, 360, AZIMUTH_STEP), np.array(INCLINATIONS), indexing="ij")
    ).reshape(2, -1)
    across = np.sin(inclination)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), -np.cos(inclination)], axis=1)


def _placed(light: Light, scene: Scene, direction: FloatArray) -> Light:
    """Return the light at its distance from the body's front point, in another direction."""
    front = np.array(scene.body.front)
    distance = np.linalg.norm(np.array(light.position) - front)
    x, y, z = (front + distance * direction).tolist()
    return replace(light, position=(x, y, z))


_PLAN_POINTS = 80
"""Points of the prediction along the longer side of the frame; chosen: zones are far wider than a step."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlook:
    """Zones and uncertainty expected in one state, at points of the reference image; NaN where the body is not seen.

    Attributes
    ----------
    state
        The deformed state.
    zones
        Prediction in this state at the material points of the reference image.
    displacement : ndarray, shape (2, h, w)
        px.
    reflects : ndarray, shape (k, h, w), bool
        Whether the light's specular fraction exceeds `rgbmidic.scene.zones.REFLECTS` in the reference or in this state.
    lit : ndarray, shape (k, h, w), bool
        Whether the light reaches the point in both.
    saturated : ndarray, shape (k, h, w), bool
        Whether white paint saturates in either.
    forecast
        Uncertainty of a node there.
    """

    state: State
    zones: Zones
    displacement: FloatArray
    reflects: BoolArray
    lit: BoolArray
    saturated: BoolArray
    forecast: Forecast

    @property
    def clean(self) -> npt.NDArray[np.int64]:
        """Number of lights (h, w) that are there and do not reflect."""
        return np.asarray((self.lit & ~self.saturated & ~self.reflects).sum(axis=0))

    @property
    def std(self) -> FloatArray:
        """Standard uncertainty (h, w) of u, and of v, in px: noise and reflections."""
        return np.hypot(self.forecast.std, self.forecast.bias)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A scene with the outlook of each of its states.

    Attributes
    ----------
    scene
        Lamps, camera, paint and body.
    instrument
        Camera, paint and processing, reduced for the forecast.
    field
        (x0, y0, x1, y1) in px of the reference image: the region to be measured.
    x, y : ndarray, shape (h, w)
        Points (px) of the reference image at which everything is predicted.
    inside : ndarray, shape (h, w), bool
        Those in the field.
    reference
        Zones of the reference state at these points.
    outlooks
        One for each state of the scene.
    """

    scene: Scene
    instrument: Instrument
    field: tuple[float, float, float, float]
    x: FloatArray
    y: FloatArray
    inside: BoolArray
    reference: Zones
    outlooks: tuple[Outlook, ...]

    def with_lamps(self, scene: Scene) -> Plan:
        """Return the same plan with a scene whose lamps stand elsewhere."""
        reference, outlooks = _predict(scene, self.instrument, self.x, self.y, [o.state for o in self.outlooks])
        return replace(self, scene=scene, reference=reference, outlooks=outlooks)

    def fraction(self, mask: BoolArray) -> float:
        """Fraction of the field on which a mask (h, w) holds."""
        return float(mask[self.inside].mean())

    @property
    def std(self) -> float:
        """Root mean square, over field and states, of the standard uncertainty (px); infinite where nothing is seen."""
        values = np.stack([outlook.std[self.inside] for outlook in self.outlooks])
        return float(np.sqrt(np.mean(np.where(np.isfinite(values), values, np.inf) ** 2)))


def make_plan(experiment: Experiment) -> Plan:
    """Predict every state of a scene.

    Parameters
    ----------
    experiment
        From `rgbmidic.scene.scene.read_scene`; without states, the body at rest is compared with itself.

    Raises
    ------
    InputError
        The field does not lie on the body in every state.

    Returns
    -------
    Plan
    """
    scene = experiment.scene
    states = list(experiment.states) or [State()]
    instrument = Instrument.of(
        scene, element_size=experiment.output.element_size, demosaic=IlluminationSettings().demosaic
    )
    height, width = scene.camera.shape
    step = max(height, width) / _PLAN_POINTS
    x, y = np.meshgrid(np.arange(0, width - 0.5, step), np.arange(0, height - 0.5, step))
    reference, outlooks = _predict(scene, instrument, x, y, states)
    motion = np.stack([outlook.displacement for outlook in outlooks])
    field = experiment.output.region or region_in_view(x, y, motion, scene.camera.shape)
    inside = (x >= field[0]) & (y >= field[1]) & (x <= field[2]) & (y <= field[3])
    if not inside.any() or not np.isfinite(motion[:, :, inside]).all():
        raise InputError(f"the field {list(field)} px does not lie on the body in every state")
    return Plan(
        scene=scene,
        instrument=instrument,
        field=field,
        x=x,
        y=y,
        inside=inside,
        reference=reference,
        outlooks=outlooks,
    )


def _predict(
    scene: Scene, instrument: Instrument, x: FloatArray, y: FloatArray, states: list[State]
) -> tuple[Zones, tuple[Outlook, ...]]:
    """Zones at rest, and the outlook of every state, at points x, y (h, w) of a square grid (px)."""
    material = material_points(scene, None, (x, y))
    reference = predict_zones(scene, material=material)
    reach = instrument.element_size / float(x[0, 1] - x[0, 0])
    outlooks = []
    for state in states:
        zones = predict_zones(scene, state, material=material)
        displacement = truth(scene, state, None, (x, y))
        with np.errstate(invalid="ignore"):
            reflects = np.fmax(reference.fraction, zones.fraction) > REFLECTS
        outlooks.append(
            Outlook(
                state=state,
                zones=zones,
                displacement=displacement,
                reflects=reflects,
                lit=np.isfinite(reference.fraction) & np.isfinite(zones.fraction),
                saturated=instrument.saturated(reference) | instrument.saturated(zones),
                forecast=instrument.forecast(reference, zones, _around(trace_change(displacement), reach)),
            )
        )
    return reference, tuple(outlooks)


def _around(values: FloatArray, reach: float) -> FloatArray:
    """Mean (n, h, w) of the known values within about `reach` points: over the elements of a node."""
    known = np.isfinite(values)
    total, weight = (
        np.stack([cv2.GaussianBlur(part, (0, 0), 0.5 * reach) for part in stack])
        for stack in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    return np.where(known, total / np.where(known, weight, 1.0), np.nan)
