"""A stereo test from two tests or results to the result in three dimensions.

The left test is an ordinary run, the right one a run on the carried mesh; both results stay whole beside the file of
the triangulated frames. Before anything is measured, what both cameras state is compared.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypedDict, Unpack

import numpy as np

from rgbmidic.disk import check_file, write_complete, write_errors
from rgbmidic.errors import InputError, ResultError
from rgbmidic.fields import MEASURES
from rgbmidic.frames import Window
from rgbmidic.illumination import IlluminationImages
from rgbmidic.illumination.calibration import Calibration
from rgbmidic.illumination.separation import Separation, reference_images
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.pipeline import measure
from rgbmidic.pipeline.plan import read_region
from rgbmidic.pipeline.user_objects import Series, open_frames
from rgbmidic.results import Result, common_variance_fraction, frame_times
from rgbmidic.results.provenance import is_result
from rgbmidic.settings import MeshSettings, TestSettings, read_test
from rgbmidic.tools.stereo.axes import AxesChoice
from rgbmidic.tools.stereo.camera_pair import CameraPair
from rgbmidic.tools.stereo.carried_mesh import carry_mesh
from rgbmidic.tools.stereo.left_result import LeftResult
from rgbmidic.tools.stereo.result import StereoResult
from rgbmidic.tools.stereo.shape import Shape, nodal_values
from rgbmidic.tools.stereo.stereo_file import STEREO_FILE, write_stereo
from rgbmidic.typing import AnyArray, IntArray, ProgressCallback

logger = logging.getLogger(__name__)

_LARGEST_DELAY = 0.25
"""Largest difference of the times of two frames of a pair, in intervals of the frames (chosen: half of one is in doubt
between two frames)."""


class RunOptions(TypedDict, total=False):
    """Options of `measure_stereo` that both runs take, see `rgbmidic.measure`."""

    overwrite: bool
    resume: bool
    workers: int | None
    progress: ProgressCallback | None


@dataclass(frozen=True, slots=True, kw_only=True)
class StereoSettings:
    """Settings of the result in three dimensions.

    Attributes
    ----------
    axes
        ``"plane"``, ``"camera"`` or three points, see `Axes.of`.
    gauge
        Length of the virtual strain gauges in px of the left frame; None: the shortest, three elements.
    measure
        Strain measure: green-lagrange, hencky, biot or engineering.
    pairing
        ``"auto"``: frames are paired by their times where both cameras state them, else by number; ``"number"``.
    """

    axes: AxesChoice = "plane"
    gauge: float | None = None
    measure: str = "green-lagrange"
    pairing: Literal["auto", "number"] = "auto"

    def __post_init__(self) -> None:
        """Check what needs no mesh before anything is measured."""
        if self.measure not in MEASURES:
            raise InputError(f'unknown strain measure "{self.measure}"; allowed are {", ".join(MEASURES)}')
        if self.pairing not in ("auto", "number"):
            raise InputError(f'frames are paired "auto" or by "number", not {self.pairing!r}')
        if isinstance(self.axes, str) and self.axes not in ("plane", "camera"):
            raise InputError(f'axes are "plane", "camera" or three points (x, y) in px, not {self.axes!r}')
        if self.gauge is not None and not 0 < self.gauge < np.inf:
            raise InputError(f"a gauge is a length in px above 0, not {self.gauge:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Test:
    """The test of one camera: its settings and frames, and its result where that is there."""

    name: str
    settings: TestSettings
    series: Series
    calibration: Calibration | None
    result: Result | None

    @classmethod
    def open(cls, test: TestSettings | Path | str) -> _Test:
        """Read a TEST.toml, or the settings of a result folder."""
        result = None
        if not isinstance(test, TestSettings) and Path(test).is_dir():
            result = Result.open(test)
            if isinstance(result, LeftResult):
                raise InputError(f"{test} is a result of two cameras; the result of one is {result.left.path}")
            settings = TestSettings.from_mapping(result.provenance["settings"], result.provenance["base"])
        else:
            settings = test if isinstance(test, TestSettings) else read_test(test)
        calibration = None if settings.calibration.file is None else Calibration.read(settings.calibration.file)
        series = open_frames(settings, None, calibration)
        cropped = calibration and calibration.cropped(settings.frames.crop_origin, series.shape)
        name = "a test" if isinstance(test, TestSettings) else str(test)
        return cls(name=name, settings=settings, series=series, calibration=cropped, result=result)

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights that the calibration has; none without."""
        calibration = self.calibration
        sections = (calibration.crosstalk, calibration.registration) if calibration else ()
        return next((section.lights for section in sections if section is not None), ())

    @property
    def rate(self) -> float | None:
        """Frames per second that are measured, as TEST.toml or else the camera states it."""
        rate = self.settings.scale.frame_rate or self.series.recording.frame_rate
        return rate and rate / self.series.selected.step

    @property
    def references(self) -> list[float]:
        """Positions of the reference frames, counted from the first that is measured."""
        selected = self.series.selected
        return [(index - selected.start) / selected.step for index in self.settings.frames.reference]

    @property
    def numbers(self) -> IntArray:
        """Number of each frame, counted from the first that is measured."""
        selected = self.series.selected
        return np.array([self.series.numbers[index] - self.series.numbers[selected[0]] for index in selected])

    @property
    def times(self) -> AnyArray | None:
        """Time of each frame in s from the trigger, (T,); None where the camera does not state it."""
        stamps = [self.series.time_ns(index) for index in self.series.selected]
        if any(stamp is None for stamp in stamps):
            return None
        return 1e-9 * np.array(stamps, dtype=np.float64)

    def reference(self) -> IlluminationImages:
        """Return the mean images of the lights over the reference frames, each where the lens put it."""
        separation = Separation(calibration=self.calibration, demosaic=self.settings.illumination.demosaic)
        full_frame = Window.of_frame(self.series.shape)
        states = (self.series.read(index, full_frame) for index in self.settings.frames.reference)
        return reference_images(separation, states, full_frame)[0]


