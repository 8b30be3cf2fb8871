"""Recommended element sizes against the truth: known fields on speckle, noise of known size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from rgbmidic.fields import at_pixels, field_rms
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline.plan import Plan
from rgbmidic.settings import FrameSettings, MeshSettings, RegionSettings, TestSettings
from rgbmidic.tools.preparation import element_size as resolution
from rgbmidic.tools.preparation.element_size import SPECKLES, study_sizes
from rgbmidic.tools.preparation.refinement import refine

from .tables import Row, table

SIZES = (10.0, 16.0, 25.0, 40.0, 63.0)
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A field on speckle under one or several lights."""

    kind: str
    width: float
    """Standard deviation of a bump, period of a wave, length over which a step rises, radius of a hole, px."""
    height: float
    """Largest displacement, px; of a hole the strain far from it, a third of the largest at its edge."""
    noise: float
    """Standard deviation over that of the speckle."""
    lights: int = 1
    speckle: float = 3.5
    seed: int = 0
    side: int = 256

    @property
    def name(self) -> str:
        return f"{self.kind} of {self.width:g} px"

    def field(self, x: Array, y: Array) -> Array:
        """Displacement (2, ...) at points of the reference."""
        middle = (self.side - 1) / 2
        dx, dy = x - middle - 7.3, y - middle + 4.1
        if self.kind == "bump":
            shape = np.exp(-(dx**2 + dy**2) / (2 * self.width**2))
        elif self.kind == "wave":
            shape = np.cos(2 * np.pi * (dx + 0.3 * dy) / self.width)
        elif self.kind == "band":
            shape = np.tanh((dx + 0.5 * dy) / self.width)
        elif self.kind == "tip":  # as beside a crack's: slopes grow without end
            radius, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
            shape = np.sqrt(radius / self.width) * np.cos(angle / 2)
        elif self.kind == "hole":
            return self.height * around_hole(x - (self.side - 1) / 2, y - (self.side - 1) / 2, self.width)
        else:  # affine
            shape = (dx + 0.4 * dy) / self.width
        return np.stack([self.height * shape, 0.6 * self.height * shape]) + np.array([1.3, -0.4])[:, None, None]

    def images(self) -> tuple[Array, Array]:
        """Images (2, k, H, W) of both states, and the displacement (2, H, W) at the pixels of the reference."""
        random, around = np.random.default_rng([self.seed, int(10 * self.width)]), 16
        size = self.side + 2 * around
        spots = gaussian_filter(random.normal(size=(size, size)), self.speckle / 2.355 / np.sqrt(2), mode="wrap")
        texture = spline_filter(spots / spots.std(), order=5)
        y, x = np.indices((self.side, self.side), dtype=float)
        u = self.field(x, y)
        back = u
        for _ in range(30):  # where what is seen at a pixel was: x = X - u(x)
            back = self.field(x - back[0], y - back[1])
        still = map_coordinates(texture, [y + around, x + around], order=5, prefilter=False, mode="grid-wrap")
        moved = map_coordinates(
            texture, [y - back[1] + around, x - back[0] + around], order=5, prefilter=False, mode="grid-wrap"
        )
        lights = []
        for light in range(self.lights):
            gain = 1 - 0.15 * light + 0.2 * np.sin((x + 60 * light) / 90)
            pair = [1000 + 200 * gain * image for image in (still, moved)]
            if light == 1:  # a reflection that sparkles, in one light and one state
                glare = np.exp(-((x - 90) ** 2 + (y - 150) ** 2) / (2 * 35**2))
                sparkle = gaussian_filter(random.normal(size=x.shape), 1.0)
                pair[1] = pair[1] + 400 * glare * (1 + 2 * sparkle / sparkle.std())
            lights.append([image + 200 * self.noise * random.normal(size=image.shape) for image in pair])
        return np.swapaxes(lights, 0, 1), u

    def settings(self) -> TestSettings:
        region = RegionSettings(rectangle=(8, 8, self.side - 9, self.side - 9))
        if self.kind == "hole":
            turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
            ring = (self.side - 1) / 2 + (self.width + 3) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            region = replace(region, holes=(tuple((float(x), float(y)) for x, y in ring),))
        return TestSettings(frames=FrameSettings(path=()), region=region)

    def true_errors(self, states: Array, field: Array, sizes: tuple[float, ...] = SIZES) -> dict[float, float]:
        """Error of elements of each size, rms over the pixels of the region and both components, px."""
        found = {}
        plan = Plan.from_settings(self.settings(), source=list(states.astype(np.float32)))
        deformed = resolution._deformed(plan, 1)
        for size in sizes:
            sized = resolution._resized(plan, size)
            solution = resolution.solved(sized, deformed, None)
            found[size] = field_rms(sized.reference.mesh, solution.displacement, field)
        return found


def around_hole(x: Array, y: Array, radius: float) -> Array:
    """Displacement (2, ...) px around a hole in a sheet that is strained by 1 along y (Kirsch; Poisson's ratio .33)."""
    poisson = 0.33
    kolosov = (3 - poisson) / (1 + poisson)
    away = np.maximum(np.hypot(x, y), radius) / radius
    angle = np.arctan2(x, y)
    outwards = away * (kolosov - 1 + 2 * np.cos(2 * angle))
    outwards += 2 / away * (1 + (kolosov + 1) * np.cos(2 * angle)) - 2 / away**3 * np.cos(2 * angle)
    around = -2 * np.sin(2 * angle) * (away + (kolosov - 1) / away + 1 / away**3)
    to_strain = radius * (1 + poisson) / 4  # stress over eight shear moduli, for a strain of 1
    return to_strain * np.stack(
        [outwards * np.sin(angle) + around * np.cos(angle), outwards * np.cos(angle) - around * np.sin(angle)]
    )


