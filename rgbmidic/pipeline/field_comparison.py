"""Displacement and strain on one mesh, compared with those on finer ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rgbmidic.correlation import Solution
from rgbmidic.fields import Places
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.quadratic_fit import quadratic_fit
from rgbmidic.typing import FloatArray

_SURE, _INDEPENDENT = 2.0, 0.5
"""Standard deviations by which a mean square must exceed that of noise, and independent values in a nodal one, whose
neighbours are correlated. Chosen."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Field:
    """Displacement and strain (N, 5) on a mesh, and their noise."""

    mesh: Tri3Mesh
    values: FloatArray
    noise: FloatArray

    @classmethod
    def of(cls, mesh: Tri3Mesh, solution: Solution) -> Field:
        """Those of a solution, the noise without the misfit of the elements."""
        values = np.hstack([solution.displacement, solution.strain])
        return cls(mesh=mesh, values=values, noise=np.hstack([solution.displacement_std, solution.strain_std]))

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The field at points (P, 2), by the quadratics through the nodes around each node (`at_pixels`), and noise."""
        used = np.asarray(np.isfinite(self.values)[self.mesh.elements].all(axis=(1, 2)))
        known = np.nan_to_num(self.values)
        _, x, y, xx, xy, yy = (operator @ known for operator in quadratic_fit(self.mesh, used))
        places = Places.of(self.mesh, points)
        node, weight = self.mesh.elements[places.element], places.barycentric
        dx, dy = np.moveaxis(points[:, None] - self.mesh.nodes[node], -1, 0)[..., None]
        bent = xx[node] * dx * dx / 2 + xy[node] * dx * dy + yy[node] * dy * dy / 2
        out = np.einsum("pc,pci->pi", weight, self.values[node] + x[node] * dx + y[node] * dy + bent)
        noise = np.sqrt(np.einsum("pc,pci->pi", weight, self.noise[node] ** 2))
        return np.where(places.inside[:, None] & used[places.element][:, None], out, np.nan), noise

    def apart(self, finer: Sequence[Field]) -> tuple[list[float], list[float]]:
        """How far this field is from each of `finer` elements beyond the noise of both, at the nodes of those.

        Halved elements show little of what is far smaller than they are, or lies between their nodes; the finer sizes
        of a study have measured it. Of displacement and strain.
        """
        found: tuple[list[float], list[float]] = ([], [])
        for other in finer:
            here, noise = self.at(other.mesh.nodes)
            square, variance = (here - other.values) ** 2, noise**2 + other.noise**2
            for errors, part in zip(found, (slice(2), slice(2, 5)), strict=True):
                known = np.isfinite(square[:, part] + variance[:, part])
                beyond, expected = (square - variance)[:, part][known], variance[:, part][known]
                plain = beyond.sum() > _SURE * np.sqrt(2 * (expected**2).sum() / _INDEPENDENT)
                errors.append(float(np.sqrt(beyond.mean())) if plain else 0.0)
        return found
