"""The paper's set-ups as virtual experiments: the sphere on its bench (Figs 2 and 3) and the flat specimen (Fig. 9).

The lamps of the sphere stand where their reflections fall on chosen pixels. That of the first covers area A4 while the
sphere is at 0 degrees and moves, with the middle of the sphere, by 181 px (14 degrees) to area A2; those of the others
stay clear of the areas and of each other. The flat specimen is turned under a light (section 2.3) and its height map is
read as by a confocal sensor (section 2.4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from measures import (
    Goniometry,
    MeasureArea,
    areas_along_x,
    detrend,
    goniometry,
    local_slope,
    paint_classes,
    pixel_levels,
    rms_slope,
    slope_uncertainty,
    wrinkle_spacing,
)
from rgbmidic import Calibration, Region
from rgbmidic.errors import InputError
from rgbmidic.illumination import IlluminationImages, separate
from rgbmidic.pipeline import Separation
from rgbmidic.tools.lab.virtual import (
    Camera,
    Light,
    Plate,
    Scene,
    Sphere,
    State,
    Surface,
    height_map,
    paper_scene,
    record,
    reference_camera,
    render,
    truth,
)

BENCHES = ("sequential", "bayer")
"""Two white lamps in succession before a monochrome camera, as in the paper; three colours in one Bayer shot. The lamps
of the latter before a camera with three sensors, the ideal, are "3-CCD"."""
SMALLEST = 448
"""Smallest frame (px) that holds the five areas with their margin."""
PITCH = 100.0
"""Distance (px) between the areas: A4 to A2 is the way of the reflection."""
MARGIN = 60.0
"""Least distance (px) of an area from the edge of the region."""
ROW = 180.0
"""Distance (px) of the areas above the middle of the frame; less in small frames."""
APART = 390.0
"""Distance (px) along y between the reflection in the areas and the others: over twice the paper's radius of 165."""
REGION = 0.55
"""Half the side of the measured square, in radii of the sphere: beyond, the surface turns away."""
BRIGHTEST = 0.97
"""Fraction of full scale that the brightest pixel of a series reaches, so that none saturates."""
LAMP = 700.0
"""Distance (mm) of the lamps from the surface."""
DSLR: dict[str, object] = {"kind": "monochrome", "bits": 14, "black_level": 0, "gain": 1.6, "read_noise": 12.0}
"""A 14-bit camera of the class of the paper's: 26,000 electrons at full scale."""
LENS: dict[str, object] = {"lateral_colour": 0.5}
"""A real lens: half a pixel of lateral colour at the corners from one coloured lamp to the next."""
CAMERAS: dict[str, dict[str, object]] = {"sequential": DSLR, "bayer": LENS, "3-CCD": {"kind": "rgb"} | LENS}
TILT_DEG = 15.0
"""Tilt of the flat specimen's normal against the camera's axis (degrees): light from as far beyond it is reflected."""
DISTANCE = 600.0
"""Distance (mm) of the flat specimen from the camera."""
PIXELS = 40
"""Pixels of the flat specimen that are followed, along the axis of rotation, as in Fig. 9."""
PITCH_UM = 5.0
"""Pitch (um) of the height map (paper, section 2.4)."""
HEIGHT_STD_UM = 0.1
"""Standard uncertainty (um) of a height that the paper reckons with."""


