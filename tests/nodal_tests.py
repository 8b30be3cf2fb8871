"""Virtual tests as nodal displacements: closed-form motions, and noise as the solve and its recovery would make it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rgbmidic.fields import NodalCovariance
from rgbmidic.mesh import Region, Tri3Mesh
from rgbmidic.mesh.recovery import Recovery
from rgbmidic.typing import BoolArray, FloatArray

MESH = Tri3Mesh.from_region(Region.from_rectangle((10, 10, 210, 170), (200, 240)), 20)
STD = 0.01
"""Standard uncertainty of a displacement against the reference, px."""


def dense_correlation(mesh: Tri3Mesh) -> FloatArray:
    """Correlation (N, N) between nodes by dense algebra: the linear fit's, carried through the recovery."""
    everywhere = np.ones(len(mesh.elements), dtype=bool)
    recovery = Recovery.over(mesh, everywhere).value.toarray()
    covariance = recovery @ np.linalg.inv(mesh.mass_matrix.toarray()) @ recovery.T
    unit = np.sqrt(np.diag(covariance))
    return covariance / unit / unit[:, None]


_ROOT = np.linalg.cholesky(dense_correlation(MESH) + 1e-9 * np.eye(len(MESH.nodes)))
COVARIANCE = NodalCovariance.from_mesh(MESH)


def nodal_noise(random: np.random.Generator, frames: int) -> FloatArray:
    """Errors (T, N, 2) of unit standard deviation, independent between frames."""
    return np.asarray(_ROOT @ random.normal(size=(frames, len(MESH.nodes), 2)))


@dataclass(frozen=True, kw_only=True)
class NodalTest:
    """A test of a motion that is known in closed form.

    Attributes
    ----------
    times : ndarray, shape (T,)
        Of the frames, without those that are lost; the first is the reference, at which nothing has moved.
    motion
        Displacement (P, 2) of points (P, 2) in px at a time.
    """

    times: FloatArray
    motion: Callable[[FloatArray, float], FloatArray]

    @cached_property
    def truth(self) -> FloatArray:
        """Displacement (T, N, 2) of the nodes, px."""
        return np.stack([self.motion(MESH.nodes, time) for time in self.times])

    @property
    def references(self) -> BoolArray:
        """The first frame (T,)."""
        return np.arange(len(self.times)) == 0

    @property
    def std(self) -> FloatArray:
        """Stated uncertainty (T, N): none of the reference against itself."""
        return np.where(self.references, 0.0, STD)[:, None] * np.ones(len(MESH.nodes))

    def measured(self, seed: int) -> FloatArray:
        """Displacement (T, N, 2) with the noise of each frame and, in all alike, the reference's."""
        noise = nodal_noise(np.random.default_rng(seed), len(self.times)) * STD / np.sqrt(2)
        return self.truth + noise - noise[0]
