"""The planar part of a finite-element mesh, as three-node triangles with the labels of their file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from rgbmidic.errors import InputError
from rgbmidic.mesh.outline_mesh import cross, orient_elements
from rgbmidic.renamed import state_new_names
from rgbmidic.typing import BoolArray, FloatArray, IntArray, as_numbers, as_values

ROUNDING = 1e-4
"""Error of a distance by rounding, as a fraction of the mesh's extent: single precision and the eight columns of
Nastran 1e-6 to 1e-5 (derived)."""


@state_new_names
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FiniteElementMesh:
    """The planar part of a finite-element mesh, as three-node triangles.

    Attributes
    ----------
    name : str
        The file.
    points : ndarray, shape (N, 2), float64
        Nodes in mm, in the mesh's own axes: the coordinates `axes` of the file.
    node_numbers : ndarray, shape (N,), int64
        Labels of the nodes in the file.
    elements : ndarray, shape (E, 3), int32
        Triangles, counter-clockwise in the mesh's axes; a quadrilateral gives two, and only corner nodes are kept.
    element_numbers : ndarray, shape (E,), int64
        Labels, in the file, of the elements that the triangles come from.
    fields : mapping of str to ndarray, shape (N, ...)
        Nodal data of the file (none of Abaqus and Nastran), in its own unit and components: a vector's
        component along x is ``[:, axes[0]]``.
    axes : tuple of int
        Which coordinates (0, 1, 2) of the file are x and y.
    unit_mm : float
        Millimetres per unit of length of the file; multiply a displacement in `fields` by it.
    numbering : str
        Origin of the numbers, in words.

    Examples
    --------
    >>> from rgbmidic import FiniteElementMesh
    >>> mesh = FiniteElementMesh(
    ...     name="plate",
    ...     points=np.array([[0, 0], [10, 0], [10, 5], [0, 5]]),
    ...     node_numbers=np.array([1, 2, 3, 4]),
    ...     elements=np.array([[0, 1, 2], [0, 2, 3]]),
    ...     element_numbers=np.array([11, 12]),
    ... )
    >>> mesh.areas.tolist(), mesh.overlap()
    ([25.0, 25.0], None)
    """

    name: str
    points: FloatArray
    node_numbers: IntArray
    elements: npt.NDArray[np.int32]
    element_numbers: IntArray
    fields: Mapping[str, FloatArray] = field(default_factory=dict)
    axes: tuple[int, int] = (0, 1)
    unit_mm: float = 1.0
    numbering: str = "labels of the file"

    def __post_init__(self) -> None:
        """Check the arrays, convert them to their types and order the corners."""
        points, elements, area = orient_elements(self.points, self.elements, self.name)
        if not (area > 1e-12 * np.ptp(points, axis=0).max() ** 2).all():
            raise InputError(f"{self.name}: element {np.asarray(self.element_numbers)[area.argmin()]} has no area")
        if self.axes not in ((0, 1), (0, 2), (1, 2)):
            raise InputError(f"{self.name}: axes are two of 0, 1, 2 in their order, not {self.axes!r}")
        for key, data in self.fields.items():
            as_values(data, f"{self.name}: {key}", (len(points), *(None,) * (np.ndim(data) - 1)))
        for key, values, count in (
            ("points", points, len(points)),
            ("elements", elements, len(elements)),
            ("node_numbers", self.node_numbers, len(points)),
            ("element_numbers", self.element_numbers, len(elements)),
        ):
            if "numbers" in key:
                values = as_numbers(values, f"{self.name}: {key} needs {count} whole numbers", (count,), dtype=np.int64)
            values.setflags(write=False)
            object.__setattr__(self, key, values)

    def subset(self, selected: BoolArray) -> Self:
        """Return the chosen triangles (E,), and their nodes.

        Parameters
        ----------
        selected : ndarray, shape (E,), bool
            The triangles that stay.

        Returns
        -------
        FiniteElementMesh
        """
        selected = as_values(selected, "selected", (len(self.elements),), "b")
        used_nodes, index = np.unique(self.elements[selected], return_inverse=True)
        return replace(
            self,
            points=self.points[used_nodes],
            node_numbers=self.node_numbers[used_nodes],
            elements=index.reshape(-1, 3).astype(np.int32),
            element_numbers=self.element_numbers[selected],
            fields={key: values[used_nodes] for key, values in self.fields.items()},
        )

    @property
    def areas(self) -> FloatArray:
        """Area (E,) of every triangle, square mm."""
        return cross(self.points, self.elements) / 2

    def overlap(self) -> tuple[int, int] | None:
        """Return the numbers of two elements whose triangles overlap by more than rounding; None: no two do.

        The triangles are sorted into strips along x, and those within a strip by their left ends. Two of them overlap
        by the least depth along the normals of their sides (separating axis theorem).

        Returns
        -------
        tuple of int, or None
        """
        corners = self.points[self.elements]
        low, high = corners.min(axis=1), corners.max(axis=1)
        extent = np.ptp(self.points, axis=0)
        strips = int(np.ceil(np.sqrt(len(corners))))
        first, last = (
            ((side[:, 1] - self.points[:, 1].min()) / extent[1] * strips).astype(np.int64) for side in (low, high)
        )
        count = last - first + 1
        triangle = np.repeat(np.arange(len(count)), count)
        strip = first[triangle] + np.arange(len(triangle)) - (np.cumsum(count) - count)[triangle]
        order = np.lexsort((low[triangle, 0], strip))
        triangle, strip = triangle[order], strip[order]
        left_edge, right_edge = (
            strip * 2 + (side[triangle, 0] - self.points[:, 0].min()) / extent[0] for side in (low, high)
        )
        end = np.searchsorted(left_edge, right_edge)
        index, step = np.arange(len(triangle)), 1
        while len(index := index[index + step < end[index]]):
            a, b = triangle[index], triangle[index + step]
            share_rows = (low[a, 1] < high[b, 1]) & (low[b, 1] < high[a, 1])
            a, b = a[share_rows], b[share_rows]
            depth = np.minimum(_depth(corners[a], corners[b]), _depth(corners[b], corners[a]))
            if (depth > ROUNDING * extent.max()).any():
                return int(self.element_numbers[a[depth.argmax()]]), int(self.element_numbers[b[depth.argmax()]])
            step += 1
        return None


def _depth(triangle: FloatArray, other_triangle: FloatArray) -> FloatArray:
    """Return the depth (n,) of `other_triangle` (n, 3, 2) within `triangle` from its nearest side.

    The corners of `triangle` turn as the axes do.
    """
    side = np.roll(triangle, -1, axis=1) - triangle
    inward = np.stack([-side[..., 1], side[..., 0]], axis=2) / np.linalg.norm(side, axis=2, keepdims=True)
    return np.asarray(
        np.einsum("nsk,nsck->nsc", inward, other_triangle[:, None] - triangle[:, :, None]).max(axis=2).min(axis=1)
    )
