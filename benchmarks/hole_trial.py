"""A strip with a hole, as a laboratory records it: a front that passes, glares that saturate and travel, raw frames.

The displacement is Kirsch's around the hole (Z. VDI 42, 1898) times the load that the front has brought there, on top
of the front's own: known at every point, and so are its rates.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from rgbmidic import Result, TestSettings, measure
from rgbmidic.fields import Displacement, Field, make_probe, rates, reference_fraction
from rgbmidic.frames import Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.tools.scene.camera import REFERENCE_CROSSTALK
from rgbmidic.typing import BoolArray, FloatArray

from .standing_glare import GAIN, READ_NOISE, Paint, expose
from .tables import Row, table
from .uncertainty import rms

SHAPE, STRIP, HOLE, RADIUS = (200, 400), (24.0, 176.0), np.array([230.0, 100.0]), 24.0
RECTANGLE = [20, 30, 380, 170]
POISSON, STRAIN = 0.3, -0.01
SPEED, FRONT, ARRIVES = 25.0, 125.0, 8.0
"""px/frame; px that the front is long, five frames; frame in which it enters the frame at x = 0."""
REST, FRAMES, WINDOW = 4, 32, 7
STEP = 0.01
"""Frames before and after one from which the exact rates are taken."""
GLARES = np.array([(-40.0, 70.0, 11.0), (-10.0, 110.0, 9.0), (30.0, 140.0, 10.0)])
"""x and y of each light's glare in frame 0, px, and its speed, px/frame."""
SPREAD, LEVEL = 20.0, 4.0
"""Standard deviation of a glare, px, and its level over the paint's."""


