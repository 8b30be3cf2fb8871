"""What each demosaicing method costs in displacement error, with and without reflections, on scenes with exact truth.

    python benchmarks/demosaicing.py [--study main] [--seeds 11 12 13] [--wrinkles 0.025 0.05 0.1] [--plates-only]
    python benchmarks/demosaicing.py --study shifts --wrinkles 0.05 --seeds 31 --only "0.25 px" "0.5 px"
    python benchmarks/demosaicing.py --study phases|blur|aberration|coloured
    python benchmarks/demosaicing.py --study speed

Scenes of `rgbmidic.lab.virtual`: RGGB, 12 bit, 4 e-/DN, read noise 12 e-, crosstalk 10 to 16 % between neighbours,
specular peak 1.5 times an ideal white. Three lights are solved together with the true crosstalk, TRI3 of 25 px started
within half a pixel of the truth; errors over the pixels of the field without its border element. Wrinkles of the paint
25 um apart give a smooth reflection, 50 um one that sparkles at the scale of the pixel, 100 um one with coarser spots.
Each is traced with as many rays as its reflection needs.

The 3-CCD camera is the ideal: all three colours at every pixel, the same solve. One sample instead of three costs a
factor of sqrt(3) in noise; what is above that is the demosaicing's doing, and each cell ends with the ratio to it. The
studies vary one thing at a time: the
shift, the Bayer phase, the lens blur, the lens's lateral colour aberration (calibrated, and undone after the
separation), and a specimen whose colours show partly or wholly different textures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from rgbmidic._kernels.threads import threads
from rgbmidic.fields import at_pixels
from rgbmidic.illumination.crosstalk import align, unmix
from rgbmidic.illumination.images import IlluminationImages, normalise
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.registration import Registration
from rgbmidic.illumination.separation import DEMOSAICERS, separate
from rgbmidic.lab.virtual import Scene, State, plate_scene, record, render, sphere_scene, strained_plate, truth, turned
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import correlate
from rgbmidic.scene.camera import PIXEL
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.threshold import threshold_weights

TILT = (float(-np.degrees(0.15)), 0.0)
"""The plate leans towards green's lamp."""
MASKED_ABOVE = 0.4
"""Blurred grey level, as a share of the full scale, above which the paper's masks exclude a light."""
ABERRATION = (-2e-4, 0.0, 3e-4)


@dataclass(frozen=True)
class Case:
    """A pair of states. `coloured` is the share of each light's contrast that no other light shows."""

    name: str
    scene: Callable[..., Scene]
    state: State
    size: int
    is_plate: bool = True
    options: dict[str, Any] = field(default_factory=dict)
    coloured: float = 0.0

    def called(self, name: str, **changes: Any) -> Case:
        """The same with other options of the scene (or `coloured`) and something added to its name."""
        coloured = changes.pop("coloured", self.coloured)
        return replace(self, name=f"{self.name}, {name}", options=self.options | changes, coloured=coloured)


def _glaring(**options: Any) -> Scene:
    return plate_scene(gloss=1.5, glare="green", tilt_deg=TILT, **options)


def _mat(**options: Any) -> Scene:
    return plate_scene(tilt_deg=TILT, **options)


GLARING = Case("plate in green's reflection", _glaring, strained_plate(), 512)
MAT = Case("plate without reflection", _mat, strained_plate(), 512)
SPHERES = [Case(f"sphere {a:g}°", sphere_scene, turned(a), 640, is_plate=False) for a in (0.33, 1, 2, 4, 8)]
BASE = [GLARING, SPHERES[1], SPHERES[3], MAT]
SHIFTS = [
    replace(
        case, name=f"{case.name}, shift {n / 8:g} px", state=strained_plate(shift_px=(n / 8, 0.3 * n / 8), strain=0)
    )
    for case in (GLARING, MAT)
    for n in range(9)
]
STUDIES = {
    "shifts": SHIFTS,
    "main": [GLARING, *SPHERES, MAT],
    "phases": [case.called(cfa, cfa=cfa) for case in BASE for cfa in ("RGGB", "BGGR", "GRBG", "GBRG")],
    "blur": [case.called(f"blur {blur:g}", lens_blur=blur) for case in BASE for blur in (0.3, 0.45, 0.6, 0.8)],
    "aberration": [case.called("aberration", aberration=ABERRATION) for case in [GLARING, *SPHERES, MAT]],
    "coloured": [
        case.called(f"{share:.0%} coloured", coloured=share) for case in (MAT, GLARING) for share in (0.1, 0.3, 0.6, 1)
    ],
}


