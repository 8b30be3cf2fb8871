"""The uncertainty that the calibration of two cameras leaves in shape and displacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.mesh import Tri3Mesh
from rgbmidic.tools.stereo.axes import Axes, AxesChoice
from rgbmidic.tools.stereo.camera_pair import CameraPair
from rgbmidic.tools.stereo.triangulation import Triangulation, triangulate
from rgbmidic.typing import FloatArray

_SAMPLED = 200
"""Nodes over which the error of displacements is averaged: it is smooth over the frame (lens and pose)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CalibrationPart:
    """Errors that 22 independent errors of unit variance of the calibration make, to first order.

    Attributes
    ----------
    shape : ndarray, shape (N, 3, 22)
        Of the nodes on the undeformed surface, mm, in axes that are laid through the surface anew.
    gain : ndarray, shape (3, 3, 22)
        ``gain[i, j]``: of a displacement along i, per mm of displacement along j; the mean over the nodes.
    length_std : float
        Relative standard uncertainty of lengths on the surface.
    epipolar_std : float
        Standard uncertainty of the epipolar residual, px, rms over the nodes.
    """

    shape: FloatArray
    gain: FloatArray
    length_std: float
    epipolar_std: float

    @classmethod
    def of(
        cls, pair: CameraPair, mesh: Tri3Mesh, surface: Triangulation, spread: FloatArray, axes: AxesChoice
    ) -> CalibrationPart:
        """Propagate the covariance of the cameras to a surface.

        Parameters
        ----------
        pair
            The cameras.
        mesh
            N nodes in px of the left frame.
        surface
            The nodes in space.
        spread : ndarray, shape (N, 4, 4)
            Covariance of their coordinates in both frames, of which the weights follow.
        axes
            As of `Axes.of`.

        Returns
        -------
        CalibrationPart
        """
        nodes, count = pair.project(surface.points), len(mesh.nodes)
        sampled = slice(None, None, count // _SAMPLED + 1)
        rotation = Axes.of(axes, mesh, surface.points).rotation
        length = 0.1 * float(np.linalg.norm(np.ptp(surface.points, axis=0)))  # any that is short against the distance
        steps = [pair.project(surface.points[sampled] + length * direction) for direction in rotation]

        def quantities(perturbed: CameraPair) -> FloatArray:
            """Return nodes (3 N,), displacements (9,), the logarithm of the extent, and epipolar residuals."""
            perturbed_surface = triangulate(perturbed, *nodes, spread)
            turned = Axes.of(axes, mesh, perturbed_surface.points)
            extent = np.linalg.norm(perturbed_surface.points - perturbed_surface.points.mean(axis=0))
            motions = [
                (
                    (triangulate(perturbed, *pixels, spread[sampled]).points - perturbed_surface.points[sampled])
                    @ turned.rotation.T
                )
                for pixels in steps
            ]
            gain = np.stack([displacement.mean(axis=0) / length for displacement in motions], axis=1)
            return np.concatenate(
                [
                    turned.points(perturbed_surface.points).ravel(),
                    gain.ravel(),
                    [np.log(extent)],
                    perturbed_surface.residual,
                ]
            )

        errors = pair.sensitivity(quantities)
        return cls(
            shape=errors[: 3 * count].reshape(count, 3, -1),
            gain=errors[3 * count : 3 * count + 9].reshape(3, 3, -1),
            length_std=float(np.linalg.norm(errors[3 * count + 9])),
            epipolar_std=float(np.sqrt((errors[3 * count + 10 :] ** 2).sum(axis=1).mean())),
        )

    @property
    def shape_covariance(self) -> FloatArray:
        """Covariance (N, 3, 3) of each node of the surface, mm^2."""
        return np.asarray(self.shape @ self.shape.transpose(0, 2, 1))

    def displacement_covariance(self, displacement: FloatArray) -> FloatArray:
        """Return the covariance (N, 3, 3) of displacements (N, 3), mm^2.

        Parameters
        ----------
        displacement : ndarray, shape (N, 3)
            mm, in the axes of the result.

        Returns
        -------
        ndarray, shape (N, 3, 3)
        """
        errors = np.einsum("ijk,nj->nik", self.gain, displacement)
        return np.asarray(errors @ errors.transpose(0, 2, 1))
