"""Crossed polarisers, what laboratories use against glare today, held against three colours, and both together.

The sphere of `sphere_scene` under one lamp (the green one, before a monochrome camera) or all three (before a Bayer
camera of the same pixels), each lamp of the same power. Every contender has the default settings of rgbmidic and is
started within half a pixel of the truth. The polarisers are ideal but for their extinction: they let pass a quarter of
the diffuse light, film some 15 %.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property

import cv2
import numpy as np

from rgbmidic import correlate
from rgbmidic.fields import at_nodes, at_pixels
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import Separation
from rgbmidic.tools.lab.virtual import Polarisers, Scene, record, render, sphere_scene, truth, turned
from rgbmidic.tools.lab.virtual.dataset import true_calibration
from rgbmidic.tools.lab.virtual.rendering import rays_per_pixel
from rgbmidic.tools.scene.camera import PIXEL
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

from .tables import Row, table
from .uncertainty import rms
from .uncertainty_scenes import blurred

SIZE, FIRST, LAST, ELEMENT = 398, 11, 386, 25
"""Frame, first and last pixel of the measured square (15 elements wide), and side of an element, px."""
SEEDS, DRAWS = (11, 12), 2
"""Sprays of paint, and noises of the camera for each."""
PAINTS: dict[str, dict[str, float]] = {
    "painted": {},
    "raised droplets": {"dome": 0.004},
    "varnished": {"gloss": 12.0, "lobe_deg": 1.5, "slope_deg": 3.0, "spacing": 0.05},
}
"""The paint of the other tables, the paper's with droplets 4 um high (its Fig. 10), and one as smooth as a clear coat
leaves it; all reflect some 6 % (Fresnel: 4 %)."""
EXTINCTIONS = (None, 1e-2, 1e-4)
"""Without polarisers, with common film, and with the best."""
BRIGHTEST = 0.97
"""Fraction of full scale of the brightest sample; in trials a longer exposure, the glare saturated, gained nothing."""
LIGHTS = {"full well": 0.0, "same": 1.0, "same / 10": 10.0, "same / 30": 30.0}
"""Exposure: each contender's own to the full well, or the same for all, that of the brightest without polarisers, and
parts of it."""
REFLECTION = 1 / 3
"""Fraction of a light's local mean that is not diffuse from which a pixel lies in the reflection."""


@dataclass(frozen=True)
class Shots:
    """Both states of the sphere without noise: all that is seen, its diffuse part, and the truth."""

    scene: Scene
    seen: tuple[FloatImage, FloatImage]
    diffuse: tuple[FloatImage, FloatImage]
    exact: FloatArray

    def through(self, polarisers: Polarisers | None) -> list[FloatImage]:
        """What the polarisers let pass (as `Scene.polarised` renders it; glare adds to the diffuse light)."""
        if polarisers is None:
            return list(self.seen)
        pairs = zip(self.seen, self.diffuse, strict=True)
        return [polarisers.transmission * (mat + polarisers.glare * (all_ - mat)) for all_, mat in pairs]

    @cached_property
    def reflection(self) -> BoolArray:
        """Pixels of the reference, inside the border element, with green's reflection in one of the states."""
        y, x = np.mgrid[:SIZE, :SIZE].astype(np.float32)
        zone, (u, v) = np.zeros((SIZE, SIZE), dtype=bool), np.nan_to_num(self.exact).astype(np.float32)
        for number, (seen, mat) in enumerate(zip(self.seen, self.diffuse, strict=True)):
            glare = (1 - blurred(mat)[1] / np.maximum(blurred(seen)[1], 1)).astype(np.float32)
            zone |= (cv2.remap(glare, x + u, y + v, cv2.INTER_LINEAR) if number else glare) > REFLECTION
        return zone & inner()


def inner() -> BoolArray:
    """Pixels of the measured square without its border element."""
    inside = np.zeros((SIZE, SIZE), dtype=bool)
    inside[FIRST + ELEMENT : LAST + 1 - ELEMENT, FIRST + ELEMENT : LAST + 1 - ELEMENT] = True
    return inside


