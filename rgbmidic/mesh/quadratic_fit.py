"""Quadratic fits to nodal values: value, slope and curvature at every node, and between the nodes at the owned pixels.

The recovery of Zhang and Naga, SIAM J. Sci. Comput. 26, 2005, with weights that fall with the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import scipy.sparse as sp

from rgbmidic.mesh.pixel_map import PixelMap
from rgbmidic.mesh.tri3 import Tri3Mesh, with_data
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

Index = npt.NDArray[np.intp]

TERMS = ("value", "x", "y", "xx", "xy", "yy")
"""Results of the operators of `quadratic_fit`: the value, its first and its second derivatives."""


def quadratic_fit(
    mesh: Tri3Mesh,
    used: BoolArray,
    *,
    information: FloatArray | None = None,
    offset: FloatArray | None = None,
    first: int | None = None,
) -> tuple[sp.csr_matrix, ...]:
    """Linear operators (N, N), one for each of `TERMS`, from nodal values to those of the polynomial at each node.

    The polynomial is fitted to the nodes within two edges, reached over `used` elements only: not across a crack or a
    hole. Quadratic fields are reproduced, at edges too; what too few nodes determine is 0.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    used : ndarray, shape (E,), bool
        Elements over which nodes are reached.
    information : ndarray, shape (N,), optional
        How well each node is known (inverse variance, any unit): one that is known badly counts little elsewhere.
    offset : ndarray, shape (N, 3), optional
        Excess of the given values over a field whose second derivative xx, xy or yy is 1, square px; 0 without.
    first
        Fit the polynomials of so many first nodes only; None: of all.

    Returns
    -------
    tuple of csr_matrix, shape (N, N) or (`first`, N)
        In the order of `TERMS`, per px and square px.
    """
    other, known, weight, structure = _window(mesh, used.tobytes())
    basis = _basis(mesh, used.tobytes(), None if offset is None else offset.tobytes())
    if first is not None:
        other, weight, basis, structure = other[:first], weight[:first], basis[:first], structure[:first]
        known = known[: structure.nnz]
    if information is not None:
        own, theirs = np.broadcast_to(information[: len(other), None], other.shape), information[other]
        weight = weight * np.divide(theirs, own + theirs, out=np.full(other.shape, 0.5), where=own + theirs > 0)
    weighted = weight[:, None] * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    # slopes and curvatures are held at 0 where too few nodes determine them: the second derivatives of waves of 5 to 6
    # elements, crack tips among them, change by 2e-5 of the largest at most (measured)
    normal[:, range(1, 6), range(1, 6)] += [1e-9, 1e-9, 1e-6, 1e-6, 1e-6]
    fits = (
        np.linalg.inv(normal) / (mesh.sizes[: len(other), None] ** np.array([0, 1, 1, 2, 2, 2]))[:, :, None]
    ) @ weighted
    return tuple(with_data(structure, fits[:, term].ravel()[known]) for term in range(6))


def blended(mesh: Tri3Mesh, pixels: PixelMap, polynomials: Sequence[FloatArray]) -> FloatImage:
    """Evaluate the nodes' polynomials at the owned pixels, each weighted by its shape function: (C, P), continuous.

    Parameters
    ----------
    mesh, pixels
        N nodes, P owned pixels.
    polynomials : sequence of ndarray, shape (N, C)
        Values of each of `TERMS`.
    """
    value, x, y, xx, xy, yy = polynomials
    element = np.repeat(np.arange(len(mesh.elements)), np.diff(pixels.offsets))
    columns, rows = pixels.columns, pixels.rows
    out = np.zeros((value.shape[1], columns.size), dtype=np.float32)
    for corner in range(3):
        node = mesh.elements[element, corner]
        constant, slope_x, slope_y = pixels.barycentric[element, corner].T
        shape_function = constant + slope_x * pixels.local_x + slope_y * pixels.local_y
        dx, dy = columns - mesh.nodes[node, 0], rows - mesh.nodes[node, 1]
        for c in range(len(out)):
            bent = xx[node, c] * dx * dx / 2 + xy[node, c] * dx * dy + yy[node, c] * dy * dy / 2
            out[c] += shape_function * (value[node, c] + x[node, c] * dx + y[node, c] * dy + bent)
    return out


@lru_cache(maxsize=2)  # of a mesh and of its halves
def _window(mesh: Tri3Mesh, used: bytes) -> tuple[Index, Index, FloatArray, sp.csr_matrix]:
    """Return the nodes that the polynomial of each node is fitted to.

    The last result is kept, for most frames use all elements.

    Returns
    -------
    tuple
        The nodes around each, itself where a row has fewer, (N, W); the places of those that are no such filling; their
        weights (N, W); and the matrix of these nodes.
    """
    elements = np.frombuffer(used, dtype=bool)
    surrounded = _surrounded(mesh, elements)
    is_tip = mesh.on_boundary & (surrounded > 0.8)  # of a crack that opens by less than 70 degrees
    reach = _reached(mesh, elements, ~is_tip)
    number = np.diff(reach.indptr)
    known = np.arange(number.max()) < number[:, None]
    other = np.repeat(np.arange(number.size)[:, None], known.shape[1], axis=1)
    other[known] = reach.indices
    square = sum((axis[other] - axis[:, None]) ** 2 for axis in mesh.nodes.T) / mesh.sizes[:, None] ** 2
    # Standard deviation of the weights around an inner node, in sides of an element. Waves of 3, 4 and 6 elements then
    # have .95 to 1.02, .99 to 1.01 and 1.00 of their height at the nodes, at a third less noise than the linear fit's;
    # with .45 1.05 and with .7 .86 of it at 3 elements (regular and outlined meshes, waves along the mesh and at 45
    # degrees). At an edge the window holds as much of the mesh as inside: with .58 everywhere corners scattered 2 times
    # as much as the linear fit's, and waves at an edge were seen no better.
    width = 0.58
    weight = np.where(known, np.exp(-square * surrounded[:, None] / (2 * width**2)), 0.0)
    return other, np.flatnonzero(known), weight, reach


def _surrounded(mesh: Tri3Mesh, used: BoolArray) -> FloatArray:
    """Return the fraction (N,) of the full angle around each node that `used` elements fill; 1 where there are none."""
    corners = mesh.nodes[mesh.elements]
    ahead, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    across = ahead[..., 0] * back[..., 1] - ahead[..., 1] * back[..., 0]
    angle = np.arctan2(across, (ahead * back).sum(axis=-1)) * used[:, None]
    fraction = np.bincount(mesh.elements.ravel(), weights=angle.ravel(), minlength=len(mesh.nodes)) / (2 * np.pi)
    return np.asarray(np.where(fraction > 0, fraction, 1.0))


@lru_cache(maxsize=4)  # with and without the offset
def _basis(mesh: Tri3Mesh, used: bytes, offset: bytes | None) -> FloatArray:
    """Evaluate 1, x, y, xx/2, xy, yy/2 about each node at those around it, in sides of an element: (N, 6, W)."""
    other = _window(mesh, used)[0]
    sizes = mesh.sizes[:, None]
    x, y = ((axis[other] - axis[:, None]) / sizes for axis in mesh.nodes.T)
    basis = np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=1)
    if offset is not None:
        for term, beyond in enumerate(np.frombuffer(offset).reshape(-1, 3).T):
            basis[:, 3 + term] += beyond[other] / sizes**2
    return basis


def _reached(mesh: Tri3Mesh, used: BoolArray, passable: BoolArray) -> sp.csr_matrix:
    """Return the nodes at most two edges of `used` elements away from each, itself included, as the entries of its row.

    A way leads through `passable` nodes (N,) only: not round the tip of a crack to its other side.
    """
    corners, itself = mesh.elements[used], np.arange(len(mesh.nodes))
    rows = np.concatenate([np.repeat(corners, 3, axis=1).ravel(), itself])
    columns = np.concatenate([np.tile(corners, 3).ravel(), itself])
    beside = sp.csr_matrix((np.ones(rows.size, dtype=bool), (rows, columns)), shape=(itself.size, itself.size))
    row = np.repeat(itself, np.diff(beside.indptr))
    through = with_data(beside, passable[row] | (beside.indices == row))
    reached = sp.csr_matrix(beside @ through)
    reached.sort_indices()  # or scipy might, later, in one of the matrices that share them
    return reached
