"""The paper's optical bench (Figs 2 and 3) as a virtual experiment: the sphere, its lamps, the areas A0 to A4.

The lamps stand where their reflections fall on chosen pixels. That of the first covers area A4 while the sphere is at
0 degrees and moves, with the middle of the sphere, by 181 px (14 degrees) to area A2; those of the others stay clear of
the areas and of each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.illumination.images import IlluminationImages
from rgbmidic.illumination.linearise import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.separate import separate
from rgbmidic.lab.study.perturbation import Area, areas_along_x
from rgbmidic.lab.virtual.recording import record
from rgbmidic.lab.virtual.rendering import render
from rgbmidic.lab.virtual.scenes import paper_scene
from rgbmidic.mesh import Region
from rgbmidic.scene.camera import Camera, reference_camera
from rgbmidic.scene.light import Light, Vector
from rgbmidic.scene.projection import truth
from rgbmidic.scene.scene import Scene, Sphere, State
from rgbmidic.scene.surface import Surface
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["BENCHES", "SMALLEST", "Bench", "lamp_for_reflection", "study_paint"]


BENCHES = ("sequential", "bayer")
"""Two white lamps in succession before a monochrome camera, as in the paper; three colours in one Bayer shot."""
SMALLEST = 448
"""Smallest frame (px) that holds the five areas with their margin."""
_PITCH = 100.0
"""Distance (px) between the areas: A4 to A2 is the way of the reflection."""
_MARGIN = 60.0
"""Least distance (px) of an area from the edge of the region."""
_ROW = 180.0
"""Distance (px) of the areas above the middle of the frame; half as much and more in small frames."""
_APART = 390.0
"""Distance (px) along y between the reflection in the areas and the others: over twice the paper's radius of 165."""
_REGION = 0.55
"""Half the side of the measured square, in radii of the sphere: beyond, the surface turns away."""
_BRIGHTEST = 0.97
"""Fraction of full scale that the brightest pixel of a series reaches, so that none saturates."""
_LAMP = 700.0
"""Distance (mm) of the lamps from the surface."""
DSLR: dict[str, object] = {"kind": "monochrome", "bits": 14, "black_level": 0, "gain": 1.6, "read_noise": 12.0}
"""A 14-bit camera of the class of the paper's: 26,000 electrons at full scale."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A scene with what is measured on it.

    Attributes
    ----------
    name
        One of `BENCHES`.
    scene
        Sphere, lamps, camera and paint. The light whose reflection crosses the areas is `light`.
    areas
        A0 to A4.
    half
        Half the side (px) of the measured square, about the middle of the frame.
    light
        Index of the light of the methods with one light.
    prefilter
        Of the solves: none as in the paper, or what the Bayer mosaic needs.
    seed
        Of the camera noise.
    """

    name: str
    scene: Scene
    areas: tuple[Area, ...]
    half: float
    light: int
    prefilter: str
    seed: int = 0

    @classmethod
    def build(cls, name: str, size: int = 1024, *, surface: Surface | None = None, seed: int = 0) -> Bench:
        """The bench before a camera of `size` x `size` px.

        Parameters
        ----------
        name
            One of `BENCHES`.
        surface
            The paint; None: that of `rgbmidic.lab.virtual.paper_scene`.
        seed
            Of paint and noise.

        Raises
        ------
        InputError
            Unknown name, or a frame that does not hold the areas.
        """
        if name not in BENCHES:
            raise InputError(f"unknown scene {name!r}; allowed are {', '.join(BENCHES)}")
        if size < SMALLEST:
            raise InputError(f"the frames must be at least {SMALLEST} px wide to hold the areas, not {size}")
        settings = DSLR if name == "sequential" else {}
        camera = reference_camera((size, size), **settings)
        body, middle = Sphere(), camera.centre[0]
        half = min(_REGION * body.radius * camera.focal_px / body.front[2], size / 2 - 8)
        pitch = min(_PITCH, (half - _MARGIN - 25) / 2)
        row = middle - min(_ROW, half - 140)
        areas = areas_along_x((middle - 2 * pitch, row), pitch=pitch)
        spots = _spots(name, areas[-1].centre, middle)
        front = body.front
        lights = tuple(
            Light(name=light, position=lamp_for_reflection(body, camera, spot)).aimed(front)
            for light, spot in spots.items()
        )
        return cls(
            name=name,
            scene=Scene(body=body, lights=lights, camera=camera, surface=surface or study_paint(seed)),
            areas=areas,
            half=half,
            light=next(i for i, spot in enumerate(spots.values()) if spot == areas[-1].centre),
            prefilter="none" if name == "sequential" else "binomial",
            seed=seed,
        )

    @property
    def region(self) -> Region:
        """The measured square."""
        x, y = self.scene.camera.centre
        corners = (x - self.half, y - self.half, x + self.half, y + self.half)
        return Region.from_rectangle(corners, self.scene.camera.shape)

    def state(self, angle_deg: float) -> State:
        """The sphere turned so that the reflections move to the left."""
        return State(angle_deg=-angle_deg)

    def reflection_shift(self, angle_deg: float) -> float:
        """Way (px) of the reflections along x: that of the sphere's middle, which turns about the front point."""
        body = self.scene.body
        assert isinstance(body, Sphere)
        scale = self.scene.camera.focal_px / body.front[2]
        return -body.radius * math.sin(math.radians(angle_deg)) * scale

    def render(self, angle_deg: float) -> FloatImage:
        """What each light alone gives, without noise, shape (k, H, W)."""
        return render(self.scene, self.state(angle_deg))

    def exposure_gain(self, brightest: float) -> float:
        """Factor on the exposure that brings a brightest level just below saturation."""
        return _BRIGHTEST * self.scene.camera.full_scale / brightest

    def brightest(self, images: FloatImage) -> float:
        """Largest grey level that the camera would see in any shot of a state."""
        if self.name == "sequential":
            return float(images.max())
        mixing = self.scene.camera.mixing(self.scene.lights).astype(np.float32)
        return max(float(np.einsum("l,lyx->yx", row, images).max()) for row in mixing)

    def photograph(self, images: FloatImage, shot: int, demosaic: str = "malvar") -> IlluminationImages:
        """Illumination images from noisy shots of a state: one per light, or one mosaic of all.

        Parameters
        ----------
        images
            Noise-free images (k, H, W), exposed.
        shot
            Number of the state; every one has its own noise.
        demosaic
            How a Bayer mosaic is separated, see `rgbmidic.illumination.separate.separate`.
        """
        camera, lights = self.scene.camera, self.scene.lights
        if self.name == "bayer":
            mosaic = linearise(record(images, camera, lights, seed=self._noise_seed(shot, 0)), camera.noise)
            assert isinstance(mosaic, LinearMosaic)
            return separate(mosaic, camera.true_crosstalk(lights), demosaic)
        frames = [
            linearise(record(images, camera, lights, seed=self._noise_seed(shot, i), on=(light.name,)))
            for i, light in enumerate(lights)
        ]
        return IlluminationImages(
            values=np.concatenate([frame.values for frame in frames]),
            valid=np.concatenate([frame.valid for frame in frames if isinstance(frame, LinearChannels)]),
            names=tuple(light.name for light in lights),
            full_scale=camera.full_scale,
        )

    def truth(self, angle_deg: float) -> FloatArray:
        """Exact displacement (2, H, W) in px of the points seen at 0 degrees."""
        return truth(self.scene, self.state(angle_deg))

    def _noise_seed(self, shot: int, light: int) -> int:
        return int(np.random.SeedSequence([self.seed, shot, light]).generate_state(1)[0])


