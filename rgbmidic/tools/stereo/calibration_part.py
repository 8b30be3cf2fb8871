"""The uncertainty that the calibration of two cameras leaves in shape, displacement and strain.

A point X is where both cameras project it: with other parameters p of the cameras, the same four image coordinates are
those of ``X + dX``, ``dX = -G (dπ/dp) dp``, with the projection π and the derivative G of the point by its coordinates
(`Triangulation.gain`). What a calibration error leaves in a displacement u is the difference of dX of both states,
``(∂dX/∂X) u`` to first order: it is zero where nothing moves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.fields import CalibrationErrors
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.tools.stereo.axes import Axes, AxesChoice
from rgbmidic.tools.stereo.camera_pair import CameraPair
from rgbmidic.tools.stereo.triangulation import Triangulation, triangulate

_STEP = 1e-3
"""Step of the derivative of dX over the extent of the surface (dX is smooth over the frame, by lens and pose)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationPart:
    """Errors that M independent errors of unit variance of the calibration make, to first order.

    Attributes
    ----------
    errors
        Of the nodes on the undeformed surface, and of their displacement over the displacement, in the axes, mm; M is
        the rank of the covariance of the cameras.
    length_std : float
        Relative standard uncertainty of lengths on the surface.
    epipolar_std : float
        Standard uncertainty of the epipolar residual, px, rms over the nodes.
    """

    errors: CalibrationErrors
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
        # the axes are laid through the surface, which has errors, too
        moved = [[Axes.of(axes, mesh, points + sign * step) for sign in (1, -1)] for step in np.moveaxis(shift, 2, 0)]
        turn, origin = (
            np.array([(getattr(plus, name) - getattr(minus, name)) / 2 for plus, minus in moved]).reshape(-1, *size)
            for name, size in (("rotation", (3, 3)), ("origin", (3,)))
        )
        shape = np.einsum("ij,njm->min", at_rest.rotation, shift - origin.T)
        shape += np.einsum("mij,nj->min", turn, points - at_rest.origin)
        step, weights = (
            _STEP * float(np.linalg.norm(np.ptp(points, axis=0))),
            np.eye(4)[None].repeat(len(points), axis=0),
        )
        before, *after = (
            -triangulate(pair, *pair.project(places), weights).gain @ (pair.parameter_slopes(places) @ errors)
            for places in (points, *(points + step * axis for axis in at_rest.rotation))
        )
        gain = np.stack([np.einsum("ij,njm->min", at_rest.rotation, (one - before) / step) for one in after], axis=2)
        gain += (turn @ at_rest.rotation.T)[..., None]
        centred = points - points.mean(axis=0)
        growth = np.einsum("nj,njm->m", centred, shift) / (centred**2).sum()
        epipolar = np.einsum("ni,nim->nm", surface.epipolar, slopes)
        return cls(
            errors=CalibrationErrors(surface=shape, gain=gain),
            length_std=float(np.linalg.norm(growth)),
            epipolar_std=float(np.sqrt((epipolar**2).sum(axis=1).mean())),
        )
