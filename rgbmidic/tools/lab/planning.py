"""Planning a test before a lamp is mounted: where the reflections fall, what can be measured, better places for lamps.

Everything follows from a SCENE.toml: its reflection zones (`rgbmidic.tools.scene.zones`) and the uncertainty in closed
form (`rgbmidic.tools.scene.forecast`). Nothing is rendered.

Better places: the directions of the lamps are chosen anew, each at its own distance from the specimen. The reflection
zones should not overlap in any state and should lie outside the field as far as the light can afford to fall
obliquely; the colour that measures best (of a Bayer camera green, with two samples in four) deserves the light
that reflects least. All three follow from one cost: the uncertainty over field and states if every light counted by
the fourth power of its diffuse fraction, the weighting of a user who trusts no reflection.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import permutations

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.settings import IlluminationSettings
from rgbmidic.tools.scene.camera import Light
from rgbmidic.tools.scene.forecast import Forecast, Instrument, trace_change
from rgbmidic.tools.scene.scene import Experiment, Scene, State
from rgbmidic.tools.scene.zones import (
    REFLECTS,
    Zones,
    material_points,
    predict_zones,
    region_in_view,
    truth,
    unit_vectors,
)
from rgbmidic.typing import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanningConstants:
    """Constants of planning.

    Attributes
    ----------
    grid_points
        Points of the prediction along the longer side of the frame; chosen: zones are far wider than a step.
    n_points, n_states
        Points of the field, and states, at which lamps are compared; chosen for the time that it takes.
    azimuth_step
        Degrees about the optical axis between the directions that are tried.
    inclinations
        Degrees from the optical axis: not before the lens, not so oblique that wrinkles throw shadows.
    min_angle
        Least angle (degrees) between two lamps, seen from the specimen.
    diffuse_power
        Power of the diffuse fraction in the cost; chosen.
    min_gain
        Gain from which lamps are moved; chosen: less is not worth mounting.
    max_std_growth
        Largest growth of the expected uncertainty for lamps that are moved, which then stand more obliquely: a
        reflection that hardly adds to the uncertainty need not be avoided at any price; chosen.
    """

    grid_points: int = 80
    n_points: int = 300
    n_states: int = 6
    azimuth_step: float = 15.0
    inclinations: tuple[float, ...] = (20.0, 25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0, 60.0)
    min_angle: float = 20.0
    diffuse_power: int = 4
    min_gain: float = 1.02
    max_std_growth: float = 1.2


CONSTANTS = PlanningConstants()


def propose_colours(plan: LampPlan) -> LampPlan:
    """Return the present lamp directions with the colours exchanged for the best."""
    search = _Search.of(plan, _directions(plan.scene))
    return search.proposal(plan, min(permutations(range(len(plan.scene.lights))), key=search.cost), max_std_growth=1.0)


def propose_lamps(plan: LampPlan) -> LampPlan:
    """Return the best directions of a grid over azimuth and inclination, with the best colour for each."""
    angles = np.arange(0, 360, CONSTANTS.azimuth_step), np.array(CONSTANTS.inclinations)
    azimuth, inclination = np.radians(np.meshgrid(*angles, indexing="ij")).reshape(2, -1)
    across = np.sin(inclination)
    grid = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), -np.cos(inclination)], axis=1)
    present = _directions(plan.scene)
    search = _Search.of(plan, np.concatenate([present, grid]))
    orders = list(permutations(range(len(present))))
    guesses = sorted(orders, key=search.cost)[:2] + [search.greedy(order) for order in orders[:6]]
    return search.proposal(plan, min(map(search.descend, guesses), key=search.cost), CONSTANTS.max_std_growth)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Search:
    """Directions with the information that each light would give from each.

    `information` (k, directions, states, points); `directions` (directions, 3), unit vectors from the specimen.
    """

    directions: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, plan: LampPlan, directions: FloatArray) -> _Search:
        """Return the search by the inverse variance of each light, times the fourth power of its diffuse fraction."""
        scene = plan.scene
        rows, columns = np.nonzero(plan.inside)
        sample = slice(None, None, max(1, rows.size // CONSTANTS.n_points))
        pixels = plan.x[rows[sample], columns[sample]], plan.y[rows[sample], columns[sample]]
        material = material_points(scene, None, pixels)
        index = np.unique(np.linspace(0, len(plan.outlooks) - 1, CONSTANTS.n_states).round().astype(int))
        brightness = np.nan_to_num(np.nanmean(plan.reference.level[:, plan.inside], axis=1))

        def light_information(light: int, reference: Zones, deformed: Zones) -> FloatArray:
            variance = plan.instrument.light_variance(light, reference, deformed, brightness)
            with np.errstate(invalid="ignore"):
                diffuse = 1 - np.fmax(reference.fraction, deformed.fraction)
                levels = np.fmax(*(plan.instrument.white_level(zones) for zones in (reference, deformed)))
                is_unsaturated = levels < scene.camera.full_scale
                return np.nan_to_num(np.where(is_unsaturated, diffuse**CONSTANTS.diffuse_power / variance, 0.0))

        information = []
        for light, lamp in enumerate(scene.lights):
            # one light in all its places, seen as brightly as the camera sees its colour
            camera = replace(scene.camera, crosstalk=None, sensitivities=None)
            single_light_scene = replace(scene, lights=(lamp,), camera=camera)
            response = scene.camera.response(scene.lights).max(axis=0)[light]
            candidates = tuple(_lamp_in_direction(lamp, scene, direction) for direction in directions)
            predicted = [
                predict_zones(single_light_scene, state, material=material, lights=candidates)
                for state in (State(), *(plan.outlooks[i].state for i in index))
            ]
            reference, *deformed = (replace(zones, irradiance=zones.irradiance * response) for zones in predicted)
            information.append(np.stack([light_information(light, reference, zones) for zones in deformed], axis=1))
        return cls(directions=directions, information=np.stack(information))

    def cost(self, choice: Iterable[int]) -> float:
        """Return the root mean square uncertainty, in units of its own, of one direction per light."""
        total = sum(self.information[light, direction] for light, direction in enumerate(choice))
        return float(np.sqrt(np.mean(1 / np.maximum(total, 1e-9))))

    def best(self, light: int, fixed: Mapping[int, int]) -> int:
        """Return direction in which a light adds most to `fixed` (light to direction), at an angle from all of them."""
        total = self.information[light] + sum(
            self.information[fixed_light, direction] for fixed_light, direction in fixed.items()
        )
        costs = np.mean(1 / np.maximum(total, 1e-9), axis=(1, 2))
        near = self.directions @ self.directions[list(fixed.values())].T > np.cos(np.radians(CONSTANTS.min_angle))
        return int(np.where(near.any(axis=1), np.inf, costs).argmin())

    def greedy(self, order: tuple[int, ...]) -> tuple[int, ...]:
        """Return one light after the other where it adds most."""
        choice: dict[int, int] = {}
        for light in order:
            choice[light] = self.best(light, choice)
        return tuple(choice[light] for light in sorted(choice))

    def descend(self, choice: tuple[int, ...]) -> tuple[int, ...]:
        """Move one light at a time to its best direction until none gains."""
        while True:
            previous_cost = self.cost(choice)
            for light in range(len(choice)):
                fixed = {fixed_light: direction for fixed_light, direction in enumerate(choice) if fixed_light != light}
                candidate = (*choice[:light], self.best(light, fixed), *choice[light + 1 :])
                choice = min(choice, candidate, key=self.cost)
            if not self.cost(choice) < previous_cost * (1 - 1e-6):
                return choice

    def proposal(self, plan: LampPlan, choice: tuple[int, ...], max_std_growth: float) -> LampPlan:
        """Return the plan with the lights in the chosen directions, if that gains.

        The uncertainty must not grow by more than the factor `max_std_growth`.
        """
        gain = self.cost(range(len(choice))) / self.cost(choice)
        if gain >= CONSTANTS.min_gain:
            scene, directions = plan.scene, self.directions[list(choice)]
            lights = tuple(
                _lamp_in_direction(lamp, scene, direction)
                for lamp, direction in zip(scene.lights, directions, strict=True)
            )
            scene = replace(scene, lights=lights)
            states = [outlook.state for outlook in plan.outlooks]
            reference, outlooks = _predict(scene, plan.instrument, plan.x, plan.y, states)
            proposed = replace(plan, scene=scene, reference=reference, outlooks=outlooks, gain=gain)
            if proposed.std <= max_std_growth * plan.std:
                return proposed
        return plan


def _directions(scene: Scene) -> FloatArray:
    """Return unit vectors (k, 3) from the body's front point to the lamps."""
    return unit_vectors(np.array([light.position for light in scene.lights]) - scene.body.front, axis=1)


