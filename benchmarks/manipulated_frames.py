"""Which frames that are not what was calibrated the check of the reference frame finds, and whether good frames pass.

    python benchmarks/manipulated_frames.py [--data FOLDER]

Every good scene is recorded by the calibrated camera and by cameras that are not: another gain and crosstalk, channels
swapped, gains per channel, gamma, an 8-bit table, interpolated samples, another phase of the pattern, another black
level. What is done to *stored* samples leaves gaps in their histogram, what is done *inside* the camera, before it
stores them, does not. A count is of scenes with an error (and a warning) by `rgbmidic.illumination.frame_check`; with
the whole calibration, and with its crosstalk alone. `--data` names a folder with the independent scenes and real raw
frames. docs/how-to/inspect.md quotes the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from colour_scenes import NOISE, A, sparkle, speckle

from rgbmidic.errors import RgbmidicError
from rgbmidic.frames import open_source
from rgbmidic.frames.data import ChannelFrame, Mosaic, cfa_channels
from rgbmidic.illumination.calibration import Calibration, Crosstalk
from rgbmidic.illumination.frame_check import mismatches
from rgbmidic.illumination.linear import NoiseModel
from rgbmidic.lab.virtual import plate_scene, sphere_scene
from rgbmidic.scene.camera import PIXEL
from rgbmidic.settings import FrameSettings
from rgbmidic.typing import FloatArray, FloatImage

from .demosaicing import TILT, painted
from .uncertainty_scenes import stored_render

BLACK, WHITE = 64, 4095
RANGE = WHITE - BLACK
MEASURED = np.array([[1, 0.15, 0.05], [0.12, 1, 0.33], [0.02, 0.28, 1]])
"""A crosstalk with as much between green and blue as measured cameras have."""
EVERY = 2
"""Every second scene is manipulated."""
Scenes = list[tuple[str, FloatImage]]
Change = Callable[[FloatArray], FloatArray]


def scenes(data: Path | None) -> Scenes:
    """Lights (k, H, W) in DN of every good scene."""
    found = list(_independent(data)) if data else []
    for body, make in (("sphere", sphere_scene), ("plate", partial(plate_scene, glare="green", tilt_deg=TILT))):
        for gloss in (0.0, 1.5, 3.0):
            for size in (2.5, 4.2, 8.0):
                scene = make(size=320, seed=11, droplet=size * PIXEL, gloss=gloss)
                found.append((f"{body}, gloss {gloss}, speckle {size}", stored_render(scene, None)))
        scene = painted(make(size=320, seed=11, droplet=4.2 * PIXEL, gloss=1.5), 0.15)
        found.append((f"{body}, coarse paint", stored_render(scene, None)))
    for diameter in (2.5, 3.0, 4.2, 6.0):
        mat = np.stack([1500 * speckle((192, 192), diameter=diameter, seed=1)] * 3)
        glaring = mat + np.array([0, 1, 0])[:, None, None] * sparkle((192, 192), 1200, 5)
        found += [(f"discs {diameter}", mat), (f"discs {diameter} in glare", glaring)]
    return found


def _independent(data: Path) -> Iterator[tuple[str, FloatImage]]:
    for case in ("sphere", "plate_in_green_glare"):
        with np.load(data / "independent_scenes" / case / "lights.npz") as archive:
            for index, lights in enumerate(archive["lights"]):
                yield f"{case} {index}", lights.astype(np.float32) * 0.5 * RANGE


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
            yield f"white balance, {where}", f"R x {factor:g}", {where: gain(factor, 0)}
        for exponent in (1.1, 1.4, 1.8, 2.2):
            yield f"gamma, {where}", f"{exponent:g}", {where: gamma(exponent)}
    yield "8-bit square root", "expanded", {"inside": companded}
    yield "8-bit square root", "scaled only", {"inside": companded_raw}
    for phase, text in (((1, 0), "row"), ((1, 1), "row and column")):
        yield "demosaiced, other phase", text, {"stored": interpolated(phase)}
    yield "noise reduction", "σ .8 samples", {"stored": smoothed}
    for offset in (-60, -30, 30, 100, 300):
        yield "black level off", f"{offset:+d} DN", {"black": BLACK + offset}


def verdict(
    frame: Mosaic | ChannelFrame, calibration: Calibration, repeat: Mosaic | None = None
) -> tuple[int, set[str]]:
    """2 for an error, 1 for a warning, 0; and the checks that found it."""
    inside = np.ones(frame.values.shape[-2:], dtype=bool)
    found = mismatches(frame, calibration, inside, repeat)
    level = max((2 if mismatch.certain else 1 for mismatch in found), default=0)
    return level, {mismatch.check for mismatch in found if (2 if mismatch.certain else 1) == level}


def calibrations(matrix: FloatArray) -> tuple[Calibration, Calibration]:
    """Of everything, and what `rgbmidic-calibrate crosstalk` alone writes."""
    crosstalk = Crosstalk(matrix=matrix, lights=("red", "green", "blue"))
    return Calibration(crosstalk=crosstalk, noise=NOISE, unevenness=0.0), Calibration(
        crosstalk=crosstalk, unevenness=0.0
    )


def table(good: Scenes) -> None:
    """Errors and warnings of every manipulation, over all scenes and both crosstalks."""
    cases = [(name, lights, matrix) for name, lights in good for matrix in (A, MEASURED)]
    some = cases[:: 2 * EVERY] + cases[1 :: 2 * EVERY]
    print(f"{len(cases)} good frames, {len(some)} manipulated ones a line: errors + warnings (by which checks)")
    print("| manipulation | strength | calibrated | and a second frame of the state | crosstalk alone calibrated |")
    print("|---|---|---|---|---|")
    lit = [("good", f"light x {factor:g}", {"light": factor}) for factor in (1.0, 0.5, 0.1, 2.2)]
    for name, strength, options in (*lit, *manipulations()):
        columns = ["", "", ""]
        taken = []
        for label, lights, matrix in cases if name == "good" else some:
            frame, again = (record(lights, matrix, **options, seed=seed) for seed in (0, 1))
            taken.append((label, frame, again, calibrations(matrix)))
        for column, (repeated, which) in enumerate(((False, 0), (True, 0), (False, 1))):
            verdicts = [
                (label, *verdict(frame, known[which], again if repeated else None))
                for label, frame, again, known in taken
            ]
            errors, warnings = (sum(level == wanted for _, level, _ in verdicts) for wanted in (2, 1))
            checks = ", ".join(sorted(set().union(*(checks for _, _, checks in verdicts))))
            columns[column] = f"{errors} + {warnings}" + (f" ({checks})" if checks else "")
            for label, level, found in verdicts:
                if name == "good" and level:
                    print("FALSE ALARM", label, strength, found)
        print(f"| {name} | {strength} | {' | '.join(columns)} |", flush=True)


def real(data: Path) -> None:
    """Errors and warnings of real raw frames with a calibration whose captures use all grey levels and no more."""
    for path in sorted(data.rglob("*")):
        if path.suffix.lower() not in (".tif", ".tiff", ".png", ".dng", ".cine", ".kdc", ".cihx", ".cih", ".raw"):
            continue
        if "must_reject" in str(path):
            continue
        for stated in ({}, {"kind": "monochrome"}, {"cfa": "RGGB"}, {"kind": "monochrome", "black_level": 0}):
            try:
                settings = FrameSettings(path=("frame",), **{"white_level": None, **stated})
                frame = open_source(path, settings).read(0)
            except RgbmidicError:
                continue
            inside = np.ones(frame.values.shape[-2:], dtype=bool)
            found = mismatches(frame, Calibration(unevenness=0.0), inside)
            told = "; ".join(f"{'ERROR' if one.certain else 'warning'} {one.check}: {one.text}" for one in found)
            print(f"{path.relative_to(data)} {stated}: {told or 'passes'}")
            break


def main() -> None:
    """Print the table, and the real frames."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with independent_scenes and real frames")
    parser.add_argument("--only", choices=("table", "real"), help="one of the two")
    arguments = parser.parse_args()
    if arguments.only != "real":
        table(scenes(arguments.data))
    if arguments.data and arguments.only != "table":
        real(arguments.data)


if __name__ == "__main__":
    main()
