"""What linear elements cannot follow: the nodal values corrected for the curvature of the field.

A least-squares fit of linear elements to a curved field passes above and below it: its nodes are off by about
``h^2/12`` times the second derivative (on a sphere turned by 8 degrees 0.02 px with 25 px elements, several times the
noise). The second derivatives are recovered from the solution; the deviation of the curved field from its linear
interpolant is projected like any other residual and taken off the nodal values, which then are those of the curved
field; between the nodes that field is not linear any more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from rgbmidic._kernels.correlation import curvature_deviation, element_vector, interpolate_nodal
from rgbmidic.correlation.equations import Equations
from rgbmidic.correlation.reference import Reference
from rgbmidic.mesh import Tri3Mesh
from rgbmidic.typing import BoolArray, FloatArray, FloatImage

__all__ = ["CurvatureOffset", "curvature_offset"]


_FARTHEST = 3.5
"""Sides of an element over which a curvature is carried to nodes that do not know it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvatureOffset:
    """What linear elements make of a curved field.

    Attributes
    ----------
    displacement : ndarray, shape (N, 2)
        Offset of the nodal displacement in px.
    one_sided : ndarray, shape (N, 3)
        Offset of the nodal strain exx, eyy, exy where the elements around a node do not surround it evenly: at an edge
        their mean slope is that of a point half an element inside.
    strain : ndarray, shape (N, 3)
        Offset of the nodal strain for both reasons.
    deviation : ndarray, shape (2, P), float32
        What the curved field has over the linear one at the owned pixels, px.
    """

    displacement: FloatArray
    one_sided: FloatArray
    strain: FloatArray
    deviation: FloatImage


def curvature_offset(
    reference: Reference, equations: Equations, displacement: FloatArray, sound: BoolArray
) -> CurvatureOffset:
    """Offsets of nodal displacement and strain; 0 where no curvature is known within a few elements.

    Parameters
    ----------
    reference
        The reference state.
    equations
        Of the last pass, with its weights and factors.
    displacement : ndarray, shape (N, 2)
        The solution, finite everywhere.
    sound : ndarray, shape (N,), bool
        Nodes whose displacement tells a curvature: seen, and not beside elements that do not match.
    """
    curvature = _curvature(reference, displacement, sound)
    mesh, pixels = reference.mesh, reference.pixels
    geometry = pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric
    deviation, carried = np.empty((2, 2, pixels.rows.size), dtype=np.float32)
    curvature_deviation(mesh.nodes, mesh.elements, curvature[mesh.elements].mean(axis=1), *geometry, deviation)
    offset = _offset(reference, equations, deviation)
    interpolate_nodal(offset, mesh.elements, *geometry, carried)
    one_sided = _one_sided(mesh, curvature)
    return CurvatureOffset(
        displacement=offset,
        one_sided=one_sided,
        strain=reference.strain(offset) + one_sided,
        deviation=deviation - carried,
    )


def _offset(reference: Reference, equations: Equations, deviation: FloatImage) -> FloatArray:
    """Offset (N, 2) of the nodes: the `deviation` (2, P) projected as a residual is."""
    mesh, pixels = reference.mesh, reference.pixels
    total = np.zeros(reference.assembly.size)
    parts = np.zeros((len(mesh.elements), 3, 2))
    for weight, gx, gy in zip(equations.weights, reference.gradient_x, reference.gradient_y, strict=True):
        along = weight * (gx * deviation[0] + gy * deviation[1])
        element_vector(
            along * gx, along * gy, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, parts
        )
        total += reference.assembly.vector(parts)
    return equations.solve(total).reshape(-1, 2)


def _one_sided(mesh: Tri3Mesh, curvature: FloatArray) -> FloatArray:
    """Mean slope of the elements around each node less the slope at the node, as a strain (N, 3), for second
    derivatives (N, 2, 3) at the nodes."""
    slopes = mesh.shape_gradients() * mesh.areas[:, None, None]
    corners = mesh.nodes[mesh.elements]
    gradient = np.zeros((len(mesh.nodes), 2, 2))
    for node in range(3):
        arm = corners - corners[:, node, None]
        squares = np.stack([arm[..., 0] ** 2, 2 * arm[..., 0] * arm[..., 1], arm[..., 1] ** 2], axis=-1) / 2
        values = np.einsum("ebq,ecq->ecb", squares, curvature[mesh.elements[:, node]])
        np.add.at(gradient, mesh.elements[:, node], np.einsum("ecb,ebd->ecd", values, slopes))
    gradient /= mesh.to_nodes(mesh.areas)[:, None, None]
    shear = (gradient[:, 0, 1] + gradient[:, 1, 0]) / 2
    return np.stack([gradient[:, 0, 0], gradient[:, 1, 1], shear], axis=1)


def _curvature(reference: Reference, displacement: FloatArray, measured: BoolArray) -> FloatArray:
    """Second derivatives (N, 2, 3) of u and v: the gradient recovered at the nodes, and once more."""
    mesh = reference.mesh
    slopes = mesh.nodal_gradient(displacement)
    second = mesh.nodal_gradient(slopes.reshape(-1, 4)).reshape(-1, 2, 2, 2)
    symmetric = np.stack([second[..., 0, 0], (second[..., 0, 1] + second[..., 1, 0]) / 2, second[..., 1, 1]], axis=-1)
    deep = np.flatnonzero(_deep(reference, measured))
    if not len(deep):
        return np.zeros_like(symmetric)
    distance, nearest = (np.asarray(a) for a in cKDTree(mesh.nodes[deep]).query(mesh.places))
    # towards an edge the gradient is one-sided: there the curvature is that of the nearest node that knows it
    near = distance <= _FARTHEST * mesh.size
    return np.where(near[:, None, None], symmetric[deep][nearest], 0)


def _deep(reference: Reference, measured: BoolArray) -> BoolArray:
    """Nodes whose neighbours, and theirs, are all measured and inside the mesh: only there is a curvature known."""
    mesh = reference.mesh
    i, j = mesh.neighbours.T
    deep = measured & ~mesh.on_boundary
    shallow = ~deep
    reached = shallow.copy()
    np.logical_or.at(reached, i, shallow[j])
    np.logical_or.at(reached, j, shallow[i])
    return ~reached
