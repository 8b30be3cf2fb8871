"""Which elements match, and which nodes count as measured.

The matching criterion of an element is the zero-mean correlation coefficient of all lights at the displacement found.
A node counts as measured unless one of an ordered table of rules applies to it (`classify_nodes`).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rgbmidic._kernels.correlation import element_hessian
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.images import centred_products
from rgbmidic.correlation.reference import torn_elements
from rgbmidic.correlation.residual import Residual
from rgbmidic.correlation.solution import NodeStatus
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray, FloatImage
from rgbmidic.weights.precision import Precision


def classify_nodes(
    equations: Equations,
    residual: Residual,
    matched: BoolArray,
    std: FloatArray,
    sensitivity: FloatArray,
    inside: BoolArray,
) -> npt.NDArray[np.uint8]:
    """`NodeStatus` of every node (N,) at the end of a solve: of the rules, the first that applies decides.

    Parameters
    ----------
    equations, residual
        Of the last pass.
    matched : ndarray, shape (E,), bool
        Elements whose images match.
    std : ndarray, shape (N, 2)
        Standard uncertainty of u and v, px; NaN where not known.
    sensitivity : ndarray, shape (N,)
        As observed, over that of the equations.
    inside : ndarray, shape (N,), bool
        Nodes that lie in the deformed images.
    """
    textured = inside & (equations.observability * np.minimum(sensitivity, 1) > 1)
    one_sided = one_sided_texture(equations, residual)
    mismatched = residual.reference.mesh.to_nodes((~matched).astype(np.float64)) > 0
    rules = (
        # the elements around it do not match, and the others have too little texture
        (mismatched & (one_sided | ~textured), NodeStatus.DECORRELATED),
        # it has left the images, or no light sees enough texture around it
        (~textured, NodeStatus.NOT_SEEN),
        # the texture runs in one direction only: what lies along it cannot be measured
        (one_sided, NodeStatus.NOT_SEEN),
        # its displacement is uncertain by half a pixel or more, or nobody knows by how much
        (~(std.max(axis=1) <= residual.reference.constants.max_std), NodeStatus.DECORRELATED),
    )
    status = [np.uint8(code) for _, code in rules]
    return np.select([applies for applies, _ in rules], status, np.uint8(NodeStatus.MEASURED))


def one_sided_texture(equations: Equations, residual: Residual) -> BoolArray:
    """Nodes (N,) whose texture runs in one direction only: along the other, the gradient is that of the noise."""
    xx, xy, yy = equations.node_blocks
    half, difference = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    weak = half - difference
    one_sided = np.asarray(equations.textured & (weak < 0.3 * (half + difference)))
    if not one_sided.any():
        return one_sided
    angle = np.arctan2(2 * xy, xx - yy) / 2 + np.pi / 2  # of the weaker direction
    x, y = np.cos(angle), np.sin(angle)
    noise_xx, noise_xy, noise_yy = _noise_blocks(residual, equations.weights, one_sided)
    along = noise_xx * x * x + 2 * noise_xy * x * y + noise_yy * y * y
    # displacements along it are 30 % too small then
    return np.asarray(one_sided & (along > 0.3 * weak))


def _noise_blocks(residual: Residual, weights: FloatImage, nodes: BoolArray) -> FloatArray:
    """Return entries xx, xy, yy (3, N) of the chosen nodes' own blocks in the Hessian that noise alone has.

    The noise is what the residual, which holds that of both images, differs by from pixel to pixel; `nodes` is (N,).
    """
    reference, pixels = residual.reference, residual.reference.pixels
    mesh = reference.mesh
    elements = np.asarray(nodes[mesh.elements].any(axis=1))
    pixel_index, column, row = pixels.element_pixels(elements)
    beside, columns_beside, rows_beside = pixels.element_pixels(
        np.asarray(mesh.adjacent_nodes(nodes)[mesh.elements].any(axis=1))
    )
    offsets = np.concatenate([[0], np.cumsum(np.diff(pixels.offsets)[elements])])
    geometry = pixels.local_x[pixel_index], pixels.local_y[pixel_index], offsets, pixels.barycentric[elements]
    light_blocks, total = np.zeros((int(elements.sum()), 3, 3, 3)), np.zeros((elements.size, 3, 3, 3))
    image = np.zeros([side + 1 for side in pixels.shape], dtype=np.float32)
    for weight, difference in zip(weights, residual.difference, strict=True):
        image[rows_beside, columns_beside] = difference[beside] / np.float32(np.sqrt(2))
        centre = image[row, column]
        slopes = image[row, column + 1] - centre, image[row + 1, column] - centre
        element_hessian(*slopes, weight[pixel_index], *geometry, light_blocks)
        total[elements] += light_blocks
    return reference.assembly.node_blocks(total)


def matching_elements(
    residual: Residual, displacement: FloatArray, precision: Precision | None = None, *, min_zncc: float | None = None
) -> BoolArray:
    """Find the elements that are whole and match: zero-mean correlation coefficient of all lights together.

    Elements without weight or texture in the reference count as matched.

    Parameters
    ----------
    residual
        At the displacement found.
    displacement : ndarray, shape (N, 2)
        That displacement, px.
    precision
        Of the lights, by which they count in an element; None: all alike.
    min_zncc
        Coefficient from which an element matches; None judges it by what the elements around reach.

    Returns
    -------
    ndarray, shape (E,), bool
    """
    mesh, constants = residual.reference.mesh, residual.reference.constants
    fg, ff, gg = _centred_products(residual, precision)
    element_zncc = correlation(fg, ff, gg)
    # a few speckles can match by chance; those of all elements around a node hardly
    nodal_zncc = correlation(mesh.to_nodes(fg), mesh.to_nodes(ff), mesh.to_nodes(gg))
    coefficient = np.minimum(element_zncc, np.sort(nodal_zncc[mesh.elements], axis=1)[:, 1])
    intact = ~torn_elements(mesh, displacement, constants)
    if min_zncc is not None:
        return np.asarray(intact & (coefficient >= min_zncc))
    poor, good = constants.zncc_bounds if precision is None else constants.zncc_bounds_precise
    matched = np.asarray(coefficient >= good)
    between = ~matched & (coefficient >= poor)
    typical, textured = 1.0, ff > 0
    if textured.any() and between.any():
        centre = mesh.centres
        ranks = [*range(1, min(constants.neighbour_count, int(textured.sum())) + 1)]
        nearest = cKDTree(centre[textured]).query(centre[between], k=ranks)[1]
        typical = np.median(coefficient[textured][nearest], axis=1)
    matched[between] = coefficient[between] >= 1 - constants.outlier_factor * (1 - typical)
    return matched & intact


def correlation_around(residual: Residual) -> FloatArray:
    """Zero-mean correlation coefficient (N,) of all lights together in the elements around each node.

    It is NaN where the states show no texture together.
    """
    mesh = residual.reference.mesh
    fg, ff, gg = (mesh.to_nodes(products) for products in _centred_products(residual, None))
    return np.where(ff > 1e-9 * ff.max(initial=0.0), correlation(fg, ff, gg), np.nan)


def misfit(mesh: Tri3Mesh, squares: FloatArray, measured: BoolArray) -> FloatArray:
    """Weighted rms residual around each node, over its median: 1 is ordinary, 3 is suspicious.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    squares : ndarray, shape (k, E, 3)
        Those of `Residual` with the weights of the solve, in units of the inverse variance of the residual.
    measured : ndarray, shape (N,), bool
        Nodes over which the median is taken.

    Returns
    -------
    ndarray, shape (N,)
    """
    square, _, count = (mesh.to_nodes(sums) for sums in squares.sum(axis=0).T)
    mean_square = square / np.maximum(count, 1.0)
    typical = float(np.median(mean_square[measured])) if measured.any() else 0.0
    return np.sqrt(mean_square / typical) if typical > 0 else np.ones_like(mean_square)


def _centred_products(residual: Residual, precision: Precision | None) -> FloatArray:
    """Sum the centred products f g, f f and g g of each element over the lights; (3, E).

    Lights count by their mean precision in the element over that of the most precise; alike where it is not known.
    """
    products = np.array(centred_products(residual.moments))
    if precision is not None and len(residual.weights) > 1:
        mean = residual.reference.sums(precision.factor, precision.loss_curvature)[..., 0]
        products *= mean / np.maximum(mean.max(axis=0), 1e-300)
    return np.asarray(products.sum(axis=1))


def correlation(fg: FloatArray, ff: FloatArray, gg: FloatArray) -> FloatArray:
    """Correlation coefficient from the centred products f g, f f and g g.

    It is 1 where the reference has nothing to compare, and 0 where only the deformed image has nothing.
    """
    empty = ff <= 1e-9 * ff.max(initial=0.0)
    blank = gg <= 1e-9 * ff
    scale = np.sqrt(np.maximum(ff, 0) * np.maximum(gg, 0))
    return np.where(empty, 1.0, np.where(blank, 0.0, fg / np.where(empty | blank, 1.0, scale)))
