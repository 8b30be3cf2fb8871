"""Ready-made scenes: the reference sphere and plate on which rgbmidic's figures are measured, and the paper's bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbmidic.lab.virtual.rendering import render
from rgbmidic.scene.camera import DISTANCE, PIXEL, reference_camera
from rgbmidic.scene.in_plane import AffineField
from rgbmidic.scene.light import Light, Vector, three_lights
from rgbmidic.scene.scene import Plate, Scene, Sphere, State
from rgbmidic.scene.surface import Finish, Surface

__all__ = [
    "expose",
    "paint",
    "paper_scene",
    "plate_scene",
    "sphere_scene",
    "strained_plate",
    "turned",
]


def paint(
    *,
    droplet: float = 0.23,
    gloss: float = 1.5,
    seed: int = 0,
    coverage: float = 0.45,
    lobe_deg: float = 4.0,
    dome: float = 0.0,
) -> Surface:
    """Black droplets (albedo 0.10) on white paint (0.80), wrinkles 25 um apart with 6 degrees rms slope."""
    white = Finish(albedo=0.80, gloss=gloss, lobe_deg=lobe_deg)
    return Surface(
        white=white, black=replace(white, albedo=0.10), droplet=droplet, coverage=coverage, seed=seed, dome=dome
    )


def sphere_scene(
    *,
    size: int = 640,
    seed: int = 0,
    droplet: float = 0.23,
    gloss: float = 1.5,
    aberration: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **camera: object,
) -> Scene:
    """The speckled 82.5 mm sphere under three coloured lamps; `turned` gives its states.

    Parameters
    ----------
    size
        Rows and columns (px).
    seed
        Of the paint.
    droplet
        Median diameter of the black droplets (mm; 0.055 mm is one pixel).
    gloss
        Specular peak in units of an ideal white; 0: no reflection.
    aberration
        Relative magnification of the lens in red, green and blue.
    **camera
        Changed settings of the camera (`Camera`), for instance ``cfa="GBRG"`` or ``kind="rgb"``.
    """
    return Scene(
        body=Sphere(),
        lights=three_lights(aberration=aberration),
        camera=reference_camera((size, size), **camera),
        surface=paint(droplet=droplet, gloss=gloss, seed=seed),
    )


def plate_scene(
    *,
    size: int = 512,
    seed: int = 0,
    droplet: float = 0.23,
    gloss: float = 0.0,
    glare: str | None = None,
    tilt_deg: tuple[float, float] = (float(np.degrees(0.15)), 0.0),
    aberration: tuple[float, float, float] = (0.0, 0.0, 0.0),
    **camera: object,
) -> Scene:
    """A flat speckled plate under three coloured lamps; `strained_plate` gives its states.

    Parameters
    ----------
    gloss
        0 (default): no reflection anywhere. With 1.5 the reference tilt brings green's reflection near the field.
    glare
        Name of a lamp to be moved, at its distance, to where its reflection covers the whole field.
    tilt_deg
        Tilt of the plate about y, then about x.

    Other parameters as in `sphere_scene`.
    """
    scene = Scene(
        body=Plate(width=200.0, height=200.0, centre=(0.0, 0.0, DISTANCE), tilt_deg=tilt_deg),
        lights=three_lights(aberration=aberration),
        camera=reference_camera((size, size), **camera),
        surface=paint(droplet=droplet, gloss=gloss, seed=seed),
    )
    if glare is None:
        return scene
    lamp = scene.light(glare)
    distance = float(np.linalg.norm(np.array(lamp.position) - scene.body.front))
    return scene.with_light(replace(lamp, position=scene.mirror_position(distance)))


def paper_scene(*, size: int = 1024, seed: int = 0, colour: bool = False, **camera: object) -> Scene:
    """The bench of paper section 3.3: two white lamps in succession and a monochrome camera, or three colours at once.

    The lamps stand so far apart that, while the sphere turns from 0 to +14 degrees, the reflection of one never comes
    where the other's was (reflections at -305 and +207 px of the middle, moving by +181 px). The paint is that of
    `sphere_scene` with droplets 4 um high (paper, Fig. 10): plain DIC then scatters 3.3 to 4.6 times as much in the
    reflection as beside it from 1/3 to 2 degrees, where the paper found about 4. The exposure
    leaves the brightest pixel just below saturation.
    """
    places = {"left": _lamp_at(-48.0, -1.5), "right": _lamp_at(32.0, 1.5)}
    if colour:
        places = {"red": places["left"], "green": places["right"], "blue": (10.0, -220.0, 60.0)}
    front = (0.0, 0.0, DISTANCE)
    settings: dict[str, object] = {"kind": "bayer" if colour else "monochrome", **camera}
    scene = Scene(
        body=Sphere(),
        lights=tuple(Light(name=name, position=position).aimed(front) for name, position in places.items()),
        camera=reference_camera((size, size), **settings),
        surface=paint(seed=seed, dome=0.004),
    )
    return scene if "exposure" in camera else expose(scene)


def expose(scene: Scene, state: State | None = None, level: float = 0.97) -> Scene:
    """The scene with an exposure that brings its brightest pixel, over all channels, to a fraction of full scale."""
    images = render(scene, state)
    together = np.einsum("cl,lyx->cyx", scene.camera.mixing(scene.lights), images)
    brightest = float((images if scene.camera.kind == "monochrome" else together).max())
    factor = level * scene.camera.full_scale / brightest
    return replace(scene, camera=replace(scene.camera, exposure=scene.camera.exposure * factor))


def _lamp_at(angle_deg: float, height_deg: float, distance: float = 550.0) -> Vector:
    """A lamp seen from the front point under an angle from the optical axis, a little above (negative) or below it."""
    angle, height = np.radians(angle_deg), np.radians(height_deg)
    x, z = distance * np.cos(height) * np.sin(angle), DISTANCE - distance * np.cos(height) * np.cos(angle)
    return float(x), float(distance * np.sin(height)), float(z)


def turned(angle_deg: float) -> State:
    """The body turned by an angle about the vertical through its front point (paper, section 2.1)."""
    return State(angle_deg=angle_deg)


def strained_plate(
    *, shift_px: tuple[float, float] = (0.25, 0.075), strain: float = 0.002, pixel: float = PIXEL
) -> State:
    """A plate stretched by the same strain along x and y and shifted by about `shift_px` in the image."""
    offset = (shift_px[0] * pixel, shift_px[1] * pixel)
    return State(displacement=AffineField(gradient=((strain, 0.0), (0.0, strain)), offset=offset))