def _lamp_in_direction(light: Light, scene: Scene, direction: FloatArray) -> Light:
    """Return the light at its distance from the body's front point, in another direction."""
    front = np.array(scene.body.front)
    position = front + np.linalg.norm(np.array(light.position) - front) * direction
    return replace(light, position=position.tolist())


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
        Whether the light's specular fraction exceeds `rgbmidic.tools.scene.zones.REFLECTS` in the reference or in this
        state.
    clean : ndarray, shape (h, w), int
        Number of lights that reach the point in both and do not reflect.
    saturated : ndarray, shape (k, h, w), bool
        Whether white paint saturates in either.
    forecast
        Uncertainty of a node there.
    """

    state: State
    zones: Zones
    displacement: FloatArray
    reflects: BoolArray
    clean: npt.NDArray[np.int64]
    saturated: BoolArray
    forecast: Forecast

    @property
    def std(self) -> FloatArray:
        """Standard uncertainty (h, w) of u, and of v, in px: noise and reflections."""
        return np.hypot(self.forecast.std, self.forecast.bias)


@dataclass(frozen=True, slots=True, kw_only=True)
class LampPlan:
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
    gain
        Cost of the present lamps over that of these, where they are proposed instead; else 1.
    """

    scene: Scene
    instrument: Instrument
    field: tuple[float, float, float, float]
    x: FloatArray
    y: FloatArray
    inside: BoolArray
    reference: Zones
    outlooks: tuple[Outlook, ...]
    gain: float = 1.0

    def fraction(self, mask: BoolArray) -> float:
        """Return the fraction of the field on which a mask (h, w) holds."""
        return float(mask[self.inside].mean())

    @property
    def std(self) -> float:
        """Root mean square, over field and states, of the standard uncertainty (px); infinite where nothing is seen."""
        values = np.stack([outlook.std[self.inside] for outlook in self.outlooks])
        return float(np.sqrt(np.mean(np.where(np.isfinite(values), values, np.inf) ** 2)))


