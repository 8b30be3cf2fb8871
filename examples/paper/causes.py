"""Why the displacement is disturbed: the virtual experiment with one thing changed at a time.

Every variation is measured by plain DIC and by GLC-DIC, and P is taken inside the reflection (within `RADIUS` of its
middle on the reference image) and far from it: more elements than the paper's areas hold, so that the figures tell
variations apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench import Bench, study_paint
from measurement import Competitor, displacement_at_pixels
from rgbmidic.fields import high_pass
from rgbmidic.illumination import IlluminationImages
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.tools.lab.virtual import Finish, Surface

RADIUS = 100.0
"""px; the paper's disturbed zone has 165."""
FAR = 230.0
"""px from the reflection, in the reference and in the deformed image, from which P counts as unaffected."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """One thing that is changed."""

    title: str
    paint: Callable[[Finish], Finish] | None = None  # what becomes of both paints
    surface: tuple[tuple[str, float], ...] = ()  # further changes of the surface (fields of `Surface`)
    noisy: bool = True  # whether the camera has its noise
    element_size: float = ELEMENT_SIZE

    def apply(self, surface: Surface) -> Surface:
        """The surface of the study with this change."""
        changed = replace(surface, **dict(self.surface))
        if self.paint is None:
            return changed
        return replace(changed, white=self.paint(changed.white), black=self.paint(changed.black))


def _sharper(paint: Finish) -> Finish:
    """Half the lobe, the same light reflected."""
    return replace(paint, lobe_deg=paint.lobe_deg / 2, gloss=paint.gloss * 4)


def _smooth(paint: Finish) -> Finish:
    """Facets all alike that reflect, on average, as the wrinkled paint: its lobe is that of facets and slopes."""
    slope_deg = math.degrees(math.atan(math.tan(math.radians(paint.slope_deg)) / math.sqrt(2)))
    lobe_deg = math.hypot(paint.lobe_deg, slope_deg)
    return replace(paint, slope_deg=0.0, lobe_deg=lobe_deg, gloss=paint.gloss * (paint.lobe_deg / lobe_deg) ** 2)


VARIATIONS = (
    Variation(title="paint of the study"),
    Variation(title="half the gloss", paint=lambda p: replace(p, gloss=p.gloss / 2)),
    Variation(title="twice the gloss", paint=lambda p: replace(p, gloss=p.gloss * 2)),
    Variation(title="facets twice as sharp, as much light", paint=_sharper),
    Variation(title="flat droplets", surface=(("dome", 0.0),)),
    Variation(title="flat droplets, no wrinkles, same mean reflection", paint=_smooth, surface=(("dome", 0.0),)),
    Variation(title="no reflection (mat)", paint=lambda p: replace(p, gloss=0.0)),
    Variation(
        title="mat, flat, no wrinkles", paint=lambda p: replace(p, gloss=0.0, slope_deg=0.0), surface=(("dome", 0.0),)
    ),
    Variation(title="droplets 1.5 times as large", surface=(("droplet", 0.345),)),
    Variation(title="camera without noise", noisy=False),
    Variation(title="elements of 15 px", element_size=15.0),
)
"""What is changed, one at a time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cause:
    """P (px) of one variation, in the reflection and far from it: plain DIC and GLC-DIC (rows), at each angle."""

    title: str
    angles: tuple[float, ...]
    inside: np.ndarray
    outside: np.ndarray


def find_causes(
    angles: Sequence[float] = (0.333, 1.0, 8.0),
    *,
    size: int = 512,
    seed: int = 0,
    variations: Sequence[Variation] = VARIATIONS,
    progress: Callable[[str], None] = lambda line: None,
) -> tuple[Cause, ...]:
    """Measure every variation on the monochrome bench with one lamp, in frames of `size` px at `angles` above 0."""
    causes = []
    first = study_paint(seed)
    rendered: dict[Surface, list[np.ndarray]] = {}
    for variation in variations:
        surface = variation.apply(first)
        bench = Bench.build("sequential", size, surface=surface, seed=seed)
        lamp = (bench.scene.lights[bench.light],)
        bench = replace(bench, scene=replace(bench.scene, lights=lamp), light=0)
        if surface not in rendered:
            rendered[surface] = [bench.render(angle) for angle in (0.0, *angles)]
        causes.append(_measure_variation(variation, bench, tuple(angles), rendered[surface]))
        progress(variation.title)
    return tuple(causes)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseOfLights:
    """Scatter (root mean square over the nodes, px) of the displacement from the camera's noise alone, no motion."""

    single: np.ndarray  # each light alone, (k,)
    together: float  # all lights in one solve
    expected: float  # from the single ones, node by node: (sum 1/s_j^2)^(-1/2)


