"""Factors of the matrices of a mesh: order and structure are found once, the numbers for every matrix.

scipy's SuperLU finds both for every matrix: with 1,764 nodes it takes 9.0 ms for what takes 2.2 ms here (factors and
one solution, one thread, equal to 2e-15; measured 2026-11-24).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic._kernels.factors import factorise, solve_factors
from rgbmidic.typing import FloatArray

_SINGULAR = 1e11
"""Entries of a node's own block over what is left of it when the others are eliminated, from which that is rounding:
1e13 to 1e20 in singular matrices of 60 to 4,800 nodes, 3e8 at most where the smoothness alone holds one direction
(measured)."""


Index = npt.NDArray[np.integer]


@dataclass(frozen=True, slots=True, kw_only=True)
class Elimination:
    """Structure of the factors of symmetric matrices with a block of 2 x 2 for each two nodes that share an edge.

    Attributes
    ----------
    order : ndarray, shape (N,)
        When each node is eliminated. All else counts the nodes so.
    diagonal_slots : ndarray, shape (N, 2)
        Places of the entries xx and yy of each node's own block in the matrix' data.
    matrix_rows : tuple of ndarray
        Rows of the lower half of the matrix: where each starts, nodes, and places (n, 2, 2) in the matrix' data.
    lower : csc_matrix, shape (N, N)
        Blocks of the lower factor under its diagonal.
    lower_by_rows : csr_matrix, shape (N, N)
        The same by rows.
    """

    order: Index
    diagonal_slots: Index
    matrix_rows: tuple[Index, Index, Index]
    lower: sp.csc_matrix
    lower_by_rows: sp.csr_matrix

    @classmethod
    def of_pairs(cls, row: Index, column: Index, slots: Index) -> Elimination:
        """Find order and structure for matrices with blocks at the nodes `row` (n,) and `column` (n,).

        The node with fewest neighbours left is eliminated first.

        Parameters
        ----------
        row, column : ndarray, shape (n,)
            Column after column, diagonal included.
        slots : ndarray, shape (n, 2, 2)
            Places of the blocks in the matrix' data.
        """
        edges = np.bincount(column)
        # negative beside the diagonal: nothing that is filled in cancels
        values = np.where(row == column, edges[column] + 1.0, -1.0)
        graph = sp.csc_matrix((values, row, np.concatenate([[0], np.cumsum(edges)])), shape=(edges.size,) * 2)
        factors = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        factor, order = factors.L, factors.perm_c
        factor.sort_indices()
        below = np.ones(factor.nnz, dtype=bool)
        below[factor.indptr[:-1]] = False  # the diagonal is the first of each column
        rows, starts = factor.indices[below], np.concatenate([[0], np.cumsum(np.diff(factor.indptr) - 1)])
        lower = sp.csc_matrix((np.ones(rows.size, dtype=bool), rows, starts), shape=factor.shape)
        half = np.flatnonzero(order[column] <= order[row])
        half = half[np.argsort(order[row[half]], kind="stable")]
        diagonal_slots = np.empty((edges.size, 2), dtype=np.int64)
        diagonal_slots[order[row[row == column]]] = slots[row == column][:, [0, 1], [0, 1]]
        row_starts = np.searchsorted(order[row[half]], np.arange(edges.size + 1))
        matrix_rows = row_starts, order[column[half]], np.ascontiguousarray(slots[half])
        return cls(
            order=order,
            diagonal_slots=diagonal_slots,
            matrix_rows=matrix_rows,
            lower=lower,
            lower_by_rows=sp.csr_matrix(lower),
        )

    def factorise(self, data: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Factorise a positive definite matrix given by its data.

        Returns
        -------
        callable
            Solves for right-hand sides (2 N,) or (2 N, R).

        Raises
        ------
        LinAlgError
            The matrix is not positive definite, or singular in double precision.
        """
        lower, inverse = np.empty((self.lower.nnz, 4)), np.empty((self.order.size, 3))
        structure = self.lower.indptr, self.lower.indices
        factorise(
            data, *self.matrix_rows, self.lower_by_rows.indptr, self.lower_by_rows.indices, *structure, lower, inverse
        )
        xx, xy, yy = inverse.T
        growth = (xx + yy) * data[self.diagonal_slots].sum(axis=1)
        if not ((xx > 0) & (xx * yy > xy * xy) & (growth < _SINGULAR)).all():
            raise np.linalg.LinAlgError("the matrix is singular, or not positive definite")

        def solve(right_sides: FloatArray) -> FloatArray:
            solution = np.empty((self.order.size, 2, right_sides[0].size))
            solution[self.order] = right_sides.reshape(solution.shape)
            solve_factors(*structure, lower, inverse, solution)
            return solution[self.order].reshape(right_sides.shape)

        return solve
