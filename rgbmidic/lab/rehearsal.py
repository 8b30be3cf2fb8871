"""A measurement in small by processes of its own: what they compile lies in the cache when it is needed."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from rgbmidic._kernels import are_compiled
from rgbmidic.typing import FloatImage

__all__ = ["rehearsed"]

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
    from rgbmidic.frames.writers import write_dng
    from rgbmidic.lab.virtual.dataset import true_calibration
    from rgbmidic.lab.virtual.recording import record
    from rgbmidic.lab.virtual.scenes import sphere_scene
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
