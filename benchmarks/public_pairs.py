"""Public image pairs with a known displacement: the defaults of `correlate` and `measure` beside other programs.

The files, with source and licence, are described by SOURCE.txt of their folders. Crops of some are in tests/data, whose
size is limited: sample 5 and the tension of pattern 7x. Not there: pattern 7x's other motions, pattern 11 (a lattice of
10 px: every program is a period off where the motion is beyond half of it), the rendered plate, sample 14's L1.
OpenCorr is not among the programs: it is C++ that must be built with OpenCV, FFTW and Eigen.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from real_files import CROPS, corner

from rgbmidic import read_frame
from rgbmidic.typing import BoolArray, FloatArray

from . import ROOT
from .contenders import Placing, displacements, peers_python
from .grey_levels import DEFAULTS, measured_by
from .tables import MissingDataError, Row, table
from .uncertainty import rms

PEERS = ("pyvale", "pyxel-dic", "al-dic", "muDIC")
MARGIN, INSIDE = 12, 24
"""px: the region's distance from the border of the frame, and the least one, in both states, of points that count."""
SAMPLE14 = "dic_challenge_sample14"
LEVELS = {"L1": 1, "L3": 3, "L5": 5}
"""Columns of its command."""


@dataclass(frozen=True)
class PublicPair:
    """Two files of a folder, displacement at points (n, 2) of the full reference, side of elements and subsets (px)."""

    folder: str
    reference: str
    deformed: str
    truth: Callable[[FloatArray], FloatArray]
    size: int = 25

    def find(self, root: Path) -> Path | None:
        """Its folder below a root, if both files are there."""
        folder = root / self.folder
        return folder if all((folder / name).is_file() for name in (self.reference, self.deformed)) else None


def affine(*rows: tuple[float, float, float]) -> Callable[[FloatArray], FloatArray]:
    """u and v, each as a constant and the slopes along x and y."""
    return lambda points: np.array(rows)[:, 0] + points @ np.array(rows)[:, 1:].T


def commanded(level: str) -> Callable[[FloatArray], FloatArray]:
    """u of sample 14; v is 0."""
    command = np.loadtxt(CROPS / SAMPLE14 / "command.csv", delimiter=",")[:, LEVELS[level]]
    return lambda points: np.interp(points[:, 0], np.arange(len(command)), command)[:, None] * (1.0, 0.0)


def public() -> dict[str, PublicPair]:
    """All pairs by name. Patterns 7x and 11 move as affine fits to them say, with residuals below .002 px."""
    folder = "public_pairs"
    found = {
        "challenge 5 at rest; contrast and offset": PublicPair(
            folder, "s5_ref.tif", "s5_000_c75_r10.tif", affine((0, 0, 0), (0, 0, 0))
        ),
        "challenge 5 by 0.1 px; contrast and offset": PublicPair(
            folder, "s5_ref.tif", "s5_001_c100_r20.tif", affine((0.1, 0, 0), (0.1, 0, 0))
        ),
    }
    motions = {
        "translation": affine((7.0852, 0, 0), (7.0852, 0, 0)),
        "tension": affine((0, 0.02, 0), (2.5, 0, -0.01)),
        "shear": affine((-2.5, 0, 0.01), (-2.5, 0.01, 0)),
    }
    for pattern, sizes in (("7x", (25, 40)), ("11", (40,))):
        for size in sizes:
            for name, truth in motions.items():
                title = f"pattern {pattern} {name}{' (period of 10 px)' if pattern == '11' else ''}; {size} px"
                files = f"pattern_{pattern}.bmp", f"pattern_{pattern}_{name}.bmp"
                found[title] = PublicPair(folder, *files, truth, size)
    for frame, shift in (("04", 0.4), ("25", 25.0)):
        files = "rigid_cam0_frame00.tiff", f"rigid_cam0_frame{frame}.tiff"
        found[f"rigid plate by {shift:g} px"] = PublicPair(folder, *files, affine((shift, 0, 0), (-shift, 0, 0)))
    for shift in (1, 5, 10, 15):
        files, truth = ("ref.tif", f"def_{shift}.tif"), affine((shift, 0, 0), (shift, 0, 0))
        found[f"whole pixels; {shift}"] = PublicPair("dic_rigid_shift", *files, truth)
    for level in LEVELS:
        files = "Sample14 Reference.tif", f"Sample14 {level} Amp0.1b.tif"
        found[f"challenge 14 {level}; waves of 0.1 px"] = PublicPair(SAMPLE14, *files, commanded(level))
    return {name.replace(";", ":"): pair for name, pair in found.items()}


