"""Whether displacement and stated uncertainty hold without tuning: reflections, noise alone, corrupted frames.

    python benchmarks/uncertainty.py [TABLE ...] [--quick] [--cache FOLDER]

Scenes of `rgbmidic.lab.virtual` with exact truth, seen by a raw Bayer camera (reflection-aware) and by an ideal
3-CCD one; every setting is the default of `rgbmidic.correlate` with images divided by their local mean
(sigma 10 px). The opponent is the paper's binary mask with the threshold that gives the smallest true error, sought
anew for every scene and state, everything else equal: a choice nobody can make in a laboratory.

"ratio" is rms(error / stated standard uncertainty) over the measured nodes, 1 where the statement is right; "covered"
the share of errors within 1.96 stated standard uncertainties. Zones are told by mat renderings of the same scenes:
"reflection" where more than a third of a light's local mean is not diffuse in one of the states, "edge" within 12 px of
such a zone's border, "mat" the rest.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rgbmidic import correlate
from rgbmidic.correlation import Solution
from rgbmidic.fields import (
    Nodal,
    NodalCovariance,
    at_nodes,
    at_pixels,
    difference_std,
    field_rms,
    high_pass,
    make_probe,
    reference_fraction,
)
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.lab.measures import area_stds
from rgbmidic.lab.virtual import strained_plate, truth
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray
from rgbmidic.weights.threshold import threshold_weights

from .tables import Row, table
from .uncertainty_scenes import (
    CACHE,
    SPOILS,
    Kind,
    Pair,
    Setting,
    both,
    frame,
    images_of,
    pair_of,
    stored_render,
    turn,
)

if TYPE_CHECKING:
    from bench import Bench

KINDS: dict[Kind, str] = {"rgb": "3-CCD", "bayer": "Bayer"}
ZONES = ("mat", "reflection", "edge")
THRESHOLDS = (0.26, 0.28, 0.3, 0.33, 0.36, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 2.0)
"""Blurred grey levels, as shares of the full scale, above which the masks exclude a light; 2 excludes nothing."""
SPHERE_TARGETS = {
    "rgb": {0.33: 0.0029, 1: 0.0034, 2: 0.0043, 4: 0.0061, 8: 0.0099},
    "bayer": {0.33: 0.0045, 1: 0.0065, 2: 0.0076, 4: 0.0100, 8: 0.0150},
}
REFLECTION_SHARE = 1 / 3
NODAL = ("u", "v", "u_std", "v_std")
EDGE = 12


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
    options = {"initial": at_nodes(pair.exact, nodes) + 0.2, "normalise": 10.0, **options}
    if threshold is not None:
        first, second = (threshold_weights(image, threshold=threshold) for image in images)
        options |= {"weights": first, "deformed_weights": second, "statistics": False}
    return correlate(images[0].values, images[1].values, region=region, **options)


@dataclass(frozen=True)
class Verdict:
    """What a solution is worth against the truth."""

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


def zones_of(pair: Pair, solution: Solution) -> dict[str, BoolArray]:
    """Which nodes lie in which zone."""
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    there = at_pixels(mesh, at_nodes(pair.exact, solution.nodes), (pair.size, pair.size))
    y, x = np.mgrid[: pair.size, : pair.size].astype(np.float32)
    shining, edge = np.zeros((2, pair.size, pair.size), dtype=bool)
    for first, second in zip(*pair.glare, strict=True):
        back = cv2.remap(second, np.nan_to_num(x + there[0]), np.nan_to_num(y + there[1]), cv2.INTER_LINEAR)
        for glare in (first, back):
            zone = (glare > REFLECTION_SHARE).astype(np.uint8)
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * EDGE + 1, 2 * EDGE + 1))
            shining |= zone > 0
            edge |= cv2.dilate(zone, disc) != cv2.erode(zone, disc)
    column, row = np.round(solution.nodes).astype(int).T
    at_edge, inside = edge[row, column], shining[row, column]
    return {"mat": ~inside & ~at_edge, "reflection": inside & ~at_edge, "edge": at_edge}


def rms(values: FloatArray) -> float:
    """Root mean square of what is finite."""
    values = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def covered(ratio: FloatArray) -> float:
    """Share of errors within 1.96 standard uncertainties."""
    known = ratio[np.isfinite(ratio)]
    return float((np.abs(known) < 1.96).mean()) if known.size else float("nan")


def best_threshold(
    pair: Pair, images: tuple[IlluminationImages, IlluminationImages], default: Solution
) -> tuple[float, float, Solution]:
    """Threshold with the smallest true error over what the default measures too, that error, and its solution.

    A threshold that loses over 1 % more nodes than the default does not count.
    """
    found = []
    for threshold in THRESHOLDS:
        solution = solve_pair(pair, images, threshold)
        if (default.measured & ~solution.measured).mean() <= 0.01:
            found.append((Verdict.of(solution, pair).rms, threshold, solution))
    error, threshold, solution = min(found, key=lambda one: one[0])
    return threshold, error, solution


def heading(*names: str) -> None:
    """First two lines of a table."""
    print("\n| " + " | ".join(names) + " |\n" + "|---" * len(names) + "|")


def row(*cells: object) -> None:
    """One line of a table."""
    print("| " + " | ".join(f"{c:.4f}" if isinstance(c, float) else str(c) for c in cells) + " |", flush=True)


def sphere(quick: bool) -> None:
    """Sphere: error over the field, best threshold, ratio and coverage by zone."""
    angles = (0.33, 1.0, 4.0) if quick else (0.33, 1.0, 2.0, 4.0, 8.0, 14.0)
    by_zone = "/".join(ZONES)
    heading(
        "camera", "angle", "rms (asked)", "best threshold", "lost", "ratio u v", "covered u v", f"ratio {by_zone}",
        f"covered {by_zone}", "strain ratio", "strain covered", f"strain ratio {by_zone}",
    )  # fmt: skip
    for kind, name in KINDS.items():
        for angle in angles:
            pair = pair_of(Setting(body="sphere", state=turn(angle), size=448 if quick else 640))
            images = both(pair, kind)
            solution = solve_pair(pair, images)
            verdict, zones = Verdict.of(solution, pair), zones_of(pair, solution)
            threshold, opponent, _ = best_threshold(pair, images, solution)
            row(
                name, f"{angle:g}°", f"{verdict.rms:.4f} ({SPHERE_TARGETS[kind].get(angle, float('nan')):.4f})",
                f"{opponent:.4f} at {threshold:g}", f"{verdict.unmeasured:.2%}",
                *_by_part(verdict.ratio.T), *_by_part([verdict.ratio[zones[z]] for z in ZONES]),
                *_by_part([verdict.strain_ratio]), _by_part([verdict.strain_ratio[zones[z]] for z in ZONES])[0],
            )  # fmt: skip


def _by_part(parts: Any) -> tuple[str, str]:
    return " / ".join(f"{rms(p):.2f}" for p in parts), " / ".join(f"{covered(p):.1%}" for p in parts)


def areas(quick: bool) -> None:
    """The paper's bench in one Bayer shot: P in the areas over that of A0, by statistics and by the best threshold."""
    sys.path.append(str(Path(__file__).resolve().parents[1] / "examples" / "paper"))
    from bench import Bench

    angles = (1.0, 8.0) if quick else (0.33, 1.0, 2.0, 4.0, 8.0, 14.0)
    seeds, size = ((0,), 640) if quick else ((0, 1, 2), 1024)
    heading(
        "angle",
        "P of A0",
        *(f"A{i}/A0" for i in range(1, 5)),
        "best threshold",
        "its P of A0",
        *(f"its A{i}/A0" for i in range(1, 5)),
    )
    for angle in angles:
        ours, theirs, tuned = [], [], []
        for seed in seeds:
            found = _perturbations(Bench.build("bayer", size, seed=seed), angle, seed)
            ours.append(found[0])
            theirs.append(found[1])
            tuned.append(found[2])
        p, q = (np.sqrt(np.mean(np.square(values), axis=(0, 1))) for values in (ours, theirs))
        row(f"{angle:g}°", p[0], *(f"{v:.2f}" for v in p[1:] / p[0]), tuned, q[0], *(f"{v:.2f}" for v in q[1:] / q[0]))


