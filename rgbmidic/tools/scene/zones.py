"""Geometry of a scene, exact and without rendering: material points, displacement, and the zones where lights reflect.

The material point that a pixel sees, its place in another state and its displacement in the image follow from the
pin-hole camera and the body's pose; the zones from the reflectance of the paint. It is rough: facets with a narrow
specular lobe, tilted at random by the wrinkles. At the scale of the speckle it reflects into the facets' lobe convolved
with the law of the slopes (P. Beckmann and A. Spizzichino, The Scattering of Electromagnetic Waves from Rough Surfaces,
1963; R. Cook and K. Torrance, ACM Transactions on Graphics 1, 1982). That lobe is smooth and predictable; the erratic
part within it (paper, section 2.3) is not, which is why the prediction serves to weight the lights and not to correct
the images.

The camera stands in the origin and looks along +z; x to the right, y downwards, lengths in mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rgbmidic.arguments import bounded
from rgbmidic.errors import InputError
from rgbmidic.tools.scene import SceneSection
from rgbmidic.tools.scene.camera import NOMINAL_DISTANCE, Light
from rgbmidic.tools.scene.scene import Cylinder, Plate, Scene, Sphere, State
from rgbmidic.tools.scene.surface import Finish, Surface, material_from_spatial
from rgbmidic.typing import FloatArray

REFLECTS = 0.2
"""Specular fraction from which a light counts as reflecting at a point (chosen; the forecast does not use it)."""


def material_points(
    scene: Scene, state: State | None = None, pixels: tuple[FloatArray, FloatArray] | None = None
) -> FloatArray:
    """Return material point (mm, body axes) seen at every pixel centre of the first light's image; NaN off the body.

    `pixels`: image points (x, y) in px, two arrays of one shape, instead of the pixel centres.

    Parameters
    ----------
    scene
        The scene.
    state
        Pose and displacement; None: the reference state.
    pixels
        Image points x and y in px, arrays of one shape; None: the pixel centres.

    Returns
    -------
    ndarray, shape (3, H, W)
        Or (3, ...) for `pixels` of another shape.
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


def points_and_normals(scene: Scene, material: FloatArray, state: State | None = None) -> tuple[FloatArray, FloatArray]:
    """Return the positions of material points (3, ...) in a state, and the surface's normals there.

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
    if isinstance(scene.body, Plate):
        normals = np.zeros_like(material)
        normals[2] = -1.0
    else:
        normals = material / scene.body.radius
        if isinstance(scene.body, Cylinder):
            normals[1] = 0.0
    turn, origin = state.pose(scene.body)
    points = np.einsum("ij,j...->i...", turn, position) + origin.reshape(3, *[1] * (material.ndim - 1))
    return points, np.einsum("ij,j...->i...", turn, normals)


def truth(
    scene: Scene, state: State, reference: State | None = None, pixels: tuple[FloatArray, FloatArray] | None = None
) -> FloatArray:
    """Exact displacement of the material point seen at every pixel of the first light's reference image, px of it.

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
    point, normal = points_and_normals(scene, material_points(scene, reference, pixels), state)
    is_hidden = ~((normal * point).sum(axis=0) < 0)
    camera = scene.camera
    if pixels is None:
        pixels = np.arange(camera.shape[1], dtype=float), np.arange(camera.shape[0], dtype=float)[:, None]
    focal, *centre = camera.lenses(scene.lights)[0]
    x = focal * point[0] / point[2] + centre[0] - pixels[0]
    y = focal * point[1] / point[2] + centre[1] - pixels[1]
    return np.where(is_hidden, np.nan, np.stack([x, y]))


def intersect(scene: Scene, state: State, x: FloatArray, y: FloatArray) -> FloatArray:
    """Point (3, ...) in body axes where the rays through points (px) of the first light's image meet the body; or NaN.

    Of the body only its front is seen.
    """
    focal, *centre = scene.camera.lenses(scene.lights)[0]
    turn, origin = state.pose(scene.body)
    rays = np.stack([(x - centre[0]) / focal, (y - centre[1]) / focal, np.ones_like(x)])
    direction = np.einsum("ji,j...->i...", turn, rays)
    start = -turn.T @ origin
    with np.errstate(invalid="ignore", divide="ignore"):
        if isinstance(scene.body, Plate):
            distance = -start[2] / direction[2]
        else:
            axes = [0, 1, 2] if isinstance(scene.body, Sphere) else [0, 2]
            a = (direction[axes] ** 2).sum(axis=0)
            b = np.einsum("i,i...->...", start[axes], direction[axes])
            c = (start[axes] ** 2).sum() - scene.body.radius**2
            distance = (-b - np.sqrt(b * b - a * c)) / a
        distance = np.where(distance > 0, distance, np.nan)
    point = start.reshape(3, *[1] * x.ndim) + distance * direction
    if isinstance(scene.body, Cylinder):
        point[:, abs(point[1]) > scene.body.length / 2] = np.nan
    return np.asarray(point)


