"""The motion of a body as a whole: what is left when it is taken off is deformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from rgbmidic.errors import InputError
from rgbmidic.fields.covariance import NodalCovariance
from rgbmidic.typing import FloatArray

__all__ = ["RigidMotion"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RigidMotion:
    """Shift and rotation that come nearest to a displacement field, over its measured nodes.

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
        """Least squares over the measured nodes, for a rotation of any size (Kabsch, Acta Cryst A32, 1976).

        Parameters
        ----------
        covariance
            Of the mesh.
        u, v, u_std, v_std : ndarray, shape (N,)
            In px; NaN where not measured.

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
        lever = np.zeros((2, len(nodes)))
        angle = float(np.arctan2(turned, along))
        # d(angle) = sum of (arm, turned along) x d(moved) / (arm . there)
        c, s = np.cos(angle), np.sin(angle)
        lever[:, known] = np.stack([-(s * arm[:, 0] + c * arm[:, 1]), c * arm[:, 0] - s * arm[:, 1]]) / np.hypot(
            along, turned
        )
        variance = [covariance.variance(even, part) for part in (u_std, v_std)]
        turning = covariance.variance(lever[0], u_std) + covariance.variance(lever[1], v_std)
        return cls(
            centre=centre,
            shift=shift,
            shift_std=np.sqrt(np.array(variance)),
            rotation=angle,
            rotation_std=float(np.sqrt(turning)),
        )

    def removed(self, nodes: FloatArray, field: FloatArray) -> FloatArray:
        """A displacement field as one sees it who moves with the body.

        What is left of the displacements is turned back by the rotation, so that lengths and strains stay as they are.

        Parameters
        ----------
        nodes : ndarray, shape (N, 2)
            In px on the reference.
        field : ndarray, shape (4, N)
            u, v and their standard uncertainty, px. That of the rigid motion itself is not added: it is the less, the
            more nodes there are.
        """
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        back = np.array([[c, s], [-s, c]])
        arm = nodes - self.centre
        left = (arm + field[:2].T - self.shift) @ back.T - arm
        return np.concatenate([left.T, np.sqrt(back**2 @ field[2:] ** 2)])

    def at(self, points: FloatArray) -> FloatArray:
        """Displacement (P, 2) in px of points (P, 2) by the rigid motion alone."""
        c, s = np.cos(self.rotation), np.sin(self.rotation)
        return np.asarray((points - self.centre) @ (np.array([[c, -s], [s, c]]) - np.eye(2)).T + self.shift)
