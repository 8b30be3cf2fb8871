"""What linear elements cannot follow: the nodal values corrected for the curvature of the field.

A least-squares fit of linear elements to a curved field passes above and below it: its nodes are off by about
``h^2/12`` times the second derivative (on a sphere turned by 8 degrees 0.02 px with 25 px elements, several times the
noise). The second derivatives are recovered from the solution; the deviation of the curved field from its linear
interpolant is projected like any other residual and taken off the nodal values, which then are those of the curved
field; between the nodes that field is not linear any more.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic._kernels.correlation import curvature_deviation, element_vector
from rgbmidic.correlation.problem import Reference
from rgbmidic.correlation.step import Step

__all__ = ["curvature_correction"]

FloatArray = npt.NDArray[np.float64]


def curvature_correction(reference: Reference, step: Step, displacement: FloatArray) -> FloatArray:
    """What to subtract from the nodal displacement (N, 2) in px; 0 beside nodes that are not measured.

    Parameters
    ----------
    reference
        The reference state.
    step
        The last pass, with its weights and factors.
    displacement : ndarray, shape (N, 2)
        The solution, finite everywhere.
    """
    mesh, pixels = reference.mesh, reference.pixels
    deviation = np.empty((2, pixels.rows.size), dtype=np.float32)
    curvature_deviation(
        mesh.nodes,
        mesh.elements,
        _curvature(reference, displacement, step.measured),
        pixels.local_x,
        pixels.local_y,
        pixels.offsets,
        pixels.barycentric,
        deviation,
    )
    total = np.zeros(reference.equations.size)
    parts = np.zeros((len(mesh.elements), 3, 2))
    for weight, gx, gy in zip(step.weights, reference.gradient_x, reference.gradient_y, strict=True):
        along = weight * (gx * deviation[0] + gy * deviation[1])
        element_vector(
            along * gx, along * gy, pixels.local_x, pixels.local_y, pixels.offsets, pixels.barycentric, parts
        )
        total += reference.equations.vector(parts)
    return step.solve(total).reshape(-1, 2)


def _curvature(reference: Reference, displacement: FloatArray, measured: npt.NDArray[np.bool_]) -> FloatArray:
    """Second derivatives (E, 2, 3) of u and v: the gradient recovered at the nodes, and once more."""
    mesh = reference.mesh
    slopes = mesh.nodal_gradient(displacement)
    second = mesh.nodal_gradient(slopes.reshape(-1, 4)).reshape(-1, 2, 2, 2)
    symmetric = np.stack([second[..., 0, 0], (second[..., 0, 1] + second[..., 1, 0]) / 2, second[..., 1, 1]], axis=-1)
    symmetric[~_deep(reference, measured)] = np.nan
    corners = symmetric[mesh.elements]
    known = np.isfinite(corners).all(axis=(2, 3))
    share = np.maximum(known.sum(axis=1), 1)[:, None, None]
    return np.asarray(np.nan_to_num(corners).sum(axis=1) / share)


def _deep(reference: Reference, measured: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Nodes whose neighbours, and theirs, are all measured and inside the mesh: only there is a curvature known."""
    mesh = reference.mesh
    i, j = mesh.neighbours.T
    deep = measured & ~mesh.on_boundary
    shallow = ~deep
    reached = shallow.copy()
    np.logical_or.at(reached, i, shallow[j])
    np.logical_or.at(reached, j, shallow[i])
    return ~reached