def load(phase: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Part of the full strain (smooth to its second derivative) that a front brings, and its integral over the phase.

    The phase is 0 where the front begins and 1 where it has passed.
    """
    p = np.clip(phase, 0, 1)
    return p**3 * (10 - 15 * p + 6 * p**2), p**4 * (2.5 - 3 * p + p**2) + np.maximum(phase - 1, 0)


def kirsch(points: FloatArray) -> FloatArray:
    """Displacement (..., 2) that the hole adds under unit strain along x, plane stress; inside as on the rim."""
    x, y = np.moveaxis(points - HOLE, -1, 0)
    radius, angle = np.maximum(np.hypot(x, y), RADIUS), np.arctan2(y, x)
    kappa, square = (3 - POISSON) / (1 + POISSON), RADIUS**2
    scale = (1 + POISSON) / 2 / radius
    radial = scale * (square * (1 + (1 + kappa) * np.cos(2 * angle)) - square**2 / radius**2 * np.cos(2 * angle))
    around = scale * ((1 - kappa) * square - square**2 / radius**2) * np.sin(2 * angle)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * radial - s * around, s * radial + c * around], axis=-1)


@dataclass(frozen=True, slots=True)
class Strip:
    """The strip in the frames of a test."""

    draw: int
    is_glaring: bool

    def displacement(self, points: FloatArray, frame: float) -> FloatArray:
        """Displacement (..., 2) of material points (..., 2), px."""
        travelled = SPEED * (frame - ARRIVES)
        amount, moved = load((travelled - points[..., 0]) / FRONT)
        lateral = -POISSON * STRAIN * (points[..., 1] - HOLE[1]) * amount
        around_hole = STRAIN * load((travelled - HOLE[:1]) / FRONT)[0] * kirsch(points)
        return np.stack([-STRAIN * FRONT * moved, lateral], axis=-1) + around_hole

    def frames(self) -> list[Mosaic]:
        """Raw frames."""
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
        pixels, paint, rng = np.stack([x, y], axis=-1), Paint(self.draw, SHAPE), np.random.default_rng(self.draw)
        grains = gaussian_filter(rng.normal(size=(3, *SHAPE)), (0, 1, 1)) ** 2
        erratic, mosaics = 0.6 + 0.4 * grains / grains.mean(), []
        for number in range(FRAMES):
            material = pixels
            for _ in range(4 if number > ARRIVES else 0):  # it changes by 4 % of its argument: right to 1e-5 px
                material = pixels - self.displacement(material, number)
            solid = np.clip(np.hypot(*np.moveaxis(material - HOLE, -1, 0)) - RADIUS + 0.5, 0, 1)
            solid *= np.clip(np.minimum(material[..., 1] - STRIP[0], STRIP[1] - material[..., 1]) + 0.5, 0, 1)
            lights = np.broadcast_to(paint(material), (3, *SHAPE)).copy()
            if self.is_glaring:
                for light, (x0, y0, speed) in enumerate(GLARES):
                    square = (x - x0 - speed * number) ** 2 + (y - y0) ** 2
                    lights[light] += 0.45 * LEVEL * erratic[light] * np.exp(-square / (2 * SPREAD**2))
            mosaics.append(expose(0.4 * (solid * lights + 0.03 * (1 - solid)), 1000 * self.draw + number))
        return mosaics


def measured(strip: Strip, folder: Path, mesh: dict[str, object]) -> Result:
    """Measure the strip through raw frames, calibration file and settings, as a user does."""
    Calibration(
        crosstalk=Crosstalk(matrix=np.array(REFERENCE_CROSSTALK), lights=("red", "green", "blue")),
        noise=NoiseModel(gain=GAIN, read_noise=READ_NOISE),
    ).write(folder / "calibration.json")
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = HOLE + (RADIUS + 2.5) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    settings = {
        "frames": {"path": [], "reference": f"0:{REST}"},
        "calibration": {"file": "calibration.json"},
        "region": {"rectangle": RECTANGLE, "holes": [ring.tolist()]},
        "mesh": mesh,
    }
    return measure(TestSettings.from_mapping(settings, folder), folder / "result", source=strip.frames(), workers=1)


def places(points: FloatArray, glare_reach: float, is_glaring: bool) -> dict[str, BoolArray]:
    """Rows of the table: which frames and points (T, P) belong to each; without those at the ends of the test."""
    frame = np.arange(float(FRAMES))[:, None]
    start, end = (np.minimum(points[:, 0], HOLE[0]), np.maximum(points[:, 0], HOLE[0]) + FRONT)
    arrived, passed = (SPEED * (frame - ARRIVES) > x for x in (start, end))
    rim = np.broadcast_to(np.hypot(*(points - HOLE).T) < RADIUS + 4, arrived.shape)
    glare = np.zeros_like(arrived)
    for x, y, speed in GLARES[: len(GLARES) if is_glaring else 0]:
        glare |= np.hypot(points[:, 0] - x - speed * frame, points[:, 1] - y) < glare_reach
    inner = (frame >= REST) & (frame < FRAMES - 3)
    found = {
        "rim": rim & arrived,
        "before the front": ~arrived & ~glare & ~rim,
        "while it passes": arrived & ~passed & ~glare & ~rim,
        "after it": passed & ~glare & ~rim,
    }
    if is_glaring:
        found |= {"in glare before or after it": glare & ~(arrived & ~passed) & ~rim}
        found |= {"in glare while it passes": glare & arrived & ~passed & ~rim}
    return {name: mask & inner for name, mask in found.items()}


def rate(values: FloatArray, std: FloatArray, truth: FloatArray) -> FloatArray:
    """Error over stated uncertainty (T, P) of the rate of values; `truth` (2, T, P) is just before and after each."""
    times = np.arange(float(FRAMES))
    options = {"window": WINDOW - 1.0, "common_fraction": reference_fraction(REST), "references": times < REST}
    velocity = rates(times, Field(name="u", values=values, std=std), **options)["velocity"]
    return np.asarray((velocity.values - (truth[1] - truth[0]) / (2 * STEP)) / velocity.uncertainty)


def ratios(strip: Strip, result: Result) -> Iterator[tuple[str, str, FloatArray, FloatArray]]:
    """Row, quantity, errors and errors over stated uncertainty of a result."""
    physical = result.in_units()
    length, nodes = 3 * physical.mesh.size, result.nodes.astype(np.float64)
    truth = np.stack([[strip.displacement(nodes, i + step) for i in range(FRAMES)] for step in (-STEP, 0, STEP)])
    step = np.array([0.05, 0.0])
    strain = np.stack(
        [strip.displacement(nodes + step, i) - strip.displacement(nodes - step, i) for i in range(FRAMES)]
    )[..., 0]
    errors = {
        "u, v": (np.stack([result.u, result.v]) - np.moveaxis(truth[1], -1, 0), np.stack([result.u_std, result.v_std])),
        "strain": (result.nodal_exx - strain / (2 * step[0]), result.nodal_exx_std),
    }
    for name, mask in places(nodes, 2 * SPREAD, strip.is_glaring).items():
        for quantity, (error, std) in errors.items():
            chosen = np.broadcast_to(mask, error.shape)
            yield name, quantity, error[chosen], error[chosen] / std[chosen]
    velocity = rate(result.u, result.u_std, truth[::2, ..., 0])
    for name, mask in places(nodes, 2 * SPREAD, strip.is_glaring).items():
        yield name, "velocity", velocity[mask], velocity[mask]
    grid = np.stack(np.meshgrid(np.arange(50.0, 360, 30), [65.0, 100.0, 135.0]), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(*(grid - HOLE).T) > RADIUS + length / 2 + 4]
    gauges = [make_probe(physical.covariance, "strain_gauge", 1, (x, y, length)) for x, y in grid]
    fields = Displacement.concatenate([physical.displacement(frame) for frame in range(FRAMES)])
    exact = [Displacement.in_plane(*np.moveaxis(part, -1, 0), *np.full((2, *part.shape[:2]), STEP)) for part in truth]
    series = [[gauge.histories(part.isel(node=gauge.nodes))[0] for gauge in gauges] for part in (fields, *exact)]
    found, *true = (np.stack([one.values for one in row], axis=1) for row in series)
    std = np.stack([one.std for one in series[0]], axis=1)
    strain_rate = rate(found, std, np.stack(true[::2]))
    for name, mask in places(grid, 2 * SPREAD, strip.is_glaring).items():
        yield name, "gauge", (found - true[1])[mask], ((found - true[1]) / std)[mask]
        yield name, "strain rate", strain_rate[mask], strain_rate[mask]


@table("hole_trial", page="explanation/uncertainty", cost=90, keys=3)
def hole_trial(quick: bool) -> Iterator[Row]:
    """A strip with a hole of 48 px (raw Bayer frames, 12 bit), rest, then a front of 125 px within five frames that
    brings 1 % of compression and Kirsch's field around the hole; without and with three glares of four times the
    paint's level that saturate and travel: rms error of nodes, error over stated uncertainty of displacement and
    strain of nodes, of gauges of three elements, of velocity and of the gauges' strain rate over 7 frames. Glare: nodes
    and gauges within 40 px of the middle of one. The front passes from its arrival until it has passed node and hole.
    """
    cases = [(size, is_glaring) for size in (18.0, 9.0) for is_glaring in (False, True)]
    for size, is_glaring in [(18.0, False)] if quick else cases:
        collected: dict[str, dict[str, list[FloatArray]]] = {}
        for draw in range(1 if quick else 2):
            with tempfile.TemporaryDirectory() as folder:
                strip = Strip(draw, is_glaring)
                result = measured(strip, Path(folder), {"element_size": size})
                for place, quantity, error, ratio in ratios(strip, result):
                    row = collected.setdefault(place, {})
                    row.setdefault(f"{quantity} error", []).append(error)
                    row.setdefault(quantity, []).append(ratio)
        for place, row in collected.items():
            figure = {name: rms(np.concatenate(values)) for name, values in row.items()}
            missing = float("nan")
            yield {
                "elements [px]": f"{size:g}",
                "glare": "three" if is_glaring else "none",
                "where and when": place,
                "u and v [px]": figure["u, v error"],
                "u and v: error/stated": figure["u, v"],
                "exx [1e-6]": 1e6 * figure["strain error"],
                "exx: error/stated": figure["strain"],
                "gauge: error/stated": figure.get("gauge", missing),
                "velocity: error/stated": figure["velocity"],
                "strain rate: error/stated": figure.get("strain rate", missing),
            }
