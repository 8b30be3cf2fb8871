"""What each way from a raw frame to the lights costs in displacement error, on scenes with exact truth.

Scenes of `rgbmidic.tools.lab.virtual`: RGGB, 12 bit, 4 e-/DN, read noise 12 e-, specular peak 1.5 times an ideal white,
a speckle of 4.2 px. Three lights are solved together with the true crosstalk, TRI3 of 25 px started near the truth;
errors over the pixels of the field without its border element. Wrinkles of the paint 25 um apart give a smooth
reflection, 100 um one that sparkles in spots. Each is traced with as many rays as its reflection needs.

The 3-CCD camera is the ideal: all three colours at every pixel, the same solve. One sample instead of three costs a
factor of sqrt(3) in noise; what is above that is the demosaicing's doing.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from rgbmidic import read_frame
from rgbmidic.fields import at_nodes, at_pixels
from rgbmidic.illumination.crosstalk import Crosstalk, unmix
from rgbmidic.illumination.images import IlluminationImages, local_mean
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, NoiseModel, linearise
from rgbmidic.illumination.separation import separate
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import correlate
from rgbmidic.tools.lab.virtual import (
    Scene,
    State,
    plate_scene,
    record,
    render,
    sphere_scene,
    strained_plate,
    truth,
    turned,
)
from rgbmidic.tools.scene.camera import PIXEL
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.threshold import threshold_weights

from . import ROOT
from .tables import MissingDataError, table

TILT = (float(-np.degrees(0.15)), 0.0)
"""The plate leans towards green's lamp."""
MASKED_ABOVE = 0.4
"""Blurred grey level, as a fraction of the full scale, above which binary masks exclude a light."""
MEASURED = np.array([[1, 0.15, 0.05], [0.12, 1, 0.33], [0.02, 0.28, 1]])
"""A crosstalk with as much between green and blue as measured cameras have under LEDs of 630, 525 and 465 nm."""
MARGIN = 25
"""Border (px) of the field whose errors do not count: an element."""


def shifted(pixels: float) -> State:
    """A plate that only shifts, by this along x and by .3 of it along y."""
    return strained_plate(shift_px=(pixels, 0.3 * pixels), strain=0)


@dataclass(frozen=True)
class Case:
    """A body in two states. `coloured` is the fraction of each light's contrast that no other light shows."""

    name: str
    scene: Scene
    state: State
    coloured: float = 0.0

    @classmethod
    def of(cls, name: str, *, wrinkles: float = 0.025, speckle: float = 4.2, seed: int = 41, **options: Any) -> Case:
        """A plate ("reflection" or "mat") that shifts, or a sphere that turns, by the last word of the name."""
        amount = float(name.split()[-2])
        given: dict[str, Any] = {"seed": seed, "droplet": speckle * PIXEL, **options}
        if name.startswith("sphere"):
            scene = sphere_scene(**{"size": 384} | given)
        elif name.startswith("mat"):
            scene = plate_scene(**{"size": 256, "tilt_deg": TILT} | given)
        else:
            scene = plate_scene(**{"size": 320, "gloss": 1.5, "glare": "green", "tilt_deg": TILT} | given)
        return cls(name, painted(scene, wrinkles), turned(amount) if name.startswith("sphere") else shifted(amount))

    @property
    def is_plate(self) -> bool:
        """Whether it is judged by its scatter, and not by its rms error."""
        return not self.name.startswith("sphere")

    def photographs(self) -> tuple[list[FloatImage], FloatArray]:
        """Lights (k, H, W) of both states without noise, and the truth (2, H, W)."""
        return [coloured(self.scene, state, self.coloured) for state in (None, self.state)], truth(
            self.scene, self.state
        )


def painted(scene: Scene, wrinkles: float) -> Scene:
    """The scene with paint whose wrinkles have this spacing in mm."""
    white, black = (replace(finish, spacing=wrinkles) for finish in (scene.surface.white, scene.surface.black))
    return replace(scene, surface=replace(scene.surface, white=white, black=black))


