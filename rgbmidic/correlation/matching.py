"""Which elements' images match at the displacement found, and how well the residual around each node fits in."""

from __future__ import annotations

import numpy as np

from rgbmidic._kernels.correlation import element_moments
from rgbmidic.correlation.residual import Residual
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["matching_elements", "misfit"]

_MATCHED = (0.4, 0.6)
"""Correlation coefficient under which the images of an element do not match: for poor images and for good ones."""
_WORSE = 8.0
"""In between: how many times farther from 1 than the median of the elements."""


def matching_elements(residual: Residual, least: float | None = None) -> BoolArray:
    """Elements (E,) whose images match: zero-mean correlation coefficient of all lights together.

    Elements without weight or texture in the reference say nothing and count as matched. `least` is the coefficient
    from which an element matches; None judges it by what the others reach.
    """
    mesh = residual.reference.mesh
    fg, ff, gg = _centred_products(residual)
    own = _correlation(fg, ff, gg)
    # a few speckles can match by chance; those of all elements around a node hardly
    around = _correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
    coefficient = np.minimum(own, np.median(around[mesh.elements], axis=1))
    if least is None:
        textured = coefficient[ff > 0]
        typical = float(np.median(textured)) if textured.size else 1.0
        least = float(np.clip(1 - _WORSE * (1 - typical), *_MATCHED))
    return np.asarray(coefficient >= least)


def misfit(residual: Residual, weights: FloatImage, measured: BoolArray) -> FloatArray:
    """Weighted rms residual around each node (N,), over its median: 1 is ordinary, 3 is suspicious.

    `weights` (k, P) are those of the solve, in units of the inverse variance of the residual.
    """
    mesh, offsets = residual.reference.mesh, residual.reference.pixels.offsets
    owner = np.repeat(np.arange(len(mesh.elements)), np.diff(offsets))
    square, count = (
        mesh.to_nodes(np.bincount(owner, weights=part.sum(axis=0), minlength=len(mesh.elements)).astype(np.float64))
        for part in (weights * residual.difference**2, weights > 0)
    )
    around = square / np.maximum(count, 1.0)
    typical = float(np.median(around[measured])) if measured.any() else 0.0
    return np.sqrt(around / typical) if typical > 0 else np.ones_like(around)


def _centred_products(residual: Residual) -> FloatArray:
    """Sums (3, E) over the lights of the centred products f g, f f and g g of each element."""
    offsets = residual.reference.pixels.offsets
    moments = np.zeros((len(offsets) - 1, 6))
    products = np.zeros((3, len(moments)))
    for value, warped, weight in zip(residual.values, residual.warped, residual.weights, strict=True):
        element_moments(value, warped, weight, offsets, moments)
        total, f, g, f2, product, g2 = moments.T
        total = np.maximum(total, 1e-30)
        products += product - f * g / total, f2 - f * f / total, g2 - g * g / total
    return products


def _correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from centred products; 1 where the reference has nothing to compare, 0 where only the
    deformed image has nothing."""
    empty = ff <= 1e-9 * ff.max(initial=0.0)
    blank = gg <= 1e-9 * ff
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    return np.where(empty, 1.0, np.where(blank, 0.0, fg / np.where(empty | blank, 1.0, scale)))
