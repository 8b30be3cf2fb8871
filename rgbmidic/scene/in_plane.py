"""In-plane displacement fields of a plate: uniform gradient, nodal values on a mesh, or any function of the user's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.mesh_field import interpolate_nodal
from rgbmidic.errors import InputError
from rgbmidic.typing import FloatArray

__all__ = ["AffineField", "InPlaneField", "MeshField", "material_from_spatial"]

InPlaneField = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""Displacement (ux, uy) in mm of a plate's material points (x, y) in mm, in the plate's own axes; vectorised."""

INVERSION_TOLERANCE = 1e-8
"""Accuracy (mm) of the material point found from a spatial one."""
_ELEMENTS_PER_BIN = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class AffineField:
    """A uniform displacement gradient on a plate: u = gradient . x + offset.

    Attributes
    ----------
    gradient
        ((du/dx, du/dy), (dv/dx, dv/dy)).
    offset
        Displacement (mm) of the plate's middle.
    """

    gradient: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    offset: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        (xx, xy), (yx, yy) = self.gradient
        if not (1 + xx) * (1 + yy) - xy * yx > 0:
            raise InputError(f"a displacement gradient must not turn the plate inside out: {self.gradient}")

    def __call__(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement (mm) of the material points."""
        (xx, xy), (yx, yy) = self.gradient
        return xx * x + xy * y + self.offset[0], yx * x + yy * y + self.offset[1]

    def inverse(self) -> FloatArray:
        """[m00, m01, m10, m11, t0, t1]: spatial to material point."""
        matrix = np.linalg.inv(np.eye(2) + np.array(self.gradient))
        return np.concatenate([matrix.ravel(), -matrix @ np.array(self.offset)])

    def material(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Material points of spatial ones."""
        m = self.inverse()
        return m[0] * x + m[1] * y + m[4], m[2] * x + m[3] * y + m[5]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshField:
    """Nodal displacements on triangles, linear in between, as a finite-element program gives them.

    The plate ends where the mesh ends.

    Attributes
    ----------
    nodes : ndarray, shape (N, 2)
        Material positions (mm) in the plate's axes.
    elements : ndarray, shape (E, 3)
        Node indices.
    displacement : ndarray, shape (N, 2)
        mm.
    """

    nodes: FloatArray
    elements: npt.NDArray[np.int64]
    displacement: FloatArray

    def __post_init__(self) -> None:
        nodes, values = np.array(self.nodes, dtype=float), np.array(self.displacement, dtype=float)
        elements = np.array(self.elements, dtype=np.int64)
        if nodes.ndim != 2 or nodes.shape[1] != 2 or values.shape != nodes.shape or elements.shape[1:] != (3,):
            raise InputError(
                f"a mesh field has nodes (N, 2), elements (E, 3) and displacement (N, 2), not {nodes.shape}, "
                f"{elements.shape} and {values.shape}"
            )
        if not len(elements) or elements.min() < 0 or elements.max() >= len(nodes):
            raise InputError("the elements of a mesh field must name existing nodes, and there must be one")
        if not (np.isfinite(nodes).all() and np.isfinite(values).all()):
            raise InputError("nodes and displacement of a mesh field must be finite")
        before, after = _areas(nodes, elements), _areas(nodes + values, elements)
        if not (before * after > 0).all():
            raise InputError(
                f"element {int(np.argmin(before * after))} of the mesh field has no area or is turned over"
            )
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "displacement", values)
        object.__setattr__(self, "elements", elements)

    def __call__(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacement (mm) of the material points; NaN off the mesh."""
        return _interpolate(x, y, self.nodes, self.elements, self.displacement)

    def material(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Material points of spatial ones: linear in the deformed triangles, hence exact; NaN off the mesh."""
        return _interpolate(x, y, self.nodes + self.displacement, self.elements, self.nodes)


def material_from_spatial(field: InPlaneField | None, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Material points X of spatial points x = X + u(X).

    A general function is inverted by the iteration X <- x - u(X), which converges where its gradient is below 1.

    Raises
    ------
    InputError
        The iteration does not converge.
    """
    if field is None:
        return x, y
    if isinstance(field, AffineField | MeshField):
        return field.material(x, y)
    mx, my = x, y
    for _ in range(100):
        ux, uy = field(mx, my)
        nx, ny = x - ux, y - uy
        change = np.maximum(abs(nx - mx), abs(ny - my))
        mx, my = nx, ny
        if not (change > INVERSION_TOLERANCE).any():
            return mx, my
    raise InputError("the plate's displacement field cannot be inverted: its gradient must stay below 1 everywhere")


def _areas(nodes: FloatArray, elements: npt.NDArray[np.int64]) -> FloatArray:
    a, b, c = (nodes[elements[:, corner]] for corner in range(3))
    return np.asarray((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def _interpolate(
    x: FloatArray, y: FloatArray, nodes: FloatArray, elements: npt.NDArray[np.int64], values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    out = np.empty((x.size, 2))
    flat_x, flat_y = np.ascontiguousarray(x, dtype=float).ravel(), np.ascontiguousarray(y, dtype=float).ravel()
    interpolate_nodal(out, flat_x, flat_y, nodes, elements, values, *_bins(nodes, elements))
    return out[:, 0].reshape(x.shape), out[:, 1].reshape(x.shape)


def _bins(
    nodes: FloatArray, elements: npt.NDArray[np.int64]
) -> tuple[FloatArray, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Square bins over the mesh, and for each the elements whose bounding box meets it."""
    corners = nodes[elements]
    low, high = corners.min(axis=1), corners.max(axis=1)
    origin, span = low.min(axis=0), high.max(axis=0) - low.min(axis=0)
    side = float(np.sqrt(span[0] * span[1] * _ELEMENTS_PER_BIN / len(elements)))
    columns, rows = (int(length / side) + 1 for length in span)
    start = ((low - origin) / side).astype(np.int64)
    count = ((high - origin) / side).astype(np.int64) - start + 1
    pairs = np.repeat(np.arange(len(elements)), count.prod(axis=1))
    place = np.arange(pairs.size) - np.repeat(np.cumsum(count.prod(axis=1)) - count.prod(axis=1), count.prod(axis=1))
    i = np.minimum(start[pairs, 0] + place % count[pairs, 0], columns - 1)
    j = np.minimum(start[pairs, 1] + place // count[pairs, 0], rows - 1)
    bins = j * columns + i
    first = np.searchsorted(np.sort(bins), np.arange(columns * rows + 1))
    return np.array([*origin, side, columns, rows]), first, pairs[np.argsort(bins, kind="stable")]
