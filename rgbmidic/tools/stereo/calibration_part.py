"""The uncertainty that the calibration of two cameras leaves in shape, displacement and strain.

A point X is where both cameras project it: with other parameters p of the cameras, the same four image coordinates are
those of ``X + dX``, ``dX = -G (dπ/dp) dp``, with the projection π and the derivative G of the point by its coordinates
(`Triangulation.gain`). What a calibration error leaves in a displacement is the difference of dX of both states: it is
zero where nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.mesh import Tri3Mesh
from rgbmidic.tools.stereo.axes import Axes, AxesChoice
from rgbmidic.tools.stereo.camera_pair import CameraPair
from rgbmidic.tools.stereo.triangulation import Triangulation, triangulate
from rgbmidic.typing import FloatArray

_SAMPLED = 200
"""Nodes over which the error of displacements is averaged."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationPart:
    """Errors that M independent errors of unit variance of the calibration make, to first order.

    Attributes
    ----------
    pair
        The cameras.
    errors : ndarray, shape (22, M)
        Of the parameters of the cameras; M is the rank of their covariance.
    rotation : ndarray, shape (3, 3)
        Of the axes.
    turn : ndarray, shape (3, 3, M)
        Of this rotation: the axes are laid through the surface, which has errors, too.
    shape : ndarray, shape (N, 3, M)
        Of the nodes on the undeformed surface, mm, in the axes.
    length_std : float
        Relative standard uncertainty of lengths on the surface.
    epipolar_std : float
        Standard uncertainty of the epipolar residual, px, rms over the nodes.
    """

    pair: CameraPair
    errors: FloatArray
    rotation: FloatArray
    turn: FloatArray
    shape: FloatArray
    length_std: float
    epipolar_std: float

    @classmethod
    def of(cls, pair: CameraPair, mesh: Tri3Mesh, surface: Triangulation, axes: AxesChoice) -> CalibrationPart:
        """Propagate the covariance of the cameras to a surface.

        Parameters
        ----------
        pair
            The cameras.
        mesh
            N nodes in px of the left frame.
        surface
            The nodes in space.
        axes
            As of `Axes.of`.

        Returns
        -------
        CalibrationPart
        """
        errors, points = pair.parameter_errors, surface.points
        slopes = pair.parameter_slopes(points) @ errors
        shift = -surface.gain @ slopes
        at_rest = Axes.of(axes, mesh, points)
        moved = [[Axes.of(axes, mesh, points + sign * step) for sign in (1, -1)] for step in np.moveaxis(shift, 2, 0)]
        turn, origin = (
            np.array([(getattr(plus, name) - getattr(minus, name)) / 2 for plus, minus in moved]).reshape(-1, *size)
            for name, size in (("rotation", (3, 3)), ("origin", (3,)))
        )
        turn, origin = np.moveaxis(turn, 0, 2), origin.T
        shape = np.einsum("ij,njm->nim", at_rest.rotation, shift - origin)
        shape += np.einsum("ijm,nj->nim", turn, points - at_rest.origin)
        centred = points - points.mean(axis=0)
        growth = np.einsum("nj,njm->m", centred, shift) / (centred**2).sum()
        epipolar = np.einsum("ni,nim->nm", surface.epipolar, slopes)
        return cls(
            pair=pair,
            errors=errors,
            rotation=at_rest.rotation,
            turn=turn,
            shape=shape,
            length_std=float(np.linalg.norm(growth)),
            epipolar_std=float(np.sqrt((epipolar**2).sum(axis=1).mean())),
        )

    def displacement(self, reference: Triangulation, deformed: Triangulation) -> FloatArray:
        """Return the errors (N, 3, M) of displacements, mm, in the axes.

        Parameters
        ----------
        reference, deformed
            The nodes in both states, triangulated with the same weights.

        Returns
        -------
        ndarray, shape (N, 3, M)
        """
        before, after = (
            -state.gain @ (self.pair.parameter_slopes(state.points) @ self.errors) for state in (reference, deformed)
        )
        turned = np.einsum("ijm,nj->nim", self.turn, deformed.points - reference.points)
        return np.asarray(np.einsum("ij,njm->nim", self.rotation, after - before) + turned)

    def mean_gain(self, points: FloatArray) -> FloatArray:
        """Return the errors (3, 3, M) of a displacement along the first index per mm along the second, over the nodes.

        It is smooth over the frame, by lens and pose, so that their mean serves for any place.

        Parameters
        ----------
        points : ndarray, shape (N, 3)
            Nodes, mm, left camera's axes.

        Returns
        -------
        ndarray, shape (3, 3, M)
        """
        sampled = points[:: len(points) // _SAMPLED + 1]
        length = 0.1 * float(np.linalg.norm(np.ptp(points, axis=0)))  # any that is short against the distance
        weights = np.eye(4)[None].repeat(len(sampled), axis=0)
        steps = [np.zeros(3), *(length * self.rotation)]
        rest, *moved = (triangulate(self.pair, *self.pair.project(sampled + step), weights) for step in steps)
        return np.stack([self.displacement(rest, state).mean(axis=0) / length for state in moved], axis=1)


def covariance_of(errors: FloatArray) -> FloatArray:
    """Return the covariance (N, 3, 3) that errors (N, 3, M) of unit variance make.

    Parameters
    ----------
    errors : ndarray, shape (N, 3, M)
        Independent ones.

    Returns
    -------
    ndarray, shape (N, 3, 3)
    """
    return np.asarray(errors @ errors.transpose(0, 2, 1))
