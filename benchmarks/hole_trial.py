"""A strip with a hole, as a laboratory records it: a front that passes, glares that saturate and travel, raw frames.

The displacement is Kirsch's around the hole (Z. VDI 42, 1898) times the load that the front has brought there, on top
of the front's own: known at every point, and so are its rates.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from rgbmidic import Result, TestSettings, measure
from rgbmidic.fields import rates
from rgbmidic.frames import Mosaic
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.results.histories import read_histories
from rgbmidic.scene.camera import REFERENCE_CROSSTALK
from rgbmidic.settings import ProbeSettings
from rgbmidic.typing import BoolArray, FloatArray

from .standing_glare import BLACK, GAIN, READ_NOISE, WHITE, Paint, expose
from .tables import Row, table
from .uncertainty import rms

SHAPE, STRIP, HOLE, RADIUS = (200, 400), (24.0, 176.0), np.array([230.0, 100.0]), 24.0
RECTANGLE = [20, 30, 380, 170]
POISSON, STRAIN = 0.3, -0.01
SPEED, FRONT, ARRIVES = 25.0, 125.0, 8.0
"""px/frame; px that the front is long, five frames; frame in which it enters the frame at x = 0."""
REST, FRAMES = 4, 32
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
            for _ in range(6):  # the displacement changes by 4 % of its argument at most
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


def measured(strip: Strip, folder: Path, element_size: float, **sections: dict[str, object]) -> Result:
    """Measure the strip through raw frames, calibration file and settings, as a user does."""
    Calibration(
        crosstalk=Crosstalk(matrix=np.array(REFERENCE_CROSSTALK), lights=("red", "green", "blue")),
        noise=NoiseModel(gain=GAIN, read_noise=READ_NOISE),
    ).write(folder / "calibration.json")
    ring = HOLE + (RADIUS + 2.5) * np.stack([f(np.linspace(0, 2 * np.pi, 25)[:-1]) for f in (np.cos, np.sin)], axis=1)
    settings = {
        "frames": {"path": [], "reference": f"0:{REST}"},
        "calibration": {"file": "calibration.json"},
        "region": {"rectangle": RECTANGLE, "holes": [ring.tolist()]},
        "mesh": {"element_size": element_size},
    } | sections
    return measure(TestSettings.from_mapping(settings, folder), folder / "result", source=strip.frames(), workers=1)