def _perturbations(bench: Bench, angle: float, seed: int) -> tuple[FloatArray, FloatArray, float]:
    """P (2, 5) of the error's two components by statistics and by the threshold with the smallest P overall."""
    scene, state = bench.scene, bench.state(angle)
    exact = truth(scene, state)
    images = [
        images_of(frame(stored_render(scene, s), scene, "bayer", 100 * seed + n), scene)
        for n, s in enumerate((None, state))
    ]
    mesh = Tri3Mesh.from_region(bench.region, 25)
    start = at_nodes(exact, mesh.nodes) + 0.2

    def p(threshold: float | None) -> FloatArray:
        options: dict[str, Any] = {}
        if threshold is not None:
            first, second = (threshold_weights(image, threshold=threshold) for image in images)
            options = {"weights": first, "deformed_weights": second, "statistics": False}
        found = correlate(
            images[0].values, images[1].values, region=bench.region, initial=start, normalise=10, **options
        )
        field = at_pixels(mesh, found.displacement, scene.camera.shape) - exact
        return np.stack([area_stds(high_pass(part), bench.areas) for part in field])

    tried = {threshold: p(threshold) for threshold in THRESHOLDS}
    best = min((t for t in tried if np.isfinite(tried[t]).all()), key=lambda t: rms(tried[t]))
    return p(None), tried[best], best


