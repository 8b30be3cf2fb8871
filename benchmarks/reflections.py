"""What the product is for: plain DIC, the paper's masks, other programs and rgbmidic in a reflection."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

from bench import Bench
from measurement import SceneStudy
from rgbmidic.fields import at_nodes
from rgbmidic.illumination import IlluminationImages
from rgbmidic.illumination.images import local_mean
from rgbmidic.typing import AnyArray, FloatArray
from run import run_scene

from .contenders import CONTENDERS, MODULES
from .study import bench_study
from .tables import MissingDataError, Row, table
from .uncertainty import rms

METHODS = {"dic": "plain DIC with one lamp", "midic": "the paper's binary masks", "default": "rgbmidic"}
LIGHTS = {
    "sequential": "two lamps in succession",
    "bayer": "three colours in one Bayer shot",
    "3-CCD": "three colours with a 3-CCD camera",
}
SIZE, ANGLES, SEEDS = 640, (0.333, 1.0, 2.0, 8.0), (0, 1, 2)
CROSSED = slice(3, 5)
"""Areas A3 and A4: the reflection covers A4 at rest and has come to A3 at 8 degrees."""
TREND = 1.3
"""An area is as good as A0 up to this multiple of its P (examples/paper/claims.py)."""
PEERS = ("pyvale", "al-dic", "pyxel-dic")
LOST = 2.0
"""Error (px) beyond which a point of another program is counted as not found instead."""


def studies_of(name: str, angles: tuple[float, ...], quick: bool, **settings: Any) -> list[SceneStudy]:
    """One study of a bench for each seed; quick: those of the paper's experiment, one seed with every method."""
    if quick:
        return [replace(study, angles=angles) for study in bench_study(True).scenes]
    return [run_scene(Bench.build(name, SIZE, seed=seed), angles, **settings) for seed in SEEDS]


@table(
    "reflections", page="explanation/polarisers", cost=200, own_quick=True, within={"areas within 1.3 A0 [%]": 200 / 4}
)
def reflections(quick: bool) -> Iterator[Row]:
    """A sphere turning by 0.33 to 8 degrees under a reflection: the paper's perturbation P and the error. The coloured
    lamps are seen through a lens with lateral colour of half a pixel at the corners from one lamp to the next."""
    angles = (1.0,) if quick else ANGLES
    for name in ("sequential",) if quick else LIGHTS:
        studies = studies_of(name, angles, quick, methods=tuple(METHODS))
        for method, title in METHODS.items():
            p, error, ratio = (
                np.concatenate([study.series(method, quantity) for study in studies])
                for quantity in ("perturbation", "rms", "ratio")
            )
            yield {
                "lights": LIGHTS[name],
                "method": title,
                "P beside the reflection [px]": rms(p[:, 0]),
                "P in it [px]": rms(p[:, CROSSED]),
                "areas within 1.3 A0 [%]": 100 * float((p[:, 1:] <= TREND * p[:, :1]).mean()),
                **{
                    f"error in it at {angle:g} deg [px]": rms(error[number :: len(angles), CROSSED])
                    for number, angle in enumerate(angles)
                    if angle in (1, 8)
                },
                "error/stated in it": rms(ratio[:, CROSSED]),
            }


@table("reflections_areas", page="explanation/polarisers", cost=90, keys=2, own_quick=True)
def areas(quick: bool) -> Iterator[Row]:
    """The same sphere: error of rgbmidic in each area, and error over stated uncertainty."""
    angles = (1.0,) if quick else (1.0, 8.0)
    for name in ("sequential",) if quick else LIGHTS:
        studies = studies_of(name, angles, quick, methods=("default",), set_up=())
        for number, angle in enumerate(angles):
            error, ratio = (
                np.array([study.series("default", quantity)[number] for study in studies])
                for quantity in ("rms", "ratio")
            )
            row: Row = {"lights": LIGHTS[name], "angle [deg]": angle}
            row |= {f"A{area} [px]": rms(error[:, area]) for area in range(5)}
            yield row | {f"A{area}: error/stated": rms(ratio[:, area]) for area in range(5)}