@dataclass(frozen=True)
class Contender:
    """A way from the raw frame to the solve; a method that rgbmidic does not have is one of colour-demosaicing."""

    name: str
    method: str
    prefilter: str = "binomial"
    normalise: float | None = 10.0
    masks: bool = False
    one_image: bool = False

    def lights(self, frame: Any, scene: Scene) -> IlluminationImages:
        """Illumination images of a recorded frame."""
        crosstalk = scene.camera.true_crosstalk(scene.lights)
        linear = linearise(frame, scene.camera.noise)
        if isinstance(linear, LinearChannels):
            return unmix(linear, crosstalk)
        assert isinstance(linear, LinearMosaic)
        if self.method in DEMOSAICERS:
            return separate(linear, crosstalk, self.method)
        import colour_demosaicing

        demosaicer = getattr(colour_demosaicing, f"demosaicing_CFA_Bayer_{self.method}")
        values = np.moveaxis(demosaicer(linear.values, linear.cfa), -1, 0)
        valid = np.broadcast_to(~linear.saturated, values.shape)
        return unmix(LinearChannels(values=values, valid=valid, full_scale=linear.full_scale), crosstalk)


CONTENDERS = [
    Contender("Malvar + masks, no prefilter (the paper)", "malvar", prefilter="none", normalise=None, masks=True),
    Contender("bilinear", "bilinear"),
    Contender("Malvar", "malvar"),
    Contender("Menon", "Menon2007"),
    Contender("normalised mosaic", "normalised"),
    Contender("mean of the lights, as one image", "reflection-aware", normalise=None, one_image=True),
    Contender("reflection-aware (default)", "reflection-aware"),
    Contender("ideal 3-CCD", "3-CCD"),
]


@dataclass(frozen=True)
class Error:
    """Displacement error over the field, px, and of the lights' images, as a share of their mean."""

    bias: tuple[float, float]
    scatter: float
    rms: float
    unmeasured: float
    image: float

    @classmethod
    def mean(cls, errors: list[Error]) -> Error:
        """Over several seeds: biases averaged, the rest as root mean square."""
        x, y = np.mean([error.bias for error in errors], axis=0)
        scatter, rms, image = np.sqrt(np.mean([(e.scatter**2, e.rms**2, e.image**2) for e in errors], axis=0))
        missing = max(e.unmeasured for e in errors)
        return cls((float(x), float(y)), float(scatter), float(rms), missing, float(image))

    def size(self, case: Case) -> float:
        """What a case is judged by: scatter for plates, rms for spheres."""
        return self.scatter if case.is_plate else self.rms

    def text(self, case: Case, ideal: float) -> str:
        """As in the table: bias x/y, scatter for plates, rms for spheres; over the ideal."""
        flag = "" if self.unmeasured < 0.001 else f" ({self.unmeasured:.1%} not measured)"
        if case.coloured:
            flag += f"; image {self.image:.1%}"
        bias = f"{self.bias[0]:+.4f}/{self.bias[1]:+.4f}, " if case.is_plate else ""
        return f"{bias}{self.size(case):.4f}, {self.size(case) / ideal:.2f}{flag}"


def painted(scene: Scene, wrinkles: float) -> Scene:
    """The scene with paint whose wrinkles have this spacing in mm."""
    white, black = (replace(finish, spacing=wrinkles) for finish in (scene.surface.white, scene.surface.black))
    return replace(scene, surface=replace(scene.surface, white=white, black=black))


