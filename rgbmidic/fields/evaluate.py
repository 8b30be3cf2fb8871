"""Nodal fields at pixels, and pixel fields at nodes."""

from __future__ import annotations

import numpy as np

from rgbmidic.mesh import PixelMap, Region, Tri3Mesh
from rgbmidic.mesh.quadratic_fit import blended, quadratic_fit
from rgbmidic.typing import FloatArray, FloatImage

__all__ = ["at_nodes", "at_pixels", "field_rms"]


def at_pixels(mesh: Tri3Mesh, values: FloatArray, shape: tuple[int, int]) -> FloatImage:
    """A nodal field (N, 2) at the pixels of an image of `shape` (H, W), as curved as the nodes around say it is.

    Each node's quadratic counts as its shape function does. Linear between nodes that are right, a wave of 6 elements
    would lose a tenth of its height; this one keeps .99, .95 at 4 and .83 at 3 elements.

    Returns
    -------
    ndarray, shape (2, H, W), float32
        NaN outside the mesh and in elements with a NaN node.
    """
    pixels = PixelMap.from_mesh(mesh, Region.from_mask(np.ones(shape, dtype=bool)))
    used = np.asarray(np.isfinite(values)[mesh.elements].all(axis=(1, 2)))
    known = np.nan_to_num(values)
    out = blended(mesh, pixels, [values, *(operator @ known for operator in quadratic_fit(mesh, used)[1:])])
    return np.stack([pixels.scatter(part, fill=np.nan) for part in out])


def at_nodes(field: FloatArray, nodes: FloatArray) -> FloatArray:
    """A pixel field (C, H, W) at nodes (N, 2), bilinear; shape (N, C), NaN where a pixel used is NaN."""
    height, width = field.shape[1:]
    x = np.clip(nodes[:, 0], 0, width - 1)
    y = np.clip(nodes[:, 1], 0, height - 1)
    column = np.minimum(x.astype(int), width - 2)
    row = np.minimum(y.astype(int), height - 2)
    tx, ty = x - column, y - row
    above = (1 - tx) * field[:, row, column] + tx * field[:, row, column + 1]
    below = (1 - tx) * field[:, row + 1, column] + tx * field[:, row + 1, column + 1]
    return np.asarray(((1 - ty) * above + ty * below).T)


def field_rms(mesh: Tri3Mesh, values: FloatArray, truth: FloatArray, *, border: float = 0.0) -> float:
    """Root mean square difference, over pixels and components, of a nodal field (N, 2) and a pixel field (2, H, W).

    Parameters
    ----------
    mesh, values
        The field; NaN nodes leave out their elements.
    truth
        NaN pixels are left out.
    border
        Width in px of the rim of the mesh's bounding box that is left out.
    """
    difference = at_pixels(mesh, values, truth.shape[1:]) - truth
    low, high = mesh.nodes.min(axis=0) + border, mesh.nodes.max(axis=0) - border
    rows = slice(int(np.ceil(low[1])), int(high[1]) + 1)
    columns = slice(int(np.ceil(low[0])), int(high[0]) + 1)
    inner = difference[:, rows, columns]
    inner = inner[np.isfinite(inner)]
    return float(np.sqrt(np.mean(inner**2))) if inner.size else float("nan")
