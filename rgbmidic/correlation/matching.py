"""Which elements' images match at the displacement found, and how well the residual around each node fits in."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rgbmidic.correlation.precision import Precision
from rgbmidic.correlation.residual import Residual
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["correlation", "correlation_around", "matching_elements", "misfit"]

_MATCHED = (0.4, 0.6)
"""Correlation coefficient under which the images of an element do not match: for poor images and for good ones."""
_MATCHED_PRECISE = (0.4, 0.9)
"""The same where the lights count by their precision, so that a reflection in one of them is no mismatch."""
_WORSE = 8.0
"""In between: how many times farther from 1 than the median of the elements around."""
_AROUND = 61
"""Elements around: a square of some 5.5 elements a side, of which a crack takes a third."""


def matching_elements(
    residual: Residual, precision: Precision | None = None, *, least: float | None = None
) -> BoolArray:
    """Elements (E,) whose images match: zero-mean correlation coefficient of all lights together.

    Elements without weight or texture in the reference say nothing and count as matched. Lights count by their
    `precision` in the element, where it is known. `least` is the coefficient from which an element matches; None judges
    it by what the elements around reach.
    """
    mesh = residual.reference.mesh
    fg, ff, gg = _centred_products(residual, _light_precision(residual, precision))
    own = correlation(fg, ff, gg)
    # a few speckles can match by chance; those of all elements around a node hardly
    around = correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
    coefficient = np.minimum(own, np.sort(around[mesh.elements], axis=1)[:, 1])
    if least is not None:
        return np.asarray(coefficient >= least)
    poor, good = _MATCHED if precision is None else _MATCHED_PRECISE
    matched = np.asarray(coefficient >= good)
    between = ~matched & (coefficient >= poor)
    typical = _median_around(mesh, coefficient, ff > 0, between)
    matched[between] = coefficient[between] >= 1 - _WORSE * (1 - typical)
    return matched


def correlation_around(residual: Residual) -> FloatArray:
    """Zero-mean correlation coefficient (N,) of all lights together in the elements around each node; NaN where the
    states show no texture together."""
    to_nodes = residual.reference.mesh.to_nodes
    fg, ff, gg = (to_nodes(part) for part in _centred_products(residual, _light_precision(residual, None)))
    return np.where(ff > 1e-9 * ff.max(initial=0.0), correlation(fg, ff, gg), np.nan)


def _median_around(mesh: Tri3Mesh, values: FloatArray, textured: BoolArray, chosen: BoolArray) -> FloatArray:
    """Median of the values of the nearest textured elements around each of the `chosen` elements (E,); 1 where there is
    none."""
    if not textured.any() or not chosen.any():
        return np.ones(int(chosen.sum()))
    centre = mesh.nodes[mesh.elements].mean(axis=1)
    count = min(_AROUND, int(textured.sum()))
    nearest = cKDTree(centre[textured]).query(centre[chosen], k=[*range(1, count + 1)])[1]
    return np.asarray(np.median(values[textured][nearest], axis=1))


def _light_precision(residual: Residual, precision: Precision | None) -> FloatArray:
    """Mean precision (k, E) of each light in each element, over that of the most precise; 1 where it is not known."""
    reference = residual.reference
    if precision is None or len(residual.values) == 1:
        return np.ones((len(residual.values), len(reference.mesh.elements)))
    mean = reference.sums(precision.factor, precision.bend)[..., 0]
    return np.asarray(mean / np.maximum(mean.max(axis=0), 1e-300))


def misfit(mesh: Tri3Mesh, squares: FloatArray, measured: BoolArray) -> FloatArray:
    """Weighted rms residual around each node (N,), over its median: 1 is ordinary, 3 is suspicious.

    `squares` (k, E, 3) are those of `Residual` with the weights of the solve, in units of the inverse variance of the
    residual.
    """
    square, _, count = (mesh.to_nodes(part) for part in squares.sum(axis=0).T)
    around = square / np.maximum(count, 1.0)
    typical = float(np.median(around[measured])) if measured.any() else 0.0
    return np.sqrt(around / typical) if typical > 0 else np.ones_like(around)


def _centred_products(residual: Residual, precision: FloatArray) -> FloatArray:
    """Sums (3, E) over the lights, each with its `precision` (k, E), of the centred products f g, f f and g g."""
    return np.asarray([(precision * part).sum(axis=0) for part in residual.centred_products()])


def correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from centred products; 1 where the reference has nothing to compare, 0 where only the
    deformed image has nothing."""
    empty = ff <= 1e-9 * ff.max(initial=0.0)
    blank = gg <= 1e-9 * ff
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    return np.where(empty, 1.0, np.where(blank, 0.0, fg / np.where(empty | blank, 1.0, scale)))
