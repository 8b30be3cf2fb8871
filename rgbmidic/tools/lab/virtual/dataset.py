"""A virtual test on disk: raw frames, calibration captures, the exact truth, and settings that `rgbmidic run` takes.

The captures are those that a laboratory records beside the test: one light at a time on a target, dark frames, a white
card, the checks. The camera (`record`) samples through its colour filter array, adds shot and read noise, quantises
and saturates.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from rgbmidic._version import __version__
from rgbmidic.arguments import checked
from rgbmidic.disk import write_errors
from rgbmidic.errors import InputError, ResultError
from rgbmidic.frames.data import ChannelFrame, Mosaic
from rgbmidic.frames.images import write_dng, write_tiff
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.plane_samples import Frame
from rgbmidic.tools.lab.virtual.rendering import render
from rgbmidic.tools.scene.camera import Camera, Light, SecondCamera, green_signs, mosaic_samples
from rgbmidic.tools.scene.scene import DatasetSettings, Plate, Scene, State, Target, read_scene
from rgbmidic.tools.scene.surface import Finish, Surface
from rgbmidic.tools.scene.zones import region_in_view, truth
from rgbmidic.typing import FloatImage, ProgressCallback

EXPOSURES = tuple(0.13 * time for time in (0.5, 1, 2, 4, 6, 10))
"""Fraction of the full scale that the brightest sample of a white card reaches, .13 per ms of the exposure times that
calibration/README.md states; in the last it saturates."""


def write_dataset(scene_toml: Path | str, out: Path | str, progress: ProgressCallback | None = None) -> Path:
    """Render the virtual test that a SCENE.toml describes.

    Written to `out`: ``frames/`` (frame 0 shows the body at rest; a monochrome camera gets one folder per light),
    ``dark/``, ``light_NAME/``, ``flat_1/`` and so on and ``check/`` for `rgbmidic-calibrate`, ``calibration.json`` (the
    true crosstalk and noise),
    ``truth.npz`` (displacement (T, 2, H, W) px of the material points at the pixels of frame 0, NaN where there is
    none), ``test.toml`` for `rgbmidic run`, and a copy of the scene.

    Parameters
    ----------
    scene_toml
        The scene (`rgbmidic.tools.scene.scene.read_scene`).
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
    _check_output(experiment.scene, out)
    states = (State(), *experiment.states)
    test = _write_test(experiment.scene, states, experiment.output, out, progress)
    shutil.copyfile(scene_toml, out / "scene.toml")
    return test


def write_stereo_dataset(
    scene_toml: Path | str, out: Path | str, angle_deg: float | None = None, progress: ProgressCallback | None = None
) -> tuple[Path, Path]:
    """Render the virtual test of a SCENE.toml as two cameras see it, for `rgbmidic stereo`.

    The scene's camera is the left one, ``[camera.second]`` the right one.
    Written to `out`: ``left/`` and ``right/`` with all that `write_dataset` writes, ``stereo.json`` (the true cameras),
    and ``truth.npz`` (points (3, H, W) and displacement (T, 3, H, W), mm in the left camera's axes, of the material
    points at the pixels of the left frame 0; NaN where there is none).

    Parameters
    ----------
    scene_toml, out, progress
        As of `write_dataset`.
    angle_deg
        Angle between the cameras; None: as the scene states, or else its default.

    Returns
    -------
    left, right : Path
        The test.toml of either camera.

    Raises
    ------
    ConfigurationError
        The scene file is wrong.
    InputError
        The angle is not above 0 and below 120 degrees or not that of the scene, or the body spins during the exposure.
    ResultError
        The folder is not empty or cannot be written.
    """
    from rgbmidic.tools.lab.virtual.view_point import ViewPoint, true_motion, true_pair

    experiment, out = read_scene(scene_toml), Path(out)
    second = experiment.second or SecondCamera()
    if angle_deg is not None:
        if experiment.second is not None and angle_deg != second.angle_deg:
            raise InputError(
                f"{scene_toml}: camera.second.angle_deg is {second.angle_deg:g}, stated beside it are {angle_deg:g} "
                "degrees (`angle_deg`): state one of them"
            )
        second = replace(second, angle_deg=angle_deg)
    scene, states = experiment.scene, (State(), *experiment.states)
    views = ViewPoint.both(scene, second)
    poses = [[view.state(scene.body, state) for state in states] for view in views]
    _check_output(scene, out)
    tests = list[Path]()
    for side, view, seen in zip(("left", "right"), views, poses, strict=True):
        settings = replace(experiment.output, seed=experiment.output.seed + len(tests))
        if side == "right":
            height, width = view.camera.shape
            settings = replace(settings, region=(0.0, 0.0, width - 1.0, height - 1.0))
        (out / side).mkdir()
        tests.append(_write_test(view.scene(scene), seen, settings, out / side, progress))
    height, width = scene.camera.shape
    pixels = np.indices(scene.camera.shape, dtype=float)[::-1].reshape(2, -1).T
    motions = [true_motion(scene, views[0], pixels, state) for state in states]
    points, displacement = motions[0][0], np.stack([motion for _, motion in motions])
    _save_arrays(
        out / "truth.npz",
        points=np.moveaxis(points, -1, 0).reshape(3, height, width).astype(np.float32),
        displacement=np.moveaxis(displacement, -1, 1).reshape(-1, 3, height, width).astype(np.float32),
    )
    true_pair(scene, *views).write(out / "stereo.json")
    shutil.copyfile(scene_toml, out / "scene.toml")
    return tests[0], tests[1]


