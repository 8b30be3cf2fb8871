"""A virtual test on disk: raw frames, calibration captures, the exact truth, and settings that `rgbmidic run` takes."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rgbmidic._version import __version__
from rgbmidic.errors import InputError, ResultError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.writers import write_dng, write_tiff
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.lab.virtual.capture import check_frames, dark_frames, flat_frames, single_light_frames
from rgbmidic.lab.virtual.recording import record
from rgbmidic.lab.virtual.rendering import render
from rgbmidic.scene.camera import Camera
from rgbmidic.scene.projection import truth
from rgbmidic.scene.scene import Scene, State
from rgbmidic.scene.scenefile import DatasetSettings, Experiment, read_scene
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["true_calibration", "write_dataset", "write_experiment"]

Frame = Mosaic | ChannelFrame
Progress = Callable[[int, int, str], None]
MARGIN = 20
"""Pixels between the frame's edge and what moves nearest to it, in the region of test.toml."""


def write_dataset(scene_toml: Path | str, out: Path | str, progress: Progress | None = None) -> Path:
    """Render what a SCENE.toml describes.

    Written to `out`: ``frames/`` (frame 0 shows the body at rest; a monochrome camera gets one folder per light),
    ``dark/``, ``light_NAME/``, ``flat_1/`` and so on and ``check/`` for `rgbmidic-calibrate`, ``calibration.json`` (the
    true crosstalk and noise),
    ``truth.npz`` (displacement (T, 2, H, W) px of the material points at the pixels of frame 0, NaN where there is
    none), ``test.toml`` for `rgbmidic run`, and a copy of the scene.

    Parameters
    ----------
    scene_toml
        The scene (`rgbmidic.scene.scenefile.read_scene`).
    out
        Folder; it must be empty or not exist.
    progress
        Called with the number of frames done, their total and a line about the last one.

    Returns
    -------
    Path
        The test.toml.

    Raises
    ------
    ConfigurationError
        The scene file is wrong.
    ResultError
        The folder is not empty or cannot be written.
    """
    experiment, out = read_scene(scene_toml), Path(out)
    test = write_experiment(experiment, out, progress)
    shutil.copyfile(scene_toml, out / "scene.toml")
    return test


def write_experiment(experiment: Experiment, out: Path, progress: Progress | None = None) -> Path:
    """Like `write_dataset`, from an experiment in memory."""
    _check_names_of_lights(experiment.scene)
    _make_folder(out)
    scene, settings = experiment.scene, experiment.output
    states = (State(), *experiment.states)
    seeds = np.random.SeedSequence(settings.seed).spawn(5)
    frame_seeds = seeds[0].generate_state(len(states) * len(scene.lights)).reshape(len(states), -1)
    at_rest = render(scene)
    for index, state in enumerate(states):
        images = render(scene, state) if index else at_rest
        _write_state(out, scene, settings, index, images, frame_seeds[index])
        if settings.noise_free:
            _save(out / "noise_free" / f"frame_{index:04d}.npz", images=images)
        if progress is not None:
            progress(index + 1, len(states), f"frame {index}: turned by {state.angle_deg:g} degrees")
    displacement = np.stack([truth(scene, state) for state in states])
    _save(out / "truth.npz", displacement=displacement.astype(np.float32), angle_deg=[s.angle_deg for s in states])
    _write_captures(out, scene, settings, at_rest, [int(seed.generate_state(1)[0]) for seed in seeds[1:]])
    true_calibration(scene).write(out / "calibration.json")
    test = out / "test.toml"
    test.write_text(_test_settings(scene, settings, _region(settings, displacement)), encoding="utf-8")
    return test


def _check_names_of_lights(scene: Scene) -> None:
    for light in scene.lights:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", light.name):
            raise InputError(f"a light's name becomes a folder's: letters, digits, - and _ only, not {light.name!r}")
        if light.name in ("all", "dark"):
            raise InputError(f"a light cannot be called {light.name!r}: that is the name of a folder of captures")


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        taken = any(out.iterdir())
    except OSError as error:
        raise ResultError(f"cannot write a data set to {out}: {error.strerror}") from None
    if taken:
        raise ResultError(f"{out} is not empty; nothing is overwritten: choose another folder")


def _write_state(
    out: Path,
    scene: Scene,
    settings: DatasetSettings,
    index: int,
    images: FloatImage,
    seeds: npt.NDArray[np.uint32],
) -> None:
    """One frame; of a monochrome camera, for which the lights fire in succession, one per light."""
    for folder, seed, on in zip(_folders(scene), seeds, _lights_on(scene), strict=False):
        frame = record(images, scene.camera, scene.lights, seed=int(seed), on=on)
        _write_frame(out / folder, index, frame, settings)


