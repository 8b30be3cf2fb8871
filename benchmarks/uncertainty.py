"""Tables of rendered scenes: whether displacement and stated uncertainty hold without tuning.

Scenes of `rgbmidic.tools.lab.virtual` with exact truth, seen by a raw Bayer camera (reflection-aware) and by an ideal
3-CCD one; every setting is the default of `rgbmidic.correlate` with images divided by their local mean (sigma 10 px).
"error/stated" is the root mean square of error over stated standard uncertainty of the measured nodes: 1 is right.
"covered" is the percentage of errors within 1.96 stated standard uncertainties: 95 is right.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from measures import area_stds
from rgbmidic import Status, correlate, measure_sequence
from rgbmidic.correlation import Solution
from rgbmidic.fields import at_nodes, at_pixels, field_rms, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.tools.lab.virtual import render, strained_plate, truth
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic.weights.threshold import threshold_weights

from .tables import Row, table
from .uncertainty_scenes import (
    CORRUPTIONS,
    KINDS,
    PAINTS,
    Pair,
    Setting,
    both,
    frame,
    glare_of,
    images_of,
    pair_of,
    turn,
)

THRESHOLDS = (0.26, 0.28, 0.3, 0.33, 0.36, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 2.0)
"""Blurred grey levels, as fractions of the full scale, above which the masks exclude a light; 2 excludes nothing."""
REFLECTION = 1 / 3
"""Fraction of a light's local mean that is not diffuse, above which a pixel counts as in a reflection."""


def square(size: int) -> tuple[int, int]:
    """First and last pixel of the measured square: whole elements of 25 px, at least 8 px from the frame's edge."""
    side = (size - 17) // 25 * 25
    return (size - 1 - side) // 2, (size - 1 - side) // 2 + side


def solve_pair(
    pair: Pair, images: tuple[IlluminationImages, IlluminationImages], threshold: float | None = None, **options: Any
) -> Solution:
    """Default solve, or the paper's binary masks with a threshold; started within half a pixel of the truth."""
    low, high = square(pair.size)
    region = Region.from_rectangle((low, low, high, high), (pair.size, pair.size))
    nodes = Tri3Mesh.from_region(region, 25).nodes
    options = {"initial": at_nodes(pair.exact, nodes) + 0.2, **options}
    if threshold is not None:
        first, second = (threshold_weights(image, threshold=threshold) for image in images)
        options |= {"weights": first, "deformed_weights": second, "statistics": False}
    return correlated(images, region, **options)


def correlated(images: tuple[IlluminationImages, IlluminationImages], region: Region, **options: Any) -> Solution:
    """Solution of two states; lights that have a registration are measured as a test is, from a search for the start.

    Raises
    ------
    ValueError
        Lights with a registration and options beyond the defaults.
    """
    if images[0].registration is None:
        return correlate(images[0].values, images[1].values, region=region, **options)
    if options.keys() != {"initial"}:
        raise ValueError(f"lights with a registration are measured by defaults only, not with {list(options)}")
    (solution,) = measure_sequence([images[1]], reference=images[0], region=region)
    return solution


@dataclass(frozen=True)
class Verdict:
    """A solution against the truth."""

    rms: float
    error: FloatArray
    ratio: FloatArray
    strain_ratio: FloatArray
    unmeasured: float

    @classmethod
    def of(cls, solution: Solution, pair: Pair) -> Verdict:
        """Error of the field without its border element, errors and ratios (N, ...) at the nodes."""
        mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
        error = solution.displacement - at_nodes(pair.exact, solution.nodes)
        strain = solution.strain - true_strain(pair, solution.nodes)
        return cls(
            rms=field_rms(mesh, solution.displacement, pair.exact, border=25),
            error=error,
            ratio=error / solution.displacement_std,
            strain_ratio=strain / solution.strain_std,
            unmeasured=float((~solution.measured).mean()),
        )


def true_strain(pair: Pair, nodes: FloatArray) -> FloatArray:
    """Strains exx, eyy, exy (N, 3) of the continuous field at the nodes."""
    dy, dx = (np.asarray(np.gradient(pair.exact, axis=axis)) for axis in (1, 2))
    return at_nodes(np.stack([dx[0], dy[1], (dy[0] + dx[1]) / 2]), nodes)


