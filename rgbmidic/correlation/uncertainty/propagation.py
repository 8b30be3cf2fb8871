"""Standard uncertainty of every node without inverting the Hessian.

The covariance is the sandwich ``M^-1 S M^-1`` with S the covariance of the right-hand side. Columns of M^-1 decay
within a few elements, so many of them are found with one solve: unit vectors of nodes far apart are summed (probing),
and each node of the result belongs to the nearest of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["NodeColouring", "displacement_functionals", "functional_std"]


_RINGS = 5
"""Nodes of one colour are at least this many edges apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeColouring:
    """Colouring of the nodes so that nodes of one colour are far apart.

    Attributes
    ----------
    colour : ndarray, shape (N,), int64
    nearest : ndarray, shape (C, N), int64
        For every colour, the node of that colour nearest to each node.
    """

    colour: npt.NDArray[np.int64]
    nearest: npt.NDArray[np.int64]

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> NodeColouring:
        """Greedy colouring of the graph of nodes closer than `_RINGS` edges."""
        from scipy.spatial import cKDTree

        count = len(mesh.nodes)
        # nodes at one place count as neighbours: the nearest of a colour is found by distance
        i, j = np.concatenate([mesh.neighbours, mesh.copies]).T
        edges = sp.coo_matrix((np.ones(len(i), dtype=np.int8), (i, j)), shape=(count, count))
        ring = sp.csr_matrix(edges + edges.T + sp.eye(count, dtype=np.int8))
        reach = sp.csr_matrix(ring)
        for _ in range(_RINGS - 2):
            reach = sp.csr_matrix((reach @ ring) > 0)
        colour = _greedy_colours(reach.indptr, reach.indices)
        nearest = np.empty((colour.max() + 1, count), dtype=np.int64)
        for c in range(len(nearest)):
            centres = np.flatnonzero(colour == c)
            nearest[c] = centres[cKDTree(mesh.nodes[centres]).query(mesh.nodes)[1]]
        return cls(colour=colour, nearest=nearest)


def _greedy_colours(indptr: npt.NDArray[np.int32], indices: npt.NDArray[np.int32]) -> npt.NDArray[np.int64]:
    starts, neighbours, bits = indptr.tolist(), indices.tolist(), [0] * (len(indptr) - 1)
    for node in range(len(bits)):
        taken = 0
        for other in neighbours[starts[node] : starts[node + 1]]:
            taken |= bits[other]
        bits[node] = ~taken & (taken + 1)  # the lowest bit that is free
    return np.array([bit.bit_length() - 1 for bit in bits], dtype=np.int64)


def functional_std(
    solve: Callable[[FloatArray], FloatArray],
    right_side_covariance: sp.csc_matrix,
    colouring: NodeColouring,
    functionals: Sequence[sp.csr_matrix],
    nodes: BoolArray,
) -> FloatArray:
    """Standard uncertainty (N, F) of quantities that are linear in the displacements around each node.

    Parameters
    ----------
    solve
        Solves ``M x = b`` for b of shape (2 N, R).
    right_side_covariance
        S, shape (2 N, 2 N).
    colouring
        Of the mesh.
    functionals
        F matrices (N, 2 N); row n of each gives the quantity at node n, and is zero but for n and its neighbours.
    nodes : ndarray, shape (N,), bool
        Nodes whose uncertainty is asked for. The quantity must not touch a node that is hardly seen: such a column
        reaches far and would spoil those of its colour.
    """
    count, colours = len(colouring.colour), len(colouring.nearest)
    variance = np.empty((count, len(functionals)))
    for i, functional in enumerate(functionals):
        row = np.repeat(np.arange(count), np.diff(functional.indptr))
        place = functional.indices.astype(np.int64) * colours + colouring.colour[row]
        sums = np.bincount(place, weights=functional.data * nodes[row], minlength=2 * count * colours)
        columns = solve(sums.astype(np.float64, copy=False).reshape(2 * count, colours))
        energy = (columns * (right_side_covariance @ columns)).reshape(count, 2, colours).sum(axis=1)
        variance[:, i] = np.bincount(colouring.nearest.ravel(), weights=energy.T.ravel(), minlength=count)
    return np.sqrt(np.maximum(variance, 0))


def displacement_functionals(nodes: int) -> list[sp.csr_matrix]:
    """The displacements u and v themselves, as `functional_std` takes them."""
    row = np.arange(nodes)
    return [sp.csr_matrix((np.ones(nodes), (row, 2 * row + axis)), shape=(nodes, 2 * nodes)) for axis in (0, 1)]