def coloured_images(scene: Scene, state: State | None, share: float) -> Any:
    """The lights' images; a `share` of each light's variance comes from a spray of its own."""
    images = render(scene, state)
    if share == 0:
        return images
    for light in range(len(images)):
        own = replace(scene, surface=replace(scene.surface, seed=scene.surface.seed + 1000 * (light + 1)))
        other = render(own, state)[light]
        mean = float(images[light].mean())
        images[light] = mean + (1 - share) ** 0.5 * (images[light] - mean) + share**0.5 * (other - mean)
    return np.maximum(images, 0)


@cache
def rendered(study: str, index: int, wrinkles: float, seed: int, speckle: float) -> tuple[Scene, Any, Any, FloatArray]:
    """Scene, lights in both states without noise, and truth (2, H, W); rendered once for all contenders."""
    case = STUDIES[study][index]
    scene = painted(case.scene(size=case.size, seed=seed, droplet=speckle * PIXEL, **case.options), wrinkles)
    images = [coloured_images(scene, state, case.coloured) for state in (None, case.state)]
    # the first light's pixels are the frame of reference
    zoom = 1 + scene.lights[0].magnification
    (x, y), (rows, columns) = scene.camera.centre, scene.camera.shape
    pixels = np.meshgrid((np.arange(columns) - x) / zoom + x, (np.arange(rows) - y) / zoom + y)
    return scene, images[0], images[1], zoom * truth(scene, case.state, pixels=(pixels[0], pixels[1]))


def registered(images: IlluminationImages, scene: Scene) -> IlluminationImages:
    """The lights aligned as a perfect calibration would."""
    zoom = np.array([1 + light.magnification for light in scene.lights])
    identity = Registration.identity(images.names, images.shape)
    parameters = identity.parameters.copy()
    parameters[:, 3] = zoom / zoom[0] - 1
    return align(images, replace(identity, parameters=parameters))


def together(images: IlluminationImages) -> FloatImage:
    """The mean (1, H, W) of the lights, each divided by its local mean."""
    return np.asarray(normalise(images.values, 10.0, images.full_scale).mean(axis=0, keepdims=True))