def _folders(scene: Scene) -> list[str]:
    if scene.camera.kind == "monochrome" and len(scene.lights) > 1:
        return [f"frames_{light.name}" for light in scene.lights]
    return ["frames"]


def _lights_on(scene: Scene) -> Iterator[tuple[str, ...]]:
    names = tuple(light.name for light in scene.lights)
    return ((name,) for name in names) if scene.camera.kind == "monochrome" else iter([names])


def _suffix(camera: Camera, settings: DatasetSettings) -> str:
    return "dng" if camera.kind == "bayer" and settings.format == "dng" else "tif"


def _write_frame(folder: Path, index: int, frame: Frame, settings: DatasetSettings) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(frame, Mosaic) and settings.format == "dng":
        write_dng(folder / f"frame_{index:04d}.dng", frame)
    else:
        write_tiff(folder / f"frame_{index:04d}.tif", frame)


def _write_captures(out: Path, scene: Scene, settings: DatasetSettings, at_rest: FloatImage, seeds: list[int]) -> None:
    count = settings.calibration_frames
    captures = single_light_frames(scene, count=count, seed=seeds[0], target=settings.target)
    groups = {f"light_{name}": frames for name, frames in captures.items()}
    groups["dark"] = dark_frames(scene.camera, count=count, seed=seeds[1])
    groups |= {f"flat_{i}": frames for i, frames in enumerate(flat_frames(scene, seed=seeds[2]), start=1)}
    groups |= {f"check/{name}": frames for name, frames in check_frames(scene, at_rest, seed=seeds[3]).items()}
    for folder, frames in groups.items():
        for index, frame in enumerate(frames):
            _write_frame(out / folder, index, frame, settings)


def true_calibration(scene: Scene) -> Calibration:
    camera = scene.camera
    return Calibration(
        crosstalk=None if camera.kind == "monochrome" else camera.true_crosstalk(scene.lights),
        noise=camera.noise,
        cfa=camera.cfa if camera.kind == "bayer" else None,
        black_level=float(camera.black_level),
        white_level=float(camera.white_level),
        provenance={"origin": "virtual scene, exact", "rgbmidic": __version__},
    )


def _region(settings: DatasetSettings, displacement: FloatArray) -> tuple[float, float, float, float]:
    """The stated rectangle, or the frame less the largest motion and a margin, on the body in every state.

    Raises
    ------
    InputError
        No rectangle about the middle of the frame stays in view; the user must state one.
    """
    if settings.region is not None:
        return settings.region
    height, width = displacement.shape[2:]
    seen = np.asarray(np.isfinite(displacement[:, 0]).all(axis=0))
    moved = np.abs(displacement[:, :, seen]).max(axis=(0, 2)) if seen.any() else np.zeros(2)
    x, y = (math.ceil(motion) + MARGIN for motion in moved)
    while 2 * x < width and 2 * y < height:
        if seen[y : height - y, x : width - x].all():
            return float(x), float(y), float(width - 1 - x), float(height - 1 - y)
        x, y = x + 4, y + 4
    raise InputError("the body leaves the middle of the frame: state output.region = [x0, y0, x1, y1]")


def _test_settings(scene: Scene, settings: DatasetSettings, region: tuple[float, ...]) -> str:
    """The text of test.toml."""
    camera, suffix = scene.camera, _suffix(scene.camera, settings)
    path = ", ".join(f'"{folder}/*.{suffix}"' for folder in _folders(scene))
    lines = ["[frames]", f"path = [{path}]", f'kind = "{camera.kind}"']
    if suffix == "tif":
        lines += [f'cfa = "{camera.cfa}"'] if camera.kind == "bayer" else []
        lines += [f"black_level = {camera.black_level}", f"white_level = {camera.white_level}"]
    lines += ["", "[calibration]", 'file = "calibration.json"', ""]
    lines += ["[region]", f"rectangle = [{', '.join(f'{edge:g}' for edge in region)}]", ""]
    lines += ["[mesh]", f"element_size = {settings.element_size:g}", ""]
    lines += ["[scale]", f"mm_per_pixel = {scene.body.front[2] / camera.focal_px:.9g}", ""]
    return "\n".join(lines)


def _save(path: Path, **arrays: npt.ArrayLike) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)
