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

from rgbmidic._kernels.mesh import colour_nodes
from rgbmidic._kernels.triangular import node_energies
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["Functional", "NodeColouring", "displacement_functionals", "functional_std"]

Functional = tuple[sp.csr_matrix | None, sp.csr_matrix | None]
"""A quantity linear in the displacements around each node: its matrices (N, N) for u and for v, None for 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeColouring:
    """Colouring of the nodes so that nodes of one colour are far apart.

    Attributes
    ----------
    colour : ndarray, shape (N,), int64
    nearest : ndarray, shape (C, N), int64
        For every colour, the node of that colour nearest to each node; N where there is none within four edges.
    """

    colour: npt.NDArray[np.int64]
    nearest: npt.NDArray[np.int64]

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> NodeColouring:
        """Greedy colouring: nodes of one colour are at least five edges apart."""
        count = len(mesh.nodes)
        # nodes at one place count as neighbours: the nearest of a colour is found by distance
        i, j = np.concatenate([mesh.neighbours, mesh.copies, np.repeat(np.arange(count), 2).reshape(-1, 2)]).T
        ends = np.concatenate([i, j]), np.concatenate([j, i])
        ring = sp.csr_matrix((np.ones(2 * len(i), dtype=bool), ends), shape=(count, count))
        near = ring @ ring  # two nodes with one near both are at most four edges apart
        reach = near @ near
        colour = np.empty(count, dtype=np.int64)
        colour_nodes(near.indptr, near.indices, np.zeros((count, np.diff(reach.indptr).max()), dtype=bool), colour)
        node, other = np.repeat(np.arange(count), np.diff(reach.indptr)), reach.indices
        place, distance = colour[other] * count + node, sum((axis[node] - axis[other]) ** 2 for axis in mesh.nodes.T)
        least = np.full((colour.max() + 1) * count, np.inf)
        np.minimum.at(least, place, distance)
        nearest, own = np.full(least.size, count), distance == least[place]
        nearest[place[own]] = other[own]
        return cls(colour=colour, nearest=nearest.reshape(-1, count))


def functional_std(
    solve: Callable[[FloatArray], FloatArray],
    right_side_covariance: sp.csc_matrix,
    colouring: NodeColouring,
    asked: Sequence[tuple[Functional, BoolArray]],
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
    asked
        F quantities, row n of whose matrices is zero but for n and its neighbours; and of each the nodes (N,) whose
        uncertainty is asked for. It must not touch a node that is hardly seen: such a column reaches far and would
        spoil those of its colour.
    """
    count, colours = len(colouring.colour), len(colouring.nearest)
    columns = np.zeros((count, 2, len(asked), colours))
    for i, (functional, nodes) in enumerate(asked):
        for axis, matrix in enumerate(functional):
            if matrix is not None:
                row = np.repeat(np.arange(count), np.diff(matrix.indptr))
                place = matrix.indices * np.int64(colours) + colouring.colour[row]
                sums = np.bincount(place, weights=matrix.data * nodes[row], minlength=count * colours)
                columns[:, axis, i] = sums.reshape(count, colours)
    solved = solve(columns.reshape(2 * count, -1))
    energy = np.empty((count, len(asked), colours))
    covariance = right_side_covariance  # symmetric: its columns are its rows
    node_energies(covariance.data, covariance.indices, covariance.indptr, solved, energy.reshape(count, -1))
    nearest = colouring.nearest.T.ravel()
    variance = [np.bincount(nearest, weights=energy[:, i].ravel(), minlength=count)[:count] for i in range(len(asked))]
    return np.sqrt(np.maximum(np.stack(variance, axis=1), 0))


def displacement_functionals(nodes: int) -> list[Functional]:
    """The displacements u and v themselves, as `functional_std` takes them."""
    itself = sp.eye(nodes, format="csr")
    return [(itself, None), (None, itself)]
