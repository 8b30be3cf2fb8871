"""Which frames that are not what was calibrated the check of the reference frame finds, and whether good frames pass.

Every good scene is recorded by the calibrated camera and by cameras that are not: another gain and crosstalk, channels
swapped, gains per channel, gamma, an 8-bit table, interpolated samples, another phase of the pattern, another black
level. What is done to *stored* samples leaves gaps in their histogram, what is done *inside* the camera, before it
stores them, does not. A count is of scenes with an error (and a warning) by `rgbmidic.tools.preparation.frame_check`;
with the whole calibration, and with its crosstalk alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
from colour_scenes import NOISE, A, sparkle, speckle

from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.crosstalk import Crosstalk
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.tools.lab.virtual import plate_scene, render, sphere_scene
from rgbmidic.tools.preparation.frame_check import contradictions
from rgbmidic.tools.scene.camera import PIXEL
from rgbmidic.typing import FloatArray, FloatImage

from .demosaicing import MEASURED, TILT, painted
from .tables import table

BLACK, WHITE = 64, 4095
RANGE = WHITE - BLACK
Scenes = list[tuple[str, FloatImage]]
Change = Callable[[FloatArray], FloatArray]


def scenes(quick: bool) -> Scenes:
    """Lights (k, H, W) in DN of every good scene; those of `quick` need no rendering."""
    found = []
    for diameter in (2.5, 3.0, 4.2, 6.0):
        mat = np.stack([1500 * speckle((192, 192), diameter=diameter, seed=1)] * 3)
        glaring = mat + np.array([0, 1, 0])[:, None, None] * sparkle((192, 192), 1200, 5)
        found += [(f"discs {diameter}", mat), (f"discs {diameter} in glare", glaring)]
    if quick:
        return found[4:6]
    for body, make in (("sphere", sphere_scene), ("plate", partial(plate_scene, glare="green", tilt_deg=TILT))):
        for gloss in (0.0, 1.5, 3.0):
            for size in (2.5, 8.0):
                scene = make(size=256, seed=11, droplet=size * PIXEL, gloss=gloss)
                found.append((f"{body}, gloss {gloss}, speckle {size}", render(scene, None)))
        scene = painted(make(size=256, seed=11, droplet=4.2 * PIXEL, gloss=1.5), 0.15)
        found.append((f"{body}, coarse paint", render(scene, None)))
    return found


def record(
    lights: FloatImage,
    matrix: FloatArray = A,
    *,
    noise: NoiseModel = NOISE,
    black: float = BLACK,
    cfa: str = "RGGB",
    inside: Change | None = None,
    stored: Change | None = None,
    other: Change | None = None,
    light: float = 1.0,
    seed: int = 0,
) -> Mosaic:
    """What a camera stores; `inside` and `stored` change the samples above black before and after rounding, `other` the
    crosstalk."""
    rng = np.random.default_rng(seed)
    channels = light * np.tensordot(other(matrix) if other else matrix, lights, axes=1).astype(np.float64)
    values = np.empty(channels.shape[1:])
    for (row, column), channel in np.ndenumerate(cfa_channels(cfa)):
        values[row::2, column::2] = channels[channel, row::2, column::2]
    values = rng.poisson(np.maximum(values, 0) * noise.gain) / noise.gain
    values += noise.read_noise * rng.normal(size=values.shape)
    values = np.clip(np.rint((inside(values) if inside else values) + black), 0, WHITE)
    if stored:
        values = np.clip(np.rint(stored(values - black) + black), 0, WHITE)
    return Mosaic(values=values.astype(np.uint16), cfa="RGGB", black_level=np.array(BLACK), white_level=WHITE)


def gain(factor: float, channel: int) -> Change:
    """A gain of one channel of an RGGB mosaic."""

    def change(values: FloatArray) -> FloatArray:
        out = values.copy()
        for (row, column), sampled in np.ndenumerate(cfa_channels("RGGB")):
            if sampled == channel:
                out[row::2, column::2] *= factor
        return out

    return change


def gamma(exponent: float) -> Change:
    """Full scale to full scale."""
    return lambda values: np.sign(values) * RANGE * np.minimum(np.abs(values) / RANGE, 1) ** (1 / exponent)


def companded(values: FloatArray) -> FloatArray:
    """Eight bits of the square root, expanded again."""
    return (np.rint(255 * np.sqrt(np.clip(values, 0, RANGE) / RANGE)) / 255) ** 2 * RANGE


def companded_raw(values: FloatArray) -> FloatArray:
    """Eight bits of the square root, not expanded but for their unit."""
    return np.rint(255 * np.sqrt(np.clip(values, 0, RANGE) / RANGE)) / 255 * RANGE


def interpolated(phase: tuple[int, int]) -> Change:
    """Demosaiced bilinearly, and sampled by another phase of the pattern."""

    def change(values: FloatArray) -> FloatArray:
        raw = np.clip(values + BLACK, 0, 65535).astype(np.uint16)
        colours = cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2RGB)
        out = np.empty_like(values)
        for (row, column), channel in np.ndenumerate(np.roll(cfa_channels("RGGB"), phase, axis=(0, 1))):
            out[row::2, column::2] = colours[row::2, column::2, channel]
        return np.roll(out, (-phase[0], -phase[1]), axis=(0, 1)) - BLACK

    return change


def smoothed(values: FloatArray) -> FloatArray:
    """Noise reduction: a Gaussian of .8 samples within each plane."""
    out = values.copy()
    for row in (0, 1):
        for column in (0, 1):
            out[row::2, column::2] = cv2.GaussianBlur(values[row::2, column::2], (0, 0), 0.8)
    return out


def manipulations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Name, strength and options of `record` of everything that is not what was calibrated."""
    for factor in (0.5, 0.8, 1.25, 1.5, 2.0, 4.0):
        yield "another camera: e-/DN", f"x {factor:g}", {"noise": replace(NOISE, gain=NOISE.gain * factor)}
    yield "another camera: crosstalk", "the other A", {"other": lambda a: MEASURED if a is A else A}
    for share in (0.4, 0.6):
        full = np.full((3, 3), share) + (1 - share) * np.eye(3)
        yield "another camera: crosstalk", f"{share:g} everywhere", {"other": lambda a, full=full: full}
    for order, text in (([2, 1, 0], "R and B"), ([1, 0, 2], "R and G"), ([0, 2, 1], "G and B"), ([1, 2, 0], "all")):
        yield "channels swapped", text, {"other": lambda a, order=order: a[order]}
    for cfa in ("BGGR", "GRBG", "GBRG"):
        yield "wrong phase of the pattern", cfa, {"cfa": cfa}
    for where in ("stored", "inside"):
        for factor in (0.8, 1.05, 1.2, 1.5, 2.0):
            yield f"white balance {where}", f"R x {factor:g}", {where: gain(factor, 0)}
        for exponent in (1.1, 1.4, 1.8, 2.2):
            yield f"gamma {where}", f"{exponent:g}", {where: gamma(exponent)}
    yield "8-bit square root", "expanded", {"inside": companded}
    yield "8-bit square root", "scaled only", {"inside": companded_raw}
    for phase, text in (((1, 0), "row"), ((1, 1), "row and column")):
        yield "demosaiced and sampled in another phase", text, {"stored": interpolated(phase)}
    yield "noise reduction", "σ .8 samples", {"stored": smoothed}
    for offset in (-60, -30, 30, 100, 300):
        yield "black level off", f"{offset:+d} DN", {"black": BLACK + offset}