@dataclass(frozen=True)
class States:
    """Grey levels of both states of a pair, and the corner of the reference in the full one (px)."""

    pair: PublicPair
    reference: FloatArray
    deformed: FloatArray
    origin: tuple[int, int]

    @classmethod
    def read(cls, pair: PublicPair, folder: Path) -> States:
        """Both states from a folder."""
        images = [
            read_frame(folder / name, kind="monochrome").values[0].astype(np.float64)
            for name in (pair.reference, pair.deformed)
        ]
        return cls(pair, *images, corner(folder))

    @property
    def placing(self) -> Placing:
        """All of the frame but for the margin."""
        height, width = self.reference.shape
        return Placing((MARGIN, MARGIN, width - 1 - MARGIN, height - 1 - MARGIN), self.pair.size)

    def error(self, points: FloatArray, displacement: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Error at the points that count, and which these are."""
        truth = self.pair.truth(points + self.origin)
        both = np.stack([points, points + truth])
        far = np.array(self.reference.shape)[::-1] - 1 - both
        counted = (np.minimum(both, far) >= INSIDE).all(axis=(0, 2))
        return (displacement - truth)[counted], counted


def rms_or_none(values: FloatArray) -> float:
    """Root mean square; NaN where no value is known."""
    return rms(values) if np.isfinite(values).any() else float("nan")


@table("public_pairs", page="explanation/uncertainty", cost=400, own_quick=True)
def public_pairs(quick: bool) -> Iterator[Row]:
    """Public image pairs with known displacement: rms error in px of the defaults of `correlate` and `measure`, with
    error over stated uncertainty and the points that are not measured, beside other programs by their defaults, with
    elements or subsets of the same side (25 px unless stated), over points at least 24 px inside the frame in both
    states.
    """
    shared = Path(os.environ.get("RGBMIDIC_SHARED_DATA", ROOT.parent / "shared" / "data"))
    python, peers = ("", []) if quick else peers_python(PEERS)
    # the other crops have tests of their own (tests/truth/test_real_images.py)
    chosen = {name: pair for name, pair in public().items() if not quick or pair.folder == "public_pairs"}
    folders = {name: (pair, pair.find(CROPS if quick else shared)) for name, pair in chosen.items()}
    if not quick and (missing := [name for name, (_, folder) in folders.items() if folder is None]):
        raise MissingDataError(f"not in {shared}, set RGBMIDIC_SHARED_DATA: {', '.join(missing)}")
    states = {name: States.read(pair, folder) for name, (pair, folder) in folders.items() if folder}
    measured = {
        peer: displacements(python, peer, {n: (s.reference, s.deformed, s.placing) for n, s in states.items()})
        for peer in peers
    }
    for name, pair in states.items():
        row: Row = {"pair": name}
        for default in DEFAULTS:
            region, size = pair.placing.region, pair.placing.size
            found = measured_by(default, pair.reference, pair.deformed, region=region, element_size=size)
            error, counted = pair.error(found.nodes, found.displacement)
            row |= {
                default: rms_or_none(error),
                f"{default}: error/stated": rms_or_none(error / found.displacement_std[counted]),
                f"{default}: lost [%]": 100 * float(np.isnan(error[:, 0]).mean()),
            }
        for peer in peers:
            points = measured[peer][name]
            row[peer] = float("nan") if points is None else rms_or_none(pair.error(*points)[0])
        yield row