@cache
def shots(paint: str, angle: float, seed: int) -> Shots:
    """Render the sphere at rest and turned, and its mat twin with as many rays."""
    scene, changes = sphere_scene(size=SIZE, seed=seed, droplet=4.2 * PIXEL), dict(PAINTS[paint])
    scene = replace(scene, surface=replace(scene.surface, dome=changes.pop("dome", 0.0)))
    scene = with_finish(scene, **changes)
    scene = replace(scene, camera=replace(scene.camera, samples=rays_per_pixel(scene)))
    states, mat = (None, turned(angle)), with_finish(scene, gloss=0.0)
    seen, diffuse = ([render(one, state) for state in states] for one in (scene, mat))
    return Shots(scene, (seen[0], seen[1]), (diffuse[0], diffuse[1]), truth(scene, states[1]))


def with_finish(scene: Scene, **changes: float) -> Scene:
    """The scene with both paints changed."""
    white, black = (replace(finish, **changes) for finish in (scene.surface.white, scene.surface.black))
    return replace(scene, surface=replace(scene.surface, white=white, black=black))


@dataclass(frozen=True)
class Contender:
    """One lamp or all, with polarisers or without."""

    lamps: int
    extinction: float | None

    @property
    def name(self) -> str:
        """Heading of its column."""
        name = "one lamp" if self.lamps == 1 else "three colours"
        return name if self.extinction is None else f"{name} polarised {self.extinction:g}"

    def set_up(self, taken: Shots) -> tuple[Scene, list[FloatImage]]:
        """Its camera and lamps, and what they see of both states."""
        polarisers = None if self.extinction is None else Polarisers(extinction=self.extinction)
        images, scene = taken.through(polarisers), taken.scene
        if self.lamps == 3:
            return scene, images
        camera = replace(scene.camera, kind="monochrome", crosstalk=None)
        return replace(scene, lights=scene.lights[1:2], camera=camera), [image[1:2] for image in images]

    def gain(self, taken: Shots) -> float:
        """Factor on the exposure at which its brightest sample nearly fills its range."""
        scene, images = self.set_up(taken)
        mixing = scene.camera.mixing(scene.lights)
        brightest = max(float(np.einsum("cl,lyx->cyx", mixing, image).max()) for image in images)
        return BRIGHTEST * scene.camera.full_scale / brightest

    def measured(self, taken: Shots, gain: float, draw: int) -> dict[str, FloatArray]:
        """Errors in the reflection and elsewhere, errors over stated uncertainties, and signal, at an exposure."""
        scene, images = self.set_up(taken)
        separation = Separation(calibration=true_calibration(scene))
        region = Region.from_rectangle((FIRST, FIRST, LAST, LAST), (SIZE, SIZE))
        start = at_nodes(taken.exact, Tri3Mesh.from_region(region, ELEMENT).nodes) + 0.2
        seed = 1000 * scene.surface.seed + 10 * draw
        seen = [
            separation((record(image * np.float32(gain), scene.camera, scene.lights, seed=seed + number),))
            for number, image in enumerate(images)
        ]
        first, second = (np.where(image.valid, image.values, np.nan) for image in seen)
        found = correlate(first, second, region=region, initial=start)
        mesh, zone = Tri3Mesh(nodes=found.nodes, elements=found.elements), taken.reflection
        error = at_pixels(mesh, found.displacement, (SIZE, SIZE)) - taken.exact
        ratio = (found.displacement - at_nodes(taken.exact, found.nodes)) / found.displacement_std
        column, row = np.round(found.nodes).astype(int).T
        return {
            "reflection": error[:, zone],
            "elsewhere": error[:, inner() & ~zone],
            "ratio": ratio[inner()[row, column]].T,
            "electrons": np.full((1, 1), gain * scene.camera.gain * float(np.median(images[0][-1]))),
        }


