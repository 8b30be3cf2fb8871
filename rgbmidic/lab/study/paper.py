"""The paper's experiment on the virtual bench: every angle, the methods, two ways to light and record."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields import high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.lab.study.bench import BENCHES, SMALLEST, Bench
from rgbmidic.lab.study.causes import VARIATIONS, find_causes, noise_of_lights
from rgbmidic.lab.study.competitors import METHODS, Competitor
from rgbmidic.lab.study.plate import virtual_goniometry, virtual_topography
from rgbmidic.lab.study.results import Measurement, PaperStudy, SceneStudy, Snapshot
from rgbmidic.lab.study.state import field_at_pixels, measure_state
from rgbmidic.typing import FloatImage
from rgbmidic.weights.disturbed_zone import SetUpThreshold, set_up_threshold
from rgbmidic.weights.threshold import blurred, threshold_weights

__all__ = ["ANGLES", "BLUR", "CLEAR", "run_paper_study"]

logger = logging.getLogger(__name__)

Progress = Callable[[int, int, str], None]

ANGLES = (0.0, 0.333, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0)
"""Degrees; 0 is a second shot of the reference state, where only the camera's noise is left."""
BLUR = 10.0
"""Standard deviation (px) of the blur before the threshold: the speckle vanishes, the reflection stays."""
SET_UP_ANGLES = (0.333, 1.0, 2.0, 4.0)
"""Small angles (degrees) from which the weighting threshold is found, the smallest first."""
CLEAR = 3.0
"""P in the reflection over P away from it from which the contour of the disturbed zone is taken for certain. The
paper's smallest angle gives 4; where the disturbance hardly exceeds the camera's noise, its 150 % contour lies near its
top, the zone comes out too small and the threshold too high."""
NO_THRESHOLD = 1.0
"""Threshold where the reflection disturbs nothing: only saturated pixels are excluded."""


def run_paper_study(
    angles: Sequence[float] = ANGLES,
    *,
    size: int = 1024,
    scenes: Sequence[str] = BENCHES,
    seed: int = 0,
    causes: bool = True,
    progress: Progress | None = None,
) -> PaperStudy:
    """Render the sphere at every angle and measure it with every method; then the flat specimen and the causes.

    Parameters
    ----------
    angles
        Degrees from 0 to 20; at least one above 0. The reference is at 0 in any case.
    size
        Rows and columns of the frames in px.
    scenes
        Some of `rgbmidic.lab.study.bench.BENCHES`.
    seed
        Of paint and noise.
    causes
        Whether to look for the causes (`rgbmidic.lab.study.causes`), on frames of 512 px.
    progress
        Called with the steps done, their total and a line about the last one.

    Raises
    ------
    InputError
        Angles or size out of range.
    """
    wanted = tuple(sorted({float(angle) for angle in angles}))
    if not all(0 <= angle <= _LARGEST for angle in wanted) or not any(angle > 0 for angle in wanted):
        raise InputError(
            f"angles lie between 0 and {_LARGEST:g} degrees, at least one of them above 0; given are {list(angles)}"
        )
    benches = [Bench.build(name, size, seed=seed) for name in scenes]
    positive = sum(angle > 0 for angle in wanted)
    total = len(benches) * (1 + positive + len(wanted)) + 3 + (len(VARIATIONS) if causes else 0)
    steps = _Steps(total=total, call=progress)
    studies = tuple(_run_scene(bench, wanted, steps) for bench in benches)
    turning = virtual_goniometry(seed=seed)
    steps("goniometry")
    relief = virtual_topography(seed=seed)
    steps("topography")
    noise = noise_of_lights(SMALLEST, seed=seed)
    steps("noise of the lights")
    found = find_causes(seed=seed, progress=lambda _, __, title: steps(title)) if causes else ()
    return PaperStudy(
        angles=wanted,
        size=size,
        seed=seed,
        scenes=studies,
        goniometry=turning,
        topography=relief,
        noise=noise,
        causes=found,
    )


_LARGEST = 20.0


@dataclass(slots=True)
class _Steps:
    """Counts what is done."""

    total: int
    call: Progress | None
    done: int = 0

    def __call__(self, line: str) -> None:
        self.done += 1
        if self.call is not None:
            self.call(self.done, self.total, line)


