"""What each demosaicing method costs in displacement error, with and without reflections, on scenes with exact truth.

    python benchmarks/demosaicing.py [--seeds 11 12 13] [--paint smooth|sparkling] [--speckle 4.2] [--figure FILE]
    python benchmarks/demosaicing.py --speckles 3 4.2 6 8 --figure FILE

Scenes of `rgbmidic.virtual`: RGGB, 12 bit, 4 e-/DN, read noise 12 e-, crosstalk 10 to 16 % between neighbours, specular
peak 1.5 times an ideal white. Three lights are solved together with the true crosstalk, TRI3 of 25 px started within
half a pixel of the truth; errors over the field without its border element. "sparkling" paint has facets twice as
large, traced with 3 x 3 rays per pixel, so that a reflection changes erratically from state to state.

The 3-CCD camera is the ideal: all three colours at every pixel, the same solve. One sample instead of three costs a
factor of sqrt(3) in noise; what is above that is the demosaicing's doing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from rgbmidic.correlation import correlate
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.mosaic import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.separate import separate
from rgbmidic.illumination.unmix import unmix
from rgbmidic.illumination.weights import threshold_weights
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.virtual import Scene, State, plate_scene, record, render, sphere_scene, strained_plate, truth, turned
from rgbmidic.virtual.scenes import PIXEL

Array = npt.NDArray[np.float64]
TILT = (float(-np.degrees(0.15)), 0.0)
"""The plate leans towards green's lamp."""
MASKED_ABOVE = 0.4
"""Blurred grey level, as a share of the full scale, above which the paper's masks exclude a light."""


@dataclass(frozen=True)
class Case:
    """A pair of states."""

    name: str
    scene: Callable[..., Scene]
    state: State
    size: int
    is_plate: bool = True


def _glaring(**options: Any) -> Scene:
    return plate_scene(gloss=1.5, glare="green", tilt_deg=TILT, **options)


def _mat(**options: Any) -> Scene:
    return plate_scene(tilt_deg=TILT, **options)


CASES = [
    Case("plate in green's reflection", _glaring, strained_plate(), 512),
    *(Case(f"sphere {a:g}°", sphere_scene, turned(a), 640, is_plate=False) for a in (0.33, 1, 2, 4, 8)),
    Case("plate without reflection", _mat, strained_plate(), 512),
]


@dataclass(frozen=True)
class Contender:
    """A way from the raw frame to the solve."""

    name: str
    method: str
    prefilter: str = "binomial"
    normalise: float | None = 10.0
    masks: bool = False

    def lights(self, frame: Any, scene: Scene) -> IlluminationImages:
        """Illumination images of a recorded frame."""
        crosstalk = scene.camera.true_crosstalk(scene.lights)
        linear = linearise(frame, scene.camera.noise)
        if isinstance(linear, LinearChannels):
            return unmix(linear, crosstalk)
        assert isinstance(linear, LinearMosaic)
        return separate(linear, crosstalk, self.method)


CONTENDERS = [
    Contender("Malvar + masks, no prefilter (the paper)", "malvar", prefilter="none", normalise=None, masks=True),
    Contender("bilinear", "bilinear"),
    Contender("Malvar", "malvar"),
    Contender("Menon", "menon"),
    Contender("band-limited", "band-limited"),
    Contender("normalised mosaic", "normalised"),
    Contender("reflection-aware (default)", "reflection-aware"),
    Contender("ideal 3-CCD", "3-CCD"),
]


@dataclass(frozen=True)
class Error:
    """Displacement error over the field, px."""

    bias: tuple[float, float]
    scatter: float
    rms: float
    unmeasured: float

    @classmethod
    def mean(cls, errors: list[Error]) -> Error:
        """Over several seeds: biases averaged, the rest as root mean square."""
        x, y = np.mean([error.bias for error in errors], axis=0)
        scatter, rms = np.sqrt(np.mean([(e.scatter**2, e.rms**2) for e in errors], axis=0))
        return cls((float(x), float(y)), float(scatter), float(rms), max(e.unmeasured for e in errors))

    def text(self, is_plate: bool) -> str:
        """As in the table: bias x/y, scatter for plates, rms for spheres."""
        flag = "" if self.unmeasured < 0.001 else f" ({self.unmeasured:.1%} not measured)"
        if is_plate:
            return f"{self.bias[0]:+.4f}/{self.bias[1]:+.4f}, {self.scatter:.4f}{flag}"
        return f"{self.rms:.4f}{flag}"


def painted(scene: Scene, paint: str) -> Scene:
    """The scene with smooth or sparkling paint."""
    if paint == "smooth":
        return scene
    white, black = (replace(finish, spacing=0.05) for finish in (scene.surface.white, scene.surface.black))
    return replace(
        scene, surface=replace(scene.surface, white=white, black=black), camera=replace(scene.camera, samples=3)
    )


@cache
def rendered(index: int, paint: str, seed: int, speckle: float) -> tuple[Scene, Any, Any, Array]:
    """Scene, lights in both states without noise, and truth (2, H, W); rendered once for all contenders."""
    case = CASES[index]
    scene = painted(case.scene(size=case.size, seed=seed, droplet=speckle * PIXEL), paint)
    return scene, render(scene), render(scene, case.state), truth(scene, case.state)


