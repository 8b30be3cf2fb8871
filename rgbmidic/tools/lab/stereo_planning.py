"""The uncertainty that two cameras leave in shape and motion, before a test, against the angle between them.

Either camera's uncertainty at a point is that of the plan (`rgbmidic.tools.scene.forecast`), and so is that of the
match of both reference states, which sees the reflections elsewhere in each camera; the triangulation carries them into
space. Nothing is rendered or solved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rgbmidic.tools.lab import format_number
from rgbmidic.tools.lab.planning import LampPlan, nodal_mean
from rgbmidic.tools.lab.virtual.view_point import ViewPoint, true_pair
from rgbmidic.tools.scene.camera import SecondCamera
from rgbmidic.tools.scene.forecast import Instrument, trace_change
from rgbmidic.tools.scene.scene import State
from rgbmidic.tools.scene.zones import Zones, material_points, points_and_normals, predict_zones
from rgbmidic.tools.stereo import Axes, CameraPair, triangulate
from rgbmidic.typing import FloatArray

ANGLES = (10.0, 15.0, 22.0, 30.0, 40.0, 50.0)
"""Angles (degrees) at which the table has the uncertainty, beside that of the scene (chosen)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoOutlook:
    """Uncertainty to expect of two cameras, in the axes of the mean plane.

    Attributes
    ----------
    angle_deg
        Angle between the cameras.
    shape_std : ndarray, shape (3,)
        Standard uncertainty of x, y, z of the surface, mm, rms over the points that both cameras see.
    std : ndarray, shape (T, 3)
        The same of u, v, w in every state; NaN where no point is seen.
    seen : ndarray, shape (T,)
        Fraction of the field that both cameras see in the reference and in the state.
    """

    angle_deg: float
    shape_std: FloatArray
    std: FloatArray
    seen: FloatArray


def stereo_outlooks(plan: LampPlan, second: SecondCamera, angles: Sequence[float] = ANGLES) -> list[StereoOutlook]:
    """Return what to expect with the second camera where the scene has it, then at other angles.

    Parameters
    ----------
    plan
        Of the first camera.
    second
        The second camera.
    angles
        Further angles between them, degrees.

    Returns
    -------
    list of StereoOutlook

    Raises
    ------
    InputError
        The body spins during the exposure.
    """
    scene = plan.scene
    pixels = plan.x[plan.inside], plan.y[plan.inside]
    material = material_points(scene, None, (plan.x, plan.y))
    instrument = plan.instrument
    if second.focal_px is not None:  # positions of lamps and body do not enter
        right_scene = ViewPoint.both(scene, second)[1].scene(scene)
        instrument = Instrument.of(right_scene, element_size=instrument.element_size)
    left = np.stack(pixels, axis=1)
    states = [outlook.state for outlook in plan.outlooks]
    positions = [points_and_normals(scene, material, state)[0] for state in (State(), *states)]
    grid = np.stack([plan.x, plan.y])
    axes = Axes.of("plane", None, positions[0][:, plan.inside].T)
    outlooks = []
    for angle in (second.angle_deg, *(angle for angle in angles if angle != second.angle_deg)):
        views = ViewPoint.both(scene, replace(second, angle_deg=angle))
        pair = true_pair(scene, *views)
        zones = [_zones(plan, views[1], material, state) for state in (State(), *states)]
        seen = [_seen(pair, points) for points in positions]

        def std(before: Zones, after: Zones, motion: FloatArray, by: Instrument = instrument) -> FloatArray:
            """Return the standard uncertainty of a match at the points of the field, px."""
            radius = by.element_size / float(plan.x[0, 1] - plan.x[0, 0])
            forecast = by.forecast(before, after, nodal_mean(trace_change(motion), radius))
            return np.asarray(np.hypot(forecast.std, forecast.bias)[plan.inside])

        match = std(plan.reference, zones[0], seen[0] - grid)
        right = seen[0][:, plan.inside].T
        surface = _covariance(pair, left, right, np.zeros_like(match), match)
        shape = _rms(axes, surface)
        rows = [
            _covariance(pair, left, right, outlook.std[plan.inside], std(zones[0], after, moved - seen[0]))
            for outlook, after, moved in zip(plan.outlooks, zones[1:], seen[1:], strict=True)
        ]
        outlooks.append(
            StereoOutlook(
                angle_deg=angle,
                shape_std=shape,
                std=np.array([_rms(axes, row) for row in rows]),
                seen=np.array([np.isfinite(row[:, 0, 0] + surface[:, 0, 0]).mean() for row in rows]),
            )
        )
    return outlooks