def _write_test(
    scene: Scene, states: Sequence[State], settings: DatasetSettings, out: Path, progress: ProgressCallback | None
) -> Path:
    """Write frames, captures, calibration, truth and settings of a test whose first state is the reference."""
    seeds = np.random.SeedSequence(settings.seed).spawn(5)
    frame_seeds = seeds[0].generate_state(len(states) * len(scene.lights)).reshape(len(states), -1)
    at_rest = render(scene, states[0])
    for index, state in enumerate(states):
        images = render(scene, state) if index else at_rest
        for (folder, shining), seed in zip(_folders(scene).items(), frame_seeds[index], strict=False):
            frame = record(images, scene.camera, scene.lights, seed=int(seed), shining=shining)
            write_frame(out / folder, index, frame, settings)
        if settings.noise_free:
            _save_arrays(out / "noise_free" / f"frame_{index:04d}.npz", images=images)
        if progress is not None:
            progress(index + 1, len(states), f"frame {index}: turned by {state.angle_deg:g} degrees")
    displacement = np.stack([truth(scene, state, states[0]) for state in states])
    _save_arrays(
        out / "truth.npz", displacement=displacement.astype(np.float32), angle_deg=[s.angle_deg for s in states]
    )
    _write_captures(out, scene, settings, at_rest, [int(seed.generate_state(1)[0]) for seed in seeds[1:]])
    true_calibration(scene).write(out / "calibration.json")
    test = out / "test.toml"
    y, x = np.indices(scene.camera.shape, dtype=float, sparse=True)
    region = settings.region or region_in_view(x, y, displacement, scene.camera.shape)
    test.write_text(settings_text(scene, settings, region), encoding="utf-8")
    return test


def _check_output(scene: Scene, out: Path) -> None:
    """Require names of lights that can be names of folders, and make an empty folder."""
    for light in scene.lights:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", light.name):
            raise InputError(f"a light's name becomes a folder's: letters, digits, - and _ only, not {light.name!r}")
        if light.name in ("all", "dark"):
            raise InputError(f"a light cannot be called {light.name!r}: that is the name of a folder of captures")
    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        has_files = any(out.iterdir())
    if has_files:
        raise ResultError(f"{out} is not empty; nothing is overwritten: choose another folder")


