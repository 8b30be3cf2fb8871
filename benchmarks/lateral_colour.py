"""What the lateral colour of a lens and lamps of unequal strength cost, on the project's own scenes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rgbmidic.pipeline import Separation
from rgbmidic.tools.lab.virtual import strained_plate
from rgbmidic.tools.lab.virtual.dataset import true_calibration

from .tables import Row, table
from .uncertainty import Verdict, rms, solve_pair
from .uncertainty_scenes import Kind, Pair, Setting, frame, pair_of, turn

SIZE = 256
BRIGHTEST = 0.8
"""Largest level of any channel, of the full scale."""
BODIES = {
    "mat plate": Setting(body="plate", state=strained_plate(), size=SIZE, seed=43, gloss=0.0),
    "sphere 1°": Setting(body="sphere", state=turn(1.0), size=SIZE, seed=43),
    "sphere 8°": Setting(body="sphere", state=turn(8.0), size=SIZE, seed=43),
}
LENSES = (0.0, 0.5, 2.0)
STRENGTHS = ((1.0, 1.0, 1.0), (1.0, 1.0, 4.0))


def exposed(pair: Pair, strengths: tuple[float, ...]) -> Pair:
    """The pair with lamps of these strengths, at the exposure that the brightest channel allows."""
    mixing = pair.scene.camera.mixing(pair.scene.lights)
    lights = [images * np.array(strengths, dtype=np.float32)[:, None, None] for images in pair.lights]
    largest = max(float(np.einsum("cl,lyx->cyx", mixing, images).max()) for images in lights)
    gain = np.float32(BRIGHTEST * pair.scene.camera.full_scale / largest)
    return replace(pair, lights=(lights[0] * gain, lights[1] * gain))


def solved(pair: Pair) -> dict[str, Verdict]:
    """Verdicts on the default, on the same without a registration, on Malvar's filters and on a 3-CCD camera."""
    scene, found = pair.scene, dict[str, Verdict]()
    known = true_calibration(scene)
    separations: dict[str, tuple[Kind, Separation]] = {
        "default": ("bayer", Separation(calibration=known)),
        "not registered": ("bayer", Separation(calibration=replace(known, registration=None))),
        "Malvar": ("bayer", Separation(calibration=known, demosaic="malvar")),
        "3-CCD": ("rgb", Separation(calibration=known)),
    }
    for way, (kind, separation) in separations.items():
        shots = [frame(images, scene, kind, 4300 + number) for number, images in enumerate(pair.lights)]
        first, second = (separation((shot,)) for shot in shots)
        found[way] = Verdict.of(solve_pair(pair, (first, second)), pair)
    return found


@table("lateral_colour", page="explanation/demosaicing", cost=120, keys=3, seed=43)
def lateral_colour(quick: bool) -> Iterator[Row]:
    """Rms error of the displacement by the lens's lateral colour (px at the corner from one lamp to the next) and the
    strengths of red : green : blue lamps: with the default and a calibrated registration, with none, by Malvar, and
    with a 3-CCD camera. A mat plate shifted by .25 px and stretched by .2 %, and a turned sphere, frames of 256 px."""
    for name in list(BODIES)[:1] if quick else BODIES:
        for lens in LENSES[1:2] if quick else LENSES:
            pair = pair_of(replace(BODIES[name], lateral_colour=lens))
            for strengths in STRENGTHS[:1] if quick else STRENGTHS:
                row: Row = {"scene": name, "lateral colour [px]": f"{lens:g}"}
                row["lamps"] = " : ".join(f"{strength:g}" for strength in strengths)
                found = solved(exposed(pair, strengths))
                row |= {f"{way} [px]": verdict.rms for way, verdict in found.items()}
                yield row | {f"{way}: error/stated": rms(verdict.ratio) for way, verdict in found.items()}
