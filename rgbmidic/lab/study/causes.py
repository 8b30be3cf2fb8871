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
import numpy.typing as npt

from rgbmidic.fields import at_pixels, high_pass
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.lab.study.bench import Bench, study_paint
from rgbmidic.lab.study.competitors import Competitor
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.scene.surface import Finish, Surface
from rgbmidic.settings import ELEMENT_SIZE
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["RADIUS", "VARIATIONS", "Cause", "NoiseOfLights", "Variation", "find_causes", "noise_of_lights"]


RADIUS = 100.0
"""px; the paper's disturbed zone has 165."""
_FAR = 230.0
"""px from the reflection, in the reference and in the deformed image, from which P counts as unaffected."""
_METHODS = ("dic", "glc-dic")


@dataclass(frozen=True, slots=True, kw_only=True)
class Variation:
    """One thing that is changed.

    Attributes
    ----------
    title
        In words.
    paint
        What becomes of both paints; None: nothing.
    surface
        Further changes of the surface (fields of `rgbmidic.lab.virtual.Surface`).
    noisy
        Whether the camera has its noise.
    element_size
        px.
    """

    title: str
    paint: Callable[[Finish], Finish] | None = None
    surface: tuple[tuple[str, float], ...] = ()
    noisy: bool = True
    element_size: float = ELEMENT_SIZE

    def apply(self, surface: Surface) -> Surface:
        """The surface of the study with this change."""
        changed = replace(surface, **dict(self.surface))  # type: ignore[arg-type]
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
    """P of one variation.

    Attributes
    ----------
    title
        The variation.
    angles
        Degrees.
    inside, outside : ndarray, shape (2 methods, n angles)
        P (px) of plain DIC and of GLC-DIC in the reflection and far from it.
    """

    title: str
    angles: tuple[float, ...]
    inside: FloatArray
    outside: FloatArray


def find_causes(
    angles: Sequence[float] = (0.333, 1.0, 8.0),
    *,
    size: int = 512,
    seed: int = 0,
    variations: Sequence[Variation] = VARIATIONS,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Cause, ...]:
    """Measure every variation on the monochrome bench with one lamp.

    Parameters
    ----------
    angles
        Degrees, above 0.
    size
        Rows and columns of the frames in px.
    seed
        Of paint and noise.
    variations
        What is changed.
    progress
        Called with the variations done, their total and the last one's title.
    """
    causes = []
    rendered: dict[Surface, list[FloatImage]] = {}
    for number, variation in enumerate(variations):
        bench = _one_lamp(Bench.build("sequential", size, surface=variation.apply(study_paint(seed)), seed=seed))
        surface = bench.scene.surface
        if surface not in rendered:
            rendered = {surface: [bench.render(angle) for angle in (0.0, *angles)], **_first(rendered)}
        causes.append(_measure_variation(variation, bench, tuple(angles), rendered[surface]))
        if progress is not None:
            progress(number + 1, len(variations), variation.title)
    return tuple(causes)


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseOfLights:
    """Scatter of the displacement from the camera's noise alone, no motion.

    Attributes
    ----------
    single : ndarray, shape (k,)
        Root mean square over the nodes (px), each light alone.
    together
        All lights in one solve.
    expected
        From the single ones, node by node: ``(sum 1/s_j^2)^(-1/2)``; with equal lights the single one over sqrt(k).
    """

    single: FloatArray
    together: float
    expected: float


