"""Nodal fields: the covariance of nodes and of frames, rigid motion.

The solve is a least-squares fit of linear elements, whose covariance is the inverse of a Hessian: for a texture that is
alike everywhere the inverse of the mesh's mass matrix. The displacement at a node is then that of a quadratic through
the nodes around it, a linear function of theirs. Where the texture, the weights or the noise vary, the stated
uncertainty of each node reports by how much; its correlation with the others is taken as the mesh's alone.

The frames of a test have the noise of the reference in common, which cancels in differences and rates. The displacement
of frame t has the error ``b_t - r``: that of the frame's own noise, less the mean of the same for the n frames of the
reference. With equal noise in all frames the variance stated for t is ``(1 + 1/n) Var(b)``, of which the fraction
``1 / (1 + n)`` is the reference's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import scipy.sparse as sp

from rgbmidic.correlation.recovery import Recovery
from rgbmidic.errors import InputError
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray, IntArray

_LOW, _HIGH = 0.5, 2.0
"""Bounds of the eigenvalues of a TRI3 mass matrix over its diagonal, on any mesh (Wathen, IMA J Numer Anal 7, 1987)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NodalCovariance:
    """Correlation of the errors of one displacement component between the nodes of a mesh; u and v are not correlated.

    Attributes
    ----------
    mesh
        The mesh.
    correlation : csr_matrix, shape (N, N)
        1 on the diagonal.
    """

    mesh: Tri3Mesh
    correlation: sp.csr_matrix

    @classmethod
    def from_mesh(cls, mesh: Tri3Mesh) -> Self:
        """Propagate the covariance of the linear fit (inverse mass matrix) through the recovery of the nodal values.

        Parameters
        ----------
        mesh
            N nodes, E elements.

        Returns
        -------
        NodalCovariance
        """
        mass = mesh.mass_matrix
        scale = sp.diags(1 / np.sqrt(mass.diagonal()))
        inverse = scale @ _chebyshev_inverse(sp.csr_matrix(scale @ mass @ scale)) @ scale
        everywhere = np.ones(len(mesh.elements), dtype=bool)
        recovery = Recovery.over(mesh, everywhere, np.ones(len(mesh.nodes))).value
        whole = sp.csr_matrix(recovery @ inverse @ recovery.T)
        unit = sp.diags(1 / np.sqrt(whole.diagonal()))
        return cls(mesh=mesh, correlation=sp.csr_matrix(unit @ whole @ unit))

    def variance(self, weights: FloatArray, std: FloatArray) -> FloatArray:
        """Compute the variance of a weighted sum of nodal values.

        Parameters
        ----------
        weights : ndarray, shape (..., N)
            Of the nodes. Nodes of the weight 0 take no part, their uncertainty may be NaN.
        std : ndarray, shape (..., N)
            Standard uncertainty of the nodal values.

        Returns
        -------
        ndarray, shape (...)
        """
        parts = np.where(weights != 0, np.asarray(weights) * np.asarray(std), 0.0)
        flat = np.atleast_2d(parts.reshape(-1, parts.shape[-1]))
        total = np.einsum("fn,fn->f", flat @ self.correlation, flat)
        return np.asarray(np.maximum(total, 0)).reshape(parts.shape[:-1])

    def part(self, nodes: IntArray) -> FloatArray:
        """Extract the correlation (m, m) of some nodes, given by their indices (m,).

        Parameters
        ----------
        nodes : ndarray, shape (m,)
            Indices of the nodes.

        Returns
        -------
        ndarray, shape (m, m)
        """
        return np.asarray(self.correlation[nodes][:, nodes].toarray())


def _chebyshev_inverse(matrix: sp.csr_matrix, degree: int = 4) -> sp.csr_matrix:
    """Approximate the inverse of a matrix with eigenvalues in the bounds above by the best polynomial of a `degree`.

    Saad, Iterative methods for sparse linear systems, algorithm 12.1, on the unit matrix. Every such polynomial is
    positive within the bounds, so that no combination of nodes gets a negative variance. The degree is the number of
    edges from a node up to which the inverse is kept: what lies beyond 4 is .8 % or less.
    """
    middle, half = (_HIGH + _LOW) / 2, (_HIGH - _LOW) / 2
    residual: Any = sp.eye(matrix.shape[0], format="csr")
    step = residual / middle
    total, rho = step, half / middle
    for _ in range(degree):
        residual = residual - matrix @ step
        before, rho = rho, 1 / (2 * middle / half - rho)
        step = rho * before * step + (2 * rho / half) * residual
        total = total + step
    return sp.csr_matrix(total)


def reference_fraction(count: int) -> float:
    """Return the fraction of a frame's variance that comes from the mean of `count` reference frames, common to all.

    Parameters
    ----------
    count
        Number of reference frames.

    Returns
    -------
    float
    """
    return 1 / (1 + count)


