"""Two cameras before a sphere: shape, motion and surface strain in three dimensions, with three lamps and with one."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from rgbmidic import Tri3Mesh, read_frame, separate
from rgbmidic.frames.data import ChannelFrame
from rgbmidic.frames.images import write_tiff
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.tools.lab.virtual import Scene, State, record, render, sphere_scene, turned
from rgbmidic.tools.lab.virtual.dataset import true_calibration, write_frame
from rgbmidic.tools.lab.virtual.view_point import ViewPoint, true_motion, true_pair
from rgbmidic.tools.scene.scene import DatasetSettings
from rgbmidic.tools.stereo import StereoResult, StereoSettings, measure_stereo

from .tables import Row, table
from .uncertainty import rms

ANGLE = 22.0
"""Degrees between the cameras, half of them on either side of the axis that the body faces."""
GAUGE = 77.0
ANGLES = {"1/3°": 1 / 3, "1°": 1.0, "2°": 2.0, "4°": 4.0}
PAINTS = {"shiny": (1.5, 0.5), "saturating": (3.0, 0.8), "mat": (0.0, 0.5)}
"""Gloss, and exposure of an ideal white under one lamp, as a fraction of full scale."""
LEVELS = 15.0
"""Levels of a 16-bit frame for one of a lamp's image: a tenth of the noise at most is lost by rounding."""


def views(scene: Scene) -> tuple[ViewPoint, ViewPoint]:
    """The left and the right camera."""
    return ViewPoint.around(scene, ANGLE / 2), ViewPoint.around(scene, -ANGLE / 2)


def written(folder: Path, scene: Scene, states: tuple[State, ...], seed: int, white: Path | None = None) -> None:
    """Frames, calibration and TEST.toml of both cameras, and the file of both.

    `white` is a folder for the same under white lamps before monochrome cameras: all three at once, each of a third of
    the power, and one.
    """
    height, width = scene.camera.shape
    grey = replace(scene.camera, kind="monochrome", crosstalk=None)
    margin = round(0.067 * width)
    for side, view in zip(("left", "right"), views(scene), strict=True):
        seen = view.scene(scene)
        for number, state in enumerate(states):
            images = render(seen, view.state(scene.body, state))
            frame = record(images, seen.camera, seen.lights, seed=seed + 100 * (side == "right") + number)
            write_frame(folder / side / "frames", number, frame, DatasetSettings())
            for name, image in {"three": images.mean(axis=0), "one": images[0]}.items() if white else ():
                single = record(image[None], grey, seen.lights[:1], seed=seed + 1000 * (1 + (name == "one")) + number)
                write_frame(white / name / side / "frames", number, single, DatasetSettings())
        replace(true_calibration(seen), shape=seen.camera.shape).write(folder / side / "calibration.json")
        edges = (
            (margin, margin, width - 1 - margin, height - 1 - margin)
            if side == "left"
            else (0, 0, width - 1, height - 1)
        )
        text = '[frames]\npath = "frames/*.dng"\n[calibration]\nfile = "calibration.json"\n[region]\n'
        text += f"rectangle = {list(edges)}\n"
        (folder / side / "TEST.toml").write_text(text, encoding="utf-8")
        if white:
            levels = f'kind = "monochrome"\nblack_level = {grey.black_level}\nwhite_level = {grey.white_level}\n'
            text = f'[frames]\npath = "frames/*.tif"\n{levels}[region]\nrectangle = {list(edges)}\n'
            for name in ("three", "one"):
                (white / name / side / "TEST.toml").write_text(text, encoding="utf-8")
    true_pair(scene, *views(scene)).write(folder / "stereo.json")


def of_one_lamp(folder: Path, lamp: int = 0) -> Path:
    """The same frames as one lamp shows them, separated, as monochrome tests."""
    out = folder / "one_lamp"
    for side in ("left", "right"):
        calibration = Calibration.read(folder / side / "calibration.json")
        for path in sorted((folder / side / "frames").glob("*.dng")):
            values = separate(read_frame(path), calibration).values[lamp]
            levels = np.where(np.isfinite(values), np.rint(LEVELS * values + 1000), 65535).clip(0, 65535)
            frame = ChannelFrame(values=levels.astype(np.uint16)[None], black_level=np.array(1000.0), white_level=65535)
            (out / side / "frames").mkdir(parents=True, exist_ok=True)
            write_tiff(out / side / "frames" / f"{path.stem}.tif", frame)
        text = (folder / side / "TEST.toml").read_text(encoding="utf-8")
        frames = 'path = "frames/*.tif"\nkind = "monochrome"\nblack_level = 1000\nwhite_level = 65535'
        text = text.replace('path = "frames/*.dng"', frames).replace('[calibration]\nfile = "calibration.json"\n', "")
        (out / side / "TEST.toml").write_text(text, encoding="utf-8")
    return out