def noise_of_lights(size: int = 512, *, draws: int = 12, seed: int = 0) -> NoiseOfLights:
    """How much k pairs reduce the noise: `draws` pairs of shots of the reference state, no weights."""
    bench = Bench.build("sequential", size, seed=seed)
    clean = bench.render(0.0)
    clean = clean * bench.exposure_gain(bench.brightest(clean))
    k = len(clean)
    scatter: list[list[np.ndarray]] = [[] for _ in range(k + 1)]
    for draw in range(draws):
        reference, again = bench.photograph(clean, 2 * draw), bench.photograph(clean, 2 * draw + 1)
        for j in range(k + 1):
            method = "dic" if j < k else "midic-unweighted"
            competitor = Competitor.prepare(method, reference, bench.region, light=min(j, k - 1))
            start = np.zeros_like(competitor.reference.mesh.nodes)
            scatter[j].append(competitor.measure(again, start).displacement.ravel())
    variance = np.nanmean(np.square(scatter), axis=1)
    expected = 1 / (1 / variance[:k]).sum(axis=0)
    return NoiseOfLights(
        single=np.sqrt(np.nanmean(variance[:k], axis=1)),
        together=float(np.sqrt(np.nanmean(variance[k]))),
        expected=float(np.sqrt(np.nanmean(expected))),
    )


def _measure_variation(variation: Variation, bench: Bench, angles: tuple[float, ...], clean: list[np.ndarray]) -> Cause:
    gain = bench.exposure_gain(max(bench.brightest(images) for images in clean))
    shots = [
        bench.photograph(images * gain, number)
        if variation.noisy
        else IlluminationImages(
            values=images * gain,
            valid=np.ones(images.shape, dtype=bool),
            names=tuple(light.name for light in bench.scene.lights),
            full_scale=bench.scene.camera.full_scale,
        )
        for number, images in enumerate(clean)
    ]
    pairs = []
    for method in ("dic", "glc-dic"):
        competitor = Competitor.prepare(method, shots[0], bench.region, element_size=variation.element_size)
        for angle, shot in zip(angles, shots[1:], strict=True):
            ripple = high_pass(displacement_at_pixels(competitor.measure(shot), shot.shape)[1])
            pairs.append(_inside_and_outside(ripple, bench, angle))
    inside, outside = np.array(pairs).reshape(2, len(angles), 2).transpose(2, 0, 1)
    return Cause(title=variation.title, angles=angles, inside=inside, outside=outside)


def _inside_and_outside(ripple: np.ndarray, bench: Bench, angle: float) -> list[float]:
    """Root mean square of the high-passed displacement around the reflection, and away from where it goes; without the
    element at the region's edge, where nodes have fewer pixels."""
    x, y = bench.areas[-1].centre
    middle_x, middle_y = bench.scene.camera.centre
    rows, columns = np.mgrid[: ripple.shape[0], : ripple.shape[1]]
    before = np.hypot(columns - x, rows - y)
    after = np.hypot(columns - (x + bench.reflection_shift(angle)), rows - y)
    known = np.isfinite(ripple) & (
        np.maximum(abs(columns - middle_x), abs(rows - middle_y)) <= bench.half - ELEMENT_SIZE
    )
    parts = known & (before < RADIUS), known & (np.minimum(before, after) > FAR)
    return [float(np.sqrt((ripple[part] ** 2).mean())) if part.any() else float("nan") for part in parts]
