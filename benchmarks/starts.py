"""How often an initial guess is found: random large motions by size, speckle and lights.

An initial guess counts as found if nine tenths of the nodes around which the images correlate by 0.5 or more at the
true displacement are within 1.5 px of it; motions at which no node does are left out. Dark discs on white at random
places, or on a jittered lattice, which has no coarse content; every light has its own shading and level, and
reflections that move from one state to the other: up to three times full white, erratic, left out where they exceed 1.5
times full white. The deformed image is the undeformed one moved by cubic interpolation, with noise of 2 % in both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic import Region, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.nodes import correlation_around
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.start import find_initial_guess
from rgbmidic.typing import FloatArray, FloatImage

from .tables import Row, table

SPECKLES = {"discs 3 px": (3.0, False), "discs 8 px": (8.0, False), "lattice 4 px": (4.0, True)}
LIGHTS = {"1 light": (1, 0.0), "1 light reflecting": (1, 0.12), "3 lights reflecting": (3, 0.2)}
MOTIONS = {
    "2 px": (0.0, 0.0, 0.0, 2.0),
    "half its side": (0.0, 0.0, 0.5, 0.0),
    "100 px": (0.0, 0.0, 0.0, 100.0),
    "30°": (30.0, 0.0, 0.1, 0.0),
    "20 % strain": (0.0, 0.2, 0.1, 0.0),
    "20° + 10 %": (20.0, 0.1, 0.2, 0.0),
    "30° + half its side": (30.0, 0.0, 0.5, 0.0),
}
"""Turn in degrees, largest strain, shift over the region's side, and in px."""
ROOM = 120
"""px that a picture is larger than the region; small ones are twice the region too, so that it stays in the picture."""
WITHIN, FRACTION, VISIBLE = 1.5, 0.9, 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """``x -> F (x - c) + c + t`` in px, c the middle of the picture."""

    gradient: FloatArray
    shift: FloatArray

    @classmethod
    def random(cls, name: str, side: int, random: np.random.Generator) -> Motion:
        """One of `MOTIONS`, in random directions."""
        turn, strain, share, length = MOTIONS[name]
        along, course = random.uniform(0, 2 * np.pi, 2)
        angle = np.radians(turn) * random.choice([-1, 1])
        stretch = _rotation(along) @ np.diag(1 + strain * np.array([1, random.choice([-1, 1])])) @ _rotation(-along)
        shift = (share * side + length) * np.array([np.cos(course), np.sin(course)])
        return cls(gradient=_rotation(angle) @ stretch, shift=shift)

    def of(self, points: FloatArray, middle: float) -> FloatArray:
        """Displacement (N, 2) of points (N, 2)."""
        return np.asarray((points - middle) @ (self.gradient - np.eye(2)).T + self.shift)


def _rotation(angle: float) -> FloatArray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def specimen(size: int, name: str, random: np.random.Generator) -> FloatImage:
    """Grey levels 0 to 1 (size, size), drawn three times finer."""
    diameter, lattice = SPECKLES[name]
    if lattice:
        step = 1.7 * diameter
        grid = np.stack(np.meshgrid(*2 * [np.arange(0, size, step)]), axis=-1).reshape(-1, 2)
        centres = grid + random.uniform(-0.3, 0.3, grid.shape) * step
    else:
        centres = random.uniform(0, size, (int(0.6 * size**2 / (np.pi / 4 * diameter**2)), 2))
    fine, bits = 3, 4
    canvas = np.full((fine * size, fine * size), 0.8, dtype=np.float32)
    for x, y in np.round(centres * fine * 2**bits).astype(int):
        cv2.circle(canvas, (int(x), int(y)), round(diameter / 2 * fine * 2**bits), 0.1, -1, cv2.LINE_8, bits)
    canvas = cv2.GaussianBlur(canvas, (0, 0), 0.5 * fine)
    return np.asarray(cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA), dtype=np.float32)