def _folders(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Folders of frames with the lights that shine: of a monochrome camera one each, since they fire in succession."""
    names = tuple(light.name for light in scene.lights)
    if scene.camera.kind == "monochrome" and len(names) > 1:
        return {f"frames_{name}": (name,) for name in names}
    return {"frames": names}


def write_frame(folder: Path, index: int, frame: Frame, settings: DatasetSettings) -> None:
    """Write a raw frame under its number, in the format of the settings, into a folder that is made."""
    folder.mkdir(parents=True, exist_ok=True)
    if isinstance(frame, Mosaic) and settings.format == "dng":
        write_dng(folder / f"frame_{index:04d}.dng", frame)
    else:
        write_tiff(folder / f"frame_{index:04d}.tif", frame)


def _write_captures(out: Path, scene: Scene, settings: DatasetSettings, at_rest: FloatImage, seeds: list[int]) -> None:
    count = settings.calibration_frames
    single = single_light_frames(scene, count=count, seed=seeds[0], target=settings.target)
    groups = {f"light_{name}": frames for name, frames in single.items()}
    groups |= {"dark": dark_frames(scene, count=count, seed=seeds[1])}
    groups |= {f"flat_{number}": frames for number, frames in enumerate(flat_frames(scene, seed=seeds[2]), start=1)}
    groups |= {f"check/{name}": frames for name, frames in _check_frames(scene, at_rest, seed=seeds[3]).items()}
    for folder, frames in groups.items():
        for index, frame in enumerate(frames):
            write_frame(out / folder, index, frame, settings)


def true_calibration(scene: Scene) -> Calibration:
    """Return the calibration that a perfect laboratory would find of a scene."""
    camera = scene.camera
    return Calibration(
        crosstalk=None if camera.kind == "monochrome" else camera.true_crosstalk(scene.lights),
        registration=camera.true_registration(scene.lights),
        noise=camera.noise,
        cfa=camera.cfa if camera.kind == "bayer" else None,
        black_level=float(camera.black_level),
        white_level=float(camera.white_level),
        provenance={"origin": "virtual scene, exact", "rgbmidic": __version__},
    )


def settings_text(scene: Scene, settings: DatasetSettings, region: tuple[float, ...]) -> str:
    """Return the text of test.toml."""
    camera = scene.camera
    suffix = "dng" if camera.kind == "bayer" and settings.format == "dng" else "tif"
    path = ", ".join(f'"{folder}/*.{suffix}"' for folder in _folders(scene))
    lines = ["[frames]", f"path = [{path}]", f'kind = "{camera.kind}"']
    if suffix == "tif":
        lines += [f'cfa = "{camera.cfa}"'] if camera.kind == "bayer" else []
        lines += [f"black_level = {camera.black_level}", f"white_level = {camera.white_level}"]
    lines += ["", "[calibration]", 'file = "calibration.json"', ""]
    lines += ["[region]", f"rectangle = [{', '.join(f'{edge:g}' for edge in region)}]", ""]
    lines += ["[mesh]", f"element_size = {settings.element_size:g}", ""]
    lines += ["[scale]", f"mm_per_pixel = {scene.pixel:.9g}", ""]
    return "\n".join(lines)


def _save_arrays(path: Path, **arrays: npt.ArrayLike) -> None:
    path.parent.mkdir(exist_ok=True)
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def target_scene(scene: Scene, target: Target = "white") -> Scene:
    """Return the same lights and camera before a flat mat target that fills the field at the body's front point."""
    mat = Finish(albedo=0.8, gloss=0.0, slope_deg=0.0)
    paint = replace(scene.surface, white=mat, black=replace(mat, albedo=0.1), dome=0.0)
    if target == "white":
        paint = Surface(white=mat, black=mat, coverage=0.0)
    return replace(scene, body=Plate(width=1e5, height=1e5, centre=scene.body.front), surface=paint)


def single_light_frames(scene: Scene, *, count: int = 3, seed: int, target: Target = "white") -> dict[str, list[Frame]]:
    """Return the frames with one light on at a time, dimmed from frame to frame.

    Parameters
    ----------
    scene
        The lights and the camera are its own; body and paint are exchanged for a flat mat target.
    count
        Frames per light; the last has the full power, the others equal parts of it.
    seed
        Of the noise.
    target
        Plain white or speckled.

    Returns
    -------
    dict
        Light name to its frames.
    """
    images, generator = render(target_scene(scene, target)), np.random.SeedSequence(seed)
    frames: dict[str, list[Frame]] = {light.name: [] for light in scene.lights}
    for name, frames_of_light in frames.items():
        for step, child in enumerate(generator.spawn(count), start=1):
            frames_of_light += _record_frames(
                scene, images * np.float32(step / count), child.generate_state(1), (name,)
            )
    return frames


def dark_frames(scene: Scene, *, count: int = 3, seed: int) -> list[Frame]:
    """Return the frames with all lights off."""
    darkness = np.zeros((len(scene.lights), *scene.camera.shape), dtype=np.float32)
    return _record_frames(scene, darkness, np.random.SeedSequence(seed).generate_state(count), ())


def flat_frames(scene: Scene, *, count: int = 2, seed: int) -> list[list[Frame]]:
    """Return the frames of a white card under all lights together: `count` at each of the `EXPOSURES`."""
    images = render(target_scene(scene, "white"))
    brightest = float(np.einsum("cl,lyx->cyx", scene.camera.mixing(scene.lights), images).max())
    levels = [np.float32(fraction * scene.camera.full_scale / brightest) for fraction in EXPOSURES]
    seeds = [step.generate_state(count) for step in np.random.SeedSequence(seed).spawn(len(levels))]
    return [
        _record_frames(scene, images * level, level_seeds) for level, level_seeds in zip(levels, seeds, strict=True)
    ]


def _check_frames(scene: Scene, images: FloatImage, *, count: int = 2, seed: int) -> dict[str, list[Frame]]:
    """Return frames of the specimen at rest, `images` (k, H, W): each light alone, all together ("all"), and "dark"."""
    shining_lights = {light.name: (light.name,) for light in scene.lights} | {"all": None}
    *steps, last = np.random.SeedSequence(seed).spawn(len(shining_lights) + 1)
    frames = {
        name: _record_frames(scene, images, step.generate_state(count), on)
        for (name, on), step in zip(shining_lights.items(), steps, strict=True)
    }
    return frames | {"dark": dark_frames(scene, count=count, seed=int(last.generate_state(1)[0]))}


def _record_frames(
    scene: Scene, images: FloatImage, seeds: Iterable[np.uint32], shining: Collection[str] | None = None
) -> list[Frame]:
    return [record(images, scene.camera, scene.lights, seed=int(seed), shining=shining) for seed in seeds]


@checked
def record(
    images: npt.NDArray[np.floating],
    camera: Camera,
    lights: tuple[Light, ...],
    *,
    seed: int,
    shining: Collection[str] | None = None,
) -> Frame:
    """Return the raw frame that the camera takes.

    Electrons = Poisson(gain x signal) + normal(read noise); DN = round(electrons/gain + black), clipped at saturation.

    Parameters
    ----------
    images : (k, H, W)
        Images of each light alone (`rgbmidic.tools.lab.virtual.render`).
    camera
        The camera.
    lights
        The k lights of the images.
    seed
        Of the noise; the same seed gives the same frame.
    shining
        Names of the lights that shine; None: all together, () a dark frame.

    Returns
    -------
    Mosaic (Bayer camera) or ChannelFrame (3 channels, or 1 for a monochrome camera)

    Raises
    ------
    InputError
        Images that are not those of the lights, or a light that is not there.
    """
    signal = np.asarray(images)
    if signal.ndim != 3 or len(signal) != len(lights):
        raise InputError(f"{len(lights)} lights give as many images (k, H, W), not an array of shape {signal.shape}")
    names = [light.name for light in lights]
    if shining is not None:
        if unknown := set(shining) - set(names):
            raise InputError(f"no light {', '.join(sorted(unknown))}; there are {', '.join(names)}")
        signal = signal * np.array([name in shining for name in names], dtype=signal.dtype)[:, None, None]
    mixing = camera.mixing(lights).astype(np.float32)
    illumination = signal.astype(np.float32, copy=False)
    signal = np.einsum("cl,lyx->cyx", mixing, illumination)
    if camera.kind == "bayer":
        signal = mosaic_samples(signal, camera.cfa)
        if camera.green_difference:
            half = np.float32(0.5) * np.array(camera.green_difference, dtype=np.float32)
            signal += green_signs(camera.cfa, signal.shape) * np.tensordot(half, illumination, axes=1)
    if seed < 0 or not signal.max(initial=0) * camera.gain < 2**60:
        raise InputError(f"a seed is not negative, and images have finite levels: {seed}, {signal.max(initial=0):g} DN")
    generator = np.random.default_rng(seed)
    electrons = generator.poisson(np.maximum(signal, 0) * camera.gain).astype(np.float64)
    if camera.read_noise > 0:
        electrons += generator.normal(scale=camera.read_noise, size=signal.shape)
    levels = np.rint(electrons / camera.gain + camera.black_level)
    values = np.clip(levels, 0, camera.white_level).astype(np.uint16)
    black = np.array(float(camera.black_level))
    if camera.kind == "bayer":
        return Mosaic(values=values, cfa=camera.cfa, black_level=black, white_level=camera.white_level)
    return ChannelFrame(values=values, black_level=black, white_level=camera.white_level)