def noise_of_lights(size: int = 512, *, draws: int = 12, seed: int = 0) -> NoiseOfLights:
    """How much k pairs reduce the noise: shots of the reference state against each other, no weights.

    Parameters
    ----------
    size
        Rows and columns of the frames in px.
    draws
        Pairs of shots, each with its own noise.
    seed
        Of paint and noise.
    """
    bench = Bench.build("sequential", size, seed=seed)
    clean = bench.render(0.0)
    clean = clean * np.float32(bench.exposure_gain(bench.brightest(clean)))
    k = len(clean)
    scatter = np.empty((k + 1, draws, 0))
    for draw in range(draws):
        reference, again = bench.photograph(clean, 2 * draw), bench.photograph(clean, 2 * draw + 1)
        for j in range(k + 1):
            method = "dic" if j < k else "midic-unweighted"
            competitor = Competitor.prepare(method, reference, bench.region, light=min(j, k - 1))
            start = np.zeros_like(competitor.reference.mesh.nodes)
            found = competitor.measure(again, start).displacement.ravel()
            if not scatter.size:
                scatter = np.empty((k + 1, draws, found.size))
            scatter[j, draw] = found
    variance = np.nanmean(scatter**2, axis=1)
    expected = 1 / (1 / variance[:k]).sum(axis=0)
    return NoiseOfLights(
        single=np.sqrt(np.nanmean(variance[:k], axis=1)),
        together=float(np.sqrt(np.nanmean(variance[k]))),
        expected=float(np.sqrt(np.nanmean(expected))),
    )


def _one_lamp(bench: Bench) -> Bench:
    lights = (bench.scene.lights[bench.light],)
    return replace(bench, scene=replace(bench.scene, lights=lights), light=0)


def _first(rendered: dict[Surface, list[FloatImage]]) -> dict[Surface, list[FloatImage]]:
    """The first paint's images, which several variations share; the others are not needed again."""
    return dict(list(rendered.items())[-1:])


def _measure_variation(variation: Variation, bench: Bench, angles: tuple[float, ...], clean: list[FloatImage]) -> Cause:
    gain = np.float32(bench.exposure_gain(max(bench.brightest(images) for images in clean)))
    shots = [_shoot(bench, images * gain, number, noisy=variation.noisy) for number, images in enumerate(clean)]
    inside = np.empty((len(_METHODS), len(angles)))
    outside = np.empty_like(inside)
    for row, method in enumerate(_METHODS):
        competitor = Competitor.prepare(method, shots[0], bench.region, element_size=variation.element_size)
        for column, (angle, shot) in enumerate(zip(angles, shots[1:], strict=True)):
            solution = competitor.measure(shot)
            mesh = Tri3Mesh(nodes=solution.nodes, elements=solution.elements)
            ripple = high_pass(at_pixels(mesh, solution.displacement, shot.shape)[1])
            inside[row, column], outside[row, column] = _inside_and_outside(ripple, bench, angle)
    return Cause(title=variation.title, angles=angles, inside=inside, outside=outside)


def _shoot(bench: Bench, images: FloatImage, shot: int, *, noisy: bool) -> IlluminationImages:
    if noisy:
        return bench.photograph(images, shot)
    return IlluminationImages(
        values=images,
        valid=np.ones(images.shape, dtype=bool),
        names=tuple(light.name for light in bench.scene.lights),
        full_scale=bench.scene.camera.full_scale,
    )


def _inside_and_outside(ripple: FloatArray, bench: Bench, angle: float) -> tuple[float, float]:
    """Root mean square of the high-passed displacement around the reflection, and away from where it goes."""
    x, y = bench.areas[-1].centre
    moved = x + bench.reflection_shift(angle)
    rows, columns = np.mgrid[: ripple.shape[0], : ripple.shape[1]]
    before, after = np.hypot(columns - x, rows - y), np.hypot(columns - moved, rows - y)
    known = np.isfinite(ripple) & ~_near_edge(bench, rows, columns)
    near, far = known & (before < RADIUS), known & (np.minimum(before, after) > _FAR)
    return tuple(float(np.sqrt((ripple[part] ** 2).mean())) if part.any() else float("nan") for part in (near, far))  # type: ignore[return-value]


def _near_edge(bench: Bench, rows: npt.NDArray[np.int_], columns: npt.NDArray[np.int_]) -> BoolArray:
    """Within an element of the region's edge, where nodes have fewer pixels."""
    x, y = bench.scene.camera.centre
    inner = bench.half - ELEMENT_SIZE
    return np.asarray((abs(columns - x) > inner) | (abs(rows - y) > inner))
