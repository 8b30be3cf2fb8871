"""The paper's flat specimen on the virtual bench: goniometry (section 2.3) and topography (section 2.4)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.lab.study.bench import DSLR, study_paint
from rgbmidic.lab.study.goniometry import Goniometry, goniometry, pixel_levels
from rgbmidic.lab.study.topography import (
    detrend,
    local_slope,
    paint_classes,
    rms_slope,
    slope_uncertainty,
    wrinkle_spacing,
)
from rgbmidic.lab.virtual.recording import record
from rgbmidic.lab.virtual.rendering import render
from rgbmidic.scene.camera import reference_camera
from rgbmidic.scene.light import Light
from rgbmidic.scene.scene import Plate, Scene
from rgbmidic.scene.surface import Surface, height_map
from rgbmidic.typing import FloatArray

__all__ = ["TILT_DEG", "Topography", "virtual_goniometry", "virtual_topography"]


TILT_DEG = 15.0
"""Tilt of the specimen's normal against the camera's axis, degrees; the light reflects where it stands at as much."""
PIXELS = 40
"""Pixels that are followed, along the axis of rotation."""
PITCH_UM = 5.0
"""Pitch of the height map."""
HEIGHT_STD_UM = 0.1
"""Uncertainty of a height that the paper reckons with."""
_DISTANCE = 600.0
_UM = 1000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Topography:
    """What a height map tells.

    Attributes
    ----------
    height : ndarray, shape (H, W)
        um, without form.
    intensity : ndarray, shape (H, W)
        Diffuse reflectance.
    slope : ndarray, shape (H, W)
        Local slope in degrees.
    pitch
        Distance between the points, um.
    slope_std
        Standard uncertainty of the slope, degrees.
    white_deg, black_deg
        Root mean square slope of the two paints.
    spacing
        Distance between wrinkles and its standard uncertainty, um.
    """

    height: FloatArray
    intensity: FloatArray
    slope: FloatArray
    pitch: float
    slope_std: float
    white_deg: float
    black_deg: float
    spacing: tuple[float, float]

    @classmethod
    def from_maps(
        cls, height: npt.ArrayLike, intensity: npt.ArrayLike, *, pitch: float, height_std: float
    ) -> Topography:
        """Analyse a height map (um) with its intensity map, as a confocal sensor gives them.

        Parameters
        ----------
        height, intensity : array_like, shape (H, W)
            NaN where not measured.
        pitch
            um.
        height_std
            Standard uncertainty of a height, um.
        """
        flat = detrend(height)
        white = paint_classes(intensity)
        known = np.isfinite(flat)
        return cls(
            height=flat,
            intensity=np.asarray(intensity, dtype=np.float64),
            slope=local_slope(flat, pitch),
            pitch=pitch,
            slope_std=slope_uncertainty(height_std, pitch),
            white_deg=rms_slope(flat, white & known, pitch, height_std=height_std),
            black_deg=rms_slope(flat, ~white & known, pitch, height_std=height_std),
            spacing=wrinkle_spacing(flat, pitch, longest=12 * pitch),
        )


def virtual_topography(size_mm: float = 3.0, *, surface: Surface | None = None, seed: int = 0) -> Topography:
    """Measure the study's paint on a plate with a virtual sensor: 5 um pitch, 0.1 um noise, a bent carrier.

    Parameters
    ----------
    size_mm
        Side of the square; the paper's is 10 mm.
    surface
        The paint; None: that of the study.
    seed
        Of paint and noise.
    """
    paint = surface or study_paint(seed)
    height, cover = height_map(paint, size=size_mm, pitch=PITCH_UM / _UM)
    generator = np.random.default_rng(seed)
    x, y = np.meshgrid(*(np.linspace(-1, 1, n) for n in height.shape[::-1]))
    form = 20 * x + 8 * y + 15 * x**2 - 6 * x * y**3 + 4 * y**4
    intensity = (1 - cover) * paint.white.albedo + cover * paint.black.albedo
    intensity = intensity + generator.normal(scale=0.02, size=cover.shape)
    measured = _UM * height + form + generator.normal(scale=HEIGHT_STD_UM, size=height.shape)
    return Topography.from_maps(measured, intensity, pitch=PITCH_UM, height_std=HEIGHT_STD_UM)


def virtual_goniometry(*, step_deg: float = 1.0, surface: Surface | None = None, seed: int = 0) -> Goniometry:
    """Turn a light about a tilted plate and follow pixels along the axis of rotation.

    Parameters
    ----------
    step_deg
        Step of the light, from 90 degrees on the side of the reflection to 45 degrees on the other.
    surface
        The paint; None: that of the study.
    seed
        Of paint and noise.
    """
    angles = np.arange(90.0, -45.1, -step_deg)
    camera = reference_camera((PIXELS + 8, 8), **DSLR)
    plate = Plate(width=200.0, height=200.0, centre=(0.0, 0.0, _DISTANCE), tilt_deg=(TILT_DEG, 0.0))
    lamp = Light(name="b1", position=(0.0, 0.0, 0.0)).aimed(plate.front)
    paint = surface or study_paint(seed)
    clean = []
    for angle in angles:
        light = lamp.turned(angle + TILT_DEG, plate.front)
        clean.append(render(Scene(body=plate, lights=(light,), camera=camera, surface=paint)))
    gain = np.float32(0.97 * camera.full_scale / max(float(images.max()) for images in clean))
    frames = [
        record(images * gain, camera, (lamp,), seed=seed + number).values[0].astype(np.float64) - camera.black_level
        for number, images in enumerate(clean)
    ]
    rows = np.arange(4, 4 + PIXELS)
    return goniometry(angles, pixel_levels(frames, np.stack([np.full_like(rows, 4), rows], axis=1)))
