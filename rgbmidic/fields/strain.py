"""Strain from nodal displacements."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rgbmidic.mesh import Tri3Mesh

__all__ = ["nodal_strain"]

FloatArray = npt.NDArray[np.float64]


def nodal_strain(mesh: Tri3Mesh, displacement: FloatArray) -> FloatArray:
    """Small strain (exx, eyy, exy) at the nodes, tensor shear, from displacements (N, 2) in px.

    The strain of a linear element is constant; a node gets the area-weighted mean of the elements around it.

    Parameters
    ----------
    mesh
        The mesh.
    displacement
        (u, v) of each node; NaN where not measured.

    Returns
    -------
    ndarray, shape (N, 3), float64
        NaN where the node or one of its neighbours is not measured.
    """
    gradient = mesh.nodal_gradient(displacement)
    exx, eyy = gradient[:, 0, 0], gradient[:, 1, 1]
    exy = (gradient[:, 0, 1] + gradient[:, 1, 0]) / 2
    return np.stack([exx, eyy, exy], axis=1)