def measure_stereo(
    left: TestSettings | Path | str,
    right: TestSettings | Path | str,
    camera: CameraPair | Path | str,
    out: Path | str,
    settings: StereoSettings = StereoSettings(),
    **run: Unpack[RunOptions],
) -> StereoResult:
    """Measure shape, motion and strain of a surface that two cameras see.

    Parameters
    ----------
    left, right
        Test of either camera: settings, the path of a TEST.toml, or the folder of a result. A left result is taken as
        it is; a right one is measured again with its settings, since its nodes are other points, unless it was
        measured on the carried mesh.
    camera
        The cameras, or the file that ``rgbmidic-calibrate stereo`` wrote.
    out
        Folder: ``left`` and ``right`` in it are ordinary results, ``stereo.vtkhdf`` is the result in three dimensions.
    settings
        Axes, gauges, pairing.
    **run
        ``overwrite``, ``resume``, ``workers`` and ``progress`` as of `rgbmidic.measure`.

    Returns
    -------
    StereoResult

    Raises
    ------
    RgbmidicError
        As `rgbmidic.measure`; or both tests contradict each other or the cameras.
    """
    out, pair = Path(out), camera if isinstance(camera, CameraPair) else CameraPair.read(camera)
    file, calibration = out / STEREO_FILE, json.dumps(pair.parameters.tolist())
    if file.exists():
        check_file(file, overwrite=run.get("overwrite", False) or run.get("resume", False))
        with suppress(ResultError):  # of another version: it is triangulated again
            if run.get("resume", False) and StereoResult.open(file).attributes["calibration"] != calibration:
                raise InputError(
                    f"{file} is of other cameras than {pair.name}; choose another name (`overwrite=True` replaces it)"
                )
    first, second, shape = _measure_cameras((left, right), pair, out, settings, run)
    meshes = shape.carried_mesh
    attributes = {
        "axes": shape.axes.description,
        "axes_origin_mm": shape.axes.origin,
        "axes_rotation": shape.axes.rotation,
        "gauge_px": shape.gauges.length,
        "measure": settings.measure,
        "relative_length_std": shape.calibration.length_std,
        "common_variance_fraction": common_variance_fraction(first),
        "left": _path_from(out, first.path),
        "right": _path_from(out, second.path),
        "calibration": calibration,
    }

    def frames() -> Iterator[dict[str, AnyArray]]:
        for index in range(len(first)):
            sides = nodal_values(first, index, meshes.nodes), nodal_values(second, index)
            yield {
                "number": sides[0]["number"],
                "status": np.maximum(sides[0]["status"], sides[1]["status"]),
                "reference": is_reference[index],
                **shape.frame(*sides),
            }

    with write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
    doubts, is_reference = list[str](), first.in_units().references
    times = frame_times(first)
    write_complete(
        file,
        lambda stream: doubts.extend(
            write_stereo(stream, shape, names=first.names, times=times, frames=frames(), attributes=attributes)
        ),
    )
    for text in doubts:
        if text not in meshes.warnings:  # reported when it was found
            logger.warning("%s", text)
    return StereoResult.open(file)


