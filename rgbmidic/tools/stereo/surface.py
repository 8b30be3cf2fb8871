"""Attitude of a surface in space: how virtual strain gauges on it lean.

A gauge fits planes to the three coordinates of its nodes over the left frame (`rgbmidic.fields.StrainGauges`), whose
slopes are the tangents of the surface (`rgbmidic.fields.tangent_plane`).
"""

from __future__ import annotations

import numpy as np

from rgbmidic.field import Displacement, Field
from rgbmidic.fields import StrainGauges
from rgbmidic.fields.strain import length_of
from rgbmidic.fields.tangent_plane import measured_slopes, normals, tangent_axes
from rgbmidic.typing import FloatArray


def displacement_in_space(values: FloatArray, covariance: FloatArray, bias: FloatArray | None = None) -> Displacement:
    """Return the displacement of nodes in mm, with the covariance of their errors.

    Parameters
    ----------
    values : ndarray, shape (3, N)
        mm; NaN where a node has no data.
    covariance : ndarray, shape (3, 3, N)
        mm^2.
    bias : ndarray, shape (3, N), optional
        See `Field`.

    Returns
    -------
    Displacement
    """
    std = np.sqrt(np.maximum(np.einsum("iin->in", covariance), 0))
    shared = None if bias is None else np.minimum(bias, std)
    dims = ("component", "node")
    return Displacement(unit="mm", dims=dims, values=values, std=std, bias=shared, covariance=covariance)


def attitude(gauges: StrainGauges, displacement: Displacement) -> tuple[FloatArray, Field]:
    """Compute how the deformed surface lies in space.

    Parameters
    ----------
    gauges
        G gauges on the undeformed surface in space.
    displacement
        Of the N nodes, in space.

    Returns
    -------
    normal : ndarray, shape (G, 3)
        Unit normal of the deformed surface, with a positive component along z; NaN where not measured.
    tilt : Field
        Angle between the normals of the undeformed and of the deformed surface, degrees, shape (G,).
    """
    slopes, of_slopes = gauges.slopes_of(displacement)
    tangents, slopes, valid = measured_slopes(gauges.tangents(displacement.is_measured), slopes)
    axes, normal = tangent_axes(tangents), normals(tangents + slopes)
    # to first order the normal turns by the slopes along it
    to_axes = np.linalg.inv(axes.transpose(0, 2, 1) @ tangents)
    change = np.einsum("gi,gdf->gfid", normal, to_axes).reshape(-1, 2, 6)
    of_tilt = change @ np.where(valid[:, None, None], of_slopes, 0) @ change.transpose(0, 2, 1)
    leaning = _leaning(tangents, slopes)
    errors = zip(*map(np.nan_to_num, gauges.slope_errors(displacement)), strict=True)
    changed = [_leaning(tangents + of_surface, slopes + of_motion) - leaning for of_surface, of_motion in errors]
    of_tilt += np.einsum("mga,mgb->gab", *[np.reshape(changed, (-1, *leaning.shape))] * 2)
    sine, sine_std = length_of(leaning, of_tilt)
    normal[~valid], sine[~valid], sine_std[~valid] = np.nan, np.nan, np.nan
    tilt = np.degrees(np.arcsin(np.minimum(sine, 1)))
    return normal, Field(name="tilt", unit="degree", dims=("node",), values=tilt, std=np.degrees(sine_std))


def _leaning(tangents: FloatArray, slopes: FloatArray) -> FloatArray:
    """Return the components (G, 2) of the deformed normal along the axes of the undeformed tangent plane."""
    return np.asarray(np.einsum("gi,gia->ga", normals(tangents + slopes), tangent_axes(tangents)))