def verdict(
    frame: Mosaic | ChannelFrame, calibration: Calibration, repeat: Mosaic | None = None
) -> tuple[int, set[str]]:
    """2 for an error, 1 for a warning, 0; and the checks that found it."""
    inside = np.ones(frame.values.shape[-2:], dtype=bool)
    found = contradictions(frame, calibration, inside, repeat)
    level = max((1 if check.passed else 2 for check in found), default=0)
    return level, {check.name for check in found if (1 if check.passed else 2) == level}


def calibrations(matrix: FloatArray) -> tuple[Calibration, Calibration]:
    """Of everything, and what `rgbmidic-calibrate crosstalk` alone writes."""
    crosstalk = Crosstalk(matrix=matrix, lights=("red", "green", "blue"))
    return Calibration(crosstalk=crosstalk, noise=NOISE, unevenness=0.0), Calibration(
        crosstalk=crosstalk, unevenness=0.0
    )


@table("manipulated_frames", page="how-to/inspect", cost=65, own_quick=True)
def manipulated(quick: bool) -> Iterator[dict[str, object]]:
    """Frames (%) that the check against the calibration refuses and warns of, and by what: spheres, plates of gloss 0
    to 3 with speckle of 2.5 and 8 px, coarse paint and discs, two crosstalks; with the whole calibration, with a
    second frame of the state as well, and with the crosstalk alone."""
    cases = [(name, lights, matrix) for name, lights in scenes(quick) for matrix in (A, MEASURED)]
    good = [("a good frame", f"light x {factor:g}", {"light": factor}) for factor in (1.0, 0.5, 0.1, 2.2)]
    for name, strength, options in [*good[:1], *list(manipulations())[4::12]] if quick else [*good, *manipulations()]:
        taken = [
            (*(record(lights, matrix, **options, seed=seed) for seed in (0, 1)), calibrations(matrix))
            for _, lights, matrix in cases
        ]
        cells: dict[str, object] = {"manipulation": name, "strength": strength}
        by: set[str] = set()
        for text, repeated, which in (("", False, 0), (" with a second frame", True, 0), (" by crosstalk", False, 1)):
            verdicts = [verdict(one, known[which], again if repeated else None) for one, again, known in taken]
            for word, wanted in (("refused", 2), ("warned", 1)):
                cells[f"{word}{text} [%]"] = round(100 * sum(level == wanted for level, _ in verdicts) / len(verdicts))
            by = by.union(*(checks for _, checks in verdicts))
        yield cells | {"by": " and ".join(sorted(by)) or "–"}
