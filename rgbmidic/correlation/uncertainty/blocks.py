"""Blocks over which scores are summed, and how much of such a sum the fit of the displacement leaves over."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from rgbmidic._kernels.correlation import element_hessian, element_vector
from rgbmidic.correlation.assembly import Assembly, factorise
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatImage

__all__ = ["BLOCK", "block_side", "unfitted_share"]

BLOCK = 13
"""Least side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter."""
_OF_ELEMENT = 0.75
"""Side of a block in sides of an element: what elements cannot follow is alike over about that. With 13 px the error of
40 px elements on waves of 3 to 5 elements was 1.5 to 2.3 times the stated one, so 0.8 to 1.2 times (DIC Challenge)."""
_ACROSS = 4
"""Blocks across a region from which they grow with the element: two of 19 px stated 1.8 times too much."""
_APART = 4
"""Blocks between two that are projected together, with random signs: their projections hardly meet."""
_MANY = 500
"""Blocks that tell enough: their shares scatter by a fifth."""
_ANCHOR = 1e-6
"""Multiple of the identity, over the mean diagonal entry, that holds nodes without texture."""
_LEAST = 0.05
"""Share under which the residual tells nothing of the noise: a region of one block (elements of 4 px leave 0.1)."""


def block_side(pixels: PixelMap, element: float) -> int:
    """Side (px) of the blocks for elements of side `element` (px); a small region has `_ACROSS` of them across."""
    return max(BLOCK, min(round(_OF_ELEMENT * element), min(pixels.bounds[2:]) // _ACROSS))


def unfitted_share(
    pixels: PixelMap, assembly: Assembly, gradient_x: FloatImage, gradient_y: FloatImage, side: int
) -> float:
    """Share of the variance of a block's score that is left after the displacement has been fitted to white noise.

    The residual is the noise less its projection P on the columns ``J = grad f phi`` of the least-squares problem. The
    score of block b is the product with ``c = grad f 1_b``, so ``1 - |P c|^2 / |c|^2`` of its variance is left, with
    ``|P c|^2 = (J^T c)^T (J^T J)^-1 (J^T c)``; the mean over the blocks is returned. It falls from 0.85 for elements of
    40 px to 0.1 for 4 px, and is not known (NaN) where nothing is left, in a region of about one block.

    Parameters
    ----------
    pixels, assembly
        Of the mesh.
    gradient_x, gradient_y : ndarray, shape (k, P), float32
        Of the reference images, 0 where a pixel is not used.
    side
        Of the blocks, px.
    """
    if not gradient_x.any() and not gradient_y.any():
        return 1.0
    pairs = (gradient_x, gradient_x), (gradient_x, gradient_y), (gradient_y, gradient_y)
    xx, xy, yy = (np.einsum("kp,kp->p", *pair) for pair in pairs)
    geometry = pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric
    hessian = np.zeros((len(pixels.origin), 3, 3, 3))
    for gx, gy in zip(gradient_x, gradient_y, strict=True):
        own = np.zeros_like(hessian)
        element_hessian(
            gx, gy, np.ones_like(gx), pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, own
        )
        hessian += own
    matrix = assembly.matrix(hessian)
    solve = factorise(sp.csc_matrix(matrix + _ANCHOR * matrix.diagonal().mean() * sp.eye(assembly.size)))
    index, shape = pixels.blocks(side), pixels.grid(side)
    rows, columns = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    group = rows % _APART * _APART + columns % _APART
    sign = np.random.default_rng(0).choice([-1.0, 1.0], group.size)
    total = fitted = 0.0
    parts = np.zeros((len(pixels.origin), 3, 2))
    for number in range(0, _APART**2, min(max(group.size // _MANY, 1), _APART**2)):
        chosen = np.where(group == number, sign, 0.0).astype(np.float32)[index]
        held = np.abs(chosen)
        total += float((xx * held).sum(dtype=np.float64) + (yy * held).sum(dtype=np.float64))
        for first, second in ((xx, xy), (xy, yy)):
            element_vector(np.ones_like(chosen), chosen, first, second, *geometry, parts)
            column = assembly.vector(parts)
            fitted += float(column @ solve(column))
    share = 1 - fitted / max(total, 1e-300)
    return share if share > _LEAST else float("nan")
