"""How much the chosen constants of the solve matter: each is halved and doubled.

Three scenes with exact speckle, noise of 3 grey levels, a motion with strain and rotation, and reflections of up to 60
grey levels in the deformed state: three lights with a reflection in each, the same with a part left out and rigid
motions, and one light whose reflection decorrelates nodes.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from functools import cache
from typing import Any

import cv2
import numpy as np
from textures import Affine, Texture

from rgbmidic import Solution, correlate
from rgbmidic.typing import FloatArray

from .tables import Row, table

SHAPE, REGION = (200, 240), (15, 15, 222, 182)
CONSTANTS = {
    "equations": ("_SMOOTHNESS", "_ROUNDING", "_LONGEST_STEP", "_PATIENCE"),
    "assembly": ("_ANCHOR",),
    "uncertainty": ("_LEAST_RATIO", "_LEAST_FRACTION", "_EVEN", "_SCORE_RANGE", "_PRIOR"),
    "images": ("_RANGE",),
    "residual": ("_SMOOTHNESS", "_LEAST_GAIN", "_LEAST_BEND", "_FITTED", "_TURNS"),
    "nodes": ("_WORSE", "_MISFIT", "_ONE_SIDED", "_NOISY"),
    "solve": ("_STARTED", "_WANDERING", "_SWINGING", "_SETTLED", "_LOOKED_AT"),
    "start": ("_NORMALISE", "_FLAT", "_GREY", "_VOTERS", "_TOLERANCE", "_CONTEXT"),
    "light_weights": ("_FREEDOM", "_LEAST_VARIANCE", "_ROUNDING", "_OWN"),
}
QUICK = ("anchor", "even", "grey", "least variance", "misfit", "range", "smoothness", "swinging")
"""At least one of each module."""
NOTHING = {"displacement/stated": 1e-3, "stated [%]": 0.01}
"""What is as good as no change: the last iteration of a solve may move the nodes by so much."""
TENFOLD = ("_SMOOTHNESS", "_ROUNDING", "_ANCHOR")
"""Constants of `equations` and `assembly` of which only the order of magnitude counts."""


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


def scenes() -> dict[str, Solution]:
    """Solve the three scenes."""
    first, second = images()
    weights = np.ones_like(first)
    weights[:, 90:130, 150:200] = 0
    return {
        "lights": correlate(first, second, region=REGION, brightness="local"),
        "gap": correlate(first, second, region=REGION, weights=weights, element_size=15, rigid="translation"),
        "one": correlate(first[0], second[0], region=REGION, element_size=12),
    }


def scaled(value: Any, factor: float) -> Any:
    """Return a number times a factor, a whole one rounded."""
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


@table("constants", page="explanation/uncertainty", cost=20, keys=2, seed=3, within=NOTHING)
def constants(quick: bool) -> Iterator[Row]:
    """Constants of the solve halved and doubled (tenfold where only the order counts), in three scenes: root mean
    square change of the displacement over its stated uncertainty, change of the median stated uncertainty, and of the
    fraction of nodes measured; the larger of the two, in the scene where it is largest.
    """
    rooms = {name: "weights" if name == "light_weights" else "correlation" for name in CONSTANTS}
    modules = {name: importlib.import_module(f"rgbmidic.{room}.{name}") for name, room in rooms.items()}
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
            for factor in (0.1, 10) if name in ("equations", "assembly") and constant in TENFOLD else (0.5, 2):
                setattr(modules[name], constant, scaled(value, factor))
                try:
                    found += [change(usual[scene], after) for scene, after in scenes().items()]
                finally:
                    setattr(modules[name], constant, value)
            displacement, std, nodes = np.max(found, axis=0)
            yield {
                "part": f"{rooms[name]}/{name}",
                "constant": words,
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