def rows_of(scene: Scene, states: dict[str, State], folder: Path, camera: Path) -> Iterator[Row]:
    """Errors of the shape, then of each state, in the axes of the mean plane, over inner nodes."""
    tests = [folder / side / "TEST.toml" for side in ("left", "right")]
    result = measure_stereo(*tests, camera, folder / "result", StereoSettings(gauge=GAUGE), workers=1)
    pixels = np.stack([result["x_left"], result["y_left"]], axis=1)
    inner = ~Tri3Mesh(nodes=pixels, elements=result.elements).on_boundary
    first = result.camera("left")
    count = int((~Tri3Mesh(nodes=first.nodes, elements=first.elements).on_boundary).sum())
    turn, origin = (result.attributes[name] for name in ("axes_rotation", "axes_origin_mm"))
    left, _ = views(scene)
    rest = true_motion(scene, left, pixels, State())[0]
    yield (
        {"state": "shape"}
        | figures(result, "xyz", (rest - origin) @ turn.T, inner, count)
        | epipolar(result, "common", inner)
    )
    for number, (name, state) in enumerate(states.items(), start=1):
        motion = true_motion(scene, left, pixels, state)[1] @ turn.T
        strain = np.stack([result[c][number] for c in ("exx", "eyy", "exy")], axis=1)
        stated = np.stack([result[f"{c}_std"][number] for c in ("exx", "eyy", "exy")], axis=1)
        usable = inner & np.isfinite(strain).all(axis=1)
        row = figures(result, "uvw", motion, inner, count, number) | epipolar(result, "change", inner, number)
        ratio = (strain / stated)[usable]
        yield {"state": name} | row | {"strain [1e-4]": 1e4 * rms(strain[usable]), "strain: error/stated": rms(ratio)}


def figures(
    result: StereoResult, names: str, true: np.ndarray, inner: np.ndarray, count: int, frame: int | None = None
) -> Row:
    """Nodes with data over the left mesh's inner ones, rms errors in and out of the plane, and over what is stated."""
    values, stds = (
        np.stack([result[f"{name}{end}"] if frame is None else result[f"{name}{end}"][frame] for name in names], axis=1)
        for end in ("", "_std")
    )
    usable = inner & np.isfinite(values).all(axis=1)
    error = values - true
    row: Row = {"nodes [%]": 100 * float(usable.sum() / count)}
    row |= {"in plane [mm]": rms(error[usable][:, :2]), "out of plane [mm]": rms(error[usable][:, 2])}
    ratio = error / stds
    return row | {
        "in plane: error/stated": rms(ratio[usable][:, :2]),
        "out of plane: error/stated": rms(ratio[usable][:, 2]),
    }


def epipolar(result: StereoResult, kind: str, inner: np.ndarray, frame: int | None = None) -> Row:
    """Epipolar residual and that over what is stated."""
    values, std = (
        result[f"epipolar_{kind}{end}"] if frame is None else result[f"epipolar_{kind}{end}"][frame]
        for end in ("", "_std")
    )
    usable = inner & np.isfinite(values)
    return {"epipolar [px]": rms(values[usable]), "epipolar: error/stated": rms((values / std)[usable])}


COLUMNS = ("nodes [%]", "in plane [mm]", "out of plane [mm]", "in plane: error/stated", "out of plane: error/stated",
           "epipolar [px]", "epipolar: error/stated", "strain [1e-4]", "strain: error/stated")  # fmt: skip


@table("stereo", page="how-to/stereo", cost=350, keys=3, seed=0, own_quick=True)
def stereo(quick: bool) -> Iterator[Row]:
    """Rms errors of two cameras 22° apart before a sphere turning under three lamps (448 px, .055 mm per px, elements
    of 25 px, Bayer frames), in the axes of the mean plane over the inner nodes: shape, displacement, and surface
    strain over 77 px, of which there is none; with all three lamps, with the red one alone in the same frames, and
    with white lamps before monochrome cameras, three at once of a third of the power each, or one. Saturating
    paint is twice as glossy, exposed 1.6 times as long."""
    for paint, (gloss, exposure) in PAINTS.items():
        if quick and paint != "shiny":
            continue
        angles = {"1°": 1.0} if quick else ANGLES
        if paint == "saturating":
            angles = {name: angles[name] for name in ("1°", "4°")}
        scene = sphere_scene(size=176 if quick else 448, gloss=gloss, **({"samples": 4} if quick else {}))
        scene = replace(scene, camera=replace(scene.camera, exposure=exposure))
        states = {name: turned(angle) for name, angle in angles.items()}
        with tempfile.TemporaryDirectory() as folder:
            white = None if quick or paint == "mat" else Path(folder) / "white"
            written(Path(folder), scene, (State(), *states.values()), 0, white)
            tests = {"three lamps": Path(folder)}
            if white:
                tests |= {"red of the same frames": of_one_lamp(Path(folder)), "three white at once": white / "three"}
                tests |= {"one white": white / "one"}
            for lamps, place in tests.items():
                for row in rows_of(scene, states, place, Path(folder) / "stereo.json"):
                    keys: Row = {"paint": paint, "lamps": lamps, "state": row["state"]}
                    yield keys | {name: row.get(name, float("nan")) for name in COLUMNS}
