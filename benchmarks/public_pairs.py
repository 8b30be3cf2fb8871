"""Public image pairs with a known displacement: the defaults of `correlate` and `measure` beside other programs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rgbmidic import read_frame
from rgbmidic.typing import FloatArray

from . import ROOT
from .grey_levels import DEFAULTS, measured_by
from .tables import Row, table
from .uncertainty import rms

Truth = Callable[[FloatArray], FloatArray]
MARGIN, INSIDE = 12, 24
"""px: the region's distance from the border of the frame, and the least one of the points that count."""


@dataclass(frozen=True)
class PublicPair:
    """Two files of a folder, displacement at points (n, 2), side of elements and subsets (px)."""

    folder: str
    reference: str
    deformed: str
    truth: Truth
    size: int = 25


def shift(u: float, v: float) -> Truth:
    """A rigid translation."""
    return lambda points: np.broadcast_to((u, v), points.shape)


def affine(gradient: tuple[tuple[float, float], tuple[float, float]], fixed: tuple[float, float]) -> Truth:
    """Displacement gradient (rows u, v) and the point at rest."""
    return lambda points: (points - fixed) @ np.array(gradient).T


def wave(folder: Path, column: int) -> Truth:
    """u of sample 14, of the column of the command; v = 0."""
    command = np.loadtxt(folder / "command.csv", delimiter=",")[:, column]
    return lambda points: np.stack([np.interp(points[:, 0], np.arange(len(command)), command), 0 * points[:, 0]], 1)


def shared(name: str) -> Path:
    """Folder of the full files."""
    return Path(os.environ.get("RGBMIDIC_SHARED_DATA", ROOT.parent / "shared" / "data")) / name


def pairs() -> dict[str, PublicPair]:
    """All by name."""
    found = {
        "challenge 5 no motion; contrast and offset changed": PublicPair(
            "public_pairs", "s5_ref.tif", "s5_000_c75_r10.tif", shift(0, 0)
        ),
        "challenge 5 0.1 px; contrast and offset changed": PublicPair(
            "public_pairs", "s5_ref.tif", "s5_001_c100_r20.tif", shift(0.1, 0.1)
        ),
    }
    for size in (25, 40):
        for name, truth in (
            ("translation", shift(7.0852, 7.0852)),
            ("tension", affine(((0.02, 0), (0, -0.01)), (0, 250))),
            ("shear", affine(((0, 0.01), (0.01, 0)), (250, 250))),
        ):
            found[f"pattern 7x {name}; {size} px"] = PublicPair(
                "public_pairs", "pattern_7x.bmp", f"pattern_7x_{name}.bmp", truth, size
            )
            if size == 40:
                found[f"pattern 11 (periodic) {name}"] = PublicPair(
                    "public_pairs", "pattern_11.bmp", f"pattern_11_{name}.bmp", truth, size
                )
    for frame, size in (("04", 0.4), ("25", 25.0)):
        found[f"rigid plate {size:g} px"] = PublicPair(
            "public_pairs", "rigid_cam0_frame00.tiff", f"rigid_cam0_frame{frame}.tiff", shift(size, -size)
        )
    for size in (1, 5, 10, 15):
        found[f"whole pixels {size}"] = PublicPair("dic_rigid_shift", "ref.tif", f"def_{size}.tif", shift(size, size))
    for level, column in (("L1", 1), ("L3", 3), ("L5", 5)):
        folder = "dic_challenge_sample14"
        found[f"challenge 14 {level}"] = PublicPair(
            folder, "Sample14 Reference.tif", f"Sample14 {level} Amp0.1b.tif", wave(shared(folder), column)
        )
    return {name.replace(";", " with"): pair for name, pair in found.items()}


def read(pair: PublicPair) -> tuple[FloatArray, FloatArray]:
    """Grey levels of both states."""
    first, second = (
        read_frame(shared(pair.folder) / name, kind="monochrome").values[0].astype(np.float64)
        for name in (pair.reference, pair.deformed)
    )
    return first, second


def counted(points: FloatArray, truth: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Whether points are `INSIDE` px and more inside the frame in both states."""
    both = np.stack([points, points + truth])
    return (np.minimum(both, np.array(shape)[::-1] - 1 - both) >= INSIDE).all(axis=(0, 2))


@table("public_pairs", page="explanation/uncertainty", cost=60)
def public_pairs(quick: bool) -> Iterator[Row]:
    """Public pairs with known displacement."""
    for name, pair in pairs().items():
        f, g = read(pair)
        height, width = f.shape
        row: Row = {"pair": name}
        for default in DEFAULTS:
            region = (MARGIN, MARGIN, width - 1 - MARGIN, height - 1 - MARGIN)
            found = measured_by(default, f, g, region=region, element_size=pair.size)
            truth = pair.truth(found.nodes)
            here = counted(found.nodes, truth, f.shape)
            error = (found.displacement - truth)[here]
            some = np.isfinite(error).any()
            row |= {
                f"{default} [px]": rms(error) if some else float("nan"),
                f"{default}: error/stated": rms(error / found.displacement_std[here]) if some else float("nan"),
                f"{default}: lost [%]": 100 * float(np.isnan(error[:, 0]).mean()),
            }
        yield row
