"""Blocks over which scores are summed, and how much of such a sum the fit of the displacement leaves over."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.correlation import element_hessian
from rgbmidic.correlation.assembly import Assembly
from rgbmidic.mesh import PixelMap
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["BLOCK", "block_side", "unfitted_share"]

BLOCK = 13
"""Least side (px) of the blocks whose sums give the covariance of the scores: wider than a speckle and any filter."""
_OF_ELEMENT = 0.75
"""Side of a block in sides of an element: what elements cannot follow is alike over about that. With 13 px the error of
40 px elements on waves of 3 to 5 elements was 1.5 to 2.3 times the stated one, so 0.8 to 1.2 times (DIC Challenge)."""
_ACROSS = 4
"""Blocks across a region from which they grow with the element: two of 19 px stated 1.8 times too much."""
_MANY = 700
"""Blocks, every other one in both directions, whose projections are told from one another by their random signs to half
a per cent of the share; where a region has fewer, those further apart are projected together, every fourth at most."""
_ANCHOR = 1e-6
"""Multiple of the identity, over the texture of an unknown, that holds nodes without."""
_LEAST = 0.05
"""Share under which the residual tells nothing of the noise: a region of one block (elements of 4 px leave 0.1)."""


def block_side(pixels: PixelMap, element: float) -> int:
    """Side (px) of the blocks for elements of side `element` (px); a small region has `_ACROSS` of them across."""
    return max(BLOCK, min(round(_OF_ELEMENT * element), min(pixels.bounds[2:]) // _ACROSS))


def unfitted_share(
    pixels: PixelMap,
    assembly: Assembly,
    gradient: FloatImage,
    weights: FloatImage,
    side: int,
) -> float:
    """Share of the variance of a block's score that is left after the displacement has been fitted to white noise.

    The residual is the noise less its projection P on the columns ``J = grad f phi`` of the least-squares problem. The
    score of block b is the product with ``c = grad f 1_b``, so ``1 - |P c|^2 / |c|^2`` of its variance is left, with
    ``|P c|^2 = (J^T c)^T (J^T J)^-1 (J^T c)``; the mean over the blocks is returned. Blocks apart are projected
    together, with random signs. It falls from 0.85 for elements of 40 px to 0.1 for 4 px, and is not known (NaN) where
    nothing is left, in a region of about one block.

    Parameters
    ----------
    pixels, assembly
        Of the mesh.
    gradient, weights : ndarray, shape (2, k, P), (k, P), float32
        Of the reference images.
    side
        Of the blocks, px.
    """

    def summed(signs: FloatImage | np.float32) -> FloatArray:
        out = np.zeros((len(pixels.origin), 3, 3, 3))
        own, geometry = np.empty_like(out), (pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric)
        for gx, gy, weight in zip(*gradient, weights, strict=True):
            element_hessian(gx, gy, weight * signs, *geometry, own)
            out += own
        return out

    hessian = summed(np.float32(1))
    total = float(hessian[..., (0, 2)].sum())
    if not total:
        return 1.0
    rows, columns = pixels.grid(side)
    apart = int(np.clip(np.ceil(2 * np.sqrt(_MANY / (rows * columns))), 2, 4))
    sign = np.random.default_rng(0).choice(np.array([-1, 1], dtype=np.float32), (rows, columns))
    projected = []
    for place in np.ndindex(apart, apart):
        chosen = np.zeros_like(sign)
        chosen[place[0] :: apart, place[1] :: apart] = sign[place[0] :: apart, place[1] :: apart]
        products = summed(pixels.in_blocks(chosen, side)).sum(axis=1)  # the shape functions of an element add up to 1
        xx_to_yy = assembly.at_nodes(products)
        projected += [xx_to_yy[:, :2].ravel(), xx_to_yy[:, 1:].ravel()]
    sides, anchor = np.stack(projected, axis=1), _ANCHOR * total / assembly.size
    solve = assembly.factorise(assembly.matrix(hessian, anchor * assembly.diagonal))
    share = 1 - float((sides * solve(sides)).sum()) / total
    return share if share > _LEAST else float("nan")
