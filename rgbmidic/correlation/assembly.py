"""From sums per element to the sparse normal equations of the whole mesh, ready to be factorised."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.correlation.elimination import Elimination
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.sparse import with_data
from rgbmidic.typing import FloatArray

__all__ = ["Assembly"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Assembly:
    """Sparse structure shared by all frames: the unknowns are (u, v) of node 0, (u, v) of node 1, and so on.

    Attributes
    ----------
    entries : csc_matrix, shape (nonzeros, 27 E)
        Sums element blocks into the data of the assembled matrix.
    unknowns, own : ndarray, shape (6 E,), (9 E,)
        Number of each entry of element vectors, and of three values at the corners, in those of the nodes.
    smoothness : csc_matrix, shape (2 N, 2 N)
        Graph Laplacian of the mesh for u and v, rows summing to zero, unit mean diagonal; in the structure of the
        assembled matrices.
    diagonal : ndarray
        The unit matrix's data in it.
    nodal_area : ndarray, shape (N,), float64
        A third of the area of the elements around each node, square px.
    elimination : Elimination
        Of the assembled matrices.
    """

    entries: sp.csc_matrix
    unknowns: npt.NDArray[np.int64]
    own: npt.NDArray[np.int64]
    smoothness: sp.csc_matrix
    diagonal: FloatArray
    nodal_area: FloatArray
    elimination: Elimination

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> Assembly:
        """Structure of the equations of a mesh."""
        count, corners = len(mesh.nodes), mesh.elements.astype(np.int64)
        keys, pair = np.unique(corners[:, None, :] * count + corners[:, :, None], return_inverse=True)
        row, column = keys % count, keys // count
        degree = np.bincount(column)
        ahead = np.cumsum(degree) - degree
        component = np.arange(2)
        indptr = np.append(4 * ahead[:, None] + 2 * degree[:, None] * component, 4 * len(keys)).astype(np.int32)
        # the entry of each pair of nodes, its component in the row, its component in the column
        slots = 2 * (np.arange(len(keys)) + ahead[column])[:, None, None] + component[:, None]
        slots = slots + 2 * degree[column, None, None] * component
        indices, smooth, diagonal = np.empty(slots.size, dtype=np.int32), np.zeros(slots.size), np.zeros(slots.size)
        indices[slots] = (2 * row[:, None] + component)[:, :, None]
        smooth[slots[:, component, component]] = (np.where(row == column, degree[row] - 1, -1) / (degree - 1).mean())[
            :, None
        ]
        diagonal[slots[row == column][:, component, component]] = 1
        return cls(
            entries=_sums(slots[pair], np.tile([1, 2, 1], 9 * len(corners)), slots.size),
            unknowns=(2 * corners[..., None] + component).ravel(),
            own=(3 * corners[..., None] + np.arange(3)).ravel(),
            smoothness=sp.csc_matrix((smooth, indices, indptr), shape=(2 * count, 2 * count)),
            diagonal=diagonal,
            nodal_area=mesh.to_nodes(mesh.areas / 3),
            elimination=Elimination.of_pairs(row, column, slots),
        )

    @property
    def size(self) -> int:
        """Number of unknowns, twice the number of nodes."""
        return self.smoothness.shape[0]

    def matrix(self, blocks: FloatArray, more: FloatArray | float = 0.0) -> sp.csc_matrix:
        """Assemble element blocks (E, 3, 3, 3), last axis (xx, xy, yy), into a symmetric matrix (2 N, 2 N); `more` is
        added to its data."""
        return with_data(self.smoothness, self.entries @ blocks.ravel() + more)

    def factorise(self, matrix: sp.csc_matrix) -> Callable[[FloatArray], FloatArray]:
        """Factorise such a matrix, positive definite; see `Elimination.factorise`."""
        return self.elimination.factorise(matrix.data)

    def node_blocks(self, blocks: FloatArray) -> FloatArray:
        """Entries xx, xy, yy (3, N) of the nodes' own blocks in that matrix."""
        return np.ascontiguousarray(self.at_nodes(np.einsum("eaad->ead", blocks)).T)

    def at_nodes(self, parts: FloatArray) -> FloatArray:
        """Sums (N, 3) at the nodes of three values at the corners of the elements (E, 3, 3)."""
        sums = np.bincount(self.own, weights=parts.ravel(), minlength=self.size // 2 * 3)
        return np.asarray(sums, dtype=np.float64).reshape(-1, 3)

    def vector(self, parts: FloatArray) -> FloatArray:
        """Assemble element vectors (E, 3, 2) into a vector (2 N,)."""
        return np.asarray(np.bincount(self.unknowns, weights=parts.ravel(), minlength=self.size), dtype=np.float64)


def _sums(rows: npt.NDArray[np.int64], number: npt.NDArray[np.int64], count: int) -> sp.csc_matrix:
    """The matrix that adds up entries: each of its columns counts in the next `number` of the `rows`."""
    indptr = np.concatenate([[0], np.cumsum(number)])
    return sp.csc_matrix((np.ones(rows.size), rows.ravel(), indptr), shape=(count, number.size))
