"""How often a start is found, and how sure it is: random large motions by size, speckle and lights; prints a table.

    python benchmarks/starts.py [--sizes 64 200 1000] [--repeats 3]

A start counts as found if nine tenths of the nodes around which the images correlate by 0.5 or more at the true
displacement are within 1.5 px of it; motions at which no node does are left out.
Dark discs on white at random places, or on a jittered lattice, which has no coarse content; every light has its own
shading and level, and reflections that move from one state to the other: up to three times full white, erratic, left
out where they exceed 1.5 times full white. The deformed image is the undeformed one brought to its place by cubic
interpolation, with noise of 2 % in both. The last column is a search in a picture of another specimen.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import cv2
import numpy as np

from rgbmidic import Region, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference
from rgbmidic.correlation.nodes import correlation_around
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.start import FoundStart, find_start
from rgbmidic.typing import FloatArray, FloatImage

SPECKLES = {"discs 3 px": (3.0, False), "discs 8 px": (8.0, False), "lattice 4 px": (4.0, True)}
LIGHTS = {"1 light": (1, 0.0), "1, reflection": (1, 0.12), "3, reflections": (3, 0.2)}
MOTIONS = {
    "2 px": (0.0, 0.0, 0.0, 2.0),
    "half": (0.0, 0.0, 0.5, 0.0),
    "100 px": (0.0, 0.0, 0.0, 100.0),
    "30 deg": (30.0, 0.0, 0.1, 0.0),
    "20 %": (0.0, 0.2, 0.1, 0.0),
    "20 deg 10 %": (20.0, 0.1, 0.2, 0.0),
    "30 deg half": (30.0, 0.0, 0.5, 0.0),
}
"""Turn in degrees, largest strain, shift over the region's side, and in px."""
ROOM = 120
"""px that a picture is larger than the region; small ones are twice the region too, so that it stays in the picture."""
WITHIN, SHARE, VISIBLE = 1.5, 0.9, 0.5


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


def search(
    side: int, textures: tuple[FloatImage, FloatImage], size: int, lights: str, motion: Motion, seed: int
) -> tuple[bool | None, FoundStart, float]:
    """Whether a start of a square region in the middle of a picture is found, the start, and the
    seconds it took; None where nothing is seen."""
    random = np.random.default_rng(seed)
    rest = Motion(gradient=np.eye(2), shift=np.zeros(2))
    images, weights = under_lights(moved(textures[0], size, rest), lights, random)
    edge = (size - side) // 2
    region = Region.from_rectangle((edge, edge, edge + side - 1, edge + side - 1), (size, size))
    mesh = Tri3Mesh.from_region(region, 25)
    reference = Reference.prepare(images, region, weights, mesh=mesh, prefilter="binomial")
    deformed = Deformed.prepare(*under_lights(moved(textures[1], size, motion), lights, random), prefilter="binomial")
    begin = time.perf_counter()
    start = find_start(reference, deformed)
    seconds = time.perf_counter() - begin
    truth = motion.of(mesh.nodes, (size - 1) / 2)
    residual = Residual.at(reference, deformed, reference.values, [truth] * len(images))
    visible = np.nan_to_num(correlation_around(residual)) >= VISIBLE
    if not visible.any():
        return None, start, seconds
    near = np.linalg.norm(start.displacement - truth, axis=1)[visible] < WITHIN
    return bool(near.mean() >= SHARE), start, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 200, 1000], help="sides of the region, px")
    parser.add_argument("--repeats", type=int, default=3, help="random motions of each kind")
    arguments = parser.parse_args()
    print(f"{'side':>5} {'speckle':<13} {'lights':<15}" + "".join(f"{name:>12}" for name in MOTIONS) + "   other  s")
    right, wrong = list[float](), list[float]()
    for side in arguments.sizes:
        size = side + (max(side, 2 * ROOM) if side < 400 else ROOM)
        for speckle in SPECKLES:
            random = np.random.default_rng(side)
            textures = [specimen(int(1.5 * size), speckle, random) for _ in range(2)]
            for lights in LIGHTS:
                row, times = "", list[float]()
                for name in MOTIONS:
                    found = possible = 0
                    for seed in range(arguments.repeats):
                        motion = Motion.random(name, side, random)
                        good, start, seconds = search(side, (textures[0],) * 2, size, lights, motion, seed)
                        times.append(seconds)
                        if good is not None:
                            (right if good else wrong).append(start.confidence)
                            found, possible = found + good, possible + 1
                    row += f"{f'{found} of {possible}':>12}"
                _, start, _ = search(side, (textures[0], textures[1]), size, lights, motion, 0)
                wrong.append(start.confidence)
                print(
                    f"{side:>5} {speckle:<13} {lights:<15}{row} {start.confidence:7.2f} {np.median(times):5.2f}",
                    flush=True,
                )
    levels = (0, 1, 5, 50)
    print(f"confidence of starts found, percentiles {levels}: {np.round(np.percentile(right, levels), 2)}")
    print(f"confidence of others, from the largest: {np.round(np.sort(wrong)[::-1][:12], 2)}")


if __name__ == "__main__":
    main()
