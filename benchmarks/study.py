"""The paper's own experiment on the virtual bench (examples/paper): its statements, and its methods beside ours."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from renders import kept

from causes import VARIATIONS, Cause, find_causes
from claims import judge
from measurement import METHODS
from run import run_paper_study

from .tables import table

SIZE, ANGLES = 768, (0.333, 1.0, 2.0, 4.0, 8.0, 14.0)
SMALL, FEW = 448, (1.0, 8.0)
"""Frames (px) and angles (degrees) of the tables, and of `--quick`."""


@kept
def bench_study(quick: bool) -> Any:
    """The study, kept for the tables that are made of it."""
    scenes = {"size": SMALL, "scenes": ("sequential",)} if quick else {"size": SIZE}
    return run_paper_study(FEW if quick else ANGLES, causes=False, **scenes)


@kept
def small_cause(number: int) -> Cause:
    """One of the `VARIATIONS` in small frames at 8 degrees."""
    return find_causes((8.0,), size=SMALL, variations=[VARIATIONS[number]])[0]


def _text(words: str) -> str:
    """Words as a cell has them: without the characters that separate cells."""
    return words.replace(", ", " – ").replace("; ", " – ")


@table("study", page="explanation/study", cost=190, own_quick=True)
def perturbation(quick: bool) -> Iterator[dict[str, object]]:
    """Perturbation P of the five areas: the paper's methods as in the paper, two of them in rgbmidic's solver, and
    rgbmidic's default."""
    for scene in bench_study(quick).scenes:
        for method, settings in METHODS.items():
            for angle, row in zip(scene.angles, scene.perturbation(method), strict=True):
                areas = {f"{area.name} [1e-3 px]": 1e3 * p for area, p in zip(scene.bench.areas, row, strict=True)}
                yield (
                    {"scene": scene.bench.name, "method": _text(settings.title), "angle [deg]": f"{angle:g}"} | areas
                )


@table(
    "study_ratios",
    page="explanation/study",
    cost=0.5,
    own_quick=True,
    within={"within 1.3 A0": 2 / 8, "largest P/A0": 7.0},  # P of A0, at 1 degree, scatters by a third
)
def ratios(quick: bool) -> Iterator[dict[str, object]]:
    """P in A1 to A4 at all angles over that of A0: fraction within 1.3, median, largest; P of all areas over that of
    the paper's plain DIC, median over angles up to 2 and from 6 degrees; P within an element of the masks' frontiers
    over P beside them, median."""
    for scene in bench_study(quick).scenes:
        angles = np.array(scene.angles)
        plain = scene.perturbation("dic")
        for method, settings in METHODS.items():
            p = scene.perturbation(method)
            over = p[:, 1:] / p[:, :1]
            small, large = (
                float(np.nanmedian((p / plain)[part])) if part.any() else float("nan")
                for part in (angles <= 2, angles >= 6)
            )
            frontier = scene.series(method, "frontier")
            yield {
                "scene": scene.bench.name,
                "method": _text(settings.title),
                "within 1.3 A0": float((over <= 1.3).mean()),
                "median P/A0": float(np.nanmedian(over)),
                "largest P/A0": float(np.nanmax(over)),
                "over DIC to 2 deg": small,
                "over DIC from 6 deg": large,
                "at frontiers": float(np.median(frontier)) if np.isfinite(frontier).all() else float("nan"),
            }


@table("study_claims", page="explanation/study", cost=0.5, own_quick=True, keys=3)
def claims(quick: bool) -> Iterator[dict[str, object]]:
    """The paper's statements on the virtual bench, judged with the paper's methods as published; two verdicts where 1.5
    times as strict or as lenient a limit gives another."""
    for claim in judge(bench_study(quick)):
        names = {"scene": claim.scene or "flat specimen", "paper": _text(claim.figure)}
        yield names | {"statement": _text(claim.statement), "verdict": " or ".join(claim.possible)}


@table("study_causes", page="explanation/study", cost=60, own_quick=True)
def causes(quick: bool) -> Iterator[dict[str, object]]:
    """P (1e-3 px) in the reflection and far from it by the paper's DIC and GLC-DIC with one parameter changed at a
    time, one lamp, frames of 512 px."""
    for cause in [small_cause(0)] if quick else find_causes((1.0, 8.0)):
        row: dict[str, object] = {"change": _text(cause.title)}
        for number, method in enumerate(("DIC", "GLC-DIC")):
            for angle, inside, outside in zip(cause.angles, cause.inside[number], cause.outside[number], strict=True):
                row |= {f"{method} {angle:g} deg": 1e3 * inside, f"far from it {method} {angle:g} deg": 1e3 * outside}
        yield row
