"""The paper's own experiment on the virtual bench (examples/paper): its statements, and its methods beside ours."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "paper"))

import numpy as np
from causes import VARIATIONS, find_causes
from claims import judge
from measurement import METHODS
from run import run_paper_study

from .tables import table

SIZE, ANGLES = 768, (0.333, 1.0, 2.0, 4.0, 8.0, 14.0)
SMALL, FEW = 448, (8.0,)
"""Frames (px) and angles (degrees) of the tables, and of `--quick`."""


@cache
def _study(quick: bool) -> Any:
    if quick:
        return run_paper_study(FEW, size=SMALL, scenes=("sequential",), causes=False)
    return run_paper_study(ANGLES, size=SIZE, causes=False)


@table("study", page="explanation/study", cost=200)
def perturbation(quick: bool) -> Iterator[dict[str, object]]:
    """Perturbation P of the five areas by the paper's methods, as in the paper and in our solver, and by the default."""
    for scene in _study(quick).scenes:
        for method, settings in METHODS.items():
            for angle, row in zip(scene.angles, scene.perturbation(method), strict=True):
                areas = {f"{area.name} [1e-3 px]": 1e3 * p for area, p in zip(scene.bench.areas, row, strict=True)}
                ratios = {"A3/A0": row[3] / row[0], "A4/A0": row[4] / row[0]}
                yield {"scene": scene.bench.name, "method": settings.title, "angle [deg]": f"{angle:g}"} | areas | ratios


@table("study_ratio", page="explanation/study", cost=1)
def ratio(quick: bool) -> Iterator[dict[str, object]]:
    """P of areas and angles above 0 over that of A0: fraction within 1.3, median, largest; and P over that by plain DIC
    of the paper, median up to 2 degrees and from 6 on."""
    for scene in _study(quick).scenes:
        angles = np.array(scene.angles)
        plain = scene.perturbation("dic")
        for method, settings in METHODS.items():
            p = scene.perturbation(method)
            over = p[:, 1:] / p[:, :1]
            known = np.isfinite(over)
            small, large = (
                float(np.nanmedian((p / plain)[part])) if part.any() else float("nan")
                for part in (angles <= 2, angles >= 6)
            )
            yield {
                "scene": scene.bench.name,
                "method": settings.title,
                "within 1.3 A0": float((over <= 1.3).sum() / over.size),
                "median P/A0": float(np.median(over[known])),
                "largest P/A0": float(over[known].max()),
                "over DIC, to 2 deg": small,
                "over DIC, from 6 deg": large,
            }


@table("study_claims", page="explanation/study", cost=1)
def claims(quick: bool) -> Iterator[dict[str, object]]:
    """The paper's statements, and what the virtual bench measures with the paper's methods as they are."""
    for claim in judge(_study(quick)):
        yield {
            "scene": claim.scene or "flat specimen",
            "paper": claim.figure,
            "statement": claim.statement,
            "verdict": claim.verdict,
            "measured": claim.measured,
        }


@table("study_causes", page="explanation/study", cost=70)
def causes(quick: bool) -> Iterator[dict[str, object]]:
    """P in the reflection and far from it with one thing changed at a time, one lamp, frames of 512 px."""
    some = {"size": SMALL, "variations": [VARIATIONS[0]]} if quick else {}
    for cause in find_causes(FEW if quick else (0.333, 1.0, 8.0), **some):
        for number, method in enumerate(("DIC", "GLC-DIC")):
            for angle, inside, outside in zip(cause.angles, cause.inside[number], cause.outside[number], strict=True):
                yield {
                    "change": cause.title,
                    "method": method,
                    "angle [deg]": f"{angle:g}",
                    "in the reflection [1e-3 px]": 1e3 * inside,
                    "far from it [1e-3 px]": 1e3 * outside,
                }