def moved(texture: FloatImage, size: int, motion: Motion) -> FloatImage:
    """The middle (size, size) of a picture once it has moved; grey beyond its edge."""
    own, seen = (len(texture) - 1) / 2, (size - 1) / 2
    forward = np.c_[motion.gradient, seen + motion.shift - motion.gradient @ np.full(2, own)]
    image = cv2.warpAffine(texture, forward, (size, size), flags=cv2.INTER_CUBIC, borderValue=0.3)
    return np.asarray(image, dtype=np.float32)


def under_lights(image: FloatImage, name: str, random: np.random.Generator) -> tuple[FloatImage, FloatImage]:
    """Images and weights (k, H, W)."""
    count, width = LIGHTS[name]
    size = len(image)
    y, x = np.mgrid[:size, :size] / size
    images, weights = np.zeros((2, count, size, size), dtype=np.float32)
    for light in range(count):
        a, b, phase = random.uniform(-3, 3, 3)
        seen = image * random.uniform(0.8, 1.2) * (1 + 0.1 * np.sin(a * x + b * y + phase))
        if width:
            (cx, cy), spread = random.uniform(0.2, 0.8, 2), width * random.uniform(0.7, 1.3)
            sparkle = cv2.GaussianBlur(random.normal(size=image.shape), (0, 0), 0.6)
            shape = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * spread**2))
            seen = seen + 2 * shape * (1 + 0.35 * sparkle / sparkle.std())
        weights[light] = seen < 1.5
        images[light] = 200 * (seen + random.normal(scale=0.02, size=image.shape))
    return images, weights


def search(side: int, texture: FloatImage, size: int, lights: str, motion: Motion, seed: int) -> bool | None:
    """Whether the displacement of a square region in the middle of a picture is found; None where nothing is seen."""
    random = np.random.default_rng(seed)
    rest = Motion(gradient=np.eye(2), shift=np.zeros(2))
    images, weights = under_lights(moved(texture, size, rest), lights, random)
    edge = (size - side) // 2
    region = Region.from_rectangle((edge, edge, edge + side - 1, edge + side - 1), (size, size))
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(images, region, weights, mesh=mesh, prefilter="binomial")
    deformed = Deformed.prepare(*under_lights(moved(texture, size, motion), lights, random), prefilter="binomial")
    start = find_initial_guess(reference, deformed)
    truth = motion.of(mesh.nodes, (size - 1) / 2)
    residual = Residual.at(reference, deformed, [truth] * len(images))
    visible = np.nan_to_num(correlation_around(residual)) >= VISIBLE
    if not visible.any():
        return None
    near = np.linalg.norm(start.displacement - truth, axis=1)[visible] < WITHIN
    return bool(near.mean() >= FRACTION)


@table("initial_guess", page="explanation/how-it-works", cost=200, keys=2)
def initial_guess(quick: bool) -> Iterator[Row]:
    """Initial guesses within 1.5 px of the truth, without a hint, in per cent of 9 random motions of each kind (3
    speckles, 3 draws), by the region's side and the lights; reflections are up to three times full white.
    """
    for side, names in ((64, ["30° + half its side"]),) if quick else ((64, list(MOTIONS)), (300, list(MOTIONS))):
        size = side + (max(side, 2 * ROOM) if side < 400 else ROOM)
        textures = {name: specimen(int(1.5 * size), name, np.random.default_rng(side)) for name in SPECKLES}
        for name in names:
            cells = {}
            for lights in LIGHTS:
                found = [
                    search(side, texture, size, lights, Motion.random(name, side, np.random.default_rng(seed)), seed)
                    for texture in textures.values()
                    for seed in range(3)
                ]
                seen = [one for one in found if one is not None]
                cells[f"{lights} [%]"] = 100 * sum(seen) / len(seen) if seen else float("nan")
            yield {"side [px]": side, "motion": name, **cells}
