"""Surface strain and attitude in space: virtual strain gauges on the undeformed and on the deformed surface.

A gauge fits planes to the three coordinates of its nodes over the left frame (`rgbmidic.fields.StrainGauges`), whose
slopes are the tangents of the surface (`rgbmidic.fields.tangent_plane`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.field import Displacement
from rgbmidic.fields import CalibrationErrors, NodalCovariance, Strain, StrainGauges
from rgbmidic.fields.strain import length_of
from rgbmidic.fields.tangent_plane import measured_slopes, normals, tangent_axes
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceStrain:
    """Strain and attitude of a surface at G gauges; NaN where not measured.

    Attributes
    ----------
    strain
        In the tangent plane of the undeformed surface: its first axis is the projection of x, the second one that of y
        made normal to it.
    normal : ndarray, shape (G, 3)
        Unit normal of the deformed surface, with a positive component along z.
    tilt, tilt_std : ndarray, shape (G,)
        Angle between the normals of the undeformed and of the deformed surface, and its standard uncertainty, degrees.
    """

    strain: Strain
    normal: FloatArray
    tilt: FloatArray
    tilt_std: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceGauges:
    """Virtual strain gauges around the nodes of a surface.

    Attributes
    ----------
    gauges
        On the mesh in px of the left frame, with the undeformed surface in space and the calibration's errors.
    measure
        Strain measure, as of `rgbmidic.fields.strain_of`.
    """

    gauges: StrainGauges
    measure: str = "green-lagrange"

    @classmethod
    def around_nodes(
        cls,
        mesh: Tri3Mesh,
        points: FloatArray,
        calibration: CalibrationErrors | None = None,
        length: float | None = None,
        measure: str = "green-lagrange",
    ) -> SurfaceGauges:
        """Lay a gauge around every node; errors as `rgbmidic.fields.strain_of`.

        Parameters
        ----------
        mesh
            The N nodes in px of the left frame.
        points : ndarray, shape (N, 3)
            The undeformed surface at the nodes, mm, in the axes of the result.
        calibration
            Errors that the calibration makes at the nodes; None: the cameras are exact.
        length
            Length of the gauges in px of the left frame; None: the shortest, three elements.
        measure
            Strain measure.

        Returns
        -------
        SurfaceGauges
        """
        covariance = replace(NodalCovariance.from_mesh(mesh), surface=points, calibration=calibration)
        return cls(gauges=StrainGauges.at_nodes(covariance, length), measure=measure)

    def strain(self, displacement: FloatArray, covariance: FloatArray) -> SurfaceStrain:
        """Compute strain and attitude of the deformed surface.

        Parameters
        ----------
        displacement : ndarray, shape (N, 3)
            mm; NaN where a node has no data.
        covariance : ndarray, shape (N, 3, 3)
            Of the displacement by the match, mm^2; nodes are independent. The match's error of the undeformed shape
            changes strain by its relative error, which is left out.

        Returns
        -------
        SurfaceStrain
        """
        std = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0))
        field = Displacement(
            unit="mm",
            dims=("component", "node"),
            values=displacement.T,
            std=std.T,
            covariance=np.moveaxis(covariance, 0, 2),
        )
        slopes, of_slopes = self.gauges.slopes_of(field)
        tangents = self.gauges.tangents(field.is_measured)
        strain = self.gauges.strain(field, self.measure)
        tangents, slopes, valid = measured_slopes(tangents, slopes)
        axes, normal = tangent_axes(tangents), normals(tangents + slopes)
        # to first order the normal turns by the slopes along it
        to_axes = np.linalg.inv(axes.transpose(0, 2, 1) @ tangents)
        change = np.einsum("gi,gdf->gfid", normal, to_axes).reshape(-1, 2, 6)
        of_tilt = change @ np.where(valid[:, None, None], of_slopes, 0) @ change.transpose(0, 2, 1)
        leaning = _leaning(tangents, slopes)
        errors = zip(*map(np.nan_to_num, self.gauges.slope_errors(field)), strict=True)
        changed = [_leaning(tangents + of_surface, slopes + of_motion) - leaning for of_surface, of_motion in errors]
        of_tilt += np.einsum("mga,mgb->gab", *[np.reshape(changed, (-1, *leaning.shape))] * 2)
        sine, sine_std = length_of(leaning, of_tilt)
        arrays = np.degrees(np.arcsin(np.minimum(sine, 1))), np.degrees(sine_std)
        normal[~valid] = np.nan
        tilt, tilt_std = (np.where(valid, array, np.nan) for array in arrays)
        return SurfaceStrain(strain=strain, normal=normal, tilt=tilt, tilt_std=tilt_std)


def _leaning(tangents: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return the components (G, 2) of the deformed normal along the axes of the undeformed tangent plane."""
    return np.asarray(np.einsum("gi,gia->ga", normals(tangents + slopes), tangent_axes(tangents)))