def _run_scene(bench: Bench, angles: tuple[float, ...], steps: _Steps) -> SceneStudy:
    photographs, gain = _photograph(bench, angles, steps)
    reference, shots = photographs[METHODS["midic"].demosaic]
    small = next(angle for angle in angles if angle > 0)
    kept = {small, angles[-1]}
    thresholds = _thresholds(bench, reference, shots, gain)
    chosen = max(thresholds, key=lambda angle: thresholds[angle].zone.contrast, default=None)
    limit = NO_THRESHOLD if chosen is None else thresholds[chosen].value
    competitors = {
        method: Competitor.prepare(
            method,
            photographs[settings.demosaic][0],
            bench.region,
            light=bench.light,
            threshold=limit,
            blur=BLUR,
            prefilter=bench.prefilter,
        )
        for method, settings in METHODS.items()
    }
    masks = threshold_weights(reference, threshold=limit, blur=BLUR)
    measurements: dict[tuple[str, float], Measurement] = {}
    snapshots: dict[float, Snapshot] = {}
    for angle in angles:
        fields = {}
        truth = bench.truth(angle)
        for method, competitor in competitors.items():
            first, states = photographs[METHODS[method].demosaic]
            measurement, field = measure_state(competitor, first, states[angle], bench, truth)
            measurements[method, angle], fields[method] = measurement, field
        if angle in kept:
            both = masks * threshold_weights(shots[angle], threshold=limit, blur=BLUR)
            snapshots[angle] = Snapshot(images=_relative(shots[angle]), displacement=fields, weights=both)
        steps(f"{bench.name}: {angle:g} degrees measured")
    return SceneStudy(
        bench=bench,
        angles=angles,
        reference=_relative(reference),
        names=reference.names,
        thresholds=thresholds,
        chosen=chosen,
        measurements=measurements,
        snapshots=snapshots,
        peaks=np.array([_brightest_point(shots[angle], bench) for angle in angles]),
    )


def _photograph(
    bench: Bench, angles: tuple[float, ...], steps: _Steps
) -> tuple[dict[str, tuple[IlluminationImages, dict[float, IlluminationImages]]], np.float32]:
    """Reference and states for each way to separate a mosaic, all with the one exposure, given too, at which no pixel
    of the series saturates."""
    clean = {}
    for angle in (0.0, *(angle for angle in angles if angle > 0)):
        clean[angle] = bench.render(angle)
        steps(f"{bench.name}: {angle:g} degrees rendered")
    gain = np.float32(bench.exposure_gain(max(bench.brightest(images) for images in clean.values())))
    photographs = {}
    for demosaic in {method.demosaic for method in METHODS.values()}:
        reference = bench.photograph(clean[0.0] * gain, 0, demosaic)
        shots = {angle: bench.photograph(clean[angle] * gain, 1 + i, demosaic) for i, angle in enumerate(angles)}
        photographs[demosaic] = reference, shots
    return photographs, gain


def _thresholds(
    bench: Bench, reference: IlluminationImages, shots: dict[float, IlluminationImages], gain: np.float32
) -> dict[float, SetUpThreshold]:
    """Thresholds from plain DIC at the set-up angles, up to the first at which the reflection clearly disturbs it."""
    competitor = Competitor.prepare("dic", reference, bench.region, light=bench.light, prefilter=bench.prefilter)
    found: dict[float, SetUpThreshold] = {}
    for number, angle in enumerate(SET_UP_ANGLES):
        shot = shots.get(angle)
        if shot is None:
            shot = bench.photograph(bench.render(angle) * gain, _EXTRA_SHOTS + number)
        ripple = high_pass(field_at_pixels(competitor, shot)[0][1])
        try:
            found[angle] = set_up_threshold(ripple, reference, light=bench.light, blur=BLUR)
        except InputError as error:
            logger.info("%s, %g degrees: %s", bench.name, angle, error)
            continue
        if found[angle].zone.contrast >= CLEAR:
            break
    return found


_EXTRA_SHOTS = 1000
"""Number of the first shot that is taken for the threshold alone."""


def _relative(images: IlluminationImages) -> FloatImage:
    return np.asarray(images.values / np.float32(images.full_scale), dtype=np.float32)


def _brightest_point(images: IlluminationImages, bench: Bench) -> tuple[float, float]:
    image = blurred(images, _WIDE_BLUR)[bench.light]
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    return float(column), float(row)


_WIDE_BLUR = 20.0
