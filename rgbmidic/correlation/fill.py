"""Nodes that no light sees, filled from those around by a smooth field, for users who ask for it.

The field minimises the squared graph Laplacian over the unmeasured nodes after a quadratic trend of the measured ones
is taken off (a thin plate that bends as little as it can). The uncertainty is that of the nearest measured node plus
what neighbouring nodes differ from that trend by, growing with the square root of the number of elements crossed, like
a random walk.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.solution import NodeStatus, Solution
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray

__all__ = ["fill"]


def fill(mesh: Tri3Mesh, solution: Solution, longest: float) -> Solution:
    """Fill the displacement of unmeasured nodes within `longest` px of a measured one.

    Filled nodes get `NodeStatus.FILLED` and a larger `displacement_std`; strains are left as they are.
    """
    measured = solution.measured
    if measured.all() or measured.sum() < 6:
        return solution
    distance, nearest = mesh.nearest(measured)
    filled = ~measured & (distance <= longest)
    if not filled.any():
        return solution
    trend, rest = _quadratic_trend(mesh.nodes, solution.displacement, measured)
    step = _step_between_neighbours(mesh, rest, measured)
    size = float(np.sqrt(2 * mesh.areas.mean()))
    std = np.hypot(solution.displacement_std[nearest], step * np.sqrt(np.minimum(distance, longest) / size)[:, None])
    displacement = trend + _smooth(mesh, rest, measured)
    return replace(
        solution,
        displacement=np.where(filled[:, None], displacement, solution.displacement),
        displacement_std=np.where(filled[:, None], std, solution.displacement_std),
        node_status=np.where(filled, np.uint8(NodeStatus.FILLED), solution.node_status),
    )


def _quadratic_trend(nodes: FloatArray, displacement: FloatArray, measured: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Quadratic least-squares fit at all nodes (N, 2), and what the measured ones leave (0 elsewhere)."""
    scaled = (nodes - nodes.mean(axis=0)) / np.ptp(nodes, axis=0).max()
    x, y = scaled.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    trend = basis @ np.linalg.lstsq(basis[measured], displacement[measured], rcond=1e-9)[0]
    return trend, np.where(measured[:, None], displacement - trend, 0.0)


def _step_between_neighbours(mesh: Tri3Mesh, rest: FloatArray, measured: BoolArray) -> FloatArray:
    """Rms difference (2,) of neighbouring measured nodes."""
    i, j = mesh.neighbours.T
    both = measured[i] & measured[j]
    return np.asarray(np.sqrt(np.mean((rest[i[both]] - rest[j[both]]) ** 2, axis=0)) if both.any() else np.zeros(2))


def _smooth(mesh: Tri3Mesh, rest: FloatArray, measured: BoolArray) -> FloatArray:
    """`rest` (N, 2) at the measured nodes, and the field of least squared Laplacian through them elsewhere."""
    from scipy.sparse.linalg import spsolve

    count = len(mesh.nodes)
    i, j = mesh.neighbours.T
    adjacency = sp.csr_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    laplacian = sp.eye(count, format="csr") - sp.diags(1 / np.maximum(degree, 1)) @ adjacency
    energy = sp.csc_matrix(laplacian.T @ laplacian + 1e-8 * sp.eye(count))
    free, known = np.flatnonzero(~measured), np.flatnonzero(measured)
    out = rest.copy()
    right = -(energy[free][:, known] @ rest[known])
    out[free] = np.asarray(spsolve(energy[free][:, free].tocsc(), right)).reshape(-1, 2)
    return out
