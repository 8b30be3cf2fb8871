"""Blocks over which scores are summed, and how much of such a sum a fit on the mesh leaves in the residual."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from rgbmidic._kernels.correlation import element_hessian, element_vector
from rgbmidic.correlation.assembly import Assembly, factorise
from rgbmidic.mesh import PixelMap, Tri3Mesh

__all__ = ["BLOCK", "unfitted_share"]

BLOCK = 13
"""Side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter."""
_APART = 4
"""Blocks between two that are projected together, with random signs: their projections hardly meet."""


def unfitted_share(mesh: Tri3Mesh, pixels: PixelMap, assembly: Assembly) -> float:
    """Share of the variance of a block's sum of white scores that is left after linear elements have been fitted.

    The fit projects the scores on the shape functions, so ``1 - |P 1_b|^2 / |1_b|^2`` is left of block b, with P the
    projection and 1_b the block's indicator; the mean over all blocks is returned. It falls from 0.9 for elements of
    40 px to 0.2 for 7 px.
    """
    index, shape = pixels.blocks(BLOCK)
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    group = rows % _APART * _APART + columns % _APART
    sign = np.random.default_rng(0).choice([-1.0, 1.0], group.size)
    one, none = np.ones(index.size, dtype=np.float32), np.zeros(index.size, dtype=np.float32)
    mass = np.zeros((len(mesh.elements), 3, 3, 3))
    element_hessian(one, none, one, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, mass)
    mass[..., 2] = mass[..., 0]
    geometry = pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric
    matrix = assembly.matrix(mass)
    solve = factorise(sp.csc_matrix(matrix + 1e-9 * matrix.diagonal().mean() * sp.eye(assembly.size)))
    fitted, parts = 0.0, np.zeros((len(mesh.elements), 3, 2))
    for number in range(0, _APART**2, 2):
        even, odd = (np.where(group == number + i, sign, 0.0)[index].astype(np.float32) for i in (0, 1))
        element_vector(even, odd, *geometry, parts)
        projected = assembly.vector(parts)
        fitted += float(projected @ solve(projected))
    return max(1 - fitted / index.size, _LEAST)


_LEAST = 0.05
"""Least share, of elements of 4 px: what rounding would make of it must not blow the uncertainty up."""
