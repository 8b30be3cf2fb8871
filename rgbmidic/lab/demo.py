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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rgbmidic._kernels import are_compiled
from rgbmidic.errors import ResultError
from rgbmidic.fields import at_nodes, field_rms
from rgbmidic.frames import open_series
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.unmixing import align
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.pipeline import Plan, Separation, correlate, measure
from rgbmidic.results import Result
from rgbmidic.settings import TestSettings, read_test
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["DemoRow", "run_demo"]

_SCENE = """\
# The paper's sphere (82.5 mm) turning about its front point under a red, a green and a blue lamp, all at once.
# Body, paint, lamps and camera are those that stand in where a scene states none (docs/planning.md).
[camera]
shape = [{size}, {size}]

[output]
seed = 2026
target = "speckled"
"""
ANGLES = (0.33, 1.0, 2.0, 8.0)
"""Rotations of the sphere, degrees."""


_SIZE = 96
"""Rows and columns of the frames, px: nine elements of the usual size."""
_REGION = (10, 10, 86, 86)
_SETTINGS = f"""\
[frames]
path = "*.dng"
[calibration]
file = "calibration.json"
[region]
rectangle = {list(_REGION)}
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
    progress: Callable[[int, int, str], None] | None = None,
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
    from rgbmidic.lab.virtual.dataset import write_dataset

    test, scene = out / "test", out / "scene.toml"
    if out.exists() and any(out.iterdir()):
        raise ResultError(f"{out} is not empty; nothing is overwritten: choose another folder (--out)")
    out.mkdir(parents=True, exist_ok=True)
    states = "".join(f"\n[[states]]\nangle_deg = {angle}\n" for angle in angles)
    scene.write_text(_SCENE.format(size=size) + states, encoding="utf-8")
    report(f"1 of 5: virtual test, some 15 s: raw DNG frames, calibration captures and the exact truth in {test}")
    with kernels_compiled_meanwhile():
        settings_file = write_dataset(scene, test, progress)
        (test / "calibration.json").rename(test / "true_calibration.json")
        report("2 of 5: calibration, 1 s, as rgbmidic-calibrate crosstalk does from captures with one light at a time")
        calibrate(test)
    settings = read_test(settings_file)
    report(f"3 of 5: measurement, some 3 s: rgbmidic run {settings_file} --out {out / 'result'}")
    result = measure(settings, out / "result", progress=progress)
    report("4 of 5: the same with each colour alone, for comparison, some 5 s")
    return _compare(settings, result)


def _compare(settings: TestSettings, result: Result) -> list[DemoRow]:
    with np.load(settings.base / "truth.npz") as archive:
        truth, angles = archive["displacement"].astype(np.float64), archive["angle_deg"]
    mesh = Tri3Mesh(nodes=result.nodes, elements=result.elements)
    assert settings.calibration_file is not None
    calibration = Calibration.read(settings.calibration_file)
    separation, frames = Separation(calibration=calibration), open_series(settings.frames, settings.base, calibration)
    images = [align(separation(frames.read(index))).values for index in range(len(frames))]
    options: dict[str, Any] = {
        "region": settings.region.rectangle,
        "element_size": settings.element_size,
        "normalise": settings.illumination.normalise,
    }
    rows = []
    for index in range(1, len(result)):
        field = np.stack([result.u[index], result.v[index]], axis=1)
        alone = [correlate(*pair, **options).displacement for pair in zip(images[0], images[index], strict=True)]
        std = np.stack([result.u_std[index], result.v_std[index]], axis=1)
        rows.append(
            DemoRow(
                angle_deg=float(angles[index]),
                rms_px=field_rms(mesh, field, truth[index]),
                nodal_px=_rms(field - at_nodes(truth[index], mesh.nodes)),
                predicted_px=_rms(std),
                single_px=tuple(field_rms(mesh, single, truth[index]) for single in alone),
                measured=float(np.isfinite(field[:, 0]).mean()),
            )
        )
    return rows


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


@contextmanager
def kernels_compiled_meanwhile() -> Iterator[None]:
    """Compile the kernels of a measurement, while the block runs, by two processes that measure in small.

    One compiles those of the separation, the other those of the solve; the kernels then lie in the cache. Nothing is
    started where kernels were compiled on this machine before.
    """
    if are_compiled():
        yield
        return
    with ExitStack() as stack:
        quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        commands = [[sys.executable, "-m", __name__, part] for part in _SMALL_MEASUREMENTS]
        others = [stack.enter_context(subprocess.Popen(command, **quiet)) for command in commands]
        try:
            yield
        except BaseException:
            for one in others:
                one.kill()
            raise


def _separate() -> None:
    """Prepare a measurement of raw frames and separate their lights."""
    from rgbmidic.frames.data import Mosaic
    from rgbmidic.frames.images import write_dng
    from rgbmidic.lab.virtual.dataset import record, true_calibration
    from rgbmidic.lab.virtual.rendering import sphere_scene

    scene = sphere_scene(size=_SIZE)
    with tempfile.TemporaryDirectory() as folder:
        for index in range(2):
            frame = record(_images(index), scene.camera, scene.lights, seed=index)
            assert isinstance(frame, Mosaic)
            write_dng(Path(folder) / f"{index}.dng", frame)
        true_calibration(scene).write(Path(folder) / "calibration.json")
        (Path(folder) / "test.toml").write_text(_SETTINGS, encoding="utf-8")
        plan = Plan.from_settings(read_test(Path(folder) / "test.toml"))
        plan.separation(plan.series.read(1))


def _images(index: int) -> FloatImage:
    """Blobs under three lights, a fraction of a pixel further from frame to frame."""
    from scipy.ndimage import gaussian_filter, shift

    blobs = gaussian_filter(np.random.default_rng(0).normal(size=(3, _SIZE, _SIZE)), (0, 1.5, 1.5))
    moved = shift(blobs, (0, 0, 0.3 * index), mode="nearest")
    return np.clip(1000 + 2000 * moved, 0, None).astype(np.float32)


_SMALL_MEASUREMENTS: dict[str, Callable[[], object]] = {
    "separation": _separate,
    "solve": lambda: correlate(_images(0), _images(1), region=_REGION),
}

if __name__ == "__main__":
    _SMALL_MEASUREMENTS[sys.argv[1]]()