def region_in_view(
    x: FloatArray, y: FloatArray, displacement: FloatArray, shape: tuple[int, int], margin: float = 20.0
) -> tuple[float, float, float, float]:
    """Return the largest rectangle about the middle on the body and, with a margin, in the frame in all states.

    Parameters
    ----------
    x, y : ndarray, shape (h, w)
        Points of the reference image, px.
    displacement : ndarray, shape (T, 2, h, w)
        Of these points in every state, px; NaN off the body.
    shape
        Rows and columns of the frame.
    margin
        px between the frame's edge and the region's nearest point in any state.

    Returns
    -------
    tuple
        (x0, y0, x1, y1), px.

    Raises
    ------
    InputError
        There is none; the user must state one.
    """
    height, width = shape
    on_body = np.asarray(np.isfinite(displacement[:, 0]).all(axis=0))
    largest = np.abs(displacement[:, :, on_body]).max(axis=(0, 2)) if on_body.any() else np.zeros(2)
    x_margin, y_margin = (float(np.ceil(value)) + margin for value in largest)
    middle = (width - 1) / 2, (height - 1) / 2
    while 2 * x_margin < width - 8 and 2 * y_margin < height - 8:
        inside = (abs(x - middle[0]) <= middle[0] - x_margin) & (abs(y - middle[1]) <= middle[1] - y_margin)
        if inside.any() and on_body[inside].all():
            return x_margin, y_margin, width - 1 - x_margin, height - 1 - y_margin
        x_margin, y_margin = x_margin + 4, y_margin + 4
    raise InputError("the body leaves the middle of the frame: state output.region = [x0, y0, x1, y1]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflectance(SceneSection):
    """Reflectance of a painted surface at the scale of the speckle.

    Radiance under unit irradiance: ``diffuse n.l + specular exp(-t^2/(2 width^2)) / (v.h)``, with t the tangent of the
    angle between the surface's normal n and the half-way vector h of the light's and the camera's directions l and v.

    Attributes
    ----------
    diffuse
        Mean diffuse reflection (albedo).
    specular
        Peak of the specular lobe, in the same unit.
    width_deg
        Standard deviation of the lobe, as the angle of the half-way vector: half of that by which the light turns.
    """

    diffuse: float = bounded(above=0)
    specular: float = bounded(at_least=0)
    width_deg: float = bounded(above=0, below=45)


def unit_vectors(vectors: FloatArray, axis: int = 0) -> FloatArray:
    """Return the vectors of length 1 in the same directions; the components are along an axis."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(vectors / np.linalg.norm(vectors, axis=axis, keepdims=True))


def macroscopic_reflectance(surface: Surface) -> Reflectance:
    """Return the reflectance of a painted surface at the scale of the speckle, averaged over white and black paint.

    A facet's Gaussian lobe of variance b^2 convolved with slopes of variance a^2 per axis is a Gaussian of variance
    ``a^2 + b^2`` whose peak is lower by ``b^2/(a^2 + b^2)``. Where the paints differ the lobe keeps peak and volume.
    """
    # per axis, half of the mean square slope of the dome h (1 - r^2/R^2)^2 over its disc: 4/3 (h/R)^2, its integral
    dome = 4 / 3 * (surface.dome / (surface.droplet / 2)) ** 2 / 2
    paints = ((surface.white, 0.0, 1 - surface.coverage), (surface.black, dome, surface.coverage))
    diffuse = sum(paint.albedo * area for paint, _, area in paints)
    volume = sum(paint.gloss * facet_variance(paint) * area for paint, _, area in paints)
    lobes = [(facet_variance(paint), slope_variance(paint) + dome_variance) for paint, dome_variance, _ in paints]
    peak = sum(p.gloss * b / (a + b) * area for (p, _, area), (b, a) in zip(paints, lobes, strict=True))
    width = math.sqrt(volume / peak) if peak > 0 else math.sqrt(sum(lobes[0]))
    return Reflectance(diffuse=max(diffuse, 1e-9), specular=peak, width_deg=math.degrees(width))


def facet_variance(paint: Finish) -> float:
    """Return the variance (rad^2, per axis) of the specular lobe of one facet."""
    return math.radians(paint.lobe_deg) ** 2


def slope_variance(paint: Finish) -> float:
    """Return the variance per axis of the slopes of the wrinkles."""
    return math.tan(math.radians(paint.slope_deg)) ** 2 / 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Zones:
    """Reflection and grey level expected of each light at points of a surface, in one state.

    NaN where a light or the camera does not see the surface.

    Attributes
    ----------
    slopes : ndarray, shape (k, 3, ...)
        The half-way vector relative to the normal, ``h/(n.h) - n``: the slope that a facet needs to be a mirror.
    deviation_deg : ndarray, shape (k, ...)
        Angle between the light and the mirror direction of the camera's ray.
    lambert : ndarray, shape (k, ...)
        Cosine between normal and light.
    specular : ndarray, shape (k, ...)
        Expected radiance of the specular light under unit irradiance across the rays.
    irradiance : ndarray, shape (k, ...)
        Across the rays, in grey levels of the channel that sees the light best (DN of an ideal white).
    albedo
        Mean diffuse reflection of the paint.
    """

    slopes: FloatArray
    deviation_deg: FloatArray
    lambert: FloatArray
    specular: FloatArray
    irradiance: FloatArray
    albedo: float

    @property
    def radiance(self) -> FloatArray:
        """Radiance (k, ...), diffuse and specular, under unit irradiance across the rays."""
        return self.albedo * self.lambert + self.specular

    @property
    def fraction(self) -> FloatArray:
        """Specular fraction (k, ...), 0 to 1, of the light that reaches the camera."""
        return self.specular / self.radiance

    @property
    def level(self) -> FloatArray:
        """Expected mean grey level (k, ...) of the light's image, DN above black."""
        return self.irradiance * self.radiance


def predict_zones(
    scene: Scene,
    state: State | None = None,
    *,
    material: FloatArray | None = None,
    lights: tuple[Light, ...] | None = None,
) -> Zones:
    """Predict where the lights of a scene reflect; the slopes are in the body's axes.

    Parameters
    ----------
    scene
        Body, paint, lights and camera.
    state
        Where the body is; None: at rest.
    material : ndarray, shape (3, ...), optional
        Material points (mm) to be followed; None: those that the camera's pixels see in this state.
    lights
        Instead of the scene's, in the same colours.
    """
    points = material_points(scene, state) if material is None else material
    turn, _ = (state or State()).pose(scene.body)
    return zones_on_surface(scene, *points_and_normals(scene, points, state), lights, turn)


def zones_on_surface(
    scene: Scene,
    points: FloatArray,
    normals: FloatArray,
    lights: tuple[Light, ...] | None = None,
    axes: FloatArray | None = None,
) -> Zones:
    """Predict where the lights reflect on any surface before the scene's camera, for instance one from a height map.

    `points` (mm) and outward unit `normals` of shape (3, ...), NaN off the surface, are in camera axes; the slopes are
    in those which the rotation `axes` turns into the camera's, None: the same; `lights` as in `predict_zones`.
    """
    lamps, camera, paint = (
        scene.lights if lights is None else lights,
        scene.camera,
        macroscopic_reflectance(scene.surface),
    )
    trailing_axes = (1,) * (points.ndim - 1)
    rays = np.array([light.position for light in lamps]).reshape(-1, 3, *trailing_axes) - points
    view, light = unit_vectors(-points), unit_vectors(rays, axis=1)
    halfway = unit_vectors(light + view, axis=1)
    lambert, facing = (normals * light).sum(axis=1), (normals * view).sum(axis=0)
    is_visible = (lambert > 0) & (facing > 0)
    mirror = 2 * facing * normals - view
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = np.where(
            is_visible[:, None], halfway / (normals * halfway).sum(axis=1, keepdims=True) - normals, np.nan
        )
    if axes is not None:
        slopes = np.einsum("ji,kj...->ki...", axes, slopes)
    lobe = np.exp(-(slopes**2).sum(axis=1) / (2 * math.radians(paint.width_deg) ** 2))
    levels = camera.full_scale * camera.exposure * camera.response(scene.lights).max(axis=0)
    powers = np.array([light.power for light in lamps]) * NOMINAL_DISTANCE**2 * levels
    return Zones(
        slopes=slopes,
        deviation_deg=np.where(is_visible, np.degrees(np.arccos(np.clip((mirror * light).sum(axis=1), -1, 1))), np.nan),
        lambert=np.where(is_visible, lambert, np.nan),
        specular=paint.specular * lobe / (view * halfway).sum(axis=1),
        irradiance=np.asarray(powers.reshape(-1, *trailing_axes) / (rays**2).sum(axis=1)),
        albedo=paint.diffuse,
    )