def measure_stereo_part(
    left: TestSettings | Path | str,
    right: TestSettings | Path | str,
    camera: CameraPair | Path | str,
    out: Path | str,
    frames: range,
    settings: StereoSettings = StereoSettings(),
    *,
    workers: int | None = None,
    progress: ProgressCallback | None = None,
) -> None:
    """Measure some frames of both cameras; other processes may measure others into the folder at the same time.

    When all are measured, `measure_stereo` with ``resume`` triangulates them.

    Parameters
    ----------
    left, right, camera, out, settings
        As of `measure_stereo`.
    frames
        Indices of the frames, those that the settings choose.
    workers, progress
        As of `rgbmidic.measure`.

    Raises
    ------
    RgbmidicError
        As of `measure_stereo`.
    """
    options: RunOptions = {"workers": workers, "progress": progress}
    _measure_cameras((left, right), camera, Path(out), settings, options, frames)


def _measure_cameras(
    cameras: tuple[TestSettings | Path | str, TestSettings | Path | str],
    camera: CameraPair | Path | str,
    out: Path,
    settings: StereoSettings,
    run: RunOptions,
    frames: range | None = None,
) -> tuple[Result, Result, Shape]:
    """Measure both cameras' frames; return both results and the undeformed surface."""
    pair = camera if isinstance(camera, CameraPair) else CameraPair.read(camera)
    tests = _Test.open(cameras[0]), _Test.open(cameras[1])
    _check(pair, tests)
    _check_times(tests, settings.pairing)
    images = tests[0].reference(), tests[1].reference()
    if images[0].names != images[1].names:
        names = " and ".join(f"{', '.join(of.names)} ({test.name})" for of, test in zip(images, tests, strict=True))
        raise InputError(f"both cameras must see the same lights in the same order; theirs are {names}")
    first = tests[0].result or measure(tests[0].settings, out / "left", **_options(out / "left", run, frames))
    mesh_pair = carry_mesh(
        images,
        Tri3Mesh(nodes=first.nodes, elements=first.elements),
        pair=pair,
        right_region=read_region(tests[1].settings.region, tests[1].series.shape),
        solver=tests[0].settings.solver,
    )
    shape = Shape.of(pair, mesh_pair, axes=settings.axes, gauge=settings.gauge, measure=settings.measure)
    second = _measure_right(
        tests[1], mesh_pair.right, mesh_pair.region, out / "right", _options(out / "right", run, frames)
    )
    return first, second, shape


def _path_from(out: Path, path: Path) -> str:
    """Return the path of a result as seen from the stereo result, where it lies in it: both may be moved together."""
    path, out = path.resolve(), out.resolve()
    return path.relative_to(out).as_posix() if path.is_relative_to(out) else str(path)


