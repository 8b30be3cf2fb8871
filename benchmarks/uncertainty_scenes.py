"""Scenes of the tables of uncertainty: bodies in two states with exact truth, cameras, and what corrupts a frame.

A scene is rendered light by light without the camera's colours, so cameras and crosstalk matrices share renderings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import Any, Literal

import cv2
import numpy as np

from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.pipeline import Separation
from rgbmidic.tools.lab.virtual import Cylinder, Scene, State, plate_scene, record, render, sphere_scene, truth
from rgbmidic.tools.lab.virtual.dataset import true_calibration
from rgbmidic.tools.scene.camera import MEASURED_CROSSTALK, PIXEL, REFERENCE_CROSSTALK
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

from .demosaicing import TILT, painted

Kind = Literal["rgb", "bayer"]
KINDS: dict[str, Kind] = {"3-CCD": "rgb", "Bayer": "bayer"}
CROSSTALKS: dict[str, tuple[tuple[float, ...], ...]] = {
    "none": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "mild": REFERENCE_CROSSTALK,
    "measured": MEASURED_CROSSTALK,
}
"""What each light gives in the channels of another: that of the virtual experiments, and a measured camera's."""
PAINTS: dict[str, dict[str, float]] = {
    "smooth": {},
    "glossy": {"gloss": 3.0},
    "coarse": {"wrinkles": 0.075},
}
"""Options of `Setting`: wrinkles 25 um apart that reflect 1.5 times the full white; twice that; three times as wide."""


def turn(angle: float) -> State:
    """Turned about the vertical through the front point."""
    return State(angle_deg=angle)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """A scene in two states, with everything that distinguishes it from another."""

    body: str
    state: State
    size: int = 448
    seed: int = 11
    gloss: float = 1.5
    speckle: float = 4.2
    wrinkles: float = 0.025  # their spacing in mm
    lateral_colour: float = 0.0  # of the lens, px at the corner from one light to the next

    def scene(self, gloss: float | None = None) -> Scene:
        """The scene; another `gloss` for its mat twin."""
        options: dict[str, Any] = {"size": self.size, "seed": self.seed, "droplet": self.speckle * PIXEL}
        options["lateral_colour"] = self.lateral_colour
        options["gloss"] = self.gloss if gloss is None else gloss
        if self.body == "plate":
            scene = plate_scene(glare="green", tilt_deg=TILT, **options)
        else:
            scene = sphere_scene(**options)
        if self.body == "cylinder":
            scene = replace(scene, body=Cylinder(radius=30.0, centre=(0.0, 0.0, 630.0)))
        return painted(scene, self.wrinkles)


@dataclass(frozen=True)
class Pair:
    """Noise-free lights (k, H, W) in both states, and the truth."""

    scene: Scene
    lights: tuple[FloatImage, FloatImage]
    exact: FloatArray

    def cut(self, top: int, left: int, size: int) -> Pair:
        """A square part, from an even row and column so that the colour filters stay in place."""
        part = (slice(None), slice(top, top + size), slice(left, left + size))
        camera = replace(self.scene.camera, shape=(size, size))
        first, second = (image[part] for image in self.lights)
        return Pair(replace(self.scene, camera=camera), (first, second), self.exact[part])

    @property
    def size(self) -> int:
        """Side of the frame, px."""
        return int(self.exact.shape[1])


@lru_cache(maxsize=8)
def pair_of(setting: Setting) -> Pair:
    """Render a setting and its truth."""
    scene = setting.scene()
    return Pair(scene, (render(scene), render(scene, setting.state)), truth(scene, setting.state))


@lru_cache(maxsize=8)
def glare_of(setting: Setting) -> list[FloatImage]:
    """Fraction of the lights' local mean (k, H, W) that is not diffuse, in both states: its mat twin lacks it."""
    mat, states = setting.scene(gloss=0.0), (None, setting.state)
    return [
        np.asarray(1 - blurred(render(mat, state)) / np.maximum(blurred(lights), 1), dtype=np.float32)
        for state, lights in zip(states, pair_of(setting).lights, strict=True)
    ]


def blurred(images: FloatImage) -> FloatImage:
    """Local means (k, H, W), sigma 10 px."""
    return np.stack([cv2.GaussianBlur(image, (0, 0), 10) for image in images]).astype(np.float32)


def frame(lights: FloatImage, scene: Scene, kind: Kind, seed: int) -> Mosaic | ChannelFrame:
    """The raw frame that a camera of the kind takes."""
    return record(lights, replace(scene.camera, kind=kind), scene.lights, seed=seed)


def images_of(raw: Mosaic | ChannelFrame, scene: Scene) -> IlluminationImages:
    """One image per light from a raw frame, by the defaults and with the true calibration."""
    return Separation(calibration=true_calibration(scene))((raw,))


