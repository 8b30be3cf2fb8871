"""How much the chosen constants of the solve matter: each is halved and doubled.

Seven scenes with exact speckle and noise of 3 grey levels. Three have a motion with strain and rotation, and
reflections of up to 60 grey levels in the deformed state: three lights with a reflection in each, the same with a
part left out and rigid motions, and one light whose reflection decorrelates nodes. One light sees the others: a part
shows another texture, two bodies move apart, a shadow takes nearly all contrast, with both ways to correct it.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import cv2
import numpy as np
from textures import Affine, Texture

from rgbmidic import Solution, correlate
from rgbmidic.typing import FloatArray
from rgbmidic.weights import Statistics

from .tables import Row, table

SHAPE, REGION = (200, 240), (15, 15, 222, 182)
CONSTANTS = {
    "equations": ("_SMOOTHNESS", "_LONGEST_STEP", "_PATIENCE"),
    "assembly": ("_ANCHOR",),
    "uncertainty": ("_EVEN", "_SCORE_RANGE", "_PRIOR"),
    "images": ("_RANGE",),
    "residual": ("_SMOOTHNESS", "_FITTED", "_TURNS"),
    "nodes": ("_WORSE", "_ONE_SIDED", "_NOISY"),
    "solve": ("_STARTED", "_WANDERING", "_SWINGING", "_SETTLED"),
    "start": ("_NORMALISE", "_FLAT", "_GREY", "_VOTERS", "_TOLERANCE", "_CONTEXT"),
}
STATISTICS = ("freedom", "least_variance", "own")
"""Fields of `rgbmidic.weights.Statistics`."""
QUICK = ("anchor", "even", "grey", "least variance", "noisy", "range", "smoothness", "swinging")
"""At least one of each module."""
NOTHING = {"displacement/stated": 1e-3, "stated [%]": 0.01}
"""What is as good as no change: the last iteration of a solve may move the nodes by so much."""
COARSE = {"_SMOOTHNESS": 10, "_ANCHOR": 10, "_SETTLED": 100, "_VOTERS": 10, "_TOLERANCE": 100}
"""Constants of which only the order of magnitude counts, and factors."""


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


def scenes(statistics: Statistics | None = None) -> dict[str, Solution]:
    """Solve the scenes."""
    solve = partial(correlate, statistics=statistics or True)
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
        "hole": solve(noisy[0], noisy[1], region=REGION, element_size=14),
        "apart": solve(noisy[0], noisy[2], region=REGION, element_size=14),
        "shadow": solve(noisy[0], noisy[3], region=REGION, element_size=14, brightness="local"),
        "shadow, mean": solve(noisy[0], noisy[3], region=REGION, element_size=14, brightness="mean"),
        "lights": solve(first, second, region=REGION, brightness="local"),
        "gap": solve(first, second, region=REGION, weights=weights, element_size=15, rigid="translation"),
        "one": solve(first[0], second[0], region=REGION, element_size=12),
    }


def scaled(value: Any, factor: float) -> Any:
    """Return a number times a factor, a whole one rounded."""
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@table("constants", page="explanation/uncertainty", cost=20, keys=2, seed=3, within=NOTHING)
def constants(quick: bool) -> Iterator[Row]:
    """Constants of the solve halved and doubled (ten- or a hundredfold where only the order counts), in seven scenes:
    root mean square change of the displacement over its stated uncertainty, change of the median stated uncertainty,
    and of the fraction of nodes measured; the larger of the two, in the scene where it is largest.
    """
    modules = {name: importlib.import_module(f"rgbmidic.correlation.{name}") for name in CONSTANTS}
    stale = [(name, one) for name, names in CONSTANTS.items() for one in names if not hasattr(modules[name], one)]
    if stale:
        raise AttributeError(f"constants that are not there: {stale}")
    usual = scenes()
    for name, names in CONSTANTS.items():
        for constant in names:
            words = constant.strip("_").lower().replace("_", " ")
            if quick and words not in QUICK:
                continue
            found, value = [], getattr(modules[name], constant)
            coarse = 2 if name == "residual" else COARSE.get(constant, 2)
            for factor in (1 / coarse, coarse):
                setattr(modules[name], constant, scaled(value, factor))
                try:
                    found += [change(usual[scene], after) for scene, after in scenes().items()]
                finally:
                    setattr(modules[name], constant, value)
            yield row(f"correlation/{name}", words, found)
    for constant in STATISTICS:
        words, value = constant.replace("_", " "), getattr(Statistics(), constant)
        if not quick or words in QUICK:
            varied = [scenes(replace(Statistics(), **{constant: scaled(value, factor)})) for factor in (0.5, 2)]
            found = [change(usual[scene], after) for one in varied for scene, after in one.items()]
            yield row("weights/light_weights", words, found)


def row(part: str, constant: str, found: list[tuple[float, float, float]]) -> Row:
    """The largest changes over the scenes."""
    displacement, std, nodes = np.max(found, axis=0)
    return {
        "part": part,
        "constant": constant,
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
