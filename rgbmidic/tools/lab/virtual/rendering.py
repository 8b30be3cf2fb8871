"""Images of a scene, and ready-made scenes.

Every pixel is traced back to the paint, so that a deformed image is exact and never a warped one. The scenes are the
sphere and the plate on which the figures of rgbmidic are measured, and the bench of the paper.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import erf

from rgbmidic.arguments import checked
from rgbmidic.tools.scene.camera import DISTANCE, NOMINAL_DISTANCE, PIXEL, Light, Vector, reference_camera, three_lights
from rgbmidic.tools.scene.kernels import trace_rows
from rgbmidic.tools.scene.scene import Plate, Scene, Sphere, State
from rgbmidic.tools.scene.surface import AffineField, Finish, Surface
from rgbmidic.tools.scene.zones import material_points, truth
from rgbmidic.typing import FloatArray, FloatImage


def rays_per_pixel(scene: Scene) -> int:
    """Return how many rays per pixel and direction: the camera's, or so many that the sampling pattern leaves no trace.

    On a mat plate six rays per pixel of 2.2 wrinkles err by 1 DN rms of 2000. A reflection follows details finer than
    the wrinkles by the ratio of lobe to slope: twice as many rays at 6 and 4 degrees (measured; see the tests).
    """
    if scene.camera.samples is not None:
        return scene.camera.samples
    n_samples = 6.0 if scene.surface.coverage else 1.0  # paint without droplets has no edges
    for paint in (scene.surface.white, scene.surface.black):
        if paint.slope_deg > 0:
            sharpness = 2 * max(1.0, 4 / paint.lobe_deg) ** 0.75 if paint.gloss > 0 else 1.0
            n_samples = max(n_samples, 2.7 * scene.pixel / paint.spacing * sharpness)
    return min(math.ceil(n_samples - 0.1), 24)


def render(scene: Scene, state: State | None = None) -> FloatImage:
    """Return the images of each light alone, without noise.

    Parameters
    ----------
    scene
        Body, paint, lights and camera.
    state
        Where the body is; None: the reference.

    Returns
    -------
    ndarray, shape (k, H, W)
        DN above black in the channel that sees the light best, neither quantised nor clipped; 0 off the body.
    """
    state, duration = state or State(), scene.camera.exposure_time
    poses = [state]
    if duration > 0 and (any(state.velocity) or state.spin_deg):
        # the middles of equal parts of the exposure, each shorter in motion than a quarter of the pixel's own aperture
        swept = np.hypot(*truth(scene, state.at_time(duration / 2), state.at_time(-duration / 2)))
        n_parts = max(1, math.ceil(4 * float(np.nanmax(swept, initial=0.0))))
        poses = [state.at_time(duration * ((i + 0.5) / n_parts - 0.5)) for i in range(n_parts)]
    return np.asarray(sum(_trace(scene, pose) for pose in poses) * np.float32(1 / len(poses)))


def _trace(scene: Scene, state: State) -> FloatImage:
    """Trace one pose: lights that the lens images alike are traced together."""
    out = np.empty((len(scene.lights), *scene.camera.shape), dtype=np.float32)
    lenses, kinds = np.unique(scene.camera.lenses(scene.lights), axis=0, return_inverse=True)
    for number, lens in enumerate(lenses):
        indices = np.flatnonzero(kinds.ravel() == number)
        out[indices] = _trace_lens(scene, state, tuple(scene.lights[index] for index in indices), lens)
    camera = scene.camera
    levels = camera.full_scale * camera.exposure * camera.response(scene.lights).max(axis=0)
    out *= levels.astype(np.float32)[:, None, None]
    return out


def _trace_lens(scene: Scene, state: State, lights: tuple[Light, ...], lens: FloatArray) -> FloatImage:
    camera, n = scene.camera, rays_per_pixel(scene)
    turn, origin = state.pose(scene.body)
    frame = np.concatenate([-turn.T @ origin, turn.T.ravel()])
    positions = np.array(
        [[*(turn.T @ (np.array(li.position) - origin)), li.power * NOMINAL_DISTANCE**2] for li in lights]
    )
    field = AffineField() if state.displacement is None else state.displacement
    affine = field.inverse() if isinstance(field, AffineField) else None
    pad, taps = _aperture(camera.lens_blur, n)
    height, width = camera.shape
    out = np.empty((len(lights), height, width), dtype=np.float32)
    band = 64  # rows traced at a time: bounds the memory; the images do not depend on it
    for top in range(0, height, band):
        bottom = min(top + band, height)
        rows = np.empty((len(lights), bottom - top + 2 * pad, n, width), dtype=np.float32)
        first = n * (top - pad)
        material = np.empty((0, 0, 2))
        if affine is None:
            material = _subpixel_material(scene, state, lens, (first, n * rows.shape[1]), pad)
        body, identity = scene.body.parameters(), np.array([1.0, 0, 0, 1, 0, 0])
        trace_rows(
            rows, first, taps, pad, lens, frame, body, identity if affine is None else affine, material, positions,
            *scene.surface.parameters(),
        )  # fmt: skip
        lines = rows.reshape(len(lights), -1, width)
        out[:, top:bottom] = sum(tap * lines[:, q : q + (bottom - top) * n : n] for q, tap in enumerate(taps))
    return out


def _aperture(blur: float, samples: int) -> tuple[int, FloatArray]:
    """Pixels of margin and weights of the sub-pixel samples: square pixel aperture convolved with the lens blur."""
    pad = math.ceil(4 * blur)
    offset = (np.arange(samples * (2 * pad + 1)) + 0.5) / samples - 0.5 - pad
    if blur == 0:
        weights = np.ones(offset.size)
    else:
        scale = 1 / (math.sqrt(2) * blur)
        weights = erf((offset + 0.5) * scale) - erf((offset - 0.5) * scale)
    return pad, (weights / weights.sum()).astype(np.float32)


def _subpixel_material(
    scene: Scene, state: State, lens: FloatArray, sample_rows: tuple[int, int], pad: int
) -> FloatArray:
    """Return material point (count, columns, 2) of the samples in so many rows from the first; NaN off the plate."""
    n, (first, count) = rays_per_pixel(scene), sample_rows
    x = (np.arange(n * (scene.camera.shape[1] + 2 * pad)) + 0.5) / n - 0.5 - pad
    y = (np.arange(first, first + count) + 0.5) / n - 0.5
    focal, *centre = scene.camera.lenses(scene.lights)[0]
    columns, rows = np.meshgrid(
        (x - lens[1]) * (focal / lens[0]) + centre[0], (y - lens[2]) * (focal / lens[0]) + centre[1]
    )
    return np.ascontiguousarray(np.moveaxis(material_points(scene, state, (columns, rows))[:2], 0, -1))


def paint(*, gloss: float = 1.5, lobe_deg: float = 4.0, **settings: Any) -> Surface:
    """Return black droplets (albedo 0.10) on white paint (0.80), wrinkles 25 um apart with 6 degrees rms slope.

    `settings` are those of `Surface`.
    """
    white, black = (Finish(albedo=albedo, gloss=gloss, lobe_deg=lobe_deg) for albedo in (0.80, 0.10))
    return Surface(white=white, black=black, **settings)


def sphere_scene(
    *,
    size: int = 640,
    seed: int = 0,
    droplet: float = 0.23,
    gloss: float = 1.5,
    **camera: object,
) -> Scene:
    """Return the speckled 82.5 mm sphere under three coloured lamps; `turned` gives its states.

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
    **camera
        Changed settings of the camera (`Camera`), for instance ``cfa="GBRG"`` or ``lateral_colour=0.5``.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        A setting that is not possible.
    """
    return Scene(
        body=Sphere(),
        lights=three_lights(),
        camera=reference_camera((size, size), **camera),
        surface=paint(droplet=droplet, gloss=gloss, seed=seed),
    )


def plate_scene(
    *,
    size: int = 512,
    gloss: float = 0.0,
    glare: str | None = None,
    tilt_deg: tuple[float, float] = (float(np.degrees(0.15)), 0.0),
    **settings: Any,
) -> Scene:
    """Return a flat speckled plate under three coloured lamps; `strained_plate` gives its states.

    Parameters
    ----------
    size
        Rows and columns (px).
    gloss
        0 (default): no reflection anywhere. With 1.5 the reference tilt brings green's reflection near the field.
    glare
        Name of a lamp to be moved, at its distance, to where its reflection covers the whole field.
    tilt_deg
        Tilt of the plate about y, then about x.
    **settings
        The other parameters of `sphere_scene`.

    Returns
    -------
    Scene

    Raises
    ------
    InputError
        A setting that is not possible, or no lamp of that name.
    """
    plate = Plate(width=200.0, height=200.0, centre=(0.0, 0.0, DISTANCE), tilt_deg=tilt_deg)
    scene = replace(sphere_scene(size=size, gloss=gloss, **settings), body=plate)
    if glare is None:
        return scene
    lamp = scene.light(glare)
    distance = float(np.linalg.norm(np.array(lamp.position) - scene.body.front))
    return scene.with_light(replace(lamp, position=scene.mirror_position(distance)))


def paper_scene(*, size: int = 1024, seed: int = 0, colour: bool = False, **camera: object) -> Scene:
    """Return the bench of paper section 3.3: a monochrome camera and two white lamps in succession, or three colours.

    The lamps stand so far apart that, while the sphere turns from 0 to +14 degrees, the reflection of one never comes
    where the other's was (reflections at -305 and +207 px of the middle, moving by +181 px). The paint is that of
    `sphere_scene` with droplets 4 um high (paper, Fig. 10): plain DIC then scatters 3.3 to 4.6 times as much in the
    reflection as beside it from 1/3 to 2 degrees, where the paper found about 4. The exposure
    leaves the brightest pixel just below saturation.

    Parameters
    ----------
    size
        Rows and columns of the camera.
    seed
        Of the paint's droplets.
    colour
        Whether three coloured lights are seen by a colour camera.
    **camera
        Changes of the camera's settings, as of `reference_camera`.

    Returns
    -------
    Scene
    """
    positions = {"left": _lamp_at(-48.0, -1.5), "right": _lamp_at(32.0, 1.5)}
    if colour:
        positions = {"red": positions["left"], "green": positions["right"], "blue": (10.0, -220.0, 60.0)}
    front = (0.0, 0.0, DISTANCE)
    settings: dict[str, object] = {"kind": "bayer" if colour else "monochrome", **camera}
    scene = Scene(
        body=Sphere(),
        lights=tuple(Light(name=name, position=position).aimed(front) for name, position in positions.items()),
        camera=reference_camera((size, size), **settings),
        surface=paint(seed=seed, dome=0.004),
    )
    return scene if "exposure" in camera else expose(scene)


@checked
def expose(scene: Scene, state: State | None = None, level: float = 0.97) -> Scene:
    """Return the scene with the exposure at which the brightest sample of all channels is a fraction of full scale.

    Parameters
    ----------
    scene
        Scene with any exposure.
    state
        Pose and displacement at which it is exposed; None: the reference state.
    level
        Fraction of full scale.

    Returns
    -------
    Scene
    """
    images = render(scene, state)
    channel_images = np.einsum("cl,lyx->cyx", scene.camera.mixing(scene.lights), images)
    brightest = float((images if scene.camera.kind == "monochrome" else channel_images).max())
    factor = level * scene.camera.full_scale / brightest
    return replace(scene, camera=replace(scene.camera, exposure=scene.camera.exposure * factor))


def _lamp_at(angle_deg: float, height_deg: float, distance: float = 550.0) -> Vector:
    """Return the place of a lamp at an angle from the optical axis, seen from the front point, and a height (down)."""
    angle, height = np.radians(angle_deg), np.radians(height_deg)
    x, z = distance * np.cos(height) * np.sin(angle), DISTANCE - distance * np.cos(height) * np.cos(angle)
    return float(x), float(distance * np.sin(height)), float(z)


@checked
def turned(angle_deg: float) -> State:
    """Return the body turned by an angle about the vertical through its front point (paper, section 2.1).

    Parameters
    ----------
    angle_deg
        Angle in degrees.

    Returns
    -------
    State
    """
    return State(angle_deg=angle_deg)


@checked
def strained_plate(
    *, shift_px: tuple[float, float] = (0.25, 0.075), strain: float = 0.002, pixel: float = PIXEL
) -> State:
    """Return a plate stretched by the same strain along x and y and shifted by about `shift_px` in the image.

    Parameters
    ----------
    shift_px
        Shift along x and y in px.
    strain
        Strain along x and y.
    pixel
        Size of a pixel on the plate in mm.

    Returns
    -------
    State
    """
    offset = (shift_px[0] * pixel, shift_px[1] * pixel)
    return State(displacement=AffineField(gradient=((strain, 0.0), (0.0, strain)), offset=offset))
