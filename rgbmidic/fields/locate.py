"""Where points lie in a mesh: their element and their place in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Places"]

_CANDIDATES = 24
"""Elements nearest to a point among which its own is looked for: their sizes in one mesh differ by a factor of 2."""
_EDGE = 1e-6
"""How far outside an element, in barycentric coordinates, a point may be and still belong to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Places:
    """Points in a mesh.

    Attributes
    ----------
    mesh
        The mesh.
    points : ndarray, shape (P, 2)
        In px on the reference.
    inside : ndarray, shape (P,), bool
    element : ndarray, shape (P,), int
        That holds the point, the nearest one for a point outside.
    barycentric : ndarray, shape (P, 3)
        Value of the shape functions of that element's nodes at the point.
    """

    mesh: Tri3Mesh
    points: FloatArray
    inside: BoolArray
    element: npt.NDArray[np.int64]
    barycentric: FloatArray

    @classmethod
    def of(cls, mesh: Tri3Mesh, points: npt.ArrayLike) -> Self:
        """Look for points (P, 2) in a mesh."""
        from scipy.spatial import cKDTree

        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        corners, slopes = mesh.nodes[mesh.elements], mesh.shape_gradients()
        middle = corners.mean(axis=1)
        count = min(_CANDIDATES, len(middle))
        near = np.asarray(cKDTree(middle).query(points, k=count)[1]).reshape(len(points), count)
        shape = 1 / 3 + np.einsum("pced,pcd->pce", slopes[near], points[:, None] - middle[near])
        best = shape.min(axis=2).argmax(axis=1)
        row = np.arange(len(points))
        barycentric = shape[row, best]
        inside = barycentric.min(axis=1) >= -_EDGE
        return cls(mesh=mesh, points=points, inside=inside, element=near[row, best], barycentric=barycentric)

    def check(self, what: str) -> None:
        """Refuse points outside the mesh.

        Raises
        ------
        InputError
            One is; the message names it after `what`.
        """
        if not self.inside.all():
            x, y = self.points[~self.inside][0]
            raise InputError(f"{what} at ({x:g}, {y:g}) px is outside {self.where}")

    @property
    def where(self) -> str:
        """The region and its bounds, in words."""
        (left, top), (right, bottom) = self.mesh.nodes.min(axis=0), self.mesh.nodes.max(axis=0)
        return f"the region that was measured, which lies within x {left:g} to {right:g}, y {top:g} to {bottom:g}"

    def mean(self) -> FloatArray:
        """Weight (N,) of every node in the mean over the points that are inside."""
        nodes, weights = self.mesh.elements[self.element[self.inside]], self.barycentric[self.inside]
        sums = np.bincount(nodes.ravel(), weights=weights.ravel(), minlength=len(self.mesh.nodes))
        return np.asarray(sums / max(self.inside.sum(), 1))
