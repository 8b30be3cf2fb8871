"""Planning a test before a lamp is mounted: where the reflections fall and what can be measured.

Everything follows from a SCENE.toml: its reflection zones (`rgbmidic.scene.zones`) and the uncertainty in closed form
(`rgbmidic.scene.forecast`). Nothing is rendered.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.scene.forecast import Forecast, Instrument, trace_change
from rgbmidic.scene.scene import Experiment, Scene, State
from rgbmidic.scene.zones import REFLECTS, Zones, material_points, predict_zones, region_in_view, truth
from rgbmidic.settings import IlluminationSettings
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Outlook", "Plan", "make_plan"]

_POINTS = 80
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

    def share(self, mask: BoolArray) -> float:
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
    step = max(height, width) / _POINTS
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
            reflects = np.fmax(reference.share, zones.share) > REFLECTS
        outlooks.append(
            Outlook(
                state=state,
                zones=zones,
                displacement=displacement,
                reflects=reflects,
                lit=np.isfinite(reference.share) & np.isfinite(zones.share),
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