def both(
    pair: Pair, kind: Kind, seed: int = 11, crosstalk: str = "mild"
) -> tuple[IlluminationImages, IlluminationImages]:
    """Illumination images of both states with camera noise, seen with one of the `CROSSTALKS`."""
    camera = replace(pair.scene.camera, crosstalk=np.array(CROSSTALKS[crosstalk]))
    scene = replace(pair.scene, camera=camera)
    first, second = (images_of(frame(i, scene, kind, 1000 * seed + n), scene) for n, i in enumerate(pair.lights))
    return first, second


def _nothing(*_: Any) -> None:
    return None


def _nowhere(x: FloatArray, y: FloatArray) -> BoolArray:
    return np.zeros(x.shape, dtype=bool)


@dataclass(frozen=True)
class Corruption:
    """What corrupts a frame: the zone it covers, what it does to the lights and to the samples of state 0 or 1."""

    name: str
    zone: Callable[[Any, Any], BoolArray] = _nowhere
    light: Callable[[Any, BoolArray, int], None] = _nothing
    sensor: Callable[[Any, BoolArray, int], None] = _nothing
    overlapping: bool = False

    def pair(self) -> Pair:
        """The turning sphere, or the one on which all reflections lie in one place."""
        return overlapping_reflections() if self.overlapping else pair_of(Setting(body="sphere", state=turn(1.0)))


@cache
def overlapping_reflections() -> Pair:
    """A sphere of smoother paint whose three lamps stand in one place, so that all reflect in the same 2 % of it."""
    scene = sphere_scene(size=448, seed=11)
    place = scene.lights[2].position
    white, black = (
        replace(finish, slope_deg=1.0, lobe_deg=1.2, gloss=12.0)
        for finish in (scene.surface.white, scene.surface.black)
    )
    surface = replace(scene.surface, white=white, black=black)
    scene = replace(scene, surface=surface, lights=tuple(replace(light, position=place) for light in scene.lights))
    first, second = (render(scene, state) for state in (None, turn(1.0)))
    return Pair(scene, (first, second), truth(scene, turn(1.0)))


def _off(lights: Any, zone: BoolArray, state: int) -> None:
    lights[0] *= 1 - state


def _flicker(lights: Any, zone: BoolArray, state: int) -> None:
    if state:
        lights *= np.array([1.2, 0.8, 1.2], dtype=np.float32)[:, None, None]


def _fragment(lights: Any, zone: BoolArray, state: int) -> None:
    if state:
        lights[:, zone] = 150 + 100 * np.random.default_rng(1).random(int(zone.sum()))


def _rough_fragment(lights: Any, zone: BoolArray, state: int) -> None:
    if state:
        pattern = cv2.GaussianBlur(np.random.default_rng(1).normal(size=zone.shape), (0, 0), 1.5)
        lights[:, zone] = np.maximum(1000 + 500 * pattern / pattern.std(), 0)[zone]


def _dead(values: Any, zone: BoolArray, state: int) -> None:
    random = np.random.default_rng(5).random(values.shape)
    values[random < 0.005] = 0
    values[random > 0.995] = 4095


def _saturated(channel: int) -> Callable[[Any, BoolArray, int], None]:
    def corrupt(values: Any, zone: BoolArray, state: int) -> None:
        if values.ndim == 3:
            values[channel][zone] = 4095
            return
        y, x = np.indices(values.shape)
        samples = ((0, 0), (0, 1), (1, 1))[channel]
        there = (y % 2 == samples[0]) & (x % 2 == samples[1]) if channel != 1 else (x + y) % 2 == 1
        values[zone & there] = 4095

    return corrupt


def _left_third(x: Any, y: Any) -> BoolArray:
    return np.asarray(x < 448 // 3)


def _box(x: Any, y: Any) -> BoolArray:
    return np.asarray((abs(x - 264) < 40) & (abs(y - 210) < 35))


def _lamp_spot(x: Any, y: Any) -> BoolArray:
    """Where the overlapping reflections saturate: over a third of the local mean is not diffuse."""
    pair = overlapping_reflections()
    bright = blurred(pair.lights[0])[0]
    return np.asarray(bright > 1.5 * np.median(bright))


CORRUPTIONS = [
    Corruption("nothing"),
    Corruption("red light off", light=_off),
    Corruption("20 % flicker", light=_flicker),
    Corruption("red saturated on a third", zone=_left_third, sensor=_saturated(0)),
    Corruption("green saturated on a third", zone=_left_third, sensor=_saturated(1)),
    Corruption("1 % dead and hot pixels", sensor=_dead),
    Corruption("dark fragment", zone=_box, light=_fragment),
    Corruption("speckled fragment", zone=_box, light=_rough_fragment),
    Corruption("all reflections in one place", zone=_lamp_spot, overlapping=True),
]