def reflecting(setting: Setting, solution: Solution) -> BoolArray:
    """Nodes at which, in one of the states, a reflection makes up more than a third of a light's local mean."""
    pair, (first, second) = pair_of(setting), glare_of(setting)
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    there = at_pixels(mesh, at_nodes(pair.exact, solution.nodes), (pair.size, pair.size))
    y, x = np.mgrid[: pair.size, : pair.size].astype(np.float32)
    bright = first.max(axis=0) > REFLECTION
    for light in second:
        warped = cv2.remap(light, np.nan_to_num(x + there[0]), np.nan_to_num(y + there[1]), cv2.INTER_LINEAR)
        bright |= warped > REFLECTION
    column, row = np.round(solution.nodes).astype(int).T
    return np.asarray(bright[row, column])


def rms(values: FloatArray) -> float:
    """Root mean square of what is finite."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def covered(ratio: FloatArray) -> float:
    """Fraction of errors within 1.96 standard uncertainties."""
    known = ratio[np.isfinite(ratio)]
    return float((np.abs(known) < 1.96).mean()) if known.size else float("nan")


def largest(values: FloatArray) -> float:
    """Largest absolute value of what is finite."""
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else float("nan")


def best_threshold(
    pair: Pair, images: tuple[IlluminationImages, IlluminationImages], default: Solution
) -> tuple[float, float]:
    """Threshold with the smallest true error, and that error; one that loses 1 % more nodes does not count."""
    found = []
    for threshold in THRESHOLDS:
        solution = solve_pair(pair, images, threshold)
        if (default.measured & ~solution.measured).mean() <= 0.01:
            found.append((Verdict.of(solution, pair).rms, threshold))
    error, threshold = min(found)
    return threshold, error


LENS = 0.5
"""Lateral colour (px at the corner from one light to the next) of a real lens: the default of a SCENE.toml."""
ANGLES = (0.33, 1.0, 2.0, 4.0, 8.0)
SPHERES = [
    *(("3-CCD", crosstalk, "smooth", 4.2) for crosstalk in ("mild", "measured")),
    *(("Bayer", c, paint, speckle) for paint in PAINTS for speckle in (4.2, 2.5) for c in ("mild", "measured")),
]
"""Camera, crosstalk, paint, speckle of the spheres: 30 CPU s for another paint or speckle, 4 for another crosstalk."""


@table("sphere", page="explanation/uncertainty", cost=200, keys=4, seed=11, own_quick=True)
def sphere(quick: bool) -> Iterator[Row]:
    """Turning sphere behind a lens with lateral colour of half a pixel at the corners from one lamp to the next: rms
    error of the displacement over the field after a turn; then, over all angles and nodes, error over stated
    uncertainty (also within reflections alone), errors within 1.96 stated uncertainties, and the same of strain.
    """
    for camera, crosstalk, paint, speckle in SPHERES[2:4] if quick else SPHERES:
        errors: dict[str, object] = {}
        ratios, strains, inside = list[FloatArray](), list[FloatArray](), list[BoolArray]()
        for angle in ANGLES[1::2] if quick else ANGLES:
            size = 256 if quick else 640
            paints = {"speckle": speckle, **PAINTS[paint]}
            setting = Setting(body="sphere", state=turn(angle), size=size, lateral_colour=LENS, **paints)
            pair = pair_of(setting)
            solution = solve_pair(pair, both(pair, KINDS[camera], crosstalk=crosstalk))
            verdict = Verdict.of(solution, pair)
            errors[f"{angle:g}° [px]"] = verdict.rms
            ratios.append(verdict.ratio)
            strains.append(verdict.strain_ratio)
            inside.append(reflecting(setting, solution))
        ratio, strain, reflection = (np.concatenate(parts) for parts in (ratios, strains, inside))
        yield {
            "camera": camera,
            "crosstalk": crosstalk,
            "paint": paint,
            "speckle [px]": speckle,
            **errors,
            "error/stated": rms(ratio),
            "in reflections": rms(ratio[reflection]),
            "covered [%]": 100 * covered(ratio),
            "strain error/stated": rms(strain),
        }


@table("weights", page="explanation/uncertainty", cost=60, keys=3, seed=11, own_quick=True)
def weights(quick: bool) -> Iterator[Row]:
    """Turning sphere: rms error of the displacement with the default weights, with none, and with the paper's masks at
    the best of twelve thresholds, chosen afterwards by the true error (in grey levels over full scale).
    """
    for paint in ("coarse",) if quick else PAINTS:
        for angle in (4.0,) if quick else (1.0, 8.0):
            pair = pair_of(Setting(body="sphere", state=turn(angle), size=256 if quick else 448, **PAINTS[paint]))
            for camera in ("Bayer",) if quick else KINDS:
                images = both(pair, KINDS[camera])
                solution = solve_pair(pair, images)
                threshold, masked = best_threshold(pair, images, solution)
                yield {
                    "camera": camera,
                    "paint": paint,
                    "angle [deg]": angle,
                    "statistics [px]": Verdict.of(solution, pair).rms,
                    "none [px]": Verdict.of(solve_pair(pair, images, statistics=False), pair).rms,
                    "best threshold [px]": masked,
                    "the threshold": threshold,
                }


CAMERAS = [("3-CCD", "mild"), ("Bayer", "mild"), ("Bayer", "measured")]


@table("noise", page="explanation/uncertainty", cost=60, keys=3, seed=17, own_quick=True)
def noise(quick: bool) -> Iterator[Row]:
    """Camera noise alone, 40 draws for one pair of states of the sphere: observed scatter of the displacement (median
    of the field), stated over observed, and draws within 1.96 stated uncertainties of their mean; the same of strain.
    """
    setting = Setting(body="sphere", state=turn(1.0), size=256 if quick else 448)
    for angle in (0.0,) if quick else (0.0, 1.0):
        pair = pair_of(replace(setting, state=turn(angle))).cut(*((48, 48, 160) if quick else (96, 192, 224)))
        for camera, crosstalk in CAMERAS[1:2] if quick else CAMERAS:
            draws = (both(pair, KINDS[camera], 17 + n, crosstalk) for n in range(10 if quick else 40))
            found = [solve_pair(pair, images) for images in draws]
            cells: list[float] = []
            for quantity in ("displacement", "strain"):
                values = np.array([getattr(one, quantity) for one in found])
                stated = np.array([getattr(one, f"{quantity}_std") for one in found])
                observed = np.nanstd(values, axis=0, ddof=1)
                quotient = np.sqrt(np.nanmean(stated**2, axis=0)) / observed
                ratio = (values - np.nanmean(values, axis=0)) / stated
                cells += [float(np.nanmedian(observed)), float(np.nanmedian(quotient)), 100 * covered(ratio)]
            names = ("observed", "stated/observed", "covered [%]")
            yield {
                "camera": camera,
                "crosstalk": crosstalk,
                "angle [deg]": angle,
                **dict(zip(("observed [px]", *names[1:]), cells[:3], strict=True)),
                **dict(zip((f"strain {name}" for name in names), cells[3:], strict=True)),
            }


BODIES = {"sphere": 4.0, "plate": 2.0, "cylinder": 4.0}
"""Turn of each body (degrees); the plate is strained too, wholly in green's reflection."""
VARIANTS: dict[str, dict[str, float]] = {
    "smooth": {},
    "a third as bright": {"gloss": 0.5},
    "glossy": PAINTS["glossy"],
    "coarse": PAINTS["coarse"],
    "speckle of 3 px": {"speckle": 3.0},
    "speckle of 8 px": {"speckle": 8.0},
}


