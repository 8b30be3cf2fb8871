"""Strain over a virtual strain gauge: a plane is fitted to the displacements of the nodes around a place.

No new measurement is needed: gauges of any length follow from the stored displacements. The length of a virtual strain
gauge is the diameter of a circle. A node stands for as much as an element is wide and counts by the part of that within
the circle, so that, as in the iDICs good practice guide, the length is that of the window of points plus one of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.errors import InputError
from rgbmidic.fields.measures import MEASURES, Strain, strain_of_gradient
from rgbmidic.fields.nodal import NodalCovariance, Places
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import AnyArray, BoolArray, FloatArray

SHORTEST = 3.0
"""Length of the shortest gauge in elements: a node and those around it."""


def shortest_gauge(mesh: Tri3Mesh) -> float:
    """Return the length in px of the shortest virtual strain gauge on a mesh.

    Parameters
    ----------
    mesh
        N nodes, E elements.

    Returns
    -------
    float
        In px.
    """
    return SHORTEST * mesh.size


def strain_of(
    nodes: FloatArray,
    elements: npt.NDArray[np.int32],
    u: FloatArray,
    v: FloatArray,
    u_std: FloatArray,
    v_std: FloatArray,
    *,
    gauge: float | None = None,
    measure: str = MEASURES[0],
) -> Strain:
    """Compute the strain at the nodes of a mesh from the displacements of one frame.

    For many frames or gauges make a `StrainGauges` once.

    Parameters
    ----------
    nodes : ndarray, shape (N, 2)
        In px on the reference.
    elements : ndarray, shape (E, 3)
        Node indices.
    u, v, u_std, v_std : ndarray, shape (N,)
        In px; NaN where not measured.
    gauge
        Length of the virtual strain gauge in px; None: the shortest, three elements.
    measure
        ``"green-lagrange"``, ``"hencky"``, ``"biot"`` or ``"engineering"``.

    Returns
    -------
    Strain
        NaN at nodes that are not measured and beside them.

    Raises
    ------
    InputError
        The gauge is too short, or the measure unknown.
    """
    covariance = NodalCovariance.from_mesh(Tri3Mesh(nodes=nodes, elements=elements))
    return StrainGauges.at_nodes(covariance, gauge).strain(u, v, u_std, v_std, measure=measure)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StrainGauges:
    """Virtual strain gauges of one length at some places.

    Attributes
    ----------
    length
        In px. On a graded mesh each gauge has three elements as they are around it, and this length where that is more
        and the length is stated; if it is not, this is that of elements of the mesh's size.
    centres : ndarray, shape (G, 2)
        In px on the reference.
    points : ndarray, shape (N, 2)
        The nodes.
    rows, nodes : ndarray, shape (M,), int
        Gauge and node of every pair of them: nodes within the gauge's circle that hang together in it, so that none
        lies across a crack or a hole.
    fractions : ndarray, shape (M,)
        Part of each node that is within the gauge's circle.
    needed : csr_matrix, shape (G, N)
        Nodes that must have data, else the gauge has none: the centre and those beside it.
    whole : ndarray, shape (2, M)
        Weight of every node in the slopes along x and y where all are measured.
    inflation : ndarray, shape (G, 3)
        Variance of the slopes along x and y, and their covariance, over what independent nodes would give.
    """

    length: float
    centres: FloatArray
    points: FloatArray
    rows: npt.NDArray[np.int64]
    nodes: npt.NDArray[np.int64]
    fractions: FloatArray
    needed: sp.csr_matrix
    whole: FloatArray
    inflation: FloatArray

    @classmethod
    def at_nodes(cls, covariance: NodalCovariance, length: float | None = None) -> Self:
        """Lay a gauge around every node; errors as `strain_of`.

        Parameters
        ----------
        covariance
            Of the mesh.
        length
            Length of the gauges in px; None: the shortest.

        Returns
        -------
        StrainGauges
        """
        mesh = covariance.mesh
        return cls._around(covariance, mesh.nodes, length, _ring(mesh))

    @classmethod
    def at_points(cls, covariance: NodalCovariance, points: FloatArray, length: float | None = None) -> Self:
        """Lay gauges around points (G, 2) within the mesh.

        Parameters
        ----------
        covariance
            Of the mesh.
        points : ndarray, shape (G, 2)
            Middles of the gauges in px on the reference.
        length
            Their length in px; None: the shortest.

        Returns
        -------
        StrainGauges

        Raises
        ------
        InputError
            A point is outside the mesh, or the gauge is too short.
        """
        mesh = covariance.mesh
        places = Places.of(mesh, points)
        places.check("the strain gauge")
        row = np.repeat(np.arange(len(points)), 3)
        nodes = mesh.elements[places.element].ravel()
        needed = sp.csr_matrix((np.ones(len(row)), (row, nodes)), shape=(len(points), len(mesh.nodes)))
        return cls._around(covariance, np.asarray(points, dtype=np.float64), length, needed)

    @classmethod
    def _around(
        cls, covariance: NodalCovariance, centres: FloatArray, length: float | None, needed: sp.csr_matrix
    ) -> Self:
        mesh, stated, shortest = covariance.mesh, length is not None, shortest_gauge(covariance.mesh)
        length = shortest if length is None else float(length)
        # the sides of a mesh's elements differ by some percent from the size asked for
        if not (np.isfinite(length) and length >= 0.9 * shortest):
            raise InputError(
                f"a strain gauge must be at least {shortest:.4g} px long, {SHORTEST:g} elements; given are "
                f"{length:g} px"
            )
        lengths = np.full(len(centres), length)
        if mesh.is_graded:
            around = (needed @ mesh.sizes) / np.asarray(needed.sum(axis=1)).ravel()
            lengths = np.maximum(SHORTEST * around, length if stated else 0)
        pattern = _reach(mesh, centres, lengths / 2, needed)
        rows = np.repeat(np.arange(len(centres)), np.diff(pattern.indptr))
        away = np.hypot(*(mesh.nodes[pattern.indices] - centres[rows]).T)
        gauges = cls(
            length=length,
            centres=centres,
            points=mesh.nodes,
            rows=rows,
            nodes=pattern.indices.astype(np.int64),
            fractions=np.clip((lengths[rows] / 2 - away) / mesh.sizes[pattern.indices], 0, 1),
            needed=needed,
            whole=np.zeros((2, len(rows))),
            inflation=np.ones((len(centres), 3)),
        )
        weights = gauges._weights(np.ones(len(mesh.nodes), dtype=bool))
        x, y = (sp.csr_matrix((weight, (rows, gauges.nodes)), shape=needed.shape) for weight in weights)
        together = [np.asarray((a @ covariance.correlation).multiply(a).sum(axis=1)).ravel() for a in (x, y)]
        alone = [np.asarray(a.multiply(a).sum(axis=1)).ravel() for a in (x, y)]
        along, across = (a / np.where(b > 0, b, 1) for a, b in zip(together, alone, strict=True))
        inflation = np.stack([along, across, np.sqrt(along * across)], axis=1)
        return replace(gauges, whole=weights, inflation=inflation)

    def gradient(
        self, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Fit the planes to the displacements of one frame.

        Parameters
        ----------
        u, v, u_std, v_std : ndarray, shape (N,)
            In px; NaN where a node has no data.

        Returns
        -------
        gradient : ndarray, shape (G, 2, 2)
            ``H[c, d]``: derivative of the displacement c by the coordinate d.
        covariance : ndarray, shape (G, 4, 4)
            Of the gradient row by row.
        """
        measured = np.isfinite(u + v + u_std + v_std)
        known = self.needed @ (~measured * 1.0) == 0
        weights = self.whole if measured.all() else self._weights(measured)
        values, spread = np.zeros((len(known), 2, 2)), np.zeros((len(known), 4, 4))
        for component, (value, std) in enumerate(((u, u_std), (v, v_std))):
            moved, square = (np.where(measured, part, 0.0)[self.nodes] for part in (value, std**2))
            values[:, component] = np.stack([self._sum(w * moved) for w in weights], axis=1)
            parts = [(0, 0), (1, 1), (0, 1)]
            sums = np.stack([self._sum(weights[a] * weights[b] * square) for a, b in parts], axis=1) * self.inflation
            for (a, b), part in zip(parts, sums.T, strict=True):
                spread[:, 2 * component + a, 2 * component + b] = part
                spread[:, 2 * component + b, 2 * component + a] = part
        values[~known], spread[~known] = np.nan, np.nan
        return values, spread

    def strain(
        self, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray, *, measure: str = MEASURES[0]
    ) -> Strain:
        """Compute the strain of every gauge from the displacements (N,) of one frame; errors as `strain_of`.

        Parameters
        ----------
        u, v, u_std, v_std : ndarray, shape (N,)
            Displacement and its standard uncertainty, px; NaN where not measured.
        measure
            Strain measure, as of `strain_of`.

        Returns
        -------
        Strain
        """
        return strain_of_gradient(*self.gradient(u, v, u_std, v_std), measure)

    def _weights(self, measured: BoolArray) -> FloatArray:
        """Compute the weight (2, M) of every node in the slopes of each gauge; NaN where its nodes lie on a line."""
        use = measured[self.nodes] * self.fractions
        arm = (self.points[self.nodes] - self.centres[self.rows]).T
        count = np.maximum(self._sum(use), np.finfo(float).tiny)
        x, y = (part - (self._sum(use * part) / count)[self.rows] for part in arm)
        xx, xy, yy = (self._sum(use * a * b) for a, b in ((x, x), (x, y), (y, y)))
        determinant = xx * yy - xy * xy
        # a hundredth of the second moment across as along: the nodes lie on a line
        determinant = np.where(determinant > 1e-2 * ((xx + yy) / 2) ** 2, determinant, np.nan)
        xx, xy, yy = (part[self.rows] / determinant[self.rows] for part in (xx, xy, yy))
        return np.stack([use * (yy * x - xy * y), use * (xx * y - xy * x)])

    def _sum(self, values: AnyArray) -> FloatArray:
        sums = np.bincount(self.rows, weights=values, minlength=len(self.centres))
        return np.asarray(sums, dtype=np.float64)


def _ring(mesh: Tri3Mesh) -> sp.csr_matrix:
    """Mark every node and those of the same elements, (N, N)."""
    i, j = mesh.neighbours.T
    count = len(mesh.nodes)
    edges = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    return sp.csr_matrix(edges + edges.T + sp.eye(count))


def _reach(mesh: Tri3Mesh, centres: FloatArray, radius: FloatArray, needed: sp.csr_matrix) -> sp.csr_matrix:
    """Find the nodes (G, N) within its `radius` (G,) px of each centre that are joined with it inside the circle."""
    from scipy.spatial import cKDTree

    near = cKDTree(mesh.nodes).query_ball_point(centres, radius)
    starts = np.cumsum([0, *map(len, near)])
    columns = np.concatenate([np.asarray(some, dtype=np.int64) for some in near])
    inside = sp.csr_matrix((np.ones(len(columns)), columns, starts), shape=needed.shape)
    ring, reached = _ring(mesh), sp.csr_matrix(needed > 0) * 1.0
    while True:
        grown = sp.csr_matrix((((reached @ ring).multiply(inside) + reached) > 0) * 1.0)
        if grown.nnz == reached.nnz:
            grown.sort_indices()
            return grown
        reached = grown
