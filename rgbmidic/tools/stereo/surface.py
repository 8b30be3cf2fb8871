"""Surface strain in space: tangents of the undeformed and of the deformed surface over virtual strain gauges.

A gauge fits planes to the three coordinates of its nodes over the left frame (`rgbmidic.fields.StrainGauges`): the
columns of A (3, 2) are the tangents of the undeformed surface, those of B of the deformed one. With the orthonormal
axes T (3, 2) of the undeformed tangent plane and ``M = (T^T A)^-1`` the deformation gradient of the surface is
``F = B M`` (3, 2), and ``E = (F^T F - I) / 2`` its Green-Lagrange strain in these axes. Turned into the deformed
tangent plane by the polar decomposition ``F = Q U``, ``Q^T F`` is a gradient in the plane, of which
`rgbmidic.fields.strain_of_gradient` takes strain and uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rgbmidic.fields import NodalCovariance, Strain, StrainGauges, strain_of_gradient
from rgbmidic.fields.strain import length_of
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
        On the mesh in px of the left frame.
    points : ndarray, shape (N, 3)
        The undeformed surface at the nodes, mm.
    measure
        Strain measure, as of `rgbmidic.fields.strain_of`.
    """

    gauges: StrainGauges
    points: FloatArray
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
        gauges = StrainGauges.at_nodes(NodalCovariance.from_mesh(mesh), length)
        return cls(gauges=gauges, points=points, measure=measure)

    def strain(self, displacement: FloatArray, covariance: FloatArray) -> SurfaceStrain:
        """Compute strain and attitude of the deformed surface.

        Parameters
        ----------
        displacement : ndarray, shape (N, 3)
            mm; NaN where a node has no data.
        covariance : ndarray, shape (N, 3, 3)
            Of the displacement, mm^2. The uncertainty of the undeformed shape changes strain by its relative error,
            which is left out.

        Returns
        -------
        SurfaceStrain
        """
        gauges = self.gauges
        measured = np.asarray(np.isfinite(displacement).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
        weights = gauges.weights(measured)
        fields = np.where(measured[:, None], displacement, 0.0)
        spread = np.where(measured[:, None, None], covariance, 0.0)

        def total(values: FloatArray) -> FloatArray:
            return np.asarray(np.add.reduceat(values, gauges.starts[:-1], axis=0))

        tangents, slopes = (  # (G, 3, 2)
            total(weights.T[:, None] * nodal[gauges.nodes][..., None]) for nodal in (self.points, fields)
        )
        products = weights[[0, 0, 1, 1]] * weights[[0, 1, 0, 1]]
        inflation = gauges.inflation[:, [0, 2, 2, 1]]
        sums = total(products.T[..., None, None] * spread[gauges.nodes][:, None]) * inflation[..., None, None]
        # (G, 2, 2, 3, 3) -> of slopes row by row: (G, 3, 2, 3, 2)
        of_slopes = sums.reshape(-1, 2, 2, 3, 3).transpose(0, 3, 1, 4, 2)

        return surface_strain(tangents, slopes, of_slopes, self.measure)


def surface_strain(tangents: FloatArray, slopes: FloatArray, covariance: FloatArray, measure: str) -> SurfaceStrain:
    """Compute the strain of surfaces with these tangents.

    Parameters
    ----------
    tangents, slopes : ndarray, shape (G, 3, 2)
        Derivatives of the undeformed surface and of the displacement along two directions of the left frame.
    covariance : ndarray, shape (G, 3, 2, 3, 2)
        Of the slopes.
    measure
        Strain measure.

    Returns
    -------
    SurfaceStrain
    """
    valid = np.asarray(np.isfinite(slopes + tangents).all(axis=(1, 2)))
    flat = np.eye(3)[:, :2]
    tangents, slopes = (np.where(valid[:, None, None], array, flat) for array in (tangents, slopes))
    deformed = tangents + slopes
    axes = _tangent_axes(tangents)
    to_axes = np.linalg.inv(axes.transpose(0, 2, 1) @ tangents)
    gradient = deformed @ to_axes
    left_vectors, _, right_vectors = np.linalg.svd(gradient, full_matrices=False)
    turn = (left_vectors @ right_vectors).transpose(0, 2, 1)  # Q^T
    spread = np.einsum("gdb,gidje,gef->gibjf", to_axes, covariance, to_axes, optimize=True)
    spread_in_plane = np.einsum("gai,gibjf,gcj->gabcf", turn, spread, turn, optimize=True)
    in_plane = turn @ gradient - np.eye(2)
    normal = np.cross(deformed[:, :, 0], deformed[:, :, 1])
    normal *= (np.where(normal[:, 2] < 0, -1, 1) / np.linalg.norm(normal, axis=1))[:, None]
    # to first order the normal turns by the slopes along it
    of_tilt = np.einsum("gi,gibjf,gj->gbf", normal, spread, normal)
    sine, sine_std = length_of(np.einsum("gi,gia->ga", normal, axes), of_tilt)
    tilt = np.arcsin(np.minimum(sine, 1))
    for array in (in_plane, spread_in_plane, normal, tilt):
        array[~valid] = np.nan
    return SurfaceStrain(
        strain=strain_of_gradient(in_plane, spread_in_plane.reshape(-1, 4, 4), measure),
        normal=normal,
        tilt=np.degrees(tilt),
        tilt_std=np.degrees(np.where(valid, sine_std, np.nan)),
    )


def _tangent_axes(tangents: FloatArray) -> FloatArray:
    """Return orthonormal axes (G, 3, 2) of tangent planes: x projected onto each, and the normal to it in the plane."""
    basis, _ = np.linalg.qr(tangents)
    along = np.einsum("gia,ga->gi", basis, basis[:, 0])  # x projected
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= np.where(normal[:, 2:] < 0, -1, 1)
    return np.stack([along, np.cross(normal, along)], axis=2)
