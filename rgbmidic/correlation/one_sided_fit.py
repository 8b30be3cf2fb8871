"""Third-order polynomials at the boundary of a mesh: what the one-sided quadratic ones of the recovery cannot follow.

At a free boundary strain may change within less than the window of a fit, at the rim of a hole within half its radius,
and there is nothing beyond that could show it. What a polynomial of one order more makes of the same displacements
differs from the recovered field in proportion to what that misses (error estimation by order, Zienkiewicz and Zhu, Int.
J. Numer. Meth. Eng. 33, 1992).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.recovery import angle_fraction
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.mesh.outline_mesh import EDGES, edge_keys
from rgbmidic.typing import BoolArray, FloatArray

_POWERS = np.array([(i, n - i) for n in range(4) for i in range(n, -1, -1)])
_WIDTHS = np.array([0.8, 0.5, 0.5])
"""Standard deviation of the weights of the fits for the value and the two slopes, in sides of an element as inside.

What the recovery misses, at the rim of a hole with elements of 0.15 to 0.3 of its diameter and in waves of 3 to 8
elements at straight edges, is then 0.9 to 1.5 and 0.7 to 1.5 times the difference of the value, 2.1 to 3.8 and 1.4 to
2.0 times that of the strain (without noise). Narrower fits follow less of the value, wider ones less of the strain."""


def at_free_boundary(mesh: Tri3Mesh) -> BoolArray:
    """Nodes (N,) on the boundary, and those less than a quarter of an element from an edge of it."""
    sides = mesh.elements[:, EDGES]
    keys = edge_keys(sides.reshape(-1, 2), len(mesh.nodes))
    _, index, count = np.unique(keys, return_inverse=True, return_counts=True)
    length = np.linalg.norm(np.diff(mesh.nodes[sides], axis=2)[:, :, 0], axis=2)
    opposite = np.roll(mesh.elements, 1, axis=1)  # edge a joins the corners a and a + 1
    is_near = 2 * mesh.areas[:, None] / length < mesh.sizes[opposite] / 4
    found = mesh.on_boundary
    found[opposite[is_near & (count[index] == 1).reshape(-1, 3)]] = True
    return found


def one_sided_difference(mesh: Tri3Mesh, used: BoolArray, field: FloatArray) -> FloatArray:
    """Evaluate what third-order polynomials at the nodes of `at_free_boundary` have beyond a field.

    Parameters
    ----------
    mesh
        N nodes, E elements.
    used : ndarray, shape (E,), bool
        Elements over which nodes are reached, up to three edges away.
    field : ndarray, shape (N, ..., 5)
        u, v, exx, eyy, exy: the polynomials are fitted to u and v.

    Returns
    -------
    ndarray, shape (N, ..., 5)
        NaN at other nodes, and where fewer than ten nodes are reached.
    """
    out, corners = np.full_like(field, np.nan), mesh.elements[used]
    ends = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, 3).ravel()
    beside = sp.csr_matrix((np.ones(len(ends[0]), dtype=bool), ends), shape=(len(mesh.nodes),) * 2)
    nodes = np.flatnonzero(at_free_boundary(mesh))
    reach = beside[nodes] @ beside @ beside
    number = np.diff(reach.indptr)
    nodes, reach = nodes[number >= len(_POWERS)], reach[number >= len(_POWERS)]
    if not nodes.size:
        return out
    has_node = np.arange(number.max()) < np.diff(reach.indptr)[:, None]
    other = np.repeat(nodes[:, None], number.max(), axis=1)
    other[has_node] = reach.indices
    size = mesh.sizes[nodes, None]
    x, y = ((axis[other] - axis[nodes, None]) / size for axis in mesh.nodes.T)
    basis = np.stack([x**i * y**j for i, j in _POWERS], axis=1)
    square = (x**2 + y**2) * np.minimum(angle_fraction(mesh, used), 0.5)[nodes, None] / 2
    weight = np.where(has_node, np.exp(-square / _WIDTHS[:, None, None] ** 2), 0)
    weighted = weight[:, :, None] * basis
    normal = weighted @ basis.transpose(0, 2, 1)
    normal += np.diag([0, *[1e-6] * (len(_POWERS) - 1)])  # as of the recovery: 0 where nodes do not determine it
    fits = np.linalg.solve(normal, weighted)[range(3), :, range(3)]
    fits[1:] /= size
    u, v = (np.einsum("tbw,bw...->tb...", fits, field[other, ..., axis]) for axis in (0, 1))
    out[nodes] = np.stack([u[0], v[0], u[1], v[2], (u[2] + v[1]) / 2], axis=-1) - field[nodes]
    return out
