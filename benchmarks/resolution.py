"""Recommended element sizes against the truth: known fields on speckle, noise of known size."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from rgbmidic.fields import at_nodes
from rgbmidic.pipeline import resolution
from rgbmidic.pipeline.plan import Plan
from rgbmidic.settings import FrameSettings, RegionSettings, TestSettings

from .tables import Row, table

SIZES = (10.0, 16.0, 25.0, 40.0, 63.0)
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A field on speckle under one or several lights."""

    kind: str
    width: float
    """Standard deviation of a bump, period of a wave, length over which the step of a band rises, px."""
    height: float
    """Largest displacement, px."""
    noise: float
    """Standard deviation over that of the speckle."""
    lights: int = 1
    speckle: float = 3.5
    seed: int = 0
    side: int = 256

    @property
    def name(self) -> str:
        return f"{self.kind} of {self.width:g} px"

    def field(self, x: Array, y: Array) -> Array:
        """Displacement (2, ...) at points of the reference."""
        middle = (self.side - 1) / 2
        dx, dy = x - middle - 7.3, y - middle + 4.1
        if self.kind == "bump":
            shape = np.exp(-(dx**2 + dy**2) / (2 * self.width**2))
        elif self.kind == "wave":
            shape = np.cos(2 * np.pi * (dx + 0.3 * dy) / self.width)
        elif self.kind == "band":
            shape = np.tanh((dx + 0.5 * dy) / self.width)
        else:  # affine
            shape = (dx + 0.4 * dy) / self.width
        return np.stack([self.height * shape, 0.6 * self.height * shape]) + np.array([1.3, -0.4])[:, None, None]

    def images(self) -> tuple[Array, Array]:
        """Images (2, k, H, W) of both states, and the displacement (2, H, W) at the pixels of the reference."""
        random, around = np.random.default_rng([self.seed, int(10 * self.width)]), 16
        size = self.side + 2 * around
        spots = gaussian_filter(random.normal(size=(size, size)), self.speckle / 2.355 / np.sqrt(2), mode="wrap")
        texture = spline_filter(spots / spots.std(), order=5)
        y, x = np.indices((self.side, self.side), dtype=float)
        u = self.field(x, y)
        back = u
        for _ in range(30):  # where what is seen at a pixel was: x = X - u(x)
            back = self.field(x - back[0], y - back[1])
        still = map_coordinates(texture, [y + around, x + around], order=5, prefilter=False, mode="grid-wrap")
        moved = map_coordinates(
            texture, [y - back[1] + around, x - back[0] + around], order=5, prefilter=False, mode="grid-wrap"
        )
        lights = []
        for light in range(self.lights):
            gain = 1 - 0.15 * light + 0.2 * np.sin((x + 60 * light) / 90)
            pair = [1000 + 200 * gain * image for image in (still, moved)]
            if light == 1:  # a reflection that sparkles, in one light and one state
                glare = np.exp(-((x - 90) ** 2 + (y - 150) ** 2) / (2 * 35**2))
                sparkle = gaussian_filter(random.normal(size=x.shape), 1.0)
                pair[1] = pair[1] + 400 * glare * (1 + 2 * sparkle / sparkle.std())
            lights.append([image + 200 * self.noise * random.normal(size=image.shape) for image in pair])
        return np.swapaxes(lights, 0, 1), u

    def settings(self) -> TestSettings:
        return TestSettings(
            frames=FrameSettings(path=()), region=RegionSettings(rectangle=(8, 8, self.side - 9, self.side - 9))
        )

    def true_errors(self, states: Array, field: Array, sizes: tuple[float, ...] = SIZES) -> dict[float, float]:
        """Error against the truth of elements of each size, rms over the measured nodes and both components, px."""
        found = {}
        plan = Plan.from_settings(self.settings(), source=list(states.astype(np.float32)))
        deformed = resolution._deformed(plan, 1)
        for size in sizes:
            sized = resolution._resized(plan, size)
            solution = resolution._solve(sized, deformed, None)
            error = solution.displacement - at_nodes(field, sized.reference.mesh.nodes)
            found[size] = float(np.sqrt(np.nanmean(error**2)))
        return found
