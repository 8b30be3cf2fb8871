"""How much the chosen constants of the solve matter: each is halved and doubled.

Six scenes with exact speckle and noise of 3 grey levels. Three have a motion with strain and rotation, and
reflections of up to 60 grey levels in the deformed state: three lights with a reflection in each, the same with a
part left out and rigid motions, and one light whose reflection decorrelates nodes. One light sees the others: a part
shows another texture, two bodies move apart, a shadow takes nearly all contrast.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from textures import Affine, Texture

from rgbmidic import Region, Solution, SolverSettings, Tri3Mesh
from rgbmidic.correlation import Deformed, Reference, SolverConstants, TrackingState, track
from rgbmidic.correlation.images import as_light_stack
from rgbmidic.correlation.start import Search
from rgbmidic.mesh.pixel_map import SlidingWindow
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import FloatArray
from rgbmidic.weights import Statistics, as_weights

from .tables import Row, table

SHAPE, REGION = (200, 240), (15, 15, 222, 182)
VARIED = {
    "solver": (
        *("smoothness", "information_smoothing", "score_range", "prior_blocks", "gain_window_factor", "outlier_factor"),
        *("min_initial_zncc", "max_oscillating_fraction"),
    ),
    "window": ("sigma",),
    "search": ("normalise", "flat", "voters", "context"),
    "statistics": ("freedom", "independent_fraction"),
}
"""Constants of each part of the method."""
QUICK = ("sigma",)
"""Of `--quick`: the window of all sums over blocks."""
NOTHING = {"displacement/stated": 1e-3, "stated [%]": 0.01}
"""What is as good as no change: the last iteration of a solve may move the nodes by so much."""
COARSE = {"smoothness": 10, "voters": 10}
"""Constants of which only the order of magnitude counts, and factors."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """The parts of the method that have constants."""

    solver: SolverConstants = field(default_factory=SolverConstants)
    window: SlidingWindow = field(default_factory=SlidingWindow)
    search: Search = field(default_factory=Search)
    statistics: Statistics = field(default_factory=Statistics)

    def scaled(self, part: str, name: str, factor: float) -> Method:
        """The method with one constant times a factor, a whole one rounded."""
        value = getattr(getattr(self, part), name)
        other = max(1, round(value * factor)) if isinstance(value, int) else value * factor
        return replace(self, **{part: replace(getattr(self, part), **{name: other})})

    def solve(self, first: FloatArray, second: FloatArray, **options: Any) -> Solution:
        """What `correlate` gives with this method."""
        f, g = as_light_stack(first, "first"), as_light_stack(second, "second")
        weights = as_weights(options.pop("weights", None), f.shape, "weights")
        region = Region.from_rectangle(REGION, SHAPE)
        mesh = Tri3Mesh.from_region(region, options.pop("element_size", ELEMENT_SIZE))
        settings = SolverSettings(**options)
        prefilter = settings.prefilter
        reference = Reference.prepare(f, region, weights, mesh=mesh, prefilter=prefilter, constants=self.solver)
        deformed = Deformed.prepare(g, None, prefilter=prefilter)
        statistics = replace(self.statistics, window=self.window)
        return track(reference, deformed, TrackingState(displacement=None), settings, statistics, self.search)


@cache
def images() -> tuple[FloatArray, FloatArray]:
    """Three lights (3, H, W) of both states."""
    rng, texture = np.random.default_rng(3), Texture.random(2)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    motion = Affine.strain_and_rotation(0.004, 0.5, (1.2, 0.4))
    first, second = np.empty((2, 3, *SHAPE))
    for light in range(3):
        first[light] = texture.image(SHAPE) + rng.normal(0, 3, SHAPE)
        second[light] = texture.image(SHAPE, motion) * (1 + 0.05 * light) + rng.normal(0, 3, SHAPE)
        spot = np.exp(-((x - 60 - 50 * light) ** 2 + (y - 100) ** 2) / 900)
        second[light] += 60 * spot * cv2.GaussianBlur(rng.random(SHAPE), (0, 0), 1)
    return first, second


def scenes(method: Method) -> dict[str, Solution]:
    """Solve the scenes."""
    first, second = images()
    weights = np.ones_like(first)
    weights[:, 90:130, 150:200] = 0
    rng, texture = np.random.default_rng(5), Texture.random(2)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    near, far = Affine.strain_and_rotation(0.004, 0.5, (1.2, 0.4)), Affine.strain_and_rotation(0.0, 0.0, (12.0, 3.0))
    rest, moved = (texture.image(SHAPE, motion) for motion in (Affine.strain_and_rotation(0.0, 0.0), near))
    another = np.where((x - 110) ** 2 + (y - 100) ** 2 < 35**2, Texture.random(9).image(SHAPE), moved)
    apart = np.where(x > 120, texture.image(SHAPE, far), moved)
    dark = 100 + (moved - 100) * (1 - 0.97 * np.exp(-((x - 120) ** 2 + (y - 100) ** 2) / (2 * 25**2)))
    noisy = [one + rng.normal(0, 3, SHAPE) for one in (rest, another, apart, dark)]
    return {
        "hole": method.solve(noisy[0], noisy[1], element_size=14),
        "apart": method.solve(noisy[0], noisy[2], element_size=14),
        "shadow": method.solve(noisy[0], noisy[3], element_size=14),
        "lights": method.solve(first, second),
        "gap": method.solve(first, second, weights=weights, element_size=15, rigid="translation"),
        "one": method.solve(first[0], second[0], element_size=12),
    }


@table("constants", page="explanation/uncertainty", cost=20, keys=2, seed=3, within=NOTHING)
def constants(quick: bool) -> Iterator[Row]:
    """Constants of the solve halved and doubled (ten- or a hundredfold where only the order counts), in six scenes:
    root mean square change of the displacement over its stated uncertainty, change of the median stated uncertainty,
    and of the fraction of nodes measured; the larger of the two, in the scene where it is largest.
    """
    usual = scenes(Method())
    for part, names in VARIED.items():
        for name in names:
            if quick and name not in QUICK:
                continue
            coarse = COARSE.get(name, 2)
            changed = [scenes(Method().scaled(part, name, factor)) for factor in (1 / coarse, coarse)]
            found = [change(usual[scene], after) for one in changed for scene, after in one.items()]
            displacement, std, nodes = np.max(found, axis=0)
            yield {
                "part": part,
                "constant": name.replace("_", " "),
                "displacement/stated": float(displacement),
                "stated [%]": 100 * float(std),
                "nodes [%]": 100 * float(nodes),
            }


def change(before: Solution, after: Solution) -> tuple[float, float, float]:
    """What differs: displacement over its standard uncertainty, that uncertainty, and nodes, both as fractions."""
    both = before.measured & after.measured
    motion = ((after.displacement - before.displacement) / before.displacement_std)[both]
    std = np.median(after.displacement_std[both] / before.displacement_std[both]) - 1
    return (
        float(np.sqrt(np.mean(motion**2))),
        abs(float(std)),
        abs(float(after.measured.mean() - before.measured.mean())),
    )
