"""Weights of a test's frames predicted from a SCENE.toml: the paper's first method (section 3.2), for the main job."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic.arguments import checked
from rgbmidic.disk import require_regular_file
from rgbmidic.errors import ConfigurationError, InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.settings import TestSettings
from rgbmidic.tools.scene.forecast import Instrument
from rgbmidic.tools.scene.scene import Scene, State, read_scene
from rgbmidic.tools.scene.zones import Zones, material_points, predict_zones, unit_vectors, zones_on_surface
from rgbmidic.typing import FloatArray, FloatImage

_STEP = 4
"""Pixels between the points of the prediction, which is interpolated in between: reflections are far wider."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GeometryWeights:
    """Weights of every frame of a test, from lamps, camera and specimen; a `LightWeights`.

    Attributes
    ----------
    scene
        Lamps, camera, paint and body.
    states
        State of every frame; empty: not known, all frames show the body at rest.
    reference_frames
        Indices of the frames whose mean is the reference.
    order
        For each light of the test its place in the scene.
    limit_deg
        Angle of binary weights; None: soft weights, the inverse of the variance that is expected.
    instrument
        For the soft weights.
    surface
        Points and normals (3, h, w) on the grid of the prediction, from a height map; None: the scene's body.
    """

    notes: ClassVar[Mapping[str, float]] = {}

    scene: Scene
    states: tuple[State, ...]
    reference_frames: tuple[int, ...]
    order: tuple[int, ...]
    limit_deg: float | None
    instrument: Instrument
    surface: tuple[FloatArray, FloatArray] | None = None

    @classmethod
    def prepare(
        cls, settings: TestSettings, *, lights: Sequence[str], shape: tuple[int, int], frames: int
    ) -> GeometryWeights:
        """Read the scene that the settings name and check that it is that of the test.

        Parameters
        ----------
        settings
            With ``weights.method = "geometry"``.
        lights, shape, frames
            Names of the lights, size of the frames (H, W) and their number.

        Raises
        ------
        ConfigurationError
            The scene is not readable, or its camera, lights or states are not those of the test.
        """
        weights = settings.weights
        assert weights.geometry is not None
        experiment = read_scene(weights.geometry)
        scene = experiment.scene
        if scene.camera.shape != shape:
            raise ConfigurationError(
                f"{weights.geometry}: camera.shape is {list(scene.camera.shape)}, the frames have {list(shape)}"
            )
        if experiment.states and len(experiment.states) != frames - 1:
            raise ConfigurationError(
                f"{weights.geometry}: frame 0 shows the body at rest and every other frame one of the [[states]]; "
                f"there are {frames} frames and {len(experiment.states)} states. State all of them or none"
            )
        if weights.height_map is not None and experiment.states:
            raise ConfigurationError(f"{weights.geometry}: weights.height_map shows one pose; remove the [[states]]")
        return cls(
            scene=scene,
            states=(State(), *experiment.states) if experiment.states else (),
            reference_frames=settings.frames.reference,
            order=_order(scene, lights, weights.geometry),
            limit_deg=weights.limit_deg,
            instrument=Instrument.of(
                scene,
                element_size=settings.mesh.side,
                demosaic=settings.illumination.demosaic,
                prefilter=settings.solver.prefilter,
            ),
            surface=None if weights.height_map is None else _read_surface(weights.height_map, scene),
        )

    def reference(self, images: IlluminationImages) -> FloatImage:
        """Return the weights (k, H, W) of the reference: binary ones, or 1 where an image is valid.

        Soft weights belong to a pair of states and are given to the deformed one.
        """
        valid = images.valid.astype(np.float32)
        if self.limit_deg is None:
            return valid
        frame_weights = [self._binary(self._state(index), images, self.limit_deg) for index in self.reference_frames]
        return np.asarray(valid * np.min(frame_weights, axis=0))

    def deformed(self, images: IlluminationImages, index: int) -> FloatImage:
        """Return the weights (k, H, W) of frame `index` compared with the first reference frame."""
        state = self._state(index)
        if self.limit_deg is not None:
            return np.asarray(images.valid * self._binary(state, images, self.limit_deg))
        reference_zones, deformed_zones = (
            self._zones(self._state(self.reference_frames[0]), state),
            self._zones(state, state),
        )
        weights = self.instrument.weights(reference_zones, deformed_zones, motion_known=bool(self.states))
        return np.asarray(images.valid * self._at_pixels(weights, images))

    def _binary(self, state: State, images: IlluminationImages, limit_deg: float) -> FloatImage:
        deviation = self._zones(state, state).deviation_deg
        is_visible = self._at_pixels(np.isfinite(deviation).astype(np.float32), images) > 0.5
        smooth = self._at_pixels(np.nan_to_num(deviation, nan=180.0).astype(np.float32), images)
        return angle_weights(np.where(is_visible, smooth, np.nan), limit_deg)

    def _state(self, index: int) -> State:
        return self.states[index] if self.states else State()

    def _zones(self, state: State, viewed_state: State) -> Zones:
        """Return the zones in a state at the material points that the grid's pixels see in another one."""
        if self.surface is not None:
            return zones_on_surface(self.scene, *self.surface)
        material = material_points(self.scene, viewed_state, _grid(self.scene.camera.shape))
        return predict_zones(self.scene, state, material=material)

    def _at_pixels(self, coarse: FloatImage, images: IlluminationImages) -> FloatImage:
        """Return values (k, h, w) on the grid at the pixels of images (k, H, W), in the order of the test's lights."""
        (x_origin, y_origin), (height, width) = images.origin, images.shape
        x, y = np.meshgrid(*(np.arange(a, a + n, dtype=np.float32) for a, n in ((x_origin, width), (y_origin, height))))
        grid_coordinates = x / _STEP, y / _STEP
        return np.stack([cv2.remap(coarse[light], *grid_coordinates, cv2.INTER_LINEAR) for light in self.order])


