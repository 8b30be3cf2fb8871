"""What `rgbmidic inspect` and `rgbmidic plan` predict beside what is observed, and the weights that a plan gives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from colour_scenes import speckle

from rgbmidic import Calibration, correlate
from rgbmidic.fields import at_nodes
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.illumination import IlluminationImages
from rgbmidic.illumination.crosstalk import unmix
from rgbmidic.illumination.linear import LinearChannels, LinearMosaic, linearise
from rgbmidic.illumination.separation import separate
from rgbmidic.mesh import Region
from rgbmidic.tools.lab.inspection import inspect_frame
from rgbmidic.tools.lab.virtual import Camera, State, record, render, truth, turned
from rgbmidic.tools.lab.virtual.rendering import sphere_scene
from rgbmidic.tools.scene.forecast import Instrument, trace_change
from rgbmidic.tools.scene.geometry_weights import GeometryWeights
from rgbmidic.tools.scene.zones import material_points, predict_zones
from rgbmidic.typing import FloatArray, FloatImage

from .demosaicing import NAMED, Case, errors
from .tables import table

SIZE, INSET, PAINTS, PAIRS = 256, 14, 2, 2
"""Frames (px), margin of the region, paints, and pairs of shots of each."""
Frame = Mosaic | ChannelFrame
CAMERAS = {"Bayer": "bayer", "3-CCD": "rgb", "lights in succession": "monochrome"}
SCENES = {
    "mat plate with speckle 4.2 px": {"name": "mat plate .25 px"},
    "mat plate with speckle 3.3 px": {"name": "mat plate .25 px", "speckle": 3.3},
    "plate in green's reflection": {"name": "reflection .25 px"},
    "sphere turned by 1 deg": {"name": "sphere 1 deg"},
    "sphere turned by 4 deg": {"name": "sphere 4 deg"},
}


@cache
def case_of(name: str, paint: int) -> Case:
    """A scene of the table with one of the paints."""
    return Case.of(**SCENES[name], size=SIZE, seed=41 + paint)


def camera_of(case: Case, kind: Any) -> Camera:
    """The camera of a scene, or another kind with its noise and exposure."""
    mixing = None if kind == "monochrome" else case.scene.camera.crosstalk
    return replace(case.scene.camera, kind=kind, crosstalk=mixing)


def shot(images: FloatImage, case: Case, kind: str, seed: int) -> tuple[list[Frame], IlluminationImages]:
    """Raw frames of a state and its illumination images."""
    camera, lights = camera_of(case, kind), case.scene.lights
    if kind == "monochrome":
        frames = [
            record(images, camera, lights, seed=seed * 9 + n, shining=(one.name,)) for n, one in enumerate(lights)
        ]
        return frames, IlluminationImages.in_succession([linearise(f, camera.noise) for f in frames])
    frame = record(images, camera, lights, seed=seed)
    linear, crosstalk = linearise(frame, camera.noise), camera.true_crosstalk(lights)
    if isinstance(linear, LinearChannels):
        return [frame], unmix(linear, crosstalk)
    assert isinstance(linear, LinearMosaic)
    return [frame], separate(linear, crosstalk)


def predicted(name: str, camera: str, side: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """At inner nodes, over paints and pairs: squares of errors, and of what inspect and plan state (rms over u, v)."""
    observed, by_frame, by_plan = [], [], []
    region = (INSET, INSET, SIZE - 1 - INSET, SIZE - 1 - INSET)
    for paint in range(PAINTS):
        case = case_of(name, paint)
        (first, second), exact = case.photographs()
        kind = CAMERAS[camera]
        scene = replace(case.scene, camera=camera_of(case, kind))
        known = Calibration(
            noise=scene.camera.noise,
            crosstalk=None if kind == "monochrome" else scene.camera.true_crosstalk(scene.lights),
        )
        for pair in range(PAIRS):
            seeds = 100 * paint + 2 * pair
            frames, reference = shot(first, case, kind, seeds)
            _, deformed = shot(second, case, kind, seeds + 1)
            found = correlate(reference.values, deformed.values, region=region, element_size=side,
                              prefilter="binomial", initial=exact[:, SIZE // 2, SIZE // 2])  # fmt: skip
            inner = (abs(found.nodes - (SIZE - 1) / 2) < SIZE / 2 - INSET - side / 2).all(axis=1)
            observed.append((found.displacement - at_nodes(exact, found.nodes))[inner] ** 2)
            if not pair:
                seen = inspect_frame(frames, calibration=known, region=region, element_size=side)
                by_frame.append(seen.prediction.std[inner] ** 2)
                material = material_points(scene)
                before, after = (predict_zones(scene, s, material=material) for s in (State(), case.state))
                made = Instrument.of(scene, element_size=side, demosaic="auto").forecast(
                    before, after, trace_change(exact)
                )
                by_plan.append(at_nodes(np.stack([made.std, made.std]), found.nodes)[inner] ** 2)
    return np.concatenate(observed), np.concatenate(by_frame), np.concatenate(by_plan)


@table("prediction", page="how-to/inspect", cost=45, seed=41)
def prediction(quick: bool) -> Iterator[dict[str, object]]:
    """Rms error at inner nodes, and the predictions of `rgbmidic inspect` from the first frame and of `rgbmidic plan`
    from the scene, relative to it: frames of 256 px, plates that shift by .25 px, two paints with two pairs of shots
    each."""
    for name in ("mat plate with speckle 4.2 px",) if quick else SCENES:
        for camera, side in (("Bayer", 25), ("Bayer", 16), ("3-CCD", 25), ("lights in succession", 25))[
            : 1 if quick else 4
        ]:
            rms = [float(np.sqrt(np.nanmean(squares))) for squares in predicted(name, camera, side)]
            names = {"scene": name, "camera": camera, "elements [px]": str(side)}
            yield names | {
                "observed [px]": rms[0],
                "inspect/observed": rms[1] / rms[0],
                "plan/observed": rms[2] / rms[0],
            }


@table("border", page="how-to/planning", cost=1, seed=5)
def border(quick: bool) -> Iterator[dict[str, object]]:
    """Nodes of a mesh (elements of 25 px, one light, noise of 10 grey levels on paint from 100 to 800, 16 draws): rms
    error and stated uncertainty, and the error over that of inner nodes."""
    shape, draws = (224, 224), 16
    texture = 1000 * speckle(shape, diameter=4.2, seed=5)
    random = np.random.default_rng(5)
    pairs = (texture + 10 * random.normal(size=(2, *shape)) for _ in range(draws))
    found = [correlate(*pair, region=(12, 12, 211, 211), initial=(0.0, 0.0)) for pair in pairs]
    nodes = found[0].nodes
    sides = ((nodes == nodes.min(axis=0)) | (nodes == nodes.max(axis=0))).sum(axis=1)
    inner = 0.0
    for count, name in enumerate(("inner nodes", "nodes of the border", "corners")):
        error, stated = (
            float(np.sqrt(np.mean([getattr(one, what)[sides == count] ** 2 for one in found])))
            for what in ("displacement", "displacement_std")
        )
        inner = inner or error
        yield {"nodes": name, "error [px]": error, "error/stated": error / stated, "over inner nodes": error / inner}


@table("geometry_weights", page="how-to/planning", cost=8, seed=41)
def geometry_weights(quick: bool) -> Iterator[dict[str, object]]:
    """Rms error (px) on the sphere with a 3-CCD camera by the weights of the lights, otherwise default settings."""
    for height, text in ((0.0, "flat"), (0.004, "4 um high")):
        for angle in (1.0,) if quick else (1.0, 4.0, 8.0):
            if quick and height:
                continue
            scene = sphere_scene(size=288, seed=41, kind="rgb")
            scene = replace(scene, surface=replace(scene.surface, dome=height))
            state, crosstalk, pair = turned(angle), scene.camera.true_crosstalk(scene.lights), []
            for number, one in enumerate((None, state)):
                frame = record(render(scene, one), scene.camera, scene.lights, seed=number)
                linear = linearise(frame, scene.camera.noise)
                assert isinstance(linear, LinearChannels)
                pair.append(unmix(linear, crosstalk))
            exact, cells = truth(scene, state), {}
            known: dict[str, Any] = {
                "scene": scene, "states": (State(), state), "reference_frames": (0,), "order": (0, 1, 2),
                "instrument": Instrument.of(scene),
            }  # fmt: skip
            ways = {
                "geometry": GeometryWeights(limit_deg=None, **known),
                "binary at 15 deg": GeometryWeights(limit_deg=15.0, **known),
                "statistics": None,
                "none": None,
            }
            for way, weights in ways.items():
                given = [None, None] if weights is None else [weights.reference(pair[0]), weights.deformed(pair[1], 1)]
                found = correlate(
                    pair[0].values,
                    pair[1].values,
                    region=Region.from_rectangle((19, 19, 269, 269), exact.shape[1:]),
                    weights=given[0],
                    deformed_weights=given[1],
                    statistics=way == "statistics",
                    prefilter="binomial",
                    initial=exact[:, 144, 144],
                )
                inner = (abs(found.nodes - 144) < 110).all(axis=1)
                error = (found.displacement - at_nodes(exact, found.nodes))[inner]
                cells[f"{way} [px]"] = float(np.sqrt(np.nanmean(error**2)))
            yield {"droplets": text, "angle [deg]": f"{angle:g}"} | cells


@table("fine_speckle", page="how-to/inspect", cost=11, seed=21,
       scatter={"bias x [px]": "scatter [px]", "bias x in a reflection [px]": "scatter in a reflection [px]",
                "bias x of Malvar [px]": "scatter [px]", "bias x of 3-CCD [px]": "scatter [px]"})  # fmt: skip
def fine_speckle(quick: bool) -> Iterator[dict[str, object]]:
    """Plates that shift by .25 px, default method: speckle size and agreement of neighbouring colours that the frame
    shows, bias along x and scatter; the scatter of an ideal 3-CCD camera; the bias of Malvar's filters."""
    grid = ((3.0, 0.45), (2.0, 0.45), (2.0, 0.3), (1.5, 0.3), (1.2, 0.3), (1.0, 0.3))
    for droplets, blur in grid[1:2] if quick else grid:
        options = {"speckle": droplets, "seed": 21, "lens_blur": blur, "size": 256}
        mat, glaring = (Case.of(f"{name} .25 px", **options) for name in ("mat plate", "reflection"))
        found = errors(mat, [NAMED["Malvar"], NAMED["default"], NAMED["3-CCD"]])
        shining = errors(glaring, [NAMED["default"], NAMED["3-CCD"]])
        camera = mat.scene.camera
        frame = record(mat.photographs()[0][0], camera, mat.scene.lights, seed=0)
        known = Calibration(noise=camera.noise, crosstalk=camera.true_crosstalk(mat.scene.lights))
        seen = inspect_frame(frame, calibration=known)
        yield {
            "droplets [px]": f"{droplets:g}",
            "lens blur [px]": f"{blur:g}",
            "speckle [px]": seen.speckle_px,
            "agreement": seen.texture.correlation if seen.texture else float("nan"),
            "bias x [px]": found["default"].bias,
            "scatter [px]": found["default"].scatter,
            "3-CCD [px]": found["3-CCD"].scatter,
            "bias x of 3-CCD [px]": found["3-CCD"].bias,
            "bias x of Malvar [px]": found["Malvar"].bias,
            "bias x in a reflection [px]": shining["default"].bias,
            "scatter in a reflection [px]": shining["default"].scatter,
            "3-CCD in a reflection [px]": shining["3-CCD"].scatter,
        }
