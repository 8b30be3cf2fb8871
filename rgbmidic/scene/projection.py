"""Which point of the body a pixel sees, where it goes, how far it moves in the image: exact, nothing is rendered."""

from __future__ import annotations

import numpy as np

from rgbmidic.scene.in_plane import material_from_spatial
from rgbmidic.scene.scene import Plate, Scene, State
from rgbmidic.typing import FloatArray

__all__ = ["intersect", "material_points", "placed", "truth"]


def material_points(
    scene: Scene, state: State | None = None, pixels: tuple[FloatArray, FloatArray] | None = None
) -> FloatArray:
    """Material point (mm, body axes) that an ideal lens sees at every pixel centre, shape (3, H, W); NaN off it.

    `pixels`: image points (x, y) in px, two arrays of one shape, instead of the pixel centres.
    """
    state = state or State()
    if pixels is None:
        height, width = scene.camera.shape
        x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    else:
        x, y = pixels
    spatial = intersect(scene, state, x, y)
    if isinstance(scene.body, Plate):
        spatial[:2] = material_from_spatial(state.displacement, spatial[0], spatial[1])
        spatial[2] = np.where(np.isfinite(spatial[0]), 0.0, np.nan)
        outside = (abs(spatial[0]) > scene.body.width / 2) | (abs(spatial[1]) > scene.body.height / 2)
        spatial[:, outside] = np.nan
    return spatial


def placed(scene: Scene, material: FloatArray, state: State | None = None) -> tuple[FloatArray, FloatArray]:
    """Where material points (3, ...) are in a state, and which way the surface faces there.

    Returns
    -------
    points : ndarray, shape (3, ...)
        mm, camera axes.
    normals : ndarray, shape (3, ...)
        Outward unit normals, camera axes.
    """
    state = state or State()
    position = material.copy()
    if isinstance(scene.body, Plate) and state.displacement is not None:
        ux, uy = state.displacement(material[0], material[1])
        position[0] += ux
        position[1] += uy
    turn, origin = state.pose(scene.body)
    points = np.einsum("ij,j...->i...", turn, position) + origin.reshape(3, *[1] * (material.ndim - 1))
    return points, np.einsum("ij,j...->i...", turn, _normals(scene, material))


def truth(
    scene: Scene, state: State, reference: State | None = None, pixels: tuple[FloatArray, FloatArray] | None = None
) -> FloatArray:
    """Exact displacement of the material point seen at every pixel of the reference image.

    Parameters
    ----------
    scene
        Body, paint, lights and camera.
    state
        The deformed state.
    reference
        State of the reference image; None: the scene's rest.
    pixels
        Image points (x, y) in px of the reference image, two arrays of one shape; None: all pixels.

    Returns
    -------
    ndarray, shape (2, H, W), or (2, ...) as `pixels`
        (u, v) in px; NaN where the pixel is not on the body or the point is hidden in `state`. Points that leave the
        frame keep their displacement.
    """
    point, normal = placed(scene, material_points(scene, reference, pixels), state)
    hidden = ~((normal * point).sum(axis=0) < 0)
    camera = scene.camera
    if pixels is None:
        pixels = np.arange(camera.shape[1], dtype=float), np.arange(camera.shape[0], dtype=float)[:, None]
    x = camera.focal_px * point[0] / point[2] + camera.centre[0] - pixels[0]
    y = camera.focal_px * point[1] / point[2] + camera.centre[1] - pixels[1]
    return np.where(hidden, np.nan, np.stack([x, y]))


def intersect(scene: Scene, state: State, x: FloatArray, y: FloatArray) -> FloatArray:
    """Point (3, ...) in body axes where the rays through image points (px) meet the body's front; NaN beside it."""
    camera, (turn, origin) = scene.camera, state.pose(scene.body)
    rays = np.stack(
        [(x - camera.centre[0]) / camera.focal_px, (y - camera.centre[1]) / camera.focal_px, np.ones_like(x)]
    )
    direction = np.einsum("ji,j...->i...", turn, rays)
    start = -turn.T @ origin
    with np.errstate(invalid="ignore", divide="ignore"):
        if isinstance(scene.body, Plate):
            distance = -start[2] / direction[2]
        else:
            axes = [0, 1, 2] if scene.body.parameters()[0] == 2 else [0, 2]
            a = (direction[axes] ** 2).sum(axis=0)
            b = np.einsum("i,i...->...", start[axes], direction[axes])
            c = (start[axes] ** 2).sum() - scene.body.radius**2
            distance = (-b - np.sqrt(b * b - a * c)) / a
        distance = np.where(distance > 0, distance, np.nan)
    point = start.reshape(3, *[1] * x.ndim) + distance * direction
    limits = scene.body.parameters()[2:]
    if not isinstance(scene.body, Plate):
        point[:, abs(point[1]) > limits[1]] = np.nan
    return np.asarray(point)


def _normals(scene: Scene, material: FloatArray) -> FloatArray:
    """Outward unit normals (3, ...) in body axes."""
    normal = np.zeros_like(material)
    if isinstance(scene.body, Plate):
        normal[2] = -1.0
        return normal
    normal = material / scene.body.radius
    if scene.body.parameters()[0] == 1:
        normal[1] = 0.0
    return normal
