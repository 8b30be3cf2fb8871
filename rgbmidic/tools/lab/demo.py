"""The demonstration: a virtual test made, calibrated, measured and compared with its exact truth.

It goes the way a laboratory goes: raw frames and calibration captures on disk, the two commands, the result folder.
While the frames are rendered, other processes compile the kernels of the measurement.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.special import erf

from rgbmidic._kernels import are_compiled
from rgbmidic.disk import write_errors
from rgbmidic.errors import ResultError
from rgbmidic.fields import CameraCalibration, at_nodes, field_rms
from rgbmidic.fields.plane import undistorted
from rgbmidic.frames import open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline import Plan, Separation, correlate, measure
from rgbmidic.results import Result
from rgbmidic.results.result_in_units import ResultInUnits
from rgbmidic.settings import ScaleSettings, TestSettings, read_test
from rgbmidic.tools.preparation.element_size import rms
from rgbmidic.typing import FloatArray, FloatImage, ProgressCallback

_SCENE = """\
# The paper's sphere (82.5 mm) turning about its front point under a red, a green and a blue lamp, all at once.
# Body, paint, lamps and camera are those that stand in where a scene states none (docs/how-to/planning.md); the lens
# has half a pixel of lateral colour at the corners from one lamp to the next.
[camera]
shape = [{size}, {size}]

