"""Surface strain and attitude in space: virtual strain gauges on the undeformed and on the deformed surface.

A gauge fits planes to the three coordinates of its nodes over the left frame (`rgbmidic.fields.StrainGauges`), whose
slopes are the tangents of the surface (`rgbmidic.fields.tangent_plane`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rgbmidic.field import Displacement
from rgbmidic.fields import NodalCovariance, Strain, StrainGauges, strain_of_gradient
from rgbmidic.fields.strain import length_of
from rgbmidic.fields.tangent_plane import gradient_errors, in_tangent_plane, measured_slopes, normals, tangent_axes
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
        On the mesh in px of the left frame, with the undeformed surface in space.
    measure
        Strain measure, as of `rgbmidic.fields.strain_of`.
    """

    gauges: StrainGauges
    measure: str = "green-lagrange"

    @classmethod
    def around_nodes(
        cls, mesh: Tri3Mesh, points: FloatArray, length: float | None = None, measure: str = "green-lagrange"
    ) -> SurfaceGauges:
        """Lay a gauge around every node; errors as `rgbmidic.fields.strain_of`.

        Parameters
        ----------
        mesh
            The N nodes in px of the left frame.
        points : ndarray, shape (N, 3)
            The undeformed surface at the nodes, mm, in the axes of the result.
        length
            Length of the gauges in px of the left frame; None: the shortest, three elements.
        measure
            Strain measure.

        Returns
        -------
        SurfaceGauges
        """
        covariance = replace(NodalCovariance.from_mesh(mesh), surface=points)
        return cls(gauges=StrainGauges.at_nodes(covariance, length), measure=measure)

    def strain(
        self, displacement: FloatArray, covariance: FloatArray, errors: tuple[FloatArray, FloatArray] | None = None
    ) -> SurfaceStrain:
        """Compute strain and attitude of the deformed surface.

        Parameters
        ----------
        displacement : ndarray, shape (N, 3)
            mm; NaN where a node has no data.
        covariance : ndarray, shape (N, 3, 3)
            Of the displacement by the match, mm^2; nodes are independent. The match's error of the undeformed shape
            changes strain by its relative error, which is left out.
        errors : two of ndarray, shape (N, 3, M), optional
            Errors of the undeformed surface and of the displacement that M independent errors of unit variance of the
            calibration make, mm: all nodes have them together. None: the cameras are exact.

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
        gradient, spread = in_tangent_plane(tangents, slopes, of_slopes)
        if errors is not None:
            of_shape, of_displacement = (np.moveaxis(self.gauges.fit(one, field.is_measured), 2, 0) for one in errors)
            of_gradient = gradient_errors(tangents, slopes, of_shape, of_displacement)
            spread = spread + np.einsum("mgi,mgj->gij", of_gradient, of_gradient)
        strain = strain_of_gradient(gradient, spread, self.measure)
        tangents, slopes, valid = measured_slopes(tangents, slopes)
        axes, normal = tangent_axes(tangents), normals(tangents + slopes)
        # to first order the normal turns by the slopes along it
        to_axes = np.linalg.inv(axes.transpose(0, 2, 1) @ tangents)
        change = np.einsum("gi,gdf->gfid", normal, to_axes).reshape(-1, 2, 6)
        of_tilt = change @ np.where(valid[:, None, None], of_slopes, 0) @ change.transpose(0, 2, 1)
        sine, sine_std = length_of(np.einsum("gi,gia->ga", normal, axes), of_tilt)
        arrays = np.degrees(np.arcsin(np.minimum(sine, 1))), np.degrees(sine_std)
        normal[~valid] = np.nan
        tilt, tilt_std = (np.where(valid, array, np.nan) for array in arrays)
        return SurfaceStrain(strain=strain, normal=normal, tilt=tilt, tilt_std=tilt_std)