def lamp_for_reflection(body: Sphere, camera: Camera, pixel: tuple[float, float], distance: float = _LAMP) -> Vector:
    """Where a lamp must stand for its reflection on a sphere to be seen at a pixel (x, y); `distance` mm from there.

    Raises
    ------
    InputError
        The sphere is not seen at that pixel.
    """
    ray = np.array(
        [(pixel[0] - camera.centre[0]) / camera.focal_px, (pixel[1] - camera.centre[1]) / camera.focal_px, 1]
    )
    view = -ray / np.linalg.norm(ray)
    centre = np.array(body.centre)
    along = -float(view @ centre)
    under_root = along**2 - float(centre @ centre) + body.radius**2
    if under_root < 0:
        raise InputError(f"the sphere is not seen at pixel {pixel}")
    point = -(along - np.sqrt(under_root)) * view
    normal = (point - centre) / body.radius
    x, y, z = (point + distance * (2 * (normal @ view) * normal - view)).tolist()
    return x, y, z


def _spots(name: str, first: tuple[float, float], middle: float) -> dict[str, tuple[float, float]]:
    """Pixels on which the reflections of the lamps fall at 0 degrees."""
    row = first[1] + _APART
    if name == "sequential":
        return {"b1": first, "b2": (middle + 90, row)}
    return {"red": (middle - 130, row), "green": first, "blue": (middle + 200, row)}


def study_paint(seed: int = 0) -> Surface:
    """The paint of `paper_scene`: wrinkles, relief and sharp lobe after the paper's Figs 9 to 11."""
    return paper_scene(size=64, seed=seed, exposure=1.0).surface