def coloured(scene: Scene, state: State | None, fraction: float) -> FloatImage:
    """The lights' images; a `fraction` of each light's variance comes from a spray of its own."""
    images = render(scene, state)
    for light in range(len(images) if fraction else 0):
        own = replace(scene, surface=replace(scene.surface, seed=scene.surface.seed + 1000 * (light + 1)))
        other = render(own, state)[light]
        mean = images[light].mean()
        images[light] = mean + (1 - fraction) ** 0.5 * (images[light] - mean) + fraction**0.5 * (other - mean)
    return np.maximum(images, 0)


@dataclass(frozen=True)
class Contender:
    """A way from the raw frame to the solve, by our solver."""

    name: str
    method: str
    prefilter: str = "binomial"
    brightness: float | str = "auto"
    masks: bool = False
    one_image: bool = False


CONTENDERS = [
    Contender("masks without prefilter", "malvar", prefilter="none", brightness="none", masks=True),
    Contender("Malvar", "malvar"),
    Contender("normalised mosaic", "normalised"),
    Contender("mean of the lights", "auto", one_image=True),
    Contender("default", "auto"),
    Contender("3-CCD", "3-CCD"),
]
NAMED = {contender.name: contender for contender in CONTENDERS}


@dataclass(frozen=True)
class Error:
    """Displacement error over the field, px; of its nodes over stated; of the lights' images over their mean."""

    bias: float
    scatter: float
    rms: float
    ratio: float
    image: float = float("nan")

    @classmethod
    def of(cls, found: Any, exact: FloatArray, image: float = float("nan")) -> Error:
        """Of a solution."""
        mesh = Tri3Mesh(nodes=found.nodes, elements=found.elements)
        low, high = found.nodes.min(axis=0) + MARGIN, found.nodes.max(axis=0) - MARGIN
        (left, top), (right, bottom) = np.ceil(low).astype(int), high.astype(int) + 1
        error = (at_pixels(mesh, found.displacement, exact.shape[1:]) - exact)[:, top:bottom, left:right]
        bias = np.nanmean(error, axis=(1, 2))
        inner = ((found.nodes >= low) & (found.nodes <= high)).all(axis=1)
        relative = ((found.displacement - at_nodes(exact, found.nodes)) / found.displacement_std)[inner]
        scatter = np.sqrt(np.nanmean((error - bias[:, None, None]) ** 2))
        rms, ratio = (float(np.sqrt(np.nanmean(part**2))) for part in (error, relative))
        return cls(float(bias[0]), float(scatter), rms, ratio, image)


def solved(contender: Contender, pair: list[IlluminationImages], exact: FloatArray, region: Any) -> Any:
    """Solution of a pair of separated states; the search starts near the truth where it is given by a renderer."""
    f, g = (together(images) if contender.one_image else images.values for images in pair)
    nodes = Tri3Mesh.from_region(Region.from_rectangle(region, exact.shape[1:]), 25).nodes
    start = np.stack([map_coordinates(one, nodes[:, ::-1].T, order=1) for one in exact], axis=1) + 0.2
    weights = [threshold_weights(i, threshold=MASKED_ABOVE) if contender.masks else None for i in pair]
    return correlate(
        f,
        g,
        region=region,
        initial=start,
        weights=weights[0],
        deformed_weights=weights[1],
        prefilter=contender.prefilter,
        brightness=contender.brightness,
        statistics=not contender.masks,
    )


def together(images: IlluminationImages) -> FloatImage:
    """The mean (1, H, W) of the lights, each divided by its local mean."""
    return np.mean([image / local_mean(image, 10.0) for image in images.values], axis=0, keepdims=True)


