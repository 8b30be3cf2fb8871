"""What a study of the paper's experiment gives, as plain values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.lab.study.bench import Bench
from rgbmidic.lab.study.causes import Cause, NoiseOfLights
from rgbmidic.lab.study.goniometry import Goniometry
from rgbmidic.lab.study.plate import Topography
from rgbmidic.typing import FloatArray, FloatImage
from rgbmidic.weights.disturbed_zone import SetUpThreshold

__all__ = ["Measurement", "PaperStudy", "SceneStudy", "Snapshot"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """One method at one angle.

    Attributes
    ----------
    perturbation : ndarray, shape (5,)
        P of U_y in A0 to A4, px.
    error : ndarray, shape (5,)
        Standard deviation in the areas of the measured minus the true U_y, high-passed alike, px.
    mean : ndarray, shape (2, 5)
        Mean of (U_x, U_y) in the areas, px.
    residual
        % of the effective dynamic range, light by light averaged.
    measured
        Share of the nodes that were measured.
    frontier
        P along the frontiers of the masks over P beside them; NaN without masks.
    status
        How the solve ended.
    """

    perturbation: FloatArray
    error: FloatArray
    mean: FloatArray
    residual: float
    measured: float
    frontier: float
    status: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """What is kept of one state for the figures.

    Attributes
    ----------
    images : ndarray, shape (k, H, W), float32
        Illumination images over full scale.
    displacement : dict of ndarray, shape (2, H, W), float32
        Of every method.
    weights : ndarray, shape (k, H, W), float32
        The masks of the reference and of this state together (not brought back by the displacement).
    """

    images: FloatImage
    displacement: dict[str, FloatImage]
    weights: FloatImage


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneStudy:
    """The methods on one scene.

    Attributes
    ----------
    bench
        The scene.
    angles : tuple of float
        Degrees, in order.
    reference : ndarray, shape (k, H, W), float32
        Reference images over full scale.
    names
        The lights.
    thresholds
        The weighting threshold found at each of the set-up angles that was tried.
    chosen
        That whose threshold is used: the smallest at which the reflection clearly disturbs plain DIC (`CLEAR`), or
        where it does so most; None where it nowhere does.
    measurements
        By method and angle.
    snapshots
        Of the smallest and the largest angle above 0.
    peaks : ndarray, shape (n, 2)
        Brightest point (x, y) of the blurred image of the light that crosses the areas, at every angle.
    """

    bench: Bench
    angles: tuple[float, ...]
    reference: FloatImage
    names: tuple[str, ...]
    thresholds: dict[float, SetUpThreshold]
    chosen: float | None
    measurements: dict[tuple[str, float], Measurement]
    snapshots: dict[float, Snapshot]
    peaks: FloatArray

    @property
    def threshold(self) -> SetUpThreshold | None:
        """The weighting threshold that is used."""
        return None if self.chosen is None else self.thresholds[self.chosen]

    def perturbation(self, method: str) -> FloatArray:
        """P (n angles, 5 areas) of a method, px."""
        return np.array([self.measurements[method, angle].perturbation for angle in self.angles])

    def means(self, method: str) -> FloatArray:
        """Mean (U_x, U_y) of a method, shape (n angles, 2, 5 areas), px."""
        return np.array([self.measurements[method, angle].mean for angle in self.angles])

    def series(self, method: str, quantity: str) -> FloatArray:
        """One scalar of `Measurement` at every angle."""
        return np.array([getattr(self.measurements[method, angle], quantity) for angle in self.angles])


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperStudy:
    """All that the paper's figures show, as the virtual bench gives it.

    Attributes
    ----------
    angles, size, seed
        What was asked for.
    scenes
        The sphere, one entry per way to light and record.
    goniometry, topography
        The flat specimen.
    noise
        How much two lamps reduce the noise.
    causes
        The variations; empty where they were not asked for.
    """

    angles: tuple[float, ...]
    size: int
    seed: int
    scenes: tuple[SceneStudy, ...]
    goniometry: Goniometry
    topography: Topography
    noise: NoiseOfLights
    causes: tuple[Cause, ...]
