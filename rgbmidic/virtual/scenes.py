"""Ready-made scenes: the reference sphere and plate on which rgbmidic's figures are measured, and the paper's bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rgbmidic.virtual.camera import Camera
from rgbmidic.virtual.fields import AffineField
from rgbmidic.virtual.light import Light, Vector
from rgbmidic.virtual.scene import Plate, Scene, Sphere, State
from rgbmidic.virtual.surface import Finish, Surface

__all__ = ["REFERENCE_CROSSTALK", "paint", "plate_scene", "sphere_scene", "strained_plate", "three_lights", "turned"]

REFERENCE_CROSSTALK = ((1.0, 0.10, 0.02), (0.14, 1.0, 0.16), (0.03, 0.12, 1.0))
"""Rows: camera R, G, B; columns: red, green and blue light."""
PIXEL = 0.055
"""mm per px on the object."""
DISTANCE = 600.0
"""mm from the camera to the object's front point."""


def three_lights(
    target: Vector = (0.0, 0.0, DISTANCE), aberration: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> tuple[Light, ...]:
    """Red, green and blue lamps left, right and above the camera, all equally bright at the target.

    `aberration`: relative magnification of the lens in red, green and blue.
    """
    places = {"red": (-190.0, -12.0, 90.0), "green": (200.0, 15.0, 90.0), "blue": (10.0, -220.0, 60.0)}
    return tuple(
        Light(name=name, position=position, magnification=magnification).aimed(target)
        for (name, position), magnification in zip(places.items(), aberration, strict=True)
    )


def paint(*, droplet: float = 0.23, gloss: float = 1.5, seed: int = 0, coverage: float = 0.45) -> Surface:
    """Black droplets (albedo 0.10) on white paint (0.80), wrinkles 25 um apart with 6 degrees rms slope."""
    white, black = Finish(albedo=0.80, gloss=gloss), Finish(albedo=0.10, gloss=gloss)
    return Surface(white=white, black=black, droplet=droplet, coverage=coverage, seed=seed)


def reference_camera(shape: tuple[int, int], **changes: object) -> Camera:
    """RGGB, 12 bit, 4 e-/DN, read noise 12 e-, lens blur 0.45 px, 0.055 mm per px; `changes` to any setting."""
    camera = Camera(shape=shape, focal_px=DISTANCE / PIXEL, crosstalk=np.array(REFERENCE_CROSSTALK))
    return replace(camera, **changes)  # type: ignore[arg-type]


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


def turned(angle_deg: float) -> State:
    """The body turned by an angle about the vertical through its front point (paper, section 2.1)."""
    return State(angle_deg=angle_deg)


def strained_plate(
    *, shift_px: tuple[float, float] = (0.25, 0.075), strain: float = 0.002, pixel: float = PIXEL
) -> State:
    """A plate stretched by the same strain along x and y and shifted by about `shift_px` in the image."""
    offset = (shift_px[0] * pixel, shift_px[1] * pixel)
    return State(displacement=AffineField(gradient=((strain, 0.0), (0.0, strain)), offset=offset))