@table("scenes", page="explanation/uncertainty", cost=100, keys=2, seed=11)
def scenes(quick: bool) -> Iterator[Row]:
    """Other bodies, gloss and speckle, with default settings: rms error of the displacement over the field, error over
    stated uncertainty of displacement and of strain, and nodes that are not measured, with a 3-CCD and a Bayer camera.
    """
    for body, angle in BODIES.items():
        for title, options in VARIANTS.items():
            if quick and (body, title) != ("plate", "coarse"):
                continue
            state = replace(strained_plate(), angle_deg=angle) if body == "plate" else turn(angle)
            pair = pair_of(Setting(body=body, state=state, **options))
            cells: dict[str, object] = {}
            for camera, kind in KINDS.items():
                verdict = Verdict.of(solve_pair(pair, both(pair, kind)), pair)
                cells |= {
                    f"{camera} error [px]": verdict.rms,
                    f"{camera} error/stated": rms(verdict.ratio),
                    f"{camera} strain": rms(verdict.strain_ratio),
                    f"{camera} lost [%]": 100 * verdict.unmeasured,
                }
            yield {"body": body, "paint": title, **cells}


@table("corrupted", page="explanation/uncertainty", cost=30, keys=2, seed=11)
def corrupted(quick: bool) -> Iterator[Row]:
    """Sphere rotated by 1 degree, with a corrupted deformed frame and no initial guess: error over stated uncertainty
    at least 40 px away from the corrupted zone, nodes without data there, the largest ratio anywhere; nodes within the
    zone, how many of them are not measured, and error over stated uncertainty of the others.
    """
    for corruption in CORRUPTIONS[:1] if quick else CORRUPTIONS:
        pair = corruption.pair()
        y, x = np.mgrid[: pair.size, : pair.size]
        zone = corruption.zone(x, y)
        for camera, kind in KINDS.items():
            raw = []
            for n, lights in enumerate(pair.lights):
                image = np.array(lights)
                corruption.light(image, zone, n)
                taken = frame(image, pair.scene, kind, 11000 + n)
                values = taken.values.copy()
                corruption.sensor(values, zone, n)
                raw.append(images_of(replace(taken, values=values), pair.scene))
            solution = solve_pair(pair, (raw[0], raw[1]), initial=None)
            assert solution.status is Status.CONVERGED, "the page says that every solve converges"
            ratio = Verdict.of(solution, pair).ratio
            far = cv2.distanceTransform((~zone).astype(np.uint8), cv2.DIST_L2, 5)
            column, line = np.round(solution.nodes).astype(int).T
            elsewhere, inside = far[line, column] > 40, far[line, column] == 0
            yield {
                "corrupted by": corruption.name,
                "camera": camera,
                "elsewhere": rms(ratio[elsewhere]),
                "lost elsewhere": int((~solution.measured)[elsewhere].sum()),
                "largest": largest(ratio),
                "inside": int(inside.sum()),
                "lost inside": int((~solution.measured)[inside].sum()),
                "ratio inside": rms(ratio[inside]),
            }