def measured(index: int, contender: Contender, *, paint: str, seed: int, speckle: float) -> Error:
    """Error of one contender on one case."""
    scene, first, second, exact = rendered(index, paint, seed, speckle)
    camera = replace(scene.camera, kind="rgb" if contender.method == "3-CCD" else "bayer")
    seen = replace(scene, camera=camera)
    frames = [record(i, camera, seen.lights, seed=1000 * seed + n) for n, i in enumerate((first, second))]
    reference, deformed = (contender.lights(frame, seen) for frame in frames)
    size = CASES[index].size
    margin = (size - 1 - (size - 17) // 25 * 25) // 2
    far = margin + (size - 17) // 25 * 25
    region = Region.from_rectangle((margin, margin, far, far), (size, size))
    nodes = Tri3Mesh.from_region(region, 25).nodes
    start = np.stack([map_coordinates(one, nodes[:, ::-1].T, order=1) for one in exact], axis=1) + 0.2
    weights = [threshold_weights(i, threshold=MASKED_ABOVE) if contender.masks else None for i in (reference, deformed)]
    solution = correlate(
        reference.values,
        deformed.values,
        region=region,
        initial=start,
        weights=weights[0],
        deformed_weights=weights[1],
        prefilter=contender.prefilter,
        normalise=contender.normalise,
        statistics=not contender.masks,
    )
    return field_error(solution.nodes, solution.elements, solution.displacement, exact, (margin + 25, far - 25))


def field_error(nodes: Array, elements: Any, displacement: Array, exact: Array, inside: tuple[int, int]) -> Error:
    """Error at ten points of every element that lies inside the square."""
    corners = nodes[elements]
    kept = ((corners >= inside[0] - 1e-6) & (corners <= inside[1] + 1e-6)).all(axis=(1, 2))
    shares = np.array([(a, b, 4 - a - b) for a in range(5) for b in range(5 - a)]) / 4
    shares = shares * 0.9 + 0.1 / 3
    points = np.einsum("sn,enc->esc", shares, corners[kept])
    found = np.einsum("sn,enc->esc", shares, displacement[elements[kept]])
    y, x = points[..., 1].ravel(), points[..., 0].ravel()
    wanted = np.stack([map_coordinates(one, (y, x), order=1) for one in exact], axis=1)
    error = found.reshape(-1, 2) - wanted
    bias = np.nanmean(error, axis=0)
    missing = float(np.isnan(error).any(axis=1).mean())
    scatter, rms = np.sqrt(np.nanmean((error - bias) ** 2)), np.sqrt(np.nanmean(error**2))
    return Error((float(bias[0]), float(bias[1])), float(scatter), float(rms), missing)


def table(paint: str, seeds: list[int], speckle: float, contenders: list[Contender]) -> list[list[Error]]:
    """Print the table of one paint and speckle; errors by case and contender."""
    print(f"\n{paint} paint, speckle {speckle:g} px, seeds {seeds}\n")
    print("| scene | " + " | ".join(c.name for c in contenders) + " | 3-CCD × √3 |")
    print("|---" * (len(contenders) + 2) + "|")
    rows = []
    for index, case in enumerate(CASES):
        row = [
            Error.mean([measured(index, c, paint=paint, seed=seed, speckle=speckle) for seed in seeds])
            for c in contenders
        ]
        ideal = row[-1].scatter if case.is_plate else row[-1].rms
        cells = [error.text(case.is_plate) for error in row]
        print(f"| {case.name} | " + " | ".join(cells) + f" | {ideal * 3**0.5:.4f} |", flush=True)
        rows.append(row)
        rendered.cache_clear()
    return rows


def figure(path: Path, results: dict[float, list[list[Error]]], contenders: list[Contender]) -> None:
    """Bias and scatter of each method over the size of the speckle, with and without reflection."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    sizes = sorted(results)
    panels = [(len(CASES) - 1, "without reflection"), (0, "in green's reflection")]
    fig, axes = plt.subplots(2, 2, figsize=(10, 7), sharex=True, sharey="row", layout="constrained")
    for column, (index, title) in enumerate(panels):
        for n, contender in enumerate(contenders):
            errors = [results[size][index][n] for size in sizes]
            style = {"lw": 2.5, "color": "black"} if contender.method == "reflection-aware" else {"lw": 1.2}
            style |= {"ls": "--", "color": "grey"} if contender.method == "3-CCD" else {}
            bias = [float(np.abs(e.bias).max()) for e in errors]
            axes[0, column].plot(sizes, bias, marker="o", label=contender.name, **style)
            axes[1, column].plot(sizes, [e.scatter for e in errors], marker="o", **style)
        axes[0, column].set_title(f"plate {title}")
        axes[1, column].set_xlabel("speckle, px")
    for axis, label in zip(axes[:, 0], ("largest |bias|, px", "scatter, px"), strict=True):
        axis.set_ylabel(label)
    for axis in axes.flat:
        axis.set_yscale("log")
        axis.grid(alpha=0.3)
    axes[0, 1].legend(fontsize=7)
    fig.savefig(path, dpi=130)


def main() -> None:
    """Read the command line, print the tables, write the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--paint", choices=("smooth", "sparkling"), default="smooth")
    parser.add_argument("--speckles", type=float, nargs="+", default=[4.2])
    parser.add_argument("--plates-only", action="store_true", help="leave the spheres out")
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    if arguments.plates_only:
        CASES[:] = [case for case in CASES if case.is_plate]
    results = {size: table(arguments.paint, arguments.seeds, size, CONTENDERS) for size in arguments.speckles}
    if arguments.figure:
        figure(arguments.figure, results, CONTENDERS)


if __name__ == "__main__":
    main()