def make_plan(experiment: Experiment) -> LampPlan:
    """Predict every state of a scene.

    Parameters
    ----------
    experiment
        From `rgbmidic.tools.scene.scene.read_scene`; without states, the body at rest is compared with itself.

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
    step = max(height, width) / CONSTANTS.grid_points
    x, y = np.meshgrid(np.arange(0, width - 0.5, step), np.arange(0, height - 0.5, step))
    reference, outlooks = _predict(scene, instrument, x, y, states)
    motion = np.stack([outlook.displacement for outlook in outlooks])
    field = experiment.output.region or region_in_view(x, y, motion, scene.camera.shape)
    inside = (x >= field[0]) & (y >= field[1]) & (x <= field[2]) & (y <= field[3])
    if not inside.any() or not np.isfinite(motion[:, :, inside]).all():
        raise InputError(f"the field {list(field)} px does not lie on the body in every state")
    return LampPlan(
        scene=scene, instrument=instrument, field=field, x=x, y=y, inside=inside, reference=reference, outlooks=outlooks
    )


def _predict(
    scene: Scene, instrument: Instrument, x: FloatArray, y: FloatArray, states: list[State]
) -> tuple[Zones, tuple[Outlook, ...]]:
    """Return the zones at rest, and the outlook of every state, at points x, y (h, w) of a square grid (px)."""
    material = material_points(scene, None, (x, y))
    reference = predict_zones(scene, material=material)
    radius = instrument.element_size / float(x[0, 1] - x[0, 0])
    outlooks = []
    for state in states:
        zones = predict_zones(scene, state, material=material)
        displacement = truth(scene, state, None, (x, y))
        with np.errstate(invalid="ignore"):
            reflects = np.fmax(reference.fraction, zones.fraction) > REFLECTS
        saturated = instrument.is_saturated(reference) | instrument.is_saturated(zones)
        clean = np.isfinite(reference.fraction + zones.fraction) & ~saturated & ~reflects
        outlooks.append(
            Outlook(
                state=state,
                zones=zones,
                displacement=displacement,
                reflects=reflects,
                clean=clean.sum(axis=0),
                saturated=saturated,
                forecast=instrument.forecast(reference, zones, nodal_mean(trace_change(displacement), radius)),
            )
        )
    return reference, tuple(outlooks)


def nodal_mean(values: FloatArray, radius: float) -> FloatArray:
    """Return the mean (n, h, w) of the known values within about `radius` points: over the elements of a node."""
    is_finite = np.isfinite(values)
    total, weight = (
        np.stack([cv2.GaussianBlur(layer, (0, 0), 0.5 * radius) for layer in stack])
        for stack in (np.where(is_finite, values, 0.0), is_finite.astype(np.float64))
    )
    return np.where(is_finite, total / np.where(is_finite, weight, 1.0), np.nan)
