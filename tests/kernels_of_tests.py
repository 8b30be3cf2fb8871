"""Kernels that tests call besides those of a measurement, compiled once before the processes of a run begin.

`python tests/kernels_of_tests.py` compiles those of the renderer and of rates.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from rgbmidic._kernels import are_compiled
from rgbmidic.tools.lab.demo import compile_kernels_in_background


@contextmanager
def compiled_in_background() -> Iterator[None]:
    """Compile while the block runs; nothing where kernels were compiled on this machine before."""
    if are_compiled():
        yield
        return
    with subprocess.Popen([sys.executable, __file__], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            with compile_kernels_in_background():
                yield
        except BaseException:
            process.kill()
            raise


def _render_and_fit() -> None:
    from rgbmidic.fields import rates
    from rgbmidic.tools.lab.virtual import render, sphere_scene

    scene = sphere_scene(size=8, samples=2)
    render(scene)
    scene.surface.sample(np.array([[0.0, 0.0, -82.5]]), scene.body.parameters())
    times, values = np.arange(12.0), np.zeros((12, 1))
    rates(times, values, values + 1, window=6, common_fraction=0.5, references=times == 0)


if __name__ == "__main__":
    _render_and_fit()
