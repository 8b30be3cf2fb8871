"""Other draws of what no verdict may depend on: the noise of virtual cameras, its sampler, the last bits of renders.

Another processor, or another numpy, rounds a render otherwise; a sampler of Poisson's numbers takes as much of its
stream as its values ask for, so that from there on all noise is another draw.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from rgbmidic.tools.lab.virtual import rendering

SAMPLERS = ("poisson", "normal")
JITTER = 1e-6
"""Relative change of a pixel, single precision's 6e-8 after some operations."""
current = "0_poisson_0"
"""Name of the draws that are in force."""
_default_rng = np.random.default_rng


@contextmanager
def other_draws(number: int = 0, sampler: str = "poisson", jitter: float = 0.0) -> Iterator[None]:
    """Exchange the noise of all that draws from Poisson's distribution, and change every render, within the block.

    Parameters
    ----------
    number
        Of the draw; 0: that of the seeds as stated.
    sampler
        "normal" draws Poisson's numbers as rounded normal ones of the same mean and variance.
    jitter
        Standard deviation of the relative change of each rendered pixel.
    """

    class Camera(np.random.Generator):
        """Draws as another camera from its first photon on."""

        elsewhere = False

        def poisson(self, lam: Any = 1.0, size: Any = None) -> Any:
            if number and not self.elsewhere:
                self.elsewhere = True
                self.bit_generator.advance(number << 64)
            if sampler == "poisson":
                return super().poisson(lam, size)
            drawn = np.rint(self.normal(lam, np.sqrt(lam), size))
            return np.maximum(drawn, 0).astype(np.int64)

    def generator(seed: Any = None) -> np.random.Generator:
        made = _default_rng(seed)
        return made if made is seed else Camera(made.bit_generator)

    def jittered(*arguments: Any) -> Any:
        images = trace(*arguments)
        noise = np.random.default_rng(0).normal(1, jitter, images.shape[1:]).astype(images.dtype)
        return images * noise

    global current
    before = _, trace, _ = np.random.default_rng, rendering._trace, current
    current = f"{number}_{sampler}_{jitter:g}"
    np.random.default_rng = generator if number or sampler != "poisson" else _default_rng
    if jitter:
        rendering._trace = jittered
    try:
        yield
    finally:
        np.random.default_rng, rendering._trace, current = before