def scenes(quick: bool) -> None:
    """No parameter touched between bodies, gloss, speckle and paint."""
    states = {
        "sphere": (turn(1.0), turn(4.0)),
        "plate": (strained_plate(), replace(strained_plate(), angle_deg=2.0)),
        "cylinder": (turn(1.0), turn(4.0)),
    }
    variants: list[dict[str, Any]] = [
        {},
        {"gloss": 0.5},
        {"gloss": 1.0},
        {"gloss": 3.0},
        {"speckle": 3.0},
        {"speckle": 8.0},
        {"wrinkles": 0.05},
    ]
    heading(
        "camera",
        "body",
        "variant",
        "state",
        "rms",
        "best threshold",
        "gain",
        "ratio",
        "covered",
        "strain ratio",
        "lost",
        "largest",
    )
    for kind, name in KINDS.items():
        for body, motions in states.items():
            for variant in variants[:: 3 if quick else 1]:
                for number, state in enumerate(motions[: 1 if quick else 2]):
                    pair = pair_of(Setting(body=body, state=state, **variant))
                    pair_of.cache_clear()
                    images = both(pair, kind)
                    solution = solve_pair(pair, images)
                    verdict = Verdict.of(solution, pair)
                    threshold, opponent, _ = best_threshold(pair, images, solution)
                    title = ", ".join(f"{k} {v}" for k, v in variant.items()) or "reference"
                    row(
                        name, body, title, number + 1, verdict.rms, f"{opponent:.4f} at {threshold:g}",
                        f"{opponent / verdict.rms:.2f}", f"{rms(verdict.ratio):.2f}", f"{covered(verdict.ratio):.1%}",
                        f"{rms(verdict.strain_ratio):.2f}", f"{verdict.unmeasured:.1%}",
                        f"{np.nanmax(np.abs(verdict.ratio)):.1f}",
                    )  # fmt: skip


def noise(quick: bool) -> None:
    """Camera noise alone: stated over observed scatter, and coverage of the mean of all draws, by zone.

    At rest there is nothing but noise. In motion the statement also holds what the reflections and the curvature do,
    which the draws of one pair of states do not vary: there it must not be below 1.
    """
    draws = 20 if quick else 100
    heading(
        "camera",
        "angle",
        "draws",
        "stated / observed",
        "u v by zone " + "/".join(ZONES),
        "covered by zone",
        "strain stated / observed",
        "by zone",
        "strain covered by zone",
    )
    for kind, name in KINDS.items():
        for angle in (0.0, 1.0):
            pair = pair_of(Setting(body="sphere", state=turn(angle))).cut(96, 192, 224)
            found = [solve_pair(pair, both(pair, kind, seed=17 + n)) for n in range(draws)]
            zones = zones_of(pair, found[0])
            cells: list[str] = []
            for quantity in ("displacement", "strain"):
                values = np.array([getattr(one, quantity) for one in found])
                stated = np.array([getattr(one, f"{quantity}_std") for one in found])
                observed = np.nanstd(values, axis=0, ddof=1)
                quotient = np.sqrt(np.nanmean(stated**2, axis=0)) / observed
                ratio = (values - np.nanmean(values, axis=0)) / stated
                cells += [
                    f"{np.nanmedian(quotient):.2f}",
                    " / ".join(f"{np.nanmedian(quotient[zones[z]]):.2f}" for z in ZONES),
                    " / ".join(f"{covered(ratio[:, zones[z]]):.1%}" for z in ZONES),
                ]
            row(name, f"{angle:g}°", draws, *cells)