def study_paint(seed: int = 0) -> Surface:
    """The paint of `paper_scene`: wrinkles, relief and sharp lobe after the paper's Figs 9 to 11."""
    return paper_scene(size=64, seed=seed, exposure=1.0).surface


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A scene with what is measured on it."""

    name: str  # one of `CAMERAS`
    scene: Scene
    areas: tuple[MeasureArea, ...]  # A0 to A4
    half: float  # half the side (px) of the measured square, about the middle of the frame
    light: int  # index of the light whose reflection crosses the areas
    prefilter: str  # of the solves: none as in the paper, or what the Bayer mosaic needs
    seed: int = 0  # of the camera noise

    @classmethod
    def build(cls, name: str, size: int = 1024, *, surface: Surface | None = None, seed: int = 0) -> Bench:
        """The bench before a camera of `size` x `size` px, painted as `study_paint` unless `surface` is given."""
        if name not in CAMERAS:
            raise InputError(f"unknown scene {name!r}; allowed are {', '.join(CAMERAS)}")
        if size < SMALLEST:
            raise InputError(f"the frames must be at least {SMALLEST} px wide to hold the areas, not {size}")
        camera = reference_camera((size, size), **CAMERAS[name])
        body, middle = Sphere(), camera.centre[0]
        half = min(REGION * body.radius * camera.focal_px / body.front[2], size / 2 - 8)
        pitch = min(PITCH, (half - MARGIN - 25) / 2)
        areas = areas_along_x((middle - 2 * pitch, middle - min(ROW, half - 140)), pitch=pitch)
        first, row = areas[-1].centre, areas[-1].centre[1] + APART
        if name == "sequential":
            spots = {"b1": first, "b2": (middle + 90, row)}
        else:
            spots = {"red": (middle - 130, row), "green": first, "blue": (middle + 200, row)}
        lights = tuple(
            Light(name=light, position=lamp_for_reflection(body, camera, spot)).aimed(body.front)
            for light, spot in spots.items()
        )
        return cls(
            name=name,
            scene=Scene(body=body, lights=lights, camera=camera, surface=surface or study_paint(seed)),
            areas=areas,
            half=half,
            light=list(spots.values()).index(first),
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
        scale = self.scene.camera.focal_px / body.front[2]
        return -body.radius * math.sin(math.radians(angle_deg)) * scale

    def render(self, angle_deg: float) -> np.ndarray:
        """Noise-free image of each light alone, shape (k, H, W)."""
        return render(self.scene, self.state(angle_deg))

    def truth(self, angle_deg: float) -> np.ndarray:
        """Exact displacement (2, H, W) in px of the points seen at 0 degrees."""
        return truth(self.scene, self.state(angle_deg))

    def exposure_gain(self, brightest: float) -> np.float32:
        """Factor on the exposure that brings a brightest level just below saturation."""
        return np.float32(BRIGHTEST * self.scene.camera.full_scale / brightest)

    def brightest(self, images: np.ndarray) -> float:
        """Largest grey level that the camera would see in any shot of a state."""
        if self.name == "sequential":
            return float(images.max())
        mixing = self.scene.camera.mixing(self.scene.lights).astype(np.float32)
        return max(float(np.einsum("l,lyx->yx", row, images).max()) for row in mixing)

    def photograph(self, images: np.ndarray, shot: int, demosaic: str = "malvar") -> IlluminationImages:
        """Illumination images from the shots of a state: one per light, or one mosaic of all, to be demosaiced.

        With ``"auto"`` they lie where the lens puts them and have a registration, as our solver takes them; else they
        are brought onto the first light's grid, as the paper's methods need them.
        `images` are noise-free and exposed, (k, H, W); every number of a shot has its own noise.
        """
        camera, lights = self.scene.camera, self.scene.lights
        names = tuple(light.name for light in lights)
        shots = [(name,) for name in names] if self.name == "sequential" else [names]
        frames = tuple(
            record(
                images,
                camera,
                lights,
                seed=int(np.random.SeedSequence([self.seed, shot, number]).generate_state(1)[0]),
                shining=on,
            )
            for number, on in enumerate(shots)
        )
        if self.name == "sequential":
            return replace(Separation()(frames), names=names)
        calibration = Calibration(
            crosstalk=camera.true_crosstalk(lights),
            noise=camera.noise,
            registration=camera.true_registration(lights),
        )
        if demosaic != "auto":
            return separate(frames[0], calibration, demosaic).on_first_light()
        return Separation(calibration=calibration)(frames)


def lamp_for_reflection(
    body: Sphere, camera: Camera, pixel: tuple[float, float], distance: float = LAMP
) -> tuple[float, float, float]:
    """Where a lamp must stand for its reflection on a sphere to be seen at a pixel (x, y); `distance` mm from there."""
    ray = np.array([*((np.array(pixel) - camera.centre) / camera.focal_px), 1])
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


def virtual_goniometry(seed: int = 0) -> Goniometry:
    """Turn a light about the tilted plate, from 90 degrees on the side of the reflection to 45 on the other, and follow
    pixels along the axis of rotation."""
    angles = np.arange(90.0, -46.0, -1.0)
    camera = reference_camera((PIXELS + 8, 8), **DSLR)
    plate = Plate(width=200.0, height=200.0, centre=(0.0, 0.0, DISTANCE), tilt_deg=(TILT_DEG, 0.0))
    lamp = Light(name="b1", position=(0.0, 0.0, 0.0)).aimed(plate.front)
    scene = Scene(body=plate, lights=(lamp,), camera=camera, surface=study_paint(seed))
    clean = [render(replace(scene, lights=(lamp.turned(angle + TILT_DEG, plate.front),))) for angle in angles]
    gain = np.float32(BRIGHTEST * camera.full_scale / max(float(images.max()) for images in clean))
    frames = [record(images * gain, camera, (lamp,), seed=seed + n).values[0] for n, images in enumerate(clean)]
    rows = np.arange(4, 4 + PIXELS)
    return goniometry(angles, pixel_levels(frames, np.stack([np.full_like(rows, 4), rows], axis=1)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Topography:
    """The analysis of a height map."""

    height: np.ndarray  # um, without form, (H, W)
    intensity: np.ndarray  # diffuse reflectance, (H, W)
    slope: np.ndarray  # degrees, (H, W)
    pitch: float  # um
    slope_std: float  # standard uncertainty of the slope, degrees
    white_deg: float  # root mean square slope of the white paint
    black_deg: float
    spacing: tuple[float, float]  # distance between wrinkles and its standard uncertainty, um


def virtual_topography(seed: int = 0) -> Topography:
    """Measure the study's paint on 3 x 3 mm (the paper has 10 x 10) with a virtual sensor: noise, a bent carrier."""
    paint = study_paint(seed)
    height, cover = height_map(paint, size=3.0, pitch=PITCH_UM / 1000)
    generator = np.random.default_rng(seed)
    x, y = np.meshgrid(*(np.linspace(-1, 1, n) for n in height.shape[::-1]))
    form = 20 * x + 8 * y + 15 * x**2 - 6 * x * y**3 + 4 * y**4
    intensity = (1 - cover) * paint.white.albedo + cover * paint.black.albedo
    intensity = intensity + generator.normal(scale=0.02, size=cover.shape)
    measured = 1000 * height + form + generator.normal(scale=HEIGHT_STD_UM, size=height.shape)
    flat, white = detrend(measured), paint_classes(intensity)
    return Topography(
        height=flat,
        intensity=intensity,
        slope=local_slope(flat, PITCH_UM),
        pitch=PITCH_UM,
        slope_std=slope_uncertainty(HEIGHT_STD_UM, PITCH_UM),
        white_deg=rms_slope(flat, white, PITCH_UM, height_std=HEIGHT_STD_UM),
        black_deg=rms_slope(flat, ~white, PITCH_UM, height_std=HEIGHT_STD_UM),
        spacing=wrinkle_spacing(flat, PITCH_UM, longest=12 * PITCH_UM),
    )