def _zones(plan: LampPlan, view: ViewPoint, material: FloatArray, state: State) -> Zones:
    """Return the zones of the material points in a state as a camera sees them."""
    return predict_zones(view.scene(plan.scene), view.state(plan.scene.body, state), material=material)


def _seen(pair: CameraPair, points: FloatArray) -> FloatArray:
    """Return the px (2, h, w) at which the right camera sees points (3, h, w); NaN beyond its frame."""
    x, y = pair.project(points.reshape(3, -1).T)[1].T.reshape(2, *points.shape[1:])
    height, width = pair.right.shape
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    return np.where(inside, np.stack([x, y]), np.nan)


def _covariance(
    pair: CameraPair, left: FloatArray, right: FloatArray, left_std: FloatArray, right_std: FloatArray
) -> FloatArray:
    """Return the covariance (N, 3, 3) of points in space with standard uncertainties (N,) in either frame, px."""
    variances = np.stack([left_std, left_std, right_std, right_std], axis=1) ** 2
    spread = variances[:, :, None] * np.eye(4)
    finite = np.where(np.isfinite(spread), spread, 0.0)
    weights = np.asarray(np.linalg.inv(finite + 1e-8 * np.eye(4)), dtype=np.float64)
    return triangulate(pair, left, right, spread, weights).covariance


def _rms(axes: Axes, covariance: FloatArray) -> FloatArray:
    """Return the rms standard uncertainty (3,) along the axes of those points that have one."""
    variances = np.diagonal(axes.covariance(covariance), axis1=1, axis2=2)
    finite = np.isfinite(variances).all(axis=1)
    return np.sqrt(variances[finite].mean(axis=0)) if finite.any() else np.full(3, np.nan)


def stereo_rows(outlooks: Sequence[StereoOutlook]) -> tuple[list[str], list[list[str]]]:
    """Headings and one row per angle: standard uncertainty of z, and of u, v, w over all states, mm."""
    rows = []
    for outlook in outlooks:
        std = np.sqrt((outlook.std**2).mean(axis=0))
        figures = [format_number(1e3 * value, ".2f") for value in (outlook.shape_std[2], *std)]
        rows.append([f"{outlook.angle_deg:g} deg", *figures, f"{outlook.seen.min():.0%}"])
    return ["between cameras", "z", "u", "v", "w", "seen"], rows


STEREO_WORDS = {
    "z": "shape along the mean plane's normal; u, v, w: displacement, w along the normal",
    "seen": "fraction of the field that both cameras see in every state",
}
"""Meaning of the headings of `stereo_rows`."""


def stereo_figures(outlooks: Sequence[StereoOutlook]) -> list[dict[str, Any]]:
    """Return the outlooks as plain values, for plan.json."""
    return [
        {
            "angle_deg": outlook.angle_deg,
            "shape_std_mm": dict(zip("xyz", outlook.shape_std.tolist(), strict=True)),
            "states": [
                {"std_mm": dict(zip("uvw", std.tolist(), strict=True)), "seen": float(seen)}
                for std, seen in zip(outlook.std, outlook.seen, strict=True)
            ],
        }
        for outlook in outlooks
    ]
