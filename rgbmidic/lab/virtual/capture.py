"""What a laboratory records beside the test: one light at a time on a target, dark frames, a white card, checks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.lab.virtual.recording import record
from rgbmidic.lab.virtual.rendering import render
from rgbmidic.scene.camera import Camera
from rgbmidic.scene.light import Light
from rgbmidic.scene.scene import Plate, Scene
from rgbmidic.scene.scenefile import Target
from rgbmidic.scene.surface import Finish, Surface
from rgbmidic.typing import FloatImage

__all__ = ["check_frames", "dark_frames", "flat_frames", "single_light_frames", "target_scene"]

Frame = Mosaic | ChannelFrame
EXPOSURES = tuple(0.13 * time for time in (0.5, 1, 2, 4, 6, 10))
"""Share of the full scale that the brightest sample of a white card reaches, .13 per ms of the exposure times that
calibration/README.md states; in the last it saturates."""
_NO_LIGHT = Light(name="off", position=(0.0, 0.0, 0.0), power=0.0)


def target_scene(scene: Scene, target: Target = "white") -> Scene:
    """The same lights and camera before a flat mat target that fills the field at the body's front point."""
    if target not in ("white", "speckled"):
        raise InputError(f"unknown target {target!r}; allowed are white, speckled")
    mat = Finish(albedo=0.8, gloss=0.0, slope_deg=0.0)
    paint = replace(scene.surface, white=mat, black=replace(mat, albedo=0.1), dome=0.0)
    if target == "white":
        paint = Surface(white=mat, black=mat, coverage=0.0)
    return replace(scene, body=Plate(width=1e5, height=1e5, centre=scene.body.front), surface=paint)


def single_light_frames(scene: Scene, *, count: int = 3, seed: int, target: Target = "white") -> dict[str, list[Frame]]:
    """Frames with one light on at a time, dimmed from frame to frame.

    Parameters
    ----------
    scene
        The lights and the camera are its own; body and paint are exchanged for a flat mat target.
    count
        Frames per light; the last has the full power, the others equal parts of it.
    seed
        Of the noise.
    target
        Plain white or speckled.

    Returns
    -------
    dict
        Light name to its frames.
    """
    images = render(target_scene(scene, target))
    generator = np.random.SeedSequence(seed)
    frames: dict[str, list[Frame]] = {light.name: [] for light in scene.lights}
    for name, taken in frames.items():
        for step, child in enumerate(generator.spawn(count)):
            dimmed = images * np.float32((step + 1) / count)
            taken.append(record(dimmed, scene.camera, scene.lights, seed=int(child.generate_state(1)[0]), on=(name,)))
    return frames


def dark_frames(camera: Camera, *, count: int = 3, seed: int) -> list[Frame]:
    """Frames with all lights off."""
    darkness = np.zeros((1, *camera.shape), dtype=np.float32)
    lightless = replace(camera, crosstalk=np.ones((camera.channels, 1)))
    seeds = np.random.SeedSequence(seed).generate_state(count)
    return [record(darkness, lightless, (_NO_LIGHT,), seed=int(s)) for s in seeds]


def flat_frames(scene: Scene, *, count: int = 2, seed: int) -> list[list[Frame]]:
    """Frames of a white card under all lights together: `count` at each of the `EXPOSURES`."""
    images = render(target_scene(scene, "white"))
    brightest = float(np.einsum("cl,lyx->cyx", scene.camera.mixing(scene.lights), images).max())
    steps = np.random.SeedSequence(seed).spawn(len(EXPOSURES))
    taken = []
    for share, step in zip(EXPOSURES, steps, strict=True):
        exposed = images * np.float32(share * scene.camera.full_scale / brightest)
        taken.append([record(exposed, scene.camera, scene.lights, seed=int(s)) for s in step.generate_state(count)])
    return taken


def check_frames(scene: Scene, images: FloatImage, *, count: int = 2, seed: int) -> dict[str, list[Frame]]:
    """Frames of the specimen at rest: each light alone, all together ("all"), and "dark".

    Parameters
    ----------
    scene
        Its lights and camera.
    images : ndarray, shape (k, H, W)
        What each light alone gives.
    count
        Frames of each kind.
    seed
        Of the noise.
    """
    lit = {light.name: (light.name,) for light in scene.lights} | {"all": tuple(light.name for light in scene.lights)}
    steps = np.random.SeedSequence(seed).spawn(len(lit) + 1)
    frames = {"dark": dark_frames(scene.camera, count=count, seed=int(steps[-1].generate_state(1)[0]))}
    for (name, on), step in zip(lit.items(), steps, strict=False):
        frames[name] = [
            record(images, scene.camera, scene.lights, seed=int(s), on=on) for s in step.generate_state(count)
        ]
    return frames