def _options(out: Path, run: RunOptions, frames: range | None) -> dict[str, Any]:
    """Return the options of a run into a folder: one that has not begun is not resumed."""
    return {**run, "resume": run.get("resume", False) and is_result(out), "frames": frames}


def _measure_right(test: _Test, mesh: Tri3Mesh, region: Region, out: Path, options: dict[str, Any]) -> Result:
    """Measure the right test on the carried mesh; a result that was measured on it is taken as it is."""
    if test.result is not None and np.array_equal(test.result.nodes, mesh.nodes):
        return test.result
    settings = replace(test.settings, mesh=MeshSettings(element_size=mesh.size, error=test.settings.mesh.error))
    return measure(settings, out, mesh=mesh, region=region, **options)


def _check(pair: CameraPair, tests: tuple[_Test, _Test]) -> None:
    """Refuse tests that contradict each other or the cameras."""
    left, right = tests
    if (left.settings.frames, left.settings.region) == (right.settings.frames, right.settings.region):
        raise InputError(
            f"{left.name} and {right.name} name the same frames and region: each camera has frames of its own"
        )
    for test in tests:
        if test.settings.scale.mm_per_pixel is not None or test.settings.scale.camera is not None:
            logger.warning(
                f"{test.name}: its scale in the plane does not enter, lengths in space are those of {pair.name}"
            )
    meshes = [{**asdict(mesh), "error": None} for mesh in (right.settings.mesh, left.settings.mesh, MeshSettings())]
    if right.result is None and meshes[0] not in meshes[1:]:
        raise InputError(f"{right.name}: its mesh is that of {left.name}, carried over: state the same [mesh], or none")
    pair.check((left.series.shape, right.series.shape))
    pair.check_lights((left.lights, right.lights))
    counts = [len(test.series.selected) for test in tests]
    if counts[0] != counts[1]:
        raise InputError(
            f"both cameras must have as many frames: {left.name} has {counts[0]}, {right.name} {counts[1]}; choose "
            "them with frames.first, last and step"
        )
    references = [test.references for test in tests]
    if references[0] != references[1]:
        raise InputError(
            f"frames.reference must name the same states of both cameras, counted in frames from frames.first: "
            f"{left.name} has {references[0]}, {right.name} {references[1]}"
        )
    rates = left.rate, right.rate
    if rates[0] and rates[1] and abs(rates[0] / rates[1] - 1) > 0.01:
        raise InputError(
            f"both cameras must have one frame rate: {left.name} has {rates[0]:g}, {right.name} {rates[1]:g} frames "
            "per second"
        )


def _check_times(tests: tuple[_Test, _Test], pairing: str) -> None:
    """Refuse frames of both cameras that were not taken at one time; say that they are paired by number."""
    left, right = tests
    times = left.times, right.times
    if pairing == "number" or times[0] is None or times[1] is None:
        if pairing != "number":
            logger.warning("frames of both cameras are paired by number: not every frame of both has a time stamp")
        differ = np.flatnonzero(left.numbers != right.numbers)
        if len(differ):
            numbers = f"{left.numbers[differ[0]]} and {right.numbers[differ[0]]}"
            raise InputError(
                f"frames {differ[0]} of {left.name} and {right.name} have the numbers {numbers}, counted from the "
                "first: one of the cameras has lost frames; leave out the same ones of the other"
            )
        return
    delays = np.abs(times[1] - times[0])
    interval = float(np.median(np.diff(times[0]))) if len(delays) > 1 else np.inf
    if delays.max() > _LARGEST_DELAY * interval:
        worst = int(np.argmax(delays))
        first = int(np.argmax(delays > _LARGEST_DELAY * interval))
        raise InputError(
            f"frames {first} of {left.name} and {right.name} were taken {delays[first]:.3g} s apart (frames {worst}: "
            f"{delays[worst]:.3g} s), with {interval:.3g} s between frames: choose the same ones with frames.first and "
            "last, or pair them by number (`pairing`) if the clocks differ"
        )
