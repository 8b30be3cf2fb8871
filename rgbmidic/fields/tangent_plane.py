"""The deformation of a surface in space in its tangent plane.

The columns of A (3, 2) are the tangents of the undeformed surface along two directions, those of B of the deformed one.
With the orthonormal axes T (3, 2) of the undeformed tangent plane and ``M = (T^T A)^-1`` the deformation gradient of
the surface is ``F = B M`` (3, 2), and ``E = (F^T F - I) / 2`` its Green-Lagrange strain in these axes. Turned into the
deformed tangent plane by the polar decomposition ``F = Q U``, ``Q^T F = U`` is a gradient in the plane.
"""

from __future__ import annotations

import numpy as np

from rgbmidic.typing import BoolArray, FloatArray


def in_tangent_plane(tangents: FloatArray, slopes: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Turn the slopes of a displacement in space into a displacement gradient in the tangent plane.

    Parameters
    ----------
    tangents, slopes : ndarray, shape (G, 3, 2)
        Derivatives of the undeformed surface and of the displacement along two directions; NaN where not measured.
    covariance : ndarray, shape (G, 6, 6)
        Of the slopes row by row. The uncertainty of the undeformed shape changes strain by its relative error, which is
        left out.

    Returns
    -------
    gradient : ndarray, shape (G, 2, 2)
        Symmetric, in the tangent plane of the undeformed surface: its first axis is the projection of x, the second one
        that of y made normal to it.
    covariance : ndarray, shape (G, 4, 4)
        Of the gradient row by row.

    Examples
    --------
    >>> flat = np.eye(3)[None, :, :2]  # the plane z = 0, turned about x by a right angle
    >>> turned = np.array([[[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]])
    >>> bool(np.allclose(in_tangent_plane(flat, turned - flat, np.zeros((1, 6, 6)))[0], 0))
    True
    """
    tangents, slopes, valid = measured_slopes(tangents, slopes)
    gradient, turn, to_axes = _deformation(tangents, slopes)
    change = np.einsum("gai,gef->gafie", turn, to_axes).reshape(-1, 4, 6)
    in_plane, spread = turn @ gradient - np.eye(2), change @ covariance @ change.transpose(0, 2, 1)
    in_plane[~valid], spread[~valid] = np.nan, np.nan
    return in_plane, spread


def gradient_errors(
    tangents: FloatArray, slopes: FloatArray, tangent_errors: FloatArray, slope_errors: FloatArray
) -> FloatArray:
    """Return what errors of the undeformed surface and of the displacement make of the gradient in the tangent plane.

    With errors dA and dB of the tangents ``dF = dB M + B dM`` and ``dM = -M (T^T dA) M``.

    Parameters
    ----------
    tangents, slopes : ndarray, shape (G, 3, 2)
        As of `in_tangent_plane`.
    tangent_errors, slope_errors : ndarray, shape (M, G, 3, 2)
        Of them, by each of M causes.

    Returns
    -------
    ndarray, shape (M, G, 4)
        Of the gradient row by row.
    """
    tangents, slopes, _ = measured_slopes(tangents, slopes)
    gradient, turn, to_axes = _deformation(tangents, slopes)
    across = tangent_axes(tangents).transpose(0, 2, 1) @ tangent_errors
    errors = turn @ ((tangent_errors + slope_errors - gradient @ across) @ to_axes)
    return np.asarray(errors.reshape(*errors.shape[:2], 4))


def _deformation(tangents: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the deformation gradient F (G, 3, 2), the turn Q^T into its tangent plane (G, 2, 3), and M (G, 2, 2)."""
    to_axes = np.linalg.inv(tangent_axes(tangents).transpose(0, 2, 1) @ tangents)
    gradient: FloatArray = np.asarray((tangents + slopes) @ to_axes)
    left_vectors, _, right_vectors = np.linalg.svd(gradient, full_matrices=False)
    return gradient, np.asarray(left_vectors @ right_vectors).transpose(0, 2, 1), np.asarray(to_axes, dtype=np.float64)


def measured_slopes(tangents: FloatArray, slopes: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Return tangents and slopes (G, 3, 2), those of a flat surface at rest where not measured, and where they are."""
    valid = np.asarray(np.isfinite(slopes + tangents).all(axis=(1, 2)))
    flat, rest = np.eye(3)[:, :2], np.zeros((3, 2))
    return np.where(valid[:, None, None], tangents, flat), np.where(valid[:, None, None], slopes, rest), valid


def tangent_axes(tangents: FloatArray) -> FloatArray:
    """Return orthonormal axes (G, 3, 2) of tangent planes: x projected onto each, and the normal to it in the plane."""
    basis, _ = np.linalg.qr(tangents)
    along = np.einsum("gia,ga->gi", basis, basis[:, 0])  # x projected
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    normal = normals(tangents)
    return np.stack([along, np.cross(normal, along)], axis=2)


def normals(tangents: FloatArray) -> FloatArray:
    """Return unit normals (G, 3) of tangent planes, with a positive component along z."""
    normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
    return np.asarray(normal * (np.where(normal[:, 2] < 0, -1, 1) / np.linalg.norm(normal, axis=1))[:, None])