def measured(study: str, index: int, contender: Contender, *, wrinkles: float, seed: int, speckle: float) -> Error:
    """Error of one contender on one case."""
    scene, first, second, exact = rendered(study, index, wrinkles, seed, speckle)
    camera = replace(scene.camera, kind="rgb" if contender.method == "3-CCD" else "bayer")
    recorded = replace(scene, camera=camera)
    frames = [record(i, camera, recorded.lights, seed=1000 * seed + n) for n, i in enumerate((first, second))]
    separated = [contender.lights(frame, recorded) for frame in frames]
    image = (separated[0].values - first)[:, 16:-16, 16:-16] / first.mean(axis=(1, 2), keepdims=True)
    reference, deformed = (registered(images, scene) for images in separated)
    f, g = (together(images) if contender.one_image else images.values for images in (reference, deformed))
    size = STUDIES[study][index].size
    margin = (size - 1 - (size - 17) // 25 * 25) // 2
    far = margin + (size - 17) // 25 * 25
    region = Region.from_rectangle((margin, margin, far, far), (size, size))
    nodes = Tri3Mesh.from_region(region, 25).nodes
    start = np.stack([map_coordinates(one, nodes[:, ::-1].T, order=1) for one in exact], axis=1) + 0.2
    weights = [threshold_weights(i, threshold=MASKED_ABOVE) if contender.masks else None for i in (reference, deformed)]
    solution = correlate(
        f,
        g,
        region=region,
        initial=start,
        weights=weights[0],
        deformed_weights=weights[1],
        prefilter=contender.prefilter,
        normalise=contender.normalise,
        statistics=not contender.masks,
    )
    mesh, inside = Tri3Mesh(nodes=solution.nodes, elements=solution.elements), slice(margin + 25, far - 24)
    error = (at_pixels(mesh, solution.displacement, (size, size)) - exact)[:, inside, inside].reshape(2, -1)
    bias = np.nanmean(error, axis=1)
    scatter, rms = np.sqrt(np.nanmean((error - bias[:, None]) ** 2)), np.sqrt(np.nanmean(error**2))
    missing, of_image = float(np.isnan(error).any(axis=0).mean()), float(np.sqrt(np.nanmean(image**2)))
    return Error((float(bias[0]), float(bias[1])), float(scatter), float(rms), missing, of_image)


def table(
    study: str, wrinkles: float, seeds: list[int], speckle: float, contenders: list[Contender], only: list[str]
) -> None:
    """Print the table of one study, paint and speckle, of the cases with a part of their name among `only`."""
    print(f"\n{study}: wrinkles {1000 * wrinkles:g} um, speckle {speckle:g} px, seeds {seeds}\n")
    print("| scene | " + " | ".join(c.name for c in contenders) + " | 3-CCD × √3 |")
    print("|---" * (len(contenders) + 2) + "|")
    for index, case in enumerate(STUDIES[study]):
        if not any(part in case.name for part in only):
            continue
        row = [
            Error.mean([measured(study, index, c, wrinkles=wrinkles, seed=seed, speckle=speckle) for seed in seeds])
            for c in contenders
        ]
        ideal = row[-1].size(case) * 3**0.5
        cells = [error.text(case, ideal) for error in row]
        print(f"| {case.name} | " + " | ".join(cells) + f" | {ideal:.4f} |", flush=True)
        rendered.cache_clear()


def speed(sizes: tuple[int, ...] = (1024, 2048), repeats: int = 5) -> None:
    """Print the time per pixel from a linearised frame to the lights (least of several runs)."""
    patch = plate_scene(size=512, seed=3)
    frame = record(render(patch), patch.camera, patch.lights, seed=0)
    small = linearise(frame, patch.camera.noise)
    assert isinstance(small, LinearMosaic)
    crosstalk = patch.camera.true_crosstalk(patch.lights)
    texture = separate(small, crosstalk).texture
    ways: dict[str, Callable[[LinearMosaic], Any]] = {
        "reflection-aware, texture given": lambda mosaic: separate(mosaic, crosstalk, texture=texture),
        "reflection-aware, texture learnt": lambda mosaic: separate(mosaic, crosstalk),
        "Malvar": lambda mosaic: separate(mosaic, crosstalk, "malvar"),
    }
    print(f"\nns per pixel, {threads()} threads\n")
    print("| size | " + " | ".join(ways) + " |\n" + "|---" * (len(ways) + 1) + "|")
    for size in sizes:
        copies = (size // 512, size // 512)
        mosaic = replace(small, values=np.tile(small.values, copies), saturated=np.tile(small.saturated, copies))
        best = []
        for way in ways.values():
            way(mosaic)
            runs = []
            for _ in range(repeats):
                start = time.perf_counter()
                way(mosaic)
                runs.append(time.perf_counter() - start)
            best.append(min(runs) / size**2 * 1e9)
        print(f"| {size} | " + " | ".join(f"{ns:.0f}" for ns in best) + " |", flush=True)


def main() -> None:
    """Read the command line, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--study", choices=(*STUDIES, "speed"), default="main")
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    parser.add_argument("--wrinkles", type=float, nargs="+", default=[0.025], help="their spacing in mm")
    parser.add_argument("--speckles", type=float, nargs="+", default=[4.2])
    parser.add_argument("--plates-only", action="store_true", help="leave the spheres out")
    parser.add_argument("--methods", nargs="+", help="of CONTENDERS; the ideal 3-CCD is always there")
    parser.add_argument("--only", nargs="+", default=[""], help="cases by a part of their name")
    arguments = parser.parse_args()
    if arguments.study == "speed":
        speed()
        return
    if arguments.plates_only:
        STUDIES[arguments.study] = [case for case in STUDIES[arguments.study] if case.is_plate]
    chosen = [c for c in CONTENDERS if not arguments.methods or c.method in (*arguments.methods, "3-CCD")]
    for wrinkles, speckle in product(arguments.wrinkles, arguments.speckles):
        table(arguments.study, wrinkles, arguments.seeds, speckle, chosen, arguments.only)


if __name__ == "__main__":
    main()