def corrupted(quick: bool) -> None:
    """Spoiled frames, sphere at 1 degree, start sought by the solver: the rest unharmed, what is lost flagged."""
    heading(
        "camera",
        "corrupted by",
        "status",
        "ratio elsewhere",
        "elsewhere lost",
        "lost inside",
        "ratio inside",
        "largest ratio",
        "largest error, px",
    )
    for kind, name in KINDS.items():
        for spoil in SPOILS[:: 3 if quick else 1]:
            pair = spoil.pair()
            y, x = np.mgrid[: pair.size, : pair.size]
            zone = spoil.zone(x, y)
            raw = []
            for n, lights in enumerate(pair.lights):
                image = np.array(lights)
                spoil.light(image, zone, n)
                taken = frame(image, pair.scene, kind, 11000 + n)
                values = taken.values.copy()
                spoil.sensor(values, zone, n)
                raw.append(images_of(replace(taken, values=values), pair.scene))
            solution = solve_pair(pair, (raw[0], raw[1]), initial=None)
            verdict = Verdict.of(solution, pair)
            far = cv2.distanceTransform((~zone).astype(np.uint8), cv2.DIST_L2, 5)
            column, line = np.round(solution.nodes).astype(int).T
            elsewhere, inside = far[line, column] > 40, far[line, column] == 0
            lost = ~solution.measured
            row(
                name, spoil.name, solution.status.name, f"{rms(verdict.ratio[elsewhere]):.2f}",
                int(lost[elsewhere].sum()),
                f"{int(lost[inside].sum())} of {int(inside.sum())}", f"{rms(verdict.ratio[inside]):.2f}",
                f"{_largest(verdict.ratio):.1f}", f"{_largest(verdict.error):.3f}",
            )  # fmt: skip


def _largest(values: FloatArray) -> float:
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else float("nan")


def texture(quick: bool) -> None:
    """Stripes that show one direction only, and grey levels of any size."""
    y, x = np.mgrid[:200, :200].astype(float)
    heading("stripes along", "noise / contrast", "measured", "ratio u", "ratio v", "stated u", "stated v")
    for relative in (0.01, 0.1, 0.3):
        for title, place in (("y", x), ("x", y)):
            found = []
            for draw in range(3 if quick else 10):
                random = np.random.default_rng(draw)
                shift = 0.3
                phase = np.cumsum(np.random.default_rng(99).uniform(0.3, 1.2, 400))
                moved = place - shift
                pair = [
                    np.sin(np.interp(p, np.arange(400) - 100, phase)) + relative * random.normal(size=x.shape)
                    for p in (place, moved)
                ]
                found.append(
                    correlate(100 + 50 * pair[0], 100 + 50 * pair[1], initial=(0.0, 0.0), region=(10, 10, 185, 185))
                )
            true = np.array([shift * (title == "y"), shift * (title == "x")])
            ratio = np.concatenate([(one.displacement - true) / one.displacement_std for one in found])
            stated = np.concatenate([one.displacement_std for one in found])
            share = np.mean([one.measured.mean() for one in found])
            row(title, relative, f"{share:.1%}", *(f"{rms(r):.2f}" for r in ratio.T), *(rms(s) for s in stated.T))
    heading("grey levels times", "brightness", "status", "u, px", "stated, px", "measured")
    image = 100 + 40 * cv2.GaussianBlur(np.random.default_rng(3).normal(size=(200, 201)), (0, 0), 1.5) / 0.19
    for brightness in ("none", "global", "local"):
        for factor in (1.0, 1e-6, 1e6, 1e12):
            one = correlate(
                image[:, 1:] * factor, 1.1 * image[:, :-1] * factor, initial=(0.6, 0.0), brightness=brightness
            )
            row(
                f"{factor:g}",
                brightness,
                one.status.name,
                float(np.nanmean(one.displacement[:, 0])),
                rms(one.displacement_std),
                f"{one.measured.mean():.1%}",
            )


