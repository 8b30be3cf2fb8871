"""What a measurement on a mesh makes of a simulated displacement field: the same fit and recovery, applied to it."""

from __future__ import annotations

import math

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from rgbmidic.correlation.recovery import Recovery
from rgbmidic.errors import InputError
from rgbmidic.fields.nodal import Places
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray


class Levelling:
    """What a measurement on a mesh makes of a simulated displacement field.

    The solve is a least-squares fit of linear elements, in which the texture counts alike everywhere on average, and
    the nodal values are recovered from it by quadratics. Both are applied here.

    Parameters
    ----------
    mesh
        The measurement's mesh.
    simulated
        The simulation's, in the same axes and unit.

    Raises
    ------
    InputError
        The simulation covers no element of the measurement.
    """

    def __init__(self, mesh: Tri3Mesh, simulated: Tri3Mesh) -> None:
        # the simulation is averaged over elements of half its own, 3 to 12 along a side: the error falls as the square
        # of their number, and is 1 % of what levelling changes at 3 (derived)
        inner = _middles(int(np.clip(math.ceil(2 * mesh.size / simulated.size), 3, 12)))
        points = np.einsum("qc,ecd->eqd", inner, mesh.nodes[mesh.elements])
        read, depth = reading(simulated, points.reshape(-1, 2))
        # it is continued linearly by half an element: the outline of a region drawn by hand differs by some px (chosen)
        used: BoolArray = np.asarray((depth.reshape(points.shape[:2]) > -0.5).all(axis=1))
        if not used.any():
            raise InputError("the simulation's mesh covers no element of the measurement's: check where it is placed")
        row = np.arange(len(depth))
        columns, values = np.repeat(mesh.elements, len(inner), axis=0), np.tile(inner, (len(mesh.elements), 1))
        shape = sp.csr_matrix((values.ravel(), (np.repeat(row, 3), columns.ravel())), shape=(len(row), len(mesh.nodes)))
        weighted = sp.csr_matrix(sp.diags(np.repeat(used * mesh.areas / len(inner), len(inner))) @ shape).T
        self._covered: BoolArray = np.asarray(mesh.to_nodes(np.asarray(used, dtype=np.float64)) > 0)
        self._factors = splu(sp.csc_matrix(weighted @ shape + sp.diags(1.0 * ~self._covered)))
        self._moments = sp.csr_matrix(weighted @ read)
        self._recovery = Recovery.over(mesh, used, self._covered.astype(np.float64))

    def __call__(self, displacement: FloatArray) -> FloatArray:
        """Displacement (2, N) at the measurement's nodes of a simulated one (M, 2); NaN where that does not reach."""
        moments = self._moments @ np.nan_to_num(displacement)
        unknown: FloatArray = np.asarray(np.isnan(displacement).any(axis=1), dtype=np.float64)
        lost = (abs(self._moments) @ unknown) > 0
        recovered = self._recovery.displacement(self._factors.solve(moments)).T
        return np.where(self._covered & ~lost, recovered, np.nan)


def _middles(parts: int) -> FloatArray:
    """Barycentric coordinates (parts^2, 3) of the middles of equal parts of a triangle."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(parts) for j in range(parts - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(parts - 1) for j in range(parts - 1 - i)]
    first, second = np.array(up + down).T / parts
    return np.stack([first, second, 1 - first - second], axis=1)


def reading(mesh: Tri3Mesh, points: FloatArray) -> tuple[sp.csr_matrix, FloatArray]:
    """Matrix (P, N) that reads a nodal field at points (P, 2), and the least barycentric coordinate there (P,)."""
    at_once = 20_000  # points: some 60 MB (derived)
    parts = [Places.of(mesh, points[start : start + at_once]) for start in range(0, len(points), at_once)]
    values = np.concatenate([part.barycentric for part in parts])
    nodes = mesh.elements[np.concatenate([part.element for part in parts])]
    row = np.repeat(np.arange(len(points)), 3)
    matrix = sp.csr_matrix((values.ravel(), (row, nodes.ravel())), shape=(len(points), len(mesh.nodes)))
    return matrix, values.min(axis=1)