def errors(case: Case, contenders: list[Contender], matrix: FloatArray | None = None) -> dict[str, Error]:
    """Errors of some contenders on a case, with the scene's crosstalk or another one."""
    clean, exact = case.photographs()
    lights, made = case.scene.lights, {}
    size = exact.shape[1]
    margin = (size - 1 - (size - 17) // 25 * 25) // 2
    region = (margin, margin, size - 1 - margin, size - 1 - margin)
    for contender in contenders:
        kind = "rgb" if contender.method == "3-CCD" else "bayer"
        camera = replace(case.scene.camera, kind=kind)
        if matrix is not None:
            camera = replace(camera, crosstalk=matrix)
        crosstalk, pair = camera.true_crosstalk(lights), []
        for number, images in enumerate(clean):
            linear = linearise(record(images, camera, lights, seed=41000 + number), camera.noise)
            whole = isinstance(linear, LinearChannels)
            pair.append(unmix(linear, crosstalk) if whole else separate(linear, crosstalk, contender.method))
        image = (pair[0].values - clean[0])[:, 16:-16, 16:-16] / clean[0].mean(axis=(1, 2), keepdims=True)
        found = solved(contender, pair, exact, region)
        made[contender.name] = Error.of(found, exact, float(np.sqrt(np.nanmean(image**2))))
    return made


def row(found: dict[str, Error], *, plate: bool) -> dict[str, object]:
    """Errors of all contenders and, of the best camera, what a third of its samples could give."""
    size = {name: error.scatter if plate else error.rms for name, error in found.items()}
    cells: dict[str, object] = {f"{name} [px]": size[name] for name in size if name != "3-CCD"}
    cells |= {"3-CCD × √3 [px]": size["3-CCD"] * 3**0.5} if "3-CCD" in size else {}
    cells |= {f"bias of {name} [px]": found[name].bias for name in ("Malvar", "default")}
    return cells | {"default: error/stated": found["default"].ratio}


SCENES = ("mat plate .25 px", "mat plate .5 px", "reflection .25 px", "reflection .5 px")
SPHERES = ("sphere .33 deg", "sphere 1 deg", "sphere 8 deg")
BIAS = {f"bias of {name} [px]": f"{name} [px]" for name in ("Malvar", "default")}


@table("demosaicing", page="explanation/demosaicing", cost=20, seed=41, scatter=BIAS)
def demosaicing(quick: bool) -> Iterator[dict[str, object]]:
    """Error over the field of the project's own scenes (scatter of plates, rms of spheres) by the method from the raw
    frame to the solver; crosstalk as assumed (.10 to .16) or as in measured cameras (.28 to .33 between green and
    blue)."""
    cases = [(25, "assumed", name) for name in (*SCENES, *SPHERES)]
    cases += [(25, "measured", name) for name in (*SCENES[3:], *SPHERES[1:])]
    cases += [(100, "assumed", name) for name in (*SCENES[2:], *SPHERES)]
    for wrinkles, crosstalk, name in cases[:1] if quick else cases:
        case = Case.of(name, wrinkles=wrinkles / 1000)
        found = errors(case, CONTENDERS, MEASURED if crosstalk == "measured" else None)
        names = {"wrinkles [um]": str(wrinkles), "crosstalk": crosstalk, "scene": name}
        yield names | row(found, plate=case.is_plate)


def independent_scenes() -> Path:
    """Folder with the scenes of the independent renderer.

    Raises
    ------
    MissingDataError
        They are not at hand.
    """
    folder = Path(os.environ.get("RGBMIDIC_SHARED_DATA", "")) / "independent_scenes"
    if not (folder / "sphere").is_dir():
        raise MissingDataError(f"there are no independent scenes in {folder}: set RGBMIDIC_SHARED_DATA")
    return folder


@table("demosaicing_independent", page="explanation/demosaicing", cost=8, scatter=BIAS, own_quick=True)
def independent(quick: bool) -> Iterator[dict[str, object]]:
    """Rms error over the field of scenes of a renderer that has no code in common with the project (256 rays a pixel,
    wrinkles 50 um apart)."""
    cases = [("plate_in_green_glare", 1, "plate in green's glare .25 px"), ("plate_in_green_glare", 2, "shift .5 px")]
    cases += [("plate_in_green_glare", 4, "strain 1 % and 4 px")]
    cases += [("sphere", n, f"sphere {angle} deg") for n, angle in ((1, ".33"), (2, "1"), (3, "2"), (5, "8"))]
    for folder, number, name in cases[3:4] if quick else cases:
        data = (ROOT / "tests/data/independent_scenes" if quick else independent_scenes()) / folder  # quick: the crop
        truth = np.load(data / "truth.npz")
        exact = truth["u"][number] if "u" in truth else truth["steps"][number].cumsum(1).cumsum(2) / 2**12
        end = exact.shape[1] - 21
        matrix = np.load(data / "lights.npz")["crosstalk"].astype(float)
        crosstalk, found = Crosstalk(matrix=matrix, lights=("red", "green", "blue")), {}
        linear = [
            linearise(
                read_frame(
                    data / "frames" / f"frame_{n:03d}.tif", cfa="RGGB", black_level=64, white_level=4095, kind="bayer"
                ),
                NoiseModel(gain=4.0, read_noise=3.0),
            )
            for n in (0, number)
        ]
        for contender in CONTENDERS[1:-1]:
            pair = [separate(linear[0], crosstalk, contender.method)]
            pair.append(separate(linear[1], crosstalk, contender.method, texture=pair[0].texture))
            found[contender.name] = Error.of(solved(contender, pair, exact, (20, 20, end, end)), exact)
        yield {"scene": name} | row(found, plate=False)


@table("demosaicing_coloured", page="explanation/demosaicing", cost=2, seed=11)
def coloured_specimen(quick: bool) -> Iterator[dict[str, object]]:
    """A mat plate, with a fraction of each light's variance in a texture that only this light shows: scatter of the
    displacement over .25 px, error of the lights' images over their mean, error over stated uncertainty."""
    for fraction in (0.1,) if quick else (0.1, 0.3, 0.6, 1.0):
        case = replace(Case.of("mat plate .25 px", size=256, seed=11), coloured=fraction)
        found = errors(case, [NAMED["Malvar"], NAMED["default"]])
        row: dict[str, object] = {"channel-specific": f"{fraction:.0%}"}
        row |= {f"{name} [px]": error.scatter for name, error in found.items()}
        row |= {f"images by {name} [%]": 100 * error.image for name, error in found.items()}
        yield row | {f"{name}: error/stated": error.ratio for name, error in found.items()}


@table("demosaicing_speed", page="explanation/demosaicing", cost=4, timing=True)
def speed(quick: bool) -> Iterator[dict[str, object]]:
    """Processor time from a linearised frame to the lights on one thread, least of three runs."""
    patch = plate_scene(size=256, seed=3, samples=2)
    small = linearise(record(render(patch), patch.camera, patch.lights, seed=0), patch.camera.noise)
    assert isinstance(small, LinearMosaic)
    crosstalk = patch.camera.true_crosstalk(patch.lights)
    texture = separate(small, crosstalk).texture
    ways: dict[str, Callable[[LinearMosaic], Any]] = {
        "default with the texture known": lambda mosaic: separate(mosaic, crosstalk, texture=texture),
        "default with the texture learnt": lambda mosaic: separate(mosaic, crosstalk),
        "Malvar": lambda mosaic: separate(mosaic, crosstalk, "malvar"),
    }
    for size in (256,) if quick else (1024, 2048):
        copies = (size // 256, size // 256)
        mosaic = replace(small, values=np.tile(small.values, copies), saturated=np.tile(small.saturated, copies))
        row: dict[str, object] = {"frame": f"{size} px"}
        for name, way in ways.items():
            way(mosaic)
            runs = []
            for _ in range(3):
                start = time.process_time()
                way(mosaic)
                runs.append(time.process_time() - start)
            row[f"{name} [ns/px]"] = min(runs) / size**2 * 1e9
        yield row
