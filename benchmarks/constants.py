"""How much the chosen constants of the solve matter: each is halved and doubled; prints what changes.

    python benchmarks/constants.py

Three scenes with exact speckle, noise of 3 grey levels, a motion with strain and rotation, and reflections of up to 60
grey levels in the deformed state: "lights" (three lights, a reflection in each), "gap" (the same with a part left out,
rigid motions), and "one" (one light, whose reflection decorrelates nodes). Printed are the largest change of a measured
displacement (px), the median change of its standard uncertainty, and how many nodes more are measured.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rgbmidic import Solution, correlate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from textures import Affine, Texture

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
    "statistics": ("_FREEDOM", "_LEAST_VARIANCE", "_ROUNDING"),
}
TENFOLD = ("_SMOOTHNESS", "_ROUNDING", "_ANCHOR")
"""Constants of `equations` and `assembly` of which only the order of magnitude counts."""


def scenes() -> dict[str, Solution]:
    """Solve the three scenes."""
    rng, texture = np.random.default_rng(3), Texture.random(2)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    motion = Affine.strain_and_rotation(0.004, 0.5, (1.2, 0.4))
    first, second = np.empty((2, 3, *SHAPE))
    for light in range(3):
        first[light] = texture.image(SHAPE) + rng.normal(0, 3, SHAPE)
        second[light] = texture.image(SHAPE, motion) * (1 + 0.05 * light) + rng.normal(0, 3, SHAPE)
        spot = np.exp(-((x - 60 - 50 * light) ** 2 + (y - 100) ** 2) / 900)
        second[light] += 60 * spot * cv2.GaussianBlur(rng.random(SHAPE), (0, 0), 1)
    weights = np.ones_like(first)
    weights[:, 90:130, 150:200] = 0
    return {
        "lights": correlate(first, second, region=REGION, brightness="local"),
        "gap": correlate(first, second, region=REGION, weights=weights, element_size=15, rigid="translation"),
        "one": correlate(first[0], second[0], region=REGION, element_size=12),
    }


def change(before: Solution, after: Solution) -> str:
    """Report what differs."""
    both = before.measured & after.measured
    motion = np.abs(after.displacement - before.displacement)[both].max()
    std = np.median(np.abs(after.displacement_std / before.displacement_std - 1)[both])
    return f"{motion:.0e} px, std {std:.1%}, nodes {int(after.measured.sum()) - int(before.measured.sum()):+d}"


def scaled(value: Any, factor: float) -> Any:
    """Return a number times a factor, a whole one rounded."""
    return max(1, round(value * factor)) if isinstance(value, int) else value * factor


def main() -> None:
    """Print a line for every constant and factor."""
    usual = scenes()
    for name, constants in CONSTANTS.items():
        room = "weights" if name == "statistics" else "correlation"
        module = importlib.import_module(f"rgbmidic.{room}.{name}")
        for constant in constants:
            value = getattr(module, constant)
            for factor in (0.1, 10) if name in ("equations", "assembly") and constant in TENFOLD else (0.5, 2):
                setattr(module, constant, scaled(value, factor))
                found = "; ".join(f"{scene} {change(usual[scene], after)}" for scene, after in scenes().items())
                print(f"{name}.{constant} x {factor:g}: {found}", flush=True)
            setattr(module, constant, value)


if __name__ == "__main__":
    main()
