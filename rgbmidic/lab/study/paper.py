"""The paper's experiment on the virtual bench: every angle, the four methods, two ways to light and record."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.correlation import NodeStatus
from rgbmidic.errors import InputError
from rgbmidic.fields import at_pixels, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.lab.study.bench import BENCHES, SMALLEST, Bench
from rgbmidic.lab.study.causes import VARIATIONS, Cause, NoiseOfLights, find_causes, noise_of_lights
from rgbmidic.lab.study.competitors import METHODS, Competitor
from rgbmidic.lab.study.goniometry import Goniometry
from rgbmidic.lab.study.perturbation import area_means, area_stds, residual_percent
from rgbmidic.lab.study.plate import Topography, virtual_goniometry, virtual_topography
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.disturbed_zone import SetUpThreshold, set_up_threshold
from rgbmidic.weights.threshold import blurred, threshold_weights

__all__ = [
    "ANGLES",
    "BLUR",
    "CLEAR",
    "Measurement",
    "PaperStudy",
    "SceneStudy",
    "Snapshot",
    "measure_state",
    "run_paper_study",
]

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


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One method at one angle.

    Attributes
    ----------
    perturbation : ndarray, shape (5,)
        P of U_y in A0 to A4, px.
    error : ndarray, shape (5,)
        Standard deviation in the areas of the measured minus the true U_y, high-passed alike, px.
    mean : ndarray, shape (2, 5)
        Mean of (U_x, U_y) in the areas, px.
    residual
        % of the effective dynamic range, light by light averaged.
    measured
        Share of the nodes that were measured.
    frontier
        P along the frontiers of the masks over P beside them; NaN without masks.
    status
        How the solve ended.
    """

    perturbation: FloatArray
    error: FloatArray
    mean: FloatArray
    residual: float
    measured: float
    frontier: float
    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """What is kept of one state for the figures.

    Attributes
    ----------
    images : ndarray, shape (k, H, W), float32
        Illumination images over full scale.
    displacement : dict of ndarray, shape (2, H, W), float32
        Of every method.
    weights : ndarray, shape (k, H, W), float32
        The masks of the reference and of this state together (not brought back by the displacement).
    """

    images: FloatImage
    displacement: dict[str, FloatImage]
    weights: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneStudy:
    """The four methods on one scene.

    Attributes
    ----------
    bench
        The scene.
    angles : tuple of float
        Degrees, in order.
    reference : ndarray, shape (k, H, W), float32
        Reference images over full scale.
    names
        The lights.
    thresholds
        The weighting threshold found at each of the set-up angles that was tried.
    chosen
        That whose threshold is used: the smallest at which the reflection clearly disturbs plain DIC (`CLEAR`), or
        where it does so most; None where it nowhere does.
    measurements
        By method and angle.
    snapshots
        Of the smallest and the largest angle above 0.
    peaks : ndarray, shape (n, 2)
        Brightest point (x, y) of the blurred image of the light that crosses the areas, at every angle.
    """

    bench: Bench
    angles: tuple[float, ...]
    reference: FloatImage
    names: tuple[str, ...]
    thresholds: dict[float, SetUpThreshold]
    chosen: float | None
    measurements: dict[tuple[str, float], Measurement]
    snapshots: dict[float, Snapshot]
    peaks: FloatArray

    @property
    def threshold(self) -> SetUpThreshold | None:
        """The weighting threshold that is used."""
        return None if self.chosen is None else self.thresholds[self.chosen]

    def perturbation(self, method: str) -> FloatArray:
        """P (n angles, 5 areas) of a method, px."""
        return np.array([self.measurements[method, angle].perturbation for angle in self.angles])

    def means(self, method: str) -> FloatArray:
        """Mean (U_x, U_y) of a method, shape (n angles, 2, 5 areas), px."""
        return np.array([self.measurements[method, angle].mean for angle in self.angles])

    def series(self, method: str, quantity: str) -> FloatArray:
        """One scalar of `Measurement` at every angle."""
        return np.array([getattr(self.measurements[method, angle], quantity) for angle in self.angles])


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperStudy:
    """All that the paper's figures show, as the virtual bench gives it.

    Attributes
    ----------
    angles, size, seed
        What was asked for.
    scenes
        The sphere, one entry per way to light and record.
    goniometry, topography
        The flat specimen.
    noise
        How much two lamps reduce the noise.
    causes
        The variations; empty where they were not asked for.
    """

    angles: tuple[float, ...]
    size: int
    seed: int
    scenes: tuple[SceneStudy, ...]
    goniometry: Goniometry
    topography: Topography
    noise: NoiseOfLights
    causes: tuple[Cause, ...]


