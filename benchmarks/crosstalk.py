"""Table of what the crosstalk of camera and lamps costs, and where: in the unmixing of noise or in the demosaicing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.tools.lab.virtual import State, strained_plate

from .tables import Row, table
from .uncertainty import Verdict, rms, solve_pair
from .uncertainty_scenes import CROSSTALKS, KINDS, PAINTS, Setting, both, pair_of, turn

CAMERAS: dict[str, tuple[str, dict[str, Any]]] = {
    "3-CCD": ("3-CCD", {}),
    "Bayer": ("Bayer", {}),
    "Bayer without noise": ("Bayer", {"gain": 1e7, "read_noise": 0.0}),
    "Bayer that never saturates": ("Bayer", {"bits": 14, "exposure": 0.125}),
}
SHIFT = strained_plate(shift_px=(0.5, 0.15), strain=0)
SPARKLING = {"wrinkles": 0.05}
CASES: dict[str, tuple[str, State, dict[str, float]]] = {
    "sphere 1° [px]": ("sphere", turn(1.0), SPARKLING),
    "sphere 8° [px]": ("sphere", turn(8.0), SPARKLING),
    "glossy sphere 8° [px]": ("sphere", turn(8.0), PAINTS["glossy"]),
    "plate in green's glare [px]": ("plate", SHIFT, SPARKLING),
}


@table("crosstalk", page="explanation/demosaicing", cost=90, keys=2, seed=41, own_quick=True)
def crosstalk(quick: bool) -> Iterator[Row]:
    """Effect of crosstalk: the largest noise amplification of a light by the unmixing; rms error of the displacement of
    two spheres turned by 1 and 8 degrees (wrinkles 50 um apart; glossy paint) and of two plates completely in green's
    reflection, shifted by half a pixel; and error over stated uncertainty of all of them.
    """
    seeds, size = ((41,), 256) if quick else ((41, 42), 448)
    for matrix in ("measured",) if quick else CROSSTALKS:
        amplification = Crosstalk(matrix=np.array(CROSSTALKS[matrix]), lights=("red", "green", "blue"))
        row: Row = {"worst noise amplification": float(amplification.noise_amplification.max())}
        for camera in ("Bayer",) if quick else CAMERAS:
            kind, changes = CAMERAS[camera]
            ratios = []
            for title, (body, state, paint) in list(CASES.items())[1:2] if quick else CASES.items():
                squares = []
                for seed in seeds:
                    pair = pair_of(Setting(body=body, state=state, size=size, seed=seed, **paint))
                    pair = replace(pair, scene=replace(pair.scene, camera=replace(pair.scene.camera, **changes)))
                    images = both(pair, KINDS[kind], seed=seed, crosstalk=matrix)
                    verdict = Verdict.of(solve_pair(pair, images), pair)
                    squares.append(verdict.rms**2)
                    ratios.append(verdict.ratio)
                row |= {title: float(np.sqrt(np.mean(squares)))}
            yield {"crosstalk": matrix, "camera": camera, **row, "error/stated": rms(np.concatenate(ratios))}