@table("areas", page="explanation/uncertainty", cost=40, keys=2, own_quick=True)
def areas(quick: bool) -> Iterator[Row]:
    """The paper's sphere behind a lens with lateral colour of half a pixel at the corners from one lamp to the next,
    whose green reflection crosses the areas A4 and A3, in one shot: perturbation P of area A0,
    which no reflection reaches, P of the other areas over it (root mean square of both components), and their stated
    uncertainty over that of A0.
    """
    from bench import Bench

    bench = Bench.build("bayer", 448 if quick else 768, seed=0)
    none = np.eye(3)
    cases = {"3-CCD": ("rgb", None), "Bayer": ("bayer", None), "Bayer without crosstalk": ("bayer", none)}
    for angle in (2.0,) if quick else (1.0, 2.0, 8.0):
        state = bench.state(angle)
        exact, rendered = truth(bench.scene, state), [render(bench.scene, one) for one in (None, state)]
        for title, (kind, matrix) in list(cases.items())[: 2 if quick else 3]:
            camera = bench.scene.camera if matrix is None else replace(bench.scene.camera, crosstalk=matrix)
            scene = replace(bench.scene, camera=camera)
            first, second = (images_of(frame(i, scene, kind, n), scene) for n, i in enumerate(rendered))
            mesh = Tri3Mesh.from_region(bench.region, 25)
            start = at_nodes(exact, mesh.nodes) + 0.2
            found = correlated((first, second), bench.region, initial=start)
            fields = at_pixels(mesh, found.displacement, camera.shape) - exact
            std = at_pixels(mesh, found.displacement_std, camera.shape)
            p, stated = (
                np.sqrt(np.mean(np.square(parts), axis=0))
                for parts in (
                    [area_stds(high_pass(part), bench.areas) for part in fields],
                    [[np.nanmean(area.cut(part)) for area in bench.areas] for part in std],
                )
            )
            yield {
                "angle [deg]": angle,
                "camera": title,
                "P of A0 [px]": float(p[0]),
                **{f"A{n}/A0": float(p[n] / p[0]) for n in range(1, 5)},
                **{f"stated A{n}/A0": float(stated[n] / stated[0]) for n in (3, 4)},
            }