@table("elements", page="explanation/uncertainty", cost=40, keys=3)
def elements(quick: bool) -> Iterator[Row]:
    """Error over stated uncertainty with elements and regions of any size: plain texture at rest, noise of 8 % of its
    contrast, 12 draws.
    """
    image = 100 + 50 * _speckle(160, 3.5)
    cases = [(size, 160, lights) for size in (40, 25, 16, 12, 8, 6, 4) for lights in (1, 3)]
    cases += [(25, side, 3) for side in (16, 25, 40, 60)]
    for size, side, lights in [(25, 160, 1), (8, 160, 1), (25, 25, 3)] if quick else cases:
        draws, corner = [], (160 - side) // 2
        for draw in range(12):
            random = np.random.default_rng(draw)
            first, second = (image + 4 * random.normal(size=(lights, 160, 160)) for _ in (0, 1))
            region = (corner, corner, corner + side - 1, corner + side - 1)
            draws.append(correlate(first, second, region=region, element_size=size, initial=(0.0, 0.0)))
        error, std = (np.array([getattr(one, name) for one in draws]) for name in ("displacement", "displacement_std"))
        ratio = error / std
        yield {
            "elements [px]": size,
            "region [px]": side,
            "lights": lights,
            "rms error [px]": rms(error),
            "error/stated": rms(ratio),
            "covered [%]": 100 * covered(ratio),
            "measured [%]": 100 * float(np.isfinite(ratio).mean()),
        }


PLACES = (
    ("point", (53.3, 47.1)),
    ("line", (20, 20, 100, 100)),
    ("circle", (60, 60, 25)),
    ("region", (30, 30, 100, 100)),
    ("gauge", (33, 40, 100, 90)),
    ("strain_gauge", (65, 60, 51)),
    ("strain_gauge", (65, 60, 87)),
)
"""Probes on a region of 100 px: kind and place in px; elements have 16 px."""


def probes(quick: bool) -> None:
    """Means, gauges and their change between two frames: a plain texture at rest, noise of 8 % of its contrast."""
    image, draws = 100 + 50 * _speckle(130, 3.5), []
    for draw in range(20 if quick else 100):
        random = np.random.default_rng(draw)
        first, *later = (image + 4 * random.normal(size=image.shape) for _ in range(3))
        states = [correlate(first, one, region=(15, 15, 114, 114), element_size=16, initial=(0, 0)) for one in later]
        draws.append(np.stack([np.concatenate([one.displacement.T, one.displacement_std.T]) for one in states], axis=1))
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=states[0].nodes, elements=states[0].elements))
    fields = np.stack(draws)
    nodal = fields[:, :2] / fields[:, 2:]
    heading("probe", "quantity", "ratio", "covered", "ratio of the change")
    row("nodes", "u, v", rms(nodal), f"{covered(nodal):.1%}", "")
    for number, (kind, place) in enumerate(PLACES):
        probe = make_probe(covariance, kind, number, place)
        read = [probe.histories(Nodal(**dict(zip(NODAL, draw[..., probe.nodes], strict=True)))) for draw in fields]
        for histories in zip(*read, strict=True):
            error, std = (np.stack([getattr(one, name) for one in histories]) for name in ("values", "std"))
            change = (error[:, 1] - error[:, 0]) / difference_std(std[:, 0], std[:, 1], reference_fraction(1))
            name = histories[0].name.removeprefix(f"{kind}_{number}_")
            if histories[0].unit == "deg" or name in ("e1", "e2", "equivalent"):  # mean nothing without strain
                continue
            row(f"{kind} {place}", name, rms(error / std), f"{covered(error / std):.1%}", rms(change))


def _speckle(size: int, width: float) -> FloatArray:
    """Gaussian speckle of unit contrast; `width` (px) of the autocorrelation at half maximum."""
    blurred = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(size + 40, size + 40)), (0, 0), width / 3.33)
    return np.asarray(blurred[20:-20, 20:-20] / blurred.std())


def main() -> None:
    """Read the command line and print the tables asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], help="all if none is named")
    parser.add_argument("--quick", action="store_true", help="fewer angles, variants and draws")
    parser.add_argument("--cache", type=Path, default=CACHE["folder"], help="folder for rendered scenes")
    arguments = parser.parse_args()
    CACHE["folder"] = arguments.cache
    for name in arguments.tables or TABLES:
        print(f"\n## {name}: {(TABLES[name].__doc__ or name).strip()}")
        TABLES[name](arguments.quick)


TABLES: dict[str, Callable[[bool], None]] = {
    "sphere": sphere,
    "areas": areas,
    "scenes": scenes,
    "noise": noise,
    "corrupted": corrupted,
    "texture": texture,
    "probes": probes,
}

if __name__ == "__main__":
    main()
