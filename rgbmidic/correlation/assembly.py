"""From sums per element to the sparse normal equations of the whole mesh, and their factorisation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray

__all__ = ["Assembly", "factorise"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assembly:
    """Sparse structure shared by all frames: the unknowns are (u, v) of node 0, (u, v) of node 1, and so on.

    Attributes
    ----------
    entries, own : csr_matrix, shape (nonzeros, 27 E), (3 N, 27 E)
        Sum element blocks into the data of the assembled matrix, and into entries xx, xy, yy of the nodes' own blocks.
    corners : csr_matrix, shape (2 N, 6 E)
        Sums element vectors into that of the unknowns.
    smoothness : csc_matrix, shape (2 N, 2 N)
        Graph Laplacian of the mesh for u and v, rows summing to zero, unit mean diagonal; in the structure of the
        assembled matrices.
    diagonal : ndarray
        The unit matrix's data in it.
    nodal_area : ndarray, shape (N,), float64
        A third of the area of the elements around each node, square px.
    """

    entries: sp.csr_matrix
    own: sp.csr_matrix
    corners: sp.csr_matrix
    smoothness: sp.csc_matrix
    diagonal: FloatArray
    nodal_area: FloatArray

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> Assembly:
        """Structure of the equations of a mesh."""
        unknowns = (2 * mesh.elements.astype(np.int64)[:, :, None] + np.arange(2)).reshape(-1, 6)
        size = 2 * len(mesh.nodes)
        rows = np.repeat(unknowns, 6, axis=1).ravel()
        columns = np.tile(unknowns, 6).ravel()
        keys, slots = np.unique(columns * size + rows, return_inverse=True)
        part = np.arange(27 * len(mesh.elements)).reshape(-1, 3, 3, 3)
        full = part[..., [0, 1, 1, 2]].reshape(-1, 3, 3, 2, 2).transpose(0, 1, 3, 2, 4)
        own = 3 * mesh.elements[..., None] + np.arange(3)
        indptr = np.searchsorted(keys, np.arange(size + 1) * size)
        structure = (keys % size).astype(np.int32), indptr.astype(np.int32)
        laplacian, data = sp.coo_matrix(_laplacian(mesh)), np.zeros(len(keys))
        data[np.searchsorted(keys, laplacian.col.astype(np.int64) * size + laplacian.row)] = laplacian.data
        return cls(
            entries=_sums(slots.ravel(), full.ravel(), (len(keys), part.size)),
            own=_sums(own.ravel(), np.einsum("eaad->ead", part).ravel(), (3 * len(mesh.nodes), part.size)),
            corners=_sums(unknowns.ravel(), np.arange(unknowns.size), (size, unknowns.size)),
            smoothness=sp.csc_matrix((data, *structure), shape=(size, size)),
            diagonal=(keys % size == keys // size).astype(np.float64),
            nodal_area=mesh.to_nodes(mesh.areas / 3),
        )

    @property
    def size(self) -> int:
        """Number of unknowns, twice the number of nodes."""
        return self.smoothness.shape[0]

    def matrix(self, blocks: FloatArray, more: FloatArray | float = 0.0) -> sp.csc_matrix:
        """Assemble element blocks (E, 3, 3, 3), last axis (xx, xy, yy), into a symmetric matrix (2 N, 2 N); `more` is
        added to its data."""
        matrix = self.smoothness.copy()
        matrix.data = self.entries @ blocks.ravel() + more
        return matrix

    def node_blocks(self, blocks: FloatArray) -> FloatArray:
        """Entries xx, xy, yy (3, N) of the nodes' own blocks in that matrix."""
        return np.ascontiguousarray((self.own @ blocks.ravel()).reshape(-1, 3).T)

    def vector(self, parts: FloatArray) -> FloatArray:
        """Assemble element vectors (E, 3, 2) into a vector (2 N,)."""
        return np.asarray(self.corners @ parts.ravel())


def _sums(rows: npt.NDArray[np.int64], columns: npt.NDArray[np.int64], shape: tuple[int, int]) -> sp.csr_matrix:
    """The matrix that adds up entries: 1 at each pair of a row and a column."""
    return sp.csr_matrix((np.ones(rows.size), (rows, columns)), shape=shape)


def factorise(matrix: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
    """Factorise a symmetric positive definite matrix; gives the function that solves for right-hand sides."""
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve


def _laplacian(mesh: Tri3Mesh) -> sp.csc_matrix:
    count = len(mesh.nodes)
    i, j = mesh.neighbours.T
    adjacency = sp.coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    laplacian = (sp.diags(degree) - adjacency) / degree.mean()
    return sp.csc_matrix(sp.kron(laplacian, sp.eye(2)))