def _grid(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the image points (x, y) of the prediction, up to beyond the last pixel."""
    rows, columns = (np.arange(0, size + _STEP, _STEP, dtype=np.float64) for size in shape)
    x, y = np.meshgrid(columns, rows)
    return x, y


def _order(scene: Scene, lights: Sequence[str], file: Path) -> tuple[int, ...]:
    names = [light.name for light in scene.lights]
    if set(names) == set(lights):
        return tuple(names.index(name) for name in lights)
    if scene.camera.kind == "monochrome" and len(names) == len(lights):  # files do not name the lights: their order
        return tuple(range(len(names)))
    raise ConfigurationError(f"{file}: the scene's lights are {', '.join(names)}, the test's are {', '.join(lights)}")


def _read_surface(path: Path, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the points and normals on the grid, from a height map on disk."""
    camera = scene.camera
    try:
        heights = np.load(require_regular_file(path), allow_pickle=False)
    except FileNotFoundError:
        raise ConfigurationError(f"weights.height_map not found: {path}") from None
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"weights.height_map {path} is not a readable npy file: {error}") from None
    if not isinstance(heights, np.ndarray) or heights.shape != camera.shape or heights.dtype.kind not in "fiu":
        raise ConfigurationError(
            f"weights.height_map {path} must hold one height in mm per pixel, shape {camera.shape}, not "
            f"{getattr(heights, 'shape', 'several arrays')}"
        )
    try:
        points, normals = surface_from_heights(heights, scene)
    except InputError as error:
        raise ConfigurationError(f"weights.height_map {path}: {error}") from None
    limits = camera.shape[1] - 1, camera.shape[0] - 1
    columns, rows = (
        np.minimum(coordinates, limit).astype(int)
        for coordinates, limit in zip(_grid(camera.shape), limits, strict=True)
    )
    return points[:, rows, columns], normals[:, rows, columns]


@checked
def angle_weights(deviation_deg: FloatArray, limit_deg: float = 15.0) -> FloatImage:
    """Return binary weights: 0 within `limit_deg` of the mirror direction and where the deviation is NaN, 1 elsewhere.

    By default the limit is that within which the reflection corrupts the image (paper, Fig. 9).

    Raises
    ------
    InputError
        The limit is not an angle between 0 and 180 degrees.
    """
    if not 0 < limit_deg < 180:
        raise InputError(f"the limit angle lies between 0 and 180 degrees, not {limit_deg!r}")
    return (deviation_deg > limit_deg).astype(np.float32)


@checked
def surface_from_heights(heights: npt.ArrayLike, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Return the points and normals of a surface given as a height map over the pixels of the reference image.

    Parameters
    ----------
    heights : array_like, shape (H, W)
        Height (mm) towards the camera over the plane through the body's front point, at every pixel; NaN where not
        known. Smooth at the scale of the speckle: droplets and wrinkles belong to the reflectance.
    scene
        Its camera, and the distance of that plane.

    Returns
    -------
    points, normals : ndarray, shape (3, H, W)

    Raises
    ------
    InputError
        A height reaches the camera.
    """
    camera, distance = scene.camera, scene.body.front[2]
    depth = distance - np.asarray(heights, dtype=np.float64)
    if depth.ndim != 2 or min(depth.shape) < 2:
        raise InputError(f"heights are a map of 2 x 2 points and more, not of shape {depth.shape}")
    if not np.nanmin(depth, initial=np.inf) > 0:
        raise InputError(f"heights must stay below the distance of {distance:g} mm to the camera")
    rows, columns = np.indices(depth.shape)
    focal, x0, y0 = camera.lenses(scene.lights)[0]
    points = np.stack([depth * (columns - x0) / focal, depth * (rows - y0) / focal, depth])
    down, right = np.gradient(points, axis=(1, 2))
    return points, unit_vectors(np.cross(down, right, axis=0))
