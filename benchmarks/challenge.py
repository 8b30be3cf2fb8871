"""Fine detail on the star of the DIC Challenge 2.0: what height of a wave is measured, and whether its error is stated.

v = 0.5 cos(2 pi (y - middle) / period) px, the period 10 px at the left edge of the image and growing by 0.07 px per px
(fitted to the Challenge's short pair, DIC_Challenge_Wave_*_Noisy.tif, which is that of the full table). A pair of our
own with white noise is the quick one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbmidic import Tri3Mesh, correlate, read_frame
from rgbmidic.correlation import Solution
from rgbmidic.fields import at_pixels
from rgbmidic.typing import BoolArray, FloatArray

from . import ROOT
from .contenders import Placing, displacements, peers_python
from .peers import speckle
from .tables import MissingDataError, Row, table

MARGIN = 20
BAND = 0.08
"""Half width of the band of periods over which a gain is taken, relative."""
STATED = ((2.0, 3.0), (3.0, 5.0), (5.0, 100.0))
"""Periods, in elements, at which stated and true error are compared."""


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


def read_pair(folder: Path) -> Pair:
    """The Challenge's pair; its noise from the residual where the waves are long."""
    paths = [folder / f"DIC_Challenge_Wave_{name}_Noisy.tif" for name in ("Reference", "Deformed")]
    if not all(path.is_file() for path in paths):
        raise MissingDataError(f"there is no {paths[0].name} in {folder}: set RGBMIDIC_SHARED_DATA")
    first, second = (read_frame(path, kind="monochrome").values[0].astype(float) for path in paths)
    height, width = first.shape
    found = correlate(
        first, second, region=(0.8 * width, MARGIN, width - 1 - MARGIN, height - 1 - MARGIN), element_size=16,
        prefilter="none", initial=(0, 0),
    )  # fmt: skip
    noise = float(found.residual[0]) * first.mean()  # the residual is that over the local mean
    added = np.random.default_rng(0).normal(scale=noise, size=first.shape)
    return Pair(reference=first, deformed=second, still=first + added)


def shared_wave() -> Path:
    """Folder of the full files."""
    return Path(os.environ.get("RGBMIDIC_SHARED_DATA", ROOT.parent / "shared" / "data")) / "dic_challenge2_wave"