[output]
seed = 2026
"""
ANGLES = (0.33, 1.0, 2.0, 8.0)
"""Rotations of the sphere, degrees."""
_SIZE = 96
"""Rows and columns of the frames, px: nine elements of the usual size."""
_REGION = (10, 10, 86, 86)

PLATE_MOTIONS = {"shifted by 1.22 mm": ((1.0, -0.7), 0.0), "and stretched by 1 %": ((0.5, 0.3), 0.01)}
"""Motions of the tilted plate: shift (x, y) in mm, strain along x."""
_PLATE_SHAPE, _LENS = (480, 640), (2400.0, 327.0, 232.0, -0.72, 0.0, 0.0, 0.0, 0.0)
"""Its frames, px, and `rgbmidic.fields.plane.LENS_PARAMETERS`: a barrel of 2 % in the corners."""
_PLATE_DISTANCE, _TILT = 225.0, (4.0, 3.0)
"""mm to the plate, at which the frame is 60 mm wide, and its tilt about x and y, degrees."""
_BOARD, _SQUARE = (9, 7), 5.0
"""Inner corners of the chessboard, and its squares' side, mm."""
_VIEWS = (
    ((20.0, 0.0, 0.0), (-7.0, -4.0)),
    ((-20.0, 5.0, 4.0), (7.0, -4.0)),
    ((5.0, 22.0, 8.0), (-6.0, 4.0)),
    ((0.0, -22.0, 12.0), (6.0, 4.0)),
    ((15.0, 15.0, 16.0), (0.0, 0.0)),
    ((-14.0, -16.0, 20.0), (0.0, 0.0)),
)
"""Turns of the chessboard about x, y and z, degrees, and its place beside the axis, mm."""
_WAVES = 36
"""Waves of the speckle: a sum of cosines whose contrast is then cut off."""
_PLATE_SETTINGS = """\
# A flat specimen tilted by 5 degrees behind a lens that distorts by 2 % in the corners.
[frames]
path = "plate/*.png"
kind = "monochrome"
black_level = 0
white_level = 65535
[region]
rectangle = [60, 60, 580, 420]
[scale]
camera = "camera.json"
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoRow:
    """One frame of the demonstration.

    Attributes
    ----------
    angle_deg
        Rotation of the sphere.
    rms_px
        Root mean square error of the displacement over the field, px.
    predicted_px
        Root mean square of the uncertainty that the result states for its nodes, px.
    nodal_px
        Root mean square error at the nodes, px.
    single_px
        Error of each colour alone, with the same solver.
    measured
        Fraction of the nodes that are measured.
    """

    angle_deg: float
    rms_px: float
    predicted_px: float
    nodal_px: float
    single_px: tuple[float, ...]
    measured: float


def run_demo(
    out: Path,
    report: Callable[[str], None],
    calibrate: Callable[[Path], None],
    progress: ProgressCallback | None = None,
    *,
    size: int = 448,
    angles: Sequence[float] = ANGLES,
) -> list[DemoRow]:
    """Make the virtual test in `out`/test, calibrate it, measure it into `out`/result, and compare.

    Parameters
    ----------
    out
        Folder; it must be empty or not exist.
    report
        Called with a line about each step.
    calibrate
        Called with the folder of the virtual test; writes calibration.json from the captures there.
    progress
        Called with frames done, their total and a line.
    size
        Rows and columns of the frames, px.
    angles
        Rotations of the sphere, degrees, one frame each.

    Returns
    -------
    list of DemoRow
        One row per turned frame.

    Raises
    ------
    RgbmidicError
        The folder is not empty, or a step fails.
    """
    from rgbmidic.tools.lab.virtual.dataset import write_dataset

    test, scene = out / "test", out / "scene.toml"
    if out.exists() and any(out.iterdir()):
        raise ResultError(f"{out} is not empty; nothing is overwritten: choose another folder (`out`)")
    out.mkdir(parents=True, exist_ok=True)
    states = "".join(f"\n[[states]]\nangle_deg = {angle}\n" for angle in angles)
    scene.write_text(_SCENE.format(size=size) + states, encoding="utf-8")
    report(f"1 of 7: virtual test, some 15 s: raw DNG frames, calibration captures and the exact truth in {test}")
    with compile_kernels_in_background():
        settings_file = write_dataset(scene, test, progress)
        (test / "calibration.json").rename(test / "true_calibration.json")
        report("2 of 7: calibration, 2 s, as rgbmidic-calibrate crosstalk, registration and merge do from captures")
        calibrate(test)
    settings = read_test(settings_file)
    report(f"3 of 7: measurement, some 3 s: rgbmidic run {settings_file} --out {out / 'result'}")
    result = measure(settings, out / "result", progress=progress)
    report("4 of 7: the same with each colour alone, for comparison, some 5 s")
    return _compare(settings, result)


def _compare(settings: TestSettings, result: Result) -> list[DemoRow]:
    with np.load(settings.base / "truth.npz") as archive:
        truth, angles = archive["displacement"].astype(np.float64), archive["angle_deg"]
    mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
    assert settings.calibration.file is not None
    calibration = Calibration.read(settings.calibration.file)
    separation, frames = Separation(calibration=calibration), open_series(settings.frames, settings.base, calibration)
    images = [separation(frames.read(index)).on_first_light().values for index in range(len(frames))]
    options: dict[str, Any] = {
        "region": settings.region.rectangle,
        "element_size": settings.mesh.element_size,
        "brightness": settings.solver.brightness,
    }
    rows = []
    for index in range(1, len(result)):
        field = np.stack([result.u[index], result.v[index]], axis=1)
        single_fields = [
            correlate(*pair, **options).displacement for pair in zip(images[0], images[index], strict=True)
        ]
        std = np.stack([result.u_std[index], result.v_std[index]], axis=1)
        rows.append(
            DemoRow(
                angle_deg=float(angles[index]),
                rms_px=field_rms(mesh, field, truth[index]),
                nodal_px=rms(field - at_nodes(truth[index], mesh.nodes)),
                predicted_px=rms(std),
                single_px=tuple(field_rms(mesh, single, truth[index]) for single in single_fields),
                measured=float(np.isfinite(field[:, 0]).mean()),
            )
        )
    return rows


@dataclass(frozen=True, slots=True, kw_only=True)
class PlateRow:
    """One motion of the tilted plate: root mean square errors against the exact truth, and what the result states.

    Attributes
    ----------
    motion
        What it does.
    displacement_mm
        Error by lens and plane, and by one scale for all of the frame.
    strain
        Error of the Green-Lagrange strains exx, eyy and exy, likewise.
    stated_mm, stated_strain
        Standard uncertainty that the result states of its noise, by lens and plane.
    """

    motion: str
    displacement_mm: tuple[float, float]
    strain: tuple[float, float]
    stated_mm: float
    stated_strain: float


def write_plate(test: Path) -> CameraCalibration:
    """Write photographs of a chessboard, and of a speckled plate that moves, behind a lens that distorts.

    Six views of the chessboard in `test`/target, one on the plate in `test`/plane, the plate at rest and after each of
    `PLATE_MOTIONS` in `test`/plate, and plate.toml for `rgbmidic run`. Every pixel is traced to its place on the plane.

    Returns
    -------
    CameraCalibration
        The true lens and plane, in the axes of the image.
    """
    random = np.random.default_rng(2026)
    rows, columns = _PLATE_SHAPE
    y, x = np.mgrid[:rows, :columns]

    straight = undistorted(np.array(_LENS), np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64))

    def photograph(name: str, values: FloatArray) -> None:
        """Write values of 0 to 1 as grey levels, with noise of .25 % of the full scale."""
        (test / name).parent.mkdir(exist_ok=True)
        levels = 65535 * (0.05 + 0.8 * values + random.normal(0, 0.0025, values.shape))
        _, content = cv2.imencode(".png", np.round(levels).clip(0, 65535).astype(np.uint16).reshape(_PLATE_SHAPE))
        with write_errors(test / name):  # OpenCV itself opens no non-ASCII names on Windows
            (test / name).write_bytes(content.tobytes())

    def board(name: str, turns: Sequence[float], position: tuple[float, float, float]) -> None:
        positions = replace(_posed_camera(turns, position), lens=None).to_mm(straight)
        waves = []
        for coordinates, count in zip(positions.T, _BOARD, strict=True):
            line = np.clip(np.round(coordinates / _SQUARE + (count - 1) / 2), -1, count) - (count - 1) / 2
            sign = np.where((line - (count - 1) / 2) % 2 == 0, 1, -1)
            waves.append(sign * erf((coordinates - line * _SQUARE) / (0.1 * position[2] / _PLATE_DISTANCE)))
        on_board = (np.abs(positions) < (np.array(_BOARD) + 1) / 2 * _SQUARE).all(axis=1)
        photograph(name, np.where(on_board, 0.5 - 0.5 * waves[0] * waves[1], 1.0))

    for number, (turns, offset) in enumerate(_VIEWS):
        board(f"target/view_{number}.png", turns, (*offset, 1.15 * _PLATE_DISTANCE))
    board("plane/plane.png", (*_TILT, 0.0), (0.0, 0.0, _PLATE_DISTANCE))
    camera, _ = _posed_camera((*_TILT, 0.0), (0.0, 0.0, _PLATE_DISTANCE)).in_image_axes()
    positions = replace(camera, lens=None).to_mm(straight)
    directions, lengths = random.uniform(0, np.pi, _WAVES), random.uniform(0.6, 1.5, _WAVES)
    waves = 2 * np.pi * np.stack([np.cos(directions), np.sin(directions)]) / lengths  # per mm: of 6 to 16 px
    phases = random.uniform(0, 2 * np.pi, _WAVES)
    for number, (shift, stretch) in enumerate([((0.0, 0.0), 0.0), *PLATE_MOTIONS.values()]):
        material = (positions - np.array(shift)) / np.array([1 + stretch, 1.0])
        paint = sum(np.cos(material @ wave + phase) for wave, phase in zip(waves.T, phases, strict=True))
        photograph(f"plate/frame_{number}.png", 0.5 + 0.5 * np.tanh(2 / np.sqrt(_WAVES) * np.asarray(paint)))
    (test / "plate.toml").write_text(_PLATE_SETTINGS, encoding="utf-8")
    return camera


def run_plate(test: Path, truth: CameraCalibration) -> list[PlateRow]:
    """Measure the plate of `write_plate` by `test`/camera.json and plate.toml, and compare with the `truth`."""
    result = measure(read_test(test / "plate.toml"), test.parent / "plate_result")
    positions, scale = truth.to_mm(result.nodes), truth.scale(truth.centre)[0]
    scales = (ResultInUnits.from_result(result), ResultInUnits.from_result(result, ScaleSettings(mm_per_pixel=scale)))
    rows = []
    for index, (name, (shift, stretch)) in enumerate(PLATE_MOTIONS.items(), start=1):
        exact = positions * np.array([stretch, 0.0]) + np.array(shift)
        fields = [physical.frame(index) for physical in scales]
        errors = [np.stack([field["u"], field["v"]], axis=1) - exact for field in fields]
        exact_strain = {"exx": stretch + stretch**2 / 2, "eyy": 0.0, "exy": 0.0}
        strains = [np.stack([field[name] - value for name, value in exact_strain.items()]) for field in fields]
        rows.append(
            PlateRow(
                motion=name,
                displacement_mm=(rms(errors[0]), rms(errors[1])),
                strain=(rms(strains[0]), rms(strains[1])),
                stated_mm=rms(np.stack([fields[0]["u_std"], fields[0]["v_std"]])),
                stated_strain=rms(np.stack([fields[0][f"{name}_std"] for name in exact_strain])),
            )
        )
    return rows


def _posed_camera(turns: Sequence[float], position: tuple[float, float, float]) -> CameraCalibration:
    """Return the virtual camera before a plane turned about x, y and z (degrees), its middle at a place (mm)."""
    rows, columns = _PLATE_SHAPE
    focal, cx, cy = _LENS[:3]
    offset = np.array([cx - (columns - 1) / 2, cy - (rows - 1) / 2])
    matrix = np.array([[focal, 0, offset[0]], [0, focal, offset[1]], [0, 0, 1.0]])
    turn = np.asarray(cv2.Rodrigues(np.radians(turns))[0])
    homography = np.linalg.inv(matrix @ np.c_[turn[:, :2], position])
    return CameraCalibration(shape=_PLATE_SHAPE, lens=np.array(_LENS), homography=homography / homography[2, 2])


@contextmanager
def compile_kernels_in_background() -> Iterator[None]:
    """Compile the kernels of a measurement, while the block runs, by two processes that measure in small.

    One compiles those of the separation, the other those of the solve; the kernels then lie in the cache. Nothing is
    started where kernels were compiled on this machine before.
    """
    if are_compiled():
        yield
        return
    with ExitStack() as stack:
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        # -P: not the package of a clone in whose folder this runs, whose kernels lie elsewhere
        commands = [[sys.executable, "-P", "-m", __name__, name] for name in _SMALL_MEASUREMENTS]
        processes = [stack.enter_context(subprocess.Popen(command, **quiet)) for command in commands]
        try:
            yield
        except BaseException:
            for process in processes:
                process.kill()
            raise


def _separate() -> None:
    """Prepare a measurement of raw frames and separate their lights."""
    from rgbmidic.tools.lab.virtual.dataset import record, settings_text, true_calibration, write_frame
    from rgbmidic.tools.lab.virtual.rendering import sphere_scene
    from rgbmidic.tools.scene.scene import DatasetSettings

    scene, settings = sphere_scene(size=_SIZE, lateral_colour=0.5), DatasetSettings()
    with tempfile.TemporaryDirectory() as folder:
        for index in range(2):
            frame = record(_images(index), scene.camera, scene.lights, seed=index)
            write_frame(Path(folder) / "frames", index, frame, settings)
        true_calibration(scene).write(Path(folder) / "calibration.json")
        test = Path(folder) / "test.toml"
        test.write_text(settings_text(scene, settings, _REGION), encoding="utf-8")
        plan = Plan.from_settings(read_test(test))
        frames = plan.series.read(1)
        assert isinstance(frames, tuple)
        plan.separation(frames)


def _images(index: int) -> FloatImage:
    """Return the blobs under three lights, a fraction of a pixel further from frame to frame."""
    from scipy.ndimage import gaussian_filter, shift

    blobs = gaussian_filter(np.random.default_rng(0).normal(size=(3, _SIZE, _SIZE)), (0, 1.5, 1.5))
    images = shift(blobs, (0, 0, 0.3 * index), mode="nearest")
    return np.clip(1000 + 2000 * images, 0, None).astype(np.float32)


_SMALL_MEASUREMENTS: dict[str, Callable[[], object]] = {
    "separation": _separate,
    "solve": lambda: correlate(_images(0), _images(1), region=_REGION),
}

if __name__ == "__main__":
    _SMALL_MEASUREMENTS[sys.argv[1]]()
