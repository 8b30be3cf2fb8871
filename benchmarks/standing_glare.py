"""Glare that stands still in the laboratory while the surface moves: how many nodes it pulls away unseen."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter

from rgbmidic._kernels.splines import PAD, bspline_coefficients, sample_with_gradient
from rgbmidic.correlation.reference import Deformed, Reference
from rgbmidic.correlation.start import TrackingState, track
from rgbmidic.frames import Mosaic, Window, cfa_channels
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.illumination.separation import Separation, reference_images
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.settings import ELEMENT_SIZE, SolverSettings
from rgbmidic.tools.scene.camera import REFERENCE_CROSSTALK
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights import Statistics

from .tables import Row, table
from .uncertainty import covered, rms

CROSSTALK = np.array(REFERENCE_CROSSTALK)
CFA, BLACK, WHITE, GAIN, READ_NOISE = "GBRG", 64, 4095, 4.0, 3.0
_FINE = 2
"""Pixels of the texture to one of a frame: what interpolating it adds is below the camera's noise."""
WILD = (0.2, 4.0)
"""A node is wild if it is off by more than this many px and this many times its stated uncertainty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HoledPlate:
    """A plate with a hole, at rest, then moving; hole, glare and its sparkle differ from draw to draw."""

    draw: int
    hole: FloatArray
    """Its centre, px."""
    radius: float
    spots: FloatArray
    """Centres (3, 2) of the lights' glare, px."""
    spread: float
    """Standard deviation of a light's glare, px."""
    glare: float
    """Over the diffuse level."""
    erratic: float
    sparkle: float
    """Standard deviation of the erratic part's grains, px."""
    shift: FloatArray
    size: int = 512
    rest: int = 4
    moving: int = 12
    arrives: int = 0
    """Frames in motion until the glare is there; 0: always."""

    @classmethod
    def drawn(cls, draw: int) -> HoledPlate:
        """One of them."""
        rng = np.random.default_rng(draw)
        angle, direction = rng.uniform(0, 2 * np.pi, 2)
        hole, radius = rng.uniform(200, 312, 2), rng.uniform(35, 80)
        spread, level, erratic, sparkle = rng.uniform((45, 1.5, 0.3, 1), (60, 2.5, 0.6, 2))
        beside = hole + (radius + 15) * np.array([np.cos(angle), np.sin(angle)])
        return cls(
            draw=draw,
            hole=hole,
            radius=radius,
            spots=beside + rng.normal(0, 25, (3, 2)),
            spread=spread,
            glare=level,
            erratic=erratic,
            sparkle=sparkle,
            shift=17 * np.array([np.cos(direction), np.sin(direction)]),
        )

    def _affine(self, frame: int) -> tuple[FloatArray, FloatArray]:
        part = (max(frame - self.rest + 1, 0) / self.moving) ** 2
        c, s = np.cos(np.radians(2 * part)), np.sin(np.radians(2 * part))
        return np.array([[c, -s], [s, c]]) @ np.diag([1 + 0.02 * part, 1 - 0.006 * part]), self.shift * part

    def displacement(self, points: FloatArray, frame: int) -> FloatArray:
        """Displacement (..., 2) of material points (..., 2)."""
        gradient, shift = self._affine(frame)
        return (points - self.size / 2) @ (gradient - np.eye(2)).T + shift

    def origin(self, points: FloatArray, frame: int) -> FloatArray:
        """Material points (H, W, 2) that are seen at the pixels (H, W, 2) of a frame."""
        gradient, shift = self._affine(frame)
        return (points - self.size / 2 - shift) @ np.linalg.inv(gradient).T + self.size / 2

    def region(self) -> Region:
        """The frame but for its border and the hole."""
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
        edge = self.hole + self.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return Region.from_rectangle((30, 30, self.size - 31, self.size - 31), (self.size,) * 2).without([edge])


class Paint:
    """Paint of a random texture at any points of a surface of a shape and 200 px around it, .15 to .75."""

    def __init__(self, draw: int, shape: tuple[int, int]) -> None:
        rng, fine = np.random.default_rng(100 + draw), tuple(_FINE * (size + 400) for size in shape)
        spots = gaussian_filter(rng.normal(size=fine).astype(np.float32), 1.25 * _FINE, mode="wrap")
        paint = 0.45 + 0.3 * np.tanh(2 * spots / spots.std())
        self.coefficients = np.empty([size + 2 * PAD for size in paint.shape], dtype=np.float32)
        bspline_coefficients(paint, self.coefficients)

    def __call__(self, points: FloatArray) -> FloatImage:
        """Reflectance (...) at points (..., 2)."""
        # OpenCV rounds places to 1/32 px: not enough for the truth
        fine = np.ascontiguousarray(np.moveaxis((points + 200) * _FINE, -1, 0))
        paint, *slopes = np.empty((3, fine[0].size), dtype=np.float32)
        sample_with_gradient(self.coefficients, *fine.reshape(2, -1), paint, *slopes)
        return paint.reshape(fine.shape[1:])