def own_fields(pair: Pair, size: float) -> dict[str, Field]:
    """What the solve measures at the nodes and at the pixels."""
    moved, rest = (
        correlate(pair.reference, image, region=pair.region, element_size=size, initial=(0, 0))
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


def stated_over_true(pair: Pair, field: Field, size: float) -> Iterator[tuple[str, float]]:
    """For each range of periods; NaN where nothing is stated."""
    elements, error = period(field.x) / size, field.v - pair.star(field.x, field.y)
    for low, high in STATED:
        here: BoolArray = (elements >= low) & (elements < high) & np.isfinite(error)
        name = f"stated/true {low:g} to {high:g}" if high < 100 else f"stated/true over {low:g}"
        if field.std is None or here.sum() <= 20:
            yield name, float("nan")
        else:
            yield name, float(np.sqrt(np.mean(field.std[here] ** 2) / np.mean(error[here] ** 2)))


@table("star", page="explanation/uncertainty", cost=40, keys=2, own_quick=True)
def star(quick: bool) -> Iterator[Row]:
    """Star of the DIC Challenge 2.0 (0.5 px, periods of 10 to 150 px, camera noise): measured over true height of waves
    of 3, 4 and 6 elements; SR, the longest period with an error of 10 %; scatter at rest; their product MEI; stated
    uncertainty over true error at the nodes (root mean squares) for waves of 2 to 3, 3 to 5 and over 5 elements.
    """
    pair = own_pair((141, 1001)) if quick else read_pair(shared_wave())
    for size in (16,) if quick else (8, 16, 25, 40):
        for place, field in own_fields(pair, size).items():
            scatter, longest = float(np.sqrt(np.nanmean(field.rest**2))), resolution(pair, field)
            yield {
                "elements [px]": size,
                "at": place,
                **{f"gain at {count}": gain(pair, field, count * size) for count in (3, 4, 6)},
                "SR [px]": longest,
                "noise [px]": scatter,
                "MEI": scatter * longest,
                **dict(stated_over_true(pair, field, size)),
            }


SPACING = 10
"""px between the subsets of other programs."""
SUBSETS = {"pyvale": (11, 17, 25, 41), "pyvale quadratic": (17, 25, 41, 57)}
"""Sides (px); smaller ones lose points."""


@table("star_peers", page="explanation/uncertainty", cost=150, keys=3, own_quick=True)
def star_peers(quick: bool) -> Iterator[Row]:
    """The same star beside subsets of pyvale, affine and quadratic, with its default prefilter: SR, the longest period
    with an error of 10 %; scatter at rest; and their product, which is what resolution costs in noise."""
    python, peers = ("", []) if quick else peers_python(list(SUBSETS))
    pair = own_pair((101, 601)) if quick else read_pair(shared_wave())
    fields: dict[tuple[str, str, int], Field] = {}
    for size in (16,) if quick else (8, 12, 16, 25, 40):
        for place, field in own_fields(pair, size).items():
            fields["rgbmidic", place, size] = field
    for name in peers:
        both = {
            f"{size} {kind}": (pair.reference, image, Placing(pair.region, size, SPACING))
            for size in SUBSETS[name]
            for kind, image in (("moved", pair.deformed), ("still", pair.still))
        }
        found = displacements(python, name, both)
        for size in SUBSETS[name]:
            moved, still = found[f"{size} moved"], found[f"{size} still"]
            if moved is not None and still is not None:
                fields[name, "subsets", size] = Field(
                    x=moved[0][:, 0], y=moved[0][:, 1], v=moved[1][:, 1], rest=still[1].T
                )
    for (name, place, size), field in fields.items():
        scatter, longest = float(np.sqrt(np.nanmean(field.rest**2))), resolution(pair, field)
        yield {
            "program": name,
            "at": place,
            "elements or subsets [px]": size,
            "SR [px]": longest,
            "noise [px]": scatter,
            "product [px^2]": scatter * longest,
        }


BINS = ((3.0, 3.5), (3.5, 4.5), (4.5, 6.0), (6.0, 9.0), (9.0, 15.0))
"""Periods, in elements, at which noise and discretisation error are compared with the true error."""


@table("mesh_error", page="explanation/discretisation", cost=25, keys=3, own_quick=True)
def mesh_error(quick: bool) -> Iterator[Row]:
    """Star of the DIC Challenge 2.0: stated over true error (root mean squares over the nodes) of v and eyy, of the
    noise that is stated without `mesh.error`, of the noise with it, and of noise and discretisation error together,
    by the period of the waves in elements; at the edge over all waves from 3 elements on.
    """
    pair = own_pair((181, 1001)) if quick else read_pair(shared_wave())
    for size in (16,) if quick else (16, 25, 40):
        options = {"region": pair.region, "element_size": size, "initial": (0, 0)}
        plain = correlate(pair.reference, pair.deformed, **options)
        found = correlate(pair.reference, pair.deformed, mesh_error=True, **options)
        x, y = found.nodes.T
        edge, elements = Tri3Mesh(nodes=found.nodes, elements=found.elements).on_boundary, period(x) / size
        wave = 2 * np.pi / period(x)
        slope = -0.5 * wave * np.sin(wave * (y - pair.reference.shape[0] // 2))
        errors = {"v": found.displacement[:, 1] - pair.star(x, y), "eyy": found.strain[:, 1] - slope}
        places = [(f"{low:g} to {high:g}", ~edge & (elements >= low) & (elements < high)) for low, high in BINS]
        for place, here in (*places, ("edge", edge & (elements >= BINS[0][0]))):
            for name, error in errors.items():
                known = here & np.isfinite(error)
                if known.sum() <= 20:
                    continue
                kind = "displacement" if name == "v" else "strain"
                before, noise = (getattr(one, f"{kind}_std")[known, 1] for one in (plain, found))
                both = np.hypot(noise, getattr(found, f"{kind}_error")[known, 1])
                true = float(np.sqrt(np.mean(error[known] ** 2)))
                columns = {"without": before, "noise": noise, "noise and mesh": both}
                ratios = {column: float(np.sqrt(np.mean(part**2))) / true for column, part in columns.items()}
                yield {"elements [px]": size, "period [elements]": place, "of": name, "true error": true, **ratios}
