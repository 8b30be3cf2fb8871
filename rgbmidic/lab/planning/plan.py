"""Planning a test before a lamp is mounted: where the reflections fall and what can be measured.

Everything follows from a SCENE.toml: its reflection zones (`rgbmidic.scene.zones`) and the uncertainty in closed form
(`rgbmidic.scene.forecast`). Nothing is rendered.

A measurement in small by processes of its own: what they compile lies in the cache when it is needed.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rgbmidic._kernels import are_compiled
from rgbmidic.errors import InputError
from rgbmidic.scene.forecast import Forecast, Instrument, trace_change
from rgbmidic.scene.scene import Experiment, Scene, State
from rgbmidic.scene.zones import REFLECTS, Zones, material_points, predict_zones, truth
from rgbmidic.settings import IlluminationSettings
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["Outlook", "Plan", "make_plan", "outlook", "rehearsed"]

_POINTS = 80
"""Points of the prediction along the longer side of the frame."""
_MARGIN = 20.0
"""Pixels between the frame's edge and what moves nearest to it, where the scene states no region."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outlook:
    """What is expected of one state, at points of the reference image; NaN where the body is not seen.

    Attributes
    ----------
    state
        The deformed state.
    zones
        Prediction in this state at the material points of the reference image.
    displacement : ndarray, shape (2, h, w)
        px.
    reflects : ndarray, shape (k, h, w), bool
        Whether the light's specular share exceeds `rgbmidic.scene.zones.REFLECTS` in the reference or in this state.
    lit : ndarray, shape (k, h, w), bool
        Whether the light reaches the point in both.
    saturated : ndarray, shape (k, h, w), bool
        Whether white paint saturates in either.
    forecast
        Uncertainty of a node there.
    """

    state: State
    zones: Zones
    displacement: FloatArray
    reflects: BoolArray
    lit: BoolArray
    saturated: BoolArray
    forecast: Forecast

    @property
    def clean(self) -> npt.NDArray[np.int64]:
        """Number of lights (h, w) that are there and do not reflect."""
        return np.asarray((self.lit & ~self.saturated & ~self.reflects).sum(axis=0))

    @property
    def std(self) -> FloatArray:
        """Standard uncertainty (h, w) of u, and of v, in px: noise and reflections."""
        return np.hypot(self.forecast.std, self.forecast.bias)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A scene with what is expected of it.

    Attributes
    ----------
    scene
        Lamps, camera, paint and body.
    instrument
        What camera, paint and processing make of them.
    field
        (x0, y0, x1, y1) in px of the reference image: what is to be measured.
    x, y : ndarray, shape (h, w)
        Points (px) of the reference image at which everything is predicted.
    inside : ndarray, shape (h, w), bool
        Those in the field.
    reference
        Zones of the reference state at these points.
    outlooks
        One for each state of the scene.
    """

    scene: Scene
    instrument: Instrument
    field: tuple[float, float, float, float]
    x: FloatArray
    y: FloatArray
    inside: BoolArray
    reference: Zones
    outlooks: tuple[Outlook, ...]

    def with_lamps(self, scene: Scene) -> Plan:
        """The same plan with a scene whose lamps stand elsewhere."""
        reference, outlooks = _predict(scene, self.instrument, self.x, self.y, [o.state for o in self.outlooks])
        return replace(self, scene=scene, reference=reference, outlooks=outlooks)

    def share(self, mask: BoolArray) -> float:
        """Share of the field on which a mask (h, w) holds."""
        return float(mask[self.inside].mean())

    @property
    def std(self) -> float:
        """Root mean square, over field and states, of the standard uncertainty (px); infinite where nothing is seen."""
        values = np.stack([outlook.std[self.inside] for outlook in self.outlooks])
        return float(np.sqrt(np.mean(np.where(np.isfinite(values), values, np.inf) ** 2)))


def make_plan(experiment: Experiment) -> Plan:
    """Predict every state of a scene.

    Parameters
    ----------
    experiment
        What `rgbmidic.scene.scene.read_scene` reads; without states, the body at rest is compared with itself.

    Raises
    ------
    InputError
        The field does not lie on the body in every state.
    """
    scene = experiment.scene
    states = list(experiment.states) or [State()]
    instrument = Instrument.of(
        scene, element_size=experiment.output.element_size, demosaic=IlluminationSettings().demosaic
    )
    height, width = scene.camera.shape
    step = max(height, width) / _POINTS
    x, y = np.meshgrid(np.arange(0, width - 0.5, step), np.arange(0, height - 0.5, step))
    reference, outlooks = _predict(scene, instrument, x, y, states)
    motion = np.stack([outlook.displacement for outlook in outlooks])
    field = experiment.output.region or _field_in_view(x, y, motion, scene.camera.shape)
    inside = (x >= field[0]) & (y >= field[1]) & (x <= field[2]) & (y <= field[3])
    if not inside.any() or not np.isfinite(motion[:, :, inside]).all():
        raise InputError(f"the field {list(field)} px does not lie on the body in every state")
    return Plan(
        scene=scene,
        instrument=instrument,
        field=field,
        x=x,
        y=y,
        inside=inside,
        reference=reference,
        outlooks=outlooks,
    )


def _predict(
    scene: Scene, instrument: Instrument, x: FloatArray, y: FloatArray, states: list[State]
) -> tuple[Zones, tuple[Outlook, ...]]:
    material = material_points(scene, None, (x, y))
    reference = predict_zones(scene, material=material)
    return reference, tuple(outlook(scene, instrument, reference, material, state, (x, y)) for state in states)


def outlook(
    scene: Scene,
    instrument: Instrument,
    reference: Zones,
    material: FloatArray,
    state: State,
    pixels: tuple[FloatArray, FloatArray],
) -> Outlook:
    """Predict one state.

    Parameters
    ----------
    scene, instrument
        Lamps, camera, paint and body; what camera, paint and processing make of them.
    reference
        Zones of the reference state at the material points.
    material : ndarray, shape (3, h, w)
        mm, body axes.
    state
        The deformed state.
    pixels
        Where the reference image shows the material points: x and y (h, w) on a square grid, px.
    """
    zones = predict_zones(scene, state, material=material)
    step = float(pixels[0][0, 1] - pixels[0][0, 0])
    displacement = truth(scene, state, None, pixels)
    change = _around(trace_change(displacement), instrument.element_size / step)
    with np.errstate(invalid="ignore"):
        share = np.fmax(reference.share, zones.share)
        reflects = share > REFLECTS
    return Outlook(
        state=state,
        zones=zones,
        displacement=displacement,
        reflects=reflects,
        lit=np.isfinite(reference.share) & np.isfinite(zones.share),
        saturated=instrument.saturated(reference) | instrument.saturated(zones),
        forecast=instrument.forecast(reference, zones, change),
    )


def _around(values: FloatArray, reach: float) -> FloatArray:
    """Mean (n, h, w) of what is known within about `reach` points: over the elements of a node."""
    known = np.isfinite(values)
    total, weight = (
        np.stack([cv2.GaussianBlur(part, (0, 0), 0.5 * reach) for part in stack])
        for stack in (np.where(known, values, 0.0), known.astype(np.float64))
    )
    return np.where(known, total / np.where(known, weight, 1.0), np.nan)


def _field_in_view(
    x: FloatArray, y: FloatArray, motion: FloatArray, shape: tuple[int, int]
) -> tuple[float, float, float, float]:
    """The largest rectangle about the middle that lies on the body and within the frame, with a margin, in all states.

    Raises
    ------
    InputError
        There is none.
    """
    height, width = shape
    seen = np.asarray(np.isfinite(motion[:, 0]).all(axis=0))
    largest = np.abs(motion[:, :, seen]).max(axis=(0, 2)) if seen.any() else np.zeros(2)
    left, top = (float(np.ceil(value)) + _MARGIN for value in largest)
    middle = (width - 1) / 2, (height - 1) / 2
    while 2 * left < width - 8 and 2 * top < height - 8:
        inside = (abs(x - middle[0]) <= middle[0] - left) & (abs(y - middle[1]) <= middle[1] - top)
        if inside.any() and seen[inside].all():
            return left, top, width - 1 - left, height - 1 - top
        left, top = left + 4, top + 4
    raise InputError("the body leaves the middle of the frame: state output.region = [x0, y0, x1, y1]")


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


@contextmanager
def rehearsed() -> Iterator[None]:
    """While the block runs two other processes compile the kernels of a measurement, those of the separation and those
    of the solve; at the end of all they are cached.

    Where kernels were compiled on this machine before there is nothing to do.
    """
    if are_compiled():
        yield
        return
    with ExitStack() as stack:
        others = [stack.enter_context(_started(part)) for part in _PARTS]
        try:
            yield
        except BaseException:
            for one in others:
                one.kill()
            raise


def _started(part: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", __name__, part], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def _separate() -> None:
    """Prepare a measurement of raw frames and separate their lights."""
    from rgbmidic.frames.data import Mosaic
    from rgbmidic.frames.images import write_dng
    from rgbmidic.lab.virtual.dataset import record, true_calibration
    from rgbmidic.lab.virtual.rendering import sphere_scene
    from rgbmidic.pipeline import Plan
    from rgbmidic.settings import read_test

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


def _solve() -> None:
    """Solve for the displacement between images of three lights."""
    from rgbmidic import correlate

    correlate(_images(0), _images(1), region=_REGION)


def _images(index: int) -> FloatImage:
    """Blobs under three lights, a fraction of a pixel further from frame to frame."""
    from scipy.ndimage import gaussian_filter, shift

    blobs = gaussian_filter(np.random.default_rng(0).normal(size=(3, _SIZE, _SIZE)), (0, 1.5, 1.5))
    moved = shift(blobs, (0, 0, 0.3 * index), mode="nearest")
    return np.clip(1000 + 2000 * moved, 0, None).astype(np.float32)


_PARTS = {"separation": _separate, "solve": _solve}

if __name__ == "__main__":
    _PARTS[sys.argv[1]]()