@table("polarisers", page="explanation/polarisers", cost=140, keys=4, seed=SEEDS[0], own_quick=True)
def polarisers(quick: bool) -> Iterator[Row]:
    """One lamp or three colours, without polarisers and with crossed ones of an extinction of 0.01 or 0.0001."""
    contenders = [Contender(lamps, extinction) for lamps in (1, 3) for extinction in EXTINCTIONS]
    rows: dict[str, list[Row]] = {}
    for paint, angle, light in cases(quick):
        found: dict[str, list[dict[str, FloatArray]]] = {one.name: [] for one in contenders}
        for seed, draw in [(SEEDS[0], 0)] if quick else itertools.product(SEEDS, range(DRAWS)):
            taken = shots(paint, angle, seed)
            same = min(one.gain(taken) for one in contenders if one.extinction is None)
            for one in contenders:
                gain = same / LIGHTS[light] if LIGHTS[light] else one.gain(taken)
                found[one.name].append(one.measured(taken, gain, draw))
        figures = {
            name: summary({part: np.hstack([one[part] for one in draws]) for part in draws[0]})
            for name, draws in found.items()
        }
        for figure in figures[contenders[0].name]:
            row: Row = {"figure": figure, "paint": paint, "angle [deg]": angle, "exposure": light}
            rows.setdefault(figure, []).append(row | {name: figures[name][figure] for name in figures})
    for figure in rows:
        yield from rows[figure]


def summary(parts: dict[str, FloatArray]) -> dict[str, float]:
    """Figures of one contender over all paints and draws."""
    return {
        "error in the reflection [px]": rms(parts["reflection"]),
        "error elsewhere [px]": rms(parts["elsewhere"]),
        "reflection not measured [%]": 100 * float(np.isnan(parts["reflection"]).mean()),
        "error/stated": rms(parts["ratio"]),
        "electrons per pixel": rms(parts["electrons"]),
    }


def cases(quick: bool) -> list[tuple[str, float, str]]:
    """Paint, angle and exposure; a clear coat under a thirtieth leaves 10 electrons, too few to measure."""
    if quick:
        return [("painted", 2.0, "same / 10")]
    every = [(paint, angle, light) for paint in PAINTS for angle in (2.0, 8.0) for light in LIGHTS]
    return [case for case in every if case[0] == "painted" or case[2] != "same / 30"]


ALUMINIUM = 1.373 + 7.618j
"""Refractive index at 633 nm (A. D. Rakic, Applied Optics 34, 4755, 1995, by refractiveindex.info)."""


@table("polarisers_oblique", page="explanation/polarisers", cost=0, keys=2)
def polarisers_oblique(quick: bool) -> Iterator[Row]:
    """Transmission of a single reflection through ideal crossed polarisers, relative to that of diffuse light."""
    for surface, index in (("paint", 1.5), ("aluminium", ALUMINIUM)):
        for apart in (20, 45, 90, 140):
            diagonal, darkest = crossed(index, np.radians(apart / 2))
            names = "both axes at 45 deg to the plane of incidence", "lamp's axis turned to the darkest"
            row: Row = {"surface": surface, "lamp to camera [deg]": apart}
            yield row | dict(zip(names, (diagonal, darkest), strict=True))


def crossed(index: complex, incidence: float) -> tuple[float, float]:
    """Glare over diffuse light that a pair at 45 and -45 degrees to the plane of incidence lets pass, and the least.

    Fresnel's equations; the least is that of the best direction of the lamp's polariser, 0 unless the surface turns
    linear into elliptical polarisation, as metals do.
    """
    c = np.cos(incidence)
    t = np.sqrt(1 - (np.sin(incidence) / index) ** 2 + 0j)
    along = np.array([(c - index * t) / (c + index * t), (t - index * c) / (t + index * c)]) * np.sqrt([0.5, 0.5])
    passed = np.real(np.outer(along, along.conj()))
    scale = 2 / np.trace(passed)
    across = np.sqrt([0.5, 0.5]) * [1, -1]
    return float(across @ passed @ across * scale), abs(round(float(np.linalg.eigvalsh(passed)[0] * scale), 9))
