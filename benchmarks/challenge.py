"""Fine detail on a star pair, beside pyvale where it is installed; prints a table against the element size.

    python benchmarks/challenge.py [REF DEF] [--sizes 8 10 13 16 20 25 32 40]

The star of the DIC Challenge 2.0: v = 0.5 cos(2 pi (y - middle) / period) px, the period 10 px at the left edge of the
image and growing by 0.07 px per px (fitted to the Challenge's short pair). Without files, a pair of our own with white
noise is made.

Gain: measured times true v over the square of the true one, over a band of 8 % about a period. SR: the longest period
at which it is 10 % off. Noise: standard deviation of u and v between the reference and itself with as much noise as
both images have. MEI: their product. Stated over true: of v at the nodes, root mean squares, by period in elements.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from rgbmidic import Tri3Mesh, correlate, read_frame
from rgbmidic.correlation import Solution
from rgbmidic.fields import at_pixels
from rgbmidic.typing import BoolArray, FloatArray

from .peers import speckle

MARGIN = 20
BAND = 0.08
"""Half width of the band of periods over which a gain is taken, relative."""
PERIODS = (0.0, 2.0, 3.0, 5.0, 100.0)
"""Limits of the periods, in elements, by which stated and true uncertainty are compared."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Reference, deformed, and the reference with as much more noise as both have; each (H, W)."""

    reference: FloatArray
    deformed: FloatArray
    still: FloatArray

    @property
    def region(self) -> tuple[int, int, int, int]:
        height, width = self.reference.shape
        return MARGIN, MARGIN, width - 1 - MARGIN, height - 1 - MARGIN

    def star(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """v in px at points of the reference."""
        return np.asarray(0.5 * np.cos(2 * np.pi * (y - self.reference.shape[0] // 2) / period(x)))


@dataclass(frozen=True, kw_only=True)
class Field:
    """Values at points: of the pair (v) and at rest (u and v), with the stated uncertainty of v or None."""

    x: FloatArray
    y: FloatArray
    v: FloatArray
    rest: FloatArray
    std: FloatArray | None = None


def period(x: FloatArray) -> FloatArray:
    """Period in px of the star's wave at x."""
    return 10 + 0.07 * x


def own_pair(shape: tuple[int, int] = (361, 2001), noise: float = 2.0) -> Pair:
    """A star on the speckle of the solver's benchmark, exactly rendered."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    material = y.copy()
    for _ in range(30):
        material = y - 0.5 * np.cos(2 * np.pi * (material - shape[0] // 2) / period(x))
    clean = speckle(x, y)
    draws = np.random.default_rng(0).normal(scale=noise, size=(3, *shape))
    return Pair(reference=clean + draws[0], deformed=speckle(x, material) + draws[1], still=clean + draws[2])


def read_pair(reference: Path, deformed: Path) -> Pair:
    """A pair from files; its noise from the residual where the waves are long."""
    first, second = (read_frame(path, kind="monochrome").values[0].astype(float) for path in (reference, deformed))
    height, width = first.shape
    found = correlate(
        first, second, region=(0.8 * width, MARGIN, width - 1 - MARGIN, height - 1 - MARGIN), element_size=16,
        prefilter="none", initial=(0, 0),
    )  # fmt: skip
    added = np.random.default_rng(0).normal(scale=float(found.residual[0]), size=first.shape)
    return Pair(reference=first, deformed=second, still=first + added)


def own_fields(pair: Pair, size: float, *, statistics: bool) -> dict[str, Field]:
    """What the solve measures at the nodes and at the pixels."""
    moved, rest = (
        correlate(pair.reference, image, region=pair.region, element_size=size, initial=(0, 0), statistics=statistics)
        for image in (pair.deformed, pair.still)
    )
    y, x = (axis.astype(float) for axis in np.mgrid[: pair.reference.shape[0], : pair.reference.shape[1]])
    nodal = Field(
        x=moved.nodes[:, 0], y=moved.nodes[:, 1], v=moved.displacement[:, 1], rest=rest.displacement.T,
        std=moved.displacement_std[:, 1],
    )  # fmt: skip
    return {"nodes": nodal, "pixels": Field(x=x, y=y, v=_dense(moved, pair)[1], rest=_dense(rest, pair))}


def _dense(solution: Solution, pair: Pair) -> FloatArray:
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    return np.asarray(at_pixels(mesh, solution.displacement, pair.reference.shape), dtype=np.float64)


def pyvale_field(pair: Pair, subset: int, shape_function: str) -> Field:
    """pyvale's subsets at every second pixel."""
    from pyvale import dic  # type: ignore[import-untyped]

    images = [np.clip(np.round(image), 0, 255).astype(np.uint8) for image in (pair.deformed, pair.still)]
    first = np.clip(np.round(pair.reference), 0, 255).astype(np.uint8)
    mask = np.zeros(first.shape, dtype=bool)
    mask[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    found = []
    for image in images:
        with tempfile.TemporaryDirectory() as folder:
            dic.calculate_2d(
                first, image, mask, [first.shape[1] - 3 * MARGIN, first.shape[0] // 2], subset_size=subset,
                subset_step=2, max_displacement=8, shape_function=shape_function, output_basepath=folder, print_level=0,
            )  # fmt: skip
            found.append(
                dic.import_2d(str(next(Path(folder).glob("*.csv"))), layout="column", binary=False, delimiter=",")
            )
    x, y, v = (np.asarray(part, dtype=float).ravel() for part in (found[0].ss_x, found[0].ss_y, found[0].v_px))
    rest = np.stack([np.asarray(part, dtype=float).ravel() for part in (found[1].u_px, found[1].v_px)])
    return Field(x=x, y=y, v=v, rest=rest)


def gain(pair: Pair, field: Field, wanted: float) -> float:
    """Measured over true height of the wave of a period in px; NaN outside the image."""
    near = np.isfinite(field.v) & (np.abs(period(field.x) / wanted - 1) < BAND)
    if near.sum() < 20 or not period(0.0) * (1 + BAND) < wanted < period(field.x.max()) * (1 - BAND):
        return float("nan")
    true = pair.star(field.x[near], field.y[near])
    return float((field.v[near] @ true) / (true @ true))


def resolution(pair: Pair, field: Field) -> float:
    """Longest period (px) at which the wave's height is 10 % off."""
    periods = np.arange(11.0, 150.0)
    off = np.abs(np.array([gain(pair, field, one) for one in periods]) - 1) > 0.1
    return float(periods[off].max(initial=periods[0]))


def noise(field: Field) -> float:
    """Root mean square of u and v at rest, px."""
    return float(np.sqrt(np.nanmean(field.rest**2)))


def stated_over_true(pair: Pair, field: Field, size: float) -> Iterator[str]:
    """For each range of periods, and for all."""
    assert field.std is not None
    elements, error = period(field.x) / size, field.v - pair.star(field.x, field.y)
    limits = [*pairwise(PERIODS), (PERIODS[0], PERIODS[-1])]
    for low, high in limits:
        here: BoolArray = (elements >= low) & (elements < high) & np.isfinite(error)
        ratio = np.sqrt(np.mean(field.std[here] ** 2) / np.mean(error[here] ** 2)) if here.sum() > 20 else np.nan
        yield f"{ratio:.2f}"


def row(*cells: object) -> None:
    print(
        "| " + " | ".join(f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in cells) + " |", flush=True
    )


def compare(pair: Pair, size: float) -> None:
    for statistics in (True, False):
        for place, field in own_fields(pair, size, statistics=statistics).items():
            gains = [f"{gain(pair, field, count * size):.3f}" for count in (3, 4, 6)]
            scatter, longest = noise(field), resolution(pair, field)
            stated = stated_over_true(pair, field, size) if field.std is not None else ()
            row(size, "on" if statistics else "off", place, *gains, longest, scatter, scatter * longest, *stated)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("pair", nargs="*", type=Path, help="reference and deformed image; none makes a pair of our own")
    parser.add_argument("--sizes", nargs="+", type=float, default=[8, 10, 13, 16, 20, 25, 32, 40], help="elements, px")
    arguments = parser.parse_args()
    if len(arguments.pair) not in (0, 2):
        sys.exit("give the reference and the deformed image, or none")
    pair = read_pair(*arguments.pair) if arguments.pair else own_pair()
    ranges = [f"{low:g} to {high:g}" for low, high in pairwise(PERIODS)]
    row("elements, px", "statistics", "at", "gain at 3", "4", "6", "SR, px", "noise, px", "MEI",
        *(f"stated / true, {one}" for one in ranges), "all")  # fmt: skip
    for size in arguments.sizes:
        compare(pair, size)
    try:
        version = importlib.metadata.version("pyvale")
    except importlib.metadata.PackageNotFoundError:
        print("pyvale is not installed: `pip install pyvale` has its subsets beside")
        return
    for function in ("AFFINE", "QUAD"):
        for subset in (15, 21, 31, 41):
            field = pyvale_field(pair, subset, function)
            scatter, longest = noise(field), resolution(pair, field)
            row(f"pyvale {version} {function} {subset}", "", "", "", "", "", longest, scatter, scatter * longest)


if __name__ == "__main__":
    main()
