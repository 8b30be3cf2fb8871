"""Displacement at points, along lines and over areas, with the covariance between the nodes that it comes from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.fields.covariance import NodalCovariance
from rgbmidic.fields.history import History, Nodal
from rgbmidic.fields.locate import Places
from rgbmidic.typing import FloatArray

__all__ = ["Mean"]

_LEAST = 0.5
"""Least part of an area that must be measured for its mean to be told."""
_STEP = 1.0
"""Distance in px of the points that stand for a line or an area."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mean:
    """Displacement at a point, or its mean along a line or over an area: u and v.

    Attributes
    ----------
    weights : ndarray, shape (m,)
        Of the nodes; their sum is 1.
    correlation : ndarray, shape (m, m)
        Of the nodes' errors.
    least
        Part of the weights that must be measured; the mean is that of the measured part.
    """

    name: str
    nodes: npt.NDArray[np.int64]
    weights: FloatArray
    correlation: FloatArray
    least: float = 1.0

    @classmethod
    def _of(cls, name: str, covariance: NodalCovariance, places: Places, least: float) -> Mean:
        weights = places.mean()
        nodes = np.flatnonzero(weights).astype(np.int64)
        return cls(
            name=name, nodes=nodes, weights=weights[nodes], correlation=covariance.part(nodes), least=least - 1e-9
        )

    @classmethod
    def at_point(cls, covariance: NodalCovariance, name: str, x: float, y: float) -> Mean:
        """At a point, px; an `InputError` where it is outside the region."""
        places = Places.of(covariance.mesh, [[x, y]])
        places.check(name)
        return cls._of(name, covariance, places, 1.0)

    @classmethod
    def along_line(cls, covariance: NodalCovariance, name: str, x0: float, y0: float, x1: float, y1: float) -> Mean:
        """Along the line between two points, px; an `InputError` where a part of it is outside the region."""
        count = int(np.hypot(x1 - x0, y1 - y0) / _STEP) + 2
        places = Places.of(covariance.mesh, np.linspace((x0, y0), (x1, y1), count))
        places.check(name)
        return cls._of(name, covariance, places, _LEAST)

    @classmethod
    def over_circle(cls, covariance: NodalCovariance, name: str, x: float, y: float, radius: float) -> Mean:
        """Over a circle, px, as far as it lies in the region; an `InputError` where less than half of it does."""
        grid = _grid((x - radius, y - radius, x + radius, y + radius))
        grid = grid[np.hypot(grid[:, 0] - x, grid[:, 1] - y) <= radius]
        return cls._over(covariance, name, grid)

    @classmethod
    def over_region(cls, covariance: NodalCovariance, name: str, x0: float, y0: float, x1: float, y1: float) -> Mean:
        """Over a rectangle between two corners, px; errors as `over_circle`."""
        return cls._over(covariance, name, _grid((min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))))

    @classmethod
    def _over(cls, covariance: NodalCovariance, name: str, grid: FloatArray) -> Mean:
        places = Places.of(covariance.mesh, grid)
        if places.inside.mean() < _LEAST:
            raise InputError(f"half or more of {name} is outside {places.where}")
        return cls._of(name, covariance, places, _LEAST)

    def histories(self, nodal: Nodal) -> list[History]:
        """u and v in px."""
        (u, u_std), (v, v_std) = self.read(nodal)
        return [
            History(name=f"{self.name}_u", unit="px", values=u, std=u_std),
            History(name=f"{self.name}_v", unit="px", values=v, std=v_std),
        ]

    def read(self, nodal: Nodal) -> list[tuple[FloatArray, FloatArray]]:
        """u and v, each (T,), with their standard uncertainty."""
        known = np.isfinite(nodal.u + nodal.v + nodal.u_std + nodal.v_std)
        share = known @ self.weights
        enough = share >= self.least
        weights = np.where(known, self.weights, 0) / np.where(enough, share, 1)[:, None]
        found = []
        for values, std in ((nodal.u, nodal.u_std), (nodal.v, nodal.v_std)):
            mean = (weights * np.where(known, values, 0)).sum(axis=1)
            parts = weights * np.where(known, std, 0)
            spread = np.sqrt(np.maximum(np.einsum("tm,tm->t", parts @ self.correlation, parts), 0))
            found.append((np.where(enough, mean, np.nan), np.where(enough, spread, np.nan)))
        return found


def _grid(box: tuple[float, float, float, float]) -> FloatArray:
    """Points (P, 2) that stand for the cells of a rectangle."""
    x0, y0, x1, y1 = box
    axes = []
    for low, high in ((x0, x1), (y0, y1)):
        count = max(int(np.ceil((high - low) / _STEP)), 1)
        axes.append(low + (np.arange(count) + 0.5) * (high - low) / count)
    x, y = np.meshgrid(*axes)
    return np.stack([x.ravel(), y.ravel()], axis=1)