@table("reflections_peers", page="explanation/polarisers", cost=240, keys=2)
def with_peers(quick: bool) -> Iterator[Row]:
    """The same sphere in one Bayer shot: error in A3 and A4 of other programs, which get our light images, divided by
    their local mean, of the lamp that is best for them in hindsight or the mean of the three, and of rgbmidic, which
    gets all three. Points that are over 2 px wrong count as not found. They have subsets or elements of 25 px."""
    for name in PEERS:
        if importlib.util.find_spec(MODULES.get(name, name)) is None:
            raise MissingDataError(f"{name} is not installed here: pip install '.[bench]' in an environment of its own")
    found: dict[tuple[str, str], dict[float, list[FloatArray]]] = {}
    for seed in SEEDS[:1] if quick else SEEDS:
        bench = Bench.build("bayer", SIZE, seed=seed)
        clean = {angle: bench.render(angle) for angle in (0.0, 1.0, 8.0)}
        gain = bench.exposure_gain(max(bench.brightest(images) for images in clean.values()))
        shots = {angle: bench.photograph(images * gain, n, "auto") for n, (angle, images) in enumerate(clean.items())}
        pictures = {angle: seen(images) for angle, images in shots.items()}
        for angle in (1.0,) if quick else (1.0, 8.0):
            exact = bench.truth(angle)
            for what, f, g in zip(
                ("red", "green", "blue", "mean of three"), pictures[0.0], pictures[angle], strict=True
            ):
                for name in PEERS:
                    points, displacement = CONTENDERS[name](f, g, 2)
                    errors = in_reflection(bench, exact, points, displacement)
                    found.setdefault((f"{name} {version(name)}", what), {}).setdefault(angle, []).append(errors)
            study = run_scene(bench, (angle,), methods=("default",), set_up=())
            error = np.repeat(study.series("default", "rms")[0, CROSSED][:, None], 2, axis=1)
            found.setdefault(("rgbmidic", "three lights"), {}).setdefault(angle, []).append(error)
    yield from best(found)


def seen(images: IlluminationImages) -> FloatArray:
    """8-bit pictures (4, H, W) of the lights on the first one's grid and of their mean, over their local mean."""
    lights = np.stack([image / local_mean(image, 10.0) for image in images.on_first_light().values])
    every = np.concatenate([lights, lights.mean(axis=0, keepdims=True)])
    return np.asarray(np.nan_to_num(every * 110, nan=110.0).clip(0, 255).round(), dtype=np.float64)


def in_reflection(bench: Bench, exact: AnyArray, points: FloatArray, displacement: FloatArray) -> FloatArray:
    """Errors (n, 2) at the points in A3 and A4; NaN where nothing was found."""
    inside = np.zeros(len(points), dtype=bool)
    for area in bench.areas[CROSSED]:
        x0, y0, x1, y1 = area.rectangle
        inside |= ((points >= (x0, y0)) & (points <= (x1, y1))).all(axis=1)
    error = displacement[inside] - at_nodes(exact, points[inside])
    return np.where((np.hypot(*error.T) > LOST)[:, None], np.nan, error)


def best(found: dict[tuple[str, str], dict[float, list[FloatArray]]]) -> Iterator[Row]:
    """Rows; of the single lamps that with the least error at the largest angle, a lost point counted as 2 px."""
    rows: dict[tuple[str, str], tuple[float, Row]] = {}
    for (program, what), angles in found.items():
        row: Row = {}
        for angle, parts in angles.items():
            errors = np.concatenate(parts)
            row[f"error at {angle:g} deg [px]"] = rms(errors[np.isfinite(errors)])
            row[f"not found at {angle:g} deg [%]"] = 100 * float(np.isnan(errors).any(axis=1).mean())
        worst = rms(np.nan_to_num(errors, nan=LOST))
        kind = "best lamp alone" if what in ("red", "green", "blue") else what
        if (program, kind) not in rows or worst < rows[program, kind][0]:
            rows[program, kind] = worst, row
    for (program, kind), (_, row) in rows.items():
        yield {"program": program, "images": kind} | row
