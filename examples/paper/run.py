"""The paper's experiment on the virtual bench: every angle, five methods, two ways to light and record.

    python examples/paper/run.py --out DIR [--angles 0.333,8] [--size 512] [--causes | --no-causes] [--overwrite]

Tables, pictures and a page that sets the paper's statements beside the figures measured go to DIR (docs: study).
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bench import BENCHES, SMALLEST, Bench, virtual_goniometry, virtual_topography
from causes import find_causes, noise_of_lights
from measurement import (
    BLUR,
    METHODS,
    Competitor,
    PaperStudy,
    SceneStudy,
    Snapshot,
    displacement_at_pixels,
    measure_state,
)
from report import check_folder, write_study
from rgbmidic import RgbmidicError
from rgbmidic.errors import InputError
from rgbmidic.fields import high_pass
from rgbmidic.illumination import IlluminationImages
from rgbmidic.weights import SetUpThreshold, blurred, set_up_threshold, threshold_weights

logger = logging.getLogger(__name__)

Progress = Callable[[str], None]

ANGLES = (0.0, 0.333, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
"""Degrees; 0 is a second shot of the reference state, where only the camera's noise is left."""
LARGEST = 20.0
"""Largest angle (degrees) that is taken; the paper goes to 14."""
SET_UP_ANGLES = (0.333, 1.0, 2.0, 4.0)
"""Small angles (degrees) from which the weighting threshold is found, the smallest first."""
EXTRA_SHOTS = 1000
"""Number of the first shot that is taken for the threshold alone."""
CLEAR = 3.0
"""P in the reflection over P away from it from which the contour of the disturbed zone is taken for certain. The
paper's smallest angle gives 4; where the disturbance hardly exceeds the camera's noise, its 150 % contour lies near its
top, the zone comes out too small and the threshold too high."""
NO_THRESHOLD = 1.0
"""Threshold where the reflection disturbs nothing: only saturated pixels are excluded."""
WIDE_BLUR = 20.0
"""Standard deviation (px) of the blur before the brightest point is looked for."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for what is written; must be empty or new")
    parser.add_argument(
        "--angles", type=_angles, default=ANGLES, help="degrees, such as 0.333,8; the paper's by default"
    )
    parser.add_argument("--size", type=int, default=1024, help="rows and columns of the frames in px (1024)")
    parser.add_argument(
        "--causes",
        action=argparse.BooleanOptionalAction,
        help="also change one thing at a time; by default in frames of 1024 px and more",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace what is already there")
    asked = parser.parse_args(arguments)
    started = time.perf_counter()
    try:
        check_folder(asked.out, overwrite=asked.overwrite)
        study = run_paper_study(
            asked.angles,
            size=asked.size,
            causes=asked.size >= 1024 if asked.causes is None else asked.causes,
            progress=lambda line: print(line, file=sys.stderr),
        )
        claims = write_study(study, asked.out, overwrite=asked.overwrite)
    except RgbmidicError as error:
        parser.error(str(error))
    for claim in claims:
        print(f"{claim.verdict:15} {claim.scene or 'plate':11} {claim.figure}: {claim.statement}")
    print(f"report: {asked.out / 'report.md'}   {time.perf_counter() - started:.0f} s")


def _angles(text: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"angles are numbers with commas between them, not {text!r}") from None


def run_paper_study(
    angles: Sequence[float] = ANGLES,
    *,
    size: int = 1024,
    scenes: Sequence[str] = BENCHES,
    seed: int = 0,
    causes: bool = True,
    progress: Progress = lambda line: None,
) -> PaperStudy:
    """Render the sphere at every angle and measure it with every method; then the flat specimen and the causes.

    Angles are in degrees, at least one above 0; the reference is at 0 in any case. The causes have frames of 512 px.
    `progress` is called with a line about every step.
    """
    wanted = tuple(sorted({float(angle) for angle in angles}))
    if not all(0 <= angle <= LARGEST for angle in wanted) or not any(angle > 0 for angle in wanted):
        raise InputError(
            f"angles lie between 0 and {LARGEST:g} degrees, at least one of them above 0; given are {list(angles)}"
        )
    benches = [Bench.build(name, size, seed=seed) for name in scenes]
    studies = tuple(run_scene(bench, wanted, progress) for bench in benches)
    progress("flat specimen, noise of the lights")
    return PaperStudy(
        angles=wanted,
        size=size,
        seed=seed,
        scenes=studies,
        goniometry=virtual_goniometry(seed=seed),
        topography=virtual_topography(seed=seed),
        noise=noise_of_lights(SMALLEST, seed=seed),
        causes=find_causes(seed=seed, progress=progress) if causes else (),
    )


def run_scene(
    bench: Bench,
    angles: tuple[float, ...],
    progress: Progress = lambda line: None,
    *,
    methods: Sequence[str] = tuple(METHODS),
    set_up: Sequence[float] = SET_UP_ANGLES,
) -> SceneStudy:
    """Render one bench and measure it with the methods; the weighting threshold is found at the angles of `set_up`."""
    photographs, gain = _photograph(bench, angles, progress)
    reference, shots = photographs[METHODS["midic"].demosaic]
    thresholds = _thresholds(bench, reference, shots, gain, set_up)
    chosen = max(thresholds, key=lambda angle: thresholds[angle].zone.contrast, default=None)
    limit = NO_THRESHOLD if chosen is None else thresholds[chosen].value
    competitors = {
        method: Competitor.prepare(
            method,
            photographs[settings.demosaic][0],
            bench.region,
            light=bench.light,
            threshold=limit,
            prefilter=bench.prefilter,
        )
        for method, settings in METHODS.items()
        if method in methods
    }
    masks = threshold_weights(reference, threshold=limit, blur=BLUR)
    scale = np.float32(reference.full_scale)
    measurements, snapshots, peaks = {}, {}, []
    for angle in angles:
        fields, truth, shot = {}, bench.truth(angle), shots[angle]
        for method, competitor in competitors.items():
            first, states = photographs[METHODS[method].demosaic]
            measurements[method, angle], fields[method] = measure_state(competitor, first, states[angle], bench, truth)
        if angle in (min(filter(None, angles)), angles[-1]):
            both = masks * threshold_weights(shot, threshold=limit, blur=BLUR)
            snapshots[angle] = Snapshot(images=shot.values / scale, displacement=fields, weights=both)
        smooth = blurred(shot, WIDE_BLUR)[bench.light]
        peaks.append(np.unravel_index(int(smooth.argmax()), smooth.shape)[::-1])
        progress(f"{bench.name}: {angle:g} degrees measured")
    return SceneStudy(
        bench=bench,
        angles=angles,
        reference=reference.values / scale,
        names=reference.names,
        thresholds=thresholds,
        chosen=chosen,
        measurements=measurements,
        snapshots=snapshots,
        peaks=np.array(peaks, dtype=np.float64),
    )


def _photograph(
    bench: Bench, angles: tuple[float, ...], progress: Progress
) -> tuple[dict[str, tuple[IlluminationImages, dict[float, IlluminationImages]]], np.float32]:
    """Reference and states for each way to separate a mosaic, all with the one exposure, given too, at which no pixel
    of the series saturates."""
    clean = {}
    for angle in sorted({0.0, *angles}):
        clean[angle] = bench.render(angle)
        progress(f"{bench.name}: {angle:g} degrees rendered")
    gain = bench.exposure_gain(max(bench.brightest(images) for images in clean.values()))
    photographs = {}
    for demosaic in {method.demosaic for method in METHODS.values()}:
        reference = bench.photograph(clean[0.0] * gain, 0, demosaic)
        shots = {angle: bench.photograph(clean[angle] * gain, 1 + i, demosaic) for i, angle in enumerate(angles)}
        photographs[demosaic] = reference, shots
    return photographs, gain


def _thresholds(
    bench: Bench,
    reference: IlluminationImages,
    shots: dict[float, IlluminationImages],
    gain: np.float32,
    set_up: Sequence[float],
) -> dict[float, SetUpThreshold]:
    """Thresholds from plain DIC at the set-up angles, up to the first at which the reflection clearly disturbs it."""
    competitor = Competitor.prepare("dic", reference, bench.region, light=bench.light, prefilter=bench.prefilter)
    found: dict[float, SetUpThreshold] = {}
    for number, angle in enumerate(set_up):
        shot = shots.get(angle) or bench.photograph(bench.render(angle) * gain, EXTRA_SHOTS + number)
        ripple = high_pass(displacement_at_pixels(competitor.measure(shot), shot.shape)[1])
        try:
            found[angle] = set_up_threshold(ripple, reference, light=bench.light, blur=BLUR)
        except InputError as error:
            logger.info("%s, %g degrees: %s", bench.name, angle, error)
            continue
        if found[angle].zone.contrast >= CLEAR:
            break
    return found


if __name__ == "__main__":
    main()