def expose(lights: FloatArray, seed: int) -> Mosaic:
    """Raw frame of lights (3, H, W), of 1 at three quarters of the white level, with the camera's noise."""
    height, width = lights.shape[1:]
    site = np.tile(cfa_channels(CFA), (height // 2, width // 2))
    signal = np.take_along_axis(np.tensordot(CROSSTALK, lights, axes=1), site[None], axis=0)[0]
    signal *= (WHITE - BLACK) * 0.75
    noise = np.random.default_rng(seed).normal(size=signal.shape)
    noisy = signal + noise * np.sqrt(np.maximum(signal, 0) / GAIN + READ_NOISE**2)
    values = np.clip(np.round(noisy + BLACK), 0, WHITE).astype(np.uint16)
    return Mosaic(values=values, cfa=CFA, black_level=BLACK, white_level=WHITE)


class _Renderer:
    """Frames of such a plate: paint that moves, and glare of each light that stands still."""

    def __init__(self, plate: HoledPlate) -> None:
        self.plate, rng = plate, np.random.default_rng(200 + plate.draw)
        self.paint = Paint(plate.draw, (plate.size, plate.size))
        self.points = np.stack(np.mgrid[: plate.size, : plate.size][::-1].astype(np.float64), axis=-1)
        self.glare = []
        for spot in plate.spots:
            grains = sum(gaussian_filter(rng.normal(size=(plate.size,) * 2), plate.sparkle) ** 2 for _ in range(2))
            erratic = 1 - plate.erratic + plate.erratic * grains / grains.mean()
            distance = ((self.points - spot) ** 2).sum(axis=-1)
            self.glare.append(0.45 * plate.glare * erratic * np.exp(-distance / (2 * plate.spread**2)))

    def mosaic(self, number: int) -> Mosaic:
        """One raw frame."""
        seen = self.plate.origin(self.points, number)
        solid = np.clip(np.hypot(*np.moveaxis(seen - self.plate.hole, -1, 0)) - self.plate.radius + 0.5, 0, 1)
        come = min(max(number - self.plate.rest + 1, 0) / self.plate.arrives, 1) if self.plate.arrives else 1.0
        lights = 0.4 * (solid * (self.paint(seen) + come * np.stack(self.glare)) + 0.03 * (1 - solid))
        return expose(lights, 10_000 * (self.plate.draw + 1) + number)


@table("standing_glare", page="explanation/uncertainty", cost=100, keys=1, own_quick=True)
def standing_glare(quick: bool) -> Iterator[Row]:
    """Plates with a hole, with reflections of three lights beside it that do not move, 1.5 to 2.5 times the diffuse
    level and 30 to 60 % of it irregular, raw Bayer frames, 12 frames of motion up to 17 px, 2 degrees and 2 % of
    strain: nodes, how many are wild (error above .2 px and 4 times their stated uncertainty), those not measured, rms
    error, error over stated uncertainty.
    """
    for draw in range(1 if quick else 6):
        yield _measured(HoledPlate.drawn(draw), 2 if quick else None)


@table("arriving_glare", page="explanation/uncertainty", cost=60, keys=1, own_quick=True)
def arriving_glare(quick: bool) -> Iterator[Row]:
    """The same plates as in `standing_glare`, with reflections of all three lights at the rim of the hole, twice the
    diffuse level, that arrive within six frames of motion.
    """
    for draw in range(1 if quick else 4):
        plate, rng = HoledPlate.drawn(draw), np.random.default_rng(300 + draw)
        angle = rng.uniform(0, 2 * np.pi)
        rim = plate.hole + plate.radius * np.array([np.cos(angle), np.sin(angle)])
        yield _measured(
            replace(plate, spots=rim + rng.normal(0, 10, (3, 2)), spread=40.0, glare=2.0, arrives=6),
            8 if quick else None,
        )


def _measured(plate: HoledPlate, moving: int | None) -> Row:
    """Row of a plate, for so many frames in motion; None: all."""
    crosstalk = Crosstalk(matrix=CROSSTALK, lights=("red", "green", "blue"))
    calibration, solver = (
        Calibration(crosstalk=crosstalk, noise=NoiseModel(gain=GAIN, read_noise=READ_NOISE)),
        SolverSettings(),
    )
    renderer, region = _Renderer(plate), plate.region()
    frames = [(renderer.mosaic(number),) for number in range(plate.rest + (moving or plate.moving))]
    images, separation = reference_images(
        Separation(calibration=calibration), frames[: plate.rest], Window.of_frame(frames[0][0].values.shape[-2:])
    )
    mesh = Tri3Mesh.from_region(region, ELEMENT_SIZE)
    reference = Reference.prepare(images.values, region, mesh=mesh, prefilter=solver.prefilter)
    start, errors, stated = TrackingState(displacement=np.zeros_like(mesh.nodes)), [], []
    for number in range(plate.rest, len(frames)):
        ready = separation(frames[number]).values
        found = track(reference, Deformed.prepare(ready, prefilter=solver.prefilter), start, solver, Statistics())
        start = start.extrapolate(mesh, found.displacement, found.measured)
        errors.append(found.displacement - plate.displacement(mesh.nodes, number))
        stated.append(found.displacement_std)
    error = np.abs(np.concatenate(errors))
    ratio = error / np.concatenate(stated)
    return {
        "draw": plate.draw,
        "nodes": len(error),
        "wild": int(((error > WILD[0]) & (ratio > WILD[1])).any(axis=1).sum()),
        "not measured [%]": 100 * float(np.isnan(error[:, 0]).mean()),
        "rms error [px]": rms(error),
        "error/stated": rms(ratio),
        "covered [%]": 100 * covered(ratio),
    }