SCENES = (
    Scene("bump", 14, 1.0, 0.06, lights=3, seed=31),
    Scene("bump", 32, 2.0, 0.04, seed=32),
    Scene("bump", 64, 4.0, 0.12, lights=3, seed=33, speckle=5.0),
    Scene("wave", 70, 0.3, 0.10, seed=34),
    Scene("wave", 160, 2.0, 0.15, lights=3, seed=35),
    Scene("band", 18, 0.8, 0.10, lights=3, seed=36),
    Scene("band", 50, 2.0, 0.03, seed=37),
    Scene("tip", 30, 1.0, 0.05, lights=3, seed=38),
    Scene("tip", 50, 1.0, 0.20, seed=39),
    Scene("affine", 120, 3.0, 0.08, lights=3, seed=40, speckle=2.8),
)
"""Features of 14 to 160 px, a square root beside a point, noise of 3 to 20 % of the contrast, one light, and three of
which one reflects. No constant was chosen on them."""
QUICK = (4, 6)


def judged(scene: Scene) -> Row:
    """Recommended size of a scene beside the best one."""
    states, field = scene.images()
    true = scene.true_errors(states, field)
    study = study_sizes(scene.settings(), SIZES, gauges=(), source=list(states.astype(np.float32)))
    enough = [size for size in SIZES if size >= SPECKLES * study.speckle]
    best, chosen = min(enough, key=true.__getitem__), study.choice
    assert chosen is not None
    stated = next(one for one in study.sizes if one.element_size == chosen.element_size)
    return {
        "field": scene.name,
        "lights": str(scene.lights),
        "noise [%]": f"{100 * scene.noise:g}",
        "recommended [px]": int(chosen.element_size),
        "best [px]": int(best),
        "error of the recommended [px]": true[chosen.element_size],
        "least error [px]": true[best],
        "estimated error [px]": stated.total,
    }


@table("resolution", page="how-to/resolution", cost=15, keys=3)
def recommended(quick: bool) -> Iterator[Row]:
    """Element size that `rgbmidic resolution` recommends, and the one with the smallest true error (rms over the
    pixels).

    Sizes of 10 (where three speckles fit), 16, 25, 40 and 63 px, two frames of 256 px, one draw of speckle and noise.
    """
    for number, scene in enumerate(SCENES):
        if not quick or number in QUICK:
            yield judged(scene)


REFINED = tuple(
    (Scene(kind, width, height, 0.06, seed=50, side=380), start)
    for kind, width, height in (
        ("bump", 14, 1.5),
        ("hole", 20, 0.02),
        ("hole", 40, 0.02),
        ("wave", 90, 0.4),
        ("affine", 120, 1.0),
    )
    for start in (25.0, 40.0)
)
"""A bump and a hole that need small elements in one place, a wave that needs them everywhere, a plane nowhere; and the
element size that is refined."""


def errors(plan: Plan, states: Array, field: Array) -> tuple[float, ...]:
    """Error of displacement, px, and of strain, 1e-3: rms over the pixels of the region and the components; and the
    99 % quantile of that of a strain component, 1e-3.
    """
    solution = resolution.solved(plan, resolution._deformed(plan, 1), None)
    mesh, nodal = plan.reference.mesh, solution.strain
    (xx, xy), (yx, yy) = (np.gradient(part, axis=(1, 0)) for part in field)
    true = np.stack([xx, yy, (xy + yx) / 2])
    found = np.concatenate([at_pixels(mesh, nodal[:, pair], xx.shape) for pair in ([0, 1], [2, 2])])[:3]
    off = 1e3 * np.abs((found - true)[np.isfinite(found)])
    return field_rms(mesh, solution.displacement, field), float(np.sqrt(np.mean(off**2))), float(np.quantile(off, 0.99))


@table("refined_mesh", page="explanation/discretisation", cost=20, keys=3)
def refined_mesh(quick: bool) -> Iterator[Row]:
    """True errors on a mesh that `mesh.refine` made from elements of one size, and on a uniform one of as many nodes.

    Over the pixels: root mean square of displacement and of strain, and the 99 % quantile of strain. Frames of 380 px,
    speckle of 3.5 px, noise of 6 % of its contrast, means of two draws.
    """
    for scene, start in REFINED[:1] if quick else REFINED:
        draws = []
        for seed in (scene.seed, scene.seed + 1):
            drawn = replace(scene, seed=seed)
            states, field = drawn.images()
            plan = Plan.from_settings(
                replace(drawn.settings(), mesh=MeshSettings(element_size=start)), source=list(states.astype(np.float32))
            )
            finer = refine(plan)
            count, mesh = len(finer.reference.mesh.nodes), plan.reference.mesh
            sizes = np.sqrt(mesh.areas.sum() / count) * np.linspace(0.8, 1.25, 19)
            meshes = (Tri3Mesh.from_region(plan.region, size) for size in sizes)
            even = min(meshes, key=lambda one: abs(len(one.nodes) - count))
            pair = (finer, plan.on_mesh(even))
            draws.append([(len(one.reference.mesh.nodes), *errors(one, states, field)) for one in pair])
        for kind, (nodes, moved, strain, largest) in zip(("refined", "uniform"), np.mean(draws, axis=0), strict=True):
            yield {
                "field": scene.name if scene.kind != "affine" else "plane",
                "from [px]": f"{start:g}",
                "mesh": kind,
                "nodes": round(nodes),
                "displacement [px]": moved,
                "strain [1e-3]": strain,
                "strain 99 % [1e-3]": largest,
            }
