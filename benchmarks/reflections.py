"""What the product is for, in one table: plain DIC, the paper's masks and rgbmidic in a reflection."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench import SMALLEST, Bench
from run import run_scene

from .tables import Row, table
from .uncertainty import rms

METHODS = {"dic": "plain DIC with one lamp", "midic": "the paper's binary masks", "default": "rgbmidic"}
LIGHTS = {"sequential": "two lamps in succession", "bayer": "three colours in one Bayer shot"}
SIZE, ANGLES, SEEDS = 640, (0.333, 1.0, 2.0, 8.0), (0, 1, 2)
CROSSED = slice(3, 5)
"""Areas A3 and A4: the reflection covers A4 at rest and has come to A3 at 8 degrees."""
TREND = 1.3
"""An area is as good as A0 up to this multiple of its P (examples/paper/claims.py)."""


@table(
    "reflections", page="explanation/polarisers", cost=130, own_quick=True, within={"areas within 1.3 A0 [%]": 200 / 4}
)
def reflections(quick: bool) -> Iterator[Row]:
    """A sphere turning by 0.33 to 8 degrees under a reflection: the paper's perturbation P and the error."""
    angles = (1.0,) if quick else ANGLES
    for name in ("sequential",) if quick else LIGHTS:
        studies = [
            run_scene(
                Bench.build(name, SMALLEST if quick else SIZE, seed=seed),
                angles,
                methods=tuple(METHODS),
                **({"set_up": (1.0,)} if quick else {}),
            )
            for seed in (SEEDS[:1] if quick else SEEDS)
        ]
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