def run_paper_study(
    angles: Sequence[float] = ANGLES,
    *,
    size: int = 1024,
    scenes: Sequence[str] = BENCHES,
    seed: int = 0,
    causes: bool = True,
    progress: Progress | None = None,
) -> PaperStudy:
    """Render the sphere at every angle and measure it with the four methods; then the flat specimen and the causes.

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
    reference, shots, gain = _photograph(bench, angles, steps)
    small = next(angle for angle in angles if angle > 0)
    kept = {small, angles[-1]}
    thresholds = _thresholds(bench, reference, shots, gain)
    chosen = max(thresholds, key=lambda angle: thresholds[angle].zone.contrast, default=None)
    limit = NO_THRESHOLD if chosen is None else thresholds[chosen].value
    competitors = {
        method: Competitor.prepare(
            method,
            reference,
            bench.region,
            light=bench.light,
            threshold=limit,
            blur=BLUR,
            prefilter=bench.prefilter,
        )
        for method in METHODS
    }
    masks = threshold_weights(reference, threshold=limit, blur=BLUR)
    measurements: dict[tuple[str, float], Measurement] = {}
    snapshots: dict[float, Snapshot] = {}
    for angle in angles:
        fields = {}
        truth = bench.truth(angle)
        for method, competitor in competitors.items():
            measurement, field = measure_state(competitor, reference, shots[angle], bench, truth)
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
) -> tuple[IlluminationImages, dict[float, IlluminationImages], np.float32]:
    """Reference and states, all with the one exposure, given too, at which no pixel of the series saturates."""
    clean = {}
    for angle in (0.0, *(angle for angle in angles if angle > 0)):
        clean[angle] = bench.render(angle)
        steps(f"{bench.name}: {angle:g} degrees rendered")
    gain = np.float32(bench.exposure_gain(max(bench.brightest(images) for images in clean.values())))
    reference = bench.photograph(clean[0.0] * gain, 0)
    shots = {angle: bench.photograph(clean[angle] * gain, 1 + i) for i, angle in enumerate(angles)}
    return reference, shots, gain


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
        ripple = high_pass(_grid(competitor, shot)[0][1])
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


def measure_state(
    competitor: Competitor,
    reference: IlluminationImages,
    images: IlluminationImages,
    bench: Bench,
    truth: FloatArray,
) -> tuple[Measurement, FloatImage]:
    """Measure one state with one method.

    Parameters
    ----------
    competitor
        The method, prepared with `reference`.
    reference, images
        Reference and state.
    bench
        The scene, with its areas.
    truth : ndarray, shape (2, H, W)
        Exact displacement.

    Returns
    -------
    tuple
        The measurement, and the displacement (2, H, W) at the pixels.
    """
    field, measured, status = _grid(competitor, images)
    none = np.full(len(bench.areas), np.nan)
    perturbation = error = none
    if np.isfinite(field[1]).sum() > 10:
        ripple = high_pass(field[1])
        perturbation = area_stds(ripple, bench.areas)
        error = area_stds(high_pass(field[1] - truth[1]), bench.areas)
        residual = np.mean(
            [
                residual_percent(reference.values[i], images.values[i], np.asarray(field, dtype=np.float64))
                for i in competitor.lights
            ]
        )
        frontier = _frontier(ripple, competitor, images)
    else:
        residual, frontier = np.float64(np.nan), float("nan")
    measurement = Measurement(
        perturbation=perturbation,
        error=error,
        mean=np.stack([area_means(part, bench.areas) for part in field]),
        residual=float(residual),
        measured=measured,
        frontier=frontier,
        status=status,
    )
    return measurement, field


def _grid(competitor: Competitor, images: IlluminationImages) -> tuple[FloatImage, float, str]:
    """Displacement at the pixels, share of the nodes measured, and how the solve ended."""
    solution = competitor.measure(images)
    mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
    field = at_pixels(mesh, solution.displacement, images.shape)
    return field, float((solution.node_status == NodeStatus.MEASURED).mean()), solution.status.name.lower()


def _frontier(ripple: FloatArray, competitor: Competitor, images: IlluminationImages) -> float:
    """P within an element of the masks' frontiers, over P beside it: on the side where it is larger.

    On either side of a frontier other lights are seen, and fewer lights give more noise; a band that the frontier
    itself disturbs is worse than both. The mask of the deformed state is taken where it is, within a few px of where
    the displacement brings it.
    """
    import cv2

    if competitor.threshold is None:
        return float("nan")
    after = threshold_weights(images, threshold=competitor.threshold, blur=competitor.blur)
    masks = ((competitor.reference.weights > 0) & (after > 0)).astype(np.uint8)
    edge = np.zeros(images.shape, dtype=np.uint8)
    for mask in masks:
        edge |= np.asarray(cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)), dtype=np.uint8)
    distance = cv2.distanceTransform(1 - edge, cv2.DIST_L2, 5) if edge.any() else np.full(images.shape, np.inf)
    known = np.isfinite(ripple)
    beside = known & (distance > ELEMENT_SIZE) & (distance <= 3 * ELEMENT_SIZE)
    sides = [beside & (masks.sum(axis=0) == count) for count in range(len(masks) + 1)]
    level = max(
        (float((ripple[side] ** 2).mean()) for side in sides if side.sum() >= 20 * ELEMENT_SIZE**2), default=0.0
    )
    band = known & (distance <= ELEMENT_SIZE)
    if level == 0 or band.sum() < 20 * ELEMENT_SIZE**2:
        return float("nan")
    return float(np.sqrt((ripple[band] ** 2).mean() / level))


def _relative(images: IlluminationImages) -> FloatImage:
    return np.asarray(images.values / np.float32(images.full_scale), dtype=np.float32)


def _brightest_point(images: IlluminationImages, bench: Bench) -> tuple[float, float]:
    image = blurred(images, _WIDE_BLUR)[bench.light]
    row, column = np.unravel_index(int(image.argmax()), image.shape)
    return float(column), float(row)


_WIDE_BLUR = 20.0