def frame_covariance(std: FloatArray, common_fraction: float, references: Sequence[bool] | BoolArray) -> FloatArray:
    """Compute the covariance between frames of a quantity that is measured in each.

    Two frames have the reference's part in common, `common_fraction` of the smaller of their variances: where one of
    them is less certain, because it sees fewer lights or has changed more, the excess is independent (the covariance
    of an estimate with the best one is the variance of the best). A frame of the reference, whose own noise is a part
    of the mean that is subtracted, has nothing in common with the others: the only one is 0 without uncertainty, n of
    them are correlated by ``-1/(n - 1)``.

    Parameters
    ----------
    std : ndarray, shape (T, ...)
        Standard uncertainty in each frame.
    common_fraction
        See `reference_fraction`.
    references : (T,), bool
        Which of the frames belong to the reference.

    Returns
    -------
    ndarray, shape (T, T, ...)
    """
    variance, reference = np.asarray(std, dtype=np.float64) ** 2, np.asarray(references, dtype=bool)
    either, both = reference[:, None] | reference[None], reference[:, None] & reference[None]
    count = round(1 / common_fraction) - 1
    factor = np.where(both, -1 / max(count - 1, 1), np.where(either, 0.0, common_fraction))
    np.fill_diagonal(factor, 1.0)
    factor = factor.reshape(factor.shape + (1,) * (variance.ndim - 1))
    return np.asarray(factor * np.minimum(variance[:, None], variance[None]))


def difference_std(first: FloatArray, second: FloatArray, common_fraction: float) -> FloatArray:
    """Compute the standard uncertainty of a quantity's difference between two frames that are no reference.

    Parameters
    ----------
    first, second : ndarray
        Standard uncertainty in either frame.
    common_fraction
        See `reference_fraction`.

    Returns
    -------
    ndarray
    """
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    shared = common_fraction * np.minimum(first, second) ** 2
    return np.asarray(np.sqrt(first**2 + second**2 - 2 * shared))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidMotion:
    """Shift and rotation that fit a displacement field best, by least squares over its measured nodes.

    Attributes
    ----------
    centre : ndarray, shape (2,)
        Middle of the measured nodes on the reference, px: the shift is that of this point.
    shift, shift_std : ndarray, shape (2,)
        In px.
    rotation, rotation_std : float
        In rad, from x towards y.
    """

    centre: FloatArray
    shift: FloatArray
    shift_std: FloatArray
    rotation: float
    rotation_std: float

    @classmethod
    def of(
        cls, covariance: NodalCovariance, u: FloatArray, v: FloatArray, u_std: FloatArray, v_std: FloatArray
    ) -> Self:
        """Fit shift and rotation of any size (Kabsch, Acta Cryst A32, 1976).

        Parameters
        ----------
        covariance
            Of the mesh.
        u, v, u_std, v_std : ndarray, shape (N,)
            In px; NaN where not measured.

        Returns
        -------
        RigidMotion

        Raises
        ------
        InputError
            Fewer than two nodes are measured.
        """
        nodes, known = covariance.mesh.nodes, np.isfinite(u + v + u_std + v_std)
        if known.sum() < 2:
            raise InputError("a rigid motion needs two measured nodes or more")
        centre = nodes[known].mean(axis=0)
        arm, moved = nodes[known] - centre, np.stack([u, v], axis=1)[known]
        shift = moved.mean(axis=0)
        there = arm + moved - shift
        along, turned = (arm * there).sum(), (arm[:, 0] * there[:, 1] - arm[:, 1] * there[:, 0]).sum()
        even = known / known.sum()
        lever, angle = np.zeros((2, len(nodes))), float(np.arctan2(turned, along))
        # d(angle) = sum of (arm, turned along) x d(moved) / (arm . there)
        c, s = np.cos(angle), np.sin(angle)
        lever[:, known] = np.stack([-(s * arm[:, 0] + c * arm[:, 1]), c * arm[:, 0] - s * arm[:, 1]])
        lever /= np.hypot(along, turned)
        turning = covariance.variance(lever[0], u_std) + covariance.variance(lever[1], v_std)
        return cls(
            centre=centre,
            shift=shift,
            shift_std=np.sqrt(np.array([covariance.variance(even, part) for part in (u_std, v_std)])),
            rotation=angle,
            rotation_std=float(np.sqrt(turning)),
        )

    def removed(self, nodes: FloatArray, field: FloatArray) -> FloatArray:
        """Subtract the rigid motion from a displacement field: the field in axes that move with the body.

        The remaining displacements are rotated back, so that lengths and strains stay as they are.

        Parameters
        ----------
        nodes : ndarray, shape (N, 2)
            In px on the reference.
        field : ndarray, shape (4, N)
            u, v and their standard uncertainty, px. That of the rigid motion itself is not added: it is the less, the
            more nodes there are.

        Returns
        -------
        ndarray, shape (4, N)
            As `field`.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        back = np.array([[c, s], [-s, c]])
        arm = nodes - self.centre
        left = (arm + field[:2].T - self.shift) @ back.T - arm
        return np.concatenate([left.T, np.sqrt(back**2 @ field[2:] ** 2)])

    def at(self, points: FloatArray) -> FloatArray:
        """Compute the displacement (P, 2) in px of points (P, 2) by the rigid motion alone.

        Parameters
        ----------
        points : ndarray, shape (P, 2)
            Points (x, y) on the reference, px.

        Returns
        -------
        ndarray, shape (P, 2)
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.asarray((points - self.centre) @ (np.array([[c, -s], [s, c]]) - np.eye(2)).T + self.shift)
